//! The cameras of photos that came without: keypoints ▸ matches ▸ `segsplat_cameras` ▸ judge.
//!
//! The solver sees keypoints, and what a network says of the cameras where the bundle has one: a
//! guess, which it begins with and which keypoints judge. The judge of all is the plane sweep of
//! `capture`, which compares the photos' pixels under the cameras: what it calls wrong of given
//! cameras refuses solved ones.

use std::{
    collections::HashSet,
    sync::{
        Arc,
        atomic::{AtomicUsize, Ordering},
    },
    time::Instant,
};

use rayon::prelude::*;
use segsplat_cameras::{
    CONFIDENCE_MIN, Evidence, Grey, PairMatches, PhotoKeypoints, Placed, Placing, Solution,
    SolveOptions, mend, pairs_to_match, solve,
};

use super::{
    Pipeline, Seen, fraction,
    networks::opened,
    see,
    sets::{PhotoSet, UnposedSet, read_time},
};
use crate::{
    capture,
    error::{Error, ErrorCode, Result, short},
    formats::captures::FIND_CAMERAS,
    matching::{Descriptors, KeypointPair},
    meter,
    models::{CameraNetwork, FeatureNetwork, MatcherNetwork, PhotoFeatures, SureMatch},
    photos,
    scene::{
        Camera, CameraToWorld, CamerasReport, CamerasSource, LeftOutPhoto, Photo, PlacedPhoto,
        PosedPhoto, SceneOptions, SolvedCamera, Stage, StageTime, UnposedPhoto, Warning,
        WarningCode, Watch, unless_cancelled,
    },
};

/// Where keypoints and matches end in the stage.
const KEYPOINTS_END: f32 = 0.15;
const MATCHES_END: f32 = 0.7;
const SOLVED_END: f32 = 0.95;
/// Fewest photos that make a scene.
const PLACED_MIN: usize = 2;
/// Photos that one message names.
const NAMED_MAX: usize = 4;
/// How far a match of most similar descriptors is trusted beside those of the network, which are
/// tried first.
const NEAREST_TRUST: f32 = 0.5;
/// Where more pairs are matched, the network looks at fewer keypoints of each photo: time grows
/// with their square, and of many photos each link matters less (docs/adr/0085).
const PAIRS_IN_FULL: usize = 36;
const KEYPOINTS_OF_MANY: usize = 1024;
/// What can be done about photos whose cameras are not found.
const REMEDY: &str = "Take more photos, each of which shows most of what the one before shows, of \
    things with texture; or send cameras with them";

/// What the solver and the judge found: for whoever measures them.
#[derive(Clone, Debug)]
pub struct JudgedCameras {
    /// How likely the cameras are right, 0..1.
    pub confidence: f64,
    /// What the confidence is made of.
    pub evidence: Evidence,
    /// Each photo's camera, or why it has none, in their order.
    pub placings: Vec<Placing>,
    /// Why the cameras are refused; `None`: they are not.
    pub refused: Option<String>,
}

impl JudgedCameras {
    /// The camera of each photo, where it has one, in their order.
    pub fn cameras(&self) -> impl Iterator<Item = Option<Camera>> {
        self.placings.iter().map(|placing| match placing {
            Placing::Placed(placed) => Some(placed.camera),
            Placing::LeftOut(_) => None,
        })
    }
}

impl Pipeline {
    /// The feature network, opened at the first call.
    ///
    /// # Errors
    /// `model_unavailable` when the bundle has none or it does not open.
    pub fn features(&self) -> Result<Arc<FeatureNetwork>> {
        let open = || FeatureNetwork::open(&self.runtime, &self.bundle, &self.lazy.options);
        opened(&self.lazy.features, "feature network, which finds the cameras of photos", open)
    }

    /// The network that matches keypoints, opened at the first call; `None` where the bundle has
    /// none.
    ///
    /// # Errors
    /// `model_unavailable` when it does not open.
    pub fn matcher(&self) -> Result<Option<Arc<MatcherNetwork>>> {
        if self.bundle.matcher().is_none() {
            return Ok(None);
        }
        let open = || MatcherNetwork::open(&self.runtime, &self.bundle, &self.lazy.options);
        opened(&self.lazy.matcher, "network that matches keypoints", open).map(Some)
    }

    /// The network that says where photos were taken, opened at the first call.
    ///
    /// # Errors
    /// `model_unavailable` when the bundle has none or it does not open.
    pub fn cameras(&self) -> Result<Arc<CameraNetwork>> {
        let open = || CameraNetwork::open(&self.runtime, &self.bundle, &self.lazy.options);
        opened(&self.lazy.cameras, "network that says where photos were taken", open)
    }
}

