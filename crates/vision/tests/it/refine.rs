//! Refinement: the loss against finite differences, and scenes that get better.

use std::sync::Arc;

use segsplat_core::{
    error::{Error, ErrorCode},
    scene::{
        Backdrop, Camera, Gaussians, HealthReport, Photo, PosedPhoto, Provenance, Scene, SceneId,
        SceneMeta,
    },
};
use segsplat_render::{Background, Kinds, RenderRequest, Renderer as _, cpu::CpuRenderer};
use segsplat_testing::scenes::{Random, camera, checked, cloud, look};
use segsplat_vision::refine::{
    HOLDS_OUT_FROM, RefineBudget, RefineOptions, RefinedVersion, UNWATCHED_STEPS_MAX, held_out,
    photo_loss, refine, split,
};

/// SSIM as its paper has it, f64, window by window.
fn plain_loss(picture: &[[f32; 3]], photo: &[[f32; 3]], width: usize) -> f64 {
    let height = photo.len() / width;
    let weight = |i: usize| (-(i as f64 - 5.0).powi(2) / 4.5).exp();
    let sum: f64 = (0..11).map(weight).sum();
    let (mut ssim, mut windows) = (0.0, 0.0);
    for c in 0..3 {
        for y in 0..height - 10 {
            for x in 0..width - 10 {
                let mut m = [0.0; 5];
                for k in 0..121 {
                    let at = (y + k / 11) * width + x + k % 11;
                    let w = weight(k / 11) * weight(k % 11) / (sum * sum);
                    let (a, b) = (f64::from(picture[at][c]), f64::from(photo[at][c]));
                    for (m, v) in m.iter_mut().zip([a, b, a * a, b * b, a * b]) {
                        *m += w * v;
                    }
                }
                let [a, b, aa, bb, ab] = m;
                let top = (2.0 * a * b + 1e-4) * (2.0 * (ab - a * b) + 9e-4);
                ssim += top / ((a * a + b * b + 1e-4) * (aa - a * a + bb - b * b + 9e-4));
                windows += 1.0;
            }
        }
    }
    let numbers = picture.as_flattened().iter().zip(photo.as_flattened());
    let away: f64 = numbers.map(|(a, b)| (f64::from(*a) - f64::from(*b)).abs()).sum();
    0.8 * away / (3 * photo.len()) as f64 + 0.2 * (1.0 - ssim / windows)
}

#[test]
fn the_loss_and_its_gradient_are_those_of_the_plain_form() {
    let (width, height) = (19, 14);
    let mut random = Random(3);
    let mut picture = |_| [(); 3].map(|()| random.range(0.0, 1.0));
    let photo: Vec<[f32; 3]> = (0..width * height).map(&mut picture).collect();
    let shown: Vec<[f32; 3]> = (0..width * height).map(&mut picture).collect();
    let found = photo_loss(&shown, &photo, width, None, 0.2);
    let want = plain_loss(&shown, &photo, width);
    assert!((found.value - want).abs() < 1e-6, "{} is not {want}", found.value);
    let most = found.gradient.as_flattened().iter().fold(0.0_f32, |most, by| most.max(by.abs()));
    for (i, by) in found.gradient.iter().enumerate() {
        for c in 0..3 {
            let moved = |by: f32| {
                let mut moved = shown.clone();
                moved[i][c] += by;
                plain_loss(&moved, &photo, width)
            };
            let step = 2.0_f32.powi(-10);
            if (shown[i][c] - photo[i][c]).abs() < 2.0 * step {
                continue; // the kink of the absolute difference
            }
            let want = (moved(step) - moved(-step)) / f64::from(2.0 * step);
            let error = (f64::from(by[c]) - want).abs() / f64::from(most);
            assert!(error < 1e-3, "pixel {i}, channel {c}: {} is not {want}", by[c]);
        }
    }
}

