//! The oracle: f64, pixel by pixel, no tiles, one full sort. It is slow on purpose and shares no
//! arithmetic with the renderers that it judges.
//!
//! The model has thresholds. A pixel stands at a cliff when an alpha is close to 1/255, a ray close
//! to its end, or two depths close to each other. Another renderer may decide differently there and
//! still be right. The oracle marks such pixels.

use std::{cmp::Ordering, collections::BTreeMap};

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;

use super::{
    Background, Labels, Layer, RenderRequest, Source,
    constants::{
        ALPHA_MAX, ALPHA_MIN, BLUR_PX2, FRUSTUM_MARGIN, OWN_SIZE, PIXEL_PX2, SH_C0, SH_C1, SH_C2,
        SH_C3, SH_OFFSET, TRANSMITTANCE_MIN,
    },
    labels::BLEND_WIDTH,
    merged::Merged,
};
use crate::{
    error::Result,
    scene::{Gaussians, Intrinsics},
};

/// Relative distance to a threshold under which a pixel counts as standing on its edge: ten times
/// what f32 rounding moves alpha (1e-5) and a transmittance after many factors (1e-4).
pub const CLIFF_ALPHA: f64 = 1e-4;
/// As [`CLIFF_ALPHA`], for the transmittance at which a ray ends.
pub const CLIFF_TRANSMITTANCE: f64 = 1e-3;
/// Relative difference of two depths under which f32 arithmetic may swap them.
pub const CLIFF_DEPTH: f64 = 1e-6;
/// Distance of a blended number to a bound of a mask, as a share of what was summed.
pub const CLIFF_MASK: f64 = 1e-5;
/// Angle to the vertical, radians, within which f32 does not know a longitude.
pub const CLIFF_POLE: f64 = 1e-5;

/// Why a pixel may rightly differ.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Cliff {
    /// A contribution has alpha next to 1/255.
    pub alpha: bool,
    /// The transmittance came next to 1e-4.
    pub transmittance: bool,
    /// Two neighbouring contributions have depths that f32 arithmetic may swap.
    pub depth: bool,
    /// A contribution's alpha would pass 1/255 if its centre moved by what f32 leaves of a place
    /// on the picture.
    pub place: bool,
    /// A number that decides whether a mask selects the pixel is next to its bound.
    pub mask: bool,
    /// The backdrop shows, next to one of its poles.
    pub pole: bool,
}

impl Cliff {
    /// Whether a renderer that sorts by the very key of the oracle may differ here.
    pub fn same_order(self) -> bool {
        self.alpha || self.transmittance || self.mask || self.pole
    }

    /// Whether a renderer with depths and places of its own, in f32, may differ here.
    pub fn any(self) -> bool {
        self.same_order() || self.depth || self.place
    }
}

/// One pixel.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct OraclePixel {
    /// Colour over the background.
    pub color: [f64; 3],
    /// Expected depth, world units; 0 where alpha is 0.
    pub depth: f64,
    /// Accumulated opacity.
    pub alpha: f64,
    /// Blended rows of the request's table; zeros where none was given.
    pub blend: [f64; BLEND_WIDTH],
    /// Whether the request's mask selects it; `false` where none was asked for.
    pub mask: bool,
    /// Weight of each entry but 0, where weights were asked for.
    pub weights: BTreeMap<u16, f64>,
    /// Edges it stands on.
    pub cliff: Cliff,
}

/// Renders the whole picture, row-major.
///
/// # Errors
/// `invalid_request` when the intrinsics are unusable.
pub fn render(gaussians: &Gaussians, request: &RenderRequest) -> Result<Vec<OraclePixel>> {
    let Intrinsics { width, height, .. } = request.lens();
    let pixels: Vec<[u32; 2]> = (0..height).flat_map(|y| (0..width).map(move |x| [x, y])).collect();
    render_pixels(gaussians, request, &pixels)
}

