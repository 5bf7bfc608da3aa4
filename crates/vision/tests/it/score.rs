//! Scores of a text, by numbers that are worked out by hand.

use std::{
    sync::{Arc, mpsc},
    time::Duration,
};

use rayon::prelude::*;
use segsplat_core::error::Result;
use segsplat_core::scene::{Bank, PixelWeights, Preset, RowViews, ScoringMethod};
use segsplat_testing::labels::mask_of_blends;
use segsplat_vision::semantics::{Scorer, Scoring, ViewNorms};

fn scoring(profile: Preset, canon: &[[f32; 2]]) -> Arc<Scoring> {
    let canon = canon.iter().map(|c| c.to_vec()).collect();
    Arc::new(new(profile, canon, 10.0, 0.05).unwrap())
}

fn new(preset: Preset, canon: Vec<Vec<f32>>, tau: f64, floor: f64) -> Result<Scoring> {
    let names: Vec<String> = (0..canon.len()).map(|c| c.to_string()).collect();
    let method = ScoringMethod::of(preset, names.clone(), tau, floor, 0.0, 1.0);
    Scoring::new(&ScoringMethod { canon: names, tau, ..method }, canon, Arc::default())
}

/// The default, where no entry is left out for being far under the best one.
fn all_over_the_canon(canon: &[[f32; 2]]) -> Arc<Scoring> {
    let names: Vec<String> = (0..canon.len()).map(|c| c.to_string()).collect();
    let near_best = ScoringMethod::NEAR_BEST_MAX;
    let method = ScoringMethod::of(Preset::Default, names, 10.0, 0.05, 0.0, 1.0);
    let canon = canon.iter().map(|c| c.to_vec()).collect();
    let method = ScoringMethod { near_best, ..method };
    Arc::new(Scoring::new(&method, canon, Arc::default()).unwrap())
}

const X: [f32; 2] = [1.0, 0.0];
const Y: [f32; 2] = [0.0, 1.0];

fn scorer(rows: &[[f32; 2]], profile: Preset) -> Scorer {
    let bank = Bank { dim: 2, rows: rows.concat() };
    Scorer::new(&bank, scoring(profile, &[Y])).unwrap()
}

/// Weights of pixels given as lists.
fn view(pixels: &[&[(u16, f32)]]) -> PixelWeights {
    let mut view = PixelWeights::none(0);
    for pixel in pixels {
        view.entries.extend(pixel.iter().map(|e| e.0));
        view.weights.extend(pixel.iter().map(|e| e.1));
        view.offsets.push(view.entries.len() as u32);
    }
    view
}

#[test]
fn a_row_that_is_the_text_scores_as_the_formula_says() {
    let scorer = scorer(&[X, Y, [3.0, 4.0]], Preset::Paper);
    let text = scorer.text(&X).unwrap();
    let close = |a: f32, b: f64| (f64::from(a) - b).abs() < 1e-6;
    let sigmoid = |v: f64| 1.0 / (1.0 + (-10.0 * v).exp());
    let entries = text.relevancies();
    assert!(close(entries[1], sigmoid(1.0)) && close(entries[2], sigmoid(-1.0)));
    assert!(close(entries[3], sigmoid(-0.2)), "a row's own length does not matter alone");
    assert!(entries[0].to_bits() == 0 && text.selects(1) && !text.selects(2));
    assert!(!text.selects(0) && !text.selects(4), "the background and what is no row");
}

#[test]
fn pixels_blend_their_rows_and_forget_the_rest() {
    let scorer = scorer(&[X, Y], Preset::Paper);
    let text = scorer.text(&X).unwrap();
    let view = view(&[&[(1, 0.4), (2, 0.3)], &[(1, 0.3), (2, 0.4)], &[], &[(9, 1.0), (0, 1.0)]]);
    let norms = scorer.norms(&view).unwrap();
    let map = scorer.relevancy(&text, &view, &norms).unwrap();
    let want = 1.0 / (1.0 + (-10.0 * 0.1_f64 / 0.5).exp());
    assert!((f64::from(map[0]) - want).abs() < 1e-6, "{} {want}", map[0]);
    assert_eq!(&map[1..], [0.0, 0.0, 0.0], "under 0.5, nothing, no rows");
    let mask = scorer.mask(&text, &view).unwrap();
    assert_eq!(mask, [true, false, false, false]);
}

