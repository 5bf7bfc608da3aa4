//! Cameras that are a little wrong, mended by matched keypoints: a bundle adjustment that begins
//! with them, and leaves all of them together where they were given.

use nalgebra::{Matrix3, Vector2, Vector3};
use segsplat_core::{
    error::{Error, Result},
    scene::{Camera, CameraToWorld},
};

use crate::{
    adjust::{AdjustOptions, Bundle, LensPrior, Sight},
    given::{PairMatches, PhotoKeypoints},
    grow::nearest_to,
    lens::Lens,
    pose::{Pose, angle_deg, camera_to_world, project},
    tracks::join,
};

/// Focal length of the lens in whose pixels all is measured: a pixel is a thousandth of the depth.
const FOCAL: f64 = 1_000.0;
/// How far a match may be from the line that the given cameras say: two degrees.
const LINE_MAX: f64 = 35.0;
/// A pair of photos speaks where so many of its matches are near their lines, and so large a share:
/// of wrong matches a fifth is.
const NEAR_MIN: usize = 12;
const NEAR_SHARE: f64 = 0.4;
/// A camera that turns further than this from where it was given, degrees, is not held by its
/// keypoints: it stays.
const TURN_MAX_DEG: f64 = 2.0;
/// Distance at which a keypoint has half of its weight, turn by turn; three times as far it is none
/// of its point's.
const SCALES: [f64; 4] = [12.0, 6.0, 3.0, 1.5];
const STEPS: usize = 20;
/// Fewest keypoints that hold a camera: with fewer it stays.
const SIGHTS_MIN: usize = 24;
/// Keypoints of points that are seen from one place say nothing: least sine of the angle of rays.
const SINE_MIN: f64 = 0.02;

/// Where the cameras of photos stand, by the matches of their keypoints; those with too few matches
/// stay, and all stay where they were given in the mean, in turn, place and scale. `None` where
/// matches are too few for any.
///
/// # Errors
/// `invalid_request` where photos, cameras and matches do not fit each other.
pub fn mend(
    cameras: &[Camera],
    photos: &[PhotoKeypoints],
    matches: &[PairMatches],
) -> Result<Option<Vec<CameraToWorld>>> {
    let is_there = |photo: usize, keypoint: u32| {
        photos.get(photo).is_some_and(|photo| (keypoint as usize) < photo.keypoints.len())
    };
    let fits = |of: &PairMatches| {
        let [a, b] = of.photos;
        of.pairs.iter().all(|[i, j]| is_there(a, *i) && is_there(b, *j))
    };
    if cameras.len() != photos.len() || !matches.iter().all(fits) {
        return Err(Error::invalid("cameras: matches of other photos"));
    }
    let pixels: Vec<Vec<Vector2<f64>>> = cameras.iter().zip(photos).map(plain_pixels).collect();
    let given: Vec<Pose> = cameras.iter().map(|camera| Pose::of(&camera.camera_to_world)).collect();
    let tracks = tracks(&given, &pixels, matches);
    let mut poses = given.clone();
    let (mut held, mut loose) = (Vec::new(), vec![false; poses.len()]);
    for scale_px in SCALES {
        let mut bundle = bundle(&poses, &tracks, scale_px);
        held = held_by(&bundle, &loose);
        for of_point in &mut bundle.sights {
            of_point.retain(|sight| held[sight.camera]);
        }
        let Some(fixed) = held.iter().position(|held| *held) else { return Ok(None) };
        let options = AdjustOptions { steps: STEPS, free_focal: false, free_k1: false, scale_px };
        bundle.adjust(fixed, &options);
        poses = bundle.poses;
        back(&given, &mut poses, &held);
        for i in 0..poses.len() {
            let turn = angle_deg(&(poses[i].r * given[i].r.transpose()));
            if held[i] && turn > TURN_MAX_DEG {
                (poses[i], loose[i], held[i]) = (given[i], true, false);
            }
        }
    }
    Ok((held.iter().filter(|held| **held).count() >= 2)
        .then(|| poses.iter().map(camera_to_world).collect()))
}

/// The tracks of the matches that are near the lines of the given cameras.
fn tracks(
    given: &[Pose],
    pixels: &[Vec<Vector2<f64>>],
    matches: &[PairMatches],
) -> Vec<Vec<Sight>> {
    let near = matches.iter().flat_map(|of| {
        let [a, b] = of.photos;
        let between = between(&given[a], &given[b]);
        let (of_a, of_b) = (&pixels[a], &pixels[b]);
        let near: Vec<[(u32, u32); 2]> = of
            .pairs
            .iter()
            .filter(|[i, j]| off_line(&between, &of_a[*i as usize], &of_b[*j as usize]) < LINE_MAX)
            .map(|[i, j]| [(a as u32, *i), (b as u32, *j)])
            .collect();
        let least = NEAR_SHARE * of.pairs.len() as f64;
        let speaks = near.len() >= NEAR_MIN && near.len() as f64 >= least;
        if speaks { near } else { Vec::new() }
    });
    let counts: Vec<usize> = pixels.iter().map(Vec::len).collect();
    let sight = |(camera, keypoint): (u32, u32)| {
        let camera = camera as usize;
        Sight { camera, pixel: pixels[camera][keypoint as usize] }
    };
    let tracks = join(&counts, near).into_iter();
    tracks.map(|track| track.into_iter().map(sight).collect()).collect()
}

