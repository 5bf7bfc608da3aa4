//! What a text selects in space: connected parts of Gaussians, each with its boxes.
//!
//! Two Gaussians touch when pixels next to each other made them at nearly one depth, or when they
//! lie within a few of their own spacings of each other: a spacing is the width of a pixel of the
//! network's picture at the Gaussian's depth, so that near and far things are joined alike.

use std::collections::HashMap;

use glam::{DMat3, DVec3};
use rayon::prelude::*;

use crate::scene::{Gaussians, SceneCamera};

/// How Gaussians are joined to parts.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PartOptions {
    /// Spacings within which Gaussians of any photos touch.
    pub reach: f64,
    /// Relative difference of depth under which neighbouring pixels of one photo touch.
    pub same_depth: f64,
    /// Fewest Gaussians of a part.
    pub count_min: usize,
    /// Smallest share of all selected Gaussians that a part may have.
    pub share_min: f64,
    /// Share of a part's Gaussians that a box may leave out on each side of each axis.
    pub trim: f64,
}

impl Default for PartOptions {
    fn default() -> Self {
        Self { reach: 4.0, same_depth: 0.02, count_min: 12, share_min: 0.02, trim: 0.005 }
    }
}

/// A box in the world, upright or turned.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Box3 {
    /// Middle, world units.
    pub center: [f64; 3],
    /// Full lengths along the axes, world units.
    pub size: [f64; 3],
    /// Unit axes, one a row, right-handed; for an aligned box those of the world.
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

/// Connected parts of the `selected` Gaussians, the largest first, small ones left out.
///
/// `cameras` are the scene's; they say how far apart Gaussians of one surface lie.
#[must_use]
pub fn parts(
    gaussians: &Gaussians,
    cameras: &[SceneCamera],
    selected: &[u32],
    options: &PartOptions,
) -> Vec<Part> {
    let mut chosen: Vec<u32> =
        selected.iter().copied().filter(|&i| (i as usize) < gaussians.len()).collect();
    chosen.sort_unstable();
    chosen.dedup();
    let sites = sites(gaussians, cameras, &chosen);
    let mut sets = Sets::new(chosen.len());
    join_pixels(&mut sets, gaussians, &chosen, &sites, options.same_depth);
    join_cells(&mut sets, &sites, options.reach);
    let mut members: HashMap<u32, Vec<u32>> = HashMap::new();
    for (at, i) in chosen.iter().enumerate() {
        members.entry(sets.root(at)).or_default().push(*i);
    }
    let share = options.share_min * chosen.len() as f64;
    let mut found: Vec<Vec<u32>> = members
        .into_values()
        .filter(|part| part.len() >= options.count_min && part.len() as f64 >= share)
        .collect();
    // The first Gaussian of each part is another, so the order is the same every time.
    found.sort_by_key(|part| (std::cmp::Reverse(part.len()), part.first().copied()));
    found.into_iter().map(|part| describe(gaussians, part, options.trim)).collect()
}