#[test]
fn the_default_has_unit_rows_and_a_coverage_floor_the_paper_has_neither() {
    let rows = [[0.1, 0.0], Y];
    let view = view(&[&[(1, 0.5), (2, 0.3)], &[(1, 0.04)], &[(1, 0.05)]]);
    let mask = |profile| {
        let scorer = scorer(&rows, profile);
        let text = scorer.text(&X).unwrap();
        let norms = scorer.norms(&view).unwrap();
        let map = scorer.relevancy(&text, &view, &norms).unwrap();
        let mask = scorer.mask(&text, &view).unwrap();
        let from_map: Vec<bool> = map.iter().map(|v| *v >= 0.5).collect();
        assert_eq!(mask, from_map, "{profile:?}: the mask and the relevancy agree");
        mask
    };
    assert_eq!(mask(Preset::Default), [true, false, true]);
    assert_eq!(mask(Preset::Paper), [false, true, true]);
}

#[test]
fn opposite_rows_cancel_to_no_relevancy_and_never_nan() {
    let scorer = scorer(&[X, [-1.0, 0.0], [0.0, 0.0]], Preset::Default);
    let text = scorer.text(&X).unwrap();
    let view = view(&[&[(1, 0.5), (2, 0.5)], &[(3, 1.0)], &[(1, 0.5), (3, 0.5)]]);
    let norms = scorer.norms(&view).unwrap();
    let map = scorer.relevancy(&text, &view, &norms).unwrap();
    assert_eq!(map[..2], [0.0, 0.0]);
    assert!(map[2] > 0.99, "a row of zeros adds coverage alone");
    assert_eq!(scorer.mask(&text, &view).unwrap(), [false, false, true]);
}

#[test]
fn the_worst_phrase_decides_and_blended_tables_say_the_same() {
    let bank = Bank { dim: 2, rows: [X, [0.6, 0.8], [-0.6, -0.8]].concat() };
    for count in 1..=5_usize {
        // Phrases turn towards X; the last is the nearest to it.
        let canon: Vec<[f32; 2]> = (1..=count)
            .map(|i| {
                let turn = 1.5 - 0.25 * i as f32;
                [turn.cos(), turn.sin()]
            })
            .collect();
        let scoring = all_over_the_canon(&canon);
        let scorer = Scorer::new(&bank, Arc::clone(&scoring)).unwrap();
        let text = scorer.text(&X).unwrap();
        let want = 1.0 / (1.0 + (-10.0 * (1.0 - f64::from(canon[count - 1][0]))).exp());
        assert!((f64::from(text.relevancies()[1]) - want).abs() < 1e-5, "{count} phrases");
        let tables = text.tables();
        assert_eq!(tables.len(), count.div_ceil(3));
        let pixels: [&[(u16, f32)]; 5] =
            [&[(1, 0.5)], &[(2, 0.9)], &[(1, 0.2), (2, 0.3)], &[(1, 0.01)], &[(3, 0.7)]];
        let view = view(&pixels);
        let blend = |table: &Arc<[[f32; 4]]>| -> Vec<[f32; 4]> {
            let sum = |pixel: &&[(u16, f32)]| {
                let mut sum = [0.0; 4];
                for (m, weight) in *pixel {
                    let row = table[usize::from(*m)];
                    sum.iter_mut().zip(row).for_each(|(s, v): (&mut f32, f32)| *s += weight * v);
                }
                sum
            };
            pixels.iter().map(sum).collect()
        };
        let pictures: Vec<Vec<[f32; 4]>> = tables.iter().map(blend).collect();
        let pictures: Vec<&[[f32; 4]]> = pictures.iter().map(Vec::as_slice).collect();
        let mask = mask_of_blends(&pictures, scoring.coverage_floor());
        assert_eq!(mask, scorer.mask(&text, &view).unwrap(), "{count} phrases");
        assert!(mask[0] && !mask[3], "{count} phrases: {mask:?}");
        // Far from the text, but farther from every phrase.
        assert!(mask[4], "{count} phrases: {mask:?}");
    }
}

