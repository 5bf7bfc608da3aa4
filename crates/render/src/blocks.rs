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
//!
//! A view with a permission for it ([`RenderRequest::detail`]) has merged Gaussians in place of
//! those of blocks that are far away ([`crate::merged`]). They have blocks of their own, a tree
//! over those of the scene: [`Blocks::detailed`] makes it, and [`Frustum::is_fine`] is the test.

use std::{
    ops::Range,
    sync::{Arc, Weak},
};

use glam::DVec3;
use parking_lot::Mutex;
use rayon::prelude::*;

use crate::{
    RenderRequest, Source,
    constants::{ALPHA_MIN, BLUR_PX2, FOOTPRINT_SLACK},
    error::Result,
    merged::{Merged, Merger, Part},
    places::{Place, corners, split},
    scene::Gaussians,
    switches::{Skip, Switches},
    view::View,
};

/// Gaussians of a block: a workgroup of the kernels.
pub const BLOCK: usize = 256;
/// Gaussians from which a scene has blocks: for fewer a view costs less than the test saves.
pub const BLOCKS_MIN: usize = 1 << 18;
/// Rounding of the test, as a share of the numbers in it: over that of f32 on a device.
pub(crate) const ROUNDING: f64 = 1e-5;
/// Share by which reaches are taken larger, and pixels around the picture: over the slack of
/// `shaders/common/tiles.wgsl`.
const REACH_SLACK: f64 = 1.0001;
const MARGIN_PX: f64 = 1.0;

/// No Gaussian, in the last places of a block that has fewer than [`BLOCK`]; no block.
pub const NONE: u32 = u32::MAX;

/// Where the Gaussians of a block are, and how far they reach.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bounds {
    /// Middle of the box of the centres, relative to the origin: also of those of all Gaussians
    /// that are merged in this block.
    pub center: [f32; 3],
    /// Half the sides of the box.
    pub half: [f32; 3],
    /// Largest scale.
    pub reach: f32,
    /// How far a Gaussian of the scene is at most from the one that stands for it here, world
    /// units: see [`crate::merged`]. Under 0: they are the scene's own.
    pub error: f32,
    /// The block of merged Gaussians that stands for this one and its neighbours, or [`NONE`].
    pub parent: u32,
}

impl Default for Bounds {
    fn default() -> Self {
        let [center, half] = [[0.0; 3]; 2];
        Self { center, half, reach: 0.0, error: -1.0, parent: NONE }
    }
}

/// The blocks of a scene: 4.2 bytes a Gaussian.
#[derive(Debug)]
pub struct Blocks {
    /// Gaussians, block after block of [`BLOCK`]; those of a block ascend, and [`NONE`] fills the
    /// last one. Those that are merged count on after the scene's own.
    pub order: Vec<u32>,
    /// Of each block.
    pub bounds: Vec<Bounds>,
    /// Number of blocks of the scene's own Gaussians, which come first.
    pub own: usize,
    /// The merged Gaussians, where there are some.
    pub merged: Option<Arc<Merged>>,
}

impl Blocks {
    /// The blocks of a scene; the same ones for any number of threads. Takes 16 bytes a Gaussian
    /// while it runs.
    pub fn of(gaussians: &Gaussians) -> Self {
        let means = gaussians.means().par_iter().enumerate();
        let mut places: Vec<Place> = means.map(|(id, &at)| Place { at, id: id as u32 }).collect();
        split(&mut places, BLOCK);
        let scales = gaussians.scales();
        let bounds: Vec<_> =
            places.par_chunks(BLOCK).map(|block| bounds_of(block, scales)).collect();
        let mut order: Vec<u32> = places.par_iter().map(|place| place.id).collect();
        order.resize(bounds.len() * BLOCK, NONE);
        Self { order, own: bounds.len(), bounds, merged: None }
    }

    /// The same with merged Gaussians, layer upon layer: those of a block and its neighbours are
    /// the next block, until there is one.
    ///
    /// # Errors
    /// `internal` where merged Gaussians are not Gaussians any more.
    pub fn detailed(gaussians: &Gaussians) -> Result<Self> {
        Self::detailed_unless(gaussians, &|| Ok(()))
    }

