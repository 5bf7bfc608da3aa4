//! Why a scene, or a part of it, was not made.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::error::{Error, ErrorCode, TABLE};

/// Why a scene failed: a code of the error table and its message.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct SceneError {
    /// Name of a row of the error table.
    pub code: String,
    /// Names input, value and bound.
    pub message: String,
}

impl From<&Error> for SceneError {
    fn from(error: &Error) -> Self {
        Self { code: error.code().name().to_owned(), message: error.message().to_owned() }
    }
}

impl SceneError {
    /// The error this was; a name of no row is `internal`.
    pub fn to_error(&self) -> Error {
        let row = TABLE.iter().find(|row| row.name == self.code);
        Error::new(row.map_or(ErrorCode::Internal, |row| row.code), self.message.clone())
    }
}