#[test]
fn an_empty_bank_has_no_relevancy_anywhere() {
    let scorer = scorer(&[], Preset::Default);
    let text = scorer.text(&X).unwrap();
    assert_eq!((text.relevancies().len(), text.tables()[0].len()), (1, 1));
    let view = view(&[&[], &[(1, 1.0)]]);
    let norms = scorer.norms(&view).unwrap();
    assert_eq!(scorer.relevancy(&text, &view, &norms).unwrap(), [0.0, 0.0]);
    assert_eq!(scorer.mask(&text, &view).unwrap(), [false, false]);
}

#[test]
fn a_great_tau_saturates_without_overflow() {
    let canon = vec![Y.to_vec()];
    let scoring = new(Preset::Paper, canon, 1e6, 0.05).unwrap();
    let bank = Bank { dim: 2, rows: [X, Y].concat() };
    let text = Scorer::new(&bank, Arc::new(scoring)).unwrap().text(&X).unwrap();
    assert_eq!(text.relevancies(), [0.0, 1.0, 0.0]);
}

#[test]
fn what_does_not_belong_together_is_refused() {
    let new = |canon: Vec<Vec<f32>>, tau, floor| new(Preset::Default, canon, tau, floor);
    assert!(new(vec![], 10.0, 0.0).is_err() && new(vec![vec![]], 10.0, 0.0).is_err());
    assert!(new(vec![X.to_vec(), vec![1.0]], 10.0, 0.0).is_err());
    assert!(new(vec![vec![f32::NAN]], 10.0, 0.0).is_err());
    assert!(new(vec![X.to_vec()], 0.0, 0.0).is_err());
    assert!(new(vec![X.to_vec()], f64::NAN, 0.0).is_err());
    assert!(new(vec![X.to_vec()], 10.0, 1.5).is_err());
    let scorer = scorer(&[X], Preset::Default);
    assert!(scorer.text(&[1.0]).is_err() && scorer.text(&[1.0, f32::INFINITY]).is_err());
    let wide = Bank { dim: 3, rows: vec![1.0; 3] };
    assert!(Scorer::new(&wide, scoring(Preset::Default, &[Y])).is_err());
    let view = view(&[&[(1, 0.5)]]);
    let text = scorer.text(&X).unwrap();
    assert!(scorer.relevancy(&text, &view, &ViewNorms::default()).is_err());
    let broken = PixelWeights { offsets: vec![0, 2], entries: vec![1], weights: vec![0.5] };
    assert!(scorer.mask(&text, &broken).is_err() && scorer.norms(&broken).is_err());
}

#[test]
fn texts_on_one_pool_do_not_wait_for_each_other() {
    let (tell, told) = mpsc::channel();
    // A thread of its own: it never ends where they do.
    std::thread::spawn(move || {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(4).build().unwrap();
        // The products take long enough for others to take a part of them.
        let (dim, rows) = (1024, 256);
        let rows: Vec<f32> = (0..dim * rows).map(|i| (i as f32).sin()).collect();
        let bank = Bank { dim, rows };
        let canon = vec![bank.row(0).to_vec()];
        let scoring = Arc::new(new(Preset::Paper, canon, 10.0, 0.05).unwrap());
        let view = view(&[&[(1, 0.5), (7, 0.25)], &[(200, 1.0)]]);
        for _ in 0..60 {
            let scorer = Scorer::new(&bank, Arc::clone(&scoring)).unwrap();
            let text = |_| drop(scorer.norms(&view).unwrap());
            pool.install(|| (0..4).into_par_iter().with_max_len(1).for_each(text));
        }
        tell.send(()).unwrap();
    });
    told.recv_timeout(Duration::from_secs(120)).expect("the texts are scored");
}

