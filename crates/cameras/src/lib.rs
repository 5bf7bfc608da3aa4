//! From matched keypoints of photos to their cameras: poses, focal lengths, a sparse cloud of points,
//! and a confidence that says whether they can be trusted.
//!
//! Pixels are those of `segsplat_core`: the centre of the top left pixel is (0.5, 0.5). Cameras are
//! OpenCV camera-to-world. Nothing here reads a photo or runs a network.

mod absolute;
mod adjust;
mod five_point;
mod grow;
mod judge;
mod lens;
mod pairs;
mod pose;
mod report;
mod rng;
mod roots;
mod rotations;
mod solver;
mod survey;
mod tracks;
mod two_view;
mod world;

use std::sync::atomic::AtomicBool;

use segsplat_core::{
    error::{Error, Result},
    scene::{Camera, unless_cancelled},
};

pub use judge::Evidence;
pub use pairs::pairs_to_match;

/// What is known of one photo.
#[derive(Clone, Debug, Default)]
pub struct PhotoKeypoints {
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// Focal length in pixels, as EXIF gives it. It may be some per cent off; `None` is searched.
    pub focal: Option<f64>,
    /// Keypoints, pixels.
    pub keypoints: Vec<[f32; 2]>,
    /// Time in the video that the photo is from, seconds.
    pub seconds: Option<f64>,
}

/// Keypoints of two photos that look alike.
#[derive(Clone, Debug, Default)]
pub struct PairMatches {
    /// Two different photos.
    pub photos: [usize; 2],
    /// Keypoints of the first and of the second photo. Each keypoint may occur once.
    pub pairs: Vec<[u32; 2]>,
    /// How sure the matcher is of each pair, 0..1; empty where it does not say.
    pub scores: Vec<f32>,
}

/// How to solve.
#[derive(Clone, Copy, Debug)]
pub struct SolveOptions {
    /// The same seed gives the same cameras, on any number of threads.
    pub seed: u64,
    /// All photos of one size were taken with one lens at one zoom.
    pub one_lens: bool,
    /// Most photos.
    pub photos_max: usize,
    /// Most keypoints of a photo.
    pub keypoints_max: usize,
}

impl Default for SolveOptions {
    fn default() -> Self {
        Self { seed: 0, one_lens: true, photos_max: 256, keypoints_max: 8192 }
    }
}

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

/// Finds the cameras of photos.
///
/// `matches` has each pair of photos at most once, in any order; pairs that were tried and did not
/// match are given with few or no pairs of keypoints: they are evidence too. `progress` gets shares
/// of the work, 0..1.
///
/// # Errors
/// `invalid_request` for numbers that are not finite or out of range, `limit_exceeded` for more
/// photos or keypoints than the options allow, `cancelled`. Photos that cannot be placed are no
/// error: all of them may be left out.
pub fn solve(
    photos: &[PhotoKeypoints],
    matches: &[PairMatches],
    options: &SolveOptions,
    cancel: &AtomicBool,
    progress: &(dyn Fn(f64) + Sync),
) -> Result<Solution> {
    check(photos, matches, options)?;
    let survey = solver::survey(photos, matches, options);
    unless_cancelled(cancel)?;
    progress(0.05);
    let candidates = solver::candidates(&survey, cancel, progress)?;
    let mut candidates = candidates.into_iter();
    let Some(mut best) = candidates.next() else {
        let left_out = |photo| Placing::LeftOut(report::why_left_out(&survey, photo, &[]));
        return Ok(Solution {
            photos: (0..photos.len()).map(left_out).collect(),
            points: Vec::new(),
            confidence: 0.0,
            evidence: Evidence::default(),
            warnings: vec!["no two photos show enough of the same things".to_owned()],
        });
    };
    let (links, dropped) = solver::drop_weak(&survey, &mut best);
    let others: Vec<grow::Grown> = candidates.map(|other| other.grown).collect();
    let evidence = judge::evidence(&survey, &best, &links, &others);
    let why_not = |photo| report::why_left_out(&survey, photo, &dropped);
    let (placings, points) = world::outcome(photos, &survey, &best, why_not)?;
    let confidence = judge::confidence(&evidence);
    let warnings = report::warnings(&survey, &best.grown, &placings, &evidence, confidence);
    progress(1.0);
    Ok(Solution { photos: placings, points, confidence, evidence, warnings })
}

/// Refuses numbers that are not finite or out of range, and more of them than the options allow.
fn check(photos: &[PhotoKeypoints], matches: &[PairMatches], options: &SolveOptions) -> Result<()> {
    if photos.len() > options.photos_max {
        return Err(Error::limit("photos", photos.len(), options.photos_max));
    }
    for (index, photo) in photos.iter().enumerate() {
        let name = |what: &str| format!("photo {index}: {what}");
        if photo.keypoints.len() > options.keypoints_max {
            let bound = options.keypoints_max;
            return Err(Error::limit(name("keypoints"), photo.keypoints.len(), bound));
        }
        if photo.size.contains(&0) {
            let [width, height] = photo.size;
            return Err(Error::invalid(name(&format!("{width}x{height} px; both must be over 0"))));
        }
        if let Some(focal) = photo.focal
            && !(focal.is_finite() && focal > 0.0)
        {
            return Err(Error::invalid(name(&format!("focal is {focal}; it must be over 0"))));
        }
        if let Some(keypoint) = photo.keypoints.iter().find(|k| !k.iter().all(|v| v.is_finite())) {
            return Err(Error::invalid(name(&format!("keypoint {keypoint:?} is not finite"))));
        }
    }
    let mut known = std::collections::BTreeSet::new();
    for pair in matches {
        let [a, b] = pair.photos;
        let name = |what: &str| format!("pair of photos {a} and {b}: {what}");
        if a == b || a >= photos.len() || b >= photos.len() {
            let count = photos.len();
            return Err(Error::invalid(name(&format!("must be two different ones of {count}"))));
        }
        if !known.insert([a.min(b), a.max(b)]) {
            return Err(Error::invalid(name("given twice")));
        }
        if !pair.scores.is_empty() && pair.scores.len() != pair.pairs.len() {
            let (scores, pairs) = (pair.scores.len(), pair.pairs.len());
            return Err(Error::invalid(name(&format!("{scores} scores of {pairs} matches"))));
        }
        for [i, j] in &pair.pairs {
            if *i as usize >= photos[a].keypoints.len() || *j as usize >= photos[b].keypoints.len()
            {
                return Err(Error::invalid(name(&format!("no keypoints {i} and {j}"))));
            }
        }
    }
    Ok(())
}
