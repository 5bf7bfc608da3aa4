//! Refinement: scenes that get better.

use std::{
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
    time::{Duration, Instant},
};

use glam::DVec3;
use segsplat_core::{
    error::{Error, ErrorCode, Result},
    scene::{
        Backdrop, Camera, CameraToWorld, Gaussians, HealthReport, Photo, PosedPhoto, Provenance,
        RefineReport, Scene, SceneCamera, SceneId, SceneMeta, SourcePixel,
    },
};
use segsplat_render::{
    Background, DifferentiableRenderer, Frame, Kinds, RenderRequest, Renderer,
    backward::{FrameGradients, Gradients},
    cpu::CpuRenderer,
    train::{Trainer, TrainingSet, pose::moved},
};
use segsplat_testing::scenes::{Random, camera, checked, cloud, look};
use segsplat_vision::{
    pipeline::{
        Reconstruction,
        refinement::{self, RefineCalls, Refined, version_of},
    },
    refine::{
        HOLDS_OUT_FROM, Judged, LearntPhotos, MorePhotos, PhotoSpool, RefineBudget, RefineOptions,
        RefinedVersion, Stepped, UNWATCHED_STEPS_MAX, differences, held_out, judged_as_served,
        rate_factor, ready, refine, split,
    },
};

#[test]
fn every_eighth_photo_is_held_out_or_three_and_none_of_few() {
    assert!(held_out(HOLDS_OUT_FROM - 1).is_empty(), "few photos");
    assert_eq!([held_out(5), held_out(7)], [[3], [3]]);
    assert_eq!([held_out(8), held_out(9)], [[1, 5], [1, 5]]);
    assert_eq!([held_out(12), held_out(20)], [[1, 5, 9], [2, 8, 14]]);
    assert_eq!(held_out(42), [3, 11, 19, 27, 35]);
    let (_, photos) = captured(9);
    let (learnt, out) = split(&photos, &held_out(photos.len()));
    assert_eq!((learnt.len(), out.len()), (7, 2));
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
) -> Stepped {
    let budget = RefineBudget::steps(steps);
    let plain = RefineOptions::default();
    let options = RefineOptions { budget, growth: 0.0, coarse_share: 0.3, pose_rate: 0.0, ..plain };
    refined_by(renderer, start, photos, &options)
}

fn refined_by(
    renderer: &dyn DifferentiableRenderer,
    start: &Gaussians,
    photos: &[PosedPhoto],
    options: &RefineOptions,
) -> Stepped {
    let (learnt, out) = split(photos, &held_out(photos.len()));
    let scene = scene(start, 3.0);
    let gaussians = ready(&scene, start, options).expect("Gaussians");
    let learnt = learnt[..].into();
    refine(renderer, &scene, &gaussians, learnt, &out, options, &mut |_| Ok(())).expect("refined")
}

fn cpu() -> CpuRenderer {
    CpuRenderer::new(2).expect("two threads")
}

/// A renderer on the processor that may say that it is a device, or have no room for a trainer. It
/// counts its views, and keeps the width and the focal length of those that it goes back from.
struct Watched {
    cpu: CpuRenderer,
    is_device: bool,
    is_full: bool,
    drawn: AtomicUsize,
    lenses: Mutex<Vec<(u32, f64)>>,
}

fn watched() -> Watched {
    let (drawn, lenses) = (AtomicUsize::new(0), Mutex::default());
    Watched { cpu: cpu(), is_device: false, is_full: false, drawn, lenses }
}

impl Renderer for Watched {
    fn name(&self) -> String {
        self.cpu.name()
    }

    fn concurrency(&self) -> usize {
        self.cpu.concurrency()
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        self.drawn.fetch_add(1, Ordering::SeqCst);
        self.cpu.render(gaussians, request)
    }
}

