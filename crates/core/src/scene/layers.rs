//! Which photos' Gaussians make a view, and which only fill what those leave open.
//!
//! A network composes few photos at a time; the union of many says every surface many times, each
//! time at a slightly other depth, and the nearest of these wins. So a view is made from the few
//! photos taken closest to it, and the rest is drawn behind, where those saw nothing.

use std::sync::Arc;

use crate::{
    limits::LAYERS_CACHE_BYTES_MAX,
    scene::{Camera, Gaussians, Scene, copies::Copies},
};

/// Photos that make a view together: as many as the network is trained to compose.
const FRONT_PHOTOS: usize = 4;
/// What a turn of one radian costs against a step of one median depth.
const TURN_COST: f64 = 0.5;

/// Front and behind, by the photos in front.
pub(super) static LAYERS: Copies<Arc<[Gaussians; 2]>> = Copies::new(LAYERS_CACHE_BYTES_MAX);

impl Scene {
    /// The Gaussians in front and behind for a camera, or `None` where few photos made the scene.
    /// Cameras with the same photos in front get the same copies, while those are kept.
    #[must_use]
    pub fn layers(&self, camera: &Camera) -> Option<Arc<[Gaussians; 2]>> {
        let focals = &self.meta.report.network_focal_px;
        let depth = self.meta.report.median_depth;
        let used = focals.iter().filter(|focal| **focal > 0.0).count();
        if used <= FRONT_PHOTOS || depth <= 0.0 {
            return None;
        }
        let pose = &camera.camera_to_world;
        let mut costs: Vec<(usize, f64)> = self
            .meta
            .cameras
            .iter()
            .zip(focals)
            .enumerate()
            .filter(|(_, (_, focal))| **focal > 0.0)
            .map(|(i, (input, _))| {
                let own = &input.camera.camera_to_world;
                let step = own.center().distance(pose.center()) / depth;
                let turn = own.axis().dot(pose.axis()).clamp(-1.0, 1.0).acos();
                (i, step + TURN_COST * turn)
            })
            .collect();
        costs.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        let mut front = vec![false; self.meta.cameras.len()];
        costs.iter().take(FRONT_PHOTOS).for_each(|(i, _)| front[*i] = true);
        let in_front = |i: usize| {
            let view = usize::from(self.gaussians.source()[i].view);
            front.get(view).copied().unwrap_or(false)
        };
        let in_front_bits = front.iter().map(|&f| u64::from(f)).collect();
        Some(LAYERS.get(&self.gaussians, in_front_bits, || {
            let layers = [self.gaussians.only(in_front), self.gaussians.only(|i| !in_front(i))];
            let size = layers.iter().map(Gaussians::size_bytes).sum();
            (Arc::new(layers), size)
        }))
    }
}
