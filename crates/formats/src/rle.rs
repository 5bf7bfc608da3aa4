//! Masks as COCO's compressed run lengths: column by column, as `pycocotools` reads and writes.

use serde::Serialize;
use utoipa::ToSchema;

/// A mask as run lengths, off and on in turn, beginning with off.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, ToSchema)]
pub struct Rle {
    /// Height and width, pixels.
    pub size: [u32; 2],
    /// The run lengths in COCO's printable encoding.
    pub counts: String,
}

impl Rle {
    /// Encodes a mask, `[height * width]` row-major.
    pub fn encode(mask: &[bool], width: u32, height: u32) -> Self {
        let (w, h) = (width as usize, height as usize);
        // Most columns of most masks are empty; row-major memory is fast to read row by row.
        let mut some = vec![false; w];
        for row in mask.chunks_exact(w.max(1)) {
            some.iter_mut().zip(row).for_each(|(some, on)| *some |= on);
        }
        let mut runs: Vec<i64> = Vec::new();
        let (mut value, mut run) = (false, 0_i64);
        for (x, some) in some.into_iter().enumerate() {
            if !some && !value {
                run += i64::from(height);
                continue;
            }
            for y in 0..h {
                let on = mask.get(y * w + x).copied().unwrap_or(false);
                if on != value {
                    runs.push(run);
                    (value, run) = (on, 0);
                }
                run += 1;
            }
        }
        runs.push(run);
        Self { size: [height, width], counts: text_of(&runs) }
    }

    /// The mask, `[height * width]` row-major. Runs beyond its end are left out.
    pub fn decode(&self) -> Vec<bool> {
        let [height, width] = self.size.map(|side| side as usize);
        let mut mask = vec![false; height * width];
        let mut at = 0_usize;
        for (i, run) in runs_of(&self.counts).into_iter().enumerate() {
            let run = usize::try_from(run).unwrap_or(0);
            let end = at.saturating_add(run).min(mask.len());
            if i % 2 == 1 {
                (at..end).for_each(|k| mask[k % height * width + k / height] = true);
            }
            at = end;
        }
        mask
    }
}

/// The runs of a text of [`text_of`].
fn runs_of(text: &str) -> Vec<i64> {
    let (mut runs, mut run, mut bits) = (Vec::<i64>::new(), 0_i64, 0_u32);
    for byte in text.bytes().map(|byte| i64::from(byte.wrapping_sub(48))) {
        run |= (byte & 0x1f).unbounded_shl(bits);
        bits += 5;
        if byte & 0x20 != 0 {
            continue;
        }
        if byte & 0x10 != 0 {
            run |= (-1_i64).unbounded_shl(bits);
        }
        let before = if runs.len() > 2 { runs[runs.len() - 2] } else { 0 };
        runs.push(run.wrapping_add(before));
        (run, bits) = (0, 0);
    }
    runs
}

/// Each run as the difference to the one two before it (from the fourth on), in groups of five
/// bits from the lowest, a sixth bit saying that more follow, offset into printable characters.
fn text_of(runs: &[i64]) -> String {
    let mut text = String::new();
    for (i, run) in runs.iter().enumerate() {
        let mut rest = if i > 2 { run - runs[i - 2] } else { *run };
        loop {
            let low = u8::try_from(rest & 0x1f).unwrap_or(0);
            rest >>= 5;
            // The sign is that of the group's highest bit, so a rest of 0 or -1 may be dropped.
            let more = if low & 0x10 == 0 { rest != 0 } else { rest != -1 };
            text.push(char::from(low + if more { 0x20 } else { 0 } + 48));
            if !more {
                break;
            }
        }
    }
    text
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_mask_comes_back() {
        let mut state = 1_u64;
        for case in 0..200_u32 {
            let (width, height) = (1 + case % 37, 1 + case % 29);
            let mask: Vec<bool> = (0..width * height)
                .map(|i| {
                    state = state.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1);
                    // Runs of all lengths.
                    if case % 2 == 0 { (state >> 33) % 3 < 1 } else { i / (1 + case) % 2 == 0 }
                })
                .collect();
            assert_eq!(Rle::encode(&mask, width, height).decode(), mask, "case {case}");
        }
        assert!(Rle::default().decode().is_empty());
        let odd = Rle { size: [2, 2], counts: "\u{7f}~~zz0123".to_owned() };
        assert_eq!(odd.decode().len(), 4, "runs beyond the end are left out");
    }
}
