//! The oracle of the backward pass: f64, pixel by pixel, back to front, with the matrices written
//! as matrices. It shares the forward oracle's Gaussians on the picture, and nothing with the
//! kernels that it judges but the derivatives of the harmonics.

use glam::{DMat2, DMat3, DQuat, DVec2, DVec3};
use rayon::prelude::*;

use segsplat_core::{
    error::Result,
    scene::{Gaussians, Intrinsics},
};
use segsplat_render::{
    Background, RenderRequest,
    backward::{FrameGradients, Gradients, basis_slopes},
    constants::{
        ALPHA_MAX, ALPHA_MIN, BLUR_PX2, FRUSTUM_MARGIN, OWN_SIZE, PIXEL_PX2, SH_OFFSET,
        TRANSMITTANCE_MIN,
    },
    oracle::{self, Blur, Splat, source_width},
};

/// Derivatives by the numbers of a Gaussian on the picture.
#[derive(Clone, Copy, Debug)]
struct SplatGradient {
    mean: DVec2,
    /// By the 2D covariance, as a symmetric matrix.
    covariance: DMat2,
    /// By the opacity after its compensation.
    opacity: f64,
    depth: f64,
    color: DVec3,
}

impl SplatGradient {
    /// Not `default()`: that of a matrix is the identity.
    const ZERO: Self = Self {
        mean: DVec2::ZERO,
        covariance: DMat2::ZERO,
        opacity: 0.0,
        depth: 0.0,
        color: DVec3::ZERO,
    };
}

/// What `loss` says of the frame, told of each Gaussian.
///
/// # Errors
/// `invalid_request` when the intrinsics are unusable, `internal` when a picture has another size.
pub fn gradients(
    gaussians: &Gaussians,
    request: &RenderRequest,
    loss: &FrameGradients,
) -> Result<Gradients<f64>> {
    let lens = request.camera.intrinsics.validated("camera")?;
    let Intrinsics { width, height, .. } = request.lens();
    loss.check(width as usize * height as usize)?;
    let corner = request.crop.map_or([0, 0], |crop| [crop.x, crop.y]);
    let mut splats: Vec<(usize, Splat)> = (0..gaussians.len())
        .filter_map(|i| Some((i, oracle::splat(gaussians, i, request, &lens)?)))
        .collect();
    splats.sort_by(|a, b| Splat::order(&a.1, &b.1));
    let of_pixel = |at: u32| -> Vec<(usize, SplatGradient)> {
        let [x, y] = [at % width + corner[0], at / width + corner[1]];
        let center = DVec2::new(f64::from(x) + 0.5, f64::from(y) + 0.5);
        pixel(&splats, center, request, loss, at as usize)
    };
    let pixels: Vec<_> = (0..width * height).into_par_iter().map(of_pixel).collect();
    let mut sums = vec![SplatGradient::ZERO; gaussians.len()];
    for (i, more) in pixels.into_iter().flatten() {
        let sum = &mut sums[i];
        sum.mean += more.mean;
        sum.covariance += more.covariance;
        sum.opacity += more.opacity;
        sum.depth += more.depth;
        sum.color += more.color;
    }
    let mut out = Gradients::default();
    out.clear(gaussians.len(), gaussians.sh_count());
    for (i, _) in &splats {
        out.seen[*i] = true;
        back(gaussians, *i, request, &lens, &sums[*i], &mut out);
    }
    Ok(out)
}

