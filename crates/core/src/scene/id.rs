//! Scene ids. The alphabet is checked here, before an id becomes part of a path.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Serialize};

use crate::error::{Error, ErrorCode};

/// Length of an id: 128 bits as lower-case hex.
pub const SCENE_ID_CHARS: usize = 32;

/// Id of a scene: 32 lower-case hex digits.
#[derive(Clone, Debug, PartialEq, Eq, Hash, PartialOrd, Ord, Serialize, Deserialize)]
#[serde(try_from = "String")]
pub struct SceneId(String);

impl SceneId {
    /// From 16 bytes (random, or a content hash).
    pub fn from_bytes(bytes: [u8; 16]) -> Self {
        Self(bytes.iter().map(|b| format!("{b:02x}")).collect())
    }

    /// The hex digits.
    pub fn as_str(&self) -> &str {
        &self.0
    }
}

impl FromStr for SceneId {
    type Err = Error;

    fn from_str(text: &str) -> Result<Self, Error> {
        let hex = |b: u8| b.is_ascii_digit() || (b'a'..=b'f').contains(&b);
        if text.len() == SCENE_ID_CHARS && text.bytes().all(hex) {
            Ok(Self(text.to_owned()))
        } else {
            let shown: String = text.chars().take(40).collect();
            Err(Error::new(
                ErrorCode::SceneNotFound,
                format!("no scene has the id {shown:?}: an id is {SCENE_ID_CHARS} hex digits"),
            ))
        }
    }
}

impl TryFrom<String> for SceneId {
    type Error = Error;

    fn try_from(text: String) -> Result<Self, Error> {
        text.parse()
    }
}

impl fmt::Display for SceneId {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(&self.0)
    }
}
