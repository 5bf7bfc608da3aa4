//! Views that magnify: what to do where a picture shows more pixels than the network saw.
//!
//! The network learnt its Gaussians together with the renderer's blur of 0.3 px² at the size of
//! its own pictures. Seen larger (a longer focal length, a closer camera) that blur shrinks
//! against the pixels it joined, and gaps open as a dot grid. Here each Gaussian that is seen
//! `p` times larger than in its own photo gets back what the blur lost: with `w` the width of its
//! source pixel in the world, a variance of `0.3 w² (1 - 1/p²)`, so that the sum of both is what
//! the network learnt. Views at the network's own size are untouched, bit for bit.

use std::sync::Arc;

use glam::DVec3;
use rayon::prelude::*;

use crate::{
    limits::MAGNIFIED_CACHE_BYTES_MAX,
    scene::{Camera, Gaussians, Scene, copies::Copies},
};

/// The renderer's blur, px² (`render::constants::BLUR_PX2`; a test holds them equal).
pub const LEARNT_BLUR_PX2: f32 = 0.3;
/// Magnification that passes as the network's own size.
const OWN_SIZE: f64 = 1.25;
/// Share of magnified Gaussians under which a view is left alone.
const SHARE_MIN: f64 = 1e-3;

/// Answers by Gaussians, photos and camera.
pub(super) static MAGNIFIED: Copies<Option<Arc<Gaussians>>> =
    Copies::new(MAGNIFIED_CACHE_BYTES_MAX);

/// Where a photo's Gaussians came from: camera centre and axis, and 1 / focal length in pixels of
/// the network's picture; 0 where nothing is known.
struct Source {
    center: DVec3,
    axis: DVec3,
    pixel: f64,
}

/// Where a view looks from, relative to the origin, and its larger focal length in pixels.
#[derive(Clone, Copy)]
struct Eye {
    center: DVec3,
    axis: DVec3,
    focal: f64,
}

impl Scene {
    /// Gaussians of this scene for a view that magnifies them, or `None` where they are right as
    /// they are. The same camera gets the same copy, while it is kept.
    #[must_use]
    pub fn magnified(&self, gaussians: &Gaussians, camera: &Camera) -> Option<Arc<Gaussians>> {
        let focals = &self.meta.report.network_focal_px;
        let sources: Vec<Source> = self
            .meta
            .cameras
            .iter()
            .zip(focals)
            .map(|(input, focal)| Source {
                center: input.camera.camera_to_world.center() - gaussians.origin(),
                axis: input.camera.camera_to_world.axis(),
                pixel: if *focal > 0.0 { 1.0 / focal } else { 0.0 },
            })
            .collect();
        if sources.is_empty() {
            return None;
        }
        let eye = Eye {
            center: camera.camera_to_world.center() - gaussians.origin(),
            axis: camera.camera_to_world.axis(),
            focal: camera.intrinsics.fx.max(camera.intrinsics.fy),
        };
        let place = |center: DVec3, axis: DVec3, last: f64| {
            [center.to_array(), axis.to_array()].into_iter().flatten().chain([last])
        };
        let photos = sources.iter().flat_map(|s| place(s.center, s.axis, s.pixel));
        let bits = place(eye.center, eye.axis, eye.focal).chain(photos).map(f64::to_bits);
        MAGNIFIED.get(gaussians, bits.collect(), || {
            let copy = magnify(gaussians, &sources, eye).map(Arc::new);
            let size = copy.as_ref().map_or(0, |copy| copy.size_bytes());
            (copy, size)
        })
    }
}

/// The Gaussians with what the blur lost given back, or `None` where next to none lost any.
fn magnify(gaussians: &Gaussians, sources: &[Source], eye: Eye) -> Option<Gaussians> {
    // Variance to add, for each Gaussian.
    let added: Vec<f32> = gaussians
        .means()
        .par_iter()
        .zip(gaussians.source())
        .map(|(mean, source)| {
            let Some(source) = sources.get(usize::from(source.view)) else { return 0.0 };
            let mean = DVec3::from_array(mean.map(f64::from));
            let width = (mean - source.center).dot(source.axis).max(0.0) * source.pixel;
            let depth = (mean - eye.center).dot(eye.axis);
            let p = width * eye.focal / depth / OWN_SIZE;
            if depth <= 0.0 || p <= 1.0 || !p.is_finite() {
                return 0.0;
            }
            #[expect(clippy::cast_possible_truncation, reason = "scales are f32")]
            let variance = (width * width * (1.0 - 1.0 / (p * p))) as f32;
            LEARNT_BLUR_PX2 * variance
        })
        .collect();
    let magnified = added.iter().filter(|v| **v > 0.0).count();
    if (magnified as f64) < SHARE_MIN * added.len() as f64 || magnified == 0 {
        return None;
    }
    let scales = gaussians
        .scales()
        .par_iter()
        .zip(&added)
        .map(|(scales, added)| scales.map(|s| (s * s + added).sqrt()))
        .collect();
    Some(gaussians.with_scales(scales))
}