#[test]
fn pixels_without_a_source_and_small_pictures_are_allowed_for() {
    let photo = vec![[0.5; 3]; 15 * 15];
    let mut shown = photo.clone();
    shown[17] = [0.9, 0.1, 0.4];
    let mut valid = vec![true; 15 * 15];
    valid[17] = false;
    let found = photo_loss(&shown, &photo, 15, Some(&valid), 0.2);
    assert!(found.value.abs() < 1e-6, "{} for the same picture", found.value);
    assert!(found.gradient[17] == [0.0; 3], "a pixel that does not count pulls");
    let small = photo_loss(&shown[..20], &photo[..20], 5, None, 0.2);
    assert!(small.value > 0.0 && small.gradient[17][0] > 0.0, "no window fits: L1 alone");
    assert!(photo_loss(&[], &[], 0, None, 0.2).gradient.is_empty(), "no picture");
}

#[test]
fn every_eighth_photo_is_held_out_and_none_of_few() {
    assert!(held_out(HOLDS_OUT_FROM - 1).is_empty(), "few photos");
    assert_eq!(held_out(5), [3]);
    assert_eq!(held_out(20), [3, 11, 19]);
    let (_, photos) = captured(9);
    let (learnt, out) = split(photos);
    assert_eq!((learnt.len(), out.len()), (8, 1));
    assert!(learnt.iter().all(|photo| photo.file != out[0].file), "a photo on both sides");
}

/// Photos of a cloud of Gaussians by renders of it, and the cloud.
fn captured(count: u32) -> (Gaussians, Vec<PosedPhoto>) {
    let gaussians = cloud(400, 0, 5);
    let cpu = CpuRenderer::new(2).expect("two threads");
    let photos = (0..count).map(|i| {
        let eye = glam::DVec3::new(0.3 * f64::from(i % 4) - 0.5, 0.2 * f64::from(i / 4), -0.5);
        let pose = look(eye, glam::DVec3::new(0.5, -0.2, 4.0));
        let camera = Camera { camera_to_world: pose, ..camera(48, 40) };
        let frame = cpu.render(&gaussians, &request(camera)).expect("a picture");
        let color = frame.color.expect("colour");
        let rgb = color.as_flattened().iter().map(|v| (v * 255.0).round().clamp(0.0, 255.0) as u8);
        let photo = Photo { width: 48, height: 40, rgb: rgb.collect(), valid: None };
        PosedPhoto { file: format!("{i}"), photo, camera, intrinsics_made_for: None }
    });
    let photos = photos.collect();
    (gaussians, photos)
}

fn request(camera: Camera) -> RenderRequest {
    let background = Background::Backdrop(Arc::default());
    RenderRequest { background, ..RenderRequest::plain(camera, Kinds::COLOR, 0.03) }
}

/// The cloud with every number moved.
fn disturbed(gaussians: &Gaussians) -> Gaussians {
    let mut random = Random(8);
    let mut raw = gaussians.as_raw().clone();
    for i in 0..raw.means.len() {
        raw.means[i][0] += random.range(-0.02, 0.02);
        raw.scales[i][1] *= random.range(0.6, 1.5);
        raw.opacities[i] = (raw.opacities[i] * random.range(0.5, 1.6)).clamp(0.02, 0.95);
        raw.sh[i][0] += random.range(-0.5, 0.5);
        raw.semantic_index[i] = (i % 7) as u16;
    }
    checked(raw)
}

/// These Gaussians as a scene of this median depth.
fn scene(gaussians: &Gaussians, median_depth: f64) -> Scene {
    let meta = SceneMeta {
        id: SceneId::from_bytes([1; 16]),
        created_ms: 0,
        cameras: Vec::new(),
        report: HealthReport { median_depth, ..HealthReport::default() },
        provenance: Provenance::default(),
    };
    Scene::new(meta, gaussians.clone(), Backdrop::default())
}

