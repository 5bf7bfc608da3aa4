//! Steps of training against those of another implementation: `adam.csv` has what `PyTorch`'s Adam
//! makes of the same gradients (`tests/tools/adam_vectors.py`). The trainer of a device is held to
//! the one of the processor in `train.rs`.

use std::sync::atomic::{AtomicUsize, Ordering};

use segsplat_core::{
    error::Result,
    scene::{Gaussians, Photo, RawGaussians},
};
use segsplat_render::{
    DifferentiableRenderer, Frame, Kinds, RenderRequest, Renderer,
    backward::{FrameGradients, Gradients},
    train::{HostTrainer, LearningRates, Trainer as _, TrainingPhoto, TrainingSet, TrainingStep},
};
use segsplat_testing::scenes::{Random, camera, checked, push, request};

const STEPS: usize = 24;
const GAUSSIANS: usize = 3;
/// Numbers of a Gaussian: mean, quaternion, scales, opacity, harmonics.
const NUMBERS: usize = 23;
/// Sizes of their gradients: from those whose squares are no f32 to those whose squares are large.
const SIZES: [f64; NUMBERS] = [
    1.0, 1e-3, 1e6, 1e-2, 1e-2, 1e-2, 1e-2, 10.0, 1e-8, 1e-14, 1e-4, 1.0, 1e-10, 1e15, 1e-12,
    1e-14, 1e-15, 1e-16, 1e-18, 1e-20, 1e-25, 1e-30, 1e10,
];
/// Pixels of the picture.
const SIZE: [u32; 2] = [4, 2];

/// A renderer whose gradients and picture are given.
struct Given {
    gradients: Vec<Gradients>,
    color: Vec<[f32; 3]>,
    step: AtomicUsize,
}

impl Given {
    fn new() -> Self {
        let mut random = Random(7);
        let gradients = (0..STEPS).map(|step| {
            let mut by = Gradients::default();
            by.clear(GAUSSIANS, 4);
            for i in 0..GAUSSIANS {
                let own: Vec<f32> = SIZES.iter().map(|size| sized(&mut random, *size)).collect();
                by.means[i].copy_from_slice(&own[..3]);
                by.quats[i].copy_from_slice(&own[3..7]);
                by.scales[i].copy_from_slice(&own[7..10]);
                by.opacities[i] = own[10];
                by.sh[4 * i..4 * i + 4].as_flattened_mut().copy_from_slice(&own[11..]);
                by.seen[i] = [true, step % 3 != 1, step >= 10][i];
            }
            by
        });
        let gradients = gradients.collect();
        let mut random = Random(8);
        let color = (0..8).map(|_| [(); 3].map(|()| random.range(0.5, 1.0))).collect();
        Self { gradients, color, step: AtomicUsize::new(0) }
    }
}

fn sized(random: &mut Random, size: f64) -> f32 {
    ((f64::from(random.range(0.0, 1.0)) - 0.25) * size) as f32
}

impl Renderer for Given {
    fn name(&self) -> String {
        "given".to_owned()
    }

    fn concurrency(&self) -> usize {
        1
    }

    fn render(&self, _: &Gaussians, _: &RenderRequest) -> Result<Frame> {
        let [width, height] = SIZE;
        Ok(Frame { width, height, color: Some(self.color.clone()), ..Frame::default() })
    }
}

impl DifferentiableRenderer for Given {
    fn backward(
        &self,
        gaussians: &Gaussians,
        request: &RenderRequest,
        loss: &mut dyn FnMut(&Frame) -> Result<FrameGradients>,
        gradients: &mut Gradients,
    ) -> Result<Frame> {
        let frame = self.render(gaussians, request)?;
        loss(&frame)?;
        gradients.clone_from(&self.gradients[self.step.fetch_add(1, Ordering::Relaxed)]);
        Ok(frame)
    }
}

/// Numbers that moved from `start`: within a ten-thousandth of the way, and f32's rounding of the
/// steps.
fn near(name: &str, start: &[f32], got: &[f32], want: &[f64]) {
    assert_eq!(got.len(), want.len(), "{name}");
    for (k, (&got, &want)) in got.iter().zip(want).enumerate() {
        let (got, start) = (f64::from(got), f64::from(start[k]));
        let bound = 1e-4 * (want - start).abs() + 1e-6 * start.abs();
        assert!(want != start, "{name}: number {k} does not move");
        assert!((got - want).abs() <= bound, "{name}: number {k} is {got:e}, not {want:e}");
    }
}

fn numbers(raw: &RawGaussians, i: usize) -> Vec<f32> {
    let mut all = [&raw.means[i][..], &raw.quats[i], &raw.scales[i]].concat();
    all.push(raw.opacities[i]);
    all.extend(raw.sh[4 * i..4 * i + 4].as_flattened());
    all
}

#[test]
fn steps_are_those_of_pytorch() {
    let rows: Vec<Vec<f64>> = include_str!("adam.csv")
        .lines()
        .skip(1)
        .map(|row| row.split(',').map(|value| value.parse().expect("a number")).collect())
        .collect();
    let mut raw = RawGaussians { sh_degree: 1, ..RawGaussians::default() };
    for i in 0..GAUSSIANS {
        let mean = [0.5, -0.25, i as f32];
        push(&mut raw, mean, [0.5, 0.5, -0.5, 0.5], [0.5, 0.25, 0.125], 0.25, &[[0.0; 3]; 4]);
    }
    let start = checked(raw);
    let [width, height] = SIZE;
    let rgb = (0..8).flat_map(|at| [8 * at, 8 * at + 1, 8 * at + 2]).collect();
    let photo = Photo { width, height, rgb, valid: None };
    let request = RenderRequest { kinds: Kinds::COLOR, ..request(camera(width, height)) };
    let photos = vec![TrainingPhoto { photo: &photo, request, pose: 0 }];
    let given = Given::new();
    let (streamed, ssim_share) = (Vec::new(), 0.2);
    let set = TrainingSet { gaussians: &start, photos, streamed, ssim_share, gaussians_max: 0 };
    let mut trainer = HostTrainer::new(&given, &set).expect("a trainer");
    let rates = LearningRates {
        means: 1e-2,
        quats: 2e-3,
        scales: 5e-3,
        opacities: 5e-2,
        sh: 2.5e-3,
        sh_rest: 1.25e-4,
    };
    let step = TrainingStep { rates, exposure: 5e-3, ..TrainingStep::default() };
    for _ in 0..STEPS {
        trainer.step(&[0], &step).expect("a step");
    }
    let (start, moved) = (start.into_raw(), trainer.gaussians().expect("moved").into_raw());
    for (i, want) in rows[..GAUSSIANS].iter().enumerate() {
        near(&format!("Gaussian {i}"), &numbers(&start, i), &numbers(&moved, i), want);
    }
    let exposure = trainer.exposures().expect("exposures")[0].0;
    let got = [exposure.gain, exposure.bias].concat();
    near("exposure", &[1.0, 1.0, 1.0, 0.0, 0.0, 0.0], &got, &rows[GAUSSIANS]);
}
