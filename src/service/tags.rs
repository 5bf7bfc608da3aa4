//! Texts that tell scenes, requests and answers from each other: keys of caches and entity tags.

use serde::Serialize;
use sha2::{Digest, Sha256};

use super::request::ScoringOptions;
use crate::{
    error::{Error, Result},
    names::hex,
    scene::{Preset, Scene, SceneId},
    store::Record,
};

/// Values as text: equal text means equal values. Numbers are written to their last bit.
pub(super) fn cache_key(values: &impl Serialize) -> Result<String> {
    serde_json::to_string(values)
        .map_err(|e| Error::internal("a request cannot be written down").caused_by(e))
}

/// The entity tag of what a key tells apart: 32 hexadecimal digits of its sha256.
pub(super) fn etag(key: &str) -> String {
    hex(&Sha256::digest(key)[..16])
}

/// The key of a text of a scene and how it is scored; `tag` tells scene and semantics.
pub(super) fn text_key(
    tag: &str,
    text: Option<&str>,
    preset: Preset,
    changes: &ScoringOptions,
) -> Result<String> {
    cache_key(&(tag, text, (preset, changes)))
}

/// Tells a version of a scene from all others.
pub(super) fn scene_tag(scene: &Scene) -> String {
    tag(&scene.sha256, &scene.meta.id, &scene.edits_sha256, &scene.semantics_sha256)
}

/// Tells a version of a scene and the edits of a list, by the hash of the list, from all others.
pub(super) fn edits_tag(base: &Scene, edits_sha256: &str) -> String {
    tag(&base.sha256, &base.meta.id, edits_sha256, &base.semantics_sha256)
}

/// The tag of the version that a record names, after the edits of a list of this hash. Others may
/// be served a moment later.
pub(super) fn record_tag(record: &Record, edits_sha256: &str) -> String {
    let [scene, semantics] =
        [&record.scene_sha256, &record.semantics_sha256].map(|of| of.as_deref().unwrap_or(""));
    tag(scene, &record.status.id, edits_sha256, semantics)
}

/// Tells a version of a scene and its semantics from all others.
pub(super) fn semantics_tag(scene: &Scene) -> String {
    format!("{} {}", scene_tag(scene), scene.semantics_sha256)
}

/// The same of the version that a record names.
pub(super) fn record_semantics_tag(record: &Record, edits_sha256: &str) -> String {
    let semantics = record.semantics_sha256.as_deref().unwrap_or_default();
    format!("{} {semantics}", record_tag(record, edits_sha256))
}

/// Without edits a view does not depend on the semantics; edits may take what they select.
fn tag(sha256: &str, id: &SceneId, edits: &str, semantics: &str) -> String {
    match edits {
        "" => format!("{sha256} {id}"),
        edits => format!("{sha256} {id} {edits} {semantics}"),
    }
}
