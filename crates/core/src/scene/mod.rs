//! The nouns: cameras, photos, Gaussians, reports. No IO, no threads; constructors validate and
//! the types are trusted below.

mod axes;
mod backdrop;
mod camera;
mod capture;
mod copies;
mod gaussians;
mod geometry;
mod id;
mod layers;
mod made;
mod magnify;
mod photo;
mod report;
mod semantics;
mod status;
mod upload;

pub use axes::principal_axes;
pub use backdrop::Backdrop;
pub use camera::{Camera, CameraToWorld, Intrinsics, ORTHONORMAL_TOLERANCE, Region};
pub use capture::{Capture, ViewSet};
pub use gaussians::{Gaussians, RawGaussians, SH_C0, SanitizeReport, SourcePixel};
pub use geometry::ViewGaussians;
pub use id::{SCENE_ID_CHARS, SceneId};
pub use made::{PhotoHash, Provenance, Scene, SceneMeta};
pub use magnify::LEARNT_BLUR_PX2;
pub use photo::{Crop, Photo, PosedPhoto};
pub use report::{DropCount, HealthReport, StageTime, Warning, WarningCode};
pub use semantics::{
    Bank, IndexMap, MaskInfo, PhotoMasks, ScoringProfile, Semantics, SemanticsReport,
};
pub use status::{
    Density, Event, SceneCamera, SceneError, SceneOptions, SceneState, SceneStatus, SemanticsMode,
    SemanticsState, SemanticsStatus,
};
pub use upload::{Upload, UploadCameras, UploadFile};

/// Bounds what all scenes of the process keep for views to come, bytes: layers, and Gaussians
/// magnified for a view.
pub fn keep_copies(layers_bytes_max: u64, magnified_bytes_max: u64) {
    layers::LAYERS.set_bytes_max(layers_bytes_max);
    magnify::MAGNIFIED.set_bytes_max(magnified_bytes_max);
}
