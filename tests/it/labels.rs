//! Labels against the literal road: one-hot vectors of M channels blended as colours are, three at
//! a time, by the same renderer. Blend and Entries must say what it says, for any M.

use std::sync::Arc;

use segsplat::{
    render::{Entries, Frame, Kinds, Labels, RenderRequest, Renderer, cpu::CpuRenderer, oracle},
    scene::{Gaussians, RawGaussians},
};

use crate::common::{
    compare::Tolerance,
    scenes::{Random, camera, checked, cloud, request},
};

/// Degree-0 harmonic of 3DGS: colour = 0.5 + this times the coefficient.
const SH_C0: f32 = 0.282_094_79;

fn cpu() -> CpuRenderer {
    CpuRenderer::new(2).expect("two threads")
}

/// `count` Gaussians with indices 0..=m, at random.
pub(crate) fn labelled(count: usize, m: u16, seed: u64) -> Gaussians {
    let mut random = Random(seed);
    let index = (0..count).map(|_| (random.bits() % (u64::from(m) + 1)) as u16).collect();
    cloud(count, 0, seed).with_semantic_index(index).expect("an index a Gaussian")
}

/// A table of `rows` rows of small numbers, row 0 zeros.
pub(crate) fn table(rows: usize, seed: u64) -> Arc<[[f32; 4]]> {
    let mut random = Random(seed);
    let row = |m| [(); 4].map(|()| if m == 0 { 0.0 } else { random.range(-1.0, 1.0) });
    (0..rows).map(row).collect()
}

/// `request` for labels alone.
pub(crate) fn alone(request: &RenderRequest, labels: Labels) -> RenderRequest {
    RenderRequest { kinds: Kinds::NONE, labels, ..request.clone() }
}

/// The same Gaussians in one-hot colours: channel c shows index `first + c` and no other.
fn one_hot(gaussians: &Gaussians, first: u16) -> Gaussians {
    let index = gaussians.semantic_index();
    let color = |m: u16| [0, 1, 2].map(|c| if m == first + c { 1.0 } else { 0.0 });
    let sh = index.iter().map(|&m| color(m).map(|v: f32| (v - 0.5) / SH_C0)).collect();
    checked(RawGaussians { sh, sh_degree: 0, ..gaussians.as_raw().clone() })
}

