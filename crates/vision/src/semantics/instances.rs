//! What a text selects in space: instances, each a connected set of Gaussians with its boxes.
//!
//! A text selects whole entries of the bank. So the connected components of the Gaussians of each
//! entry are found once for each scene, with the pairs of components that touch. An instance of a
//! text is made of components of the selected entries that touch each other.
//!
//! Two Gaussians touch when neighbouring pixels made them at nearly the same depth, or when they
//! are at most a few spacings apart. A spacing is the width of a pixel of the network's picture at
//! the Gaussian's depth, so near and far objects are joined alike.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::Views;
use crate::{
    point,
    scene::{Gaussians, SceneCamera, covariance, principal_axes},
};

/// How Gaussians are joined to instances.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct InstanceOptions {
    /// Gaussians touch if they are at most this many spacings apart.
    pub reach: f64,
    /// Neighbouring pixels of one photo touch under this relative difference of depth.
    pub same_depth: f64,
    /// Fewest Gaussians of an instance.
    pub count_min: usize,
    /// Smallest share of all selected Gaussians that an instance may have.
    pub share_min: f64,
    /// A box ends where its Gaussians get sparser, along an axis, than this share of the mean.
    pub sparse: f64,
    /// Share of those in between that a box leaves out on each side of each axis.
    pub trim: f64,
}

impl Default for InstanceOptions {
    fn default() -> Self {
        let (sparse, trim) = (0.05, 0.002);
        Self { reach: 4.0, same_depth: 0.02, count_min: 12, share_min: 0.02, sparse, trim }
    }
}

/// A box in the world, of any rotation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Box3 {
    /// Middle, world units.
    pub center: [f64; 3],
    /// Full lengths along the axes, world units.
    pub size: [f64; 3],
    /// Unit axes, one in each row, right-handed.
    pub axes: [[f64; 3]; 3],
}

/// Connected Gaussians of the entries that a text selects.
#[derive(Clone, Debug, PartialEq)]
pub struct Instance {
    /// Its Gaussians, ascending.
    pub gaussians: Vec<u32>,
    /// Mean centre of its Gaussians, world units.
    pub centroid: [f64; 3],
    /// Covariance of the mixture of its Gaussians, each counted once: the mean of their own and the
    /// spread of their centres. World units squared.
    pub covariance: [[f64; 3]; 3],
    /// `[V]` share of its Gaussians that each photo shows, 0..1.
    pub visibility: Vec<f32>,
    /// Its entries, ascending, each with how many of its Gaussians have it.
    pub entries: Vec<(u16, u32)>,
    /// Centres that boxes hold, relative to `origin`: those of its solid middle.
    means: Vec<DVec3>,
    origin: DVec3,
    /// Up of the scene.
    up: DVec3,
    /// [`InstanceOptions::trim`].
    trim: f64,
}

impl Instance {
    /// How well it fits a text, by the relevancy of each entry of the bank: that of its best entry,
    /// of those that a tenth of its Gaussians have. So an edge of another entry does not count.
    #[must_use]
    pub fn score(&self, relevancies: &[f32]) -> f32 {
        let total: u64 = self.entries.iter().map(|(_, count)| u64::from(*count)).sum();
        let large = self.entries.iter().filter(|(_, count)| 10 * u64::from(*count) >= total);
        let of = |(m, _): &(u16, u32)| relevancies.get(usize::from(*m)).copied().unwrap_or(0.0);
        large.map(of).fold(0.0, f32::max)
    }

    /// The box along the principal axes of the covariance, the longest first.
    #[must_use]
    pub fn oriented(&self) -> Box3 {
        let spread = DMat3::from_cols_array_2d(&self.covariance);
        let own = self.bounds(principal_axes(spread));
        boxed(longest_first(own), self.origin)
    }

