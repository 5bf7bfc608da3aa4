//! Who may call: API keys, kept as hashes in a file, their scopes and whose scenes they see.
//!
//! A key is 256 random bits, so one sha256 is all the hiding it needs: there is no short list of
//! likely keys to try, which is what slow password hashes defend. Why: `docs/adr/`.

use std::{fmt, path::Path, sync::Arc};

use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use subtle::{ConditionallySelectable, ConstantTimeEq};

use crate::{
    error::{Error, Result},
    names::display_names,
};

/// Starts every key, so that scanners for leaked secrets can find one.
const PREFIX: &str = "segsplat_";
/// Random bytes of a key.
const SECRET_BYTES: usize = 32;
/// Longest name of a key or an owner.
const NAME_BYTES_MAX: usize = 64;
/// Keys in one file: every one of them is compared with what a caller shows.
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
    /// Everybody's: no keys are configured, or the key is an admin's, or the call is our own.
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
    sha256: [u8; 32],
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
    key: Vec<Entry>,
}

#[derive(Deserialize)]
#[serde(deny_unknown_fields)]
struct Entry {
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
    /// `invalid_request` when it cannot be read or an entry is wrong; never with a key's hash.
    pub fn load(path: &Path) -> Result<Self> {
        let text = fs_err::read_to_string(path)
            .map_err(|e| Error::invalid(format!("keys file: {e}")).caused_by(e))?;
        Self::parse(&text)
    }

    /// The keys of a TOML text.
    ///
    /// # Errors
    /// `invalid_request` when an entry is wrong; never with a key's hash.
    pub fn parse(text: &str) -> Result<Self> {
        let file: File = toml::from_str(text)
            // The parser shows the line it stands on, which may hold a hash.
            .map_err(|e| Error::invalid(format!("keys file: {}", e.message())))?;
        if file.key.len() > KEYS_MAX {
            return Err(Error::limit("keys file: keys", file.key.len(), KEYS_MAX));
        }
        let keys = file.key.into_iter().map(entry).collect::<Result<Vec<_>>>()?;
        for (i, key) in keys.iter().enumerate() {
            if keys[..i].iter().any(|other| other.name == key.name || other.sha256 == key.sha256) {
                let name = &key.name;
                return Err(Error::invalid(format!("keys file: key {name:?} stands there twice")));
            }
        }
        if keys.is_empty() {
            return Err(Error::invalid("keys file: no [[key]] in it, so nobody could call"));
        }
        Ok(Self(keys))
    }

    /// The key that a caller shows, if it is one of these. Takes as long whichever it is.
    #[must_use]
    pub fn find(&self, shown: &str) -> Option<&Key> {
        let digest = sha256(shown);
        let mut found = u32::MAX;
        for (i, key) in (0_u32..).zip(&self.0) {
            found.conditional_assign(&i, digest.ct_eq(&key.sha256));
        }
        self.0.get(usize::try_from(found).ok()?)
    }

    /// All keys.
    pub fn iter(&self) -> impl Iterator<Item = &Key> {
        self.0.iter()
    }
}

