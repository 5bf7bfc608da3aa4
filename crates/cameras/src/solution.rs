//! What callers get: cameras, points, confidence.

use segsplat_core::scene::Camera;
use serde::Serialize;

/// A photo whose camera was found.
#[derive(Clone, Copy, Debug)]
pub struct Placed {
    /// The camera. The principal point is the photo's middle.
    pub camera: Camera,
    /// Radial distortion k1 of OpenCV's model: a direction (x, y, 1) is seen at
    /// `f (1 + k1 (x² + y²)) (x, y) + c`. 0 where it was not to be found.
    pub k1: f64,
    /// Keypoints that agree with the points of the scene.
    pub inliers: usize,
    /// Root of the mean squared distance of these keypoints to their points, pixels.
    pub error_px: f64,
}

/// What became of a photo.
#[derive(Clone, Debug)]
pub enum Placing {
    /// Its camera was found.
    Placed(Placed),
    /// It was left out, and why: words for a person.
    LeftOut(String),
}

/// A point of the scene that several photos see.
#[derive(Clone, Debug)]
pub struct SeenPoint {
    /// Place in the world.
    pub position: [f64; 3],
    /// Photo and keypoint of each that sees it.
    pub track: Vec<(u32, u32)>,
    /// Root of the mean squared distance to its keypoints, pixels.
    pub error_px: f64,
}

/// Cameras of photos. The mean of the cameras' up is -y of the world as in OpenCV's frames, the
/// median of the points is the origin, and half of the points lie within 0.5 of it.
#[derive(Clone, Debug)]
pub struct Solution {
    /// One for each photo, in their order.
    pub photos: Vec<Placing>,
    /// Points that at least two photos see.
    pub points: Vec<SeenPoint>,
    /// Estimate of the share of such solutions that are right (within 5 degrees), 0..1. Under
    /// [`CONFIDENCE_MIN`] the cameras must not be used without asking.
    pub confidence: f64,
    /// What the confidence is made of.
    pub evidence: Evidence,
    /// What a person should know, words: doubts, photos that could not be placed surely, a focal
    /// length that the photos do not determine.
    pub warnings: Vec<String>,
}

/// Solutions under this confidence are to be refused or warned of.
pub const CONFIDENCE_MIN: f64 = 0.5;

/// What speaks for a solution and against it.
#[derive(Clone, Copy, Debug, Default, Serialize)]
pub struct Evidence {
    /// Pairs of placed photos whose matches fit one geometry of two views.
    pub links: usize,
    /// Share of these pairs, by their matches, that are turned as the cameras are, within 5
    /// degrees.
    pub agreeing: f64,
    /// Share of the matches of these pairs that the cameras explain.
    pub explained: f64,
    /// Matches that the best other solution explains, as a share of those of this one.
    pub rival: f64,
    /// The same of the mirrored solution: the scene inside out.
    pub mirrored: f64,
    /// Points that three photos or more see, in the photo that sees fewest of them.
    pub held: usize,
    /// The same in the median photo.
    pub held_median: usize,
    /// Median of the widest angle at which a point is seen, degrees.
    pub angle_deg: f64,
    /// Median distance of keypoints from their points, in units of the distance at which they
    /// agree.
    pub error: f64,
    /// Share of the loops of three such pairs whose turns close, within 5 degrees. 1 where there is
    /// no loop.
    pub loops: f64,
    /// Share of the pairs of near cameras that see the same points by the solution, but did not
    /// match.
    pub missing: f64,
    /// The placed photos are joined by pairs of which the cameras explain this share of the matches
    /// and more.
    pub weakest: f64,
    /// Photos placed.
    pub placed: usize,
    /// Whether the focal lengths of all of them are from EXIF.
    pub focal_known: bool,
}
