//! The same views by the library, in this process: what the server could give at most.

use std::{
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
    time::Instant,
};

use super::path::Path;
use crate::{
    error::Result,
    limits::Limits,
    photo_files,
    pipeline::Pipeline,
    render::{Frame, Kinds, RenderRequest, Renderer, Samples, Switches, plan::served},
    rows::each,
    scene::{Camera, Scene, SceneOptions, Upload},
    scenes::{make, scene_of, view_request},
    setup::Setup,
};

/// Where a row ends: at the first of both.
#[derive(Clone, Copy, Debug)]
pub(super) struct Bounds {
    pub(super) views: u64,
    pub(super) seconds: f64,
}

impl Bounds {
    /// Views before the measured ones.
    pub(super) fn warm_up(self, callers: usize) -> u64 {
        (4 * callers as u64).min(self.views)
    }
}

/// The scene and the renderer of this process.
pub(super) struct Library {
    scene: Scene,
    renderer: Arc<dyn Renderer>,
}

impl Library {
    /// Makes the scene of an upload.
    pub(super) fn open(setup: &Setup, upload: &Upload) -> Result<Self> {
        let photos = photo_files::read(upload, &Limits::default())?;
        let scene = make(&Pipeline::open(&setup.networks(1))?, &photos, &SceneOptions::default())?;
        let (renderer, _adapters) = setup.renderer(Switches::default())?;
        Ok(Self { scene: scene_of(scene), renderer })
    }

    /// A view over the backdrop, in f32 or in the levels that files have.
    pub(super) fn draw(&self, camera: Camera, kinds: Kinds, samples: Samples) -> Result<Frame> {
        let plain = view_request(camera, kinds, self.scene.meta.report.median_depth);
        let request = served(&self.scene, RenderRequest { samples, ..plain });
        self.renderer.render(&self.scene.gaussians, &request)
    }

    /// Views a second of `callers` threads, from the view `first` on.
    pub(super) fn rate(
        &self,
        path: &Path,
        kinds: Kinds,
        callers: usize,
        first: u64,
        bounds: Bounds,
    ) -> Result<f64> {
        let run = |views: u64, seconds: f64| -> Result<f64> {
            let (next, begun) = (AtomicU64::new(0), Instant::now());
            let drawn = each(callers, callers, |_| {
                let mut drawn = 0_u64;
                loop {
                    let n = next.fetch_add(1, Ordering::Relaxed);
                    if n >= views || begun.elapsed().as_secs_f64() > seconds {
                        return Ok(drawn);
                    }
                    self.draw(path.camera(first + n)?, kinds, Samples::Levels)?;
                    drawn += 1;
                }
            })?;
            Ok(drawn.iter().sum::<u64>() as f64 / begun.elapsed().as_secs_f64())
        };
        run(bounds.warm_up(callers), bounds.seconds)?;
        run(bounds.views, bounds.seconds)
    }
}