impl DifferentiableRenderer for Watched {
    fn backward(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        loss: &mut dyn FnMut(&Frame) -> Result<FrameGradients>,
        gradients: &mut Gradients,
    ) -> Result<Frame> {
        let lens = request.lens();
        self.lenses.lock().expect("a lock").push((lens.width, lens.fx));
        self.cpu.backward(gaussians, request, loss, gradients)
    }

    fn trainer<'a>(
        &'a self,
        _set: &TrainingSet<'a>,
        bytes_max: u64,
    ) -> Result<Option<Box<dyn Trainer + 'a>>> {
        match self.is_full {
            true => Err(Error::limit("bytes", u64::MAX, bytes_max)),
            false => Ok(None),
        }
    }

    fn is_device(&self) -> bool {
        self.is_device
    }
}

#[test]
fn a_disturbed_scene_gets_better_on_photos_that_were_held_out() {
    let (truth, photos) = captured(9);
    let start = disturbed(&truth);
    let best = refined(&cpu(), &start, &photos, 150);
    let held = split(&photos, &held_out(photos.len())).1;
    let before = judged_as_served(&cpu(), &scene(&start, 3.0), &held).unwrap().unwrap().psnr;
    let after = best.judged.unwrap().psnr;
    println!("{before:.2} dB before, {after:.2} dB after {} steps", best.steps);
    assert!(after > before + 2.0 && best.steps == 150, "{after} dB after, {before} before");
    // Entries stay with their Gaussians, which stay in order.
    let entries = best.gaussians.semantic_index();
    assert!(entries.len() <= start.len() && entries.contains(&6), "entries");
    // Also where a device has no room: the same steps.
    let again = refined(&Watched { is_full: true, ..watched() }, &start, &photos, 150);
    assert!(again.gaussians.means() == best.gaussians.means(), "the same steps");
    assert_eq!((again.steps, again.judged), (best.steps, best.judged));
}

#[test]
fn photos_on_disk_are_learnt_beside_the_others() {
    let (truth, photos) = captured(12);
    let (kept, others) = photos.split_at(8);
    let mut spool = PhotoSpool::new(None).expect("a file");
    others.iter().for_each(|photo| spool.push(photo).expect("room"));
    let more = MorePhotos::of(spool).expect("photos");
    let start = disturbed(&truth);
    let scene = scene(&start, 3.0);
    let budget = RefineBudget::steps(160);
    let options = RefineOptions {
        budget,
        coarse_share: 0.4,
        coarse_side_min: 20,
        growth: 0.0,
        ..RefineOptions::default()
    };
    let gaussians = ready(&scene, &start, &options).expect("Gaussians");
    let away = |more: Option<&MorePhotos>| {
        let learnt = LearntPhotos { kept, more };
        let mut pace = |_: f32| Ok(());
        let made =
            refine(&cpu(), &scene, &gaussians, learnt, &[], &options, &mut pace).expect("refined");
        assert_eq!((made.steps, made.poses.len()), (160, kept.len()));
        let all = differences(&cpu(), &scene, &made.gaussians, others).expect("views");
        all.iter().sum::<f64>() / all.len() as f64
    };
    let (without, with) = (away(None), away(Some(&more)));
    println!("{without:.4} away without them, {with:.4} with them");
    assert!(with < 0.8 * without, "{with} away, {without} without them");
    assert_eq!(with, away(Some(&more)), "the same steps");
}

/// A whole refinement, and each of its versions with what it began with.
struct Whole {
    found: Refined,
    versions: Vec<(Scene, RefinedVersion)>,
}

impl Whole {
    fn last(&self) -> &(Scene, RefinedVersion) {
        self.versions.last().expect("a better version")
    }
}

/// A whole refinement of a scene of these photos: what the networks make is the disturbed cloud,
/// whose Gaussians come from the photos by turns. `made` is called before each time they make it.
fn refined_whole(
    renderer: &dyn DifferentiableRenderer,
    photos: &[PosedPhoto],
    options: &RefineOptions,
    made: &dyn Fn(),
) -> Whole {
    refined_again(renderer, photos, options, made, None)
}

