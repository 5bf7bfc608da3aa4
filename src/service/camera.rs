//! A camera as asked for becomes a camera: pose, lens, size; every number checked against a bound.

use glam::DVec3;

use super::request::{CameraSpec, LensSpec, PoseSpec, ViewOptions};
use crate::{
    error::{Error, Result},
    limits::Limits,
    names::shown,
    scene::{Camera, CameraToWorld, Intrinsics, SceneCamera},
};

/// Longer side of a picture whose size nobody asked for, pixels: near what the network saw, so
/// that the gaps between its pixels do not show.
const DEFAULT_SIDE: f64 = 384.0;
/// Focal lengths and principal points accepted, pixels: a view is at most some thousands wide.
const FOCAL_RANGE: [f64; 2] = [1.0, 1e6];
/// Vertical fields of view accepted, degrees.
const FOV_RANGE: [f64; 2] = [0.1, 170.0];
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
    let (from, to, t) = match spec.pose {
        PoseSpec::Between { from, to, t } => {
            if !(0.0..=1.0).contains(&t) {
                return Err(Error::invalid(format!(
                    "{what}: t is {}; it must be 0 to 1",
                    shown(t)
                )));
            }
            (input(inputs, from, "from", what)?, input(inputs, to, "to", what)?, t)
        }
        PoseSpec::CameraToWorld(_) | PoseSpec::LookAt { .. } => {
            let first = inputs.first().map(|input| &input.camera);
            let (width, height) = size(options, first, limits, what)?;
            let intrinsics = match first {
                Some(first) => lens(&spec.lens, fitted(&first.intrinsics, width, height), what)?,
                None => lens(&spec.lens, default_lens(width, height), what)?,
            };
            return Ok(Camera { intrinsics, camera_to_world: pose(spec, inputs, what)? });
        }
    };
    let (width, height) = size(options, Some(from), limits, what)?;
    let between =
        mixed(&fitted(&from.intrinsics, width, height), &fitted(&to.intrinsics, width, height), t);
    Ok(Camera {
        intrinsics: lens(&spec.lens, between, what)?,
        camera_to_world: CameraToWorld::between(&from.camera_to_world, &to.camera_to_world, t),
    })
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
            up.map_or_else(|| mean_up(inputs), DVec3::from_array),
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

