//! Which host names a call may name: the defence against DNS rebinding.
//!
//! A page of the web can give its own name the address of this machine. Its calls then look like
//! calls of the server's own page, but they still carry the page's name. So without keys a call
//! must name loopback, an address that the server listens on, or a host of `allowed_hosts`. With
//! keys, every name is allowed unless `allowed_hosts` is set: a browser never adds a key by itself.

use std::net::IpAddr;

use crate::{
    config::Config,
    error::{Error, ErrorCode, Result},
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
                let shown: String = host.chars().take(80).collect();
                let message = format!("host {shown:?} is not allowed; name it in allowed_hosts");
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

#[cfg(test)]
mod tests {
    use super::*;

    fn hosts(listen: &str, names: &[&str], keys: bool) -> AllowedHosts {
        AllowedHosts::new(&Config {
            listen: format!("{listen}:8080").parse().unwrap(),
            allowed_hosts: names.iter().map(|&name| name.to_owned()).collect(),
            keys: keys.then(|| "keys.toml".into()),
            ..Config::default()
        })
    }

    fn allows(hosts: &AllowedHosts, host: &str) -> bool {
        hosts.check([host].into_iter()).is_ok()
    }

    #[test]
    fn without_keys_a_call_names_loopback_the_address_or_an_allowed_host() {
        let own = hosts("127.0.0.1", &["gpu.example"], false);
        for host in ["localhost:1", "LocalHost.", "127.0.0.1:8080", "127.8.9.1", "[::1]:80"] {
            assert!(allows(&own, host), "{host}");
        }
        assert!(allows(&own, "GPU.example:443"));
        for host in ["evil.example:8080", "localhost.evil.example", "10.0.0.7", "0.0.0.0:8080"] {
            assert!(!allows(&own, host), "{host}");
        }
        for host in ["", "a b", "evil.example@", "127.0.0.1.evil.example", "[::2]", "x@[::2]"] {
            assert!(!allows(&own, host), "{host:?}");
        }
        assert!(allows(&hosts("10.0.0.7", &[], false), "10.0.0.7:8080"));
        assert!(!allows(&hosts("10.0.0.7", &[], false), "10.0.0.8:8080"));
        // Who listens on every address has that of the caller; a rebound name is never an address.
        let open = hosts("0.0.0.0", &[], false);
        assert!(allows(&open, "10.0.0.8:8080") && !allows(&open, "evil.example"));
    }

    #[test]
    fn with_keys_or_a_star_any_host_is_allowed_unless_some_are_named() {
        assert!(allows(&hosts("0.0.0.0", &[], true), "any.example"));
        assert!(allows(&hosts("127.0.0.1", &["*"], false), "any.example"));
        assert!(!allows(&hosts("0.0.0.0", &["gpu.example"], true), "any.example"));
    }

    #[test]
    fn every_host_that_is_named_counts_and_naming_none_is_allowed() {
        let own = hosts("127.0.0.1", &[], false);
        assert!(own.check(["localhost", "127.0.0.1:80"].into_iter()).is_ok());
        assert!(own.check(std::iter::empty()).is_ok());
        let error = own.check(["localhost", "evil.example"].into_iter()).unwrap_err();
        assert!(error.message().contains("evil.example"), "{error}");
    }
}