/// Renders the pixels (column, row of the part drawn) given, in their order: for pictures too
/// large to do whole.
///
/// Cost: pixels x Gaussians in the pixel's row.
///
/// # Errors
/// `invalid_request` when the intrinsics are unusable.
pub fn render_pixels(
    gaussians: &Gaussians,
    request: &RenderRequest,
    pixels: &[[u32; 2]],
) -> Result<Vec<OraclePixel>> {
    let lens = request.camera.intrinsics.validated("camera")?;
    let splats = (0..gaussians.len()).filter_map(|i| splat(gaussians, i, request, &lens));
    Ok(blend(splats.collect(), request, pixels))
}

/// As [`render_pixels`], of these Gaussians alone: merged ones count on after the scene's own.
///
/// # Errors
/// As [`render_pixels`].
pub fn render_merged(
    gaussians: &Gaussians,
    merged: &Merged,
    ids: &[usize],
    request: &RenderRequest,
    pixels: &[[u32; 2]],
) -> Result<Vec<OraclePixel>> {
    let lens = request.camera.intrinsics.validated("camera")?;
    let entries = merged.entries(gaussians);
    let of = |&id: &usize| match id.checked_sub(gaussians.len()) {
        None => splat(gaussians, id, request, &lens),
        Some(id) => {
            let sum = f64::from(merged.sums[id]);
            let splat = splat_of(&merged.gaussians, id, sum, request, &lens)?;
            Some(Splat { entry: entries[id], ..splat })
        }
    };
    Ok(blend(ids.iter().filter_map(of).collect(), request, pixels))
}

fn blend(mut splats: Vec<Splat>, request: &RenderRequest, pixels: &[[u32; 2]]) -> Vec<OraclePixel> {
    let corner = request.crop.map_or([0, 0], |crop| [crop.x, crop.y]);
    splats.sort_by(Splat::order);
    // Pixels of one row share the list of Gaussians that can reach the row.
    let mut by_row: Vec<usize> = (0..pixels.len()).collect();
    by_row.sort_by_key(|&i| pixels[i][1]);
    let rows: Vec<&[usize]> = by_row.chunk_by(|&a, &b| pixels[a][1] == pixels[b][1]).collect();
    let done: Vec<Vec<(usize, OraclePixel)>> = rows
        .into_par_iter()
        .map(|row| {
            let y = f64::from(pixels[row[0]][1] + corner[1]) + 0.5;
            let near: Vec<&Splat> =
                splats.iter().filter(|s| (y - s.mean.y).abs() <= s.half_height).collect();
            row.iter()
                .map(|&i| {
                    let center = DVec2::new(f64::from(pixels[i][0] + corner[0]) + 0.5, y);
                    (i, pixel(&near, center, request))
                })
                .collect()
        })
        .collect();
    let mut out = vec![OraclePixel::default(); pixels.len()];
    for (i, pixel) in done.into_iter().flatten() {
        out[i] = pixel;
    }
    out
}

/// What one Gaussian adds to a pixel.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Contribution {
    /// Its number.
    pub gaussian: usize,
    /// Depth of its centre, world units.
    pub depth: f64,
    /// alpha T, 0..1.
    pub weight: f64,
}

/// What each Gaussian adds to one pixel of the whole picture (column, row), front to back. `among`
/// are those that are asked, ascending, or all.
///
/// # Errors
/// `invalid_request` when the intrinsics are unusable.
pub fn contributions(
    gaussians: &Gaussians,
    request: &RenderRequest,
    pixel: [u32; 2],
    among: Option<&[u32]>,
) -> Result<Vec<Contribution>> {
    let lens = request.camera.intrinsics.validated("camera")?;
    let [x, y] = pixel.map(|at| f64::from(at) + 0.5);
    let center = DVec2::new(x, y);
    let mut near: Vec<(usize, Splat)> = numbers(gaussians, among)
        .filter(|&i| may_reach(gaussians, i, request, &lens, center))
        .filter_map(|i| Some((i, splat(gaussians, i, request, &lens)?)))
        .filter(|(_, splat)| splat.alpha(center) >= f64::from(ALPHA_MIN))
        .collect();
    near.sort_by(|a, b| Splat::order(&a.1, &b.1));
    let mut transmittance = 1.0;
    let mut found = Vec::new();
    for (gaussian, splat) in near {
        let alpha = splat.alpha(center);
        let next = transmittance * (1.0 - alpha);
        if next <= f64::from(TRANSMITTANCE_MIN) {
            break;
        }
        found.push(Contribution { gaussian, depth: splat.depth, weight: alpha * transmittance });
        transmittance = next;
    }
    Ok(found)
}

