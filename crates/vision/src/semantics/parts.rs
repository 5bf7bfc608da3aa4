//! What a text selects in space: connected parts of Gaussians, each with its boxes.
//!
//! A text selects whole entries of the bank. So the Gaussians of each entry are joined to connected
//! pieces once for each scene, and the pairs of pieces that touch are kept. The parts of a text are
//! joined from these pieces.
//!
//! Two Gaussians touch when neighbouring pixels made them at nearly the same depth, or when they
//! are at most a few spacings apart. A spacing is the width of a pixel of the network's picture at
//! the Gaussian's depth, so near and far objects are joined alike.

use glam::{DMat3, DVec3};
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use crate::scene::{Gaussians, SceneCamera, principal_axes};

/// How Gaussians are joined to parts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PartOptions {
    /// Gaussians touch if they are at most this many spacings apart.
    pub reach: f64,
    /// Neighbouring pixels of one photo touch under this relative difference of depth.
    pub same_depth: f64,
    /// Fewest Gaussians of a part.
    pub count_min: usize,
    /// Smallest share of all selected Gaussians that a part may have.
    pub share_min: f64,
    /// Share of a part's Gaussians that a box leaves out on each side of each axis.
    pub trim: f64,
}

impl Default for PartOptions {
    fn default() -> Self {
        Self { reach: 4.0, same_depth: 0.02, count_min: 12, share_min: 0.02, trim: 0.005 }
    }
}

/// A box in the world, of any rotation.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Box3 {
    /// Middle, world units.
    pub center: [f64; 3],
    /// Full lengths along the axes, world units.
    pub size: [f64; 3],
    /// Unit axes, one in each row, right-handed. An aligned box has those of the world.
    pub axes: [[f64; 3]; 3],
}

/// One connected part.
#[derive(Clone, Debug, PartialEq)]
pub struct Part {
    /// Its Gaussians, ascending.
    pub gaussians: Vec<u32>,
    /// Mean centre of its Gaussians, world units.
    pub centroid: [f64; 3],
    /// Box along its own principal axes, the longest first.
    pub oriented: Box3,
    /// Box along the world's axes.
    pub aligned: Box3,
}

/// The connected pieces of the Gaussians of each entry, and the pairs of pieces that touch.
#[derive(Clone, Debug, Default)]
pub struct Pieces {
    /// Entry of each piece.
    entry: Vec<u16>,
    /// Gaussians of each piece, ascending.
    members: Vec<Vec<u32>>,
    /// Pairs of pieces of different entries that touch: each pair once, the smaller number first.
    touching: Vec<[u32; 2]>,
}

impl Pieces {
    /// The pieces of all Gaussians that have an entry.
    ///
    /// `cameras` are those of the scene. They give the spacing of the Gaussians of a surface.
    #[must_use]
    pub fn new(gaussians: &Gaussians, cameras: &[SceneCamera], options: &PartOptions) -> Self {
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

        let mut pieces = Self::default();
        let mut piece_of = vec![0_u32; chosen.len()];
        for (at, i) in chosen.iter().enumerate() {
            // The root is the smallest member, so it comes first.
            let root = bonds.sets.root(at) as usize;
            if root == at {
                piece_of[at] = u32::try_from(pieces.entry.len()).unwrap_or(u32::MAX);
                pieces.entry.push(bonds.entry[at]);
                pieces.members.push(Vec::new());
            }
            piece_of[at] = piece_of[root];
            pieces.members[piece_of[at] as usize].push(*i);
        }
        let piece = |at: u32| piece_of[at as usize];
        let across = bonds.across.into_iter().map(|[a, b]| [piece(a), piece(b)]);
        pieces.touching = across.map(|[a, b]| [a.min(b), a.max(b)]).collect();
        pieces.touching.sort_unstable();
        pieces.touching.dedup();
        pieces
    }

    /// Connected parts of the Gaussians of `entries`, the largest first, without the small ones.
    /// `gaussians` must be those that the pieces were made of.
    #[must_use]
    pub fn parts(
        &self,
        gaussians: &Gaussians,
        entries: &[u16],
        options: &PartOptions,
    ) -> Vec<Part> {
        let chosen = |piece: usize| entries.contains(&self.entry[piece]);
        let mut sets = Sets::new(self.entry.len());
        for [a, b] in self.touching.iter().map(|pair| pair.map(|piece| piece as usize)) {
            if chosen(a) && chosen(b) {
                sets.join(a, b);
            }
        }
        let mut joined: FxHashMap<u32, Vec<usize>> = FxHashMap::default();
        let mut total = 0;
        for piece in (0..self.entry.len()).filter(|piece| chosen(*piece)) {
            joined.entry(sets.root(piece)).or_default().push(piece);
            total += self.members[piece].len();
        }
        let least = (options.share_min * total as f64).max(options.count_min as f64);
        let mut found: Vec<Vec<u32>> = joined
            .into_values()
            .map(|pieces| -> Vec<u32> {
                let members = pieces.into_iter().flat_map(|piece| &self.members[piece]);
                members.copied().collect()
            })
            .filter(|part| part.len() as f64 >= least)
            .collect();
        found.iter_mut().for_each(|part| part.sort_unstable());
        // Parts of one size are ordered by their first Gaussian, which is never shared.
        found.sort_by_key(|part| (std::cmp::Reverse(part.len()), part.first().copied()));
        found.into_iter().map(|part| describe(gaussians, part, options.trim)).collect()
    }

