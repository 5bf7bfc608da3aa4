//! Scenes of two photos of a capture, as the server makes them, and what is drawn of them: views
//! from afar, and the Gaussians as files of other programs.

use std::{path::Path, sync::Arc, time::Instant};

use segsplat_formats::{
    splats::SplatFile,
    table::{read_splats, splat_formats},
};
use serde_json::json;

use crate::{
    error::{Error, Result},
    limits::Limits,
    metrics::{clamped, psnr},
    photo_files,
    pipeline::Pipeline,
    render::{
        Kinds, RenderRequest, Renderer, Source,
        cpu::CpuRenderer,
        plan::{served, widened},
    },
    rows::{Rows, median, ms},
    scene::{Camera, CameraToWorld, Gaussians, Scene, SceneOptions},
    scenes::{is_posed, make, nearest, scene_of, view_request},
    setup::Inputs,
};

/// How much smaller than the scene's own picture the views from afar are.
const SMALLER: [u32; 2] = [4, 8];
/// Times that a file is written.
const RUNS: usize = 5;

/// The scene of the middle photo of a capture and the one nearest to it, and the view between both,
/// as large as the picture in which the network saw them: a multiple of the smallest view from
/// afar.
fn scene(engine: &Pipeline, name: &str, dir: &Path) -> Result<(Scene, Camera)> {
    let photos = photo_files::read_dir(dir, &Limits::default())?;
    let middle = photos.len() / 2;
    let [near] = nearest(&photos, middle, 1)[..] else {
        return Err(Error::invalid(format!("{name}: there are no two photos")));
    };
    let given = [middle, near].map(|i| photos[i].clone());
    let scene = scene_of(make(engine, &given, &SceneOptions::default())?);
    let [a, b] = [&given[0].camera, &given[1].camera];
    let camera_to_world = CameraToWorld::between(&a.camera_to_world, &b.camera_to_world, 0.5);
    let (lens, focal) = (a.intrinsics, scene.meta.report.network_focal_px.first());
    let share = focal.copied().unwrap_or(lens.fx) / lens.fx;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a size")]
    let side =
        |of: u32| SMALLER[1] * (f64::from(of) * share / f64::from(SMALLER[1])).round() as u32;
    let intrinsics = lens.resized(side(lens.width), side(lens.height));
    Ok((scene, Camera { camera_to_world, intrinsics }))
}

/// Makes a row for each scene: PSNR of its view from afar to the mean of the squares of the same
/// view at the scene's own size, as served, by the blur of the full size alone, and in gsplat's
/// antialiased mode.
///
/// # Errors
/// `invalid_request` when there is no scene, else whatever a stage of the pipeline says.
pub(crate) fn afar(inputs: &Inputs, rows: &mut Rows) -> Result<()> {
    let engine = Pipeline::open(&inputs.setup.networks(1))?;
    let renderer = CpuRenderer::new(inputs.setup.threads())?;
    for (name, dir) in inputs.find(is_posed)? {
        let (scene, camera) = scene(&engine, &name, &dir)?;
        let view = |smaller: u32| {
            let lens = camera.intrinsics;
            let intrinsics = lens.resized(lens.width / smaller, lens.height / smaller);
            let camera = Camera { intrinsics, ..camera };
            served(&scene, view_request(camera, Kinds::COLOR, scene.meta.report.median_depth))
        };
        let draw = |request: &RenderRequest| -> Result<Vec<[f32; 3]>> {
            Ok(clamped(renderer.render(&scene.gaussians, request)?.color))
        };
        let whole = draw(&view(1))?;
        let [width, height] = [camera.intrinsics.width, camera.intrinsics.height];
        let mut row = json!({ "scene": name, "width": width, "height": height });
        for smaller in SMALLER {
            let truth = squares_mean(&whole, width, smaller);
            let plain = view(smaller);
            let unknown = |source: &Source| Source { scale: 0.0, ..*source };
            let sources: Arc<[Source]> = plain.sources.iter().map(unknown).collect();
            let blurred = RenderRequest { sources, ..plain.clone() };
            let antialiased = RenderRequest { antialiased: true, ..plain.clone() };
            let of = |request| Ok::<_, Error>(psnr(&draw(request)?, &truth, None));
            row[smaller.to_string()] = json!({
                "psnr": of(&plain)?, "blurred": of(&blurred)?, "antialiased": of(&antialiased)?,
            });
        }
        rows.push(json!({ "psnr_db": row["4"]["psnr"] }), row)?;
    }
    Ok(())
}