    /// The box that stands upright, with the shortest way around it: its last axis is up, the
    /// others lie level, the longer first.
    #[must_use]
    pub fn upright(&self) -> Box3 {
        let mut own = self.bounds(upright_axes(&self.means, self.up));
        if length(&own[0]) < length(&own[1]) {
            own.swap(0, 1);
        }
        own[0] = facing(own[0]);
        // Right-handed, with up as it is.
        if own[0].0.cross(own[1].0).dot(self.up) < 0.0 {
            own[1] = turned(own[1]);
        }
        boxed(own, self.origin)
    }

    /// The box along the axes of the world.
    #[must_use]
    pub fn aligned(&self) -> Box3 {
        boxed(self.bounds([DVec3::X, DVec3::Y, DVec3::Z]), self.origin)
    }

    /// Bounds along three axes. The share `trim` is left out on each side.
    fn bounds(&self, axes: [DVec3; 3]) -> Bounds {
        axes.map(|axis| (axis, quantiles(&self.means, axis, self.trim)))
    }
}

/// The connected components of the Gaussians of each entry, and the pairs that touch.
#[derive(Clone, Debug, Default)]
pub struct Components {
    /// Entry of each component.
    entry: Vec<u16>,
    /// Gaussians of each component, ascending.
    members: Vec<Vec<u32>>,
    /// Pairs of different entries that touch: each pair once, the smaller number first.
    touching: Vec<[u32; 2]>,
    /// Up of the scene.
    up: DVec3,
    /// Photos of the scene.
    photos: usize,
    /// `[N * ⌈V / 64⌉]` a bit for each photo that shows a Gaussian with an entry.
    seen: Vec<u64>,
}

impl Components {
    /// The components of all Gaussians that have an entry.
    ///
    /// `cameras` are those of the scene. They give up, the spacing of the Gaussians of a surface,
    /// and which photo shows which of them.
    #[must_use]
    pub fn new(gaussians: &Gaussians, cameras: &[SceneCamera], options: &InstanceOptions) -> Self {
        let index = gaussians.semantic_index();
        let chosen: Vec<u32> =
            index.iter().zip(0_u32..).filter(|(m, _)| **m > 0).map(|(_, i)| i).collect();
        let sites = sites(gaussians, cameras, &chosen);
        let mut bonds = Bonds {
            entry: chosen.iter().map(|&i| index[i as usize]).collect(),
            sets: Sets::new(chosen.len()),
            across: Vec::new(),
        };
        join_pixels(&mut bonds, gaussians, &chosen, &sites, options.same_depth);
        join_cells(&mut bonds, &sites, options.reach);

        let mut components = Self {
            up: SceneCamera::level_up(cameras),
            photos: cameras.len(),
            seen: seen(gaussians, cameras),
            ..Self::default()
        };
        let mut component_of = vec![0_u32; chosen.len()];
        for (at, i) in chosen.iter().enumerate() {
            // The root is the smallest member, so it comes first.
            let root = bonds.sets.root(at) as usize;
            if root == at {
                component_of[at] = u32::try_from(components.entry.len()).unwrap_or(u32::MAX);
                components.entry.push(bonds.entry[at]);
                components.members.push(Vec::new());
            }
            component_of[at] = component_of[root];
            components.members[component_of[at] as usize].push(*i);
        }
        let component = |at: u32| component_of[at as usize];
        let across = bonds.across.into_iter().map(|[a, b]| [component(a), component(b)]);
        components.touching = across.map(|[a, b]| [a.min(b), a.max(b)]).collect();
        components.touching.sort_unstable();
        components.touching.dedup();
        components
    }

