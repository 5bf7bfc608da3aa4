//! Random numbers that a seed fixes (`SplitMix64`).

/// A small generator: good enough to draw samples, the same on every machine.
#[derive(Clone, Debug)]
pub(crate) struct Rng(u64);

impl Rng {
    /// A generator for work number `stream` under `seed`.
    pub(crate) fn new(seed: u64, stream: u64) -> Self {
        let mut rng = Self(seed ^ stream.wrapping_mul(0x9e37_79b9_7f4a_7c15));
        rng.next();
        rng
    }

    fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// A number below `bound` (at least 1).
    pub(crate) fn below(&mut self, bound: usize) -> usize {
        (((u128::from(self.next())) * bound as u128) >> 64) as usize
    }

    /// `K` different numbers below `bound`, which is at least `K`.
    pub(crate) fn sample<const K: usize>(&mut self, bound: usize) -> [usize; K] {
        let mut picked = [usize::MAX; K];
        for i in 0..K {
            picked[i] = loop {
                let index = self.below(bound);
                if !picked[..i].contains(&index) {
                    break index;
                }
            };
        }
        picked
    }
}
