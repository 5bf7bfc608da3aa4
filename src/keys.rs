//! API keys: their hashes in a file, their scopes and whose scenes they see.
//!
//! A key is 256 random bits, so one sha256 hides it well enough: nobody can try all likely keys, as
//! is possible with passwords. Why: `docs/adr/`.

use std::{fmt, path::Path, sync::Arc};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use subtle::{ConditionallySelectable, ConstantTimeEq};

use crate::{
    error::{Error, Result},
    names::{display_names, hex},
};

/// Starts every key, so that scanners for leaked secrets can find one.
const PREFIX: &str = "segsplat_";
/// Random bytes of a key.
const SECRET_BYTES: usize = 32;
/// Longest name of a key or an owner.
const NAME_BYTES_MAX: usize = 64;
/// Keys in one file: each call compares its key with all of them.
const KEYS_MAX: usize = 4_096;

/// What a key may do. Each includes those before it.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Scope {
    /// Look at scenes, ask them, export them.
    Read,
    /// Also make and delete scenes.
    Write,
    /// Also see everybody's scenes and the metrics.
    Admin,
}

display_names!(Scope);

/// Whose scenes a call may see.
#[derive(Clone, Debug, Default, PartialEq, Eq, Hash)]
pub enum Caller {
    /// Those of all owners: no keys are configured, the key is an admin's, or the server calls.
    #[default]
    All,
    /// Those of this owner.
    Owner(Arc<str>),
}

impl Caller {
    /// The owner that scenes of this caller get.
    #[must_use]
    pub fn owner(&self) -> Option<&str> {
        match self {
            Self::All => None,
            Self::Owner(owner) => Some(owner),
        }
    }

    /// Whether a scene of this owner is there for the caller.
    #[must_use]
    pub fn sees(&self, owner: Option<&str>) -> bool {
        match self {
            Self::All => true,
            Self::Owner(own) => owner == Some(&**own),
        }
    }
}

/// One key of the file.
#[derive(Clone)]
pub struct Key {
    /// Shown in the log and in metrics; never the key itself.
    pub name: Arc<str>,
    /// Whose scenes it makes and sees.
    pub owner: Arc<str>,
    /// The widest of its scopes.
    pub scope: Scope,
    /// Requests a second; `None`: `limits.key_requests_per_s`.
    pub requests_per_s: Option<u32>,
    /// Requests at once; `None`: `limits.key_inflight_max`.
    pub inflight_max: Option<usize>,
    /// Hex, lower case.
    sha256: String,
}

impl fmt::Debug for Key {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Key").field("name", &self.name).finish_non_exhaustive()
    }
}

impl Key {
    /// Whose scenes a call with this key may see.
    #[must_use]
    pub fn caller(&self) -> Caller {
        match self.scope {
            Scope::Admin => Caller::All,
            Scope::Read | Scope::Write => Caller::Owner(Arc::clone(&self.owner)),
        }
    }
}

/// The keys of a file.
#[derive(Clone, Debug, Default)]
pub struct Keys(Vec<Key>);

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct File {
    #[serde(default)]
    key: Vec<Row>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Row {
    name: String,
    owner: Option<String>,
    sha256: String,
    scopes: Vec<Scope>,
    requests_per_s: Option<u32>,
    inflight_max: Option<usize>,
}

impl Keys {
    /// The keys of the TOML file at `path`.
    ///
    /// # Errors
    /// `invalid_request` when it cannot be read or a key is wrong; never with a key's hash.
    pub fn load(path: &Path) -> Result<Self> {
        let text = fs_err::read_to_string(path)
            .map_err(|e| Error::invalid(format!("keys file: {e}")).caused_by(e))?;
        Self::parse(&text)
    }

    /// The keys of a TOML text.
    ///
    /// # Errors
    /// `invalid_request` when a key is wrong; never with its hash.
    pub fn parse(text: &str) -> Result<Self> {
        let file: File = toml::from_str(text)
            // The parser shows the line it stands on, which may hold a hash.
            .map_err(|e| Error::invalid(format!("keys file: {}", e.message())))?;
        if file.key.len() > KEYS_MAX {
            return Err(Error::limit("keys file: keys", file.key.len(), KEYS_MAX));
        }
        let keys = file.key.into_iter().map(key_of).collect::<Result<Vec<_>>>()?;
        for (i, key) in keys.iter().enumerate() {
            if keys[..i].iter().any(|other| other.name == key.name || other.sha256 == key.sha256) {
                let name = &key.name;
                return Err(Error::invalid(format!("keys file: key {name:?} is given twice")));
            }
        }
        if keys.is_empty() {
            return Err(Error::invalid("keys file: it has no [[key]], so nobody could call"));
        }
        Ok(Self(keys))
    }

    /// The key that a caller shows and its index. The time does not depend on which key it is.
    #[must_use]
    pub fn find(&self, shown: &str) -> Option<(usize, &Key)> {
        let digest = key_sha256(shown);
        let mut found = u32::MAX;
        for (i, key) in (0_u32..).zip(&self.0) {
            found.conditional_assign(&i, digest.as_bytes().ct_eq(key.sha256.as_bytes()));
        }
        let i = usize::try_from(found).ok()?;
        Some((i, self.0.get(i)?))
    }

    /// All keys.
    pub fn iter(&self) -> impl Iterator<Item = &Key> {
        self.0.iter()
    }
}

fn key_of(row: Row) -> Result<Key> {
    let Row { name, owner, sha256, scopes, requests_per_s, inflight_max } = row;
    check_name("name", &name)?;
    let owner = owner.unwrap_or_else(|| name.clone());
    check_name("owner", &owner)?;
    let wrong = |what: &str| Error::invalid(format!("keys file: key {name:?}: {what}"));
    let Some(scope) = scopes.into_iter().max() else {
        return Err(wrong("scopes is empty; give read, write or admin"));
    };
    if sha256.len() != 64 || !sha256.bytes().all(|c| c.is_ascii_hexdigit()) {
        return Err(wrong("sha256 is not 64 hex digits; `segsplat keys hash` prints them"));
    }
    if requests_per_s == Some(0) || inflight_max == Some(0) {
        return Err(wrong("requests_per_s and inflight_max must be over 0"));
    }
    let sha256 = sha256.to_ascii_lowercase();
    Ok(Key { name: name.into(), owner: owner.into(), scope, requests_per_s, inflight_max, sha256 })
}

/// 1 to 64 letters, digits, `-`, `_` or `.`: names go into log lines and metrics.
///
/// # Errors
/// `invalid_request`.
pub fn check_name(what: &str, name: &str) -> Result<()> {
    let harmless = |c: u8| c.is_ascii_alphanumeric() || b"-_.".contains(&c);
    if (1..=NAME_BYTES_MAX).contains(&name.len()) && name.bytes().all(harmless) {
        return Ok(());
    }
    let shown: String = name.chars().take(40).collect();
    Err(Error::invalid(format!(
        "keys: {what} {shown:?} must be 1 to {NAME_BYTES_MAX} letters, digits, '-', '_' or '.'"
    )))
}

/// A new key: 256 bits of the system's random numbers.
///
/// # Errors
/// `internal` when the system gives none.
pub fn generate() -> Result<String> {
    let mut secret = [0; SECRET_BYTES];
    getrandom::fill(&mut secret)
        .map_err(|e| Error::internal(format!("the system gives no random numbers: {e}")))?;
    Ok(format!("{PREFIX}{}", hex(&secret)))
}

/// What the keys file holds of a key: its sha256, hex.
#[must_use]
pub fn key_sha256(key: &str) -> String {
    hex(&Sha256::digest(key.as_bytes()))
}