/// Which cameras enough keypoints hold, but for those that are `loose`.
fn held_by(bundle: &Bundle, loose: &[bool]) -> Vec<bool> {
    let mut sights = vec![0; loose.len()];
    bundle.sights.iter().flatten().for_each(|sight| sights[sight.camera] += 1);
    sights.iter().zip(loose).map(|(&sights, loose)| sights >= SIGHTS_MIN && !loose).collect()
}

/// Keypoints as [`FOCAL`] sees them, from the middle.
fn plain_pixels((camera, photo): (&Camera, &PhotoKeypoints)) -> Vec<Vector2<f64>> {
    let lens = camera.intrinsics;
    let plain = |[x, y]: &[f32; 2]| {
        let (x, y) = (f64::from(*x) - lens.cx, f64::from(*y) - lens.cy);
        Vector2::new(x / lens.fx, y / lens.fy) * FOCAL
    };
    photo.keypoints.iter().map(plain).collect()
}

/// The points of tracks under these poses, with the keypoints that are near them.
fn bundle(poses: &[Pose], tracks: &[Vec<Sight>], scale_px: f64) -> Bundle {
    let lens = Lens { focal: FOCAL, k1: 0.0 };
    let (mut points, mut sights) = (Vec::new(), Vec::new());
    for track in tracks {
        let ray = |sight: &Sight| {
            let pose = &poses[sight.camera];
            let ray = (sight.pixel / FOCAL).push(1.0);
            (pose.center(), (pose.r.transpose() * ray).normalize())
        };
        let rays: Vec<(Vector3<f64>, Vector3<f64>)> = track.iter().map(ray).collect();
        let is_wide = rays
            .iter()
            .enumerate()
            .any(|(i, a)| rays[i + 1..].iter().any(|b| a.1.cross(&b.1).norm() > SINE_MIN));
        let Some(point) = nearest_to(&rays).filter(|_| is_wide) else { continue };
        let is_near = |sight: &&Sight| {
            let seen = lens.project(&poses[sight.camera].seen(&point));
            seen.is_some_and(|seen| (seen - sight.pixel).norm() < 3.0 * scale_px)
        };
        let near: Vec<Sight> = track.iter().filter(is_near).copied().collect();
        if near.len() >= 2 {
            points.push(point);
            sights.push(near);
        }
    }
    let prior = LensPrior { focal: FOCAL, log_spread: 1.0, known: true, k1_spread: 1.0 };
    Bundle {
        poses: poses.to_vec(),
        lens_of: vec![0; poses.len()],
        lenses: vec![lens],
        priors: vec![prior],
        points,
        sights,
    }
}

/// Turns, scales and moves the cameras that were `held` by keypoints so that together they stand as
/// they were given.
fn back(given: &[Pose], poses: &mut [Pose], held: &[bool]) {
    let held: Vec<usize> = (0..poses.len()).filter(|&i| held[i]).collect();
    let count = held.len() as f64;
    let mean = |of: &[Pose]| held.iter().map(|&i| of[i].center()).sum::<Vector3<f64>>() / count;
    let (from, to) = (mean(poses), mean(given));
    let spread = |of: &[Pose], middle: &Vector3<f64>| {
        held.iter().map(|&i| (of[i].center() - middle).norm_squared()).sum::<f64>().sqrt()
    };
    let scale = spread(given, &to) / spread(poses, &from).max(f64::MIN_POSITIVE);
    let turns: Matrix3<f64> = held.iter().map(|&i| given[i].r.transpose() * poses[i].r).sum();
    let Some(turn) = project(&turns) else { return };
    for &i in &held {
        let center = to + turn * (poses[i].center() - from) * scale;
        let r = poses[i].r * turn.transpose();
        poses[i] = Pose { r, t: -(r * center) };
    }
}

/// From the first camera to the second.
fn between(first: &Pose, second: &Pose) -> Pose {
    let r = second.r * first.r.transpose();
    Pose { r, t: second.t - r * first.t }
}

/// How far a keypoint of the second photo is from the line on which the first one must lie.
fn off_line(between: &Pose, first: &Vector2<f64>, second: &Vector2<f64>) -> f64 {
    let line = between.t.cross(&(between.r * (first / FOCAL).push(1.0)));
    let off = line.dot(&(second / FOCAL).push(1.0)).abs();
    FOCAL * off / line.xy().norm().max(f64::MIN_POSITIVE)
}