/// Up in the pictures of the input cameras; -y where there are none.
fn mean_up(inputs: &[SceneCamera]) -> DVec3 {
    let sum: DVec3 = inputs.iter().map(|c| -c.camera.camera_to_world.rotation().y_axis).sum();
    sum.try_normalize().unwrap_or(DVec3::NEG_Y)
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
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped first")]
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

fn default_lens(width: u32, height: u32) -> Intrinsics {
    vertical_fov(60.0, width, height)
}

fn vertical_fov(degrees: f64, width: u32, height: u32) -> Intrinsics {
    let focal = f64::from(height) / 2.0 / (degrees.to_radians() / 2.0).tan();
    central(focal, focal, width, height)
}

fn central(fx: f64, fy: f64, width: u32, height: u32) -> Intrinsics {
    Intrinsics { fx, fy, cx: f64::from(width) / 2.0, cy: f64::from(height) / 2.0, width, height }
}

/// The lens asked for; `of_scene` has the right size already.
fn lens(spec: &LensSpec, of_scene: Intrinsics, what: &str) -> Result<Intrinsics> {
    let (width, height) = (of_scene.width, of_scene.height);
    let lens = match *spec {
        LensSpec::OfScene => of_scene,
        LensSpec::Fov(degrees) => {
            if !(FOV_RANGE[0]..=FOV_RANGE[1]).contains(&degrees) {
                return Err(Error::invalid(format!(
                    "{what}: fov is {} degrees; it must be {} to {}",
                    shown(degrees),
                    FOV_RANGE[0],
                    FOV_RANGE[1]
                )));
            }
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
        if !(least..=FOCAL_RANGE[1]).contains(&value) {
            return Err(Error::invalid(format!(
                "{what}: {name} is {} px; it must be {least} to {}",
                shown(value),
                FOCAL_RANGE[1]
            )));
        }
    }
    Ok(lens)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn inputs() -> Vec<SceneCamera> {
        let at = |x: f64, turn: f64| {
            let eye = DVec3::new(x, 0.0, 0.0);
            let target = eye + DVec3::new(turn.sin(), 0.0, turn.cos());
            let camera_to_world =
                CameraToWorld::look_at(eye, target, DVec3::NEG_Y, "test").unwrap();
            let intrinsics =
                Intrinsics { fx: 400.0, fy: 410.0, cx: 250.0, cy: 190.0, width: 500, height: 400 };
            SceneCamera {
                file: String::new(),
                camera: Camera { intrinsics, camera_to_world },
                network: None,
            }
        };
        vec![at(0.0, 0.0), at(1.0, 0.5)]
    }

    fn between(t: f64) -> CameraSpec {
        CameraSpec { pose: PoseSpec::Between { from: 0, to: 1, t }, lens: LensSpec::OfScene }
    }

    fn sized(width: Option<u32>, height: Option<u32>) -> ViewOptions {
        ViewOptions { width, height, ..ViewOptions::default() }
    }

    fn resolved(spec: &CameraSpec, options: &ViewOptions) -> Result<Camera> {
        resolve(spec, options, &inputs(), &Limits::default(), "camera")
    }

    #[test]
    fn the_ends_of_a_way_are_the_input_cameras_themselves() {
        let inputs = inputs();
        for (t, input) in [(0.0, &inputs[0]), (1.0, &inputs[1])] {
            let camera = resolved(&between(t), &sized(Some(500), Some(400))).unwrap();
            let a = camera.camera_to_world.matrix();
            let b = input.camera.camera_to_world.matrix();
            assert!(a.abs_diff_eq(b, 1e-12), "t = {t}: {a} is not {b}");
            assert_eq!(camera.intrinsics, input.camera.intrinsics);
        }
    }

    #[test]
    fn halfway_is_half_the_way_and_half_the_turn() {
        let camera = resolved(&between(0.5), &sized(None, None)).unwrap();
        let pose = camera.camera_to_world;
        assert!((pose.center() - DVec3::new(0.5, 0.0, 0.0)).length() < 1e-12);
        assert!((pose.axis() - DVec3::new(0.25_f64.sin(), 0.0, 0.25_f64.cos())).length() < 1e-9);
    }

    #[test]
    fn a_lens_fitted_to_another_shape_keeps_square_pixels_and_the_middle() {
        let camera = resolved(&between(0.0), &sized(Some(1000), Some(400))).unwrap();
        let Intrinsics { fx, fy, cx, cy, .. } = camera.intrinsics;
        assert_eq!((fx, fy), (800.0, 820.0), "twice the size");
        assert_eq!((cx, cy), (500.0, 380.0 - 200.0), "rows cut above and below alike");
    }

    #[test]
    fn a_missing_side_follows_the_shape_of_the_photos() {
        for (options, want) in [
            (sized(Some(250), None), (250, 200)),
            (sized(None, Some(800)), (1000, 800)),
            (sized(None, None), (384, 307)),
        ] {
            let lens = resolved(&between(0.0), &options).unwrap().intrinsics;
            assert_eq!((lens.width, lens.height), want);
        }
    }

    #[test]
    fn look_at_without_up_stands_as_the_photos_stand() {
        let pose = PoseSpec::LookAt { eye: [0.0, 0.0, -2.0], target: [0.0; 3], up: None };
        let spec = CameraSpec { pose, lens: LensSpec::Fov(90.0) };
        let camera = resolved(&spec, &sized(Some(300), Some(200))).unwrap();
        assert!((camera.camera_to_world.rotation().y_axis - DVec3::Y).length() < 1e-12);
        assert!((camera.intrinsics.fy - 100.0).abs() < 1e-9, "90 degrees: half the height");
    }

    #[test]
    fn what_cannot_be_is_refused_with_name_value_and_bound() {
        let eye = |eye| PoseSpec::LookAt { eye, target: [0.0; 3], up: None };
        let focal = |fx| LensSpec::Focal { fx, fy: None, cx: None, cy: None };
        let fine = eye([0.0, 0.0, -1.0]);
        let spec = |pose, lens| CameraSpec { pose, lens };
        let cases = [
            (between(1.5), sized(None, None), "t is 1.5"),
            (between(f64::NAN), sized(None, None), "t is NaN"),
            (
                spec(PoseSpec::Between { from: 0, to: 7, t: 0.0 }, LensSpec::OfScene),
                sized(None, None),
                "to is 7; the scene has 2 cameras",
            ),
            (between(0.0), sized(Some(0), None), "width is 0 px"),
            (between(0.0), sized(None, Some(100_000)), "height: 100000 px is over 4096 px"),
            (spec(fine, focal(0.0)), sized(None, None), "fx is 0"),
            (spec(fine, focal(-3.0)), sized(None, None), "fx is -3"),
            (spec(fine, focal(f64::INFINITY)), sized(None, None), "not a finite number"),
            (spec(fine, focal(1e9)), sized(None, None), "fx is 1000000000 px"),
            (spec(fine, LensSpec::Fov(180.0)), sized(None, None), "fov is 180"),
            (spec(eye([0.0; 3]), LensSpec::OfScene), sized(None, None), "the same point"),
            (spec(eye([1e30, 0.0, 0.0]), LensSpec::OfScene), sized(None, None), "1e30"),
        ];
        for (spec, options, want) in cases {
            let error = resolved(&spec, &options).expect_err(want);
            assert!(error.message().contains(want), "{:?} lacks {want:?}", error.message());
        }
    }
}
