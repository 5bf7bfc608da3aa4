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
