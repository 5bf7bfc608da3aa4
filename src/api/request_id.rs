//! Request ids: that of the caller where it is harmless, else a new one.

/// Header and metadata key, in both directions.
pub(super) const HEADER: &str = "x-request-id";

/// Longest id taken from a caller: it goes into every log line of the request.
const LEN_MAX: usize = 64;

/// The caller's id where it is 1 to 64 letters, digits, `-`, `_` or `.`; else 16 random hex digits.
pub(super) fn accept(given: Option<&str>) -> String {
    let harmless = |c: u8| c.is_ascii_alphanumeric() || b"-_.".contains(&c);
    match given {
        Some(id) if (1..=LEN_MAX).contains(&id.len()) && id.bytes().all(harmless) => id.to_owned(),
        _ => format!("{:016x}", getrandom::u64().unwrap_or_default()),
    }
}