/// What one pixel says of each Gaussian that adds to it.
fn pixel(
    splats: &[(usize, Splat)],
    center: DVec2,
    request: &RenderRequest,
    loss: &FrameGradients,
    at: usize,
) -> Vec<(usize, SplatGradient)> {
    // Front to back: who counts, with the transmittance before each.
    let mut counted: Vec<(usize, &Splat, f64, f64)> = Vec::new();
    let (mut transmittance, mut alpha_sum, mut depth_sum) = (1.0, 0.0, 0.0);
    for (i, splat) in splats {
        let alpha = splat.alpha(center);
        if alpha < f64::from(ALPHA_MIN) {
            continue;
        }
        let next = transmittance * (1.0 - alpha);
        if next <= f64::from(TRANSMITTANCE_MIN) {
            break;
        }
        counted.push((*i, splat, alpha, transmittance));
        alpha_sum += alpha * transmittance;
        depth_sum += alpha * transmittance * splat.depth;
        transmittance = next;
    }
    let by_color = loss.color.as_ref().map_or(DVec3::ZERO, |of| DVec3::from(of[at].map(f64::from)));
    let by_alpha = loss.alpha.as_ref().map_or(0.0, |of| f64::from(of[at]));
    let by_depth = match &loss.depth {
        Some(of) if alpha_sum > 0.0 => f64::from(of[at]) / alpha_sum,
        _ => 0.0,
    };
    let behind = match &request.background {
        Background::Color(color) => DVec3::from(color.map(f64::from)),
        Background::Backdrop(backdrop) => {
            let ray = request.camera.intrinsics.unproject(center.x, center.y, 1.0);
            let direction = request.camera.camera_to_world.rotation() * ray;
            DVec3::from(backdrop.color(direction).map(f64::from))
        }
    };
    let depth = if alpha_sum > 0.0 { depth_sum / alpha_sum } else { 0.0 };
    // Back to front: `rest` is what all Gaussians behind are worth.
    let mut rest = 0.0;
    let mut found = Vec::with_capacity(counted.len());
    for (i, splat, alpha, before) in counted.into_iter().rev() {
        let weight = alpha * before;
        let worth =
            by_color.dot(splat.color - behind) + by_depth * (splat.depth - depth) + by_alpha;
        let mut by = SplatGradient {
            depth: weight * by_depth,
            color: weight * by_color,
            ..SplatGradient::ZERO
        };
        if alpha < f64::from(ALPHA_MAX) {
            let by_alpha = before * worth - rest / (1.0 - alpha);
            let by_power = -alpha * by_alpha;
            let p = splat.conic * (center - splat.mean);
            by.opacity = by_alpha * alpha / splat.opacity;
            by.mean = -by_power * p;
            by.covariance = DMat2::from_cols(p * p.x, p * p.y) * (-0.5 * by_power);
        }
        rest += weight * worth;
        found.push((i, by));
    }
    found
}