/// The same of a scene whose last version was this good at its held-out photos, dB.
fn refined_again(
    renderer: &dyn DifferentiableRenderer,
    photos: &[PosedPhoto],
    options: &RefineOptions,
    made: &dyn Fn(),
    psnr_after: Option<f64>,
) -> Whole {
    let start = disturbed(&cloud(400, 0, 5));
    let reconstruction = |photos: &[PosedPhoto]| {
        let mut raw = start.clone().into_raw();
        let views = (0..photos.len() as u16).cycle();
        raw.source =
            views.take(raw.means.len()).map(|view| SourcePixel { view, x: 0, y: 0 }).collect();
        let camera = |posed: &PosedPhoto| SceneCamera {
            file: posed.file.clone(),
            camera: posed.camera,
            network: None,
        };
        Reconstruction {
            gaussians: checked(raw),
            backdrop: Backdrop::default(),
            report: HealthReport { median_depth: 3.0, ..HealthReport::default() },
            cameras: photos.iter().map(camera).collect(),
        }
    };
    let id = SceneId::from_bytes([1; 16]);
    let mut scene = reconstruction(photos).into_scene(id, 0, Provenance::default());
    scene.meta.report.refinement =
        psnr_after.map(|_| RefineReport { psnr_after, ..RefineReport::default() });
    let mut remake = |held: &[usize]| {
        made();
        let made = reconstruction(&split(photos, held).0);
        let one_set = made.gaussians.clone();
        Ok((made, one_set))
    };
    let mut versions = Vec::new();
    let mut publish = |start: &Scene, version: &RefinedVersion| {
        versions.push((start.clone(), version.clone()));
        Ok(())
    };
    let pace = &mut |_: f32| Ok(());
    let recast = &mut || Ok(None);
    let more = &mut |_| Ok(None);
    let calls = RefineCalls { remake: &mut remake, recast, more, pace, publish: &mut publish };
    let found = refinement::refined(renderer, &scene, photos, options, calls);
    Whole { found: found.expect("refined"), versions }
}

/// So many steps with these parts, without growth.
fn steps_of(steps: u32, first_steps: u32) -> RefineOptions {
    let budget = RefineBudget::steps(steps);
    RefineOptions { budget, first_steps, growth: 0.0, ..RefineOptions::default() }
}

#[test]
fn a_first_version_comes_soon_and_others_only_where_they_gain() {
    let (_, photos) = captured(9);
    let refined = |options: &RefineOptions| refined_whole(&cpu(), &photos, options, &|| ());
    let reports = |whole: &Whole| -> Vec<(u32, f64)> {
        let of = |version: &RefinedVersion| {
            (version.report.steps, version.report.psnr_after.expect("held-out photos"))
        };
        whole.versions.iter().map(|(_, version)| of(version)).collect()
    };
    // Three fourths of 40 steps, of 120 more, and of what is left of 640.
    let whole = refined(&steps_of(640, 40));
    let found = reports(&whole);
    println!("{found:?}");
    let steps: Vec<u32> = found.iter().map(|(steps, _)| *steps).collect();
    assert_eq!(steps, [30, 120, 480], "{found:?}");
    assert!(found.windows(2).all(|pair| pair[1].1 > pair[0].1 + 0.1), "{found:?}");
    assert_eq!((whole.found.versions, whole.found.report.steps), (3, 480));
    // Where a further one gains too little, the first stays, however long the budget is.
    let strict = refined(&RefineOptions { gain_min: 50.0, ..steps_of(640, 40) });
    assert_eq!(reports(&strict), found[..1]);
    let [first, again] = [&whole.versions[0], strict.last()].map(|(_, it)| it.gaussians.means());
    assert!(first == again, "more time changes nothing that came before");
    // What is left for no part of its own goes to the one before.
    let short = refined(&steps_of(60, 40));
    assert_eq!(reports(&short).iter().map(|it| it.0).collect::<Vec<_>>(), [50]);
    // What is soft is not as good as what is sharp.
    let [soft, sharp] = [0.80, 0.82].map(|ssim| Judged { psnr: 20.0, ssim }.score());
    assert!((sharp - soft - 0.4).abs() < 1e-9);
    let worse = refined(&RefineOptions { rate: -1.0, ..steps_of(640, 40) });
    assert!(worse.versions.is_empty() && worse.found.versions == 0, "steps that lead away");
}

