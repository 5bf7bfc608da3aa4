//! What a view from afar costs: the generated scene from so many times the distance, with merged
//! Gaussians of several details, and how far each picture then is from that of all Gaussians.

use std::sync::Arc;

use glam::DVec3;
use serde_json::json;

use super::{Args, frontier::times, generated::scene};
use crate::{
    error::{Error, Result},
    render::{
        Frame, Kinds, Layer, RenderRequest, Source,
        compare::{differences, psnr},
    },
    rows::Rows,
    scene::{Camera, CameraToWorld, Gaussians},
};

use segsplat_testing::scenes;

/// Distance of the scene from its camera, world units.
const DISTANCE: f64 = 4.0;

/// Details to time, and of what.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct DetailArgs {
    /// Details to ask for, pixels; the first is what the others are compared with
    #[arg(long, value_delimiter = ',', default_value = "0,0.25,0.5,1,2")]
    details: Vec<f32>,
    /// How many times as far the camera is as the photos were
    #[arg(long, default_value_t = 10.0)]
    times: f64,
    #[command(flatten)]
    frames: Args,
}

/// The view from afar: of a file of Gaussians, and as a scene of photos is served, where each
/// Gaussian is blurred as it was learnt.
fn views(args: &DetailArgs) -> Result<(Gaussians, [(&'static str, RenderRequest); 2])> {
    let DetailArgs { frames, times, .. } = args;
    let (gaussians, camera) = scene(frames.gaussians, 0, [frames.width(), frames.size])?;
    let eye = camera.camera_to_world.center() - DISTANCE * (times - 1.0) * DVec3::Z;
    let camera_to_world = CameraToWorld::look_at(eye, eye + DVec3::Z, DVec3::NEG_Y, "bench")?;
    let camera = Camera { camera_to_world, ..camera };
    let plain = RenderRequest { kinds: Kinds::COLOR, ..scenes::request(camera) };
    let side = (gaussians.len() / 2).isqrt() as u32;
    let photo = Source {
        center: [0.0; 3],
        axis: [0.0, 0.0, 1.0],
        scale: (1.0 / scenes::camera(side, side).intrinsics.fx) as f32,
        layer: Layer::Front,
    };
    let served = RenderRequest { sources: Arc::new([photo]), ..plain.clone() };
    Ok((gaussians, [("file", plain), ("photos", served)]))
}

/// Makes a row for each view and detail. Times are the least, of the device where it has a clock,
/// else of a call; `share` is this time over that of the first detail. Differences are to the first
/// detail's picture; `shown_psnr_db` is over the pixels that show some of the scene.
///
/// # Errors
/// `invalid_request` when an argument is out of range, and those of the renderer.
pub(crate) fn run(args: &DetailArgs, rows: &mut Rows) -> Result<()> {
    let DetailArgs { details, frames, .. } = args;
    frames.check()?;
    if details.is_empty() {
        return Err(Error::invalid("--details must have at least one"));
    }
    let (gaussians, views) = views(args)?;
    let (renderer, _) = frames.setup.renderer(frames.switches())?;
    for (view, request) in views {
        let of = |&detail: &f32| RenderRequest { detail, ..request.clone() };
        let requests: Vec<RenderRequest> = details.iter().map(of).collect();
        let draw = |request: &RenderRequest| {
            let kinds = Kinds { alpha: true, ..Kinds::COLOR };
            renderer.render(&gaussians, &RenderRequest { kinds, ..request.clone() })
        };
        let pictures: Vec<Frame> = requests.iter().map(draw).collect::<Result<_>>()?;
        let times = times(&*renderer, &gaussians, &requests, frames.frames)?;
        let exact = &pictures[0];
        let shown: Vec<bool> = exact.alpha.iter().flatten().map(|&alpha| alpha > 0.0).collect();
        for ((asked, picture), ms) in details.iter().zip(&pictures).zip(&times) {
            let colors = picture.color.as_ref().zip(exact.color.as_ref());
            let apart = differences(picture, exact).into_iter().fold(0.0, f32::max);
            let error = json!({
                "asked": asked,
                "psnr_db": colors.map(|(got, want)| psnr(got, want, None)),
                "shown_psnr_db": colors.map(|(got, want)| psnr(got, want, Some(&shown))),
                "max": 255.0 * apart,
            });
            let row = json!({
                "renderer": renderer.name(),
                "view": view,
                "asked": asked.to_string(),
                "times": args.times,
                "gaussians": gaussians.len(),
                "width": picture.width,
                "height": picture.height,
                "visible": picture.stats.visible,
                "shown_pixels": shown.iter().filter(|shown| **shown).count(),
                "intersections": picture.stats.intersections,
                "ms": ms,
                "share": ms / times[0],
            });
            rows.push(error, row)?;
        }
    }
    Ok(())
}