/// The numbers of some Gaussians, or of all.
pub(crate) fn numbers<'a>(
    gaussians: &Gaussians,
    among: Option<&'a [u32]>,
) -> impl IndexedParallelIterator<Item = usize> + use<'a> {
    let count = among.map_or(gaussians.len(), <[u32]>::len);
    (0..count).into_par_iter().map(move |at| among.map_or(at, |ids| ids[at] as usize))
}

/// Whether a Gaussian may add to a place: `false` only where [`splat`] gives none, or one whose
/// alpha there is under [`ALPHA_MIN`]. A few of millions are left for it.
fn may_reach(
    gaussians: &Gaussians,
    i: usize,
    request: &RenderRequest,
    lens: &Intrinsics,
    at: DVec2,
) -> bool {
    let pose = request.camera.camera_to_world;
    let mean = DVec3::from(gaussians.means()[i].map(f64::from));
    let t = pose.rotation().transpose() * (mean - (pose.center() - gaussians.origin()));
    if t.z < f64::from(request.near) {
        return false;
    }
    let source = request.sources.get(usize::from(gaussians.source()[i].view));
    let lost = source.map_or(0.0, |source| blur_lost(source, mean, t.z, lens));
    let largest = gaussians.scales()[i].into_iter().fold(0.0, f32::max);
    let variance = f64::from(largest).powi(2) + lost;
    let opacity = f64::from(gaussians.opacities()[i]).max(f64::from(ALPHA_MIN));
    let reach = 2.0 * (opacity / f64::from(ALPHA_MIN)).ln() + 1e-2;
    let blur = f64::from(BLUR_PX2) + f64::from(PIXEL_PX2);
    let reaches = |along: f64, focal: f64, center: f64, size: u32, at: f64| {
        // A row of the Jacobian is no longer than it is at the edge of the widened picture.
        let margin = f64::from(FRUSTUM_MARGIN) * 0.5 * f64::from(size) / focal;
        let edge = (center / focal).abs().max(((f64::from(size) - center) / focal).abs()) + margin;
        let row = (focal / t.z).powi(2) * (1.0 + edge.powi(2));
        (focal * along / t.z + center - at).powi(2) <= reach * (row * variance + blur)
    };
    reaches(t.x, lens.fx, lens.cx, lens.width, at.x)
        && reaches(t.y, lens.fy, lens.cy, lens.height, at.y)
}

/// A Gaussian on the picture.
#[derive(Clone, Copy, Debug)]
pub struct Splat {
    /// Its centre, pixels.
    pub mean: DVec2,
    /// The inverse of its covariance.
    pub conic: DMat2,
    /// Beyond this height alpha is under 1/255 by more than the width of a cliff.
    half_height: f64,
    /// After its compensation for the blur.
    pub opacity: f64,
    /// Whether it is drawn behind all those that are not.
    behind: bool,
    /// `t.z`, world units.
    pub depth: f64,
    /// Before any background.
    pub color: DVec3,
    entry: u16,
}

impl Splat {
    /// Front to back: t.z narrowed to f32 is the key of the model. For a stable sort, so that ties
    /// stay in the order of the scene.
    pub fn order(&self, other: &Self) -> Ordering {
        let depths = (self.depth as f32).total_cmp(&(other.depth as f32));
        self.behind.cmp(&other.behind).then(depths)
    }

    /// Alpha at a place of the picture.
    pub fn alpha(&self, at: DVec2) -> f64 {
        let d = at - self.mean;
        let power = 0.5 * d.dot(self.conic * d);
        (self.opacity * (-power).exp()).min(f64::from(ALPHA_MAX))
    }

