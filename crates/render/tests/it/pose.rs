//! Where a camera stands: its derivatives against finite differences of the oracle, the kernel of
//! the processor and the shader against the oracle, and cameras that are brought back.

use glam::DVec3;
use segsplat_core::scene::{CameraToWorld, Gaussians};
use segsplat_render::{
    DifferentiableRenderer, RenderRequest,
    backward::Gradients,
    gpu::GpuRenderer,
    train::{
        HostTrainer, PoseGradient, PoseRates, Trainer, TrainingSet, TrainingStep, pose::moved,
    },
};
use segsplat_testing::{
    backward,
    scenes::{Random, camera, checked, cloud, look, request},
};

use crate::{
    backward::{few, linear, losses, only},
    common::{both_kernels, cpu},
    train::{disturbed, photos, set, step},
};

const AXES: [DVec3; 3] = DVec3::AXES;

/// A view of few Gaussians that is not along an axis of the world.
fn skewed(width: u32, height: u32) -> RenderRequest {
    let mut of = request(camera(width, height));
    of.camera.camera_to_world = look(DVec3::new(0.4, -0.3, -0.6), DVec3::new(0.2, 0.1, 4.0));
    of
}

#[test]
fn the_derivatives_by_a_pose_agree_with_finite_differences() {
    let gaussians = checked(few(&mut Random(21), 0));
    let at = skewed(24, 18);
    let pose = at.camera.camera_to_world;
    let loss = linear(24 * 18, 78);
    let at_rest = losses(&gaussians, &at, &loss);
    for (kind, axis) in [0, 1].into_iter().flat_map(|kind| AXES.map(|axis| (kind, axis))) {
        let step = 1e-5;
        let moved = |by: f64| {
            let [turn, shift] = [[axis * by, DVec3::ZERO], [DVec3::ZERO, axis * by]][kind];
            let mut moved_request = at.clone();
            moved_request.camera.camera_to_world = moved(&pose, turn, shift);
            losses(&gaussians, &moved_request, &loss)
        };
        let (up, down) = (moved(step), moved(-step));
        let keep: Vec<bool> =
            (0..up.len()).map(|p| up[p].1 == at_rest[p].1 && down[p].1 == at_rest[p].1).collect();
        assert!(keep.iter().filter(|keep| **keep).count() * 2 > keep.len(), "few cliffs");
        let kept = keep.iter().enumerate().filter(|(_, keep)| **keep);
        let difference: f64 = kept.map(|(p, _)| up[p].0 - down[p].0).sum();
        let want = difference / (2.0 * step);
        let by = backward::gradients(&gaussians, &at, &only(&loss, &keep)).expect("gradients");
        let by = PoseGradient::of(&gaussians, &by, pose.center());
        let got = (pose.rotation() * axis).dot([by.turn, by.shift][kind]);
        println!("kind {kind}, {axis}: {got}, by differences {want}");
        assert!((got - want).abs() < 1e-3 * (want.abs() + 1.0), "{kind} {axis}: {got}, {want}");
        assert!(want.abs() > 0.1, "it counts");
    }
}

#[test]
fn the_kernel_of_the_processor_agrees_with_the_oracle() {
    let gaussians = cloud(1_500, 0, 5);
    let at = skewed(70, 50);
    let (loss, center) = (linear(70 * 50, 3), at.camera.camera_to_world.center());
    let want = backward::gradients(&gaussians, &at, &loss).expect("gradients");
    let want = PoseGradient::of(&gaussians, &want, center);
    let mut by = Gradients::default();
    cpu().backward(&gaussians, &at, &mut |_| Ok(loss.clone()), &mut by).expect("gradients");
    let got = PoseGradient::of(&gaussians, &by, center);
    for (got, want) in [(got.turn, want.turn), (got.shift, want.shift)] {
        assert!((got - want).length() < 1e-3 * want.length(), "{got}, not {want}");
    }
}

fn with_poses(rate: f32) -> TrainingStep {
    TrainingStep { poses: PoseRates { turn: rate, shift: 2.0 * rate }, ..step(0.0) }
}