/// The first proof, of 10 steps, is not better than what is served. 190 are left, too few for two
/// parts more: a half is for the next proof, and the version goes on from it with the others.
#[test]
fn a_last_proof_has_half_of_what_is_left() {
    let (_, photos) = captured(9);
    let options = steps_of(200, 40);
    let refined =
        |psnr_after: Option<f64>| refined_again(&cpu(), &photos, &options, &|| (), psnr_after);
    let psnr = |whole: &Whole| whole.versions[0].1.report.psnr_after.expect("held-out photos");
    let first = refined(None);
    let (steps, after) = (first.versions[0].1.report.steps, psnr(&first));
    let again = refined(Some(after + 0.1));
    println!("{after:.2} dB after {steps} steps, {:.2} after the last proof", psnr(&again));
    assert_eq!((steps, again.versions[0].1.report.steps, again.found.versions), (30, 95, 1));
    assert!(psnr(&again) > after + 0.1);
}

/// Fewer steps than a version of an overfitting proof has do not bring it from the networks'
/// Gaussians to where the proof is.
#[test]
fn a_version_without_the_steps_to_begin_anew_goes_on_from_the_proof() {
    let (_, photos) = captured(9);
    let means = |steps: u32, overfit_max: f32| {
        let options = RefineOptions { overfit_max, ..steps_of(steps, 40) };
        let whole = refined_whole(&cpu(), &photos, &options, &|| ());
        whole.versions[0].1.gaussians.means().to_vec()
    };
    assert!(means(36, 0.0) == means(36, 100.0), "27 steps are left, 30 are a version");
    assert!(means(40, 0.0) != means(40, 100.0), "it begins anew with 30");
}

#[test]
fn a_proof_that_overfits_ends_the_work_and_one_without_worth_publishes_nothing() {
    let (_, mut photos) = captured(9);
    let versions = |photos: &[PosedPhoto], overfit_max: f32, first_steps: u32| {
        let options = RefineOptions { overfit_max, ..steps_of(640, first_steps) };
        let whole = refined_whole(&cpu(), photos, &options, &|| ());
        (whole.found.versions, whole.found.overfit.expect("a better proof"))
    };
    let (all, overfit) = versions(&photos, 1.5, 40);
    assert_eq!((all, overfit < 1.5), (3, true), "{overfit}");
    assert_eq!(versions(&photos, 0.9 * overfit as f32, 40), (1, overfit), "the first stays");
    let steps = |options: RefineOptions| {
        let found = refined_whole(&cpu(), &photos, &options, &|| ()).found;
        (found.versions, found.report.steps)
    };
    let further = RefineOptions { overfit_further: 0.0, ..steps_of(640, 40) };
    assert_eq!(steps(further), (1, 30), "no further version of a proof that overfits");
    // What is left of the budget is not for a scene whose proof overfits.
    let first = RefineOptions { overfit_max: 0.0, ..steps_of(60, 40) };
    assert_eq!((steps(steps_of(60, 40)), steps(first)), ((1, 50), (1, 30)));
    // In a long time it has as many steps as in a short one, of many photos too.
    let (_, many) = captured(16);
    let of_many = |steps: u32| {
        let options = RefineOptions { overfit_max: 0.0, ..steps_of(steps, 20) };
        let whole = refined_whole(&cpu(), &many, &options, &|| ());
        assert_eq!((whole.found.versions, whole.found.report.steps), (1, 15), "of {steps}");
        whole.last().1.gaussians.means().to_vec()
    };
    assert!(of_many(24) == of_many(640), "more time changes nothing");
    // Noise in the held-out photos, that nothing explains.
    let mut random = Random(3);
    for at in held_out(photos.len()) {
        for value in &mut photos[at].photo.rgb {
            let noise = if random.range(0.0, 1.0) < 0.5 { -25 } else { 25 };
            *value = (i32::from(*value) + noise).clamp(0, 255) as u8;
        }
    }
    let (one, overfit) = versions(&photos, 1.5, 40);
    assert!(one == 1 && (1.5..6.0).contains(&overfit), "{one} versions, {overfit}");
    let (none, overfit) = versions(&photos, 1.5, 160);
    assert!(none == 0 && overfit > 6.0, "{none} versions, {overfit}");
}

