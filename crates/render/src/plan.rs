//! Which Gaussians make a view: request and scene in, layers of Gaussians out, and the picture.
//!
//! **Layers.** A network composes few photos at a time. The union of many photos holds every
//! surface many times, each time at a slightly different depth, and the nearest one wins. So a view
//! is made from the few photos taken closest to it. The rest is drawn behind them, where they saw
//! nothing.
//!
//! **Magnification.** The network learnt its Gaussians together with the renderer's blur
//! ([`BLUR_PX2`]) at the size of its own pictures. A view that shows them larger (a longer focal
//! length, a closer camera) has the same blur in pixels, which is less in the world, so gaps open
//! as a grid of dots. Each Gaussian that is seen `p` times larger than in its own photo gets back
//! what the blur lost: with `w` the width of its source pixel in the world, a variance of
//! `0.3 w² (1 - 1/p²)`. The sum of both is then what the network learnt. Views at the network's own
//! size stay as they are, bit for bit.
//!
//! **Backdrop.** Rays that meet no Gaussian show the photos' colours by direction.
//!
//! Layers and magnified Gaussians are copies with an identity of their own, which a renderer on a
//! device would upload again for each view. A [`ViewPlanner`] keeps them for the views to come.

use std::{
    collections::HashSet,
    sync::{Arc, Weak},
};

use glam::DVec3;
use rayon::prelude::*;

use crate::{
    Frame, RenderRequest, Renderer,
    error::Result,
    limits::Limits,
    oracle::{Contribution, contributions},
    scene::{BLUR_PX2, Backdrop, Camera, Gaussians, Scene},
};
use segsplat_core::cache::Cache;

/// Near plane where none is asked for, as a share of the scene's median depth.
const NEAR_SHARE: f64 = 0.01;
/// Near planes accepted, world units.
pub const NEAR_RANGE: [f32; 2] = [1e-9, 1e9];
/// Photos that make a view together: as many as the network is trained to compose.
const FRONT_PHOTOS: usize = 4;
/// What a turn of one radian costs against a step of one median depth.
const TURN_COST: f64 = 0.5;
/// Magnification that counts as the network's own size.
const OWN_SIZE: f64 = 1.25;
/// Share of magnified Gaussians under which a view is left alone.
const SHARE_MIN: f64 = 1e-3;
/// Alpha from which a pixel needs nothing behind it.
const OPAQUE: f32 = 0.99;
/// Share of the light that reaches what is behind, under which nothing is looked for there.
const THROUGH_MIN: f64 = 0.01;
/// Least that an answer counts for in a cache, bytes: many hold no copy.
const ANSWER_BYTES: u64 = 256 << 10;

/// The near plane of a scene whose median depth is `median_depth`, world units.
pub fn default_near(median_depth: f64) -> f32 {
    let near = (median_depth * NEAR_SHARE) as f32;
    if near.is_finite() && near > 0.0 { near.clamp(NEAR_RANGE[0], NEAR_RANGE[1]) } else { 0.01 }
}

/// Copies of Gaussians, by their identity and the bits of all else that counts.
type Copies<T> = Cache<(u64, Vec<u64>), (T, Weak<()>)>;

/// Chooses the Gaussians of views, and keeps the copies that it makes for them.
#[derive(Debug)]
pub struct ViewPlanner {
    /// In front and behind, by the photos in front.
    layers: Copies<Arc<[Gaussians; 2]>>,
    /// By camera and photos; `None` where the Gaussians are right as they are.
    magnified: Copies<Option<Arc<Gaussians>>>,
}

impl Default for ViewPlanner {
    fn default() -> Self {
        Self::new(&Limits::default())
    }
}

impl ViewPlanner {
    /// Keeps copies of at most `layers_cache_bytes_max` and `magnified_cache_bytes_max` bytes.
    pub fn new(limits: &Limits) -> Self {
        Self {
            layers: Cache::new(limits.layers_cache_bytes_max),
            magnified: Cache::new(limits.magnified_cache_bytes_max),
        }
    }

    /// Puts other limits in force.
    pub fn set_limits(&self, limits: &Limits) {
        self.layers.set_weight_max(limits.layers_cache_bytes_max);
        self.magnified.set_weight_max(limits.magnified_cache_bytes_max);
    }

