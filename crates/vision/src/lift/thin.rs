//! Thinning: where a picture is flat, one Gaussian replaces four neighbours.
//!
//! A network makes one Gaussian for each pixel, on a wall as on a leaf. Aligned blocks of 2 x 2
//! pixels (and 2 x 2 of those) whose colours and depths are alike, with their surroundings, become
//! one Gaussian: the mixture's mean and covariance, and the opacity that keeps its mass in the
//! picture, `sum a_i A_i`, where `A = sqrt(det)` of the footprint with the renderer's blur. Where
//! that would be an opacity over [`ThinOptions::opacity_max`], part of the rest widens it instead.
//! The merged one takes the place of one of the four, so it keeps a source pixel.

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use super::surface::Fate;
use crate::{
    point,
    scene::{BLUR_PX2, SH_C0, SH_COUNT_MAX, ViewGaussians, covariance, principal_axes},
};

/// How alike neighbours must be, and how often blocks of blocks are tried.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ThinOptions {
    /// Times that four become one: 0 keeps all, 2 makes up to 16 one.
    pub levels: u32,
    /// Largest difference of colour within a block, 0..1, any channel.
    pub colour: f32,
    /// Factor on `colour` for each further level: a large block shows a ramp that a small hides.
    pub finer: f32,
    /// Largest difference of depth within a block, in widths of its own pixels.
    pub depth: f64,
    /// Factor on both differences for the block with the ring of cells around it.
    pub around: f64,
    /// Largest opacity of a merged Gaussian.
    pub opacity_max: f64,
    /// Share of the mass beyond that opacity which widens the Gaussian.
    pub widen: f64,
}

impl Default for ThinOptions {
    /// Measured on five real scenes against all Gaussians: docs/benchmarks.md.
    fn default() -> Self {
        Self {
            levels: 2,
            colour: 0.06,
            finer: 0.35,
            depth: 3.0,
            around: 2.0,
            opacity_max: 0.98,
            widen: 0.5,
        }
    }
}

/// The cells of a level that one Gaussian stands for.
struct Level {
    columns: usize,
    rows: usize,
    /// Pixel whose place the cell's Gaussian has.
    at: Vec<Option<u32>>,
}

/// What four Gaussians become.
struct Merged {
    /// Cell of the next level.
    cell: usize,
    /// The four, row by row.
    of: [usize; 4],
    mean: DVec3,
    axes: [DVec3; 3],
    deviations: [f64; 3],
    opacity: f64,
    /// Coefficients, the view's count of them.
    sh: [[f32; 3]; SH_COUNT_MAX],
}

/// Merges in place: the merged Gaussian has the place of one of its four, the others are
/// [`Fate::Merged`].
pub(super) fn thin(view: &mut ViewGaussians, fates: &mut [Fate], options: &ThinOptions) {
    let lens = view.camera.intrinsics;
    let (columns, rows) = (lens.width as usize, lens.height as usize);
    let place = |(i, fate): (u32, &Fate)| (*fate == Fate::Keep).then_some(i);
    let mut level = Level { columns, rows, at: (0..).zip(fates.iter()).map(place).collect() };
    for step in 0..options.levels {
        let (columns, rows) = (level.columns / 2, level.rows / 2);
        let blocks = Blocks::new(view, &level, options, step);
        let blocks: Vec<Merged> =
            (0..columns * rows).into_par_iter().filter_map(|cell| blocks.merge(cell)).collect();
        let mut next = Level { columns, rows, at: vec![None; columns * rows] };
        // The place nearest to the block's middle.
        let heir = if step == 0 { 3 } else { 0 };
        for merged in blocks {
            let at = merged.of[heir];
            next.at[merged.cell] = u32::try_from(at).ok();
            merged.of.iter().for_each(|&i| fates[i] = Fate::Merged);
            fates[at] = Fate::Keep;
            put(view, at, &merged);
        }
        level = next;
    }
}

