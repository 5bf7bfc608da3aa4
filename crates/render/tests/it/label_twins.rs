//! Labels of the GPU renderer: against the plain definition (one-hot colours) on the same adapter,
//! and against the CPU renderer.

use std::sync::Arc;

use segsplat_core::scene::RawGaussians;
use segsplat_render::{Kinds, Labels, PixelWeights, RenderRequest, Renderer};

use crate::common::{both_kernels, cpu, gpu, judge_labels, open};
use segsplat_testing::labels::{apart, draw_labels, labelled, literal_of, table};
use segsplat_testing::scenes::{camera, checked, cloud, request};

#[test]
fn labels_of_the_gpu_equal_the_plain_definition() {
    for gpu in both_kernels() {
        for (m, width, height) in [(1, 33, 17), (2, 16, 16), (24, 64, 48), (512, 24, 20)] {
            let gaussians = labelled(1_500, m, 200 + u64::from(m));
            let request = request(camera(width, height));
            let table = table(usize::from(m) + 1, 7);
            let drawn = draw_labels(gpu, &gaussians, &request, &table);
            let dense = literal_of(gpu, &gaussians, &request, m);
            let (far, worst) = apart(&drawn, &dense, &table, 1e-5);
            assert!(
                far.is_empty(),
                "M = {m}: {} pixels differ, first {:?}",
                far.len(),
                far.first()
            );
            println!("M = {m}: {} weights, max {worst:.2e}", drawn.weights.entries.len());
        }
    }
}

#[test]
fn labels_of_the_gpu_are_those_of_the_cpu() {
    for gpu in both_kernels() {
        for (m, width, height) in
            [(0, 40, 30), (1, 1, 1), (7, 97, 61), (24, 160, 120), (512, 160, 120), (4_096, 80, 60)]
        {
            let gaussians = labelled(3_001, m, 300 + u64::from(m));
            judge_labels(gpu, &format!("M = {m}"), &gaussians, &request(camera(width, height)));
        }
        let none = checked(RawGaussians::default());
        let drawn = draw_labels(gpu, &none, &request(camera(20, 10)), &table(3, 1));
        assert_eq!(drawn.weights, PixelWeights::none(200), "no Gaussians");
        assert_eq!(drawn.blend, [[0.0; 4]; 200], "no Gaussians");

        // A table that is shorter than the bank, and none at all.
        let (gaussians, request) = (labelled(900, 8, 51), request(camera(40, 25)));
        for short in [table(4, 6), [[0.5, -1.0, 2.0, 3.0]; 2].into(), [].into()] {
            let got = draw_labels(gpu, &gaussians, &request, &short).blend;
            let want = draw_labels(&cpu(), &gaussians, &request, &short).blend;
            let worst = got.iter().flatten().zip(want.iter().flatten());
            let worst = worst.fold(0.0_f32, |worst, (a, b)| worst.max((a - b).abs()));
            assert!(worst < 1e-3, "table of {} rows: {worst}", short.len());
        }
    }
}

#[test]
fn labels_change_no_picture_of_the_gpu_and_bands_no_label() {
    let Some(gpu) = gpu() else { return };
    let gaussians = labelled(2_000, 9, 31);
    let plain = request(camera(70, 45));
    let table = table(10, 3);
    let want = gpu.render(&gaussians, &plain).expect("pictures");
    let drawn = draw_labels(gpu, &gaussians, &plain, &table);
    for labels in [Labels::Blend(Arc::clone(&table)), Labels::Weights] {
        for (color, depth, alpha) in [(true, true, true), (true, false, false), (false, true, true)]
        {
            let kinds = Kinds { color, depth, alpha };
            let request = RenderRequest { kinds, labels: labels.clone(), ..plain.clone() };
            let got = gpu.render(&gaussians, &request).expect("pictures and labels");
            assert_eq!(got.color, want.color.clone().filter(|_| color), "{kinds:?} colour");
            assert_eq!(got.depth, want.depth.clone().filter(|_| depth), "{kinds:?} depth");
            assert_eq!(got.alpha, want.alpha.clone().filter(|_| alpha), "{kinds:?} alpha");
            match labels {
                Labels::Weights => assert_eq!(got.weights.as_ref(), Some(&drawn.weights)),
                _ => assert_eq!(got.blend.as_ref(), Some(&drawn.blend), "{kinds:?}"),
            }
        }
    }
    let total = want.stats.intersections as u32;
    let Some(small) = open(|options| options.switches.isects_max = Some(total / 2)) else { return };
    let banded = draw_labels(&small, &gaussians, &plain, &table);
    assert_eq!((banded.weights, banded.blend), (drawn.weights, drawn.blend), "in bands");
}

#[test]
fn another_index_of_the_same_gaussians_is_drawn_and_their_shape_is_kept() {
    let Some(gpu) = open(|_| {}) else { return };
    let request = request(camera(50, 40));
    // An odd number: the last word of the indices is half full.
    let bare = cloud(1_201, 1, 91);
    gpu.render(&bare, &request).expect("a picture");
    for m in [3, 11] {
        let index = (0..1_201).map(|i| i % (m + 1)).collect();
        let labelled = bare.with_semantic_index(index).expect("an index a Gaussian");
        judge_labels(&gpu, &format!("index of {m}"), &labelled, &request);
        assert_eq!(gpu.internals().scenes_held(), 1, "the shape is held once");
    }
    assert_eq!(draw_labels(&gpu, &bare, &request, &table(4, 2)).weights, PixelWeights::none(2_000));
}
