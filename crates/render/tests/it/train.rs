//! Steps of training: the loss against its oracle, and the trainer of a device against the one of
//! the processor.

use segsplat_core::{
    error::ErrorCode,
    scene::{Gaussians, Photo},
};
use segsplat_render::{
    Background, DifferentiableRenderer, Kinds, RenderRequest, Renderer as _,
    gpu::GpuRenderer,
    train::{HostTrainer, Trainer, TrainingPhoto, TrainingSet, TrainingStep, photo_loss, unit},
};
use segsplat_testing::{
    loss,
    scenes::{Random, camera, checked, cloud, look, request},
};

use crate::common::{both_kernels, cpu};

const SHARE: f32 = 0.2;

fn random_picture(pixels: usize, seed: u64) -> Vec<[f64; 3]> {
    let mut random = Random(seed);
    (0..pixels).map(|_| [(); 3].map(|()| f64::from(random.range(0.0, 1.0)))).collect()
}

fn wide(picture: &[[f32; 3]]) -> Vec<[f64; 3]> {
    picture.iter().map(|color| color.map(f64::from)).collect()
}

/// Errors of `got` relative to `want`, ascending, where that is not 0; both are 0 elsewhere.
fn errors(got: &[[f32; 3]], want: &[[f64; 3]]) -> Vec<f64> {
    let pairs = got.as_flattened().iter().zip(want.as_flattened());
    let (counts, rest): (Vec<_>, Vec<_>) = pairs.partition(|(_, want)| **want != 0.0);
    assert!(rest.iter().all(|(got, _)| **got == 0.0), "what does not count pulls");
    let relative = counts.iter().map(|(got, want)| (f64::from(**got) - *want).abs() / want.abs());
    let mut errors: Vec<f64> = relative.collect();
    errors.sort_by(f64::total_cmp);
    errors
}

fn check_errors(name: &str, errors: &[f64]) {
    let at = |share: f64| errors[(share * (errors.len() - 1) as f64) as usize];
    println!("{name}: {} numbers, median {:.1e}, 99 % {:.1e}", errors.len(), at(0.5), at(0.99));
    assert!(at(0.5) <= 1e-4 && at(0.99) <= 1e-2, "{name}: {:.1e}, {:.1e}", at(0.5), at(0.99));
}

#[test]
fn the_oracle_of_the_loss_agrees_with_finite_differences() {
    let (width, pixels) = (19, 19 * 14);
    let (shown, photo) = (random_picture(pixels, 3), random_picture(pixels, 4));
    let valid: Vec<bool> = (0..pixels).map(|i| i % 9 != 4).collect();
    for valid in [None, Some(&valid[..])] {
        let of = |shown: &[[f64; 3]]| loss::photo_loss(shown, &photo, width, valid, 0.2);
        let (_, gradient) = of(&shown);
        for i in (0..pixels).step_by(5) {
            let moved = |by: f64| {
                let mut moved = shown.clone();
                moved[i][i % 3] += by;
                of(&moved).0
            };
            let want = (moved(1e-6) - moved(-1e-6)) / 2e-6;
            let got = gradient[i][i % 3];
            assert!((got - want).abs() <= 1e-9 + 1e-5 * want.abs(), "{i}: {got} is not {want}");
        }
    }
}

#[test]
fn the_kernel_of_the_loss_agrees_with_the_oracle() {
    let (width, pixels) = (61, 61 * 40);
    let narrow = |picture: Vec<[f64; 3]>| -> Vec<[f32; 3]> {
        picture.iter().map(|color| color.map(|v| v as f32)).collect()
    };
    let (shown, photo) = (narrow(random_picture(pixels, 5)), narrow(random_picture(pixels, 6)));
    let valid: Vec<bool> = (0..pixels).map(|i| i % 9 != 4).collect();
    for valid in [None, Some(&valid[..])] {
        let got = photo_loss(&shown, &photo, width, valid, SHARE);
        let (value, gradient) =
            loss::photo_loss(&wide(&shown), &wide(&photo), width, valid, SHARE.into());
        assert!((got.value - value).abs() < 1e-6, "{} is not {value}", got.value);
        check_errors("kernel", &errors(&got.gradient, &gradient));
    }
}

