//! A fixed colour for each entry of the bank, so that views agree.

use std::sync::Arc;

/// Step of the hue from one entry to the next. The golden ratio keeps near entries apart.
const HUE_STEP: f64 = 0.618_033_988_749_894_9;
/// Pairs of value and saturation. Entries take them in turn.
const TONES: [[f64; 2]; 5] = [[0.95, 0.75], [0.65, 0.85], [1.0, 0.4], [0.8, 1.0], [0.5, 0.55]];

/// sRGB colour 0..1 of an entry; the background is black.
#[must_use]
pub fn colour(entry: u16) -> [f32; 3] {
    let Some(m) = entry.checked_sub(1) else { return [0.0; 3] };
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