#[test]
fn a_cut_selects_from_its_relevancy_on_and_no_less() {
    let bank = Bank { dim: 2, rows: [X, [0.6, 0.8], Y].concat() };
    let view = view(&[&[(1, 0.5)], &[(2, 0.9)], &[(1, 0.2), (2, 0.3)], &[(3, 0.7)], &[]]);
    let with = |cut: f64| {
        let method = ScoringMethod::of(Preset::Paper, Vec::new(), 10.0, 0.0, 0.0, 1.0);
        let method = ScoringMethod { canon: vec!["y".to_owned()], cut, ..method };
        let scoring = Arc::new(Scoring::new(&method, vec![Y.to_vec()], Arc::default()).unwrap());
        let scorer = Scorer::new(&bank, scoring).unwrap();
        let text = scorer.text(&X).unwrap();
        let map = scorer.relevancy(&text, &view, &scorer.norms(&view).unwrap()).unwrap();
        let mask = scorer.mask(&text, &view).unwrap();
        let rows: Vec<bool> = (1..=3).map(|m| text.selects(m)).collect();
        (map, mask, rows)
    };
    let (all, everything, rows) = with(0.0);
    assert_eq!((everything, rows), (vec![true, true, true, true, false], vec![true; 3]));
    for cut in [0.001, 0.2, 0.45, 0.5, 0.55, 0.9, 0.9999] {
        let (map, mask, rows) = with(cut);
        for (p, raw) in all.iter().enumerate() {
            let over = f64::from(*raw) >= cut;
            assert_eq!((mask[p], map[p] > 0.0), (over, over), "cut {cut}, pixel {p}: {raw}");
            assert!(!over || (map[p] - raw).abs() < 1e-6, "cut {cut}, pixel {p}");
        }
        assert_eq!([rows[0], rows[1], rows[2]], [mask[0], mask[1], mask[3]], "cut {cut}");
    }
}

#[test]
fn an_entry_far_under_the_best_one_of_its_text_is_left_out() {
    // Over the canon by 1, 0.95 and 0.2.
    let rows = [X, [0.9988, 0.0488], [0.7763, 0.6303]];
    let selected = |preset| {
        let scorer = scorer(&rows, preset);
        let text = scorer.text(&X).unwrap();
        let view = view(&[&[(1, 1.0)], &[(2, 1.0)], &[(3, 1.0)], &[(1, 0.9), (3, 0.1)]]);
        let mask = scorer.mask(&text, &view).unwrap();
        let alone: Vec<bool> = (1..=3).map(|m| text.selects(m)).collect();
        assert_eq!(alone, mask[..3], "{preset:?}");
        let over: Vec<bool> = text.relevancies()[1..].iter().map(|v| *v >= 0.5).collect();
        assert_eq!(alone, over, "{preset:?}");
        mask
    };
    assert_eq!(selected(Preset::Default), [true, true, false, true]);
    assert_eq!(selected(Preset::Paper), [true; 4]);
}

#[test]
fn a_margin_moves_what_counts_as_the_canon_in_tables_masks_and_relevancies_alike() {
    // Unit rows whose cosines with the text are over those with the canon by 0.2, 0 and -0.2.
    let towards = |angle: f32| [angle.cos(), angle.sin()];
    let middle = std::f32::consts::FRAC_PI_4;
    let rows = [-0.141_9, 0.0, 0.141_9].map(|off| towards(middle + off));
    let bank = Bank { dim: 2, rows: rows.map(|row| row.map(|v| 3.0 * v)).concat() };
    let selected = |margin: f64| {
        let names = vec!["y".to_owned()];
        let method = ScoringMethod::of(Preset::Default, names, 10.0, 0.05, margin, 1.0);
        let method = ScoringMethod { near_best: 2.0, ..method };
        let scorer = Scorer::new(
            &bank,
            Scoring::new(&method, vec![Y.to_vec()], Arc::default()).unwrap().into(),
        )
        .unwrap();
        let text = scorer.text(&X).unwrap();
        let pixels = view(&[&[(1, 0.9)], &[(2, 0.9)], &[(3, 0.9)], &[(1, 0.5), (3, 0.4)]]);
        let norms = scorer.norms(&pixels).unwrap();
        let relevancy = scorer.relevancy(&text, &pixels, &norms).unwrap();
        let mask = scorer.mask(&text, &pixels).unwrap();
        assert_eq!(relevancy.iter().map(|v| *v >= 0.5).collect::<Vec<_>>(), mask, "{margin}");
        let entries = [1, 2, 3].map(|m| text.selects(m));
        assert_eq!(entries[..], mask[..3], "{margin}");
        (mask, text.relevancies()[1])
    };
    let (plain, sure) = selected(0.0);
    assert_eq!(plain, [true, false, false, true]);
    assert!((f64::from(sure) - 1.0 / (1.0 + (-2.0_f64).exp())).abs() < 1e-3, "{sure}");
    assert_eq!(selected(-0.1).0, [true, true, false, true]);
    assert_eq!(selected(-0.25).0, [true; 4]);
    let (strict, sure) = selected(0.1);
    assert_eq!(strict, [true, false, false, false]);
    assert!((f64::from(sure) - 1.0 / (1.0 + (-1.0_f64).exp())).abs() < 1e-3, "{sure}");
    assert_eq!(selected(0.25).0, [false; 4]);
}

