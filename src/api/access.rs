//! Who is let in: one rule for both doors. What a key may call, how often and how much at once.
//!
//! In: the value of `authorization`. Out: a [`Pass`] that holds a place until the answer has been
//! sent, or `unauthenticated`, `permission_denied`, `overloaded`. A key is never logged.

use std::{
    sync::{Arc, Mutex, PoisonError, RwLock},
    time::{Duration, Instant},
};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use super::hosts::AllowedHosts;
use crate::{
    config::Config,
    error::{Error, ErrorCode, Result},
    keys::{Caller, Keys, Scope},
};

/// The gRPC methods of the one service: name in metrics and what each needs. The HTTP routes say it
/// themselves, and a test holds the two together.
const RPCS: [(&str, &str, Scope); 10] = [
    ("CreateScene", "create_scene", Scope::Write),
    ("DeleteScene", "delete_scene", Scope::Write),
    ("Export", "export", Scope::Read),
    ("GetScene", "get_scene", Scope::Read),
    ("ListScenes", "list_scenes", Scope::Read),
    ("Pick", "pick", Scope::Read),
    ("Query", "query", Scope::Read),
    ("RenderView", "render_view", Scope::Read),
    ("RenderViews", "render_views", Scope::Read),
    ("WatchScene", "watch_scene", Scope::Read),
];

/// Name in metrics of calls that are none of ours: health, reflection, unknown routes.
pub(super) const OTHER: &str = "other";

/// Name in metrics of a gRPC path, and what it needs; health and reflection, which tell nothing of
/// scenes, need nothing.
pub(super) fn of_rpc(path: &str) -> (&'static str, Option<Scope>) {
    let Some(method) = path.strip_prefix("/segsplat.v1.SceneService/") else {
        return (OTHER, None);
    };
    // A method added without a row here is nobody's but the admin's.
    let row = RPCS.iter().find(|(name, ..)| *name == method);
    row.map_or((OTHER, Some(Scope::Admin)), |(_, call, scope)| (call, Some(*scope)))
}

/// Names in metrics of all gRPC calls.
pub(super) fn rpc_calls() -> impl Iterator<Item = &'static str> {
    RPCS.iter().map(|(_, call, _)| *call).chain([OTHER])
}

/// Leave to call; gives its place back when dropped.
#[derive(Debug)]
pub(super) struct Pass {
    /// Whose scenes the call may see.
    pub(super) caller: Caller,
    /// Name of the key, for the log.
    pub(super) key: Option<Arc<str>>,
    _place: Option<OwnedSemaphorePermit>,
}

/// The keys in force, with what each has used up.
#[derive(Debug)]
pub(super) struct Access {
    ring: RwLock<Arc<Ring>>,
}

#[derive(Debug)]
struct Ring {
    hosts: AllowedHosts,
    /// `None`: nobody is asked for a key.
    keys: Option<(Keys, Vec<Share>)>,
}

/// What one key may use.
#[derive(Debug)]
struct Share {
    rate: Rate,
    places: Arc<Semaphore>,
    places_max: usize,
}

/// Requests a second, a second's worth at once (GCRA: the time at which the next request is due).
#[derive(Debug)]
struct Rate {
    interval: Duration,
    due: Mutex<Instant>,
}

impl Rate {
    fn per_second(requests: u32) -> Self {
        let interval = Duration::from_secs(1) / requests.max(1);
        Self { interval, due: Mutex::new(Instant::now()) }
    }

    /// Takes one request at the time `now`, or says how long to wait for it.
    fn take(&self, now: Instant) -> Result<(), Duration> {
        let mut due = self.due.lock().unwrap_or_else(PoisonError::into_inner);
        let next = (*due).max(now) + self.interval;
        let early = next.saturating_duration_since(now + Duration::from_secs(1));
        if early.is_zero() {
            *due = next;
            return Ok(());
        }
        Err(early)
    }
}

