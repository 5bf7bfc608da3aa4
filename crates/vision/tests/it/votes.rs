//! Photos vote for the entry of each Gaussian that they show.

use std::sync::atomic::AtomicBool;

use segsplat_core::scene::{
    Bank, Camera, CameraToWorld, Gaussians, IndexMap, Intrinsics, RawGaussians, SceneCamera,
    SourcePixel,
};
use segsplat_render::{Kinds, RenderRequest, cpu::CpuRenderer, oracle::contributions};
use segsplat_vision::{
    pipeline::{semantics::SemanticsInput, words},
    semantics::{Views, from_source, merge},
};

const SIDE: u16 = 20;

/// Cameras one unit apart that look along z at a wall 10 units away; a photo is twice as large
/// as the network's picture of it.
pub(crate) fn cameras(count: usize) -> Vec<SceneCamera> {
    let lens = |scale: f64, side: u32| Intrinsics {
        fx: 20.0 * scale,
        fy: 20.0 * scale,
        cx: 10.0 * scale,
        cy: 10.0 * scale,
        width: side,
        height: side,
    };
    let one = |v: usize| {
        let pose = [1., 0., 0., v as f64, 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
        let camera_to_world = CameraToWorld::from_row_major(&pose, "test").unwrap();
        SceneCamera {
            file: String::new(),
            camera: Camera { intrinsics: lens(2.0, 40), camera_to_world },
            network: Some(lens(1.0, 20)),
        }
    };
    (0..count).map(one).collect()
}

/// A Gaussian for every pixel of every photo; `depth` says how far.
pub(crate) fn wall(count: u16, depth: impl Fn(SourcePixel) -> f64) -> Gaussians {
    let mut raw = RawGaussians::default();
    for view in 0..count {
        for (x, y) in (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y))) {
            let source = SourcePixel { view, x, y };
            let z = depth(source);
            let at = |v: u16| (f64::from(v) + 0.5 - 10.0) / 20.0 * z;
            let mean = [at(x) + f64::from(view), at(y), z];
            raw.means.push(mean.map(|v| v as f32));
            raw.source.push(source);
        }
    }
    let n = raw.means.len();
    raw.quats = vec![[1.0, 0.0, 0.0, 0.0]; n];
    raw.scales = vec![[0.1; 3]; n];
    raw.opacities = vec![0.9; n];
    raw.sh = vec![[0.0; 3]; n];
    raw.semantic_index = vec![0; n];
    Gaussians::sanitize(raw).unwrap().0
}

/// A map whose columns from `from` on (of 20) have index `m`.
fn map(from: u32, m: u16) -> IndexMap {
    let index = (0..20 * 20).map(|i| if i % 20 >= from { m } else { 0 }).collect();
    IndexMap { width: 20, height: 20, index }
}

fn own(gaussians: &Gaussians, maps: &[IndexMap]) -> Vec<u16> {
    from_source(gaussians.source(), &cameras(maps.len()), maps)
}

#[test]
fn photos_that_agree_overrule_the_one_that_made_it_and_fill_its_gaps() {
    let gaussians = wall(3, |_| 10.0);
    // The wall's place X is column 10 + 2 (X - v) of photo v. Thing 5 begins at X = 1.
    let mut maps = vec![map(12, 5), map(10, 5), map(8, 5)];
    // Photo 0 calls rows 0 to 4 of it another thing, and misses rows 5 to 9.
    for i in 0..200 {
        if maps[0].index[i] == 5 {
            maps[0].index[i] = if i < 100 { 6 } else { 0 };
        }
    }
    let own = own(&gaussians, &maps);
    let voted = Views::new(&gaussians, &cameras(3)).vote(&own, &maps);
    let at = |x: usize, y: usize| (own[y * 20 + x], voted[y * 20 + x]);
    assert_eq!(at(15, 2), (6, 5), "two of three photos say 5");
    assert_eq!(at(15, 7), (0, 5), "a gap");
    assert_eq!(at(15, 15), (5, 5));
    assert_eq!(at(5, 2), (0, 0), "nobody says anything");
}

