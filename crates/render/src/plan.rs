//! From a scene and a camera to what a renderer must know of the photos.
//!
//! **Layers.** A network composes few photos at a time. The union of many photos holds every
//! surface many times, each time at a slightly different depth, and the nearest one wins. So a view
//! is made from the few photos taken closest to it. The rest is drawn behind them, where they saw
//! nothing: [`Layer::Behind`].
//!
//! **Magnification.** The network learnt its Gaussians together with the renderer's blur
//! ([`crate::scene::BLUR_PX2`]) at the size of its own pictures. A view that shows them larger (a
//! longer focal length, a closer camera) has the same blur in pixels, which is less in the world,
//! so gaps open as a grid of dots. Each Gaussian that is seen `p` times larger than in its own
//! photo gets back what the blur lost: with `w` the width of its source pixel in the world, a
//! variance of `0.3 w² (1 - 1/p²)`. The sum of both is then what the network learnt. `w` is the
//! depth in the photo times [`Source::scale`]; a magnification up to [`OWN_SIZE`] counts as none.
//! [`widened`] adds it for good, for files and for refinement.
//!
//! **Views from afar.** A Gaussian that is shown smaller than in its own photo, by `s` under 1 with
//! `s = 1.25 w f / t.z`, was learnt with a blur of `0.3 s²` of the view's pixels. It is drawn with
//! that and with the variance of a pixel's square, `(1 - s²) / 12`. Its opacity falls by
//! the ratio of the two areas, so what it adds to the picture is kept, also under the least alpha
//! that counts: `o - (1 - √(det learnt / det drawn)) (o - 1/255)`. The antialiased mode has a rule
//! of its own instead.
//!
//! **Backdrop.** Rays that meet no Gaussian show the photos' colours by direction.
//!
//! Each of the three is a field of [`ViewMethod`] and can be left out.

use std::sync::Arc;

use glam::DVec3;
use rayon::prelude::*;

use crate::{
    Background, Layer, RenderRequest, Source,
    constants::OWN_SIZE,
    error::Result,
    scene::{BLUR_PX2, Camera, Gaussians, Method, Scene, SceneCamera},
    train::checked,
};

/// Near plane where none is asked for, as a share of the scene's median depth.
const NEAR_SHARE: f64 = 0.01;
/// Near planes accepted, world units.
pub const NEAR_RANGE: [f32; 2] = [1e-9, 1e9];

/// The near plane of a scene whose median depth is `median_depth`, world units.
pub fn default_near(median_depth: f64) -> f32 {
    let near = (median_depth * NEAR_SHARE) as f32;
    if near.is_finite() && near > 0.0 { near.clamp(NEAR_RANGE[0], NEAR_RANGE[1]) } else { 0.01 }
}

/// What a view does beyond blending the Gaussians.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ViewMethod {
    /// Photos that are in front, the closest ones: as many as the network is trained to compose;
    /// 0: all.
    pub front_photos: u32,
    /// Whether magnified Gaussians get back the blur that they were learnt with.
    pub magnify: bool,
    /// Whether the scene's backdrop is behind the Gaussians.
    pub backdrop: bool,
}

impl From<&Method> for ViewMethod {
    fn from(method: &Method) -> Self {
        let Method { front_photos, magnify, backdrop, .. } = *method;
        Self { front_photos, magnify, backdrop }
    }
}

/// `request` for a view of `scene` as it is served: by the method of the scene.
#[must_use]
pub fn served(scene: &Scene, request: RenderRequest) -> RenderRequest {
    let method = ViewMethod::from(&scene.meta.report.method);
    let background = match method.backdrop {
        true => Background::Backdrop(Arc::clone(&scene.backdrop)),
        false => Background::BLACK,
    };
    RenderRequest { sources: sources(scene, &request.camera, method), background, ..request }
}

