//! The colour of each entry.

use std::collections::HashSet;

use segsplat_vision::semantics::{colour, palette_table};

#[test]
fn the_background_is_black_and_no_entry_is() {
    assert_eq!(colour(0), [0.0; 3]);
    for m in 1..=4096 {
        let shade = colour(m);
        assert!(shade.iter().all(|v| (0.0..=1.0).contains(v)), "{m}: {shade:?}");
        assert!(shade.iter().any(|v| *v >= 0.49), "{m}: {shade:?} is nearly black");
    }
}

#[test]
fn entries_differ_as_eight_bit_colours() {
    let byte = |v: f32| (v * 255.0).round() as u8;
    let seen: HashSet<[u8; 3]> = (1..=512).map(|m| colour(m).map(byte)).collect();
    assert!(seen.len() >= 510, "{} colours of 512", seen.len());
    let far = |a: [f32; 3], b: [f32; 3]| {
        a.iter().zip(b).map(|(x, y)| (x - y).abs()).fold(0.0_f32, f32::max)
    };
    for a in 1..24 {
        for b in 1..a {
            assert!(far(colour(a), colour(b)) > 0.08, "{a} and {b} look alike");
        }
    }
}

#[test]
fn the_hue_goes_round_the_circle() {
    assert_eq!(colour(1), [0.95, 0.95 * 0.25, 0.95 * 0.25].map(|v: f64| v as f32), "red");
}

#[test]
fn the_table_has_a_row_for_each_index() {
    let table = palette_table(3);
    assert_eq!((table.len(), table[0]), (4, [0.0; 4]));
    assert_eq!(table[2][1..], colour(2));
    assert_eq!(table[2][0].to_bits(), 1.0_f32.to_bits());
}
