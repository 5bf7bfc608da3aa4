//! How the parts of a path are spelt, so that two systems' names of one file compare equal.

use base64::{Engine as _, prelude::BASE64_STANDARD};
use unicode_normalization_alignments::UnicodeNormalization as _;

/// How strictly names are compared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Spelling {
    /// As written.
    Written,
    /// Composed: macOS writes `é` as `e` and an accent.
    Unicode,
    /// The same in lower case, as Windows and macOS compare names.
    Case,
    /// The same of the decoded name.
    Decoded,
}

impl Spelling {
    /// The parts of a path as this level compares them.
    pub(crate) fn parts(self, path: &str) -> Vec<String> {
        let spelt: fn(&str) -> String = match self {
            Self::Written => str::to_owned,
            Self::Unicode => composed,
            Self::Case | Self::Decoded => |part| composed(&part.to_lowercase()),
        };
        let decoded = if self == Self::Decoded { decoded(path) } else { None };
        parts(decoded.as_deref().unwrap_or(path)).into_iter().map(spelt).collect()
    }
}

fn composed(text: &str) -> String {
    if text.is_ascii() { text.to_owned() } else { text.nfc().map(|(c, _)| c).collect() }
}

/// The parts of a path of any system: `/` and `\` between them, without drive and scheme. `..`
/// takes the part before it away, where there is one.
fn parts(path: &str) -> Vec<&str> {
    let path = path.trim();
    let path = match path.split_once("://") {
        // What follows the path of an address.
        Some((scheme, rest)) if scheme.bytes().all(|byte| byte.is_ascii_alphanumeric()) => {
            rest.split(['?', '#']).next().unwrap_or_default()
        }
        _ => path,
    };
    let path = match path.as_bytes() {
        [drive, b':', ..] if drive.is_ascii_alphabetic() => &path[2..],
        _ => path,
    };
    let mut parts: Vec<&str> = Vec::new();
    for part in path.split(['/', '\\']) {
        match part {
            "" | "." => {}
            ".." => drop(parts.pop()),
            part => parts.push(part),
        }
    }
    parts
}

/// A name without the encodings of HTTP clients: words of RFC 2047 (`=?utf-8?B?…?=`), then percent
/// signs with two digits. `None` where there are none, or where the result is no text.
#[must_use]
pub fn decoded(name: &str) -> Option<String> {
    let words = of_words(name);
    let percent = of_percent(words.as_deref().unwrap_or(name));
    percent.or(words)
}

fn of_percent(name: &str) -> Option<String> {
    if !name.contains('%') {
        return None;
    }
    let (mut out, mut rest) = (Vec::with_capacity(name.len()), name.as_bytes());
    while let [first, after @ ..] = rest {
        let digit = |at: usize| Some(char::from(*after.get(at)?).to_digit(16)? as u8);
        match (*first, digit(0), digit(1)) {
            (b'%', Some(high), Some(low)) => {
                out.push(16 * high + low);
                rest = &after[2..];
            }
            _ => {
                out.push(*first);
                rest = after;
            }
        }
    }
    String::from_utf8(out).ok().filter(|out| out != name)
}

fn of_words(name: &str) -> Option<String> {
    let (mut out, mut rest, mut any) = (String::new(), name, false);
    while let Some((before, after)) = rest.split_once("=?") {
        // Spaces between two words are no part of the text.
        if !(any && before.trim().is_empty()) {
            out.push_str(before);
        }
        let mut fields = after.splitn(3, '?');
        let (charset, way, after) = (fields.next()?, fields.next()?, fields.next()?);
        let (word, after) = after.split_once("?=")?;
        let bytes = match way {
            "B" | "b" => BASE64_STANDARD.decode(word).ok()?,
            "Q" | "q" => of_quoted(word)?,
            _ => return None,
        };
        // A language may follow the character set.
        let charset = charset.split('*').next().unwrap_or_default().to_ascii_lowercase();
        match charset.as_str() {
            "utf-8" | "us-ascii" => out.push_str(std::str::from_utf8(&bytes).ok()?),
            "iso-8859-1" => out.extend(bytes.iter().map(|byte| char::from(*byte))),
            _ => return None,
        }
        (rest, any) = (after, true);
    }
    out.push_str(rest);
    any.then_some(out)
}

/// The bytes of a word of RFC 2047 in its "Q" encoding.
fn of_quoted(word: &str) -> Option<Vec<u8>> {
    let mut bytes = Vec::with_capacity(word.len());
    let mut from = word.bytes();
    while let Some(byte) = from.next() {
        bytes.push(match byte {
            b'_' => b' ',
            b'=' => {
                let mut digit = || char::from(from.next()?).to_digit(16);
                u8::try_from(16 * digit()? + digit()?).ok()?
            }
            byte => byte,
        });
    }
    Some(bytes)
}