#[test]
fn gaussians_are_added_where_the_scene_differs_from_the_photos() {
    let (truth, photos) = captured(9);
    let start = disturbed(&truth).only(|i| i % 4 == 0);
    let with = |growth: f32, gaussians_max: usize| {
        let budget = RefineBudget::steps(400);
        let options = RefineOptions { budget, growth, gaussians_max, ..RefineOptions::default() };
        let best = refined_by(&cpu(), &start, &photos, &options);
        (best.judged.expect("held-out photos").psnr, best.gaussians)
    };
    let ((plain, as_many), (better, more)) = (with(0.0, usize::MAX), with(0.3, usize::MAX));
    println!("{plain:.2} dB with {}, {better:.2} dB with {}", as_many.len(), more.len());
    assert!(as_many.len() <= start.len() && more.len() > start.len() * 3 / 2, "{}", more.len());
    assert!(better > plain + 0.5, "{better} dB with more Gaussians, {plain} with as many");
    let entries = start.semantic_index();
    assert!(more.semantic_index().iter().all(|entry| entries.contains(entry)), "inherited");
    let (_, bound) = with(0.3, start.len() + 7);
    assert!(bound.len() <= start.len() + 7, "{} over the most", bound.len());
}

#[test]
fn large_photos_are_learnt_at_half_their_size_first() {
    let (truth, mut photos) = captured(5);
    for posed in &mut photos {
        let camera = Camera { intrinsics: camera(960, 24).intrinsics, ..posed.camera };
        let rgb = vec![90; 3 * 960 * 24];
        let photo = Photo { width: 960, height: 24, rgb, valid: None };
        *posed = PosedPhoto { photo, camera, ..posed.clone() };
    }
    let widths = |coarse_share: f32, photos: &[PosedPhoto]| {
        let renderer = watched();
        let budget = RefineBudget::steps(20);
        let options = RefineOptions { budget, coarse_share, growth: 0.0, ..Default::default() };
        refined_by(&renderer, &truth, photos, &options);
        renderer.lenses.into_inner().expect("a lock")
    };
    let found = widths(0.3, &photos);
    let focal = photos[0].camera.intrinsics.fx;
    assert_eq!((&found[..6], &found[6..]), (&[(480, focal / 2.0); 6][..], &[(960, focal); 14][..]));
    assert_eq!(widths(0.0, &photos), [(960, focal); 20]);
    let (_, small) = captured(5);
    let focal = small[0].camera.intrinsics.fx;
    assert_eq!(widths(0.3, &small), [(48, focal); 20], "small photos have no smaller copies");
}