/// From the picture back to the Gaussian, step by step as [`oracle::splat`] goes forward.
fn back(
    gaussians: &Gaussians,
    i: usize,
    request: &RenderRequest,
    lens: &Intrinsics,
    by: &SplatGradient,
    out: &mut Gradients<f64>,
) {
    let pose = request.camera.camera_to_world;
    let mean = DVec3::from(gaussians.means()[i].map(f64::from));
    let from_eye = mean - (pose.center() - gaussians.origin());
    let w = pose.rotation().transpose();
    let t = w * from_eye;
    let (fx, fy, z) = (lens.fx, lens.fy, t.z);
    let bounded = |ratio: f64, focal: f64, center: f64, size: u32| {
        let margin = f64::from(FRUSTUM_MARGIN) * 0.5 * f64::from(size) / focal;
        let bound =
            ratio.max(-center / focal - margin).min((f64::from(size) - center) / focal + margin);
        (bound, if bound == ratio { 1.0 } else { 0.0 })
    };
    let (slope_x, free_x) = bounded(t.x / z, fx, lens.cx, lens.width);
    let (slope_y, free_y) = bounded(t.y / z, fy, lens.cy, lens.height);
    // J as the first two rows of a 3x3.
    let jacobian = DMat3::from_cols(
        DVec3::new(fx / z, 0.0, 0.0),
        DVec3::new(0.0, fy / z, 0.0),
        DVec3::new(-fx * slope_x / z, -fy * slope_y / z, 0.0),
    );
    let [qw, qx, qy, qz] = gaussians.quats()[i].map(f64::from);
    let given = DQuat::from_xyzw(qx, qy, qz, qw);
    let unit = given.normalize();
    let r = DMat3::from_quat(unit);
    // What the blur lost: 0.3 (w² - (z OWN_SIZE / f)²) where that is over 0.
    let own = f64::from(OWN_SIZE) / fx.max(fy);
    let source = request.sources.get(usize::from(gaussians.source()[i].view));
    let (mut lost, mut lost_by_mean, mut lost_by_z) = (0.0, DVec3::ZERO, 0.0);
    // The square of the size of what is shown smaller, which the blur depends on.
    let Blur { learnt, drawn } = Blur::of(source, mean, z, lens, request.antialiased);
    let (mut size_by_mean, mut size_by_z) = (DVec3::ZERO, 0.0);
    if let Some(source) = source {
        let axis = DVec3::from(source.axis.map(f64::from));
        let scale = f64::from(source.scale);
        let width = source_width(source, mean);
        if learnt < f64::from(BLUR_PX2) {
            let size = learnt / f64::from(BLUR_PX2);
            size_by_mean = axis * (2.0 * size / width * scale);
            size_by_z = -2.0 * size / z;
        }
        if width > own * z {
            let blur = f64::from(BLUR_PX2);
            lost = blur * (width * width - (own * z).powi(2));
            lost_by_mean = axis * (2.0 * blur * width * scale);
            lost_by_z = -2.0 * blur * own * own * z;
        }
    }
    let scales = DVec3::from(gaussians.scales()[i].map(f64::from));
    let widened = (scales * scales + lost).map(f64::sqrt);
    let turned = w * r;
    let local = turned * DMat3::from_diagonal(widened);
    let a = jacobian * local;
    // Opacity, and the covariance where the opacity is compensated.
    let three =
        |m: DMat2| DMat3::from_cols(m.x_axis.extend(0.0), m.y_axis.extend(0.0), DVec3::ZERO);
    let mut by_covariance = by.covariance;
    let mut by_opacity = by.opacity;
    let mut by_size = 0.0;
    if request.antialiased || learnt < f64::from(BLUR_PX2) {
        let (row0, row1) = (a.row(0), a.row(1));
        let sharp_det = row0.cross(row1).length_squared();
        let (xx, xy, yy) = (row0.dot(row0), row0.dot(row1), row1.dot(row1));
        let adjugate =
            |blur: f64| DMat2::from_cols(DVec2::new(yy + blur, -xy), DVec2::new(-xy, xx + blur));
        let trace = |of: DMat2| of.x_axis.x + of.y_axis.y;
        let (inner, least) =
            if request.antialiased { (0.0, 0.0) } else { (learnt, f64::from(ALPHA_MIN)) };
        let blurred = |blur: f64| sharp_det + blur * (xx + yy) + blur * blur;
        let (kept, det) = (blurred(inner), blurred(drawn));
        let share = (kept / det).max(0.0).sqrt();
        if kept > 0.0 {
            let by_share = by.opacity * (f64::from(gaussians.opacities()[i]) - least);
            let by_kept = adjugate(inner) * (0.5 * by_share / (kept * det).sqrt());
            let by_det = adjugate(drawn) * (-0.5 * by_share * share / det);
            by_covariance += by_kept + by_det;
            let (blur, pixel) = (f64::from(BLUR_PX2), f64::from(PIXEL_PX2));
            by_size = blur * trace(by_kept) + (blur - pixel) * trace(by.covariance + by_det);
        }
        by_opacity *= share;
    }
    let by_a = three(by_covariance) * a * 2.0;
    let by_jacobian = by_a * local.transpose();
    let by_local = jacobian.transpose() * by_a;
    let mut by_scales = DVec3::ZERO;
    let mut by_turned = DMat3::ZERO;
    for k in 0..3 {
        by_scales[k] = by_local.col(k).dot(turned.col(k));
        *by_turned.col_mut(k) = by_local.col(k) * widened[k];
    }
    let by_lost: f64 = (0..3).map(|k| by_scales[k] / (2.0 * widened[k])).sum();
    let by_r = w.transpose() * by_turned;
    let by_slope =
        [-by_jacobian.row(0).z * fx / z * free_x, -by_jacobian.row(1).z * fy / z * free_y];
    let by_t = DVec3::new(
        by.mean.x * fx / z + by_slope[0] / z,
        by.mean.y * fy / z + by_slope[1] / z,
        by.depth + by_lost * lost_by_z + by_size * size_by_z
            - (by.mean.x * fx * t.x + by.mean.y * fy * t.y + by_slope[0] * t.x + by_slope[1] * t.y)
                / (z * z)
            - (by_jacobian.row(0).x * fx + by_jacobian.row(1).y * fy) / (z * z)
            + (by_jacobian.row(0).z * fx * slope_x + by_jacobian.row(1).z * fy * slope_y) / (z * z),
    );
    let mut by_mean = w.transpose() * by_t + lost_by_mean * by_lost + size_by_mean * by_size;
    by_mean += of_color(gaussians, i, from_eye, by.color, &mut out.sh);
    out.means[i] = by_mean.into();
    out.scales[i] = std::array::from_fn(|k| by_scales[k] * scales[k] / widened[k]);
    out.opacities[i] = by_opacity;
    let by_unit = of_rotation(unit, &by_r);
    let across = (by_unit - unit * by_unit.dot(unit)) / given.length();
    out.quats[i] = [across.w, across.x, across.y, across.z];
}

