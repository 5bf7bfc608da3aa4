//! The CPU renderer at every width of its kernels: the wide forms agree to the last bit, the
//! portable one, which fuses no products, to rounding.

use segsplat_core::scene::Gaussians;
use segsplat_render::{
    Frame, Labels, PixelWeights, RenderRequest, Renderer, Switches, cpu::CpuRenderer, oracle,
    switches::Width,
};

use segsplat_testing::labels::{labelled, table};
use segsplat_testing::{
    compare::{Tolerance, compare, samples},
    scenes::{camera, cloud, request, two_views},
    skipped,
};

/// How far apart colour, alpha, relative depth and labels may be, but at a cliff.
const BOUND: f64 = 1e-5;

fn draw(width: Width, threads: usize, gaussians: &Gaussians, request: &RenderRequest) -> Frame {
    let switches = Switches { width: Some(width), ..Switches::default() };
    let cpu = CpuRenderer::with_switches(threads, &switches).expect("threads");
    cpu.render(gaussians, request).expect("a picture")
}

/// Scenes and requests that reach every branch of the kernels: parts of tiles at the edges, long
/// thin Gaussians, harmonics, the antialiased mode, blended labels and weights.
fn cases() -> Vec<(&'static str, Gaussians, RenderRequest)> {
    let (pair, middle) = two_views(96, 3);
    let rgb = request(camera(161, 119));
    let smooth = RenderRequest { antialiased: true, ..rgb.clone() };
    let blended = RenderRequest { labels: Labels::Blend(table(25, 8)), ..rgb.clone() };
    let entered = RenderRequest { labels: Labels::Weights, ..rgb.clone() };
    vec![
        ("a Gaussian a pixel", pair, request(middle)),
        ("harmonics", cloud(4_000, 3, 5), rgb),
        ("antialiased", cloud(4_000, 0, 6), smooth),
        ("blended labels", labelled(4_000, 24, 7), blended),
        ("weights", labelled(4_000, 24, 8), entered),
    ]
}

/// Largest difference of a pixel's weights; an entry that one side lacks counts as 0 there.
fn weights_apart(a: &PixelWeights, b: &PixelWeights, pixel: usize) -> f32 {
    let of = |weights: &PixelWeights, index| {
        weights.pixel(pixel).find(|entry| entry.0 == index).map_or(0.0, |entry| entry.1)
    };
    let all = a.pixel(pixel).chain(b.pixel(pixel));
    all.map(|(index, _)| (of(a, index) - of(b, index)).abs()).fold(0.0, f32::max)
}

#[test]
fn the_wide_forms_agree_to_the_last_bit_and_for_any_number_of_threads() {
    if !Width::Eight.available() {
        return skipped("no AVX2");
    }
    for (name, gaussians, request) in cases() {
        let want = draw(Width::Eight, 1, &gaussians, &request);
        assert!(want.stats.visible > 1_000, "{name}: {:?}", want.stats);
        for (width, threads) in [(Width::Eight, 3), (Width::Sixteen, 1), (Width::Sixteen, 2)] {
            let got = draw(width, threads, &gaussians, &request);
            assert!(got == want, "{name}: {width:?} on {threads} threads");
        }
    }
}

#[test]
fn the_portable_form_agrees_with_the_widest_to_rounding() {
    for (name, gaussians, request) in cases() {
        let want = draw(Width::widest(), 2, &gaussians, &request);
        let got = draw(Width::Four, 2, &gaussians, &request);
        let again = draw(Width::Four, 1, &gaussians, &request);
        assert!(got == again, "{name}: two threads and one");
        let truth = oracle::render(&gaussians, &request).expect("the truth");
        let cliff: Vec<bool> = truth.iter().map(|p| p.cliff.same_order()).collect();
        let tolerance = Tolerance { interior: BOUND, flips: 1e-3, mean: BOUND };
        let found = compare(&samples(&got), &samples(&want), &cliff, tolerance)
            .unwrap_or_else(|told| panic!("{name}: {told}"));
        println!("{name}: max {:.2e}, mean {:.2e}, {} flips", found.max, found.mean, found.flips);
        let calm = (0..cliff.len()).filter(|&pixel| !cliff[pixel]);
        let (mut blends, mut weights) = (0.0_f32, 0.0_f32);
        for pixel in calm {
            if let (Some(got), Some(want)) = (&got.blend, &want.blend) {
                let pairs = got[pixel].iter().zip(&want[pixel]);
                blends = pairs.map(|(a, b)| (a - b).abs()).fold(blends, f32::max);
            }
            if let (Some(got), Some(want)) = (&got.weights, &want.weights) {
                weights = weights.max(weights_apart(got, want, pixel));
            }
        }
        assert!(f64::from(blends) < BOUND, "{name}: blended labels apart by {blends:.2e}");
        assert!(f64::from(weights) < BOUND, "{name}: weights apart by {weights:.2e}");
    }
}
