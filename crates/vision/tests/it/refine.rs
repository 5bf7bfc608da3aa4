//! Refinement: scenes that get better.

use std::sync::Arc;

use segsplat_core::{
    error::{Error, ErrorCode, Result},
    scene::{
        Backdrop, Camera, Gaussians, HealthReport, Photo, PosedPhoto, Provenance, Scene, SceneId,
        SceneMeta,
    },
};
use segsplat_render::{
    Background, Frame, Kinds, RenderRequest, Renderer,
    backward::{DifferentiableRenderer, FrameGradients, Gradients},
    cpu::CpuRenderer,
    train::{Trainer, TrainingSet},
};
use segsplat_testing::scenes::{Random, camera, checked, cloud, look};
use segsplat_vision::refine::{
    HOLDS_OUT_FROM, RefineBudget, RefineOptions, RefinedVersion, UNWATCHED_STEPS_MAX, held_out,
    rate_factor, refine, split,
};

#[test]
fn every_eighth_photo_is_held_out_and_none_of_few() {
    assert!(held_out(HOLDS_OUT_FROM - 1).is_empty(), "few photos");
    assert_eq!(held_out(5), [3]);
    assert_eq!(held_out(20), [3, 11, 19]);
    let (_, photos) = captured(9);
    let (learnt, out) = split(&photos, &held_out(photos.len()));
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
    let mut raw = gaussians.clone().into_raw();
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
    renderer: &dyn DifferentiableRenderer,
    start: &Gaussians,
    photos: &[PosedPhoto],
    steps: u32,
) -> RefinedVersion {
    let (learnt, out) = split(photos, &held_out(photos.len()));
    let options = RefineOptions { budget: RefineBudget::steps(steps), ..RefineOptions::default() };
    let photos = (&learnt[..], &out[..]);
    let start = (&scene(start, 3.0), start);
    refine(renderer, start, photos, &options, &mut |_| Ok(())).expect("refined")
}

fn cpu() -> CpuRenderer {
    CpuRenderer::new(2).expect("two threads")
}

#[test]
fn a_disturbed_scene_gets_better_on_photos_that_were_held_out() {
    let (truth, photos) = captured(9);
    let start = disturbed(&truth);
    let best = refined(&cpu(), &start, &photos, 150);
    let report = &best.report;
    let (before, after) = (report.psnr_before.unwrap(), report.psnr_after.unwrap());
    println!("{before:.2} dB before, {after:.2} dB after {} steps", report.steps);
    assert!(after > before + 2.0, "{after} dB after, {before} before");
    // Entries stay with their Gaussians, which stay in order.
    let entries = best.gaussians.semantic_index();
    assert!(entries.len() <= start.len() && entries.contains(&6), "entries");
    // Also where a device has no room: the same steps.
    let again = refined(&Full(cpu()), &start, &photos, 150);
    assert!(again.gaussians.means() == best.gaussians.means(), "the same steps");
    let untimed = |version: &RefinedVersion| segsplat_core::scene::RefineReport {
        seconds: 0.0,
        ..version.report.clone()
    };
    assert_eq!(untimed(&again), untimed(&best));
}

/// A renderer whose device has no room for a trainer.
struct Full(CpuRenderer);

impl Renderer for Full {
    fn name(&self) -> String {
        self.0.name()
    }

    fn concurrency(&self) -> usize {
        self.0.concurrency()
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        self.0.render(gaussians, request)
    }
}

impl DifferentiableRenderer for Full {
    fn backward(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        loss: &mut dyn FnMut(&Frame) -> Result<FrameGradients>,
        gradients: &mut Gradients,
    ) -> Result<Frame> {
        self.0.backward(gaussians, request, loss, gradients)
    }

    fn trainer<'a>(&'a self, set: &TrainingSet<'a>) -> Result<Option<Box<dyn Trainer + 'a>>> {
        Err(Error::limit("bytes", set.device_bytes(), 0))
    }
}

#[test]
fn rates_are_larger_where_few_steps_are_expected() {
    let found = [f32::NAN, 0.0, 1.0, 40.0, 100.0, 200.0, 1e4].map(rate_factor);
    assert_eq!(found[..3], [1.0, 1.0, 2.0]);
    assert!(found[3] > 1.8 && found[4] > 1.2 && found[3] > found[4], "{found:?}");
    assert_eq!(found[5..], [1.0, 1.0]);
}

#[test]
fn few_photos_take_few_steps_and_nothing_is_claimed() {
    let (truth, photos) = captured(3);
    let best = refined(&cpu(), &disturbed(&truth), &photos, 100_000);
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
        refine(&cpu, start, (photos, &[]), options, &mut pace)
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