impl Ring {
    fn load(config: &Config) -> Result<Self> {
        let hosts = AllowedHosts::new(config);
        let Some(path) = &config.keys else { return Ok(Self { hosts, keys: None }) };
        let keys = Keys::load(path)?;
        let shares = keys.iter().map(|key| {
            let per_s = key.requests_per_s.unwrap_or(config.limits.key_requests_per_s);
            let places_max = key.inflight_max.unwrap_or(config.limits.key_inflight_max);
            Share {
                rate: Rate::per_second(per_s),
                places: Arc::new(Semaphore::new(places_max)),
                places_max,
            }
        });
        let shares = shares.collect();
        Ok(Self { hosts, keys: Some((keys, shares)) })
    }
}

impl Access {
    /// The keys of the file that the configuration names.
    pub(super) fn new(config: &Config) -> Result<Self> {
        Ok(Self { ring: RwLock::new(Arc::new(Ring::load(config)?)) })
    }

    /// Reads the file again; how many keys there are now. On an error the old keys stay.
    pub(super) fn reload(&self, config: &Config) -> Result<usize> {
        let ring = Ring::load(config)?;
        let count = ring.keys.as_ref().map_or(0, |(_, shares)| shares.len());
        *self.ring.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(ring);
        Ok(count)
    }

    /// Whether callers must show a key.
    pub(super) fn asks(&self) -> bool {
        self.ring().keys.is_some()
    }