    /// Bytes in memory.
    #[must_use]
    pub fn size_bytes(&self) -> u64 {
        let members: usize = self.members.iter().map(Vec::len).sum();
        let each = size_of::<Vec<u32>>() + size_of::<u16>();
        (self.entry.len() * each + members * 4 + self.touching.len() * 8) as u64
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
            let mean = DVec3::from_array(gaussians.means()[i].map(f64::from));
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
    const AHEAD: [(i32, i32); 12] = [
        (1, 0),
        (2, 0),
        (-2, 1),
        (-1, 1),
        (0, 1),
        (1, 1),
        (2, 1),
        (-2, 2),
        (-1, 2),
        (0, 2),
        (1, 2),
        (2, 2),
    ];
    let pixel = |at: usize| {
        let source = gaussians.source()[chosen[at] as usize];
        (source.view, i32::from(source.x), i32::from(source.y))
    };
    let by_pixel: FxHashMap<(u16, i32, i32), usize> =
        (0..chosen.len()).map(|at| (pixel(at), at)).collect();
    for at in 0..chosen.len() {
        let (view, x, y) = pixel(at);
        let depth = sites[at].depth;
        for (dx, dy) in AHEAD {
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

fn describe(gaussians: &Gaussians, part: Vec<u32>, trim: f64) -> Part {
    let means: Vec<DVec3> = part
        .iter()
        .map(|&i| DVec3::from_array(gaussians.means()[i as usize].map(f64::from)))
        .collect();
    let count = means.len().max(1) as f64;
    let middle = means.iter().sum::<DVec3>() / count;
    let mut spread = DMat3::ZERO;
    for mean in &means {
        let d = *mean - middle;
        spread += DMat3::from_cols(d * d.x, d * d.y, d * d.z);
    }
    let origin = gaussians.origin();
    let own = bounds(&means, principal_axes(spread * (1.0 / count)), trim);
    Part {
        centroid: (middle + origin).to_array(),
        oriented: boxed(longest_first(own), origin),
        aligned: boxed(bounds(&means, [DVec3::X, DVec3::Y, DVec3::Z], trim), origin),
        gaussians: part,
    }
}

/// Axes, with the smallest and the largest place along each.
type Bounds = [(DVec3, [f64; 2]); 3];

/// Bounds along three axes. The share `trim` is left out on each side.
fn bounds(means: &[DVec3], axes: [DVec3; 3], trim: f64) -> Bounds {
    axes.map(|axis| {
        let mut along: Vec<f64> = means.iter().map(|mean| mean.dot(axis)).collect();
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share")]
        let out = (trim.clamp(0.0, 0.49) * along.len() as f64) as usize;
        let last = along.len() - 1 - out;
        let least = *along.select_nth_unstable_by(out, f64::total_cmp).1;
        (axis, [least, *along.select_nth_unstable_by(last, f64::total_cmp).1])
    })
}

/// Axes sorted by length, right-handed. The largest number of each axis is positive.
fn longest_first(mut bounds: Bounds) -> Bounds {
    bounds.sort_by(|(_, a), (_, b)| (b[1] - b[0]).total_cmp(&(a[1] - a[0])));
    let turned = |(axis, [from, to]): (DVec3, [f64; 2])| (-axis, [-to, -from]);
    for bound in &mut bounds[..2] {
        let numbers = bound.0.to_array();
        let largest = numbers.into_iter().max_by(|a, b| a.abs().total_cmp(&b.abs()));
        if largest.is_some_and(|v| v < 0.0) {
            *bound = turned(*bound);
        }
    }
    if bounds[0].0.cross(bounds[1].0).dot(bounds[2].0) < 0.0 {
        bounds[2] = turned(bounds[2]);
    }
    bounds
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Camera, CameraToWorld, Intrinsics, RawGaussians, SourcePixel};

    const ORIGIN: DVec3 = DVec3::new(1000.0, -50.0, 3.0);

    fn cameras(count: usize) -> Vec<SceneCamera> {
        let lens = Intrinsics { fx: 100.0, fy: 100.0, cx: 50.0, cy: 50.0, width: 100, height: 100 };
        let pose = |i: usize| {
            let x = ORIGIN.x + i as f64;
            let m = [1., 0., 0., x, 0., 1., 0., ORIGIN.y, 0., 0., 1., ORIGIN.z];
            let m = [&m[..], &[0., 0., 0., 1.]].concat();
            CameraToWorld::from_row_major(&m.try_into().unwrap(), "test").unwrap()
        };
        let camera = |i| Camera { intrinsics: lens, camera_to_world: pose(i) };
        let input = |i| SceneCamera { file: String::new(), camera: camera(i), network: Some(lens) };
        (0..count).map(input).collect()
    }

    fn gaussians(at: &[(DVec3, SourcePixel)]) -> Gaussians {
        let n = at.len();
        let raw = RawGaussians {
            origin: ORIGIN,
            means: at.iter().map(|(mean, _)| mean.as_vec3().to_array()).collect(),
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: vec![[0.01; 3]; n],
            opacities: vec![0.9; n],
            sh: vec![[0.0; 3]; n],
            semantic_index: vec![1; n],
            source: at.iter().map(|(_, source)| *source).collect(),
            ..RawGaussians::default()
        };
        Gaussians::sanitize(raw).unwrap().0
    }

    /// What camera `view` sees as columns `x`, rows `y` of a plane at depth `z`.
    fn patch(
        view: u16,
        x: std::ops::Range<u16>,
        y: std::ops::Range<u16>,
        z: f64,
    ) -> Vec<(DVec3, SourcePixel)> {
        let one = |x: u16, y: u16| {
            let ray = |v: u16| (f64::from(v) + 0.5 - 50.0) / 100.0 * z;
            (DVec3::new(ray(x) + f64::from(view), ray(y), z), SourcePixel { view, x, y })
        };
        y.flat_map(|y| x.clone().map(move |x| one(x, y))).collect()
    }

    /// Parts of all Gaussians of entry 1.
    fn parts(of: &Gaussians, cameras: &[SceneCamera], options: &PartOptions) -> Vec<Part> {
        Pieces::new(of, cameras, options).parts(of, &[1], options)
    }

    #[test]
    fn things_apart_are_two_parts_and_the_largest_comes_first() {
        let sites = [patch(0, 0..10, 0..10, 4.0), patch(0, 40..60, 0..10, 4.0)].concat();
        let scene = gaussians(&sites);
        let found = parts(&scene, &cameras(1), &PartOptions::default());
        let sizes: Vec<usize> = found.iter().map(|part| part.gaussians.len()).collect();
        assert_eq!(sizes, [200, 100]);
        assert_eq!(found[1].gaussians[..3], [0, 1, 2]);
    }

    #[test]
    fn one_surface_seen_by_two_photos_is_one_part() {
        // View 1 stands one unit to the right: its patch continues that of view 0.
        let sites = [patch(0, 50..75, 40..60, 4.0), patch(1, 50..75, 40..60, 4.08)].concat();
        let scene = gaussians(&sites);
        let found = parts(&scene, &cameras(2), &PartOptions::default());
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].gaussians.len(), 1000);
    }

    #[test]
    fn near_and_far_things_are_joined_alike_and_a_step_in_depth_parts() {
        let sites = [patch(0, 0..20, 0..20, 0.5), patch(0, 20..40, 0..20, 50.0)].concat();
        let scene = gaussians(&sites);
        let found = parts(&scene, &cameras(1), &PartOptions::default());
        assert_eq!(found.len(), 2, "neighbouring pixels, far apart in depth");
        assert!(found.iter().all(|part| part.gaussians.len() == 400));
    }

    #[test]
    fn specks_are_left_out() {
        let sites = [patch(0, 0..30, 0..30, 4.0), patch(0, 80..83, 80..83, 4.0)].concat();
        let scene = gaussians(&sites);
        let found = parts(&scene, &cameras(1), &PartOptions::default());
        assert_eq!(found.len(), 1);
        let fine = PartOptions { count_min: 1, share_min: 0.0, ..PartOptions::default() };
        assert_eq!(parts(&scene, &cameras(1), &fine).len(), 2);
        let pieces = Pieces::new(&scene, &cameras(1), &fine);
        assert!(pieces.parts(&scene, &[], &fine).is_empty());
        assert!(pieces.parts(&scene, &[7], &fine).is_empty(), "no such entry");
    }

    #[test]
    fn parts_of_some_entries_are_those_of_their_gaussians_alone() {
        // Stripes of three entries across one plane, a hole between, and a far thing of entry 2.
        let sites = [
            patch(0, 0..60, 0..20, 4.0),
            patch(1, 10..40, 30..60, 4.1),
            patch(0, 70..90, 70..90, 9.0),
        ]
        .concat();
        let stripe = |i: usize| 1 + (i % 60 / 7) as u16 % 3;
        let entry = |i: usize| if i < 1200 { stripe(i) } else { 2 + (i / 1500) as u16 % 2 };
        let index: Vec<u16> = (0..sites.len()).map(entry).collect();
        let scene = gaussians(&sites).with_semantic_index(index.clone()).unwrap();
        let options = PartOptions { count_min: 1, share_min: 0.0, ..PartOptions::default() };
        let pieces = Pieces::new(&scene, &cameras(2), &options);
        for entries in [&[1][..], &[2], &[3], &[1, 2], &[1, 3], &[2, 3], &[1, 2, 3]] {
            let chosen = |i: &usize| entries.contains(&index[*i]);
            let alone: Vec<usize> = (0..sites.len()).filter(chosen).collect();
            let rest = gaussians(&alone.iter().map(|i| sites[*i]).collect::<Vec<_>>());
            let sizes = |parts: &[Part]| -> Vec<(usize, Box3)> {
                parts.iter().map(|part| (part.gaussians.len(), part.aligned)).collect()
            };
            let found = pieces.parts(&scene, entries, &options);
            assert_eq!(sizes(&found), sizes(&parts(&rest, &cameras(2), &options)), "{entries:?}");
            assert!(!found.is_empty(), "{entries:?}");
        }
    }

    #[test]
    fn boxes_have_the_things_size_place_and_turn() {
        // A slab of 2 x 1 x 0.2, turned by 30 degrees about the camera's axis.
        let turn = DMat3::from_rotation_z(30.0_f64.to_radians());
        let mut sites = Vec::new();
        for i in 0..=40 {
            for j in 0..=20 {
                for k in 0..=4 {
                    let own = DVec3::new(
                        f64::from(i) * 0.05 - 1.0,
                        f64::from(j) * 0.05 - 0.5,
                        f64::from(k) * 0.05 - 0.1,
                    );
                    let mean = turn * own + DVec3::new(0.3, 0.2, 5.0);
                    let source = SourcePixel { view: 0, x: i as u16, y: (j * 5 + k) as u16 };
                    sites.push((mean, source));
                }
            }
        }
        let scene = gaussians(&sites);
        let options = PartOptions { trim: 0.0, ..PartOptions::default() };
        let found = parts(&scene, &cameras(1), &options);
        assert_eq!(found.len(), 1);
        let Box3 { center, size, axes } = found[0].oriented;
        let near = |a: [f64; 3], b: [f64; 3]| a.iter().zip(b).all(|(x, y)| (x - y).abs() < 1e-3);
        assert!(near(size, [2.0, 1.0, 0.2]), "{size:?}");
        assert!(near(center, (DVec3::new(0.3, 0.2, 5.0) + ORIGIN).to_array()), "{center:?}");
        let (cos, sin) = (3.0_f64.sqrt() / 2.0, 0.5);
        assert!(near(axes[0], [cos, sin, 0.0]) && near(axes[1], [-sin, cos, 0.0]), "{axes:?}");
        let [a, b, c] = axes.map(DVec3::from_array);
        assert!((a.cross(b).dot(c) - 1.0).abs() < 1e-9, "right-handed");
        let aligned = found[0].aligned;
        assert!(near(aligned.size, [2.0 * cos + sin, 2.0 * sin + cos, 0.2]), "{aligned:?}");
        assert!(near(found[0].centroid, center));
    }

    #[test]
    fn a_trimmed_box_forgets_a_stray() {
        let mut sites = patch(0, 0..20, 0..20, 4.0);
        // Joined to the patch by a thin chain of pixels.
        sites.extend(patch(0, 20..80, 10..11, 4.0));
        let scene = gaussians(&sites);
        let whole = PartOptions { trim: 0.0, ..PartOptions::default() };
        let trimmed = PartOptions { trim: 0.1, ..PartOptions::default() };
        let width = |options: &PartOptions| {
            let found = parts(&scene, &cameras(1), options);
            assert_eq!(found.len(), 1);
            found[0].aligned.size[0]
        };
        assert!((width(&whole) - 79.0 * 0.04).abs() < 1e-4, "{}", width(&whole));
        assert!(width(&trimmed) < 40.0 * 0.04, "{}", width(&trimmed));
    }
}
