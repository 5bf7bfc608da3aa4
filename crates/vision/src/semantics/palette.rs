//! A fixed colour for each entry of the bank, so that views agree.

use std::sync::Arc;

/// Step of the hue from one entry to the next. The golden ratio keeps near entries apart.
const HUE_STEP: f64 = 0.618_033_988_749_894_9;
/// Pairs of value and saturation. Entries take them in turn.
const TONES: [[f64; 2]; 5] = [[0.95, 0.75], [0.65, 0.85], [1.0, 0.4], [0.8, 1.0], [0.5, 0.55]];

/// sRGB colour 0..1 of an entry; the background is black.
#[must_use]
pub fn colour(index: u16) -> [f32; 3] {
    let Some(m) = index.checked_sub(1) else { return [0.0; 3] };
    let hue = (f64::from(m) * HUE_STEP).fract() * 6.0;
    let [value, saturation] = TONES[usize::from(m) % TONES.len()];
    // Each channel is at its maximum for a third of the circle, and rises and falls for a sixth.
    let channel = |turn: f64| {
        let near = ((hue + turn) % 6.0 - 3.0).abs() - 1.0;
        #[expect(clippy::cast_possible_truncation, reason = "a colour")]
        let shade = (value * (1.0 - saturation * (1.0 - near.clamp(0.0, 1.0)))) as f32;
        shade
    };
    [channel(0.0), channel(4.0), channel(2.0)]
}

/// `[M + 1]` rows of weight and colour. After the blend, the last three numbers divided by the
/// first are the mean colour of a pixel's entries.
#[must_use]
pub fn palette_table(rows: usize) -> Arc<[[f32; 4]]> {
    let row = |m: usize| {
        let [r, g, b] = colour(u16::try_from(m).unwrap_or(u16::MAX));
        if m == 0 { [0.0; 4] } else { [1.0, r, g, b] }
    };
    (0..=rows).map(row).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::HashSet;

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
}
