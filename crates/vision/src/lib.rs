//! From photos to Gaussians and their semantics: every stage between an upload and a scene.
//!
//! | layer | modules | may use |
//! |---|---|---|
//! | L1 stages | [`capture`], [`models`], [`lift`], [`matching`], [`segment`], [`semantics`], [`sample`] | `segsplat_core` (and [`segsplat_render::vectorised`]); never each other |
//! | L1 stages | [`photos`] | `segsplat_core`, `segsplat_formats`, [`capture`] (which turn of photos fits) |
//! | L1 stages | [`refine`] | `segsplat_core`, `segsplat_render` |
//! | L2 order | [`pipeline`] | L1, `segsplat_cameras`; the only place that knows their order |

pub mod capture;
pub mod lift;
pub mod matching;
pub mod models;
pub mod photos;
pub mod pipeline;
pub mod refine;
pub mod sample;
pub mod segment;
pub mod semantics;

use glam::DVec3;
use segsplat_core::{error, limits, meter, names, scene, scene::photo_label};
use segsplat_formats as formats;
use segsplat_render::vectorised;

/// World point at the centre of Gaussian `i`.
fn center_of(gaussians: &scene::Gaussians, i: usize) -> DVec3 {
    point(gaussians.means()[i]) + gaussians.origin()
}

fn point(mean: [f32; 3]) -> DVec3 {
    DVec3::from_array(mean.map(f64::from))
}

/// A world point in the frame of a camera, and the place (u, v) in pixels at which its picture
/// shows the point. `None` behind the camera or outside of the picture.
fn seen_at(camera: &scene::Camera, world: DVec3) -> Option<(DVec3, f64, f64)> {
    let pose = &camera.camera_to_world;
    let seen = pose.rotation().transpose() * (world - pose.center());
    let (u, v) = camera.intrinsics.project(seen);
    let (width, height) = (camera.intrinsics.width.into(), camera.intrinsics.height.into());
    (seen.z > 0.0 && (0.0..width).contains(&u) && (0.0..height).contains(&v))
        .then_some((seen, u, v))
}