#[test]
fn it_goes_on_from_the_proof_where_that_explains_photos_that_it_did_not_learn() {
    let (_, photos) = captured(7);
    let held = held_out(photos.len());
    let differs = |whole: &Whole| {
        let (start, version) = whole.last();
        let found = differences(&cpu(), start, &version.gaussians, &photos).expect("views");
        found.iter().sum::<f64>() / found.len() as f64
    };
    // Whether the Gaussians of held-out photos are behind the others.
    let joined = |whole: &Whole| {
        let views = whole.last().1.gaussians.source().to_vec();
        let is_held = |pixel: &SourcePixel| held.contains(&usize::from(pixel.view));
        let first = views.iter().position(is_held).expect("one of a held-out photo");
        views[first..].iter().all(is_held)
    };
    let with = |overfit_max: f32, gaussians_max: usize| {
        let options = RefineOptions { overfit_max, gaussians_max, ..steps_of(60, 60) };
        let options = RefineOptions { proof_share: 0.5, ..options };
        refined_whole(&cpu(), &photos, &options, &|| ())
    };
    let (anew, on) = (with(0.0, usize::MAX), with(f32::MAX, usize::MAX));
    assert!(joined(&on) && !joined(&anew), "what it begins with");
    println!("differs by {} and {}", differs(&on), differs(&anew));
    assert!(differs(&on) < 0.9 * differs(&anew), "{} against {}", differs(&on), differs(&anew));
    let overfit = on.found.overfit.expect("a proof");
    assert!(overfit > 0.2 && overfit < 5.0 && anew.found.overfit == Some(overfit), "{overfit}");
    // A bound beside what was found decides.
    let near = |factor: f64| (overfit * factor) as f32;
    assert!(joined(&with(near(1.01), usize::MAX)));
    assert!(!joined(&with(near(0.99), usize::MAX)));
    // As many as are allowed, though the proof has those of its photos.
    let full = with(f32::MAX, 400);
    let count = full.last().1.gaussians.len();
    assert!(joined(&full) && count <= 400 && count > 360, "{count} Gaussians");
}

/// Photos whose cameras are turned by `degrees` and moved by `way`, each in its own direction.
fn with_wrong_cameras(photos: &[PosedPhoto], degrees: f64, way: f64) -> Vec<PosedPhoto> {
    let mut random = Random(40);
    let wrong = |posed: &PosedPhoto| {
        let [turn, shift] = [(); 2].map(|()| {
            let numbers = [(); 3].map(|()| f64::from(random.range(-1.0, 1.0)));
            glam::DVec3::from_array(numbers).normalize()
        });
        let pose = &posed.camera.camera_to_world;
        let camera_to_world = moved(pose, turn * degrees.to_radians(), shift * way);
        PosedPhoto { camera: Camera { camera_to_world, ..posed.camera }, ..posed.clone() }
    };
    photos.iter().map(wrong).collect()
}

/// How far cameras are apart, radians in the mean: a turn of all of them together is none.
fn apart(poses: &[CameraToWorld], right: &[PosedPhoto]) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for i in 0..poses.len() {
        for j in 0..i {
            let between = |a: &CameraToWorld, b: &CameraToWorld| {
                CameraToWorld::from_rotation(a.rotation().transpose() * b.rotation(), DVec3::ZERO)
            };
            let [a, b] = [i, j].map(|i| &right[i].camera.camera_to_world);
            sum += between(&poses[i], &poses[j]).turn_to(&between(a, b));
            count += 1.0;
        }
    }
    sum / count
}