#[test]
fn a_text_must_be_among_the_words_that_fit_an_entry_best() {
    let towards = |angle: f32| vec![angle.cos(), angle.sin()];
    let bank = Bank {
        dim: 2,
        rows: [towards(0.0), towards(0.0).iter().map(|v| v * 3.0).collect()].concat(),
    };
    // The nearest word is 0.1 away from both entries, the third 0.3.
    let words: Vec<Vec<f32>> = (1_u8..=10).map(|i| towards(f32::from(i) * 0.1)).collect();
    let selects = |angle: f32, rivals: f64, unit_rows: bool| {
        let names = vec!["away".to_owned()];
        let method = ScoringMethod::of(Preset::Default, names, 10.0, 0.05, 0.0, rivals);
        let method = ScoringMethod { unit_rows, ..method };
        let canon = vec![towards(std::f32::consts::PI)];
        let scoring = Scoring::new(&method, canon, words.clone().into()).unwrap();
        let scorer = Scorer::new(&bank, scoring.into()).unwrap();
        let text = scorer.text(&towards(angle)).unwrap();
        assert_eq!(text.tables().len(), 1, "one blend");
        assert_eq!(text.relevancies()[1] >= 0.5, text.selects(1));
        [text.selects(1), text.selects(2)]
    };
    for unit_rows in [false, true] {
        assert_eq!(selects(0.25, 0.3, unit_rows), [true; 2]);
        assert_eq!(selects(0.35, 0.3, unit_rows), [false; 2]);
        assert_eq!(selects(0.35, 0.4, unit_rows), [true; 2]);
        // No share is less than one word.
        assert_eq!(selects(0.05, 0.0, unit_rows), [true; 2]);
        assert_eq!(selects(0.15, 0.0, unit_rows), [false; 2]);
        assert_eq!(selects(0.95, 1.0, unit_rows), [true; 2]);
    }
}

/// At `degrees` from X.
fn at(degrees: f32) -> [f32; 2] {
    let angle = degrees.to_radians();
    [angle.cos(), angle.sin()]
}

/// Rows that stand for masks at these degrees, against Y.
fn seen(rows: &[&[f32]]) -> Scorer {
    let mean = |of: &&[f32]| -> [f32; 2] {
        let sum =
            of.iter().map(|degrees| at(*degrees)).fold([0.0; 2], |a, b| [a[0] + b[0], a[1] + b[1]]);
        sum.map(|v| v / of.len() as f32)
    };
    let bank = Bank { dim: 2, rows: rows.iter().flat_map(mean).collect() };
    let of = |(entry, of): (u16, &&[f32])| vec![entry; of.len()];
    let views = RowViews {
        entries: (1..).zip(rows).flat_map(of).collect(),
        rows: rows.iter().flat_map(|of| of.iter().flat_map(|degrees| at(*degrees))).collect(),
    };
    let scoring = all_over_the_canon(&[Y]);
    Scorer::new(&bank, scoring).unwrap().with_views(&views).unwrap()
}

#[test]
fn a_text_is_compared_with_the_better_half_of_the_masks_of_a_row() {
    let lead = |degrees: f32| at(degrees)[0] - at(degrees)[1];
    let sigmoid = |lead: f32| 1.0 / (1.0 + (-10.0 * lead).exp());
    let close = |scorer: &Scorer, want: f32| {
        let relevancy = scorer.text(&X).unwrap().relevancies()[1];
        assert!((relevancy - sigmoid(want)).abs() < 1e-5, "{relevancy} {}", sigmoid(want));
    };
    // X is nearer than Y under 45 degrees. The mean of all four is over them.
    close(&seen(&[&[80.0, 43.0, 75.0, 41.0]]), (lead(43.0) + lead(41.0)) / 2.0);
    close(&seen(&[&[80.0, 41.0, 75.0]]), lead(41.0));
    close(&seen(&[&[41.0]]), lead(41.0));
    assert!(seen(&[&[80.0, 43.0, 75.0, 41.0]]).text(&X).unwrap().selects(1));
    let bank = Bank { dim: 2, rows: at(60.0).to_vec() };
    let alone = Scorer::new(&bank, all_over_the_canon(&[Y])).unwrap();
    assert!(!alone.text(&X).unwrap().selects(1), "a row without views is its mean");
}