/// Writes a merged Gaussian to its place.
#[expect(clippy::cast_possible_truncation, reason = "scenes are f32")]
fn put(view: &mut ViewGaussians, at: usize, merged: &Merged) {
    let [a, b, c] = merged.axes;
    let q = DQuat::from_mat3(&DMat3::from_cols(a, b, c)).normalize();
    view.means[at] = merged.mean.as_vec3().to_array();
    view.quats[at] = [q.w as f32, q.x as f32, q.y as f32, q.z as f32];
    view.scales[at] = merged.deviations.map(|deviation| deviation as f32);
    view.opacities[at] = merged.opacity as f32;
    let k = (usize::from(view.sh_degree) + 1).pow(2);
    view.sh[at * k..(at + 1) * k].copy_from_slice(&merged.sh[..k]);
}

/// The blocks of a level.
struct Blocks<'a> {
    view: &'a ViewGaussians,
    level: &'a Level,
    /// `[H * W]` z of the view's camera, and base colour.
    depth: Vec<f64>,
    colour: Vec<[f32; 3]>,
    /// The camera's axis in the frame of the Gaussians.
    axis: DVec3,
    focal: f64,
    colour_most: f32,
    depth_most: f64,
    options: &'a ThinOptions,
}

impl<'a> Blocks<'a> {
    fn new(view: &'a ViewGaussians, level: &'a Level, options: &'a ThinOptions, step: u32) -> Self {
        let to_camera = view.camera.camera_to_world.viewmat() * view.frame_to_world.matrix();
        let k = (usize::from(view.sh_degree) + 1).pow(2);
        let depth = view.means.par_iter().map(|mean| to_camera.transform_point3(point(*mean)).z);
        let colour = view.sh.par_chunks(k).map(|sh| sh[0].map(|v| v * SH_C0));
        let lens = &view.camera.intrinsics;
        let finer = (0..step).fold(1.0, |factor, _| factor * options.finer);
        Self {
            view,
            level,
            depth: depth.collect(),
            colour: colour.collect(),
            axis: DMat3::from_mat4(to_camera).transpose() * DVec3::Z,
            focal: f64::midpoint(lens.fx, lens.fy),
            colour_most: options.colour * finer,
            depth_most: options.depth * f64::from(1_u32 << step.min(16)),
            options,
        }
    }

    /// The Gaussian of the cell at (x, y); `None` beyond the level's edges too.
    fn at(&self, x: usize, y: usize) -> Option<usize> {
        let inside = x < self.level.columns && y < self.level.rows;
        inside.then(|| self.level.at[y * self.level.columns + x].map(|i| i as usize)).flatten()
    }

    /// The block of a cell of the next level as one Gaussian, where it may be one.
    fn merge(&self, cell: usize) -> Option<Merged> {
        let across = self.level.columns / 2;
        let (x, y) = (cell % across * 2, cell / across * 2);
        let of = [self.at(x, y)?, self.at(x + 1, y)?, self.at(x, y + 1)?, self.at(x + 1, y + 1)?];
        let pixel = of.iter().map(|&i| self.depth[i]).sum::<f64>() / 4.0 / self.focal;
        let around = (0..16)
            .filter_map(|k| self.at((x + k % 4).checked_sub(1)?, (y + k / 4).checked_sub(1)?));
        let alike = pixel > 0.0
            && self.alike(of.into_iter(), pixel, 1.0)
            && self.alike(around, pixel, self.options.around);
        alike.then(|| self.mixture(cell, of, pixel)).flatten()
    }