/// By the unit quaternion, from what is known by its matrix.
fn of_rotation(DQuat { x, y, z, w }: DQuat, by: &DMat3) -> DQuat {
    // The matrix is a sum of products of two of the four numbers.
    let slopes = [
        // x, y, z, w; each as rows of the matrix.
        [[0.0, y, z], [y, -2.0 * x, -w], [z, w, -2.0 * x]],
        [[-2.0 * y, x, w], [x, 0.0, z], [-w, z, -2.0 * y]],
        [[-2.0 * z, -w, x], [w, -2.0 * z, y], [x, y, 0.0]],
        [[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]],
    ];
    let [x, y, z, w] = slopes.map(|slope| {
        let rows = slope.into_iter().enumerate();
        2.0 * rows.map(|(row, slope)| by.row(row).dot(DVec3::from(slope))).sum::<f64>()
    });
    DQuat::from_xyzw(x, y, z, w)
}

/// Writes what is known by the coefficients; returns what is known by the centre.
fn of_color(
    gaussians: &Gaussians,
    i: usize,
    from_eye: DVec3,
    by_color: DVec3,
    by_sh: &mut [[f64; 3]],
) -> DVec3 {
    let k = gaussians.sh_count();
    let own = &gaussians.sh()[i * k..(i + 1) * k];
    let direction = from_eye.normalize_or_zero();
    let weights = oracle::basis(direction);
    let sum: DVec3 =
        own.iter().zip(weights).map(|(&c, weight)| weight * DVec3::from(c.map(f64::from))).sum();
    let color = sum + f64::from(SH_OFFSET);
    let by_color = DVec3::select(color.cmpgt(DVec3::ZERO), by_color, DVec3::ZERO);
    let slopes = basis_slopes(direction.into());
    let mut by_direction = DVec3::ZERO;
    for (at, coefficient) in own.iter().enumerate() {
        by_sh[i * k + at] = (by_color * weights[at]).into();
        by_direction +=
            DVec3::from(slopes[at]) * by_color.dot(DVec3::from(coefficient.map(f64::from)));
    }
    let length = from_eye.length();
    if length > 0.0 {
        (by_direction - direction * by_direction.dot(direction)) / length
    } else {
        DVec3::ZERO
    }
}