    /// Connected instances of the Gaussians of `entries`, the largest first, without the small
    /// ones. `gaussians` must be those that the components were made of.
    #[must_use]
    pub fn instances(
        &self,
        gaussians: &Gaussians,
        entries: &[u16],
        options: &InstanceOptions,
    ) -> Vec<Instance> {
        let chosen = |component: usize| entries.contains(&self.entry[component]);
        let mut sets = Sets::new(self.entry.len());
        for [a, b] in self.touching.iter().map(|pair| pair.map(|component| component as usize)) {
            if chosen(a) && chosen(b) {
                sets.join(a, b);
            }
        }
        let mut joined: FxHashMap<u32, Vec<usize>> = FxHashMap::default();
        let mut total = 0;
        for component in (0..self.entry.len()).filter(|component| chosen(*component)) {
            joined.entry(sets.root(component)).or_default().push(component);
            total += self.members[component].len();
        }
        let least = (options.share_min * total as f64).max(options.count_min as f64);
        let mut found: Vec<Vec<u32>> = joined
            .into_values()
            .map(|components| -> Vec<u32> {
                let members = components.into_iter().flat_map(|component| &self.members[component]);
                members.copied().collect()
            })
            .filter(|instance| instance.len() as f64 >= least)
            .collect();
        found.iter_mut().for_each(|instance| instance.sort_unstable());
        // Parts of one size are ordered by their first Gaussian, which is never shared.
        found
            .sort_by_key(|instance| (std::cmp::Reverse(instance.len()), instance.first().copied()));
        found.into_iter().map(|found| self.described(gaussians, found, options)).collect()
    }

    fn described(
        &self,
        gaussians: &Gaussians,
        of: Vec<u32>,
        options: &InstanceOptions,
    ) -> Instance {
        let means: Vec<DVec3> = of.iter().map(|&i| point(gaussians.means()[i as usize])).collect();
        let share = 1.0 / means.len() as f64;
        let middle = means.iter().sum::<DVec3>() * share;
        let mut spread = DMat3::ZERO;
        let (mut shown, words) = (vec![0_u32; self.photos], self.photos.div_ceil(64));
        for (mean, i) in means.iter().zip(of.iter().map(|&i| i as usize)) {
            let d = *mean - middle;
            spread += covariance(gaussians.quats()[i], gaussians.scales()[i]);
            spread += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
            for (v, shown) in shown.iter_mut().enumerate() {
                *shown += u32::from(self.seen[i * words + v / 64] >> (v % 64) & 1 == 1);
            }
        }
        #[expect(clippy::cast_possible_truncation, reason = "a share")]
        let visibility = shown.into_iter().map(|count| (f64::from(count) * share) as f32).collect();
        let opacity = |i: &u32| f64::from(gaussians.opacities()[*i as usize]);
        let weighted: Vec<Place> = means.into_iter().zip(of.iter().map(opacity)).collect();
        let mut entries: Vec<u16> =
            of.iter().map(|&i| gaussians.semantic_index()[i as usize]).collect();
        entries.sort_unstable();
        let count = |run: &[u16]| (run[0], u32::try_from(run.len()).unwrap_or(u32::MAX));
        let origin = gaussians.origin();
        Instance {
            centroid: (middle + origin).to_array(),
            covariance: (spread * share).to_cols_array_2d(),
            visibility,
            entries: entries.chunk_by(|a, b| a == b).map(count).collect(),
            means: solid(weighted, self.up, options.sparse),
            origin,
            up: self.up,
            trim: options.trim,
            gaussians: of,
        }
    }

    /// Pairs of different entries that touch: each pair once, the smaller entry first.
    #[must_use]
    pub fn touching_entries(&self) -> Vec<[u16; 2]> {
        let entries = |pair: &[u32; 2]| {
            let [a, b] = pair.map(|component| self.entry[component as usize]);
            [a.min(b), a.max(b)]
        };
        let mut pairs: Vec<[u16; 2]> = self.touching.iter().map(entries).collect();
        pairs.sort_unstable();
        pairs.dedup();
        pairs
    }

    /// Bytes in memory.
    #[must_use]
    pub fn size_bytes(&self) -> u64 {
        let members: usize = self.members.iter().map(Vec::len).sum();
        let each = size_of::<Vec<u32>>() + size_of::<u16>();
        (self.entry.len() * each + members * 4 + (self.touching.len() + self.seen.len()) * 8) as u64
    }
}

/// The pairs found so far, by place in the list of chosen Gaussians.
struct Bonds {
    entry: Vec<u16>,
    /// Gaussians of one entry that are joined.
    sets: Sets,
    /// Pairs of different entries that touch.
    across: Vec<[u32; 2]>,
}