#[test]
fn a_photo_that_sees_something_else_there_has_no_vote() {
    // Photo 1 shows a screen at half the distance in front of the wall.
    let gaussians = wall(2, |s| if s.view == 1 { 5.0 } else { 10.0 });
    let maps = vec![map(20, 1), map(0, 7)];
    let own = own(&gaussians, &maps);
    let voted = Views::new(&gaussians, &cameras(2)).vote(&own, &maps);
    assert!(voted[..400].iter().all(|m| *m == 0), "the wall is hidden from photo 1");
    assert!(voted[400..].iter().all(|m| *m == 7), "the screen keeps its own");
}

fn words_of(
    gaussians: &Gaussians,
    cameras: &[SceneCamera],
    maps: &[Vec<IndexMap>],
) -> Vec<Vec<u16>> {
    let input = SemanticsInput { photos: &[], cameras, gaussians };
    let renderer = CpuRenderer::new(1).unwrap();
    words::lift(&renderer, &input, 10.0, maps, &AtomicBool::new(false)).unwrap()
}

fn word(gaussians: &Gaussians, cameras: &[SceneCamera], maps: &[IndexMap]) -> Vec<u16> {
    words_of(gaussians, cameras, &[maps.to_vec()]).remove(0)
}

#[test]
fn words_of_one_call_are_those_of_a_call_each() {
    let gaussians = wall(2, |_| 10.0);
    let maps: Vec<Vec<IndexMap>> = (0..6_u16)
        .map(|t| vec![map(u32::from(2 * t), 300 + 100 * t), map(u32::from(18 - 3 * t), 950)])
        .collect();
    let together = words_of(&gaussians, &cameras(2), &maps);
    let alone = maps.iter().map(|of| word(&gaussians, &cameras(2), of));
    assert_eq!(together, alone.collect::<Vec<_>>());
    assert!((1..6).all(|t| together[t] != together[t - 1]));
    assert!(words_of(&gaussians, &cameras(2), &[]).is_empty());
}

#[test]
fn a_word_is_where_half_of_the_weights_of_a_gaussian_have_it() {
    let gaussians = wall(3, |_| 10.0);
    // As above; photo 1 has the word in the upper half alone, photo 2 nowhere.
    let mut maps = vec![map(12, 900), map(10, 700), map(20, 0)];
    maps[1].index[200..].fill(0);
    let scores = word(&gaussians, &cameras(3), &maps);
    let at = |x: usize, y: usize| scores[y * 20 + x];
    assert_eq!(at(15, 5), 800, "two of three have it: their mean");
    assert_eq!(at(15, 15), 0, "one of three");
    assert_eq!(at(5, 5), 0, "none");
    // Column 1 of photo 0 is beyond the others: it alone shows it.
    let alone = vec![map(0, 600), map(20, 0), map(20, 0)];
    let scores = word(&gaussians, &cameras(3), &alone);
    assert_eq!((scores[5 * 20 + 1], scores[5 * 20 + 15]), (600, 0));
}

#[test]
fn a_gaussian_that_no_photo_shows_has_what_its_own_photo_has_at_its_pixel() {
    // Photo 1's Gaussians are one behind the other one's, whose wall nothing is seen through.
    let mut raw = wall(2, |of| if of.view == 0 { 10.0 } else { 30.0 }).into_raw();
    raw.scales[..400].fill([2.0; 3]);
    raw.opacities[..400].fill(1.0);
    let gaussians = Gaussians::sanitize(raw).unwrap().0;
    let scores = word(&gaussians, &cameras(2), &[map(20, 0), map(0, 500)]);
    assert_eq!(scores[400 + 5 * 20 + 10], 500, "hidden");
    assert_eq!(word(&gaussians, &cameras(2), &[map(0, 500), map(20, 0)])[400 + 5 * 20 + 10], 0);
}