fn refined(
    start: &Gaussians,
    photos: &[PosedPhoto],
    steps: u32,
    published: &mut Vec<RefinedVersion>,
) -> RefinedVersion {
    let cpu = CpuRenderer::new(2).expect("two threads");
    let all = photos.to_vec();
    let (learnt, out) = split(all);
    let options = RefineOptions { budget: RefineBudget::steps(steps), ..RefineOptions::default() };
    let publish = &mut |version: &RefinedVersion| {
        published.push(version.clone());
        Ok(())
    };
    let photos = (&learnt[..], &out[..]);
    let start = (&scene(start, 3.0), start);
    refine(&cpu, start, photos, &options, &mut |_| Ok(()), publish).expect("refined")
}

#[test]
fn a_disturbed_scene_gets_better_on_photos_that_were_held_out() {
    let (truth, photos) = captured(9);
    let start = disturbed(&truth);
    let mut published = Vec::new();
    let best = refined(&start, &photos, 150, &mut published);
    let report = &best.report;
    let (before, after) = (report.psnr_before.unwrap(), report.psnr_after.unwrap());
    println!("{before:.2} dB before, {after:.2} dB after {} steps", report.steps);
    assert!(after > before + 2.0, "{after} dB after, {before} before");
    let rising = published.windows(2).all(|v| v[1].report.psnr_after > v[0].report.psnr_after);
    assert!(!published.is_empty() && rising, "each version is better than the last");
    assert!(published.last().unwrap().gaussians.as_raw().means == best.gaussians.as_raw().means);
    // Entries stay with their Gaussians, which stay in order.
    let entries = best.gaussians.semantic_index();
    assert!(entries.len() <= start.len() && entries.contains(&6), "entries");
    let again = refined(&start, &photos, 150, &mut Vec::new());
    assert!(again.gaussians.as_raw().means == best.gaussians.as_raw().means, "the same steps");
    let untimed = |version: &RefinedVersion| segsplat_core::scene::RefineReport {
        seconds: 0.0,
        ..version.report.clone()
    };
    assert_eq!(untimed(&again), untimed(&best));
}

#[test]
fn few_photos_take_few_steps_and_nothing_is_claimed() {
    let (truth, photos) = captured(3);
    let best = refined(&disturbed(&truth), &photos, 100_000, &mut Vec::new());
    assert_eq!(best.report.steps, UNWATCHED_STEPS_MAX);
    assert_eq!((best.report.psnr_before, best.report.psnr_after), (None, None));
}

#[test]
fn a_cancelled_refinement_stops_and_odd_input_is_taken_or_refused() {
    let (truth, photos) = captured(5);
    let cpu = CpuRenderer::new(1).expect("a thread");
    let run = |start: &Gaussians, photos: &[PosedPhoto], options: &RefineOptions, stop: bool| {
        let mut pace = |_: f32| match stop {
            true => Err(Error::new(ErrorCode::Cancelled, "stopped")),
            false => Ok(()),
        };
        let start = (&scene(start, f64::NAN), start);
        refine(&cpu, start, (photos, &[]), options, &mut pace, &mut |_| Ok(()))
    };
    let options = RefineOptions { budget: RefineBudget::steps(30), ..RefineOptions::default() };
    let told = run(&truth, &photos, &options, true).expect_err("cancelled");
    assert_eq!(told.code(), ErrorCode::Cancelled);
    let told = run(&truth, &photos, &RefineOptions { batch: 0, ..options }, false);
    assert_eq!(told.expect_err("no photo a step").code(), ErrorCode::InvalidRequest);
    assert!(run(&truth.only(|_| false), &photos, &options, false).unwrap().gaussians.is_empty());
    assert_eq!(run(&truth, &[], &options, false).unwrap().gaussians.len(), truth.len());
    let some = RefineOptions { gaussians_max: 100, batch: 3, ..options };
    assert!(run(&truth, &photos, &some, false).unwrap().gaussians.len() <= 100);
}
