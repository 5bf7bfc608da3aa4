//! Which host names a call may name: the defence against DNS rebinding.
//!
//! A page of the web can give its own name the address of this machine. Its calls then look like
//! calls of the server's own page, but they still have the page's name. So without keys a call must
//! name loopback, an address that the server listens on, or a host of `allowed_hosts`. With keys
//! any name is allowed unless `allowed_hosts` is set, because a browser never adds a key by itself.

use std::net::IpAddr;

use crate::{
    config::Config,
    error::{Error, ErrorCode, Result, short},
};

/// The hosts that calls may name.
#[derive(Debug)]
pub(super) struct AllowedHosts {
    /// Every host is allowed.
    any: bool,
    names: Vec<String>,
    listen: IpAddr,
}

impl AllowedHosts {
    pub(super) fn new(config: &Config) -> Self {
        let names = &config.allowed_hosts;
        let any = names.iter().any(|n| n == "*") || (names.is_empty() && config.keys.is_some());
        let names = names.iter().map(|name| plain(name)).collect();
        Self { any, names, listen: config.listen.ip() }
    }

    /// Checks each host, `name` or `name:port`, that a call names. A call that names none is not a
    /// browser's, and passes.
    ///
    /// # Errors
    /// `permission_denied` with the name.
    pub(super) fn check<'a>(&self, mut hosts: impl Iterator<Item = &'a str>) -> Result<()> {
        match hosts.find(|host| !self.any && !self.allows(host)) {
            None => Ok(()),
            Some(host) => {
                let host = short(host);
                let message = format!("host {host:?} is not allowed; name it in allowed_hosts");
                Err(Error::new(ErrorCode::PermissionDenied, message))
            }
        }
    }

    fn allows(&self, host: &str) -> bool {
        let name = match host.rsplit_once(':') {
            Some((name, port)) if port.bytes().all(|c| c.is_ascii_digit()) => plain(name),
            _ => plain(host),
        };
        match name.parse::<IpAddr>().map(|ip| ip.to_canonical()) {
            Ok(ip) if ip.is_loopback() || self.listen.is_unspecified() || ip == self.listen => true,
            _ => name == "localhost" || self.names.contains(&name),
        }
    }
}

/// A host's name in lower case, without the root's dot and the brackets of an IPv6 address.
fn plain(host: &str) -> String {
    let host = host.strip_prefix('[').and_then(|h| h.strip_suffix(']')).unwrap_or(host);
    host.strip_suffix('.').unwrap_or(host).to_ascii_lowercase()
}