fn entry(entry: Entry) -> Result<Key> {
    let Entry { name, owner, sha256, scopes, requests_per_s, inflight_max } = entry;
    check_name("name", &name)?;
    let owner = owner.unwrap_or_else(|| name.clone());
    check_name("owner", &owner)?;
    let wrong = |what: &str| Error::invalid(format!("keys file: key {name:?}: {what}"));
    let Some(scope) = scopes.into_iter().max() else {
        return Err(wrong("scopes is empty; give read, write or admin"));
    };
    let sha256 = unhex(&sha256)
        .ok_or_else(|| wrong("sha256 is not 64 hex digits; `segsplat keys hash` prints them"))?;
    if requests_per_s == Some(0) || inflight_max == Some(0) {
        return Err(wrong("requests_per_s and inflight_max must be over 0"));
    }
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
pub fn hash(key: &str) -> String {
    hex(&sha256(key))
}

fn sha256(key: &str) -> [u8; 32] {
    Sha256::digest(key.as_bytes()).into()
}

fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

fn unhex(text: &str) -> Option<[u8; 32]> {
    if text.len() != 64 || !text.bytes().all(|c| c.is_ascii_hexdigit()) {
        return None;
    }
    let mut bytes = [0; 32];
    for (byte, at) in bytes.iter_mut().zip((0..64).step_by(2)) {
        *byte = u8::from_str_radix(text.get(at..at + 2)?, 16).ok()?;
    }
    Some(bytes)
}

#[cfg(test)]
mod tests {
    use super::*;

    const READ: &str = "scopes = [\"read\"]";

    fn file(entries: &[(&str, &str, &str)]) -> String {
        let entry = |(name, key, rest): &(&str, &str, &str)| {
            format!("[[key]]\nname = \"{name}\"\nsha256 = \"{}\"\n{rest}\n", hash(key))
        };
        entries.iter().map(entry).collect()
    }

    #[test]
    fn a_key_is_found_by_itself_alone() {
        let (first, second) = (generate().unwrap(), generate().unwrap());
        assert_ne!(first, second);
        assert_eq!(first.len(), PREFIX.len() + 64);
        let text = file(&[
            ("a", &first, "scopes = [\"read\"]"),
            ("b", &second, "owner = \"team\"\nscopes = [\"write\", \"read\"]"),
        ]);
        let keys = Keys::parse(&text).unwrap();
        assert_eq!(&*keys.find(&first).unwrap().name, "a");
        let found = keys.find(&second).unwrap();
        assert_eq!((&*found.name, &*found.owner, found.scope), ("b", "team", Scope::Write));
        for wrong in ["", "a", &first[1..], &hash(&first), &format!("{first} ")] {
            assert!(keys.find(wrong).is_none(), "{wrong:?} is let in");
        }
    }

    #[test]
    fn an_owner_sees_its_own_and_admin_sees_all() {
        let all = file(&[("a", "x", "scopes = [\"admin\"]"), ("b", "y", "scopes = [\"read\"]")]);
        let keys = Keys::parse(&all).unwrap();
        let (admin, reader) = (keys.find("x").unwrap().caller(), keys.find("y").unwrap().caller());
        assert_eq!((admin.owner(), reader.owner()), (None, Some("b")));
        for owner in [None, Some("b"), Some("c")] {
            assert!(admin.sees(owner));
            assert_eq!(reader.sees(owner), owner == Some("b"), "{owner:?}");
        }
    }

    #[test]
    fn a_wrong_file_is_refused_without_showing_its_hashes() {
        let sha = hash("x");
        for (text, want) in [
            (String::new(), "no [[key]]"),
            (format!("[[key]]\nname = \"a\"\nsha256 = \"{sha}\"\nscopes = []"), "scopes is empty"),
            (format!("[[key]]\nname = \"a b\"\nsha256 = \"{sha}\"\nscopes = [\"read\"]"), "name"),
            (format!("[[key]]\nname = \"a\"\nsha256 = \"{sha}0\"\nscopes = [\"read\"]"), "64 hex"),
            (format!("[[key]]\nname = \"a\"\nsha256 = \"{sha}\"\nscopes = [\"root\"]"), "variant"),
            (format!("[[key]]\nname = \"a\"\nsha256 = \"{sha}\" x\nscopes = [\"read\"]"), ""),
            (file(&[("a", "x", READ), ("a", "y", READ)]), "twice"),
            (file(&[("a", "x", READ), ("b", "x", READ)]), "twice"),
            (file(&[("a", "x", &format!("{READ}\nkey = \"x\""))]), "unknown field"),
            (file(&[("a", "x", &format!("{READ}\nrequests_per_s = 0"))]), "over 0"),
        ] {
            let error = Keys::parse(&text).expect_err(&text);
            assert!(error.message().contains(want), "{}: {want}", error.message());
            assert!(!error.message().contains(&sha), "{}", error.message());
        }
    }
}
