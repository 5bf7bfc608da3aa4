//! What both doors read of semantics in the same words.

use crate::{
    error::{Error, ErrorCode, Result},
    service::{ModelsInfo, SemanticsMode},
};

/// When the semantics are made, from `lazy`, `eager` or `off`.
pub(super) fn mode(text: &str) -> Result<SemanticsMode> {
    match text {
        "lazy" => Ok(SemanticsMode::Lazy),
        "eager" => Ok(SemanticsMode::Eager),
        "off" => Ok(SemanticsMode::Off),
        other => {
            let shown: String = other.chars().take(40).collect();
            Err(Error::invalid(format!("semantics is {shown:?}; it must be lazy, eager or off")))
        }
    }
}

/// Refuses a bundle that is not the loaded one.
pub(super) fn check_bundle(asked: &str, models: &ModelsInfo) -> Result<()> {
    if asked.is_empty() || asked == models.bundle {
        return Ok(());
    }
    let shown: String = asked.chars().take(40).collect();
    Err(Error::new(
        ErrorCode::ModelUnavailable,
        format!("bundle is {shown:?}; this server has {:?} loaded", models.bundle),
    ))
}

/// The error of a picture kind that needs the semantic bank.
pub(super) fn kind_unavailable(kind: &str, models: &ModelsInfo) -> Error {
    Error::new(
        ErrorCode::ModelUnavailable,
        format!(
            "kind={kind}: bundle {:?} has no semantic networks; ask for color, depth or alpha",
            models.bundle
        ),
    )
}