    /// Renders a view of a scene. With `backdrop`, colour is over the scene's backdrop instead of
    /// the request's background. Neither adds anything to labels.
    ///
    /// # Errors
    /// Those of the renderer, and `limit_exceeded` when the layers have too many pixel weights
    /// together.
    pub fn render(
        &self,
        renderer: &dyn Renderer,
        scene: &Scene,
        request: &RenderRequest,
        backdrop: bool,
    ) -> Result<Frame> {
        let layers = self.layers(scene, &request.camera);
        let draw = |gaussians, request: &RenderRequest| {
            let magnified = self.magnified(scene, gaussians, &request.camera);
            renderer.render(magnified.as_deref().unwrap_or(gaussians), request)
        };
        let backdrop = backdrop && request.kinds.color;
        if layers.is_none() && !backdrop {
            return draw(&scene.gaussians, request);
        }
        let mut bare = RenderRequest { background: [0.0; 3], ..request.clone() };
        bare.kinds.alpha = true;
        let mut frame = match layers.as_deref() {
            None => draw(&scene.gaussians, &bare)?,
            Some([front, behind]) => {
                let mut frame = draw(front, &bare)?;
                if frame.alpha.iter().flatten().any(|alpha| *alpha < OPAQUE) {
                    put_behind(&mut frame, &draw(behind, &bare)?)?;
                }
                frame
            }
        };
        if let (Some(color), Some(alpha)) = (&mut frame.color, &frame.alpha) {
            if backdrop {
                let seen = Camera { intrinsics: request.lens(), ..request.camera };
                fill(&scene.backdrop, &seen, color, alpha);
            } else {
                for (pixel, alpha) in color.iter_mut().zip(alpha) {
                    add(pixel, request.background, 1.0 - alpha);
                }
            }
        }
        if !request.kinds.alpha {
            frame.alpha = None;
        }
        Ok(frame)
    }

    /// The Gaussians that pixel `[x, y]` of a view sees, by their number in the scene, front to
    /// back.
    ///
    /// # Errors
    /// `invalid_request` as [`contributions`].
    pub fn contributions(
        &self,
        scene: &Scene,
        request: &RenderRequest,
        pixel: [u32; 2],
    ) -> Result<Vec<Contribution>> {
        let camera = &request.camera;
        let along = |gaussians: &Gaussians| {
            let magnified = self.magnified(scene, gaussians, camera);
            contributions(magnified.as_deref().unwrap_or(gaussians), request, pixel)
        };
        let layers = self.layers(scene, camera);
        let Some([front, behind]) = layers.as_deref() else { return along(&scene.gaussians) };
        let numbered = |layer: &Gaussians, mut found: Vec<Contribution>| {
            // A layer holds whole photos, in the scene's order.
            let views: HashSet<u16> = layer.source().iter().map(|source| source.view).collect();
            let all = scene.gaussians.source().iter().enumerate();
            let numbers: Vec<usize> =
                all.filter(|(_, source)| views.contains(&source.view)).map(|(i, _)| i).collect();
            for one in &mut found {
                one.gaussian = numbers.get(one.gaussian).copied().unwrap_or(one.gaussian);
            }
            found
        };
        let mut found = numbered(front, along(front)?);
        let through = 1.0 - found.iter().map(|one| one.weight).sum::<f64>();
        if through > THROUGH_MIN {
            let under = numbered(behind, along(behind)?).into_iter();
            found.extend(under.map(|one| Contribution { weight: one.weight * through, ..one }));
        }
        Ok(found)
    }

    /// The Gaussians in front and behind for a camera, or `None` where few photos made the scene.
    /// Cameras with the same photos in front get the same copies, while those are kept.
    pub fn layers(&self, scene: &Scene, camera: &Camera) -> Option<Arc<[Gaussians; 2]>> {
        let focals = &scene.meta.report.network_focal_px;
        let depth = scene.meta.report.median_depth;
        let used = focals.iter().filter(|focal| **focal > 0.0).count();
        if used <= FRONT_PHOTOS || depth <= 0.0 {
            return None;
        }
        let pose = &camera.camera_to_world;
        let photos = scene.meta.cameras.iter().zip(focals).enumerate();
        let mut costs: Vec<(usize, f64)> = photos
            .filter(|(_, (_, focal))| **focal > 0.0)
            .map(|(i, (input, _))| {
                let own = &input.camera.camera_to_world;
                let step = own.center().distance(pose.center()) / depth;
                let turn = own.axis().dot(pose.axis()).clamp(-1.0, 1.0).acos();
                (i, step + TURN_COST * turn)
            })
            .collect();
        costs.sort_by(|a, b| a.1.total_cmp(&b.1).then(a.0.cmp(&b.0)));
        let mut front = vec![false; scene.meta.cameras.len()];
        costs.iter().take(FRONT_PHOTOS).for_each(|(i, _)| front[*i] = true);
        let all = &scene.gaussians;
        let in_front =
            |i: usize| front.get(usize::from(all.source()[i].view)).copied().unwrap_or(false);
        let bits = front.iter().map(|&in_front| u64::from(in_front)).collect();
        Some(kept(&self.layers, all, bits, || {
            let layers = [all.only(in_front), all.only(|i| !in_front(i))];
            let size = layers.iter().map(Gaussians::size_bytes).sum();
            (Arc::new(layers), size)
        }))
    }