impl Bonds {
    fn join(&mut self, a: usize, b: usize) {
        if self.entry[a] == self.entry[b] {
            self.sets.join(a, b);
        } else if let (Ok(a), Ok(b)) = (u32::try_from(a), u32::try_from(b)) {
            self.across.push([a, b]);
        }
    }
}

/// Place of a Gaussian, relative to the scene's origin.
struct Site {
    mean: DVec3,
    /// Depth in its source photo; 0 if unknown.
    depth: f64,
    /// Distance to its neighbours on the surface.
    spacing: f64,
}

fn sites(gaussians: &Gaussians, cameras: &[SceneCamera], chosen: &[u32]) -> Vec<Site> {
    chosen
        .par_iter()
        .map(|&i| {
            let i = i as usize;
            let mean = point(gaussians.means()[i]);
            let input = cameras.get(usize::from(gaussians.source()[i].view));
            let seen = input.and_then(|input| {
                let pose = &input.camera.camera_to_world;
                let depth = (mean + gaussians.origin() - pose.center()).dot(pose.axis());
                let lens = input.network?;
                (depth > 0.0).then_some((depth, depth / lens.fx.min(lens.fy)))
            });
            let widest = gaussians.scales()[i].into_iter().fold(0.0_f32, f32::max);
            let (depth, spacing) = seen.unwrap_or((0.0, f64::from(widest)));
            Site { mean, depth, spacing }
        })
        .collect()
}

/// Joins Gaussians of one photo if their pixels are at most two apart and their depths similar.
fn join_pixels(
    bonds: &mut Bonds,
    gaussians: &Gaussians,
    chosen: &[u32],
    sites: &[Site],
    same_depth: f64,
) {
    let pixel = |at: usize| {
        let source = gaussians.source()[chosen[at] as usize];
        (source.view, i32::from(source.x), i32::from(source.y))
    };
    let by_pixel: FxHashMap<(u16, i32, i32), usize> =
        (0..chosen.len()).map(|at| (pixel(at), at)).collect();
    for at in 0..chosen.len() {
        let (view, x, y) = pixel(at);
        let depth = sites[at].depth;
        // The pixels to the right and below. The others test this pixel.
        let ahead = (0..=2).flat_map(|dy| (-2..=2).map(move |dx| (dx, dy)));
        for (dx, dy) in ahead.filter(|&(dx, dy)| (dy, dx) > (0, 0)) {
            let Some(&other) = by_pixel.get(&(view, x + dx, y + dy)) else { continue };
            if depth > 0.0 && (sites[other].depth - depth).abs() <= same_depth * depth {
                bonds.join(at, other);
            }
        }
    }
}

/// Joins Gaussians at most `reach` spacings apart. Each power of two of the spacing has a grid.
fn join_cells(bonds: &mut Bonds, sites: &[Site], reach: f64) {
    // One Gaussian of each entry in each cell. All others of the entry are joined to it.
    let mut cells: FxHashMap<(i32, [i64; 3]), Vec<usize>> = FxHashMap::default();
    for (at, site) in sites.iter().enumerate() {
        if site.spacing <= 0.0 || !site.spacing.is_finite() {
            continue;
        }
        #[expect(clippy::cast_possible_truncation, reason = "a power of two of an f64")]
        let level = site.spacing.log2().ceil() as i32;
        // In its own grid, and in the next coarser one for Gaussians of wider spacing.
        for level in [level, level + 1] {
            let edge = reach * f64::from(level).exp2();
            #[expect(clippy::cast_possible_truncation, reason = "saturates far away")]
            let cell = (site.mean / edge).floor().to_array().map(|v| v as i64);
            let held = cells.entry((level, cell)).or_default();
            match held.iter().find(|&&other| bonds.entry[other] == bonds.entry[at]) {
                Some(&other) => bonds.join(at, other),
                None => held.push(at),
            }
        }
    }
    for ((level, [x, y, z]), held) in &cells {
        // The cell itself and half of its 26 neighbours. The other half tests this cell.
        for step in 13..27 {
            let by = [step % 3 - 1, step / 3 % 3 - 1, step / 9 - 1];
            let next = [x.saturating_add(by[0]), y.saturating_add(by[1]), z.saturating_add(by[2])];
            let Some(others) = cells.get(&(*level, next)) else { continue };
            for a in held {
                others.iter().for_each(|b| bonds.join(*a, *b));
            }
        }
    }
}

