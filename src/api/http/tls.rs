//! TLS on the one port: HTTP/1.1, HTTP/2 and gRPC by ALPN.
//!
//! Handshakes run beside each other and have a time limit, so that a slow caller delays nobody.

use std::{
    fmt, io,
    net::SocketAddr,
    sync::{Arc, PoisonError, RwLock},
    time::Duration,
};

use axum::serve::Listener;
use tokio::{net::TcpStream, sync::mpsc};
use tokio_rustls::{
    TlsAcceptor,
    rustls::{
        ServerConfig,
        crypto::ring,
        pki_types::{CertificateDer, PrivateKeyDer, pem::PemObject},
    },
    server::TlsStream,
};

use crate::{
    config::Config,
    error::{Error, Result},
};

/// Longest handshake.
const HANDSHAKE_MAX: Duration = Duration::from_secs(10);
/// Handshakes at the same time, and connections that wait for `accept` after theirs.
const HANDSHAKES_MAX: usize = 256;

/// The certificate in force. Cloning shares it.
#[derive(Clone)]
pub(super) struct Tls(Arc<RwLock<Arc<ServerConfig>>>);

impl fmt::Debug for Tls {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Tls").finish_non_exhaustive()
    }
}

impl Tls {
    /// Certificate and key that the configuration names; `None` where it names none.
    pub(super) fn new(config: &Config) -> Result<Option<Self>> {
        let server = load(config)?;
        Ok(server.map(|server| Self(Arc::new(RwLock::new(server)))))
    }

    /// Reads the files again; the call that this gives puts them in force.
    pub(super) fn read_again(&self, config: &Config) -> Result<impl FnOnce() + use<>> {
        let server = load(config)?.ok_or_else(|| {
            Error::invalid("tls_cert: TLS cannot be switched off while the server runs")
        })?;
        let in_force = Arc::clone(&self.0);
        Ok(move || *in_force.write().unwrap_or_else(PoisonError::into_inner) = server)
    }

    /// Connections of `listener` after their handshakes.
    pub(super) fn listen<L>(&self, mut listener: L) -> Result<TlsListener>
    where
        L: Listener<Io = TcpStream, Addr = SocketAddr>,
    {
        let local = listener
            .local_addr()
            .map_err(|e| Error::internal("the listener has no address").caused_by(e))?;
        let (to, ready) = mpsc::channel(HANDSHAKES_MAX);
        let tls = self.clone();
        tokio::spawn(async move {
            loop {
                // A place in the channel first: without one, callers stay in the system's queue.
                let Ok(place) = to.clone().reserve_owned().await else { return };
                let (stream, from) = tokio::select! {
                    accepted = listener.accept() => accepted,
                    () = to.closed() => return,
                };
                let server = Arc::clone(&tls.0.read().unwrap_or_else(PoisonError::into_inner));
                tokio::spawn(async move {
                    let handshake = TlsAcceptor::from(server).accept(stream);
                    match tokio::time::timeout(HANDSHAKE_MAX, handshake).await {
                        Ok(Ok(stream)) => drop(place.send((stream, from))),
                        Ok(Err(error)) => tracing::debug!(%error, "a handshake failed"),
                        Err(_) => tracing::debug!("a handshake took too long"),
                    }
                });
            }
        });
        Ok(TlsListener { local, ready })
    }
}

fn load(config: &Config) -> Result<Option<Arc<ServerConfig>>> {
    let (Some(cert), Some(key)) = (&config.tls_cert, &config.tls_key) else { return Ok(None) };
    // The messages name the option: the text of the key's file never reaches a log.
    let wrong = |what: &str, why: String| Error::invalid(format!("{what}: {why}"));
    let chain = CertificateDer::pem_file_iter(cert)
        .and_then(Iterator::collect::<std::result::Result<Vec<_>, _>>)
        .map_err(|e| wrong("tls_cert", e.to_string()))?;
    if chain.is_empty() {
        return Err(wrong("tls_cert", "the file holds no certificate".to_owned()));
    }
    let key = PrivateKeyDer::from_pem_file(key).map_err(|_| {
        wrong("tls_key", "the file holds no readable private key in PEM".to_owned())
    })?;
    let mut server = ServerConfig::builder_with_provider(Arc::new(ring::default_provider()))
        .with_safe_default_protocol_versions()
        .map_err(|e| Error::internal("TLS cannot be set up").caused_by(e))?
        .with_no_client_auth()
        .with_single_cert(chain, key)
        .map_err(|e| wrong("tls_cert and tls_key", e.to_string()))?;
    server.alpn_protocols = vec![b"h2".to_vec(), b"http/1.1".to_vec()];
    Ok(Some(Arc::new(server)))
}

/// Connections after their handshakes.
#[derive(Debug)]
pub(super) struct TlsListener {
    local: SocketAddr,
    ready: mpsc::Receiver<(TlsStream<TcpStream>, SocketAddr)>,
}

impl Listener for TlsListener {
    type Io = TlsStream<TcpStream>;
    type Addr = SocketAddr;

    async fn accept(&mut self) -> (Self::Io, Self::Addr) {
        match self.ready.recv().await {
            Some(ready) => ready,
            // The task that sends ends only after this receiver.
            None => std::future::pending().await,
        }
    }

    fn local_addr(&self) -> io::Result<Self::Addr> {
        Ok(self.local)
    }
}