    /// Gaussians of a scene for a view that magnifies them, or `None` where they are right as they
    /// are. The same camera gets the same copy, while it is kept.
    pub fn magnified(
        &self,
        scene: &Scene,
        gaussians: &Gaussians,
        camera: &Camera,
    ) -> Option<Arc<Gaussians>> {
        let focals = &scene.meta.report.network_focal_px;
        let photos = scene.meta.cameras.iter().zip(focals);
        let photos: Vec<Source> = photos
            .map(|(input, focal)| Source {
                center: input.camera.camera_to_world.center() - gaussians.origin(),
                axis: input.camera.camera_to_world.axis(),
                scale: if *focal > 0.0 { 1.0 / focal } else { 0.0 },
            })
            .collect();
        if photos.is_empty() {
            return None;
        }
        let view = Source {
            center: camera.camera_to_world.center() - gaussians.origin(),
            axis: camera.camera_to_world.axis(),
            scale: camera.intrinsics.fx.max(camera.intrinsics.fy),
        };
        let bits = |source: &Source| {
            let Source { center, axis, scale } = *source;
            [center.x, center.y, center.z, axis.x, axis.y, axis.z, scale].map(f64::to_bits)
        };
        let bits = [&view].into_iter().chain(&photos).flat_map(bits).collect();
        kept(&self.magnified, gaussians, bits, || {
            let copy = magnify(gaussians, &photos, &view).map(Arc::new);
            let size = copy.as_ref().map_or(0, |copy| copy.size_bytes());
            (copy, size)
        })
    }
}

/// The copy of `gaussians`, or what `make` gives with its bytes. `make` runs outside of the lock.
fn kept<T: Clone>(
    copies: &Copies<T>,
    gaussians: &Gaussians,
    rest: Vec<u64>,
    make: impl FnOnce() -> (T, u64),
) -> T {
    let key = (gaussians.identity(), rest);
    if let Some((copy, _)) = copies.find(&key) {
        return copy;
    }
    let (copy, size) = make();
    // Another caller may have been faster: all go on with the first copy.
    if let Some((first, _)) = copies.find(&key) {
        return first;
    }
    // Nobody can ask for copies of a scene that was deleted or left the memory: read once more, it
    // has another identity.
    copies.retain(|(_, life)| life.strong_count() > 0);
    copies.insert(key, (copy.clone(), gaussians.life()), size.max(ANSWER_BYTES));
    copy
}

/// Where a photo or a view was taken from: camera centre from the Gaussians' origin, and axis.
struct Source {
    center: DVec3,
    axis: DVec3,
    /// Of a photo 1 / focal length in pixels of the network's picture, 0 where nothing is known;
    /// of a view the larger focal length in pixels.
    scale: f64,
}

/// The Gaussians with what the blur lost given back, or `None` where next to none lost any.
fn magnify(gaussians: &Gaussians, photos: &[Source], view: &Source) -> Option<Gaussians> {
    // Variance to add, for each Gaussian.
    let added: Vec<f32> = gaussians
        .means()
        .par_iter()
        .zip(gaussians.source())
        .map(|(mean, source)| {
            let Some(photo) = photos.get(usize::from(source.view)) else { return 0.0 };
            let mean = DVec3::from_array(mean.map(f64::from));
            let width = (mean - photo.center).dot(photo.axis).max(0.0) * photo.scale;
            let depth = (mean - view.center).dot(view.axis);
            let p = width * view.scale / depth / OWN_SIZE;
            if depth <= 0.0 || p <= 1.0 || !p.is_finite() {
                return 0.0;
            }
            let variance = (width * width * (1.0 - 1.0 / (p * p))) as f32;
            BLUR_PX2 * variance
        })
        .collect();
    let magnified = added.iter().filter(|v| **v > 0.0).count();
    if (magnified as f64) < SHARE_MIN * added.len() as f64 || magnified == 0 {
        return None;
    }
    let scales = gaussians.scales().par_iter().zip(&added);
    let scales = scales.map(|(scales, added)| scales.map(|s| (s * s + added).sqrt())).collect();
    Some(gaussians.with_scales(scales))
}