#[test]
fn wrong_cameras_are_mended_where_held_out_photos_say_so() {
    let (_, right) = captured(9);
    let wrong = with_wrong_cameras(&right, 2.0, 0.06);
    let with = |photos: &[PosedPhoto], pose_rate: f32| {
        let options = RefineOptions { pose_rate, ..steps_of(480, 120) };
        refined_whole(&cpu(), photos, &options, &|| ())
    };
    let mended = with(&wrong, 4e-3);
    let (start, last) = mended.last();
    let given: Vec<CameraToWorld> = wrong.iter().map(|it| it.camera.camera_to_world).collect();
    let (before, after) = (apart(&given, &right), apart(&last.poses, &right));
    println!("{before} before, {after} after, gain {:?}", mended.found.pose_gain);
    assert!(after < 0.5 * before, "{after} radians after, {before} before");
    // The report says how far each moved, the version where it stands.
    let told = &last.report.cameras;
    assert_eq!(told.len(), 9);
    for ((told, given), pose) in told.iter().zip(&given).zip(&last.poses) {
        assert!((told.degrees - given.turn_to(pose).to_degrees()).abs() < 1e-9);
        assert!((told.share - given.center().distance(pose.center()) / 3.0).abs() < 1e-9);
    }
    assert!(told.iter().all(|it| it.degrees > 0.1 && it.share > 1e-3), "{told:?}");
    let version = version_of(start, start, last).expect("a scene");
    let cameras = version.meta.cameras.iter().map(|it| it.camera.camera_to_world);
    assert!(cameras.eq(last.poses.iter().copied()));
    let psnr = |whole: &Whole| whole.last().1.report.psnr_after.expect("held-out photos");
    let left = with(&wrong, 0.0);
    println!("{} dB mended, {} as given", psnr(&mended), psnr(&left));
    assert!(psnr(&mended) > psnr(&left) + 1.0);
    assert!(left.last().1.poses == given && left.last().1.report.cameras.is_empty());
    assert_eq!(left.found.pose_gain, None);
    // Right cameras stay, and nothing else changes.
    let (asked, never) = (with(&right, 4e-3), with(&right, 0.0));
    println!("gain with right cameras {:?}", asked.found.pose_gain);
    assert!(asked.found.pose_gain.expect("asked") < mended.found.pose_gain.expect("asked"));
    assert!(asked.last().1.report.cameras.is_empty());
    let [asked, never] = [asked, never].map(|it| it.last().1.gaussians.means().to_vec());
    assert!(asked == never);
}

#[test]
fn photos_whose_cameras_cannot_be_right_are_left_out_and_named() {
    let (_, right) = captured(9);
    let refined = |photos: &[PosedPhoto]| refined_whole(&cpu(), photos, &steps_of(160, 80), &|| ());
    let plain = refined(&right);
    assert!(plain.last().1.report.left_out.is_empty(), "{:?}", plain.last().1.report);
    // One looks the other way, where its photo never was.
    let mut wrong = right.clone();
    let pose = &mut wrong[3].camera.camera_to_world;
    *pose = moved(pose, DVec3::new(0.0, 0.0, 3.0), DVec3::ZERO);
    let found = refined(&wrong);
    let (start, last) = found.last();
    assert_eq!(last.report.left_out, [right[3].file.clone()]);
    // Neither its photo nor its Gaussians are in the scene.
    assert!(last.gaussians.source().iter().all(|pixel| pixel.view != 3));
    assert!(start.gaussians.source().iter().all(|pixel| pixel.view != 3));
    assert!(last.report.psnr_after > last.report.psnr_before, "{:?}", last.report);
    assert_eq!(last.poses.len(), 9);
}

#[test]
fn a_device_that_would_rest_draws_while_the_networks_work() {
    let (_, photos) = captured(9);
    for rests in [true, false] {
        let renderer = Watched { is_device: rests, ..watched() };
        let meanwhile = AtomicUsize::new(0);
        let made = || {
            let before = renderer.drawn.load(Ordering::SeqCst);
            let drawn = || renderer.drawn.load(Ordering::SeqCst) - before;
            // One that would rest draws until the networks are done; the other one gets the time
            // for a view and draws none.
            let patience = if rests { Duration::from_secs(60) } else { Duration::from_millis(300) };
            let begun = Instant::now();
            while drawn() < 2 && begun.elapsed() < patience {
                thread::sleep(Duration::from_millis(2));
            }
            meanwhile.fetch_add(drawn(), Ordering::SeqCst);
        };
        refined_whole(&renderer, &photos, &steps_of(30, 30), &made);
        let drawn = meanwhile.into_inner();
        assert_eq!(drawn > 1, rests, "{drawn} views");
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
    assert_eq!((best.steps, best.judged), (UNWATCHED_STEPS_MAX, None));
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
        let scene = scene(start, f64::NAN);
        let gaussians = ready(&scene, start, options)?;
        refine(&cpu, &scene, &gaussians, photos.into(), &[], options, &mut pace)
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
