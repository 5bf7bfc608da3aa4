//! What the photos show before any network runs: depth ranges, overlap, warnings.

use crate::scene::Warning;

/// Measured from the photos and their cameras, before any network.
#[derive(Clone, Debug, PartialEq)]
pub struct Capture {
    /// Nearest and farthest depth (z of that photo's camera, world units) worth searching, per
    /// photo. `far` may be very large where the photo sees the sky; always `0 < near < far`.
    pub near_far: Vec<[f64; 2]>,
    /// `overlap[i][j]`: share of the matchable pixels of photo i that were found in photo j,
    /// 0..1; the diagonal is 1. A pair that was not worth searching holds a geometric estimate.
    pub overlap: Vec<Vec<f64>>,
    /// Median depth of the matched pixels of all photos, world units.
    pub median_depth: f64,
    /// What looks wrong, each with its figure.
    pub warnings: Vec<Warning>,
}

/// Photos that go through the geometry network together.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ViewSet {
    /// Indices of the photos, the set's first view first.
    pub views: Vec<usize>,
    /// Row v: positions in `views` of the source views of view v, best overlap first. All rows
    /// have the same length, at least 1.
    pub neighbors: Vec<Vec<usize>>,
}
