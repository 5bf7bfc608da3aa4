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
