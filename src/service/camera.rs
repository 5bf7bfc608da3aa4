//! The camera of a request: pose, lens and size. Every number is checked against a bound.

use glam::DVec3;

use super::request::{CameraSpec, LensSpec, PoseSpec, ViewOptions};
use crate::{
    error::{Error, Result},
    limits::{FOCAL_RANGE, FOV_RANGE, Limits},
    names::shown,
    scene::{Camera, CameraToWorld, Intrinsics, SceneCamera},
};

/// Longer side of a picture when a request gives no size, pixels. It is near the size that the
/// network reads, so no gaps show between its pixels.
const DEFAULT_SIDE: f64 = 384.0;
/// Vertical field of view of a scene without cameras, degrees.
const DEFAULT_FOV: f64 = 60.0;
/// Largest coordinate of a camera centre: that of a Gaussian.
const COORDINATE_MAX: f64 = 1e9;

/// The camera of `spec` for pictures of the size in `options`. `what` names it in messages.
pub(super) fn resolve(
    spec: &CameraSpec,
    options: &ViewOptions,
    inputs: &[SceneCamera],
    limits: &Limits,
    what: &str,
) -> Result<Camera> {
    if let PoseSpec::Between { from, to, t } = spec.pose {
        in_range(what, "t", t, "", [0.0, 1.0])?;
        let (from, to) = (input(inputs, from, "from", what)?, input(inputs, to, "to", what)?);
        let (width, height) = size(options, Some(from), limits, what)?;
        let [a, b] = [from, to].map(|input| fitted(&input.intrinsics, width, height));
        return Ok(Camera {
            intrinsics: lens(&spec.lens, mixed(&a, &b, t), what)?,
            camera_to_world: CameraToWorld::between(&from.camera_to_world, &to.camera_to_world, t),
        });
    }
    let first = inputs.first().map(|input| &input.camera);
    let (width, height) = size(options, first, limits, what)?;
    let of_scene = match first {
        Some(first) => fitted(&first.intrinsics, width, height),
        None => vertical_fov(DEFAULT_FOV, width, height),
    };
    let intrinsics = lens(&spec.lens, of_scene, what)?;
    Ok(Camera { intrinsics, camera_to_world: pose(spec, inputs, what)? })
}

/// Refuses a value outside a range.
fn in_range(what: &str, name: &str, value: f64, unit: &str, [least, most]: [f64; 2]) -> Result<()> {
    if (least..=most).contains(&value) {
        return Ok(());
    }
    let value = shown(value);
    Err(Error::invalid(format!("{what}: {name} is {value}{unit}; it must be {least} to {most}")))
}

fn input<'a>(
    inputs: &'a [SceneCamera],
    index: usize,
    name: &str,
    what: &str,
) -> Result<&'a Camera> {
    inputs.get(index).map(|input| &input.camera).ok_or_else(|| {
        Error::invalid(format!("{what}: {name} is {index}; the scene has {} cameras", inputs.len()))
    })
}

fn pose(spec: &CameraSpec, inputs: &[SceneCamera], what: &str) -> Result<CameraToWorld> {
    if let PoseSpec::LookAt { eye, target, up } = spec.pose {
        for (name, point) in [("eye", eye), ("target", target), ("up", up.unwrap_or_default())] {
            let far = point.into_iter().find(|v| v.is_finite() && v.abs() > COORDINATE_MAX);
            if let Some(far) = far {
                return Err(Error::invalid(format!(
                    "{what}: {name} has {}; coordinates reach at most {COORDINATE_MAX:e}",
                    shown(far)
                )));
            }
        }
    }
    let pose = match spec.pose {
        PoseSpec::CameraToWorld(matrix) => CameraToWorld::from_row_major(&matrix, what)?,
        PoseSpec::LookAt { eye, target, up } => CameraToWorld::look_at(
            DVec3::from_array(eye),
            DVec3::from_array(target),
            up.map_or_else(|| SceneCamera::mean_up(inputs), DVec3::from_array),
            what,
        )?,
        PoseSpec::Between { .. } => {
            return Err(Error::internal("a pose between cameras was not interpolated"));
        }
    };
    let reach = pose.center().abs().max_element();
    if reach > COORDINATE_MAX {
        return Err(Error::invalid(format!(
            "{what}: the camera stands at {reach:e}; coordinates reach at most {COORDINATE_MAX:e}"
        )));
    }
    Ok(pose)
}

