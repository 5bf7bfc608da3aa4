//! What texts select, counted by hand.

use segsplat_lab::semantics::{
    labels::{Class, NOT_SEEN},
    tally::{Tally, TextMap},
};

fn class(name: &str, asked: bool) -> Class {
    Class { name: name.to_owned(), asked }
}

/// Four pixels: cup, cup, plate, wall; a fifth that nobody sees.
const LABEL: [u16; 5] = [1, 1, 2, 3, NOT_SEEN];

fn tally() -> Tally {
    let classes = [class("cup", true), class("plate", true), class("wall", false)];
    let mut tally = Tally::new(&classes, &["car".to_owned()]);
    assert_eq!(tally.texts(), ["cup", "plate", "car"]);
    let map = |score: [f64; 5], mask: [u8; 5]| TextMap {
        score: score.to_vec(),
        mask: mask.iter().map(|m| *m > 0).collect(),
    };
    let none = f64::NEG_INFINITY;
    tally.add(
        &LABEL,
        &[
            // Selects one cup pixel, the plate and the wall.
            map([0.5, none, 0.2, 0.1, 0.9], [1, 0, 1, 1, 1]),
            // Scores the plate higher than the cup does, but does not select it.
            map([0.4, none, 0.3, -0.2, 0.9], [1, 0, 0, 0, 1]),
            map([0.9, none, none, none, 0.9], [1, 0, 0, 0, 1]),
        ],
    );
    tally
}

#[test]
fn three_readings_of_one_view() {
    let scores = tally().scores();
    let cup = &scores["classes"][0];
    let plate = &scores["classes"][1];
    // Own masks: cup 1 of 4 in the union, plate 0 of 2.
    assert_eq!([&cup["iou"], &plate["iou"]], [0.25, 0.0]);
    assert_eq!(scores["miou"], 0.125);
    // Best text of each labelled pixel: cup, none, plate; 2 of 3 right.
    assert_eq!([&cup["iou_closed"], &plate["iou_closed"]], [0.5, 1.0]);
    assert_eq!(scores["accuracy_closed"], 2.0 / 3.0);
    // Best selecting text: cup, none, cup, cup; 1 of 4 right.
    assert_eq!([&cup["iou_open"], &plate["iou_open"]], [0.25, 0.0]);
    assert_eq!(scores["accuracy_open"], 0.25);
    // Three texts at most: both cup pixels but the one that nobody knows, and the plate.
    assert_eq!([&scores["miou_top1"], &scores["miou_top3"]], [0.75, 0.75]);
    // As 3D-OVS: own masks; then the best text of every pixel: cup, none, plate, cup.
    assert_eq!(scores["jaccard"], 0.125);
    assert_eq!(scores["jaccard_closed"], f64::midpoint(1.0 / 3.0, 1.0));
    // "car" selects one of four.
    assert_eq!(scores["absent_words"][0]["selected"], 0.25);
    assert_eq!([&cup["share"], &plate["share"]], [0.5, 0.25]);
}

#[test]
fn a_class_that_no_view_shows_is_left_out() {
    let mut tally = Tally::new(&[class("cup", true), class("hat", true)], &[]);
    let map = |on: bool| TextMap { score: vec![f64::from(u8::from(on))], mask: vec![on] };
    tally.add(&[1], &[map(true), map(false)]);
    let scores = tally.scores();
    assert_eq!(scores["classes"].as_array().unwrap().len(), 1);
    for figure in ["miou", "accuracy_closed", "accuracy_open"] {
        assert_eq!(scores[figure], 1.0, "{figure}");
    }
    // But 3D-OVS counts it as 0.
    assert_eq!([&scores["jaccard"], &scores["jaccard_closed"]], [0.5, 0.5]);
}

/// ScanNet++'s count, literally: every pixel's texts are sorted, and one matrix of labels and of
/// counted classes gives the IoU of each class that is in it.
fn top_k(views: &[(Vec<u16>, Vec<TextMap>)], classes: usize, k: usize) -> f64 {
    let mut matrix = vec![vec![0_u32; classes + 1]; classes];
    for (label, maps) in views {
        for (p, &label) in label.iter().enumerate().filter(|(_, label)| **label != NOT_SEEN) {
            let Some(truth) = usize::from(label).checked_sub(1) else { continue };
            let mut order: Vec<usize> =
                (0..classes).filter(|c| maps[*c].score[p] > f64::NEG_INFINITY).collect();
            order.sort_by(|a, b| maps[*b].score[p].total_cmp(&maps[*a].score[p]));
            order.truncate(k);
            let hit = order.contains(&truth);
            // The last column: no text is known there.
            let counted = if hit { truth } else { order.first().copied().unwrap_or(classes) };
            matrix[truth][counted] += 1;
        }
    }
    let iou = |c: usize| {
        let row: u32 = matrix[c].iter().sum();
        let column: u32 = matrix.iter().map(|row| row[c]).sum();
        let union = row + column - matrix[c][c];
        (union > 0).then(|| f64::from(matrix[c][c]) / f64::from(union))
    };
    let found: Vec<f64> = (0..classes).filter_map(iou).collect();
    found.iter().sum::<f64>() / found.len() as f64
}

#[test]
fn the_best_k_are_counted_as_scannetpp_counts_them() {
    // Of seven classes the last is never labelled; few levels of scores make equals.
    const CLASSES: usize = 7;
    let mut state = 1_u32;
    let mut dice = |sides: u32| {
        state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (state >> 16) % sides
    };
    let mut view = || {
        let label: Vec<u16> = (0..400)
            .map(|_| if dice(20) == 0 { NOT_SEEN } else { dice(CLASSES as u32) as u16 })
            .collect();
        let known: Vec<bool> = (0..label.len()).map(|_| dice(9) > 0).collect();
        let map = |c: usize| TextMap {
            score: label
                .iter()
                .zip(&known)
                .map(|(label, known)| match (known, usize::from(*label) == c + 1) {
                    (false, _) => f64::NEG_INFINITY,
                    (_, own) => f64::from(dice(8) + 2 * u32::from(own)),
                })
                .collect(),
            mask: label.iter().map(|_| false).collect(),
        };
        let maps = (0..CLASSES).map(map).collect();
        (label, maps)
    };
    let views = [view(), view(), view()];
    let classes: Vec<Class> = (0..CLASSES).map(|c| class(&c.to_string(), true)).collect();
    let tally = |views: &[(Vec<u16>, Vec<TextMap>)]| {
        let mut tally = Tally::new(&classes, &[]);
        views.iter().for_each(|(label, maps)| tally.add(label, maps));
        tally
    };
    let scores = tally(&views).scores();
    for (name, k) in [("miou_top1", 1), ("miou_top3", 3)] {
        let wanted = top_k(&views, CLASSES, k);
        assert!((scores[name].as_f64().unwrap() - wanted).abs() < 1e-12, "{name}: {wanted}");
    }
    assert!(scores["miou_top3"].as_f64() > scores["miou_top1"].as_f64());
    // The class that is never labelled has 0 there, and is left out of the closed reading.
    assert_eq!(scores["classes"].as_array().unwrap().len(), CLASSES - 1);
    // Views that are counted apart, as folders are, and then added.
    let mut all = tally(&views[..1]);
    assert!(all.merge(&tally(&views[1..])));
    assert_eq!(all.scores(), scores);
    assert!(!all.merge(&Tally::new(&classes[1..], &[])));
}
