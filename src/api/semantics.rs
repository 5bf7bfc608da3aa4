//! What can be asked by text: nothing yet, and both doors say so in the same words.

use serde::{Deserialize, Serialize};

use crate::{
    error::{Error, ErrorCode, Result},
    service::ModelsInfo,
};

/// When the semantic bank of a scene is made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(super) enum Semantics {
    /// At the first call that needs it.
    #[default]
    Lazy,
    /// With the scene.
    Eager,
    /// Never.
    Off,
}

impl Semantics {
    /// From `lazy`, `eager` or `off`.
    pub(super) fn parse(text: &str) -> Result<Self> {
        match text {
            "lazy" => Ok(Self::Lazy),
            "eager" => Ok(Self::Eager),
            "off" => Ok(Self::Off),
            other => {
                let shown: String = other.chars().take(40).collect();
                Err(Error::invalid(format!(
                    "semantics is {shown:?}; it must be lazy, eager or off"
                )))
            }
        }
    }

    /// Refuses what the loaded bundle cannot do: `eager` without semantic networks.
    pub(super) fn check(self, models: &ModelsInfo) -> Result<()> {
        match self {
            Self::Lazy | Self::Off => Ok(()),
            Self::Eager => Err(Error::new(
                ErrorCode::ModelUnavailable,
                format!(
                    "semantics=eager: bundle {:?} has no semantic networks; use lazy or off",
                    models.bundle
                ),
            )),
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

/// What can be asked of a scene by text, as scenes show it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub(super) struct SemanticsStatus {
    /// Whether kinds that need text can be asked for now.
    pub(super) available: bool,
    /// Why not.
    pub(super) reason: String,
}

impl SemanticsStatus {
    /// Of every scene made with `models`.
    pub(super) fn of(models: &ModelsInfo) -> Self {
        let reason = format!(
            "bundle {:?} has no semantic networks; colour, depth and alpha are available",
            models.bundle
        );
        Self { available: false, reason }
    }
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
