//! `quality=fast`: what it may differ from `exact`, by docs/conventions.md.

use segsplat_core::scene::{Gaussians, RawGaussians};
use segsplat_render::{Frame, Labels, Quality, RenderRequest, Renderer, cpu::CpuRenderer};

use crate::common::{both_kernels, colours_apart, gpu};
use segsplat_testing::scenes::{Random, camera, checked, push, request, two_views};

/// Half a level of 8 bits, and what f32 adds.
const HALF_LEVEL: f32 = 0.5 / 255.0 + 1e-6;

/// Both qualities of one view.
fn both(renderer: &dyn Renderer, gaussians: &Gaussians, ask: &RenderRequest) -> [Frame; 2] {
    [Quality::Exact, Quality::Fast].map(|quality| {
        let ask = RenderRequest { quality, ..ask.clone() };
        renderer.render(gaussians, &ask).expect("a frame")
    })
}

/// Gaussians whose depths are far enough from each other for any order of them to be the same,
/// some brighter than white.
fn layered() -> Gaussians {
    let mut random = Random(5);
    let mut raw = RawGaussians::default();
    for i in 0..400 {
        let depth = 2.0 * 1.01_f32.powi(i);
        let place = [random.range(-0.5, 0.5) * depth, random.range(-0.5, 0.5) * depth, depth];
        let scale = [(); 3].map(|()| depth * random.range(0.01, 0.05));
        let sh = [(); 3].map(|()| random.range(-1.5, 3.0));
        push(&mut raw, place, random.quat(), scale, random.range(0.1, 0.99), &[sh]);
    }
    raw.semantic_index = (0..400).map(|i| i % 9).collect();
    checked(raw)
}

fn table() -> Vec<[f32; 4]> {
    (0..9).map(|m| [0.0, 1.0, -0.5, 0.3].map(|v| v * m as f32)).collect()
}

#[test]
fn where_no_order_is_in_doubt_fast_is_exact_to_half_a_level() {
    for gpu in both_kernels() {
        let gaussians = layered();
        let ask =
            RenderRequest { labels: Labels::Blend(table().into()), ..request(camera(70, 45)) };
        let [exact, fast] = both(gpu, &gaussians, &ask);
        assert_eq!(fast.depth, exact.depth, "depth is never rounded");
        assert_eq!(fast.blend, exact.blend, "nor are labels");
        assert_eq!(fast.stats, exact.stats);
        let (mut brighter, mut rounded) = (0, 0);
        for (i, want) in exact.color.iter().flatten().enumerate() {
            let got = fast.color.as_ref().expect("colour")[i];
            for (got, want) in got.into_iter().zip(*want) {
                brighter += usize::from(want > 1.0);
                rounded += usize::from(got != want);
                let apart = (got - want.clamp(0.0, 1.0)).abs();
                assert!(apart <= HALF_LEVEL, "pixel {i}: {got}, not {want}");
            }
        }
        assert!(brighter > 0 && rounded > 0, "{brighter} values over white, {rounded} rounded");
        let alphas = fast.alpha.iter().flatten().zip(exact.alpha.iter().flatten());
        for (i, (got, want)) in alphas.enumerate() {
            assert!((got - want).abs() <= HALF_LEVEL, "alpha of pixel {i}: {got}, not {want}");
        }
        assert_eq!(fast.alpha.as_ref().map(Vec::len), Some(70 * 45));
    }
}

#[test]
fn alpha_alone_and_depth_alone_are_not_rounded() {
    let Some(gpu) = gpu() else { return };
    let gaussians = layered();
    let mut ask = request(camera(33, 20));
    ask.kinds.color = false;
    let [exact, fast] = both(gpu, &gaussians, &ask);
    assert_eq!((fast.alpha, fast.depth), (exact.alpha, exact.depth));
}

#[test]
fn of_dense_scenes_fast_keeps_its_bound() {
    let Some(gpu) = gpu() else { return };
    for side in [48, 100] {
        let (name, (gaussians, camera)) = (format!("{side} x {side}"), two_views(side, 3));
        let [exact, fast] = both(gpu, &gaussians, &request(camera));
        let exact = exact.color.expect("colour");
        let (psnr, share) = colours_apart(&fast.color.expect("colour"), &exact);
        println!("{name}: {psnr:.1} dB, {:.3} % over two levels", 100.0 * share);
        assert!(psnr >= 50.0, "{name}: {psnr:.1} dB");
        assert!(share <= 0.01, "{name}: {share} of the pixels over two levels");
    }
}

#[test]
fn on_the_cpu_fast_is_exact() {
    let cpu = CpuRenderer::new(1).expect("a thread");
    let (gaussians, camera) = two_views(24, 9);
    let [exact, fast] = both(&cpu, &gaussians, &request(camera));
    assert_eq!(fast, exact);
}