    /// By which share alpha at a place changes where the centre moves by f32's rounding of it.
    fn unsteadiness(&self, at: DVec2) -> f64 {
        let rounding = f64::from(f32::EPSILON) * at.abs().max_element();
        (self.conic * (at - self.mean)).length() * rounding
    }
}

/// Gaussian `i` on the picture; `None` where it adds to no pixel.
pub fn splat(
    gaussians: &Gaussians,
    i: usize,
    request: &RenderRequest,
    lens: &Intrinsics,
) -> Option<Splat> {
    splat_of(gaussians, i, 0.0, request, lens)
}

/// The same of one that stands for Gaussians whose opacities have this sum; 0: for none.
fn splat_of(
    gaussians: &Gaussians,
    i: usize,
    sum: f64,
    request: &RenderRequest,
    lens: &Intrinsics,
) -> Option<Splat> {
    let pose = request.camera.camera_to_world;
    let mean = DVec3::from(gaussians.means()[i].map(f64::from));
    let from_eye = mean - (pose.center() - gaussians.origin());
    let w = pose.rotation().transpose();
    let t = w * from_eye;
    if t.z < f64::from(request.near) {
        return None;
    }
    let bound = |ratio: f64, focal: f64, center: f64, size: u32| {
        let margin = f64::from(FRUSTUM_MARGIN) * 0.5 * f64::from(size) / focal;
        let low = -center / focal - margin;
        let high = (f64::from(size) - center) / focal + margin;
        ratio.max(low).min(high) * t.z
    };
    let tx = bound(t.x / t.z, lens.fx, lens.cx, lens.width);
    let ty = bound(t.y / t.z, lens.fy, lens.cy, lens.height);
    // J, 2x3, as the first two rows of a 3x3.
    let jacobian = DMat3::from_cols(
        DVec3::new(lens.fx / t.z, 0.0, 0.0),
        DVec3::new(0.0, lens.fy / t.z, 0.0),
        DVec3::new(-lens.fx * tx / (t.z * t.z), -lens.fy * ty / (t.z * t.z), 0.0),
    );
    let [qw, qx, qy, qz] = gaussians.quats()[i].map(f64::from);
    let r = DMat3::from_quat(DQuat::from_xyzw(qx, qy, qz, qw).normalize());
    let source = request.sources.get(usize::from(gaussians.source()[i].view));
    if source.is_some_and(|source| source.layer == Layer::LeftOut) {
        return None;
    }
    let lost = source.map_or(0.0, |source| blur_lost(source, mean, t.z, lens));
    let scales = gaussians.scales()[i].map(|s| f64::from(s).powi(2) + lost).map(f64::sqrt);
    let s = DMat3::from_diagonal(DVec3::from(scales));
    // S2 = J W S Wᵀ Jᵀ with S = (R s)(R s)ᵀ, as A Aᵀ: its determinant is the squared length of the
    // cross product of A's rows, which stays exact for the longest needles.
    let a = jacobian * w * r * s;
    let (row0, row1) = (a.row(0), a.row(1));
    let sharp_det = row0.cross(row1).length_squared();
    let (xx, xy, yy) = (row0.dot(row0), row0.dot(row1), row1.dot(row1));
    let Blur { learnt, drawn: blur } = Blur::of(source, mean, t.z, lens, request.antialiased);
    let blurred = |blur: f64| sharp_det + blur * (xx + yy) + blur * blur;
    let det = blurred(blur);
    if det <= 0.0 || !det.is_finite() {
        return None;
    }
    let mut opacity = f64::from(gaussians.opacities()[i]);
    if sum > 0.0 && !request.antialiased {
        // Members with its shape, smaller by one share: `crate::merged`.
        let share = opacity / sum;
        let member = share * share * sharp_det + share * learnt * (xx + yy) + learnt * learnt;
        opacity = sum * (member / blurred(learnt)).sqrt();
    }
    if request.antialiased {
        opacity *= (sharp_det / det).max(0.0).sqrt();
    } else {
        let least = f64::from(ALPHA_MIN);
        opacity -= (1.0 - (blurred(learnt) / det).sqrt()) * (opacity - least);
    }
    if sum > 0.0 {
        opacity = opacity.min(opacity.sqrt());
    }
    if opacity < f64::from(ALPHA_MIN) {
        return None;
    }
    let conic =
        DMat2::from_cols(DVec2::new(yy + blur, -xy) / det, DVec2::new(-xy, xx + blur) / det);
    let reach = 2.0 * (opacity / f64::from(ALPHA_MIN)).ln() + 1e-2;
    let k = gaussians.sh_count();
    Some(Splat {
        mean: DVec2::new(lens.fx * t.x / t.z + lens.cx, lens.fy * t.y / t.z + lens.cy),
        conic,
        half_height: (reach * (yy + blur)).sqrt(),
        opacity,
        behind: source.is_some_and(|source| source.layer == Layer::Behind),
        depth: t.z,
        color: color(&gaussians.sh()[i * k..(i + 1) * k], from_eye.normalize_or_zero()),
        entry: gaussians.semantic_index()[i],
    })
}

