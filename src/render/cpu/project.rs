//! Stage 1: Gaussians to footprints, and which to drop. Partner: `shaders/project.wgsl`
//!
//! In: means, quats, scales, opacities `[N]`. Out: [`Footprint`] `[N]`; a dropped Gaussian has
//! touched no tile (`tiles_per_gauss` 0). Everything is computed in f64 and narrowed at the end.

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;

use super::tiles::{Grid, TileSpans};
use crate::{
    render::{
        constants::{ALPHA_MIN, BLUR_PX2, FOOTPRINT_SLACK},
        view::View,
    },
    scene::Gaussians,
};

/// Gaussians a task: large enough to hide the task's cost, small enough to balance two cores.
const CHUNK: usize = 1024;

/// A Gaussian on the picture.
///
/// With d = pixel - mean, half the squared Mahalanobis distance is
/// `(inv_sx · (d.x - slope · d.y))² + (inv_sy · d.y)²`: x given y, then y (Cholesky). Unlike the
/// conic `a d.x² + 2 b d.x d.y + c d.y²` it does not cancel for long thin Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Footprint {
    /// Centre, pixels. f64: a tile subtracts its corner before it narrows.
    pub mean: [f64; 2],
    /// Covariance xy over variance y.
    pub slope: f64,
    /// √(½ / variance of x given y), 1/px.
    pub inv_sx: f32,
    /// √(½ / variance of y), 1/px.
    pub inv_sy: f32,
    /// Half the squared distance at which alpha reaches 1/255, with slack.
    pub reach: f32,
    /// Opacity, compensated in antialiased mode.
    pub opacity: f32,
    /// t.z, world units; also the sort key.
    pub depth: f32,
    /// Colour; filled by `shade`.
    pub color: [f32; 3],
}

/// What the stage gives, `[N]` each.
#[derive(Debug, Default)]
pub struct Projected {
    /// Footprints; meaningless where dropped.
    pub footprints: Vec<Footprint>,
    /// Tiles touched, for the emission; meaningless where dropped.
    pub tile_spans: Vec<TileSpans>,
    /// Tiles touched; 0 where dropped.
    pub tiles_per_gauss: Vec<u32>,
}

impl Projected {
    /// Footprints from elsewhere, with the tiles that they touch.
    #[must_use]
    pub fn of(footprints: Vec<Footprint>, grid: &Grid) -> Self {
        let touched = footprints.iter().map(|footprint| TileSpans::of(footprint, grid));
        let (tile_spans, tiles_per_gauss) = touched.unzip();
        Self { footprints, tile_spans, tiles_per_gauss }
    }
}

/// Projects every Gaussian; `tiles_per_gauss[i]` is 0 for one that is dropped.
pub fn project(gaussians: &Gaussians, view: &View, antialiased: bool, projected: &mut Projected) {
    let count = gaussians.len();
    let Projected { footprints, tile_spans, tiles_per_gauss } = projected;
    footprints.resize(count, Footprint::default());
    tile_spans.resize(count, TileSpans::default());
    tiles_per_gauss.resize(count, 0);
    let grid = Grid { width: view.width, height: view.height, tile_rows: 0..view.tiles_y() };
    let chunks = footprints
        .par_chunks_mut(CHUNK)
        .zip(tile_spans.par_chunks_mut(CHUNK))
        .zip(tiles_per_gauss.par_chunks_mut(CHUNK));
    chunks.enumerate().for_each(|(chunk, ((footprints, spans), tiles))| {
        let out = footprints.iter_mut().zip(spans).zip(tiles);
        for (i, ((footprint, spans), tiles)) in out.enumerate() {
            *tiles = 0;
            if let Some(seen) = project_one(gaussians, chunk * CHUNK + i, view, antialiased) {
                *footprint = seen;
                (*spans, *tiles) = TileSpans::of(&seen, &grid);
            }
        }
    });
}

/// EWA projection of Gaussian `i`; `None` when it cannot be seen.
#[must_use]
pub fn project_one(
    gaussians: &Gaussians,
    i: usize,
    view: &View,
    antialiased: bool,
) -> Option<Footprint> {
    let mean = DVec3::from(gaussians.means()[i].map(f64::from));
    let t = view.rotation * mean + view.translation;
    if t.z.is_nan() || t.z < view.near {
        return None;
    }
    let slope = [t.x / t.z, t.y / t.z];
    let clamped = [0, 1].map(|k: usize| slope[k].clamp(view.slope_min[k], view.slope_max[k]));
    let [fx, fy] = view.focal.map(|focal| focal / t.z);

    // Rows of M = J W R diag(scales), so that the 2D covariance is M Mᵀ.
    let [w, x, y, z] = gaussians.quats()[i].map(f64::from);
    let rotation = DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize());
    let scales = DVec3::from(gaussians.scales()[i].map(f64::from));
    let local = (view.rotation * rotation) * DMat3::from_diagonal(scales);
    let [row_x, row_y, row_z] = [local.row(0), local.row(1), local.row(2)];
    let m0 = (row_x - row_z * clamped[0]) * fx;
    let m1 = (row_y - row_z * clamped[1]) * fy;

    let blur = f64::from(BLUR_PX2);
    let (xx, yy) = (m0.length_squared(), m1.length_squared());
    // det(M Mᵀ) as a sum of squares (Cauchy-Binet): it cannot cancel or go negative.
    let det_sharp = m0.cross(m1).length_squared();
    let det = det_sharp + blur * (xx + yy) + blur * blur;
    let (var_x, var_y) = (xx + blur, yy + blur);
    if !(det > 0.0 && det.is_finite() && var_x.is_finite() && var_y.is_finite()) {
        return None;
    }
    let mut opacity = f64::from(gaussians.opacities()[i]);
    if antialiased {
        opacity *= (det_sharp / det).max(0.0).sqrt();
    }
    if opacity < f64::from(ALPHA_MIN) {
        return None;
    }
    let footprint = Footprint {
        mean: [0, 1].map(|k: usize| view.focal[k] * slope[k] + view.principal[k]),
        slope: m0.dot(m1) / var_y,
        inv_sx: (0.5 * var_y / det).sqrt() as f32,
        inv_sy: (0.5 / var_y).sqrt() as f32,
        reach: (opacity / f64::from(ALPHA_MIN)).ln() as f32 + FOOTPRINT_SLACK,
        opacity: opacity as f32,
        depth: t.z as f32,
        color: [0.0; 3],
    };
    let finite = footprint.mean.iter().all(|v| v.is_finite())
        && footprint.slope.is_finite()
        && footprint.depth.is_finite();
    (finite && footprint.inv_sx > 0.0 && footprint.inv_sy > 0.0).then_some(footprint)
}
