//! What both doors read of semantics in the same words.

use crate::{
    error::{Error, ErrorCode, Result},
    scene::ScoringProfile,
    service::{Boxes, Kind, MaskFormat, ModelsInfo, Quality, SemanticsMode},
};

/// When the semantics are made, from `lazy`, `eager` or `off`.
pub(super) fn mode(text: &str) -> Result<SemanticsMode> {
    match text {
        "lazy" => Ok(SemanticsMode::Lazy),
        "eager" => Ok(SemanticsMode::Eager),
        "off" => Ok(SemanticsMode::Off),
        other => wrong("semantics", other, "lazy, eager or off"),
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

/// The picture kind named `name`.
pub(super) fn kind(name: &str) -> Result<Kind> {
    let known = Kind::ALL.into_iter().find(|kind| kind.name() == name);
    known.ok_or_else(|| {
        let shown: String = name.chars().take(40).collect();
        Error::invalid(format!(
            "kind is {shown:?}; it must be color, depth, alpha, semantics, relevancy or mask"
        ))
    })
}

/// How closely to render, from `exact` (also where nothing is said) or `fast`.
pub(super) fn quality(text: Option<&str>) -> Result<Quality> {
    let Some(name) = text else { return Ok(Quality::default()) };
    Quality::named(name).map_or_else(|| wrong("quality", name, "exact or fast"), Ok)
}

/// How texts are scored, from `default` (also where nothing is said) or `paper`.
pub(super) fn profile(text: Option<&str>) -> Result<ScoringProfile> {
    match text {
        None | Some("default") => Ok(ScoringProfile::Default),
        Some("paper") => Ok(ScoringProfile::Paper),
        Some(other) => wrong("profile", other, "default or paper"),
    }
}

/// Which boxes hold the parts, from `oriented`, `aligned` or `none`.
pub(super) fn boxes(text: &str) -> Result<Boxes> {
    match text {
        "oriented" => Ok(Boxes::Oriented),
        "aligned" => Ok(Boxes::Aligned),
        "none" => Ok(Boxes::None),
        other => wrong("boxes", other, "oriented, aligned or none"),
    }
}

/// How masks are given, from `rle`, `png` or `none`.
pub(super) fn mask(text: &str) -> Result<MaskFormat> {
    match text {
        "rle" => Ok(MaskFormat::Rle),
        "png" => Ok(MaskFormat::Png),
        "none" => Ok(MaskFormat::None),
        other => wrong("mask", other, "rle, png or none"),
    }
}

fn wrong<T>(name: &str, value: &str, must: &str) -> Result<T> {
    let shown: String = value.chars().take(40).collect();
    Err(Error::invalid(format!("{name} is {shown:?}; it must be {must}")))
}