#[test]
fn rows_that_look_alike_are_judged_together_and_others_are_not() {
    // 50 and 40 degrees are alike, -20 degrees is like 40 but not like 110.
    let scorer = seen(&[&[50.0], &[40.0], &[110.0]]);
    let text = scorer.text(&X).unwrap();
    assert_eq!([1, 2, 3].map(|m| text.selects(m)), [true, true, false]);
    // Three masks of 50 degrees outweigh one of 40.
    let text = seen(&[&[50.0, 50.0, 50.0], &[40.0]]).text(&X).unwrap();
    assert_eq!([1, 2].map(|m| text.selects(m)), [false, false]);
    let text = seen(&[&[100.0, 100.0], &[40.0]]).text(&X).unwrap();
    assert_eq!([1, 2].map(|m| text.selects(m)), [false, true], "60 degrees apart is another look");
}

#[test]
fn what_a_text_takes_touches_what_it_is_sure_of() {
    // Over the canon by 0.17, 0.16, 0.05, 0.02 and 0.09.
    let bank = Bank { dim: 2, rows: [38.0, 38.5, 43.0, 44.2, 41.5].map(at).concat() };
    let taken = |near_best: f64, pairs: &[[u16; 2]]| {
        let method = ScoringMethod::of(Preset::Default, vec!["y".to_owned()], 10.0, 0.05, 0.0, 1.0);
        let method = ScoringMethod { near_best, ..method };
        let scoring = Scoring::new(&method, vec![Y.to_vec()], Arc::default()).unwrap();
        let scorer = Scorer::new(&bank, scoring.into()).unwrap().with_touching(pairs);
        let text = scorer.text(&X).unwrap();
        let pixels = view(&[&[(1, 0.9)], &[(2, 0.9)], &[(3, 0.9)], &[(4, 0.9)], &[(5, 0.9)]]);
        let entries = [1, 2, 3, 4, 5].map(|m| text.selects(m));
        assert_eq!(scorer.mask(&text, &pixels).unwrap(), entries);
        let over = text.relevancies()[1..].iter().map(|v| *v >= 0.5);
        assert_eq!(over.collect::<Vec<_>>(), entries);
        entries
    };
    // The second is nearly as sure as the first, the last is sure; others must touch one of these.
    let sure = [true, true, false, false, true];
    assert_eq!(taken(1.0, &[]), sure);
    assert_eq!(taken(1.0, &[[3, 4]]), sure);
    assert_eq!(taken(1.0, &[[2, 3]]), [true, true, true, false, true]);
    assert_eq!(taken(1.0, &[[5, 4]]), [true, true, false, true, true]);
    assert_eq!(taken(1.0, &[[4, 3], [1, 4]]), [true; 5], "over others that are taken");
    // What is too far from the best one is no bridge.
    assert_eq!(taken(0.14, &[[4, 3], [1, 4]]), sure);
    assert_eq!(taken(2.0, &[]), [true; 5], "a method that leaves out nothing");
    assert_eq!(taken(1.0, &[[0, 1], [3, 9]]), sure, "no entries");
    // Where the best one is unsure too, what is nearly as sure stays.
    let bank = Bank { dim: 2, rows: [43.0, 43.2, 44.2].map(at).concat() };
    let scorer = Scorer::new(&bank, scoring(Preset::Default, &[Y])).unwrap().with_touching(&[]);
    let text = scorer.text(&X).unwrap();
    assert_eq!([1, 2, 3].map(|m| text.selects(m)), [true, true, false]);
}