/// The slow twin: pixel by pixel in f64.
#[test]
fn weights_of_a_word_are_those_of_the_oracle() {
    let gaussians = wall(2, |of| if (of.x / 3 + of.y / 4) % 2 == 0 { 10.0 } else { 8.0 });
    let mut raw = gaussians.into_raw();
    (0..raw.scales.len()).for_each(|i| raw.scales[i] = [0.1 + 0.05 * (i % 7) as f32; 3]);
    (0..raw.opacities.len()).for_each(|i| raw.opacities[i] = 0.2 + 0.1 * (i % 8) as f32);
    let gaussians = Gaussians::sanitize(raw).unwrap().0;
    let cell = |i: usize, of: usize| [0, 0, 400, 600][(i / (3 + of) + i / 60) % 4];
    let maps = [0, 1].map(|of| IndexMap {
        width: 20,
        height: 20,
        index: (0..400).map(|i| cell(i, of)).collect(),
    });
    let mut sums = vec![[0.0_f64; 3]; gaussians.len()];
    for (camera, map) in cameras(2).iter().zip(&maps) {
        let intrinsics = camera.camera.intrinsics.resized(20, 20);
        let camera = Camera { intrinsics, ..camera.camera };
        let request = RenderRequest::plain(camera, Kinds::COLOR, 0.1);
        for (pixel, score) in (0..400).zip(&map.index) {
            let [x, y] = [pixel % 20, pixel / 20];
            for of in contributions(&gaussians, &request, [x, y], None).unwrap() {
                let sum = &mut sums[of.gaussian];
                sum[0] += of.weight;
                sum[1] += f64::from(u8::from(*score > 0)) * of.weight;
                sum[2] += f64::from(*score) * of.weight;
            }
        }
    }
    let scores = word(&gaussians, &cameras(2), &maps);
    let mut told = [0; 2];
    for (i, (score, [shown, with, sum])) in scores.iter().zip(sums).enumerate() {
        if shown < 0.051 || (with / shown - 0.5).abs() < 1e-4 {
            continue;
        }
        let wanted = if with > 0.5 * shown { sum / with } else { 0.0 };
        assert!((f64::from(*score) - wanted).abs() < 1.0, "{i}: {score}, not {wanted}");
        told[usize::from(*score > 0)] += 1;
    }
    assert!(told.iter().all(|count| *count > 50), "{told:?}");
}

fn rows(rows: &[[f32; 2]]) -> Bank {
    Bank { dim: 2, rows: rows.concat() }
}

#[test]
fn one_thing_under_two_indices_is_found_and_two_things_are_not() {
    let gaussians = wall(2, |_| 10.0);
    let views = Views::new(&gaussians, &cameras(2));
    let maps = vec![map(12, 1), map(10, 2)];
    let own = own(&gaussians, &maps);
    let alike = rows(&[[1.0, 0.0], [0.9, 0.1]]);
    assert_eq!(views.same_things(&own, &maps, &alike, 0.5), [0, 1, 1]);
    let other = rows(&[[1.0, 0.0], [0.0, 1.0]]);
    assert_eq!(views.same_things(&own, &maps, &other, 0.5), [0, 1, 2], "rows differ");
    // A small thing inside a large one: most of the large one is not the small one.
    let mut inside = map(20, 2);
    (0..100).for_each(|i| inside.index[i * 4 % 400] = 1);
    (0..40).for_each(|i| inside.index[i] = 2);
    let maps = vec![map(0, 1), inside];
    let own = self::own(&gaussians, &maps);
    assert_eq!(views.same_things(&own, &maps, &alike, 0.5), [0, 1, 2], "a part of it");
}

#[test]
fn merged_rows_are_the_mean_of_their_features_and_indices_close_up() {
    let bank = rows(&[[1.0, 0.0], [0.0, 1.0], [0.5, 0.5], [0.0, 0.2]]);
    let (merged, becomes) = merge(&bank, &[3, 1, 1, 1], &[0, 1, 2, 1, 2]);
    assert_eq!(becomes, [0, 1, 2, 1, 2]);
    assert_eq!(merged.rows, [0.875, 0.125, 0.0, 0.6]);
    let (same, becomes) = merge(&bank, &[3, 1, 1, 1], &[0, 1, 2, 3, 4]);
    assert_eq!((same.rows, becomes), (bank.rows, vec![0, 1, 2, 3, 4]));
}
