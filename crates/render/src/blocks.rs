//! Gaussians in blocks by place, so that a view tests a block where it would project each Gaussian.
//!
//! The arrays of a scene stay as they are. Blocks are a second order of them: halves of halves,
//! each cut across the longest side of its box, down to [`BLOCK`] Gaussians. A view that no
//! Gaussian of a block can touch leaves it out; [`Frustum::may_show`] is the test, and
//! `shaders/cull.wgsl` has it too. It never leaves out a Gaussian that touches a tile, so no pixel
//! changes.
//!
//! Blocks are made once a scene, when it is first drawn or uploaded. The backward pass has other
//! Gaussians at each step and does without.

use std::sync::{Arc, Weak};

use glam::{DVec3, Vec3};
use parking_lot::Mutex;
use rayon::prelude::*;

use crate::{
    RenderRequest, Source,
    constants::{ALPHA_MIN, BLUR_PX2, FOOTPRINT_SLACK},
    scene::Gaussians,
    switches::{Skip, Switches},
    view::View,
};

/// Gaussians of a block: a workgroup of the kernels.
pub const BLOCK: usize = 256;
/// Gaussians from which a scene has blocks: for fewer a view costs less than the test saves.
pub const BLOCKS_MIN: usize = 1 << 18;
/// Fewest Gaussians that a thread sorts by itself.
const SPLIT_MIN: usize = 1 << 14;
/// Rounding of the test, as a share of the numbers in it: over that of f32 on a device.
pub(crate) const ROUNDING: f64 = 1e-5;
/// Share by which reaches are taken larger, and pixels around the picture: over the slack of
/// `shaders/common/tiles.wgsl`.
const REACH_SLACK: f64 = 1.0001;
const MARGIN_PX: f64 = 1.0;

/// Where the Gaussians of a block are, and how far they reach: 32 bytes.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Bounds {
    /// Middle of the box of the centres, relative to the origin.
    pub center: [f32; 3],
    /// Half the sides of the box.
    pub half: [f32; 3],
    /// Largest scale.
    pub reach: f32,
}

/// The blocks of a scene: 4.1 bytes a Gaussian.
#[derive(Debug)]
pub struct Blocks {
    /// `[N]` Gaussians, block after block of [`BLOCK`]; those of a block ascend.
    pub order: Vec<u32>,
    /// Of each block.
    pub bounds: Vec<Bounds>,
}

/// A centre with its number, for the sort.
#[derive(Clone, Copy)]
struct Place {
    at: [f32; 3],
    id: u32,
}

impl Blocks {
    /// The blocks of a scene; the same ones for any number of threads. Takes 16 bytes a Gaussian
    /// while it runs.
    pub fn of(gaussians: &Gaussians) -> Self {
        let means = gaussians.means().par_iter().enumerate();
        let mut places: Vec<Place> = means.map(|(id, &at)| Place { at, id: id as u32 }).collect();
        split(&mut places);
        let scales = gaussians.scales();
        let bounds = places.par_chunks(BLOCK).map(|block| bounds_of(block, scales)).collect();
        Self { order: places.par_iter().map(|place| place.id).collect(), bounds }
    }

    /// The Gaussians of block `at`, ascending.
    pub fn ids(&self, at: usize) -> &[u32] {
        &self.order[at * BLOCK..self.order.len().min((at + 1) * BLOCK)]
    }
}

/// Least and largest coordinates.
fn corners(places: &[Place]) -> [[f32; 3]; 2] {
    let (mut low, mut high) = (Vec3::INFINITY, Vec3::NEG_INFINITY);
    for place in places {
        let at = Vec3::from(place.at);
        (low, high) = (low.min(at), high.max(at));
    }
    [low.to_array(), high.to_array()]
}

/// Orders places so that blocks of them are close together.
fn split(places: &mut [Place]) {
    if places.len() <= BLOCK {
        return places.sort_unstable_by_key(|place| place.id);
    }
    let [low, high] = corners(places);
    let side = |axis: &usize| high[*axis] - low[*axis];
    let axis = (0..3).max_by(|a, b| side(a).total_cmp(&side(b))).unwrap_or(0);
    // Both parts but the last end with a whole block.
    let middle = places.len().div_ceil(BLOCK) / 2 * BLOCK;
    places.select_nth_unstable_by(middle, |a, b| {
        a.at[axis].total_cmp(&b.at[axis]).then(a.id.cmp(&b.id))
    });
    let large = places.len() > SPLIT_MIN;
    let (near, far) = places.split_at_mut(middle);
    if large {
        rayon::join(|| split(near), || split(far));
    } else {
        split(near);
        split(far);
    }
}

/// Bounds of the Gaussians of a block.
fn bounds_of(places: &[Place], scales: &[[f32; 3]]) -> Bounds {
    let [low, high] = corners(places);
    let mut bounds = Bounds::default();
    for axis in 0..3 {
        let center = 0.5 * low[axis] + 0.5 * high[axis];
        bounds.center[axis] = center;
        // The middle is rounded: the box around it must hold both corners.
        bounds.half[axis] = (high[axis] - center).max(center - low[axis]).next_up();
    }
    let of = |place: &Place| scales[place.id as usize].into_iter().fold(0.0, f32::max);
    bounds.reach = places.iter().map(of).fold(0.0, f32::max);
    bounds
}