/// A row for each photo of a scene, for a view from `camera`. Where more photos made the scene than
/// are in front, all others are behind.
pub fn sources(scene: &Scene, camera: &Camera, method: ViewMethod) -> Arc<[Source]> {
    let origin = scene.gaussians.origin();
    let focals = &scene.meta.report.network_focal_px;
    let photos = scene.meta.cameras.iter().zip(focals).zip(behind(scene, camera, method));
    let row = |((photo, focal), behind): ((&SceneCamera, &f64), bool)| {
        let pose = &photo.camera.camera_to_world;
        Source {
            center: (pose.center() - origin).as_vec3().to_array(),
            axis: pose.axis().as_vec3().to_array(),
            scale: if method.magnify && *focal > 0.0 { focal.recip() as f32 } else { 0.0 },
            layer: Layer::behind_if(behind),
        }
    };
    photos.map(row).collect()
}

/// Some Gaussians of a scene with its magnification for good: what its views add to those that are
/// shown larger than in the network's picture, for pictures whose longer side is `side` pixels.
/// `None`: for pictures of any size, for programs that know no photos. Without a magnification in
/// the scene's method they stay as they are.
///
/// # Errors
/// `internal` where they cannot be Gaussians any more.
pub fn widened(scene: &Scene, gaussians: &Gaussians, side: Option<u32>) -> Result<Gaussians> {
    let (report, cameras) = (&scene.meta.report, &scene.meta.cameras);
    if !report.method.magnify {
        return Ok(gaussians.clone());
    }
    let origin = gaussians.origin();
    // Of each photo: centre, axis, and the blur lost, at depth 1.
    let row = |(photo, focal): (&SceneCamera, &f64)| {
        let (lens, pose) = (photo.camera.intrinsics, &photo.camera.camera_to_world);
        let shown = side.map_or(f64::INFINITY, |side| {
            lens.fx * (f64::from(side) / f64::from(lens.width.max(lens.height))).min(1.0)
        });
        let larger = (shown / focal / f64::from(OWN_SIZE)).max(1.0);
        let lost = f64::from(BLUR_PX2) * (1.0 - larger.powi(-2));
        (*focal > 0.0 && lost > 0.0)
            .then(|| (pose.center() - origin, pose.axis(), lost / focal / focal))
    };
    let rows: Vec<_> = cameras.iter().zip(&report.network_focal_px).map(row).collect();
    let mut raw = gaussians.clone().into_raw();
    let scales = raw.scales.par_iter_mut().zip(&raw.means).zip(&raw.source);
    scales.for_each(|((scales, mean), source)| {
        let Some(Some((center, axis, lost))) = rows.get(usize::from(source.view)) else { return };
        let depth = (DVec3::from_array(mean.map(f64::from)) - *center).dot(*axis);
        let wider = (lost * depth * depth) as f32;
        for scale in scales {
            *scale = (*scale * *scale + wider).sqrt().min(Gaussians::SCALE_MAX);
        }
    });
    checked(raw)
}

/// Whether each photo is behind in a view from `camera`. A photo of which nothing is known never is
/// in front of others.
fn behind(scene: &Scene, camera: &Camera, method: ViewMethod) -> Vec<bool> {
    let front = method.front_photos as usize;
    let focals = &scene.meta.report.network_focal_px;
    let depth = scene.meta.report.median_depth;
    let photos = scene.meta.cameras.iter().zip(focals).enumerate();
    let pose = &camera.camera_to_world;
    let mut costs: Vec<(usize, f64)> = photos
        .filter(|(_, (_, focal))| **focal > 0.0)
        .map(|(i, (photo, _))| (i, photo.camera.camera_to_world.apart(pose, depth)))
        .collect();
    let layered = front > 0 && costs.len() > front && depth > 0.0;
    let mut behind = vec![layered; scene.meta.cameras.len()];
    costs.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
    costs.iter().take(front).for_each(|(i, _)| behind[*i] = false);
    behind
}
