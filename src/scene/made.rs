//! A finished scene: its Gaussians, and what it is made of and how it went.

use serde::{Deserialize, Serialize};

use crate::scene::{Backdrop, Gaussians, HealthReport, SceneCamera, SceneId, SceneOptions};

/// A photo of the upload and its hash.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PhotoHash {
    /// File name as uploaded.
    pub file: String,
    /// sha256 of the file, hex.
    pub sha256: String,
}

/// What a scene was made of, so that it can be made again.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Provenance {
    /// Files of the upload: photos, or the archive, and the camera description.
    pub files: Vec<PhotoHash>,
    /// sha256 of the model bundle's manifest, hex; empty where no network was used.
    pub bundle_sha256: String,
    /// Options of the call.
    pub options: SceneOptions,
    /// Version of the program.
    pub program_version: String,
}

/// Everything of a scene but its Gaussians.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct SceneMeta {
    /// Id.
    pub id: SceneId,
    /// Time of the create call, milliseconds since 1970.
    pub created_ms: u64,
    /// Input cameras, in the order of the upload.
    pub cameras: Vec<SceneCamera>,
    /// Health report.
    pub report: HealthReport,
    /// What it was made of.
    pub provenance: Provenance,
}

/// A finished scene.
#[derive(Clone, Debug)]
pub struct Scene {
    /// Cameras, report, provenance.
    pub meta: SceneMeta,
    /// The Gaussians.
    pub gaussians: Gaussians,
    /// The photos' colours by direction, behind everything.
    pub backdrop: Backdrop,
}
