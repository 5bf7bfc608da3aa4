//! Labels against the plain definition: one-hot vectors of M channels, blended as colours are,
//! three at a time, by the same renderer. The blend and the pixel weights must equal it, for any M.

use std::sync::Arc;

use segsplat_core::{
    error::ErrorCode,
    scene::{Gaussians, RawGaussians},
};
use segsplat_render::{
    Frame, Kinds, Labels, PixelWeights, RenderRequest, Renderer, Switches, cpu::CpuRenderer, oracle,
};

use segsplat_testing::labels::{
    alone, apart, blend_apart, draw_labels, labelled, literal, literal_of, table,
};
use segsplat_testing::{
    compare::Tolerance,
    scenes::{camera, checked, cloud, request},
};

fn cpu() -> CpuRenderer {
    CpuRenderer::new(2).expect("two threads")
}

#[test]
fn labels_equal_the_plain_definition_for_any_bank() {
    let sizes = [(1, 33, 17), (2, 16, 16), (3, 1, 1), (7, 50, 31), (24, 64, 48), (64, 40, 40)];
    for (m, width, height) in sizes.into_iter().chain([(512, 32, 24), (4_096, 16, 12)]) {
        let gaussians = labelled(1_500, m, 100 + u64::from(m));
        let request = request(camera(width, height));
        let table = table(usize::from(m) + 1, 7);
        let drawn = draw_labels(&cpu(), &gaussians, &request, &table);
        let dense = literal_of(&cpu(), &gaussians, &request, m);
        let (far, worst) = apart(&drawn, &dense, &table, 1e-5);
        assert!(far.is_empty(), "M = {m}: {} pixels differ, first {:?}", far.len(), far.first());
        let seen = drawn.weights.entries.len();
        println!("M = {m}, {width}x{height}: {seen} weights, max {worst:.2e}");
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
        let listed = oracle::render(&gaussians, &alone(&request, Labels::Weights)).expect("truth");
        let blend = Labels::Blend(Arc::clone(&table));
        let blended = oracle::render(&gaussians, &alone(&request, blend)).expect("truth");
        let dense: Vec<Vec<f64>> = listed
            .iter()
            .map(|p| (1..=m).map(|k| p.weights.get(&k).copied().unwrap_or(0.0)).collect())
            .collect();
        let (far, worst) = apart(&drawn, &dense, &table, Tolerance::ORACLE.interior);
        assert!(far.iter().all(|&i| listed[i].cliff.same_order()), "M = {m}: off a cliff");
        let share = far.len() as f64 / dense.len() as f64;
        assert!(share <= Tolerance::ORACLE.flips, "M = {m}: {} pixels flipped", far.len());
        println!("M = {m}: max {worst:.2e}, {} flips", far.len());
        // The two ways of the oracle.
        for (i, (pixel, dense)) in blended.iter().zip(&dense).enumerate() {
            assert!(!listed[i].weights.contains_key(&0), "index 0 is no entry");
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
    let listed = oracle::render(&gaussians, &alone(&request, Labels::Weights)).expect("truth");
    for (i, (pixel, dense)) in listed.iter().zip(&dense).enumerate() {
        for (k, want) in (1_u16..).zip(dense) {
            let got = pixel.weights.get(&k).copied().unwrap_or(0.0);
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
    for labels in [Labels::Blend(Arc::clone(&table)), Labels::Weights] {
        for (color, depth, alpha) in
            [(true, true, true), (true, false, false), (false, true, false), (false, false, true)]
        {
            let kinds = Kinds { color, depth, alpha };
            let request = RenderRequest { kinds, labels: labels.clone(), ..plain.clone() };
            let Frame { color: c, depth: d, alpha: a, blend, weights, stats, .. } =
                cpu().render(&gaussians, &request).expect("pictures and labels");
            assert_eq!(c, want.color.clone().filter(|_| color), "{kinds:?} colour");
            assert_eq!(d, want.depth.clone().filter(|_| depth), "{kinds:?} depth");
            assert_eq!(a, want.alpha.clone().filter(|_| alpha), "{kinds:?} alpha");
            assert_eq!(stats, want.stats, "{kinds:?} counts");
            match labels {
                Labels::Weights => assert_eq!(weights.as_ref(), Some(&drawn.weights), "{kinds:?}"),
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
        assert_eq!(got.weights, want.weights, "{threads} threads");
        assert_eq!(got.blend, want.blend, "{threads} threads");
    }
    let total = cpu().render(&gaussians, &request).expect("a picture").stats.intersections;
    let switches = Switches { isects_max: Some(total as u32 / 2), ..Switches::default() };
    let banded = CpuRenderer::with_switches(2, &switches).expect("threads");
    let got = draw_labels(&banded, &gaussians, &request, &table);
    assert_eq!((got.weights, got.blend), (want.weights, want.blend), "in bands");
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
    assert_eq!(draw_labels(&cpu(), &bare, &request, &short).weights, PixelWeights::none(1_000));
    let none = checked(RawGaussians::default());
    let drawn = draw_labels(&cpu(), &none, &request, &short);
    assert_eq!(drawn.weights, PixelWeights::none(1_000), "no Gaussians");
    assert_eq!(drawn.blend, [[0.0; 4]; 1_000], "no Gaussians");

    let error = gaussians.with_semantic_index(vec![1; 599]).expect_err("one too few");
    assert!(error.message().contains("599 rows, not 600"), "{error}");
}

#[test]
fn weights_are_the_share_of_the_pixel_that_an_index_covers() {
    let gaussians = labelled(3_000, 12, 61);
    let plain = request(camera(80, 60));
    let request = RenderRequest { labels: Labels::Weights, ..plain };
    let frame = cpu().render(&gaussians, &request).expect("a picture");
    let (weights, alpha) = (frame.weights.expect("weights"), frame.alpha.expect("alpha"));
    for (i, alpha) in alpha.iter().enumerate() {
        let covered = weights.coverage(i);
        assert!(covered <= alpha + 1e-4, "pixel {i}: {covered} of {alpha}");
    }
    let all: f32 = (0..weights.pixels()).map(|i| weights.coverage(i)).sum();
    let most: f32 = alpha.iter().sum();
    // One Gaussian of thirteen has index 0.
    assert!(all > 0.8 * most && all < 0.99 * most, "{all} of {most} is labelled");
}

#[test]
fn a_table_must_be_finite_and_an_entry_beyond_it_is_0() {
    let table = [[9.0; 4], [1.0; 4], [2.0; 4]];
    assert_eq!(Labels::row(&table, 2), [2.0; 4], "the last row");
    assert_eq!(Labels::row(&table, 3), [9.0; 4], "beyond the table");
    assert_eq!(Labels::row(&[], 3), [0.0; 4], "no table");
    Labels::Blend(table.into()).check().expect("finite numbers");
    let mut bad = table;
    bad[1][2] = f32::NAN;
    let error = Labels::Blend(bad.into()).check().expect_err("a NaN");
    assert_eq!(error.code(), ErrorCode::InvalidRequest, "{error}");
    assert!(error.message().starts_with("labels: row 1"), "{error}");
}
