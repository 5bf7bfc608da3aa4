//! Masks as sets of bits, and their boxes.

use segsplat_vision::segment::{Bitset, Box2};

fn set(cells: usize, of: &[usize]) -> Bitset {
    let values: Vec<f32> = (0..cells).map(|i| if of.contains(&i) { 1.0 } else { -1.0 }).collect();
    Bitset::over(&values, 0.0)
}

#[test]
fn sets_count_meet_and_part() {
    let (a, b) = (set(130, &[0, 63, 64, 129]), set(130, &[63, 100, 129]));
    assert_eq!((a.count(), b.count(), a.common(&b)), (4, 3, 2), "counts");
    assert_eq!(a.cells().collect::<Vec<_>>(), [0, 63, 64, 129], "cells");
    let mut both = a.clone();
    both.add(&b);
    assert_eq!(both.count(), 5, "union");
    both.subtract(&a);
    assert_eq!(both.cells().collect::<Vec<_>>(), [100], "difference");
    both.subtract(&b);
    assert_eq!(both, Bitset::empty(130), "nothing is left");
    assert!(a.has(64) && !a.has(65) && !a.has(4_000), "membership");
}

#[test]
fn boxes_are_those_of_segment_anything() {
    let mask = set(48, &[9, 10, 18, 29]);
    let found = mask.bounds(8);
    assert_eq!(found, Box2 { x0: 1, y0: 1, x1: 5, y1: 3 }, "inclusive corners");
    assert_eq!(Bitset::empty(48).bounds(8), Box2::default(), "around nothing");
    // torchvision.ops.box_iou([[1,1,5,3]], [[3,1,5,4]]) = 4 / (8 + 6 - 4)
    let other = Box2 { x0: 3, y0: 1, x1: 5, y1: 4 };
    assert!((found.iou(other) - 0.4).abs() < 1e-6, "{}", found.iou(other));
    assert_eq!(Box2::default().iou(Box2::default()), 0.0, "two empty boxes");
}
