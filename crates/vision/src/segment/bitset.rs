//! A mask as a set of bits, and its box.

/// A set of cells of a grid, row-major, one bit a cell.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Bitset {
    words: Vec<u64>,
}

/// Columns and rows of a mask, first and last included, as in Segment Anything.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Box2 {
    /// First column.
    pub x0: u32,
    /// First row.
    pub y0: u32,
    /// Last column.
    pub x1: u32,
    /// Last row.
    pub y1: u32,
}

impl Bitset {
    /// The empty set of a grid of `cells` cells.
    #[must_use]
    pub fn empty(cells: usize) -> Self {
        Self { words: vec![0; cells.div_ceil(64)] }
    }

    /// The cells whose value is over `threshold`.
    #[must_use]
    pub fn over(values: &[f32], threshold: f32) -> Self {
        let word = |chunk: &[f32]| {
            let bit = |(i, v): (usize, &f32)| u64::from(*v > threshold) << i;
            chunk.iter().enumerate().map(bit).fold(0, |word, bit| word | bit)
        };
        Self { words: values.chunks(64).map(word).collect() }
    }

    /// The set of these bits, the first cell in the lowest bit of the first byte; eight bytes a
    /// word.
    #[must_use]
    pub fn of_bytes(bytes: &[u8]) -> Self {
        let (words, _) = bytes.as_chunks::<8>();
        Self { words: words.iter().map(|word| u64::from_le_bytes(*word)).collect() }
    }

    /// The set of these cells, of a grid of `cells` cells; others than the grid's are left out.
    #[must_use]
    pub fn of(cells: usize, inside: impl IntoIterator<Item = usize>) -> Self {
        let mut set = Self::empty(cells);
        for cell in inside {
            if let Some(word) = set.words.get_mut(cell / 64) {
                *word |= 1 << (cell % 64);
            }
        }
        set
    }

    /// Whether a cell is in the set.
    #[must_use]
    pub fn has(&self, cell: usize) -> bool {
        self.words.get(cell / 64).is_some_and(|word| word >> (cell % 64) & 1 == 1)
    }

    /// Adds all cells of another set of the same grid.
    pub fn add(&mut self, other: &Self) {
        self.words.iter_mut().zip(&other.words).for_each(|(a, b)| *a |= b);
    }

    /// Removes all cells of another set of the same grid.
    pub fn subtract(&mut self, other: &Self) {
        self.words.iter_mut().zip(&other.words).for_each(|(a, b)| *a &= !b);
    }

    /// Number of cells in the set.
    #[must_use]
    pub fn count(&self) -> u32 {
        self.words.iter().map(|word| word.count_ones()).sum()
    }

    /// Number of cells in both sets.
    #[must_use]
    pub fn common(&self, other: &Self) -> u32 {
        self.words.iter().zip(&other.words).map(|(a, b)| (a & b).count_ones()).sum()
    }

    /// The cells of the set, ascending.
    pub fn cells(&self) -> impl Iterator<Item = usize> + '_ {
        self.words.iter().enumerate().flat_map(|(at, &word)| {
            std::iter::successors((word != 0).then_some(word), |w| {
                let rest = w & (w - 1);
                (rest != 0).then_some(rest)
            })
            .map(move |w| at * 64 + w.trailing_zeros() as usize)
        })
    }

    /// The cells of the set as runs `[first, count]`, ascending.
    #[must_use]
    pub fn runs(&self) -> Vec<[u32; 2]> {
        let mut runs: Vec<[u32; 2]> = Vec::new();
        for cell in self.cells() {
            #[expect(clippy::cast_possible_truncation, reason = "a grid has under 2^32 cells")]
            let cell = cell as u32;
            match runs.last_mut() {
                Some([first, count]) if *first + *count == cell => *count += 1,
                _ => runs.push([cell, 1]),
            }
        }
        runs
    }

    /// The smallest box around the set in a grid of this width; all 0 if the set is empty.
    #[must_use]
    pub fn bounds(&self, width: usize) -> Box2 {
        let mut bounds: Option<Box2> = None;
        for cell in self.cells() {
            let (x, y) = (narrow(cell % width.max(1)), narrow(cell / width.max(1)));
            bounds = Some(match bounds {
                None => Box2 { x0: x, y0: y, x1: x, y1: y },
                Some(b) => Box2 { x0: b.x0.min(x), y0: b.y0, x1: b.x1.max(x), y1: y },
            });
        }
        bounds.unwrap_or_default()
    }
}

impl Box2 {
    /// Area between the first and the last columns and rows, as Segment Anything counts it.
    fn area(self) -> u64 {
        u64::from(self.x1 - self.x0) * u64::from(self.y1 - self.y0)
    }

    /// Intersection over union of two boxes, as torchvision counts it; 0 where both are empty.
    #[must_use]
    pub fn iou(self, other: Self) -> f32 {
        let overlap =
            |a0: u32, a1: u32, b0: u32, b1: u32| u64::from(a1.min(b1).saturating_sub(a0.max(b0)));
        let common = overlap(self.x0, self.x1, other.x0, other.x1)
            * overlap(self.y0, self.y1, other.y0, other.y1);
        let all = self.area() + other.area() - common;
        if all == 0 { 0.0 } else { common as f32 / all as f32 }
    }
}

fn narrow(n: usize) -> u32 {
    u32::try_from(n).unwrap_or(u32::MAX)
}
