//! The stage that users get, on photos whose true cameras are known.

use std::{collections::HashMap, sync::atomic::AtomicBool, time::Instant};

use segsplat_vision::pipeline::cameras::{JudgedCameras, judged};
use serde_json::{Value, json};

use super::compared::Compared;
use crate::{
    error::Result,
    limits::Limits,
    photo_files,
    pipeline::Pipeline,
    rows::ms,
    scene::{Camera, CamerasMode, Upload, Watch},
};

/// Median rotation error, degrees, up to which a solution is right.
pub(super) const RIGHT_DEG: f64 = 5.0;

/// What the stage found.
pub(super) struct Solved {
    pub(super) found: JudgedCameras,
    /// The photos' files, in the order of `found`.
    pub(super) files: Vec<String>,
    pub(super) compared: Compared,
    pub(super) seconds: f64,
}

impl Solved {
    /// Solves the photos of `upload`; `cameras` are the true ones by their files.
    pub(super) fn new(
        engine: &Pipeline,
        upload: &Upload,
        cameras: &HashMap<String, Camera>,
    ) -> Result<Self> {
        let never = AtomicBool::new(false);
        let watch = Watch { progress: &|_, _| (), cancel: &never };
        let limits = Limits::default();
        let read = photo_files::read_unposed(upload, CamerasMode::Solve, &limits, &never)?;
        let photos = read.map(|read| read.photos).unwrap_or_default();
        let begun = Instant::now();
        let found = judged(engine, &photos, watch)?;
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