/// The variances that are added to a Gaussian on the picture, px²: see [`crate::plan`].
#[derive(Clone, Copy, Debug)]
pub struct Blur {
    /// The blur that it was learnt with, as large as the view shows it.
    pub learnt: f64,
    /// What is added to it.
    pub drawn: f64,
}

impl Blur {
    /// Of a Gaussian at `mean` and `depth` of the view.
    pub fn of(
        source: Option<&Source>,
        mean: DVec3,
        depth: f64,
        lens: &Intrinsics,
        antialiased: bool,
    ) -> Self {
        let width = source.map_or(0.0, |source| source_width(source, mean));
        let size = (width * lens.fx.max(lens.fy) / depth * f64::from(OWN_SIZE)).min(1.0);
        let smaller = if width > 0.0 && !antialiased { 1.0 - size * size } else { 0.0 };
        let learnt = f64::from(BLUR_PX2) * (1.0 - smaller);
        Self { learnt, drawn: learnt + f64::from(PIXEL_PX2) * smaller }
    }
}

/// Width of a Gaussian's source pixel in the world.
pub fn source_width(source: &Source, mean: DVec3) -> f64 {
    let [center, axis] = [source.center, source.axis].map(|v| DVec3::from(v.map(f64::from)));
    (mean - center).dot(axis).max(0.0) * f64::from(source.scale)
}

/// What the blur lost of a Gaussian's variance, where a view shows it larger than its photo did:
/// see [`crate::plan`].
fn blur_lost(source: &Source, mean: DVec3, depth: f64, lens: &Intrinsics) -> f64 {
    let width = source_width(source, mean);
    let p = width * lens.fx.max(lens.fy) / depth / f64::from(OWN_SIZE);
    if p > 1.0 { f64::from(BLUR_PX2) * width.powi(2) * (1.0 - 1.0 / (p * p)) } else { 0.0 }
}

/// 3DGS harmonics at a unit direction, +0.5, negatives to 0.
fn color(sh: &[[f32; 3]], direction: DVec3) -> DVec3 {
    let sum: DVec3 = sh
        .iter()
        .zip(basis(direction))
        .map(|(&c, weight)| weight * DVec3::from(c.map(f64::from)))
        .sum();
    (sum + f64::from(SH_OFFSET)).max(DVec3::ZERO)
}

