//! The stage that users get, on photos whose true cameras are known.

use std::{collections::HashMap, sync::atomic::AtomicBool, time::Instant};

use glam::{DMat3, DVec3};
use segsplat_vision::pipeline::cameras::{JudgedCameras, guessed, judged};
use serde_json::{Value, json};

use super::compared::Compared;
use crate::{
    error::Result,
    limits::Limits,
    photo_files,
    pipeline::Pipeline,
    rows::ms,
    scene::{Camera, CameraToWorld, CamerasMode, UnposedPhoto, Upload, Watch},
};

/// Median rotation error, degrees, up to which a solution is right.
pub(super) const RIGHT_DEG: f64 = 5.0;

/// What stands in for a network that says where photos were taken.
#[derive(Clone, Copy, Debug, clap::Args)]
pub(super) struct Guess {
    /// Begin with cameras that are so many degrees off, as from a network: each turned so far about
    /// an axis of its own and moved by so many hundredths of the longest way between two, with a
    /// focal length that is as many hundredths too long
    #[arg(long, value_name = "DEGREES", value_parser = clap::value_parser!(u8).range(0..=180))]
    guess: Option<u8>,
}

/// True cameras that are a little or quite wrong.
fn guesses(
    photos: &[UnposedPhoto],
    cameras: &HashMap<String, Camera>,
    degrees: f64,
) -> Vec<Option<Camera>> {
    let centers: Vec<DVec3> = cameras.values().map(|of| of.camera_to_world.center()).collect();
    let ways = centers.iter().flat_map(|a| centers.iter().map(|b| a.distance(*b)));
    let longest = ways.fold(0.0, f64::max);
    // Directions spread evenly over the sphere.
    let direction = |i: usize| {
        let (around, height) = (2.4 * i as f64, 1.0 - (0.3 + 0.618 * i as f64).fract() * 2.0);
        let wide = (1.0 - height * height).sqrt();
        DVec3::new(wide * around.cos(), wide * around.sin(), height)
    };
    let guess = |(i, unposed): (usize, &UnposedPhoto)| {
        let Camera { intrinsics, camera_to_world } = cameras.get(&unposed.file)?;
        let turn = DMat3::from_axis_angle(direction(i), degrees.to_radians());
        let center = camera_to_world.center() + direction(i + 7) * (longest * degrees / 100.0);
        let mut intrinsics = intrinsics.resized(unposed.photo.width, unposed.photo.height);
        intrinsics.fx *= 1.0 + degrees / 100.0;
        intrinsics.fy *= 1.0 + degrees / 100.0;
        let rotation = camera_to_world.rotation() * turn;
        Some(Camera { intrinsics, camera_to_world: CameraToWorld::from_rotation(rotation, center) })
    };
    photos.iter().enumerate().map(guess).collect()
}

/// What the stage found.
pub(super) struct Solved {
    pub(super) found: JudgedCameras,
    /// The photos' files, in the order of `found`.
    pub(super) files: Vec<String>,
    pub(super) compared: Compared,
    pub(super) seconds: f64,
}

impl Solved {
    /// Solves the photos of `upload`; `cameras` are the true ones by their files. `guess` takes the
    /// place of the bundle's network where it is given.
    pub(super) fn new(
        engine: &Pipeline,
        upload: &Upload,
        cameras: &HashMap<String, Camera>,
        guess: &Guess,
    ) -> Result<Self> {
        let never = AtomicBool::new(false);
        let watch = Watch { progress: &|_, _| (), cancel: &never };
        let limits = Limits::default();
        let read = photo_files::read_unposed(upload, CamerasMode::Solve, &limits, &never)?;
        let photos = read.map(|read| read.photos).unwrap_or_default();
        let begun = Instant::now();
        let guesses = match guess.guess {
            Some(degrees) => guesses(&photos, cameras, f64::from(degrees)),
            None => guessed(engine, &photos)?,
        };
        let found = judged(engine, &photos, &guesses, watch)?;
        let seconds = ms(begun) / 1e3;
        let files: Vec<String> = photos.into_iter().map(|photo| photo.file).collect();
        let pairs = files.iter().zip(found.cameras());
        let pairs = pairs.filter_map(|(file, camera)| Some((*cameras.get(file)?, camera?)));
        let compared = Compared::new(&pairs.collect::<Vec<_>>());
        Ok(Self { found, files, compared, seconds })
    }

    /// `refused`, `right` or `wrong`, by the median error of the rotations.
    pub(super) fn outcome(&self) -> &'static str {
        match &self.found.refused {
            Some(_) => "refused",
            None if self.compared.rotation_deg.median <= RIGHT_DEG => "right",
            None => "wrong",
        }
    }

    /// A row with `values`, which say what was solved.
    pub(super) fn row(&self, values: Value) -> Value {
        let own = json!({
            "confidence": self.found.confidence, "seconds": self.seconds,
            "outcome": self.outcome(), "refused": self.found.refused,
            "evidence": self.found.evidence,
        });
        let all = [values, self.compared.row(), own];
        all.into_iter().flat_map(|of| of.as_object().cloned().unwrap_or_default()).collect()
    }
}