/// Dense E of indices 1..=m, `[H * W][m]`, by the road of colours.
fn literal(
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
        background: [0.0; 3],
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

/// Largest difference of sparse and dense E at pixel `i`; an index 0 or out of order is a fault.
fn entries_apart(entries: &Entries, i: usize, dense: &[f64]) -> f64 {
    let mut rest = dense.to_vec();
    let mut last = 0;
    for (index, weight) in entries.pixel(i) {
        assert!(index > last, "pixel {i}: index {index} after {last}");
        assert!(weight > 0.0, "pixel {i}: weight {weight} of index {index}");
        last = index;
        rest[usize::from(index) - 1] -= f64::from(weight);
    }
    rest.iter().fold(0.0, |worst, apart| worst.max(apart.abs()))
}

/// Largest difference of a blended pixel and E times the table.
fn blend_apart(blend: [f32; 4], dense: &[f64], table: &[[f32; 4]]) -> f64 {
    let mut want = [0.0; 4];
    for (m, weight) in (1..).zip(dense) {
        for (sum, value) in want.iter_mut().zip(Labels::row(table, m)) {
            *sum += weight * f64::from(value);
        }
    }
    want.iter().zip(blend).fold(0.0, |worst, (a, b)| worst.max((a - f64::from(b)).abs()))
}

/// Entries and blend of one view.
pub(crate) struct Drawn {
    pub(crate) entries: Entries,
    pub(crate) blend: Vec<[f32; 4]>,
}

pub(crate) fn draw_labels(
    renderer: &dyn Renderer,
    gaussians: &Gaussians,
    request: &RenderRequest,
    table: &Arc<[[f32; 4]]>,
) -> Drawn {
    let draw = |labels| renderer.render(gaussians, &alone(request, labels)).expect("labels");
    let blended = draw(Labels::Blend(Arc::clone(table)));
    let listed = draw(Labels::Entries);
    for frame in [&blended, &listed] {
        assert!(frame.color.is_none() && frame.depth.is_none() && frame.alpha.is_none());
    }
    assert!(blended.entries.is_none() && listed.blend.is_none(), "labels not asked for");
    Drawn {
        entries: listed.entries.expect("entries were asked for"),
        blend: blended.blend.expect("a blend was asked for"),
    }
}

/// Pixels where `drawn` is further than `bound` from dense E, and the largest difference of the
/// others.
pub(crate) fn apart(
    drawn: &Drawn,
    dense: &[Vec<f64>],
    table: &[[f32; 4]],
    bound: f64,
) -> (Vec<usize>, f64) {
    assert_eq!((drawn.entries.pixels(), drawn.blend.len()), (dense.len(), dense.len()), "pixels");
    let mut worst = 0.0_f64;
    let mut far = Vec::new();
    for (i, dense) in dense.iter().enumerate() {
        let entries = entries_apart(&drawn.entries, i, dense);
        let apart = entries.max(blend_apart(drawn.blend[i], dense, table));
        if apart <= bound {
            worst = worst.max(apart);
        } else {
            far.push(i);
        }
    }
    (far, worst)
}

/// Dense E of the renderer itself, by the road of colours.
pub(crate) fn literal_of(
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

#[test]
fn labels_equal_the_literal_road_for_any_bank() {
    let sizes = [(1, 33, 17), (2, 16, 16), (3, 1, 1), (7, 50, 31), (24, 64, 48), (64, 40, 40)];
    for (m, width, height) in sizes.into_iter().chain([(512, 32, 24), (4_096, 16, 12)]) {
        let gaussians = labelled(1_500, m, 100 + u64::from(m));
        let request = request(camera(width, height));
        let table = table(usize::from(m) + 1, 7);
        let drawn = draw_labels(&cpu(), &gaussians, &request, &table);
        let dense = literal_of(&cpu(), &gaussians, &request, m);
        let (far, worst) = apart(&drawn, &dense, &table, 1e-5);
        assert!(far.is_empty(), "M = {m}: {} pixels differ, first {:?}", far.len(), far.first());
        let seen = drawn.entries.index.len();
        println!("M = {m}, {width}x{height}: {seen} entries, max {worst:.2e}");
        assert!(seen > 0, "M = {m}: nothing is seen");
    }
}

#[test]
fn the_oracle_and_the_cpu_agree_on_labels_outside_cliffs() {
    for (m, seed) in [(1, 3), (24, 4), (512, 5)] {
        let gaussians = labelled(3_000, m, seed);
        let request = request(camera(96, 64));
        let table = table(usize::from(m) + 1, 9);
        let drawn = draw_labels(&cpu(), &gaussians, &request, &table);
        let listed = oracle::render(&gaussians, &alone(&request, Labels::Entries)).expect("truth");
        let blend = Labels::Blend(Arc::clone(&table));
        let blended = oracle::render(&gaussians, &alone(&request, blend)).expect("truth");
        let dense: Vec<Vec<f64>> = listed
            .iter()
            .map(|p| (1..=m).map(|k| p.entries.get(&k).copied().unwrap_or(0.0)).collect())
            .collect();
        let (far, worst) = apart(&drawn, &dense, &table, Tolerance::ORACLE.interior);
        assert!(far.iter().all(|&i| listed[i].cliff.same_order()), "M = {m}: off a cliff");
        let share = far.len() as f64 / dense.len() as f64;
        assert!(share <= Tolerance::ORACLE.flips, "M = {m}: {} pixels flipped", far.len());
        println!("M = {m}: max {worst:.2e}, {} flips", far.len());
        // The oracle's own two roads.
        for (i, (pixel, dense)) in blended.iter().zip(&dense).enumerate() {
            assert!(!listed[i].entries.contains_key(&0), "index 0 is no entry");
            let own = pixel.blend.map(|v| v as f32);
            assert!(blend_apart(own, dense, &table) < 1e-6, "M = {m}: pixel {i} of the oracle");
        }
    }
}

#[test]
fn the_oracles_entries_are_its_one_hot_colours() {
    let gaussians = labelled(800, 5, 21);
    let request = request(camera(40, 30));
    let dense = literal(&gaussians, &request, 5, |gaussians, request| {
        oracle::render(gaussians, request).expect("truth").iter().map(|p| p.color).collect()
    });
    let listed = oracle::render(&gaussians, &alone(&request, Labels::Entries)).expect("truth");
    for (i, (pixel, dense)) in listed.iter().zip(&dense).enumerate() {
        for (k, want) in (1_u16..).zip(dense) {
            let got = pixel.entries.get(&k).copied().unwrap_or(0.0);
            assert!((got - want).abs() < 1e-6, "pixel {i}, index {k}: {got}, not {want}");
        }
    }
}

#[test]
fn labels_cost_no_other_picture_a_bit() {
    let gaussians = labelled(2_000, 9, 31);
    let plain = request(camera(70, 45));
    let table = table(10, 3);
    let want = cpu().render(&gaussians, &plain).expect("pictures");
    let drawn = draw_labels(&cpu(), &gaussians, &plain, &table);
    for labels in [Labels::Blend(Arc::clone(&table)), Labels::Entries] {
        for (color, depth, alpha) in
            [(true, true, true), (true, false, false), (false, true, false), (false, false, true)]
        {
            let kinds = Kinds { color, depth, alpha };
            let request = RenderRequest { kinds, labels: labels.clone(), ..plain.clone() };
            let Frame { color: c, depth: d, alpha: a, blend, entries, stats, .. } =
                cpu().render(&gaussians, &request).expect("pictures and labels");
            assert_eq!(c, want.color.clone().filter(|_| color), "{kinds:?} colour");
            assert_eq!(d, want.depth.clone().filter(|_| depth), "{kinds:?} depth");
            assert_eq!(a, want.alpha.clone().filter(|_| alpha), "{kinds:?} alpha");
            assert_eq!(stats, want.stats, "{kinds:?} counts");
            match labels {
                Labels::Entries => assert_eq!(entries.as_ref(), Some(&drawn.entries), "{kinds:?}"),
                _ => assert_eq!(blend.as_ref(), Some(&drawn.blend), "{kinds:?}"),
            }
        }
    }
}

#[test]
fn threads_and_bands_change_no_label() {
    let gaussians = labelled(2_000, 40, 41);
    let request = request(camera(130, 90));
    let table = table(41, 5);
    let want = draw_labels(&cpu(), &gaussians, &request, &table);
    for threads in [1, 3, 8] {
        let other = CpuRenderer::new(threads).expect("threads");
        let got = draw_labels(&other, &gaussians, &request, &table);
        assert_eq!(got.entries, want.entries, "{threads} threads");
        assert_eq!(got.blend, want.blend, "{threads} threads");
    }
    let total = cpu().render(&gaussians, &request).expect("a picture").stats.intersections;
    let banded = CpuRenderer::new(2).expect("threads").with_isects_max(total / 2);
    let got = draw_labels(&banded, &gaussians, &request, &table);
    assert_eq!((got.entries, got.blend), (want.entries, want.blend), "in bands");
}

#[test]
fn an_index_beyond_the_table_counts_as_0_and_no_labels_is_a_legal_scene() {
    let gaussians = labelled(600, 8, 51);
    let request = request(camera(40, 25));
    let short: Arc<[[f32; 4]]> = table(4, 6);
    let clipped = gaussians
        .semantic_index()
        .iter()
        .map(|&m| if usize::from(m) < short.len() { m } else { 0 })
        .collect();
    let clipped = gaussians.with_semantic_index(clipped).expect("an index a Gaussian");
    let blend = |gaussians: &Gaussians, table: &Arc<[[f32; 4]]>| {
        draw_labels(&cpu(), gaussians, &request, table).blend
    };
    assert_eq!(blend(&gaussians, &short), blend(&clipped, &short), "beyond the table");
    assert!(blend(&gaussians, &short).iter().flatten().any(|&v| v != 0.0), "something is seen");
    let empty: Arc<[[f32; 4]]> = [].into();
    assert!(blend(&gaussians, &empty).iter().flatten().all(|&v| v == 0.0), "no table");

    let bare = cloud(600, 0, 51);
    assert_eq!(draw_labels(&cpu(), &bare, &request, &short).entries, Entries::none(1_000));
    let none = checked(RawGaussians::default());
    let drawn = draw_labels(&cpu(), &none, &request, &short);
    assert_eq!(drawn.entries, Entries::none(1_000), "no Gaussians");
    assert_eq!(drawn.blend, [[0.0; 4]; 1_000], "no Gaussians");

    let error = gaussians.with_semantic_index(vec![1; 599]).expect_err("one too few");
    assert!(error.message().contains("599 rows, not 600"), "{error}");
}

#[test]
fn weights_are_the_share_of_the_pixel_that_an_index_covers() {
    let gaussians = labelled(3_000, 12, 61);
    let plain = request(camera(80, 60));
    let request = RenderRequest { labels: Labels::Entries, ..plain };
    let frame = cpu().render(&gaussians, &request).expect("a picture");
    let (entries, alpha) = (frame.entries.expect("entries"), frame.alpha.expect("alpha"));
    for (i, alpha) in alpha.iter().enumerate() {
        let covered = entries.coverage(i);
        assert!(covered <= alpha + 1e-4, "pixel {i}: {covered} of {alpha}");
    }
    let all: f32 = (0..entries.pixels()).map(|i| entries.coverage(i)).sum();
    let most: f32 = alpha.iter().sum();
    // One Gaussian of thirteen has index 0.
    assert!(all > 0.8 * most && all < 0.99 * most, "{all} of {most} is labelled");
}