/// What a view shows of space: the planes beyond which no Gaussian touches the picture.
///
/// With t a centre in camera space, a Gaussian of the largest scale s (with what the view adds to
/// it) spreads over `(t.x / t.z) f + c ± K √(f² (1 + slope²) s² / t.z² + blur)` pixels at most,
/// where K is the extent of the faintest alpha that counts. Times t.z, and as √(a² + b²) ≤ a + b,
/// each side of the picture becomes a plane through the camera, moved outwards by a multiple of s.
#[derive(Clone, Copy, Debug)]
pub struct Frustum {
    /// Camera centre relative to the origin.
    pub(crate) center: DVec3,
    /// Inner normals of the planes at the left, right, top and bottom, world axes, and by how much
    /// a scale of 1 moves them.
    pub(crate) sides: [(DVec3, f64); 4],
    /// Axis of the camera.
    pub(crate) axis: DVec3,
    pub(crate) near: f64,
    /// A ball around the cameras of the photos of the view: middle and radius.
    pub(crate) photos: (DVec3, f64),
    /// What a magnified view adds to a scale at most, for each unit of the distance from a photo.
    pub(crate) widens: f64,
}

impl Frustum {
    /// The frustum of `request`, of which `view` is the camera.
    pub fn new(view: &View, request: &RenderRequest) -> Self {
        let extent =
            (2.0 * (f64::from(ALPHA_MIN.recip()).ln() + f64::from(FOOTPRINT_SLACK))).sqrt();
        let margin = extent * f64::from(BLUR_PX2).sqrt() + MARGIN_PX;
        let size = [view.width, view.height].map(f64::from);
        let side = |axis: usize, sign: f64| {
            let [focal, principal] = [view.focal[axis], view.principal[axis]];
            let inside = if sign > 0.0 { principal } else { size[axis] - principal };
            let slope = view.slope_min[axis].abs().max(view.slope_max[axis].abs());
            let normal =
                sign * view.rotation.row(axis) + (inside + margin) / focal * view.rotation.row(2);
            (normal, extent * slope.hypot(1.0) * REACH_SLACK)
        };
        let (photos, widens) = photos(&request.sources);
        Self {
            center: view.center,
            sides: [side(0, 1.0), side(0, -1.0), side(1, 1.0), side(1, -1.0)],
            axis: view.rotation.row(2),
            near: view.near,
            photos,
            widens,
        }
    }

    /// Whether the view may show a Gaussian within `bounds`. False only if no such Gaussian touches
    /// a tile of the picture.
    pub fn may_show(&self, bounds: &Bounds) -> bool {
        let [center, half] = [bounds.center, bounds.half].map(|v| DVec3::from(v.map(f64::from)));
        let from = center - self.center;
        let rounding = ROUNDING * (from.abs() + half);
        let largest = |normal: DVec3| normal.dot(from) + normal.abs().dot(half + rounding);
        let (ball, radius) = self.photos;
        let wider = (center.distance(ball) + half.length() + radius) * self.widens;
        let reach = f64::from(bounds.reach) + wider;
        // A comparison with a NaN does not leave out.
        let before = largest(self.axis) < self.near;
        let beside = |(normal, by): (DVec3, f64)| largest(normal) + by * reach < 0.0;
        !(before || self.sides.into_iter().any(beside))
    }
}

/// A ball around the cameras of photos, and the most that magnification adds to a scale at a
/// distance of 1 from one: with `w` the width of the source pixel there, √0.3 w.
fn photos(sources: &[Source]) -> ((DVec3, f64), f64) {
    let centers = || sources.iter().map(|source| DVec3::from(source.center.map(f64::from)));
    let middle = centers().sum::<DVec3>() / sources.len().max(1) as f64;
    let radius = centers().map(|center| center.distance(middle)).fold(0.0, f64::max);
    let width = |source: &Source| {
        f64::from(source.scale) * DVec3::from(source.axis.map(f64::from)).length()
    };
    let widest = sources.iter().map(width).fold(0.0, f64::max);
    ((middle, radius * REACH_SLACK), widest * f64::from(BLUR_PX2).sqrt() * REACH_SLACK)
}

/// From how many Gaussians on a scene has blocks.
pub(crate) fn blocks_from(switches: &Switches) -> usize {
    match Skip::Blocks.applies(switches.without()) {
        true => switches.blocks_min().unwrap_or(BLOCKS_MIN),
        false => usize::MAX,
    }
}

/// The blocks of the scenes that are drawn, as long as these live.
#[derive(Debug)]
pub(crate) struct BlockCache {
    from: usize,
    scenes: Mutex<Vec<CachedBlocks>>,
}

#[derive(Debug)]
struct CachedBlocks {
    /// [`Gaussians::shape_identity`].
    shape: u64,
    life: Weak<()>,
    /// `None` while they are made.
    blocks: Option<Arc<Blocks>>,
}

impl BlockCache {
    /// For scenes of at least `from` Gaussians.
    pub(crate) fn new(from: usize) -> Self {
        Self { from, scenes: Mutex::default() }
    }

    /// The blocks of a scene, made now if it is new. `None` where it has none, or while another
    /// thread makes them: a frame without them has the same pixels.
    pub(crate) fn get(&self, gaussians: &Gaussians) -> Option<Arc<Blocks>> {
        if gaussians.len() < self.from.max(1) {
            return None;
        }
        let shape = gaussians.shape_identity();
        {
            let mut scenes = self.scenes.lock();
            scenes.retain(|one| one.shape == shape || one.life.strong_count() > 0);
            if let Some(found) = scenes.iter_mut().find(|one| one.shape == shape) {
                // The same shape may live on with other entries.
                found.life = gaussians.life();
                return found.blocks.clone();
            }
            scenes.push(CachedBlocks { shape, life: gaussians.life(), blocks: None });
        }
        let blocks = Arc::new(Blocks::of(gaussians));
        let mut scenes = self.scenes.lock();
        if let Some(found) = scenes.iter_mut().find(|one| one.shape == shape) {
            found.blocks = Some(Arc::clone(&blocks));
        }
        Some(blocks)
    }
}
