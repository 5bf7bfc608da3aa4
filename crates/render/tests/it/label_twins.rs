//! Labels of the GPU renderer: against the literal road of one-hot colours on the same adapter, and
//! against the CPU renderer. Adapter and skipping are those of `twins`.

use std::sync::Arc;

use segsplat_core::scene::{Gaussians, RawGaussians};
use segsplat_render::{
    Kinds, Labels, PixelWeights, RenderRequest, Renderer, cpu::CpuRenderer, gpu::GpuRenderer,
    oracle,
};

use crate::twins::{both_kernels, gpu, open};
use segsplat_testing::labels::{Drawn, alone, apart, draw_labels, labelled, literal_of, table};
use segsplat_testing::{
    compare::Tolerance,
    scenes::{Random, camera, checked, cloud, push, request},
};

fn cpu() -> CpuRenderer {
    CpuRenderer::new(2).expect("two threads")
}

/// Dense rows of sparse weights, `[H * W][m]`.
fn dense(weights: &PixelWeights, m: usize) -> Vec<Vec<f64>> {
    let row = |i| {
        let mut row = vec![0.0; m];
        for (index, weight) in weights.pixel(i) {
            row[usize::from(index) - 1] = f64::from(weight);
        }
        row
    };
    (0..weights.pixels()).map(row).collect()
}

/// GPU against CPU: within 1/255, what differs more stands at a cliff of the oracle and is rare.
fn judge(gpu: &GpuRenderer, name: &str, gaussians: &Gaussians, request: &RenderRequest) -> Drawn {
    let m = gaussians.semantic_index().iter().copied().max().unwrap_or(0);
    let table = table(usize::from(m) + 1, 11);
    let got = draw_labels(gpu, gaussians, request, &table);
    let want = draw_labels(&cpu(), gaussians, request, &table);
    let dense = dense(&want.weights, usize::from(m));
    // A blended number adds up errors of a whole row.
    let (far, worst) = apart(&got, &dense, &table, Tolerance::GPU.interior);
    let width = request.camera.intrinsics.width;
    let pixels: Vec<[u32; 2]> = far.iter().map(|&i| [i as u32 % width, i as u32 / width]).collect();
    let truth = oracle::render_pixels(gaussians, request, oracle::DepthKey::F32, &pixels)
        .expect("the truth");
    let fault = truth.iter().position(|pixel| !pixel.cliff.any()).map(|at| far[at]);
    assert!(fault.is_none(), "{name}: pixel {fault:?} is far and at no cliff, of {}", far.len());
    let share = far.len() as f64 / dense.len() as f64;
    assert!(share <= Tolerance::GPU.flips, "{name}: {} pixels flipped", far.len());
    let (px, seen) = (dense.len(), got.weights.entries.len());
    println!("{name}: {px} px, {seen} weights: max {worst:.2e}, {} flips", far.len());
    got
}

#[test]
fn labels_of_the_gpu_equal_its_literal_road() {
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
            judge(gpu, &format!("M = {m}"), &gaussians, &request(camera(width, height)));
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
        let Some(gpu) = open(|options| options.serial = Some(serial)) else { return };
        let many = stack(100);
        let drawn = judge(&gpu, "100 weights a pixel", &many, &request(camera(48, 32)));
        assert_eq!(drawn.weights.entries.len(), 100 * 48 * 32, "every pixel sees every index");
        // Room once made changes nothing for a view that needs less, and is found again.
        let few = labelled(800, 5, 81);
        judge(&gpu, "after it few", &few, &request(camera(48, 32)));
        judge(&gpu, "and many again", &many, &request(camera(30, 20)));
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
    let Some(small) = open(|options| options.isects_max = total / 2) else { return };
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
        judge(&gpu, &format!("index of {m}"), &labelled, &request);
        assert_eq!(gpu.scenes_held(), 1, "the shape is held once");
    }
    assert_eq!(draw_labels(&gpu, &bare, &request, &table(4, 2)).weights, PixelWeights::none(2_000));
}