/// How far two poses are apart: radians, world units.
fn apart(a: &CameraToWorld, b: &CameraToWorld) -> (f64, f64) {
    (a.turn_to(b), a.center().distance(b.center()))
}

#[test]
fn the_cameras_of_a_device_move_as_those_of_the_processor() {
    let truth = cloud(1_500, 0, 5);
    let (start, photos) = (disturbed(&truth), photos(&truth, &[[75, 50], [64, 48], [40, 30]]));
    // The last photo stands where the first one does.
    let mut set = set(&start, &photos);
    set.photos[2].pose = 0;
    for gpu in both_kernels() {
        for steps in [&[&[0][..], &[1], &[0], &[2], &[1]][..], &[&[0, 1], &[1, 0]]] {
            let [device, host] = twins(gpu, &set, steps);
            assert_eq!((device.len(), host.len()), (2, 2));
            for (at, (got, want)) in device.iter().zip(&host).enumerate() {
                let (turn, shift) = apart(got, want);
                let (turned, shifted) = apart(want, &set.photos[at].request.camera.camera_to_world);
                println!("{at}: {turned:.1e}, {shifted:.1e}; apart {turn:.1e}, {shift:.1e}");
                assert!(turned > 1e-3 && shifted > 2e-3, "they move");
                assert!(turn < 0.02 * turned && shift < 0.02 * shifted, "{turn}, {shift}");
            }
        }
    }
}

/// Cameras after the same steps on a device and on the processor.
fn twins(gpu: &GpuRenderer, set: &TrainingSet<'_>, steps: &[&[usize]]) -> [Vec<CameraToWorld>; 2] {
    let device = gpu.trainer(set, u64::MAX).expect("room").expect("a trainer");
    let host = Box::new(HostTrainer::new(gpu, set).expect("a trainer"));
    [device, host].map(|mut trainer: Box<dyn Trainer + '_>| {
        for photos in steps {
            trainer.step(photos, &with_poses(2e-3)).expect("a step");
        }
        trainer.poses().expect("cameras")
    })
}

/// The camera of the first photo of `set`, which is moved away, after steps that move it alone.
fn brought_back(trainer: &mut dyn Trainer, poses: PoseRates) -> CameraToWorld {
    let still = step(0.0).rates.scaled(0.0);
    for i in 0..60_u8 {
        let poses = poses.scaled(0.1_f32.powf(f32::from(i) / 60.0));
        let step = TrainingStep { rates: still, poses, ..step(0.0) };
        trainer.step(&[0], &step).expect("a step");
    }
    trainer.poses().expect("cameras")[0]
}

#[test]
fn a_camera_that_was_moved_is_brought_back_by_its_photo() {
    let truth: Gaussians = cloud(1_500, 0, 5);
    let photos = photos(&truth, &[[75, 50]]);
    let right = photos[0].0.camera.camera_to_world;
    let wrong = moved(&right, DVec3::new(0.006, -0.007, 0.008), DVec3::new(0.03, -0.02, 0.03));
    let mut set = set(&truth, &photos);
    set.photos[0].request.camera.camera_to_world = wrong;
    let rates = PoseRates { turn: 2e-3, shift: 6e-3 };
    let renderer = cpu();
    let mut host = HostTrainer::new(&renderer, &set).expect("a trainer");
    let (before, after) = (apart(&wrong, &right), apart(&brought_back(&mut host, rates), &right));
    println!("{before:?} before, {after:?} after");
    assert!(after.0 < 0.3 * before.0 && after.1 < 0.3 * before.1, "{before:?}, {after:?}");
    // Where it is not asked for, nothing moves.
    let still = brought_back(&mut HostTrainer::new(&renderer, &set).unwrap(), PoseRates::default());
    assert_eq!(still, wrong);
}

#[test]
fn numbers_of_cameras_leave_none_out() {
    let truth = cloud(100, 0, 5);
    let photos = photos(&truth, &[[40, 30], [40, 30]]);
    let mut set = set(&truth, &photos);
    set.photos[1].pose = 2;
    let told = HostTrainer::new(&cpu(), &set).map(drop).expect_err("a gap");
    assert!(told.message().contains("camera 2 after 1"), "{told}");
}
