//! From matched keypoints of photos to their cameras: poses, focal lengths, a sparse cloud of
//! points, and a confidence that says whether they can be trusted.
//!
//! Pixels are those of `segsplat_core`: the centre of the top left pixel is (0.5, 0.5). Cameras are
//! OpenCV camera-to-world. Nothing here runs a network; grey photos, where they are given, say
//! where the keypoints really are.

mod absolute;
mod adjust;
mod five_point;
mod given;
mod grow;
mod held;
mod joints;
mod judge;
mod lens;
mod mend;
mod pairs;
mod patch;
mod pose;
mod report;
mod rng;
mod roots;
mod rotations;
mod sharpen;
mod solution;
mod solve;
mod solver;
mod survey;
mod tracks;
mod two_view;
mod world;

pub use given::{PairMatches, PhotoKeypoints, SolveOptions};
pub use mend::mend;
pub use pairs::pairs_to_match;
pub use patch::Grey;
pub use solution::{CONFIDENCE_MIN, Evidence, Placed, Placing, SeenPoint, Solution};
pub use solve::solve;
