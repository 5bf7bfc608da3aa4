//! The data types of scenes: cameras, photos, Gaussians, reports, ids, statuses.
//!
//! Constructors check their input, so code that gets a value need not check it again.

mod axes;
mod backdrop;
mod camera;
mod cameras;
mod capture;
mod edits;
mod failure;
mod finished;
mod fit;
mod floaters;
mod gaussians;
mod geometry;
mod ground;
mod growth;
mod id;
mod method;
mod photo;
mod refinement;
mod report;
mod semantics;
mod sh;
mod stage;
mod status;
mod upload;
mod weights;

pub use axes::{covariance, principal_axes};
pub use backdrop::Backdrop;
pub use camera::{Camera, CameraToWorld, Intrinsics, ORTHONORMAL_TOLERANCE, Region};
pub use cameras::{
    CameraUse, CamerasMode, CamerasReport, CamerasSource, LeftOutPhoto, LengthUnit, PlacedPhoto,
    SolvedCamera,
};
pub use capture::{Capture, ViewSet};
pub use edits::{Edit, EditAction, Edited, Editing, Place, Placement, Selected, edited};
pub use failure::SceneError;
pub use finished::{PhotoHash, Provenance, Scene, SceneMeta};
pub use fit::{biweight, least_squares};
pub use floaters::{FLOATERS_PHOTOS_MIN, floaters};
pub use gaussians::{BLUR_PX2, Gaussians, RawGaussians, SH_C0, SanitizeReport, SourcePixel};
pub use geometry::ViewGaussians;
pub use ground::{Ground, ground};
pub use growth::{GrowthState, GrowthStatus};
pub use id::{SCENE_ID_CHARS, SceneId};
pub use method::{
    Density, MaskLevel, Method, Preset, SceneOptions, ScoringMethod, SemanticsMode, with_pairs,
};
pub use photo::{Crop, CropShape, Photo, PosedPhoto, UnposedPhoto, photo_label};
pub use refinement::{MovedCamera, Refine, RefineReport, RefineState, RefineStatus};
pub use report::{DropCount, HealthReport, StageTime, Warning, WarningCode};
pub use semantics::{
    Bank, BankMask, DenseFeatures, IndexMap, JudgedMasks, MaskInfo, MaskJudging, MaskLogits,
    OverlapNms, PhotoMasks, RowViews, Semantics, SemanticsReport, TextEmbedding,
};
pub use sh::{SH_COUNT_MAX, ShRotation, sh_basis};
pub use stage::{Stage, Watch, unless_cancelled};
pub use status::{Event, SceneCamera, SceneState, SceneStatus, SemanticsState, SemanticsStatus};
pub use upload::{
    FilePart, KeptBytes, KeptFile, KeptFiles, SentBytes, SentFile, Upload, UploadCameras,
    UploadFile,
};
pub use weights::PixelWeights;
