//! Photos that are read for each of their steps are learnt as those that a trainer keeps.

use std::sync::Arc;

use segsplat_core::{
    error::{Error, ErrorCode, Result},
    scene::{Gaussians, Photo},
};
use segsplat_render::{
    DifferentiableRenderer, RenderRequest,
    train::{HostTrainer, PhotoSource, StreamedPhoto, Trainer, TrainingSet},
};
use segsplat_testing::scenes::{checked, cloud};

use crate::{
    common::{both_kernels, cpu},
    train::{disturbed, kinds, photos, set, step},
};

#[derive(Debug)]
struct Memory(Vec<Photo>);

impl PhotoSource for Memory {
    fn photo(&self, number: usize) -> Result<Photo> {
        self.0.get(number).cloned().ok_or_else(|| Error::internal("no such photo"))
    }
}

/// The set of `photos` that keeps the first alone.
fn streaming<'a>(
    gaussians: &'a Gaussians,
    photos: &'a [(RenderRequest, Photo)],
) -> TrainingSet<'a> {
    let source = Arc::new(Memory(photos.iter().map(|(_, photo)| photo.clone()).collect()));
    let streamed = photos.iter().enumerate().skip(1).map(|(number, (request, _))| {
        let request = request.clone();
        StreamedPhoto { source: source.clone(), number, request, pose: number }
    });
    TrainingSet { streamed: streamed.collect(), ..set(gaussians, &photos[..1]) }
}

fn after(trainer: &mut dyn Trainer, steps: &[&[usize]]) -> Gaussians {
    steps.iter().for_each(|photos| trainer.step(photos, &step(0.0)).expect("a step"));
    trainer.grow(&[0, 2], 2_600).expect("growth");
    trainer.step(&[1], &step(0.0)).expect("a step");
    assert_eq!(trainer.poses().expect("cameras").len(), 3);
    trainer.gaussians().expect("Gaussians")
}

#[test]
fn a_streamed_photo_is_learnt_as_one_that_is_kept() {
    // Some steps lack room and are taken again, after others have had the place.
    let mut raw = cloud(2_500, 0, 9).into_raw();
    raw.scales.iter_mut().flatten().for_each(|scale| *scale = scale.max(1.5));
    raw.opacities.iter_mut().for_each(|opacity| *opacity = opacity.min(0.05));
    let truth = checked(raw);
    let photos = photos(&truth, &[[40, 30], [150, 110], [75, 50]]);
    let start = disturbed(&truth);
    let [mut kept, mut streamed] = [set(&start, &photos), streaming(&start, &photos)];
    kept.gaussians_max = 2_600;
    streamed.gaussians_max = 2_600;
    let steps: [&[usize]; 6] = [&[1], &[2], &[0], &[2, 1], &[1], &[2]];
    let cpu = cpu();
    let all = [&kept, &streamed].map(|set| {
        let mut host = HostTrainer::new(&cpu, set).expect("a trainer");
        kinds(&after(&mut host, &steps))
    });
    assert!(all[0] == all[1], "on the processor");
    for gpu in both_kernels() {
        let all = [&kept, &streamed].map(|set| {
            let mut device = gpu.trainer(set, u64::MAX).expect("room").expect("a trainer");
            kinds(&after(&mut *device, &steps))
        });
        assert!(all[0] == all[1], "on a device");
    }
}

#[test]
fn streamed_photos_have_the_place_of_one() {
    let truth = cloud(100, 0, 5);
    let one = photos(&truth, &[[40, 30], [400, 300]]);
    let many = [&one[..], &vec![one[1].clone(); 40]].concat();
    let needs = |gpu: &dyn DifferentiableRenderer, set: &TrainingSet<'_>, bytes| {
        gpu.trainer(set, bytes).map(drop).map_err(|error| error.code())
    };
    for gpu in both_kernels() {
        let bytes = 16 << 20;
        assert_eq!(needs(gpu, &streaming(&truth, &many), bytes), Ok(()));
        let kept = set(&truth, &many);
        assert_eq!(needs(gpu, &kept, bytes), Err(ErrorCode::LimitExceeded));
    }
}

#[test]
fn a_photo_of_another_size_than_its_view_is_refused() {
    let truth = cloud(100, 0, 5);
    let photos = photos(&truth, &[[40, 30], [40, 30]]);
    let mut odd = streaming(&truth, &photos);
    let mut small = photos[1].1.clone();
    (small.height, small.valid) = (20, None);
    odd.streamed[0].source = Arc::new(Memory(vec![small.clone(), small]));
    let cpu = cpu();
    let mut host = HostTrainer::new(&cpu, &odd).expect("a trainer");
    let told = host.step(&[1], &step(0.0)).expect_err("another size");
    assert!(told.message().contains("[40, 20]"), "{told}");
    for gpu in both_kernels() {
        let mut device = gpu.trainer(&odd, u64::MAX).expect("room").expect("a trainer");
        assert!(device.step(&[1], &step(0.0)).is_err(), "another size");
    }
}