#[test]
fn pixels_without_a_source_and_small_pictures_are_allowed_for() {
    let photo = vec![[0.5; 3]; 15 * 15];
    let mut shown = photo.clone();
    shown[17] = [0.9, 0.1, 0.4];
    let mut valid = vec![true; 15 * 15];
    valid[17] = false;
    let found = photo_loss(&shown, &photo, 15, Some(&valid), SHARE);
    assert!(found.value.abs() < 1e-6, "{} for the same picture", found.value);
    assert!(found.gradient[17] == [0.0; 3], "a pixel that does not count pulls");
    let small = photo_loss(&shown[..20], &photo[..20], 5, None, SHARE);
    assert!(small.value > 0.0 && small.gradient[17][0] > 0.0, "no window fits: L1 alone");
    assert!(photo_loss(&[], &[], 0, None, SHARE).gradient.is_empty(), "no picture");
}

/// Views of `truth` and photos that they should look like, some darker, some with holes.
pub(crate) fn photos(truth: &Gaussians, sides: &[[u32; 2]]) -> Vec<(RenderRequest, Photo)> {
    let make = |(i, &[width, height]): (usize, &[u32; 2])| {
        let eye = glam::DVec3::new(0.3 * i as f64 - 0.5, 0.2 * i as f64, -0.5);
        let pose = look(eye, glam::DVec3::new(0.3, -0.2, 4.0));
        let mut camera = camera(width, height);
        camera.camera_to_world = pose;
        let background = Background::Color([0.2, 0.4, 0.3]);
        let request = RenderRequest { background, kinds: Kinds::COLOR, ..request(camera) };
        let frame = cpu().render(truth, &request).expect("a picture");
        let dark = 1.0 - 0.1 * i as f32;
        let level = |v: &f32| (v * dark * 255.0).round().clamp(0.0, 255.0) as u8;
        let rgb = frame.color.expect("colour").as_flattened().iter().map(level).collect();
        let holes = (0..width * height).map(|at| at % 17 != 5).collect();
        (request, Photo { width, height, rgb, valid: (i == 1).then_some(holes) })
    };
    sides.iter().enumerate().map(make).collect()
}

pub(crate) fn disturbed(gaussians: &Gaussians) -> Gaussians {
    let mut random = Random(8);
    let mut raw = gaussians.clone().into_raw();
    for i in 0..raw.means.len() {
        raw.means[i][0] += random.range(-0.02, 0.02);
        raw.scales[i][1] *= random.range(0.6, 1.5);
        raw.opacities[i] = (raw.opacities[i] * random.range(0.3, 1.6)).clamp(0.02, 0.95);
        raw.sh[i][0] += random.range(-0.5, 0.5);
        raw.source[i].view = (i % 5) as u16;
    }
    checked(raw)
}

pub(crate) fn set<'a>(
    gaussians: &'a Gaussians,
    photos: &'a [(RenderRequest, Photo)],
) -> TrainingSet<'a> {
    let photo = |(request, photo): &'a (RenderRequest, Photo)| TrainingPhoto {
        photo,
        request: request.clone(),
        pose: 0,
    };
    let photos = photos.iter().map(photo).enumerate();
    let photos = photos.map(|(pose, photo)| TrainingPhoto { pose, ..photo }).collect();
    let (streamed, gaussians_max) = (Vec::new(), gaussians.len());
    TrainingSet { gaussians, photos, streamed, ssim_share: SHARE, gaussians_max }
}

pub(crate) fn step(opacity_min: f32) -> TrainingStep {
    TrainingStep { exposure: 5e-3, opacity_min, ..TrainingStep::default() }
}