/// Finds the cameras of photos: the stage [`Stage::Cameras`]. Photos without one are left out.
///
/// # Errors
/// `cameras_unsolved` when they cannot be found or the photos do not confirm them;
/// `model_unavailable`, `cancelled`, `internal`.
pub fn posed(pipeline: &Pipeline, set: UnposedSet, watch: Watch<'_>) -> Result<PhotoSet> {
    let begun = Instant::now();
    unless_cancelled(watch.cancel)?;
    let _span = tracing::info_span!("stage", stage = Stage::Cameras.name()).entered();
    let UnposedSet { photos, mut warnings, read_ms } = set;
    let guesses = guessed(pipeline, &photos)?;
    let solution = solved(pipeline, &photos, &guesses, watch)?;
    let confirmed = confirmed(pipeline, photos, &solution, watch)?;
    let Confirmed { photos, cameras, doubts } = confirmed;
    warnings.extend(left_out(&cameras.left_out));
    warnings.extend(doubts);
    let ms = begun.elapsed().as_secs_f64() * 1e3;
    meter::stage(Stage::Cameras.name(), ms / 1e3);
    (watch.progress)(Stage::Cameras, 1.0);
    let own = StageTime { stage: Stage::Cameras.name().to_owned(), ms };
    let stages = vec![read_time(read_ms), own];
    Ok(PhotoSet { photos, warnings, stages, cameras, is_without_words: false })
}

/// What a network says of the cameras of photos, in a world of its own; nothing where the bundle
/// has none.
///
/// # Errors
/// `internal`; `model_unavailable` where the network does not open.
pub fn guessed(pipeline: &Pipeline, photos: &[UnposedPhoto]) -> Result<Vec<Option<Camera>>> {
    if pipeline.bundle.cameras().is_none() {
        return Ok(vec![None; photos.len()]);
    }
    let network = pipeline.cameras()?;
    let photos: Vec<&Photo> = photos.iter().map(|unposed| &unposed.photo).collect();
    pipeline.on_workers(|| network.find(&photos))
}

/// What [`posed`] finds from these guesses, and whether it would refuse it.
///
/// # Errors
/// As [`posed`], but for `cameras_unsolved`.
pub fn judged(
    pipeline: &Pipeline,
    photos: &[UnposedPhoto],
    guesses: &[Option<Camera>],
    watch: Watch<'_>,
) -> Result<JudgedCameras> {
    let solution = solved(pipeline, photos, guesses, watch)?;
    let refused = match confirmed(pipeline, photos.to_vec(), &solution, watch) {
        Ok(_) => None,
        Err(e) if e.code() == ErrorCode::CamerasUnsolved => Some(e.message().to_owned()),
        Err(error) => return Err(error),
    };
    let Solution { confidence, evidence, photos: placings, .. } = solution;
    Ok(JudgedCameras { confidence, evidence, placings, refused })
}

/// Where the cameras of photos stand by their keypoints; `None` where these are too few, or the
/// bundle has no network that finds them.
///
/// # Errors
/// `cancelled`, `internal`; `model_unavailable` where the network does not open.
pub fn mended(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    watch: Watch<'_>,
) -> Result<Option<Vec<CameraToWorld>>> {
    if pipeline.bundle.features().is_none() {
        return Ok(None);
    }
    let pixels: Vec<(&Photo, Option<f64>)> =
        photos.iter().map(|posed| (&posed.photo, None)).collect();
    let (keypoints, matches) = matched(pipeline, &pixels, watch)?;
    let cameras: Vec<Camera> = photos.iter().map(|posed| posed.camera).collect();
    pipeline.on_workers(|| mend(&cameras, &keypoints, &matches))
}

/// The photos where their keypoints say that their cameras stand ([`mended`]), and what the
/// network says of them there; `None` where keypoints do not tell.
///
/// # Errors
/// As [`super::reconstruct`].
pub fn recast(
    pipeline: &Pipeline,
    photos: &[PosedPhoto],
    options: &SceneOptions,
    watch: Watch<'_>,
) -> Result<Option<(Vec<PosedPhoto>, Seen)>> {
    let Some(poses) = mended(pipeline, photos, watch)? else { return Ok(None) };
    let mut photos = photos.to_vec();
    for (posed, pose) in photos.iter_mut().zip(poses) {
        posed.camera.camera_to_world = pose;
    }
    let seen = see(pipeline, &photos, options, watch)?;
    Ok(Some((photos, seen)))
}

