//! Where the cameras of a scene come from, and what is known of those that were solved.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::{names::display_names, scene::Camera};

/// Whether the cameras of an upload are used.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum CamerasMode {
    /// Those that the upload has; they are solved where it has none.
    #[default]
    Auto,
    /// They are solved from the photos, whatever the upload has.
    Solve,
}

/// Where the cameras of a scene come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum CamerasSource {
    /// They came with the photos.
    #[default]
    Given,
    /// They were computed from the photos.
    Solved,
}

/// What a unit of the cameras is.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum LengthUnit {
    /// Nobody said.
    #[default]
    Unknown,
    /// A metre: the program that wrote the cameras measures in metres.
    Metre,
}

/// What refinement does with the cameras of the photos.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum CameraUse {
    /// They are learnt, where photos that are held out show that they are wrong.
    #[default]
    Mended,
    /// They stay as they are.
    Given,
}

display_names!(CamerasMode, CamerasSource, CameraUse, LengthUnit);

/// A photo whose camera was solved.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct PlacedPhoto {
    /// File name of the photo.
    pub file: String,
    /// Keypoints that agree with the points of the scene.
    pub inliers: u64,
    /// Root of the mean squared distance of these to their points, pixels of the photo.
    pub error_px: f64,
    /// Radial distortion that was taken out of the photo: k1 of OpenCV's model.
    pub k1: f64,
}

/// A photo whose camera could not be solved.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
pub struct LeftOutPhoto {
    /// File name of the photo.
    pub file: String,
    /// Why, a sentence.
    pub reason: String,
}

/// What is known of the cameras of a scene.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default)]
pub struct CamerasReport {
    /// Where they come from.
    #[schema(required = true)]
    pub source: CamerasSource,
    /// What a unit of the world is, as far as the capture says.
    #[schema(required = true)]
    pub unit: LengthUnit,
    /// How likely solved cameras are right, 0..1; none of given ones.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub confidence: Option<f64>,
    /// Solved cameras: their photos, in the order of the scene's cameras.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub placed: Vec<PlacedPhoto>,
    /// Photos that are no part of the scene, since their cameras could not be solved.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub left_out: Vec<LeftOutPhoto>,
}

/// The camera of a photo that was sent without one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SolvedCamera {
    /// The camera, of the photo without its distortion.
    pub camera: Camera,
    /// Radial distortion that the photo has: k1 of OpenCV's model.
    pub k1: f64,
}