/// [`Components::seen`].
fn seen(gaussians: &Gaussians, cameras: &[SceneCamera]) -> Vec<u64> {
    let words = cameras.len().div_ceil(64);
    let mut bits = vec![0; gaussians.len() * words];
    let views = Views::new(gaussians, cameras);
    let of = gaussians.semantic_index();
    let each = bits.par_chunks_mut(words.max(1)).enumerate().filter(|(i, _)| of[*i] > 0);
    each.for_each(|(i, bits)| {
        let photos = views.show(i).enumerate().filter(|(_, shown)| *shown);
        photos.for_each(|(v, _)| bits[v / 64] |= 1 << (v % 64));
    });
    bits
}

/// A centre and the opacity there.
type Place = (DVec3, f64);

/// Most places by which ends and axes are looked for; evenly spread over all.
const SAMPLES: usize = 8192;
/// Share of the places on each side that says nothing of the way around a box.
const AROUND_TRIM: f64 = 0.01;

/// The centres between the ends along the axes of the smallest upright box, found twice: the
/// second time without what was beyond the ends.
///
/// A network puts some pixels of an edge between a thing and what is behind it, and masks take some
/// pixels of that. So a few per cent of the Gaussians of a mug lie up to the wall.
fn solid(mut places: Vec<Place>, up: DVec3, sparse: f64) -> Vec<DVec3> {
    for _ in 0..2 {
        let sample: Vec<Place> =
            places.iter().step_by(places.len().div_ceil(SAMPLES).max(1)).copied().collect();
        let centres: Vec<DVec3> = sample.iter().map(|(at, _)| *at).collect();
        let axes = upright_axes(&centres, up);
        let ends = axes.map(|axis| {
            let along = sample.iter().map(|(at, opacity)| (at.dot(axis), *opacity));
            ends(along.collect(), sparse)
        });
        let inside = |at: DVec3| {
            let mut each = axes.iter().zip(ends);
            each.all(|(axis, [from, to])| (from..=to).contains(&at.dot(*axis)))
        };
        places.retain(|(at, _)| inside(*at));
    }
    places.into_iter().map(|(at, _)| at).collect()
}

/// The two ends of places on a line, each with a weight: the part with the largest share of the
/// weight, less `sparse` times its length. Lengths are in those of 80 % of the weight, as if all of
/// it lay so. A far part is in it only where it holds more than what the way there costs.
fn ends(mut along: Vec<(f64, f64)>, sparse: f64) -> [f64; 2] {
    along.sort_by(|a, b| a.0.total_cmp(&b.0));
    let total: f64 = along.iter().map(|(_, weight)| weight).sum();
    let at = |share: f64| {
        let mut sum = 0.0;
        let passes = |(_, weight): &&(f64, f64)| {
            sum += weight;
            sum >= share * total
        };
        along.iter().find(passes).or(along.last()).map_or(0.0, |(place, _)| *place)
    };
    let length = (at(0.9) - at(0.1)) / 0.8;
    let all = along.first().zip(along.last()).map_or([0.0; 2], |(a, b)| [a.0, b.0]);
    if length <= 0.0 || total <= 0.0 {
        return all;
    }
    let (mut sum, mut least, mut from) = (0.0, f64::INFINITY, 0.0);
    let (mut best, mut found) = (f64::NEG_INFINITY, all);
    for (place, weight) in along {
        let cost = sparse * place / length;
        if sum - cost < least {
            (least, from) = (sum - cost, place);
        }
        sum += weight / total;
        if sum - cost - least > best {
            (best, found) = (sum - cost - least, [from, place]);
        }
    }
    found
}

