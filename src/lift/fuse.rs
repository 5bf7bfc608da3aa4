//! Fusion: what several photos say of one surface, said once or twice, not many times.
//!
//! Each Gaussian is looked at from every other photo that sees its place. Where that photo puts
//! its own surface at the same depth, the Gaussian is *confirmed* there; where it lies clearly in
//! front of what a surer photo sees, it is *contradicted*: it hangs in space that was seen to be
//! empty. Contradicted Gaussians that nobody confirms are dropped. Of a confirmed surface at most
//! [`LAYERS`] photos keep their Gaussians, the surest first, so that a surface is never doubled
//! further by a photo more and never loses its last layer: no holes.

use rayon::prelude::*;

use crate::scene::ViewGaussians;

/// Photos that may keep Gaussians of one surface: what a network makes of a pair is two layers.
const LAYERS: usize = 2;
/// Relative depth difference under which two Gaussians are one surface.
const SAME_SURFACE: f64 = 0.03;
/// Relative depth difference over which a Gaussian hangs in front of a surface.
const IN_FRONT: f64 = 0.10;
/// A coarser layer does not make a finer one superfluous: largest ratio of pixel footprints.
const FOOTPRINT_RATIO_MAX: f64 = 1.5;
/// How much surer a photo must be than the Gaussian it contradicts.
const SURER: f32 = 0.1;

/// What becomes of each Gaussian.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fate {
    /// Kept.
    Keep,
    /// Was not a candidate: dropped for another reason before.
    Absent,
    /// The surface has enough layers already.
    Duplicate,
    /// In front of what a surer photo sees, and confirmed by none.
    Contradicted,
}

/// A view with what fusion asks of it at every pixel.
struct Surface<'a> {
    view: &'a ViewGaussians,
    /// `[H * W]` z in this view's camera of the pixel's own Gaussian; NaN where it is absent.
    depth: Vec<f32>,
}

/// The fate of each Gaussian of each view; `candidate` says which are there at all.
pub(super) fn fuse(views: &[ViewGaussians], candidate: &[Vec<bool>]) -> Vec<Vec<Fate>> {
    let mut fates: Vec<Vec<Fate>> = candidate
        .iter()
        .map(|row| row.iter().map(|&c| if c { Fate::Keep } else { Fate::Absent }).collect())
        .collect();
    if views.len() <= LAYERS {
        return fates;
    }
    let surfaces: Vec<Surface<'_>> =
        views.iter().zip(candidate).map(|(view, keep)| Surface::new(view, keep)).collect();
    for (v, fate) in fates.iter_mut().enumerate() {
        let judged: Vec<Fate> = (0..fate.len())
            .into_par_iter()
            .map(|i| if fate[i] == Fate::Keep { judge(&surfaces, v, i) } else { fate[i] })
            .collect();
        *fate = judged;
    }
    fates
}

/// Rank of a Gaussian among those of its surface: surest first, then the view's order.
fn surer(a: (f32, usize), b: (f32, usize)) -> bool {
    a.0 > b.0 || (a.0 == b.0 && a.1 < b.1)
}

fn judge(surfaces: &[Surface<'_>], v: usize, i: usize) -> Fate {
    let own = &surfaces[v];
    let world = own.view.frame_to_world.matrix().transform_point3(point(own.view.means[i]));
    let confidence = own.view.confidence[i];
    let own_footprint = f64::from(own.depth[i]) / own.view.camera.intrinsics.fx;
    let (mut confirmed, mut better, mut contradicted) = (0, 0, 0);
    for (w, other) in surfaces.iter().enumerate() {
        if w == v {
            continue;
        }
        let Some((at, z)) = other.look(world) else { continue };
        let seen = f64::from(other.depth[at]);
        if seen.is_nan() {
            continue;
        }
        let behind = (z - seen) / seen;
        if behind.abs() <= SAME_SURFACE {
            confirmed += 1;
            let footprint = seen / other.view.camera.intrinsics.fx;
            let fine = footprint <= own_footprint * FOOTPRINT_RATIO_MAX;
            if fine && surer((other.view.confidence[at], w), (confidence, v)) {
                better += 1;
            }
        } else if behind < -IN_FRONT && other.view.confidence[at] > confidence + SURER {
            contradicted += 1;
        }
    }
    if better >= LAYERS {
        Fate::Duplicate
    } else if contradicted > 0 && confirmed == 0 {
        Fate::Contradicted
    } else {
        Fate::Keep
    }
}

impl<'a> Surface<'a> {
    fn new(view: &'a ViewGaussians, keep: &[bool]) -> Self {
        let to_camera = view.camera.camera_to_world.viewmat() * view.frame_to_world.matrix();
        #[expect(clippy::cast_possible_truncation, reason = "a depth compared to per cents")]
        let depth =
            view.means
                .par_iter()
                .zip(keep)
                .map(|(mean, &keep)| {
                    if keep { to_camera.transform_point3(point(*mean)).z as f32 } else { f32::NAN }
                })
                .collect();
        Self { view, depth }
    }

    /// Pixel that sees a world point and the point's depth there; `None` outside the picture.
    fn look(&self, world: glam::DVec3) -> Option<(usize, f64)> {
        let rotation = self.view.camera.camera_to_world.rotation();
        let seen = rotation.transpose() * (world - self.view.camera.camera_to_world.center());
        if seen.z <= 0.0 {
            return None;
        }
        let lens = &self.view.camera.intrinsics;
        let (x, y) = lens.project(seen);
        let inside =
            x >= 0.0 && y >= 0.0 && x < f64::from(lens.width) && y < f64::from(lens.height);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "inside")]
        inside.then(|| ((y as usize) * lens.width as usize + x as usize, seen.z))
    }
}

fn point(mean: [f32; 3]) -> glam::DVec3 {
    glam::Vec3::from_array(mean).as_dvec3()
}
