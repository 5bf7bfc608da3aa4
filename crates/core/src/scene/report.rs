//! The report of a scene: counts, warnings with their figures, stage times.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::scene::{CamerasReport, Method, RefineReport};

/// What looks wrong with a capture; the scene was made all the same.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[non_exhaustive]
pub enum WarningCode {
    /// OpenGL axes given as OpenCV, or the reverse.
    AxesSwapped,
    /// World-to-camera given for camera-to-world.
    PoseInverted,
    /// Intrinsics made for another resolution.
    IntrinsicsScale,
    /// Principal point far from the picture's centre.
    PrincipalPointOff,
    /// Photos share little.
    LowOverlap,
    /// Cameras stand too close together for the depth of the scene.
    SmallBaseline,
    /// Depths hit the end of the searched range.
    DepthRangeHit,
    /// The photos do not agree under the given poses, and no known mistake explains it.
    PoorPoseAgreement,
    /// Photos of the upload that were not used: without a camera, kept for tests, more than a scene
    /// takes, or with nothing in common with the others.
    PhotosUnused,
    /// Photos that the networks do not see: the steps of a refinement learn them.
    PhotosForSteps,
    /// Photos that the cameras name and that were not sent.
    PhotosMissing,
    /// Several photos are one picture, under different poses.
    SamePicture,
    /// The capture holds cameras of several kinds or places; the message says which were taken.
    CamerasChosen,
    /// Photos that were turned as their EXIF orientation says, that could be and were not, or that
    /// fit their cameras only when they are turned.
    PhotosTurned,
    /// Photos with a mask: what it leaves out takes no part in the scene.
    MasksUsed,
    /// What words name is left out of the photos, or found in none.
    WordsIgnored,
    /// Photos too large to be decoded whole, which were read at a smaller scale.
    PhotosReduced,
    /// Keys of a camera file that change what its numbers mean and are not read.
    KeysUnread,
    /// Rotations with a scale, which was taken out.
    PosesScaled,
    /// A lens that leaves most of a photo without a source, or that seems to be undone already.
    LensDoubtful,
    /// Cameras that were solved and may be wrong in part.
    CamerasDoubtful,
}

crate::names::display_names!(WarningCode);

/// One warning: what, a sentence, and the figure behind it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct Warning {
    /// What looks wrong.
    pub code: WarningCode,
    /// A sentence that names photo, value and bound.
    pub message: String,
    /// The measured figure.
    pub value: f64,
}

/// How many Gaussians were dropped or clamped for one reason.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct DropCount {
    /// Why, `snake_case`: `opacity_below_1_255`, `not_finite`, `duplicate`, `out_of_reach`, …
    pub reason: String,
    /// How many.
    pub count: u64,
}

/// Time of one stage.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct StageTime {
    /// Stage name, as in progress events.
    pub stage: String,
    /// Wall time, milliseconds.
    pub ms: f64,
}

/// The health report of a scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct HealthReport {
    /// Photos given.
    pub photos: u32,
    /// Format of the file of Gaussians that the scene is; none where it was made of photos.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub file_format: Option<String>,
    /// Whether that file was made for a renderer that compensates opacity for the blur of small
    /// Gaussians: views are drawn so unless they say otherwise.
    #[serde(default)]
    #[schema(required = true)]
    pub antialiased: bool,
    /// How it was made.
    #[serde(default)]
    #[schema(required = true)]
    pub method: Method,
    /// Where the cameras come from.
    #[serde(default)]
    #[schema(required = true)]
    pub cameras: CamerasReport,
    /// Photos used.
    pub views_used: u32,
    /// Gaussians kept.
    pub gaussians: u64,
    /// Gaussians dropped or clamped, by reason.
    pub dropped: Vec<DropCount>,
    /// Nearest and farthest depth searched, world units: smallest near and largest far of all.
    pub depth_range: [f64; 2],
    /// Median depth of the Gaussians from the input cameras, world units: the scene's extent.
    pub median_depth: f64,
    /// Mean share of a view's matchable pixels found in its best partner, 0..1.
    pub overlap: f64,
    /// Focal length of each photo in the network's picture of it, pixels; 0 where it was not used.
    #[serde(default)]
    #[schema(required = true)]
    pub network_focal_px: Vec<f64>,
    /// What refinement made of it, once it was refined.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub refinement: Option<RefineReport>,
    /// Time of each stage.
    pub stages: Vec<StageTime>,
    /// Execution provider of the geometry network.
    pub execution_provider: String,
    /// What looks wrong with the capture.
    pub warnings: Vec<Warning>,
}