    /// As [`Self::detailed`], until `unless` fails.
    ///
    /// # Errors
    /// As there, and as `unless`, which is asked block by block.
    pub fn detailed_unless(
        gaussians: &Gaussians,
        unless: &(dyn Fn() -> Result<()> + Sync),
    ) -> Result<Self> {
        let mut blocks = Self::of(gaussians);
        let mut merger = Merger::new(gaussians);
        let mut below = 0;
        while blocks.bounds.len() - below > 1 {
            let first = blocks.bounds.len();
            let of_block = |at: usize| unless().map(|()| merger.merge(blocks.ids(at)));
            let parts: Vec<Part> =
                (below..first).into_par_iter().map(of_block).collect::<Result<_>>()?;
            // The blocks whose merged Gaussians fill one.
            let mut children = below;
            while children < first {
                let (mut held, mut next) = (0, children);
                while next < first && held + parts[next - below].len() <= BLOCK {
                    held += parts[next - below].len();
                    next += 1;
                }
                let parts = &parts[children - below..next - below];
                blocks.add(children..next, parts, merger.next_id());
                parts.iter().for_each(|part| merger.take(part));
                children = next;
            }
            below = first;
        }
        blocks.merged = Some(Arc::new(merger.finish()?));
        Ok(blocks)
    }

    /// Adds the block that stands for `children`, whose merged Gaussians are `parts` and count from
    /// `first_id` on.
    fn add(&mut self, children: Range<usize>, parts: &[Part], first_id: u32) {
        let (mut low, mut high) = (DVec3::INFINITY, DVec3::NEG_INFINITY);
        let parent = self.bounds.len() as u32;
        for child in &mut self.bounds[children] {
            child.parent = parent;
            let [center, half] = [child.center, child.half].map(|v| DVec3::from(v.map(f64::from)));
            (low, high) = (low.min(center - half), high.max(center + half));
        }
        let reach = parts.iter().map(Part::reach).fold(0.0, f32::max);
        let error = parts.iter().map(Part::error).fold(0.0, f32::max);
        self.bounds.push(Bounds { reach, error, ..bounds_around(low, high) });
        let count = parts.iter().map(Part::len).sum::<usize>() as u32;
        self.order.extend(first_id..first_id + count);
        self.order.resize(self.bounds.len() * BLOCK, NONE);
    }

    /// The Gaussians of block `at`, ascending.
    pub fn ids(&self, at: usize) -> &[u32] {
        let ids = &self.order[at * BLOCK..(at + 1) * BLOCK];
        &ids[..ids.partition_point(|&id| id != NONE)]
    }

    /// The blocks that the view shows, ascending.
    pub fn shown(&self, frustum: &Frustum) -> Vec<u32> {
        let all = (0..self.bounds.len() as u32).into_par_iter().with_min_len(1 << 9);
        all.filter(|&at| self.is_shown(at as usize, frustum)).collect()
    }

    /// The scene's own Gaussians of the blocks that the view shows, ascending.
    pub fn near(&self, frustum: &Frustum) -> Vec<u32> {
        let shown = (0..self.own).filter(|&at| frustum.may_show(&self.bounds[at]));
        let mut ids: Vec<u32> = shown.flat_map(|at| self.ids(at)).copied().collect();
        ids.sort_unstable();
        ids
    }

    /// Whether the view shows block `at`: it may touch the picture and is fine enough, and the
    /// block that stands for it is not. Of each Gaussian one block of those that it is merged in is
    /// shown, or none where that cannot touch the picture.
    pub fn is_shown(&self, at: usize, frustum: &Frustum) -> bool {
        let bounds = &self.bounds[at];
        let parent = self.bounds.get(bounds.parent as usize);
        frustum.is_fine(bounds)
            && !parent.is_some_and(|parent| frustum.is_fine(parent))
            && frustum.may_show(bounds)
    }
}