/// Axes of the upright box with the shortest way around it; up is the last. Photos often see two
/// sides of a thing, which the box that covers the least ground may lie across.
fn upright_axes(centres: &[DVec3], up: DVec3) -> [DVec3; 3] {
    let (a, b) = up.any_orthonormal_pair();
    let every = centres.len().div_ceil(SAMPLES).max(1);
    let sample: Vec<DVec3> = centres.iter().step_by(every).copied().collect();
    let level = |degrees: f64| {
        let (sin, cos) = degrees.to_radians().sin_cos();
        [cos * a + sin * b, cos * b - sin * a]
    };
    let around = |degrees: f64| -> f64 {
        let sides = level(degrees).map(|axis| quantiles(&sample, axis, AROUND_TRIM));
        sides.map(|[from, to]| to - from).iter().sum()
    };
    let better = |best: (f64, f64), degrees: f64| {
        let around = around(degrees);
        if around < best.1 { (degrees, around) } else { best }
    };
    let coarse = (0..45).map(|step| f64::from(step) * 2.0);
    let mut best = coarse.fold((0.0, f64::INFINITY), better);
    for step in (0..8).map(|halved| f64::from(1 << halved).recip()) {
        let near = [best.0 - step, best.0 + step];
        best = near.into_iter().fold(best, better);
    }
    let [first, second] = level(best.0);
    [first, second, up]
}

/// The places along an axis between which all but the share `trim` on each side lie.
fn quantiles(centres: &[DVec3], axis: DVec3, trim: f64) -> [f64; 2] {
    let mut along: Vec<f64> = centres.iter().map(|mean| mean.dot(axis)).collect();
    let Some(end) = along.len().checked_sub(1) else { return [0.0; 2] };
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share")]
    let out = (trim.clamp(0.0, 0.49) * along.len() as f64) as usize;
    let least = *along.select_nth_unstable_by(out, f64::total_cmp).1;
    [least, *along.select_nth_unstable_by(end - out, f64::total_cmp).1]
}

/// An axis, with the smallest and the largest place along it.
type Bound = (DVec3, [f64; 2]);

/// Three of them, orthonormal.
type Bounds = [Bound; 3];

/// Axes sorted by length, right-handed. The largest number of each axis is positive.
fn longest_first(mut bounds: Bounds) -> Bounds {
    bounds.sort_by(|a, b| length(b).total_cmp(&length(a)));
    bounds[0] = facing(bounds[0]);
    bounds[1] = facing(bounds[1]);
    if bounds[0].0.cross(bounds[1].0).dot(bounds[2].0) < 0.0 {
        bounds[2] = turned(bounds[2]);
    }
    bounds
}

/// Bounds along the same line, whose direction has a positive largest number.
fn facing(bound: Bound) -> Bound {
    let largest = bound.0.to_array().into_iter().max_by(|a, b| a.abs().total_cmp(&b.abs()));
    if largest.is_some_and(|v| v < 0.0) { turned(bound) } else { bound }
}

fn turned((axis, [from, to]): Bound) -> Bound {
    (-axis, [-to, -from])
}

fn length((_, [from, to]): &Bound) -> f64 {
    to - from
}

fn boxed(bounds: Bounds, origin: DVec3) -> Box3 {
    let center: DVec3 = bounds.iter().map(|(axis, [a, b])| *axis * (0.5 * (a + b))).sum();
    Box3 {
        center: (center + origin).to_array(),
        size: bounds.map(|(_, [a, b])| b - a),
        axes: bounds.map(|(axis, _)| axis.to_array()),
    }
}

/// Disjoint sets; the root of each is its smallest member.
struct Sets(Vec<u32>);

impl Sets {
    fn new(count: usize) -> Self {
        Self((0..u32::try_from(count).unwrap_or(u32::MAX)).collect())
    }

    fn root(&mut self, of: usize) -> u32 {
        let mut at = of;
        while self.0[at] as usize != at {
            let above = self.0[self.0[at] as usize];
            self.0[at] = above;
            at = above as usize;
        }
        self.0[at]
    }

    fn join(&mut self, a: usize, b: usize) {
        let (a, b) = (self.root(a), self.root(b));
        self.0[a.max(b) as usize] = a.min(b);
    }
}