/// Where a selected Gaussian is, relative to the scene's origin.
struct Site {
    mean: DVec3,
    /// Depth from the photo that made it; 0 where that is unknown.
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

/// Joins Gaussians of one photo whose pixels are at most two apart and whose depths are alike.
fn join_pixels(
    sets: &mut Sets,
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
    let by_pixel: HashMap<(u16, i32, i32), usize> =
        (0..chosen.len()).map(|at| (pixel(at), at)).collect();
    for at in 0..chosen.len() {
        let (view, x, y) = pixel(at);
        let depth = sites[at].depth;
        for (dx, dy) in AHEAD {
            let Some(&other) = by_pixel.get(&(view, x + dx, y + dy)) else { continue };
            if depth > 0.0 && (sites[other].depth - depth).abs() <= same_depth * depth {
                sets.join(at, other);
            }
        }
    }
}

/// Joins Gaussians within `reach` spacings by a grid for each power of two of the spacing.
fn join_cells(sets: &mut Sets, sites: &[Site], reach: f64) {
    let mut cells: HashMap<(i32, [i64; 3]), usize> = HashMap::new();
    let mut order: Vec<(i32, [i64; 3])> = Vec::new();
    for (at, site) in sites.iter().enumerate() {
        if site.spacing <= 0.0 || !site.spacing.is_finite() {
            continue;
        }
        #[expect(clippy::cast_possible_truncation, reason = "a power of two of an f64")]
        let level = site.spacing.log2().ceil() as i32;
        // In its own grid, and in the next coarser one to meet those of wider spacing.
        for level in [level, level + 1] {
            let edge = reach * f64::from(level).exp2();
            #[expect(clippy::cast_possible_truncation, reason = "saturates far away")]
            let cell = (site.mean / edge).floor().to_array().map(|v| v as i64);
            match cells.entry((level, cell)) {
                std::collections::hash_map::Entry::Occupied(held) => sets.join(at, *held.get()),
                std::collections::hash_map::Entry::Vacant(free) => {
                    order.push((level, cell));
                    free.insert(at);
                }
            }
        }
    }
    for (level, [x, y, z]) in order {
        let at = cells[&(level, [x, y, z])];
        // Half of the 26 cells around; the other half looks this way.
        for step in 14..27 {
            let next = [x + step % 3 - 1, y + step / 3 % 3 - 1, z + step / 9 - 1];
            if let Some(&other) = cells.get(&(level, next)) {
                sets.join(at, other);
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

/// Axes with the least and the greatest place along each.
type Bounds = [(DVec3, [f64; 2]); 3];

/// Bounds along three axes, without the share `trim` on each side.
fn bounds(means: &[DVec3], axes: [DVec3; 3], trim: f64) -> Bounds {
    axes.map(|axis| {
        let mut along: Vec<f64> = means.iter().map(|mean| mean.dot(axis)).collect();
        along.sort_unstable_by(f64::total_cmp);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a share")]
        let out = (trim.clamp(0.0, 0.49) * along.len() as f64) as usize;
        (axis, [along[out], along[along.len() - 1 - out]])
    })
}

/// Axes by length, right-handed again; of each the sign that makes its largest number positive.
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

/// Orthonormal eigenvectors of a symmetric matrix, by Jacobi's rotations.
fn principal_axes(spread: DMat3) -> [DVec3; 3] {
    let mut a = spread.to_cols_array_2d();
    let mut v: [[f64; 3]; 3] = DMat3::IDENTITY.to_cols_array_2d();
    for _ in 0..32 {
        for (p, q) in [(0, 1), (0, 2), (1, 2)] {
            if a[p][q].abs() <= f64::EPSILON * (a[p][p].abs() + a[q][q].abs()) {
                continue;
            }
            let theta = (a[q][q] - a[p][p]) / (2.0 * a[p][q]);
            let t = theta.signum() / (theta.abs() + (theta * theta + 1.0).sqrt());
            let c = 1.0 / (t * t + 1.0).sqrt();
            let s = t * c;
            for numbers in a.iter_mut().chain(&mut v) {
                let (kp, kq) = (numbers[p], numbers[q]);
                (numbers[p], numbers[q]) = (c * kp - s * kq, s * kp + c * kq);
            }
            let (ap, aq) = (a[p], a[q]);
            a[p] = std::array::from_fn(|k| c * ap[k] - s * aq[k]);
            a[q] = std::array::from_fn(|k| s * ap[k] + c * aq[k]);
        }
    }
    // The axes are the columns of v, whose rows were turned above.
    [0, 1, 2].map(|k| DVec3::new(v[0][k], v[1][k], v[2][k]).normalize_or(DVec3::X))
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
            semantic_index: vec![0; n],
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

    fn all(of: &Gaussians) -> Vec<u32> {
        (0..of.len() as u32).collect()
    }

    #[test]
    fn things_apart_are_two_parts_and_the_largest_comes_first() {
        let sites = [patch(0, 0..10, 0..10, 4.0), patch(0, 40..60, 0..10, 4.0)].concat();
        let scene = gaussians(&sites);
        let found = parts(&scene, &cameras(1), &all(&scene), &PartOptions::default());
        let sizes: Vec<usize> = found.iter().map(|part| part.gaussians.len()).collect();
        assert_eq!(sizes, [200, 100]);
        assert_eq!(found[1].gaussians[..3], [0, 1, 2]);
    }

    #[test]
    fn one_surface_seen_by_two_photos_is_one_part() {
        // View 1 stands one unit to the right: its patch continues that of view 0.
        let sites = [patch(0, 50..75, 40..60, 4.0), patch(1, 50..75, 40..60, 4.08)].concat();
        let scene = gaussians(&sites);
        let found = parts(&scene, &cameras(2), &all(&scene), &PartOptions::default());
        assert_eq!(found.len(), 1);
        assert_eq!(found[0].gaussians.len(), 1000);
    }

    #[test]
    fn near_and_far_things_are_joined_alike_and_a_step_in_depth_parts() {
        let sites = [patch(0, 0..20, 0..20, 0.5), patch(0, 20..40, 0..20, 50.0)].concat();
        let scene = gaussians(&sites);
        let found = parts(&scene, &cameras(1), &all(&scene), &PartOptions::default());
        assert_eq!(found.len(), 2, "neighbouring pixels, far apart in depth");
        assert!(found.iter().all(|part| part.gaussians.len() == 400));
    }

    #[test]
    fn specks_are_left_out() {
        let sites = [patch(0, 0..30, 0..30, 4.0), patch(0, 80..83, 80..83, 4.0)].concat();
        let scene = gaussians(&sites);
        let found = parts(&scene, &cameras(1), &all(&scene), &PartOptions::default());
        assert_eq!(found.len(), 1);
        let fine = PartOptions { count_min: 1, share_min: 0.0, ..PartOptions::default() };
        assert_eq!(parts(&scene, &cameras(1), &all(&scene), &fine).len(), 2);
        assert!(parts(&scene, &cameras(1), &[], &fine).is_empty());
        assert!(parts(&scene, &cameras(1), &[5_000_000], &fine).is_empty(), "no such Gaussian");
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
        let found = parts(&scene, &cameras(1), &all(&scene), &options);
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
            let found = parts(&scene, &cameras(1), &all(&scene), options);
            assert_eq!(found.len(), 1);
            found[0].aligned.size[0]
        };
        assert!((width(&whole) - 79.0 * 0.04).abs() < 1e-4, "{}", width(&whole));
        assert!(width(&trimmed) < 40.0 * 0.04, "{}", width(&trimmed));
    }
}