/// The solver's answer.
fn solved(
    pipeline: &Pipeline,
    photos: &[UnposedPhoto],
    guesses: &[Option<Camera>],
    watch: Watch<'_>,
) -> Result<Solution> {
    let Watch { progress, cancel } = watch;
    let tell = |fraction: f32| progress(Stage::Cameras, fraction);
    let pixels: Vec<(&Photo, Option<f64>)> =
        photos.iter().map(|unposed| (&unposed.photo, unposed.focal)).collect();
    let (mut keypoints, matches) = matched(pipeline, &pixels, watch)?;
    keypoints.iter_mut().zip(guesses).for_each(|(photo, guess)| photo.guess = *guess);
    let options = SolveOptions {
        photos_max: photos.len(),
        keypoints_max: pipeline.features()?.manifest().count,
        ..SolveOptions::default()
    };
    let grey =
        |(photo, _): &(&Photo, Option<f64>)| Grey::new(photo.width, photo.height, &photo.rgb);
    let greys: Vec<Grey> = pipeline.on_workers(|| pixels.par_iter().map(grey).collect());
    let share = |done: f64| tell(MATCHES_END + (SOLVED_END - MATCHES_END) * done as f32);
    pipeline.on_workers(|| solve(&keypoints, &matches, &greys, &options, cancel, &share))
}

/// Keypoints of photos, each with its focal length where that is known, and their matches.
fn matched(
    pipeline: &Pipeline,
    photos: &[(&Photo, Option<f64>)],
    watch: Watch<'_>,
) -> Result<(Vec<PhotoKeypoints>, Vec<PairMatches>)> {
    let Watch { progress, cancel } = watch;
    let tell = |fraction: f32| progress(Stage::Cameras, fraction);
    let (network, matcher) = (pipeline.features()?, pipeline.matcher()?);
    let (mut seen, mut descriptors) = (Vec::new(), Vec::new());
    for (done, (photo, _)) in photos.iter().enumerate() {
        unless_cancelled(cancel)?;
        tell(KEYPOINTS_END * fraction(done, photos.len()));
        let found = pipeline.on_workers(|| network.find(photo))?;
        descriptors.push(Descriptors::new(&found.descriptors, found.dim));
        seen.push(found);
    }
    tell(KEYPOINTS_END);
    let alike = |i: usize, j: usize| descriptors[i].alike(&descriptors[j]);
    let pairs = pairs_to_match(photos.len(), alike);
    let least = network.manifest().similarity_min;
    let size = |i: usize| [photos[i].0.width, photos[i].0.height];
    let count = if pairs.len() > PAIRS_IN_FULL { KEYPOINTS_OF_MANY } else { usize::MAX };
    let done = AtomicUsize::new(0);
    let matched = |&[i, j]: &[usize; 2]| {
        unless_cancelled(cancel)?;
        let nearest = descriptors[i].matched(&descriptors[j], least);
        let sure = match &matcher {
            Some(matcher) => matcher.matched([&seen[i], &seen[j]], [i, j].map(size), count)?,
            None => Vec::new(),
        };
        let share = fraction(done.fetch_add(1, Ordering::Relaxed), pairs.len());
        tell(KEYPOINTS_END + (MATCHES_END - KEYPOINTS_END) * share);
        Ok::<_, Error>(joined([i, j], &sure, &nearest))
    };
    let matches = pipeline
        .on_workers(|| pairs.par_iter().map(matched).collect::<Result<Vec<PairMatches>>>())?;
    tell(MATCHES_END);
    let of_photo = |(found, (photo, focal)): (PhotoFeatures, &(&Photo, Option<f64>))| {
        let (size, keypoints) = ([photo.width, photo.height], found.keypoints);
        PhotoKeypoints { size, focal: *focal, keypoints, ..PhotoKeypoints::default() }
    };
    Ok((seen.into_iter().zip(photos).map(of_photo).collect(), matches))
}

/// Matches of a pair of photos: those of the network, then those of the most similar descriptors
/// whose keypoints it did not match. The share of all that agree with one geometry tells right
/// pairs of photos from wrong ones, which the network's alone does not.
fn joined(photos: [usize; 2], sure: &[SureMatch], nearest: &[KeypointPair]) -> PairMatches {
    let taken = [0, 1].map(|side| -> HashSet<u32> { sure.iter().map(|of| of.0[side]).collect() });
    let is_new = |of: &&KeypointPair| [0, 1].iter().all(|&s| !taken[s].contains(&of.keypoints[s]));
    let trust = if sure.is_empty() { 1.0 } else { NEAREST_TRUST };
    let others = nearest.iter().filter(is_new);
    let others = others.map(|of| (of.keypoints, trust * of.similarity.clamp(0.0, 1.0)));
    let (pairs, scores) = sure.iter().copied().chain(others).unzip();
    PairMatches { photos, pairs, scores }
}

