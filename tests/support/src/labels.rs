//! Labels by the plain definition: entries become one-hot colours, and the renderer blends them as
//! colours, three entries at a time.

use std::sync::Arc;

use segsplat_core::scene::{Gaussians, RawGaussians};
use segsplat_render::{Background, Kinds, Labels, PixelWeights, RenderRequest, Renderer};

use crate::scenes::{Random, checked, cloud};

/// Degree-0 harmonic of 3DGS: colour = 0.5 + this times the coefficient.
const SH_C0: f32 = 0.282_094_79;

/// `count` Gaussians with entries 0..=m, at random.
pub fn labelled(count: usize, m: u16, seed: u64) -> Gaussians {
    let mut random = Random(seed);
    let index = (0..count).map(|_| (random.bits() % (u64::from(m) + 1)) as u16).collect();
    cloud(count, 0, seed).with_semantic_index(index).expect("an index a Gaussian")
}

/// A table of `rows` rows of small numbers, row 0 zeros.
pub fn table(rows: usize, seed: u64) -> Arc<[[f32; 4]]> {
    let mut random = Random(seed);
    let row = |m| [(); 4].map(|()| if m == 0 { 0.0 } else { random.range(-1.0, 1.0) });
    (0..rows).map(row).collect()
}

/// `request` for labels alone.
pub fn alone(request: &RenderRequest, labels: Labels) -> RenderRequest {
    RenderRequest { kinds: Kinds::NONE, labels, ..request.clone() }
}

/// The same Gaussians in one-hot colours: channel c shows entry `first + c` and no other.
fn one_hot(gaussians: &Gaussians, first: u16) -> Gaussians {
    let index = gaussians.semantic_index();
    let color = |m: u16| [0, 1, 2].map(|c| if m == first + c { 1.0 } else { 0.0 });
    let sh = index.iter().map(|&m| color(m).map(|v: f32| (v - 0.5) / SH_C0)).collect();
    checked(RawGaussians { sh, sh_degree: 0, ..gaussians.clone().into_raw() })
}

/// Dense E of entries 1..=m, `[H * W][m]`, from one-hot colours.
pub fn literal(
    gaussians: &Gaussians,
    request: &RenderRequest,
    m: u16,
    draw: impl Fn(&Gaussians, &RenderRequest) -> Vec<[f64; 3]>,
) -> Vec<Vec<f64>> {
    let pixels = request.camera.intrinsics.width * request.camera.intrinsics.height;
    let mut dense = vec![vec![0.0; usize::from(m)]; pixels as usize];
    let black = RenderRequest {
        kinds: Kinds::COLOR,
        labels: Labels::None,
        background: Background::BLACK,
        ..request.clone()
    };
    for first in (1..=m).step_by(3) {
        for (pixel, color) in dense.iter_mut().zip(draw(&one_hot(gaussians, first), &black)) {
            for (entry, value) in pixel[usize::from(first) - 1..].iter_mut().zip(color) {
                *entry = value;
            }
        }
    }
    dense
}

/// Largest difference of sparse and dense E at pixel `i`. Entries must be over 0 and in order.
fn weights_apart(weights: &PixelWeights, i: usize, dense: &[f64]) -> f64 {
    let mut rest = dense.to_vec();
    let mut last = 0;
    for (entry, weight) in weights.pixel(i) {
        assert!(entry > last, "pixel {i}: entry {entry} after {last}");
        assert!(weight > 0.0, "pixel {i}: weight {weight} of entry {entry}");
        last = entry;
        rest[usize::from(entry) - 1] -= f64::from(weight);
    }
    rest.iter().fold(0.0, |worst, apart| worst.max(apart.abs()))
}

/// Largest difference of a blended pixel and E times the table.
pub fn blend_apart(blend: [f32; 4], dense: &[f64], table: &[[f32; 4]]) -> f64 {
    let mut want = [0.0; 4];
    for (m, weight) in (1..).zip(dense) {
        for (sum, value) in want.iter_mut().zip(Labels::row(table, m)) {
            *sum += weight * f64::from(value);
        }
    }
    want.iter().zip(blend).fold(0.0, |worst, (a, b)| worst.max((a - f64::from(b)).abs()))
}

/// Pixel weights and blend of one view.
#[derive(Debug)]
pub struct Drawn {
    /// From [`Labels::Weights`].
    pub weights: PixelWeights,
    /// From [`Labels::Blend`].
    pub blend: Vec<[f32; 4]>,
}

/// Draws one view with weights, and again with `table` blended.
pub fn draw_labels(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    table: &Arc<[[f32; 4]]>,
) -> Drawn {
    let draw = |labels| renderer.render(gaussians, &alone(request, labels)).expect("labels");
    let blended = draw(Labels::Blend(Arc::clone(table)));
    let listed = draw(Labels::Weights);
    for frame in [&blended, &listed] {
        assert!(frame.color.is_none() && frame.depth.is_none() && frame.alpha.is_none());
    }
    assert!(blended.weights.is_none() && listed.blend.is_none(), "labels not asked for");
    Drawn {
        weights: listed.weights.expect("weights were asked for"),
        blend: blended.blend.expect("a blend was asked for"),
    }
}

/// Pixels where `drawn` is further than `bound` from dense E, and the largest difference of the
/// others.
pub fn apart(
    drawn: &Drawn,
    dense: &[Vec<f64>],
    table: &[[f32; 4]],
    bound: f64,
) -> (Vec<usize>, f64) {
    assert_eq!((drawn.weights.pixels(), drawn.blend.len()), (dense.len(), dense.len()), "pixels");
    let mut worst = 0.0_f64;
    let mut far = Vec::new();
    for (i, dense) in dense.iter().enumerate() {
        let weights = weights_apart(&drawn.weights, i, dense);
        let apart = weights.max(blend_apart(drawn.blend[i], dense, table));
        if apart <= bound {
            worst = worst.max(apart);
        } else {
            far.push(i);
        }
    }
    (far, worst)
}

/// Dense E of the renderer itself, from one-hot colours.
pub fn literal_of(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    m: u16,
) -> Vec<Vec<f64>> {
    literal(gaussians, request, m, |gaussians, request| {
        let frame = renderer.render(gaussians, request).expect("one-hot colours");
        frame.color.expect("colour").into_iter().map(|c| c.map(f64::from)).collect()
    })
}

/// `[P]` the mask of a text from the blended pictures of its tables, coverage and three scores
/// each. A pixel is in it where the coverage reaches the floor, no score is under 0 and not all
/// are 0.
pub fn mask_of_blends(pictures: &[&[[f32; 4]]], coverage_floor: f64) -> Vec<bool> {
    let inside = |p: usize| {
        let rows = || pictures.iter().map(|picture| picture[p]);
        let scores = || rows().flat_map(|[_, scores @ ..]| scores);
        rows().all(|[coverage, ..]| f64::from(coverage) >= coverage_floor)
            && scores().all(|score| score >= 0.0)
            && scores().any(|score| score > 0.0)
    };
    (0..pictures.first().map_or(0, |picture| picture.len())).map(inside).collect()
}
