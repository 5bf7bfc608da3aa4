//! Labels of pixels that show many entries.

use segsplat_core::scene::{Gaussians, RawGaussians};
use segsplat_render::{Labels, Renderer};

use crate::common::{cpu, judge_labels, open};
use segsplat_testing::labels::{alone, labelled};
use segsplat_testing::scenes::{Random, camera, checked, push, request};

/// `count` faint discs over the whole view, each of an index of its own.
fn stack(count: u16) -> Gaussians {
    let (mut raw, mut random) = (RawGaussians::default(), Random(71));
    for i in 0..count {
        let mean = [random.range(-0.1, 0.1), random.range(-0.1, 0.1), 2.0 + f32::from(i) * 0.01];
        push(&mut raw, mean, random.quat(), [9.0; 3], random.range(0.02, 0.03), &[[0.5; 3]]);
    }
    let gaussians = checked(raw);
    let index = (0..count).map(|i| 1 + (i * 37) % count).collect();
    gaussians.with_semantic_index(index).expect("an index a Gaussian")
}

#[test]
fn pixels_with_more_entries_than_room_are_drawn_again() {
    for serial in [false, true] {
        let Some(gpu) = open(|options| options.switches.serial = Some(serial)) else { return };
        let many = stack(100);
        let drawn = judge_labels(&gpu, "100 weights a pixel", &many, &request(camera(48, 32)));
        assert_eq!(drawn.weights.entries.len(), 100 * 48 * 32, "every pixel sees every index");
        // Room once made changes nothing for a view that needs less, and is found again.
        let few = labelled(800, 5, 81);
        judge_labels(&gpu, "after it few", &few, &request(camera(48, 32)));
        judge_labels(&gpu, "and many again", &many, &request(camera(30, 20)));
        // Slots for all of this picture are over the 128 MiB of a portable binding: bands.
        let large = request(camera(512, 352));
        let drawn = gpu.render(&many, &alone(&large, Labels::Weights)).expect("weights in bands");
        let weights = drawn.weights.expect("weights");
        let want = cpu().render(&many, &alone(&large, Labels::Weights)).expect("weights");
        let want = want.weights.expect("weights");
        assert_eq!(weights.offsets, want.offsets, "offsets in bands");
        assert_eq!(weights.entries, want.entries, "indices in bands");
        let worst = weights.weights.iter().zip(&want.weights);
        let worst = worst.fold(0.0_f32, |worst, (a, b)| worst.max((a - b).abs()));
        assert!(worst < 1e-4, "weights in bands: {worst}");
    }
}