#[test]
fn the_shaders_of_the_loss_agree_with_the_oracle() {
    let truth = cloud(2_000, 0, 5);
    let (start, photos) = (disturbed(&truth), photos(&truth, &[[75, 50], [64, 48], [10, 30]]));
    for gpu in both_kernels() {
        let set = set(&start, &photos);
        for (at, (request, photo)) in photos.iter().enumerate() {
            let shown = gpu.render(&start, request).expect("a picture").color.expect("colour");
            let valid = photo.valid.as_deref();
            let width = photo.width as usize;
            let (value, want) =
                loss::photo_loss(&wide(&shown), &wide(&unit(photo)), width, valid, SHARE.into());
            let got = gpu.internals().loss_gradient(&set, at, &step(0.0)).expect("a step");
            check_errors(&format!("photo {at}"), &errors(&got, &want));
            let mut trainer = gpu.trainer(&set, u64::MAX).expect("room").expect("a trainer");
            trainer.step(&[at], &step(0.0)).expect("a step");
            let told = trainer.exposures().expect("exposures")[at].1;
            assert!((told - value).abs() < 1e-5, "photo {at}: {told} is not {value}");
        }
    }
}

/// Numbers of Gaussians of each kind.
pub(crate) fn kinds(gaussians: &Gaussians) -> [(&'static str, Vec<f32>); 5] {
    let raw = gaussians.clone().into_raw();
    [
        ("means", raw.means.as_flattened().to_vec()),
        ("quats", raw.quats.as_flattened().to_vec()),
        ("scales", raw.scales.iter().flatten().map(|v| v.ln()).collect()),
        ("opacities", raw.opacities.iter().map(|v| (v / (1.0 - v)).ln()).collect()),
        ("sh", raw.sh.as_flattened().to_vec()),
    ]
}

type Steps<'a> = &'a [(&'a [usize], f32)];

/// The trainer of `gpu` against that of the processor over the same renderer, after `steps`.
fn judge(gpu: &GpuRenderer, name: &str, set: &TrainingSet<'_>, steps: Steps<'_>) {
    judge_order(gpu, name, set, [steps, steps]);
}

/// The same, where the device takes the first `steps` in the order of the second.
fn judge_order(gpu: &GpuRenderer, name: &str, set: &TrainingSet<'_>, steps: [Steps<'_>; 2]) {
    let mut device = gpu.trainer(set, u64::MAX).expect("room").expect("a trainer");
    let mut host = HostTrainer::new(gpu, set).expect("a trainer");
    for (photos, opacity_min) in steps[0] {
        device.step(photos, &step(*opacity_min)).expect("a step of the device");
    }
    for (photos, opacity_min) in steps[1] {
        host.step(photos, &step(*opacity_min)).expect("a step of the processor");
    }
    let (got, want) = (device.gaussians().unwrap(), host.gaussians().unwrap());
    assert_eq!(got.len(), want.len(), "{name}: Gaussians that are left");
    assert!(got.source() == want.source(), "{name}: which are left");
    if got.len() == set.gaussians.len() {
        let numbers = kinds(&got).into_iter().zip(kinds(&want)).zip(kinds(set.gaussians));
        for (((kind, got), (_, want)), (_, start)) in numbers {
            let moved: Vec<f32> = want.iter().zip(&start).map(|(a, b)| (a - b).abs()).collect();
            let most = moved.iter().copied().fold(0.0, f32::max);
            let mut away: Vec<f32> = got.iter().zip(&want).map(|(a, b)| (a - b).abs()).collect();
            away.sort_by(f32::total_cmp);
            let at = |share: f64| away[(share * (away.len() - 1) as f64) as usize] / most;
            println!("{name}: {kind} {most:.1e}: median {:.1e}, 99 % {:.1e}", at(0.5), at(0.99));
            assert!(most > 0.0, "{name}: {kind} do not move");
            assert!(at(0.5) <= 1e-3 && at(0.99) <= 5e-2, "{name}: {kind} come apart");
        }
    }
    let told = device.exposures().unwrap().into_iter().zip(host.exposures().unwrap());
    for (at, ((got, loss), (want, truth))) in told.enumerate() {
        let numbers = got.gain.iter().chain(&got.bias).zip(want.gain.iter().chain(&want.bias));
        let apart = numbers.fold(0.0_f32, |most, (a, b)| most.max((a - b).abs()));
        assert!(apart < 2e-4, "{name}: exposure {at} is {apart} away");
        assert!((loss - truth).abs() < 1e-4 || loss.is_nan() && truth.is_nan(), "{name}: loss");
    }
    let (request, mut frames) = (&set.photos[0].request, Vec::new());
    frames.push(device.render(request).expect("a picture").color.expect("colour"));
    frames.push(host.render(request).expect("a picture").color.expect("colour"));
    let numbers = frames[0].as_flattened().iter().zip(frames[1].as_flattened());
    let near = numbers.filter(|(a, b)| (*a - *b).abs() < 4e-3).count();
    assert!(near * 100 >= 99 * 3 * frames[0].len(), "{name}: {near} numbers of the picture");
}

#[test]
fn the_trainer_of_a_device_takes_the_steps_of_the_processor() {
    for gpu in both_kernels() {
        for degree in [0, 2] {
            let truth = cloud(1_500, degree, 5);
            let (start, photos) = (disturbed(&truth), photos(&truth, &[[75, 50], [64, 48]]));
            let set = set(&start, &photos);
            let steps: [(&[usize], f32); 5] =
                [(&[0], 0.0), (&[1], 0.0), (&[0], 0.0), (&[1], 0.0), (&[0], 0.0)];
            judge(gpu, "one photo a step", &set, &steps);
            judge(gpu, "two photos a step", &set, &[(&[0, 1], 0.0), (&[1, 0], 0.0)]);
            judge(gpu, "dropping", &set, &[(&[0], 0.0), (&[1], 0.1), (&[0], 0.0), (&[1], 0.0)]);
        }
    }
}

#[test]
fn a_step_that_lacks_room_is_taken_once() {
    // More tile pairs than the first room has.
    let mut raw = cloud(2_500, 0, 9).into_raw();
    raw.scales.iter_mut().flatten().for_each(|scale| *scale = scale.max(1.5));
    raw.opacities.iter_mut().for_each(|opacity| *opacity = opacity.min(0.05));
    let truth = checked(raw);
    let photos = photos(&truth, &[[150, 110], [40, 30]]);
    for gpu in both_kernels() {
        let pairs: Vec<u64> = photos
            .iter()
            .map(|(request, _)| gpu.render(&truth, request).expect("a picture"))
            .map(|frame| frame.stats.intersections)
            .collect();
        assert!(pairs[0] > 1 << 16 && pairs[1] < 1 << 16, "{pairs:?} pairs");
        let start = disturbed(&truth);
        let set = set(&start, &photos);
        judge(gpu, "one alone", &set, &[(&[0], 0.0)]);
        judge(gpu, "both lack room", &set, &[(&[0], 0.0), (&[0], 0.0), (&[1], 0.0)]);
        // The next one was under way when it was known that the first lacked room.
        let taken: [Steps<'_>; 2] =
            [&[(&[0], 0.0), (&[1], 0.0), (&[1], 0.0)], &[(&[1], 0.0), (&[0], 0.0), (&[1], 0.0)]];
        judge_order(gpu, "the first lacks room", &set, taken);
    }
}

#[test]
fn odd_input_is_refused_and_nothing_has_no_trainer() {
    let truth = cloud(100, 0, 5);
    let mut photos = photos(&truth, &[[40, 30]]);
    let none = truth.only(|_| false);
    for gpu in both_kernels() {
        let first = set(&truth, &photos);
        let told = gpu.trainer(&first, 4 * 40 * 30).map(drop).expect_err("its photos alone");
        assert_eq!(told.code(), ErrorCode::LimitExceeded, "{told}");
        let mut trainer = gpu.trainer(&first, u64::MAX).expect("room").expect("a trainer");
        let told = trainer.step(&[1], &step(0.0)).expect_err("no such photo");
        assert!(told.message().contains("photo 1"), "{told}");
        assert!(gpu.trainer(&set(&none, &photos), u64::MAX).expect("nothing to do").is_none());
    }
    photos[0].1.width = 20;
    let other = set(&truth, &photos);
    let told = HostTrainer::new(&cpu(), &other).map(drop).expect_err("another size");
    assert!(told.message().contains("[20, 30]"), "{told}");
    for gpu in both_kernels() {
        assert!(gpu.trainer(&other, u64::MAX).is_err(), "another size");
    }
}
