//! Request ids: the caller's own where it is harmless, else a fresh one.

use std::{
    hash::{BuildHasher, RandomState},
    sync::{
        OnceLock,
        atomic::{AtomicU64, Ordering},
    },
};

/// Header and metadata key, in both directions.
pub(super) const HEADER: &str = "x-request-id";

/// Longest id taken from a caller: it goes into every log line of the request.
const LEN_MAX: usize = 64;

/// The caller's id where it is 1 to 64 letters, digits, `-`, `_` or `.`; else a fresh one.
pub(super) fn accept(given: Option<&str>) -> String {
    let harmless = |c: u8| c.is_ascii_alphanumeric() || b"-_.".contains(&c);
    match given {
        Some(id) if (1..=LEN_MAX).contains(&id.len()) && id.bytes().all(harmless) => id.to_owned(),
        _ => fresh(),
    }
}

/// 16 hex digits: a counter hashed with this process's random keys.
fn fresh() -> String {
    static KEYS: OnceLock<RandomState> = OnceLock::new();
    static COUNT: AtomicU64 = AtomicU64::new(0);
    let count = COUNT.fetch_add(1, Ordering::Relaxed);
    format!("{:016x}", KEYS.get_or_init(RandomState::new).hash_one(count))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_harmless_id_is_kept_and_others_are_replaced() {
        assert_eq!(accept(Some("job-7.a_B")), "job-7.a_B");
        let long = "a".repeat(65);
        for odd in [None, Some(""), Some("a b"), Some("a\"b"), Some("ä"), Some(long.as_str())] {
            let id = accept(odd);
            assert_eq!(id.len(), 16, "{odd:?} gave {id}");
        }
        assert_ne!(accept(None), accept(None), "fresh ids repeat");
    }
}