/// The means of squares of `side` pixels of a picture whose sides are multiples of it.
fn squares_mean(picture: &[[f32; 3]], width: u32, side: u32) -> Vec<[f32; 3]> {
    let (width, side) = (width as usize, side as usize);
    let square = |top: usize, left: usize| {
        let mut sum = [0.0_f64; 3];
        for row in picture[top * width..(top + side) * width].chunks(width) {
            for pixel in &row[left..left + side] {
                (0..3).for_each(|c| sum[c] += f64::from(pixel[c]));
            }
        }
        sum.map(|v| (v / (side * side) as f64) as f32)
    };
    let tops = (0..picture.len() / width).step_by(side);
    tops.flat_map(|top| (0..width).step_by(side).map(move |left| (top, left)))
        .map(|(top, left)| square(top, left))
        .collect()
}

/// Makes a row for each scene and format of Gaussians: bytes, time to write, and PSNR of what was
/// read back, to the Gaussians that went in over black, and to the served view.
///
/// # Errors
/// As [`afar`].
pub(crate) fn exports(inputs: &Inputs, rows: &mut Rows) -> Result<()> {
    let engine = Pipeline::open(&inputs.setup.networks(1))?;
    let renderer = CpuRenderer::new(inputs.setup.threads())?;
    for (name, dir) in inputs.find(is_posed)? {
        let (scene, camera) = scene(&engine, &name, &dir)?;
        let whole = widened(&scene, &scene.gaussians, None)?;
        let plain = view_request(camera, Kinds::COLOR, scene.meta.report.median_depth);
        let draw = |gaussians: &Gaussians, request: &RenderRequest| -> Result<Vec<[f32; 3]>> {
            Ok(clamped(renderer.render(gaussians, request)?.color))
        };
        let (truth, view) =
            (draw(&whole, &plain)?, draw(&scene.gaussians, &served(&scene, plain.clone()))?);
        for format in splat_formats() {
            let mut times = Vec::new();
            let mut bytes = Vec::new();
            for _ in 0..RUNS {
                bytes.clear();
                let begun = Instant::now();
                let file = SplatFile::new(format, widened(&scene, &scene.gaussians, None)?, None)?;
                file.write(&mut bytes)
                    .map_err(|e| Error::internal("a file in memory").caused_by(e))?;
                times.push(ms(begun));
            }
            let named = format!("scene.{}", format.ending);
            let read = read_splats(&mut bytes.as_slice(), &named, &Limits::default())?;
            let back = draw(&read.gaussians, &plain)?;
            let to_gaussians = psnr(&back, &truth, None);
            let row = json!({
                "scene": name,
                "format": format.name,
                "gaussians": whole.len(),
                "bytes": bytes.len(),
                "write_ms": median(times),
                "width": camera.intrinsics.width,
                "height": camera.intrinsics.height,
            });
            let error = json!({ "psnr_db": to_gaussians, "to_view_db": psnr(&back, &view, None) });
            rows.push(error, row)?;
        }
    }
    Ok(())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn squares_are_means_of_their_pixels() {
        let picture: Vec<[f32; 3]> = (0..16).map(|i| [i as f32, 0.0, 1.0]).collect();
        let means = squares_mean(&picture, 8, 2);
        assert_eq!(means.iter().map(|m| m[0]).collect::<Vec<_>>(), [4.5, 6.5, 8.5, 10.5]);
        assert!(means.iter().all(|m| m[1..] == [0.0, 1.0]), "{means:?}");
    }
}