fn size(
    options: &ViewOptions,
    input: Option<&Camera>,
    limits: &Limits,
    what: &str,
) -> Result<(u32, u32)> {
    for (name, side) in [("width", options.width), ("height", options.height)] {
        if side == Some(0) {
            return Err(Error::invalid(format!("{what}: {name} is 0 px; it must be at least 1")));
        }
        if let Some(side) = side.filter(|&side| side > limits.view_side_max) {
            let bound = format!("{} px", limits.view_side_max);
            return Err(Error::limit(format!("{what}: {name}"), format!("{side} px"), bound));
        }
    }
    let (w, h) = input.map_or((DEFAULT_SIDE, DEFAULT_SIDE), |camera| {
        (f64::from(camera.intrinsics.width), f64::from(camera.intrinsics.height))
    });
    let shrink = (DEFAULT_SIDE / w.max(h)).min(1.0);
    let side = |value: f64| value.round().clamp(1.0, f64::from(limits.view_side_max)) as u32;
    Ok(match (options.width, options.height) {
        (Some(width), Some(height)) => (width, height),
        (Some(width), None) => (width, side(f64::from(width) * h / w)),
        (None, Some(height)) => (side(f64::from(height) * w / h), height),
        (None, None) => (side(w * shrink), side(h * shrink)),
    })
}

/// The lens for pictures of another size: scaled until it covers them, the middle kept.
fn fitted(lens: &Intrinsics, width: u32, height: u32) -> Intrinsics {
    let (w, h) = (f64::from(lens.width), f64::from(lens.height));
    let scale = (f64::from(width) / w).max(f64::from(height) / h);
    Intrinsics {
        fx: lens.fx * scale,
        fy: lens.fy * scale,
        cx: lens.cx * scale - (w * scale - f64::from(width)) / 2.0,
        cy: lens.cy * scale - (h * scale - f64::from(height)) / 2.0,
        width,
        height,
    }
}

fn mixed(from: &Intrinsics, to: &Intrinsics, t: f64) -> Intrinsics {
    let mix = |a: f64, b: f64| a + (b - a) * t;
    Intrinsics {
        fx: mix(from.fx, to.fx),
        fy: mix(from.fy, to.fy),
        cx: mix(from.cx, to.cx),
        cy: mix(from.cy, to.cy),
        ..*from
    }
}

fn vertical_fov(degrees: f64, width: u32, height: u32) -> Intrinsics {
    let focal = f64::from(height) / 2.0 / (degrees.to_radians() / 2.0).tan();
    central(focal, focal, width, height)
}

fn central(fx: f64, fy: f64, width: u32, height: u32) -> Intrinsics {
    Intrinsics { fx, fy, cx: f64::from(width) / 2.0, cy: f64::from(height) / 2.0, width, height }
}

/// The lens of the request; `of_scene` has the right size already.
fn lens(spec: &LensSpec, of_scene: Intrinsics, what: &str) -> Result<Intrinsics> {
    let (width, height) = (of_scene.width, of_scene.height);
    let lens = match *spec {
        LensSpec::OfScene => of_scene,
        LensSpec::Fov(degrees) => {
            in_range(what, "fov", degrees, " degrees", FOV_RANGE)?;
            vertical_fov(degrees, width, height)
        }
        LensSpec::Focal { fx, fy, cx, cy } => {
            let middle = central(fx, fy.unwrap_or(fx), width, height);
            Intrinsics { cx: cx.unwrap_or(middle.cx), cy: cy.unwrap_or(middle.cy), ..middle }
        }
    }
    .validated(what)?;
    for (name, value, least) in [
        ("fx", lens.fx, FOCAL_RANGE[0]),
        ("fy", lens.fy, FOCAL_RANGE[0]),
        ("cx", lens.cx, -FOCAL_RANGE[1]),
        ("cy", lens.cy, -FOCAL_RANGE[1]),
    ] {
        in_range(what, name, value, " px", [least, FOCAL_RANGE[1]])?;
    }
    Ok(lens)
}