    fn alike(&self, of: impl Iterator<Item = usize>, pixel: f64, factor: f64) -> bool {
        let mut depths = [f64::INFINITY, f64::NEG_INFINITY];
        let mut colours = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];
        for i in of {
            depths = [depths[0].min(self.depth[i]), depths[1].max(self.depth[i])];
            for (channel, &own) in self.colour[i].iter().enumerate() {
                colours[0][channel] = colours[0][channel].min(own);
                colours[1][channel] = colours[1][channel].max(own);
            }
        }
        #[expect(clippy::cast_possible_truncation, reason = "a factor of a tolerance")]
        let colour_most = self.colour_most * factor as f32;
        depths[1] - depths[0] <= self.depth_most * factor * pixel
            && colours[0].iter().zip(colours[1]).all(|(least, most)| most - least <= colour_most)
    }

    /// `pixel`: width of a pixel of the picture at the block's depth, world units.
    fn mixture(&self, cell: usize, of: [usize; 4], pixel: f64) -> Option<Merged> {
        let view = self.view;
        let covariances = of.map(|i| covariance(view.quats[i], view.scales[i]));
        let footprint = |covariance: &DMat3| self.footprint(covariance, pixel);
        let masses: [f64; 4] =
            std::array::from_fn(|k| f64::from(view.opacities[of[k]]) * footprint(&covariances[k]));
        let mass: f64 = masses.iter().sum();
        let weights = masses.map(|own| own / mass);
        let means = of.map(|i| point(view.means[i]));
        let mean: DVec3 = means.iter().zip(weights).map(|(m, weight)| *m * weight).sum();
        let mut covariance = DMat3::ZERO;
        for k in 0..4 {
            let d = means[k] - mean;
            let spread = DMat3::from_cols(d * d.x, d * d.y, d * d.z);
            covariance += (covariances[k] + spread) * weights[k];
        }
        let opacity_max = self.options.opacity_max;
        let area = footprint(&covariance);
        let wanted = mass / area;
        if wanted > opacity_max {
            let wider = self.options.widen * (mass / opacity_max - area) * pixel * pixel;
            let along = DMat3::from_cols(
                self.axis * self.axis.x,
                self.axis * self.axis.y,
                self.axis * self.axis.z,
            );
            covariance += (DMat3::IDENTITY - along) * wider;
        }
        let axes = principal_axes(covariance);
        let [a, b, c] = axes;
        let axes = if a.cross(b).dot(c) < 0.0 { [a, b, -c] } else { axes };
        let deviations = axes.map(|axis| axis.dot(covariance * axis).max(0.0).sqrt());
        let (opacity, sh) = (wanted.min(opacity_max), self.sh(of, weights));
        let merged = Merged { cell, of, mean, axes, deviations, opacity, sh };
        let finite = mean.is_finite() && deviations.iter().all(|d| d.is_finite() && *d > 0.0);
        (finite && merged.opacity.is_finite()).then_some(merged)
    }

    /// The coefficients of four Gaussians, each with its share.
    #[expect(clippy::cast_possible_truncation, reason = "scenes are f32")]
    fn sh(&self, of: [usize; 4], weights: [f64; 4]) -> [[f32; 3]; SH_COUNT_MAX] {
        let count = (usize::from(self.view.sh_degree) + 1).pow(2);
        let mut mixed = [[0.0; 3]; SH_COUNT_MAX];
        for (row, mixed) in mixed.iter_mut().take(count).enumerate() {
            let mut sum = [0.0_f64; 3];
            for (i, weight) in of.iter().zip(weights) {
                let own = self.view.sh[i * count + row];
                sum.iter_mut().zip(own).for_each(|(sum, own)| *sum += weight * f64::from(own));
            }
            *mixed = sum.map(|v| v as f32);
        }
        mixed
    }

    /// Area of a Gaussian in the picture with the blur, px² over 2 pi.
    fn footprint(&self, covariance: &DMat3, pixel: f64) -> f64 {
        // Across the axis: what is left of the covariance beside the camera's direction.
        let side = self.axis.any_orthonormal_vector();
        let up = self.axis.cross(side);
        let blur = f64::from(BLUR_PX2);
        let px2 = pixel * pixel;
        let (a, b) = (side.dot(*covariance * side) / px2, up.dot(*covariance * up) / px2);
        let c = side.dot(*covariance * up) / px2;
        ((a + blur) * (b + blur) - c * c).max(0.0).sqrt()
    }
}
