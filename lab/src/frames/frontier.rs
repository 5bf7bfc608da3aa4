//! Time against error: what a view gains that may differ from the exact one by so many levels, and
//! how far it then is from it, of six scenes that differ in what there is to gain.

use glam::DVec3;
use segsplat_testing::scenes;
use serde_json::json;

use super::{Args, Drawing, generated::scene};
use crate::{
    error::{Error, Result},
    render::{
        Frame, Kinds, RenderRequest, Renderer,
        compare::{differences, psnr},
    },
    rows::{Rows, median},
    scene::{Camera, CameraToWorld, Gaussians},
};

/// Errors to time, and of what.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct FrontierArgs {
    /// Errors to ask for, levels of 255; the first is what the others are compared with
    #[arg(long, value_delimiter = ',', default_value = "0,0.5,1,2,4,8,16,32")]
    errors: Vec<f32>,
    #[command(flatten)]
    frames: Args,
}

/// The generated scene; the same seen large; from far away; walls of eight photos behind each
/// other; a cloud whose colours depend on the direction; and sheets that light passes.
fn six(args: &Args) -> Result<[(&'static str, Gaussians, RenderRequest); 6]> {
    let (photos, camera) = scene(args.gaussians, 0, [args.width(), args.size])?;
    let colors = |camera| RenderRequest { kinds: Kinds::COLOR, ..scenes::request(camera) };
    let eye = camera.camera_to_world.center();
    let seen_from = |eye: DVec3| -> Result<Camera> {
        let camera_to_world = CameraToWorld::look_at(eye, eye + DVec3::Z, DVec3::NEG_Y, "bench")?;
        Ok(Camera { camera_to_world, ..camera })
    };
    let large =
        Camera { intrinsics: camera.intrinsics.resized(4 * args.width(), 4 * args.size), ..camera };
    let mut raw = photos.clone().into_raw();
    for (i, (mean, scale)) in raw.means.iter_mut().zip(&mut raw.scales).enumerate() {
        let away = 1.0 + 0.02 * (i % 8) as f32;
        *mean = mean.map(|v| v * away);
        *scale = scale.map(|v| v * 8.0_f32.sqrt());
    }
    let many = Gaussians::sanitize(raw)?.0;
    let side = (args.gaussians / 40).isqrt().max(1) as u32;
    let wide = scenes::camera(args.width(), args.size);
    Ok([
        ("photos", photos.clone(), colors(camera)),
        ("large", photos.clone(), colors(large)),
        ("far", photos, colors(seen_from(eye - 16.0 * DVec3::Z)?)),
        ("many", many, colors(camera)),
        ("cloud", scenes::cloud(args.gaussians, 3, 3), colors(wide)),
        ("sheets", scenes::sheets(40, side, 0.3, 1), colors(wide)),
    ])
}

/// Makes a row for each scene and error. Times are the least, of the device where it has a clock,
/// else of a call; `ratio` is the time of the first error over that of this one. Differences are to
/// the first error's picture, in levels of 255.
///
/// # Errors
/// `invalid_request` when an argument is out of range, and those of the renderer.
pub(crate) fn run(args: &FrontierArgs, rows: &mut Rows) -> Result<()> {
    let FrontierArgs { errors, frames } = args;
    frames.check()?;
    if errors.is_empty() {
        return Err(Error::invalid("--errors must have at least one"));
    }
    let (renderer, _) = frames.setup.renderer(frames.switches())?;
    for (scene, gaussians, request) in six(frames)? {
        let requests: Vec<RenderRequest> =
            errors.iter().map(|&error| RenderRequest { error, ..request.clone() }).collect();
        let pictures: Result<Vec<Frame>> =
            requests.iter().map(|request| renderer.render(&gaussians, request)).collect();
        let times = times(&*renderer, &gaussians, &requests, frames.frames)?;
        let pictures = pictures?;
        for ((asked, picture), ms) in errors.iter().zip(&pictures).zip(&times) {
            let apart = differences(picture, &pictures[0]);
            let mean = apart.iter().map(|&d| f64::from(d)).sum::<f64>() / apart.len().max(1) as f64;
            let colors = picture.color.as_ref().zip(pictures[0].color.as_ref());
            let error = json!({
                "asked": asked,
                "max": 255.0 * apart.into_iter().fold(0.0, f32::max),
                "mean": 255.0 * mean,
                "psnr_db": colors.map(|(got, want)| psnr(got, want, None)),
            });
            let row = json!({
                "renderer": renderer.name(),
                "scene": scene,
                "asked": asked.to_string(),
                "gaussians": gaussians.len(),
                "width": picture.width,
                "height": picture.height,
                "intersections": picture.stats.intersections,
                "ms": ms,
                "ratio": times[0] / ms,
            });
            rows.push(error, row)?;
        }
    }
    Ok(())
}

/// The time of each request, milliseconds: the least of rounds in which each is drawn in turn. A
/// busy machine changes it least.
pub(super) fn times(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    requests: &[RenderRequest],
    frames: usize,
) -> Result<Vec<f64>> {
    let mut least = vec![f64::INFINITY; requests.len()];
    for _ in 0..frames {
        for (request, least) in requests.iter().zip(&mut least) {
            let drawing = Drawing { renderer, gaussians, request };
            *least = least.min(match drawing.device_times(1)? {
                Some(device) => device.total_ms,
                None => median(drawing.times(1)?),
            });
        }
    }
    Ok(least)
}