/// Bounds of the Gaussians of a block.
fn bounds_of(places: &[Place], scales: &[[f32; 3]]) -> Bounds {
    let of = |place: &Place| scales[place.id as usize].into_iter().fold(0.0, f32::max);
    let reach = places.iter().map(of).fold(0.0, f32::max);
    let [low, high] = corners(places).map(|corner| DVec3::from(corner.map(f64::from)));
    Bounds { reach, ..bounds_around(low, high) }
}

/// A box that holds both corners. Its middle is rounded, and so is what is between.
fn bounds_around(low: DVec3, high: DVec3) -> Bounds {
    let center = (0.5 * (low + high)).as_vec3();
    let middle = center.as_dvec3();
    let half = (high - middle).max(middle - low).as_vec3().to_array().map(f32::next_up);
    Bounds { center: center.to_array(), half, ..Bounds::default() }
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
    /// How far a Gaussian may be from the one that stands for it, for each unit of depth.
    pub(crate) detail: f64,
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
            detail: f64::from(request.detail) / view.pixels_per_step(),
        }
    }

    /// That of what is within `by` pixels of a place of the picture, or beside the picture.
    pub fn around(view: &View, request: &RenderRequest, at: [f64; 2], by: f64) -> Self {
        let low = at.map(|at| (at - by).floor());
        let [width, height] = [0, 1].map(|k| ((at[k] + by).ceil() - low[k]) as u32);
        let principal = [0, 1].map(|k| view.principal[k] - low[k]);
        Self::new(&View { principal, width, height, ..*view }, request)
    }

    /// Whether the Gaussians of a block may be drawn in place of those that they stand for: they
    /// are the scene's own, or no nearer than the near plane and so far away that what they differ
    /// by is under [`RenderRequest::detail`] pixels everywhere. A parent never is fine where its
    /// child is not: it holds the child's box, and its error is larger.
    pub fn is_fine(&self, bounds: &Bounds) -> bool {
        let [center, half] = [bounds.center, bounds.half].map(|v| DVec3::from(v.map(f64::from)));
        let from = center - self.center;
        let rounding = ROUNDING * (from.abs() + half);
        let nearest = self.axis.dot(from) - self.axis.abs().dot(half + rounding);
        let error = f64::from(bounds.error);
        error < 0.0 || (nearest >= self.near && error < self.detail * nearest)
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
    /// Whether they are to have merged Gaussians.
    detailed: bool,
    life: Weak<()>,
    /// `None` while they are made.
    blocks: Option<Arc<Blocks>>,
}

impl BlockCache {
    /// For scenes of at least `from` Gaussians.
    pub(crate) fn new(from: usize) -> Self {
        Self { from, scenes: Mutex::default() }
    }

    /// The blocks of a scene, made now if it is new; if `detailed`, with merged Gaussians. `None`
    /// where it has none, or while another thread makes them: a frame without them has the same
    /// pixels, or differs less than is permitted.
    ///
    /// # Errors
    /// As [`Blocks::detailed`].
    pub(crate) fn get(&self, gaussians: &Gaussians, detailed: bool) -> Result<Option<Arc<Blocks>>> {
        if gaussians.len() < self.from.max(1) {
            return Ok(None);
        }
        let shape = gaussians.shape_identity();
        let is_it = |one: &CachedBlocks| one.shape == shape && one.detailed == detailed;
        {
            let mut scenes = self.scenes.lock();
            scenes.retain(|one| one.shape == shape || one.life.strong_count() > 0);
            if let Some(found) = scenes.iter_mut().find(|one| is_it(one)) {
                // The same shape may live on with other entries.
                found.life = gaussians.life();
                return Ok(found.blocks.clone());
            }
            let life = gaussians.life();
            scenes.push(CachedBlocks { shape, detailed, life, blocks: None });
        }
        let made = match detailed {
            true => Blocks::detailed(gaussians),
            false => Ok(Blocks::of(gaussians)),
        };
        let mut scenes = self.scenes.lock();
        let blocks = match made {
            Ok(blocks) => Arc::new(blocks),
            Err(error) => {
                scenes.retain(|one| !is_it(one));
                return Err(error);
            }
        };
        if let Some(found) = scenes.iter_mut().find(|one| is_it(one)) {
            found.blocks = Some(Arc::clone(&blocks));
        }
        Ok(Some(blocks))
    }
}