/// Puts the backdrop behind a view rendered over black: `color += (1 - alpha) * backdrop`. `color`
/// and `alpha` are `[height * width]` of the camera's picture.
fn fill(backdrop: &Backdrop, camera: &Camera, color: &mut [[f32; 3]], alpha: &[f32]) {
    let rotation = camera.camera_to_world.rotation();
    let width = camera.intrinsics.width.max(1) as usize;
    for (i, (pixel, &alpha)) in color.iter_mut().zip(alpha).enumerate() {
        if alpha >= 1.0 {
            continue;
        }
        let (x, y) = ((i % width) as f64 + 0.5, (i / width) as f64 + 0.5);
        let behind = backdrop.color(rotation * camera.intrinsics.unproject(x, y, 1.0));
        add(pixel, behind, 1.0 - alpha);
    }
}

/// Adds a share of a pixel to another.
fn add<const N: usize>(to: &mut [f32; N], pixel: [f32; N], share: f32) {
    for (value, more) in to.iter_mut().zip(pixel) {
        *value += share * more;
    }
}

/// `front` over `behind`, both over black and of one size.
fn put_behind(front: &mut Frame, behind: &Frame) -> Result<()> {
    let (Some(alphas), Some(behind_alphas)) = (&mut front.alpha, &behind.alpha) else {
        return Ok(());
    };
    if let (Some(weights), Some(under)) = (&mut front.weights, &behind.weights) {
        *weights = crate::labels::over(weights, under, |i| 1.0 - alphas[i])?;
    }
    for (i, (alpha, under)) in alphas.iter_mut().zip(behind_alphas).enumerate() {
        let room = (1.0 - *alpha) * under;
        if let (Some(color), Some(under)) = (&mut front.color, &behind.color) {
            add(&mut color[i], under[i], 1.0 - *alpha);
        }
        if let (Some(blend), Some(under)) = (&mut front.blend, &behind.blend) {
            add(&mut blend[i], under[i], 1.0 - *alpha);
        }
        if let (Some(depth), Some(under)) = (&mut front.depth, &behind.depth) {
            let total = *alpha + room;
            if total > 0.0 {
                depth[i] = (depth[i] * *alpha + under[i] * room) / total;
            }
        }
        *alpha += room;
    }
    front.stats.visible += behind.stats.visible;
    front.stats.intersections += behind.stats.intersections;
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::RawGaussians;

    fn some(count: usize) -> Vec<Gaussians> {
        let one = || Gaussians::sanitize(RawGaussians::default()).expect("none is fine").0;
        (0..count).map(|_| one()).collect()
    }

    #[test]
    fn a_copy_is_made_once_and_leaves_with_the_gaussians_it_was_made_of() {
        let (copies, mut of): (Copies<usize>, _) = (Cache::new(4 * ANSWER_BYTES), some(3));
        let get = |gaussians: &Gaussians, n| kept(&copies, gaussians, vec![7], || (n, 0));
        assert_eq!(get(&of[0], 1), 1, "the first time");
        assert_eq!(get(&of[0].clone(), 2), 1, "a clone has the same copy");
        assert_eq!(kept(&copies, &of[0], vec![8], || (3, 0)), 3, "all else counts too");
        assert_eq!(get(&of[1], 4), 4, "other Gaussians");
        let held = of[0].clone();
        of.drain(..2);
        assert_eq!(copies.weight(), 3 * ANSWER_BYTES, "an answer without bytes counts too");
        assert_eq!(get(&of[0], 5), 5);
        assert_eq!(
            copies.weight(),
            3 * ANSWER_BYTES,
            "the second has left, the clone holds the first"
        );
        assert_eq!(get(&held, 6), 1);
    }
}