/// The 16 basis functions up to degree 3 at a unit direction.
pub fn basis(DVec3 { x, y, z }: DVec3) -> [f64; 16] {
    let c1 = f64::from(SH_C1);
    let c2 = SH_C2.map(f64::from);
    let c3 = SH_C3.map(f64::from);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    [
        f64::from(SH_C0),
        -c1 * y,
        c1 * z,
        -c1 * x,
        c2[0] * x * y,
        c2[1] * y * z,
        c2[2] * (2.0 * zz - xx - yy),
        c2[3] * x * z,
        c2[4] * (xx - yy),
        c3[0] * y * (3.0 * xx - yy),
        c3[1] * x * y * z,
        c3[2] * y * (4.0 * zz - xx - yy),
        c3[3] * z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
        c3[4] * x * (4.0 * zz - xx - yy),
        c3[5] * z * (xx - yy),
        c3[6] * x * (xx - 3.0 * yy),
    ]
}

/// Composites the Gaussians of `near` (depth order) at one pixel centre.
fn pixel(near: &[&Splat], center: DVec2, request: &RenderRequest) -> OraclePixel {
    let alpha_min = f64::from(ALPHA_MIN);
    let stop = f64::from(TRANSMITTANCE_MIN);
    let mut transmittance = 1.0;
    let (mut color, mut depth, mut alpha_sum) = (DVec3::ZERO, 0.0, 0.0);
    let mut blend = [0.0; BLEND_WIDTH];
    // Sums of absolute values: f32 rounds in proportion to them.
    let mut summed = [0.0; BLEND_WIDTH];
    let mut weights = BTreeMap::new();
    let mut cliff = Cliff::default();
    let mut last: Option<&Splat> = None;
    for splat in near {
        let alpha = splat.alpha(center);
        let from_cliff = (alpha / alpha_min - 1.0).abs();
        cliff.alpha |= from_cliff < CLIFF_ALPHA;
        cliff.place |= from_cliff < CLIFF_ALPHA + splat.unsteadiness(center);
        if alpha < alpha_min {
            continue;
        }
        let neighbour = last.replace(splat).filter(|last| last.behind == splat.behind);
        cliff.depth |= neighbour.is_some_and(|n| splat.depth - n.depth <= CLIFF_DEPTH * n.depth);
        let next = transmittance * (1.0 - alpha);
        cliff.transmittance |= (next / stop - 1.0).abs() < CLIFF_TRANSMITTANCE;
        if next <= stop {
            break;
        }
        let weight = alpha * transmittance;
        color += weight * splat.color;
        depth += weight * splat.depth;
        alpha_sum += weight;
        if let Some(table) = request.labels.table() {
            for (k, value) in Labels::row(table, splat.entry).into_iter().enumerate() {
                blend[k] += weight * f64::from(value);
                summed[k] += weight * f64::from(value).abs();
            }
        }
        if request.labels == Labels::Weights && splat.entry != 0 {
            *weights.entry(splat.entry).or_insert(0.0) += weight;
        }
        transmittance = next;
    }
    let mut mask = false;
    if let Labels::Mask { coverage_floor, .. } = request.labels {
        let [coverage, scores @ ..] = blend;
        let floor = f64::from(coverage_floor);
        let all = scores.iter().all(|&score| score >= 0.0);
        mask = coverage >= floor && all && scores.iter().any(|&score| score > 0.0);
        let next_to = |k: usize, bound: f64| {
            summed[k] > 0.0 && (blend[k] - bound).abs() <= CLIFF_MASK * summed[k]
        };
        cliff.mask = next_to(0, floor) || (1..BLEND_WIDTH).any(|k| next_to(k, 0.0));
    }
    let behind = match &request.background {
        Background::Color(color) => DVec3::from(color.map(f64::from)),
        Background::Backdrop(backdrop) => {
            let pose = request.camera.camera_to_world;
            let ray = request.camera.intrinsics.unproject(center.x, center.y, 1.0);
            let direction = pose.rotation() * ray;
            cliff.pole = direction.x.hypot(direction.z) < CLIFF_POLE * direction.y.abs();
            DVec3::from(backdrop.color(direction).map(f64::from))
        }
    };
    OraclePixel {
        color: (color + (1.0 - alpha_sum) * behind).into(),
        depth: if alpha_sum > 0.0 { depth / alpha_sum } else { 0.0 },
        alpha: alpha_sum,
        blend,
        mask,
        weights,
        cliff,
    }
}
