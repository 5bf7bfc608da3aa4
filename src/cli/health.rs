//! `segsplat health`: asks a running server whether it is ready, for containers without a shell.

use std::{
    io::{Read as _, Write as _},
    net::{IpAddr, Ipv4Addr, Ipv6Addr, SocketAddr, TcpStream},
    time::Duration,
};

use serde_json::json;

use super::output::Output;
use crate::{
    config::{Config, ListenArgs},
    error::{Error, ErrorCode, Result},
};

/// How long the server may take to answer.
const PATIENCE: Duration = Duration::from_secs(2);

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    #[command(flatten)]
    pub(super) listen: ListenArgs,
    /// Ask whether the process answers, not whether it is ready
    #[arg(long)]
    live: bool,
}

/// With TLS this only checks that the port is open: the certificate names hosts, not loopback.
pub(super) fn run(args: &Args, config: &Config, out: &Output) -> Result<()> {
    let address = beside(config.listen);
    let path = if args.live { "/healthz" } else { "/readyz" };
    let status = match config.tls_cert {
        Some(_) => connect(address).map(|_| "open".to_owned())?,
        None => ask(address, path)?,
    };
    if status == "open" || status == "200" {
        return out.answer("healthy", &json!({ "healthy": true, "address": address.to_string() }));
    }
    let message = format!("the server on {address} answers {path} with {status}");
    Err(Error::new(ErrorCode::Stopping, message))
}

/// Where a server that listens on `listen` is reached from the same machine.
fn beside(listen: SocketAddr) -> SocketAddr {
    let ip = match listen.ip() {
        IpAddr::V4(ip) if ip.is_unspecified() => Ipv4Addr::LOCALHOST.into(),
        IpAddr::V6(ip) if ip.is_unspecified() => Ipv6Addr::LOCALHOST.into(),
        ip => ip,
    };
    SocketAddr::new(ip, listen.port())
}

fn connect(address: SocketAddr) -> Result<TcpStream> {
    TcpStream::connect_timeout(&address, PATIENCE).map_err(|e| {
        Error::new(ErrorCode::Stopping, format!("no server answers on {address}")).caused_by(e)
    })
}

/// The status code of a GET.
fn ask(address: SocketAddr, path: &str) -> Result<String> {
    let mut stream = connect(address)?;
    let mut start = [0; 12];
    let request = format!("GET {path} HTTP/1.1\r\nhost: {address}\r\nconnection: close\r\n\r\n");
    stream
        .set_read_timeout(Some(PATIENCE))
        .and_then(|()| stream.set_write_timeout(Some(PATIENCE)))
        .and_then(|()| stream.write_all(request.as_bytes()))
        .and_then(|()| stream.read_exact(&mut start))
        .map_err(|e| {
            Error::new(ErrorCode::Stopping, format!("no answer from {address}")).caused_by(e)
        })?;
    // "HTTP/1.1 200"
    let status = start.get(9..).unwrap_or_default();
    Ok(String::from_utf8_lossy(status).into_owned())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_server_on_every_address_is_asked_on_loopback() {
        for (listen, want) in [
            ("0.0.0.0:8080", "127.0.0.1:8080"),
            ("[::]:80", "[::1]:80"),
            ("10.0.0.7:1", "10.0.0.7:1"),
        ] {
            assert_eq!(beside(listen.parse().unwrap()).to_string(), want);
        }
    }
}
