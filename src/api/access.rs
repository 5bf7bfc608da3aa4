//! Which calls are allowed: one rule for HTTP and gRPC. A key says which calls its holder may make,
//! how often and how many at once.
//!
//! In: the value of `authorization`. Out: an [`Admission`] that holds a permit until the answer has
//! been sent, or `unauthenticated`, `permission_denied`, `overloaded`. No key is ever logged.

use std::{
    sync::{
        Arc, Mutex, PoisonError, RwLock,
        atomic::{AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use super::hosts::AllowedHosts;
use crate::{
    config::Config,
    error::{Error, ErrorCode, Result},
    keys::{Caller, Keys, Scope},
};

/// Scopes that calls need; `None`: callers need no key.
const NONE: Option<Scope> = None;
const READ: Option<Scope> = Some(Scope::Read);
const WRITE: Option<Scope> = Some(Scope::Write);

/// The gRPC methods of a service: name in metrics and the scope that each needs. The HTTP routes
/// have their own list. A test compares the two.
type Rpcs = &'static [(&'static str, &'static str, Option<Scope>)];

const SERVICES: [(&str, Rpcs); 2] = [
    (
        "/segsplat.v1.SceneService/",
        &[
            ("AddPhotos", "add_photos", WRITE),
            ("CreateScene", "create_scene", WRITE),
            ("DeleteScene", "delete_scene", WRITE),
            ("Export", "export", READ),
            ("Features", "features", READ),
            ("GetEdits", "get_edits", READ),
            ("GetScale", "get_scale", READ),
            ("GetScene", "get_scene", READ),
            ("ListScenes", "list_scenes", READ),
            ("Measure", "measure", READ),
            ("Models", "models", READ),
            ("Pick", "pick", READ),
            ("Query", "query", READ),
            ("RefineScene", "refine_scene", WRITE),
            ("RemovePhoto", "remove_photo", WRITE),
            ("RenderView", "render_view", READ),
            ("RenderViews", "render_views", READ),
            ("SetEdits", "set_edits", WRITE),
            ("SetScale", "set_scale", WRITE),
            ("WatchScene", "watch_scene", READ),
        ],
    ),
    (
        "/inference.GRPCInferenceService/",
        &[
            ("ModelInfer", "model_infer", WRITE),
            ("ModelMetadata", "model_metadata", READ),
            ("ModelReady", "model_ready", READ),
            ("ServerLive", "server_live", NONE),
            ("ServerMetadata", "server_metadata", READ),
            ("ServerReady", "server_ready", NONE),
        ],
    ),
];

/// Name in metrics of all other calls: health, reflection, unknown routes.
pub(super) const OTHER: &str = "other";

/// Name in metrics of a gRPC path, and the scope that it needs. Health and reflection say nothing
/// of scenes and need none. A method that has no row here needs an admin's key.
pub(super) fn of_rpc(path: &str) -> (&'static str, Option<Scope>) {
    let method = |(service, rpcs): (&str, Rpcs)| Some((path.strip_prefix(service)?, rpcs));
    let Some((method, rpcs)) = SERVICES.into_iter().find_map(method) else {
        return (OTHER, None);
    };
    let row = rpcs.iter().find(|(name, ..)| *name == method);
    row.map_or((OTHER, Some(Scope::Admin)), |(_, call, scope)| (call, *scope))
}

/// Names in metrics of all gRPC calls.
pub(super) fn rpc_calls() -> impl Iterator<Item = &'static str> {
    let calls = SERVICES.into_iter().flat_map(|(_, rpcs)| rpcs);
    calls.map(|(_, call, _)| *call).chain([OTHER])
}

/// A call that is allowed. The key's permit returns when this is dropped.
#[derive(Debug)]
pub(super) struct Admission {
    /// Whose scenes the call may see.
    pub(super) caller: Caller,
    /// Name of the key, for the log.
    pub(super) key: Option<Arc<str>>,
    _open: Option<Open>,
}

/// Hosts and keys in force.
#[derive(Debug)]
pub(super) struct Access(RwLock<Arc<InForce>>);

#[derive(Debug)]
struct InForce {
    hosts: AllowedHosts,
    /// `None`: callers need no key. Each key has its quota at the same index.
    keys: Option<(Keys, Vec<Quota>)>,
}

/// How much one key may call.
#[derive(Debug)]
struct Quota {
    /// The time between two requests at the rate of the key.
    interval: Duration,
    open_max: usize,
    used: Arc<Used>,
}

/// How much one key has called: it stays when the keys are read again.
#[derive(Debug)]
struct Used {
    /// When the next request is due (GCRA).
    due: Mutex<Instant>,
    open: AtomicUsize,
}

/// An open call of a key.
#[derive(Debug)]
struct Open(Arc<Used>);

impl Drop for Open {
    fn drop(&mut self) {
        self.0.open.fetch_sub(1, Ordering::AcqRel);
    }
}

impl Default for Used {
    fn default() -> Self {
        Self { due: Mutex::new(Instant::now()), open: AtomicUsize::new(0) }
    }
}

impl Quota {
    /// Counts one request at the time `now`, or says how long to wait for it. A second's worth may
    /// come at once.
    fn take(&self, now: Instant) -> Result<(), Duration> {
        let mut due = self.used.due.lock().unwrap_or_else(PoisonError::into_inner);
        let next = (*due).max(now) + self.interval;
        let early = next.saturating_duration_since(now + Duration::from_secs(1));
        if early.is_zero() {
            *due = next;
            return Ok(());
        }
        Err(early)
    }

    /// One open call more, where the key may have it.
    fn open(&self) -> Option<Open> {
        let more = |open: usize| (open < self.open_max).then_some(open + 1);
        let opened = self.used.open.fetch_update(Ordering::AcqRel, Ordering::Acquire, more);
        opened.ok().map(|_| Open(Arc::clone(&self.used)))
    }
}

impl InForce {
    /// Reads the keys. Those that were in force `before` have used what they had used.
    fn load(config: &Config, before: Option<&Self>) -> Result<Self> {
        let hosts = AllowedHosts::new(config);
        let Some(path) = &config.keys else { return Ok(Self { hosts, keys: None }) };
        let keys = Keys::load(path)?;
        let quotas = keys.iter().map(|key| {
            let per_s = key.requests_per_s.unwrap_or(config.limits.key_requests_per_s);
            let open_max = key.inflight_max.unwrap_or(config.limits.key_inflight_max);
            let used = before.and_then(|before| before.used(&key.name)).unwrap_or_default();
            Quota { interval: Duration::from_secs(1) / per_s.max(1), open_max, used }
        });
        let quotas = quotas.collect();
        Ok(Self { hosts, keys: Some((keys, quotas)) })
    }

    /// What the key of this name has used.
    fn used(&self, name: &str) -> Option<Arc<Used>> {
        let (keys, quotas) = self.keys.as_ref()?;
        let known = keys.iter().zip(quotas).find(|(key, _)| &*key.name == name);
        known.map(|(_, quota)| Arc::clone(&quota.used))
    }
}

impl Access {
    /// Reads the keys of the file that the configuration names.
    pub(super) fn new(config: &Config) -> Result<Self> {
        Ok(Self(RwLock::new(Arc::new(InForce::load(config, None)?))))
    }

    /// Reads the file again; the call that this gives puts its keys in force, and gives how many.
    pub(super) fn read_again(&self, config: &Config) -> Result<impl FnOnce() -> usize> {
        let new = InForce::load(config, Some(&self.in_force()))?;
        Ok(move || {
            let count = new.keys.as_ref().map_or(0, |(_, quotas)| quotas.len());
            *self.0.write().unwrap_or_else(PoisonError::into_inner) = Arc::new(new);
            count
        })
    }

    /// Whether callers need a key.
    pub(super) fn needs_keys(&self) -> bool {
        self.in_force().keys.is_some()
    }

    /// Checks each host that a call names.
    pub(super) fn check_hosts<'a>(&self, hosts: impl Iterator<Item = &'a str>) -> Result<()> {
        self.in_force().hosts.check(hosts)
    }

    /// Allows a call that needs `scope`, or not; `shown` is the value of `authorization`.
    pub(super) fn admit(&self, shown: Option<&str>, scope: Scope) -> Result<Admission> {
        let in_force = self.in_force();
        let Some((keys, quotas)) = &in_force.keys else {
            return Ok(Admission { caller: Caller::All, key: None, _open: None });
        };
        let refused = |why: &str| Error::new(ErrorCode::Unauthenticated, why);
        let shown = shown.ok_or_else(|| refused("no key; send authorization: Bearer KEY"))?;
        let bearer = shown.split_at_checked(7).filter(|(s, _)| s.eq_ignore_ascii_case("bearer "));
        let (_, secret) =
            bearer.ok_or_else(|| refused("authorization must be: Bearer and a key"))?;
        let (key, quota) = keys
            .find(secret.trim())
            .and_then(|(i, key)| Some((key, quotas.get(i)?)))
            .ok_or_else(|| refused("the key is not one of this server's"))?;
        if key.scope < scope {
            return Err(Error::new(
                ErrorCode::PermissionDenied,
                format!("key {:?} has scope {}; this call needs {scope}", key.name, key.scope),
            ));
        }
        let overloaded = |why: String, seconds| {
            let message = format!("key {:?} {why}", key.name);
            Error::new(ErrorCode::Overloaded, message).retry_after_s(seconds)
        };
        quota.take(Instant::now()).map_err(|wait| {
            let seconds = u32::try_from(wait.as_secs()).unwrap_or(u32::MAX).saturating_add(1);
            overloaded("has used up its requests a second".to_owned(), seconds)
        })?;
        let open = quota
            .open()
            .ok_or_else(|| overloaded(format!("has {} calls open already", quota.open_max), 1))?;
        let (caller, name) = (key.caller(), Arc::clone(&key.name));
        Ok(Admission { caller, key: Some(name), _open: Some(open) })
    }

    fn in_force(&self) -> Arc<InForce> {
        Arc::clone(&self.0.read().unwrap_or_else(PoisonError::into_inner))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::keys::key_sha256;

    #[test]
    fn each_key_has_a_rate_and_permits_and_permits_return() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("keys.toml");
        let rest = "scopes = [\"read\"]\nrequests_per_s = 3\ninflight_max = 2";
        let text = format!("[[key]]\nname = \"a\"\nsha256 = \"{}\"\n{rest}", key_sha256("secret"));
        std::fs::write(&path, text).unwrap();
        let access = Access::new(&Config { keys: Some(path), ..Config::default() }).unwrap();
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
    fn keys_that_are_read_again_have_used_what_they_had_used() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("keys.toml");
        let write = |rest: &str| {
            let entry = |name: &str| {
                let sha256 = key_sha256(name);
                format!("[[key]]\nname = \"{name}\"\nsha256 = \"{sha256}\"\n{rest}\n")
            };
            let of = |name| entry(name) + "scopes = [\"read\"]\n";
            std::fs::write(&path, of("a") + &of("b")).unwrap();
        };
        write("inflight_max = 1");
        let config = Config { keys: Some(path.clone()), ..Config::default() };
        let access = Access::new(&config).unwrap();
        let admit = |name: &str| access.admit(Some(&format!("Bearer {name}")), Scope::Read);
        let open = admit("a").unwrap();
        access.read_again(&config).unwrap()();
        assert!(admit("a").unwrap_err().message().contains("1 calls open"));
        assert!(admit("b").is_ok(), "another key");
        write("inflight_max = 2");
        access.read_again(&config).unwrap()();
        let second = admit("a").unwrap();
        assert!(admit("a").is_err(), "the call from before counts");
        drop((open, second));
        assert!(admit("a").is_ok());
    }
}