/// Photos whose cameras stand the judgement.
struct Confirmed {
    photos: Vec<PosedPhoto>,
    cameras: CamerasReport,
    doubts: Vec<Warning>,
}

/// The photos with their cameras, which the solver trusts and the photos' pixels confirm.
fn confirmed(
    pipeline: &Pipeline,
    photos: Vec<UnposedPhoto>,
    solution: &Solution,
    watch: Watch<'_>,
) -> Result<Confirmed> {
    let count = photos.len();
    let (mut posed, mut placed, mut left_out) = (Vec::new(), Vec::new(), Vec::new());
    for (unposed, placing) in photos.into_iter().zip(&solution.photos) {
        let file = unposed.file.clone();
        match placing {
            Placing::Placed(Placed { camera, k1, inliers, error_px }) => {
                posed.push(photos::posed(unposed, &SolvedCamera { camera: *camera, k1: *k1 }));
                let (inliers, error_px, k1) = (*inliers as u64, *error_px, *k1);
                placed.push(PlacedPhoto { file, inliers, error_px, k1 });
            }
            Placing::LeftOut(reason) => {
                left_out.push(LeftOutPhoto { file, reason: reason.clone() });
            }
        }
    }
    let refused = |why: &str| {
        let named = named(&left_out);
        let message = format!("cameras: {why}{named}. {REMEDY}. Of {FIND_CAMERAS}");
        Error::new(ErrorCode::CamerasUnsolved, message)
    };
    if posed.len() < PLACED_MIN {
        return Err(refused(&format!("the cameras of {count} photos cannot be found")));
    }
    // Photos that were left out are named once.
    let is_new = |message: &&String| !left_out.iter().any(|of| message.contains(&of.reason));
    let confidence = solution.confidence;
    if confidence < CONFIDENCE_MIN {
        let doubts: Vec<&str> = solution.warnings.iter().filter(is_new).map(|m| &**m).collect();
        let doubts = doubts.join("; ");
        let doubts = if doubts.is_empty() { doubts } else { format!(" ({doubts})") };
        return Err(refused(&format!(
            "the cameras of {} of {count} photos were found, with a confidence of {confidence:.2}, \
             under {CONFIDENCE_MIN}: they may well be wrong{doubts}",
            posed.len()
        )));
    }
    let judge = || capture::analyse(&posed, watch.cancel);
    let wrong = match pipeline.on_workers(judge) {
        Ok(seen) => seen.warnings.into_iter().find(|warning| speaks_against(warning.code)),
        Err(e) if e.code() == ErrorCode::InvalidRequest => {
            return Err(refused(&format!("the photos do not confirm them: {}", e.message())));
        }
        Err(error) => return Err(error),
    };
    if let Some(Warning { message, .. }) = wrong {
        return Err(refused(&format!("the photos do not confirm them: {message}")));
    }
    let doubt = |message: &String| Warning {
        code: WarningCode::CamerasDoubtful,
        message: format!("cameras: {message}"),
        value: confidence,
    };
    let doubts = solution.warnings.iter().filter(is_new).map(doubt).collect();
    let confidence = Some(confidence);
    let cameras = CamerasReport {
        source: CamerasSource::Solved,
        confidence,
        placed,
        left_out,
        ..CamerasReport::default()
    };
    Ok(Confirmed { photos: posed, cameras, doubts })
}

/// Whether a warning of given cameras says that solved ones are wrong.
fn speaks_against(code: WarningCode) -> bool {
    matches!(
        code,
        WarningCode::AxesSwapped
            | WarningCode::PoseInverted
            | WarningCode::IntrinsicsScale
            | WarningCode::PoorPoseAgreement
    )
}

/// Names photos that were left out, with their reasons, for a message.
fn named(left_out: &[LeftOutPhoto]) -> String {
    let one = |of: &LeftOutPhoto| format!("{:?}: {}", short(&of.file), of.reason);
    let some: Vec<String> = left_out.iter().take(NAMED_MAX).map(one).collect();
    let more = left_out.len().saturating_sub(NAMED_MAX);
    let more = if more > 0 { format!("; and {more} more") } else { String::new() };
    if some.is_empty() { String::new() } else { format!("; left out: {}{more}", some.join("; ")) }
}

/// Warns of photos that were left out.
fn left_out(left_out: &[LeftOutPhoto]) -> Option<Warning> {
    let count = left_out.len();
    let message = format!("{count} photos have no camera{}", named(left_out));
    let code = WarningCode::PhotosUnused;
    (count > 0).then_some(Warning { code, message, value: count as f64 })
}