#[test]
fn what_one_photo_shows_is_no_measure_for_what_several_show() {
    // Rows that do not look alike: each has an axis of its own. `of`: leads, and masks of each.
    let taken = |of: [(f32, usize); 4]| {
        let row = |(i, (lead, masks)): (usize, (f32, usize))| {
            let mut row = [0.3 + lead, 0.3, 0.0, 0.0, 0.0, 0.0];
            row[2 + i] = (1.0 - row[0] * row[0] - row[1] * row[1]).sqrt();
            vec![row; masks]
        };
        let masks: Vec<Vec<[f32; 6]>> = of.into_iter().enumerate().map(row).collect();
        let bank = Bank { dim: 6, rows: masks.iter().flat_map(|of| of[0]).collect() };
        let views = RowViews {
            entries: (1..).zip(&masks).flat_map(|(m, of)| vec![m; of.len()]).collect(),
            rows: masks.concat().concat(),
        };
        let method = ScoringMethod::of(Preset::Default, vec!["y".to_owned()], 10.0, 0.05, 0.0, 1.0);
        let method = ScoringMethod { near_best: 1.0, ..method };
        let [x, y] = [0, 1].map(|at| (0..6).map(|i| f32::from(u8::from(i == at))).collect());
        let (x, y): (Vec<f32>, Vec<f32>) = (x, y);
        let scoring = Scoring::new(&method, vec![y], Arc::default()).unwrap();
        let scorer = Scorer::new(&bank, scoring.into()).unwrap().with_views(&views).unwrap();
        let text = scorer.with_touching(&[]).text(&x).unwrap();
        [1, 2, 3, 4].map(|m| text.selects(m))
    };
    // The best of several photos is the second one: it is sure, and so is what is nearly as sure.
    assert_eq!(taken([(0.17, 1), (0.037, 2), (0.035, 1), (0.01, 2)]), [true, true, true, false]);
    assert_eq!(taken([(0.17, 2), (0.037, 2), (0.035, 1), (0.01, 2)]), [true, false, false, false]);
    // Where the text takes nothing of several photos, the best one is the measure.
    assert_eq!(taken([(0.17, 1), (0.037, 1), (0.035, 1), (0.01, 1)]), [true, false, false, false]);
    assert_eq!(taken([(0.17, 1), (0.037, 1), (0.035, 1), (-0.01, 2)]), [true, false, false, false]);
    // What is sure in itself needs no other: 0.06.
    assert_eq!(taken([(0.17, 1), (0.3, 2), (0.07, 1), (0.05, 1)]), [true, true, true, false]);
}

#[test]
fn views_of_another_bank_are_refused() {
    let bank = Bank { dim: 2, rows: X.to_vec() };
    for (entries, rows) in [(vec![2], X.to_vec()), (vec![0], X.to_vec()), (vec![1], vec![1.0])] {
        let scorer = Scorer::new(&bank, all_over_the_canon(&[Y])).unwrap();
        assert!(scorer.with_views(&RowViews { entries, rows }).is_err());
    }
}

#[test]
fn the_edge_of_what_is_taken_lies_where_it_weighs_most_however_little_it_fits() {
    // 44 degrees is barely nearer to X than to Y, 170 not at all.
    let scorer = seen(&[&[44.0], &[170.0]]);
    let text = scorer.text(&X).unwrap();
    assert_eq!([1, 2].map(|m| text.selects(m)), [true, false]);
    let pixel = |share: f32| PixelWeights {
        offsets: vec![0, 2],
        entries: vec![1, 2],
        weights: vec![share, 1.0 - share],
    };
    let takes = |text, share| scorer.mask(text, &pixel(share)).unwrap()[0];
    assert_eq!([0.55, 0.45].map(|share| takes(&text, share)), [true, false]);
    // Without masks beside its rows a bank is blended as the paper does.
    let bank = Bank { dim: 2, rows: [at(44.0), at(170.0)].concat() };
    let plain = Scorer::new(&bank, all_over_the_canon(&[Y])).unwrap();
    let text = plain.text(&X).unwrap();
    assert!(!plain.mask(&text, &pixel(0.55)).unwrap()[0]);
    // Nothing is taken, so nothing counts less against it.
    let text = scorer.text(&at(170.0)).unwrap();
    assert_eq!([1, 2].map(|m| text.selects(m)), [false, true]);
    assert!(!takes(&text, 0.55) && takes(&text, 0.45));
    let text = scorer.text(&at(250.0)).unwrap();
    assert!(!takes(&text, 0.9) && !takes(&text, 0.1));
}
