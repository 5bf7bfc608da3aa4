//! What callers give: keypoints, matches, options; and the checks of their numbers.

use std::collections::BTreeSet;

use segsplat_core::{
    error::{Error, Result},
    scene::Camera,
};

/// What is known of one photo.
#[derive(Clone, Debug, Default)]
pub struct PhotoKeypoints {
    /// Width and height, pixels.
    pub size: [u32; 2],
    /// Focal length in pixels, as EXIF gives it. It may be some per cent off; `None` is searched.
    pub focal: Option<f64>,
    /// Keypoints, pixels.
    pub keypoints: Vec<[f32; 2]>,
    /// What a network says of its camera: nearly right or quite wrong, in a world of the network's
    /// own that all photos share.
    pub guess: Option<Camera>,
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

/// Refuses numbers that are not finite or out of range, and more of them than the options allow.
pub(crate) fn check(
    photos: &[PhotoKeypoints],
    matches: &[PairMatches],
    options: &SolveOptions,
) -> Result<()> {
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
        if let Some(guess) = photo.guess {
            guess.intrinsics.validated(&name("guess"))?;
        }
        if let Some(keypoint) = photo.keypoints.iter().find(|k| !k.iter().all(|v| v.is_finite())) {
            return Err(Error::invalid(name(&format!("keypoint {keypoint:?} is not finite"))));
        }
    }
    let mut known = BTreeSet::new();
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