    /// Checks each host that a call names.
    pub(super) fn check_hosts<'a>(&self, hosts: impl Iterator<Item = &'a str>) -> Result<()> {
        self.ring().hosts.check(hosts)
    }

    /// Lets a call in that needs `scope`; `shown` is the value of `authorization`.
    pub(super) fn admit(&self, shown: Option<&str>, scope: Scope) -> Result<Pass> {
        let ring = self.ring();
        let Some((keys, shares)) = &ring.keys else {
            return Ok(Pass { caller: Caller::All, key: None, _place: None });
        };
        let refused = |why: &str| Error::new(ErrorCode::Unauthenticated, why);
        let shown = shown.ok_or_else(|| refused("no key; send authorization: Bearer KEY"))?;
        let bearer = shown.split_at_checked(7).filter(|(s, _)| s.eq_ignore_ascii_case("bearer "));
        let (_, secret) =
            bearer.ok_or_else(|| refused("authorization must be: Bearer and a key"))?;
        let (key, share) = keys
            .find(secret.trim())
            .and_then(|found| {
                let at = keys.iter().position(|key| key.name == found.name)?;
                Some((found, shares.get(at)?))
            })
            .ok_or_else(|| refused("the key is not one of this server's"))?;
        if key.scope < scope {
            return Err(Error::new(
                ErrorCode::PermissionDenied,
                format!("key {:?} has scope {}; this call needs {scope}", key.name, key.scope),
            ));
        }
        if let Err(wait) = share.rate.take(Instant::now()) {
            let seconds = u32::try_from(wait.as_secs()).unwrap_or(u32::MAX).saturating_add(1);
            let message = format!("key {:?} has used up its requests a second", key.name);
            return Err(Error::new(ErrorCode::Overloaded, message).retry_after_s(seconds));
        }
        let place = Arc::clone(&share.places).try_acquire_owned().map_err(|_| {
            let message = format!("key {:?} has {} calls open already", key.name, share.places_max);
            Error::new(ErrorCode::Overloaded, message).retry_after_s(1)
        })?;
        let (caller, name) = (key.caller(), Arc::clone(&key.name));
        Ok(Pass { caller, key: Some(name), _place: Some(place) })
    }

    fn ring(&self) -> Arc<Ring> {
        Arc::clone(&self.ring.read().unwrap_or_else(PoisonError::into_inner))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::keys::hash;

    fn access(rest: &str) -> (tempfile::TempDir, Config, Access) {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("keys.toml");
        let text = format!("[[key]]\nname = \"a\"\nsha256 = \"{}\"\n{rest}", hash("secret"));
        std::fs::write(&path, text).unwrap();
        let config = Config { keys: Some(path), ..Config::default() };
        let access = Access::new(&config).unwrap();
        (folder, config, access)
    }

    fn code(access: &Access, shown: Option<&str>, scope: Scope) -> Option<ErrorCode> {
        access.admit(shown, scope).err().map(|error| {
            assert!(!error.message().contains("secret"), "{}", error.message());
            error.code()
        })
    }

    #[test]
    fn a_bearer_key_of_wide_enough_scope_is_let_in() {
        let (_folder, _, access) = access("scopes = [\"write\"]");
        for (shown, scope, want) in [
            (None, Scope::Read, Some(ErrorCode::Unauthenticated)),
            (Some(""), Scope::Read, Some(ErrorCode::Unauthenticated)),
            (Some("secret"), Scope::Read, Some(ErrorCode::Unauthenticated)),
            (Some("Basic secret"), Scope::Read, Some(ErrorCode::Unauthenticated)),
            (Some("Bearer secre"), Scope::Read, Some(ErrorCode::Unauthenticated)),
            (Some("Bearer "), Scope::Read, Some(ErrorCode::Unauthenticated)),
            (Some("Bearer secret"), Scope::Read, None),
            (Some("bearer secret"), Scope::Write, None),
            (Some("Bearer secret"), Scope::Admin, Some(ErrorCode::PermissionDenied)),
        ] {
            assert_eq!(code(&access, shown, scope), want, "{shown:?} for {scope:?}");
        }
    }

    #[test]
    fn a_method_without_a_row_is_the_admins() {
        let of = |method: &str| of_rpc(&format!("/segsplat.v1.SceneService/{method}"));
        assert_eq!(of("Pick"), ("pick", Some(Scope::Read)));
        assert_eq!(of("DeleteScene"), ("delete_scene", Some(Scope::Write)));
        assert_eq!(of("Nothing"), (OTHER, Some(Scope::Admin)));
        assert_eq!(of_rpc("/grpc.health.v1.Health/Check"), (OTHER, None));
        assert_eq!(rpc_calls().count(), RPCS.len() + 1);
    }

    #[test]
    fn rate_and_places_are_each_keys_own_and_places_return() {
        let rest = "scopes = [\"read\"]\nrequests_per_s = 3\ninflight_max = 2";
        let (_folder, _, access) = access(rest);
        let shown = Some("Bearer secret");
        let first = access.admit(shown, Scope::Read).unwrap();
        let second = access.admit(shown, Scope::Read).unwrap();
        let third = access.admit(shown, Scope::Read).unwrap_err();
        assert!(third.message().contains("2 calls open"), "{third}");
        drop((first, second));
        let fourth = access.admit(shown, Scope::Read).unwrap_err();
        assert_eq!((fourth.code(), fourth.retry_after()), (ErrorCode::Overloaded, Some(1)));
        assert!(fourth.message().contains("requests a second"), "{fourth}");
    }

    #[test]
    fn a_file_read_again_counts_at_once_and_a_bad_one_changes_nothing() {
        let (folder, mut config, access) = access("scopes = [\"read\"]");
        let path = folder.path().join("keys.toml");
        let shown = Some("Bearer secret");
        std::fs::write(&path, "rubbish").unwrap();
        assert!(access.reload(&config).is_err());
        assert_eq!(code(&access, shown, Scope::Read), None, "the old keys stay");
        let other = hash("other");
        let text = format!("[[key]]\nname = \"b\"\nsha256 = \"{other}\"\nscopes = [\"read\"]");
        std::fs::write(&path, text).unwrap();
        assert_eq!(access.reload(&config).unwrap(), 1);
        assert_eq!(code(&access, shown, Scope::Read), Some(ErrorCode::Unauthenticated));
        config.keys = None;
        assert!(access.asks());
        access.reload(&config).unwrap();
        assert!(!access.asks());
    }
}
