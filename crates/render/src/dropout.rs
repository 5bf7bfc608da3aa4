//! Gaussians that a view leaves out by chance (Srivastava et al. 2014), as steps of training ask
//! for: docs/adr/0110. WGSL: `shaders/common/dropout.wgsl`.

/// Each Gaussian is left out with the same chance, by a hash of its number and of a seed alone: all
/// renderers leave out the same ones, each time. The default leaves out none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Dropout(u32);

impl Dropout {
    /// Leaves out none.
    pub const NONE: Self = Self(0);
    /// The chance in the upper bits, in steps of 1/256; below it the seed.
    const SEED_BITS: u32 = 24;

    /// Leaves out each with this chance, 0 to 255/256, rounded to 1/256. Of the seed the lower 24
    /// bits count.
    #[must_use]
    pub fn new(chance: f32, seed: u32) -> Self {
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..255")]
        let steps = (chance * 256.0).round().clamp(0.0, 255.0) as u32;
        if steps == 0 { Self::NONE } else { Self(steps << Self::SEED_BITS | seed & 0xff_ffff) }
    }

    /// Whether the view leaves out Gaussian number `i`.
    #[inline(always)]
    #[must_use]
    pub fn leaves_out(self, i: u32) -> bool {
        self.0 != 0 && mixed(i ^ mixed(self.0)) >> Self::SEED_BITS < self.0 >> Self::SEED_BITS
    }

    /// As the shaders have it.
    pub(crate) fn word(self) -> u32 {
        self.0
    }
}

/// A number that looks random: `lowbias32` of Wellons' hash prospector.
#[inline(always)]
fn mixed(mut x: u32) -> u32 {
    x ^= x >> 16;
    x = x.wrapping_mul(0x7feb_352d);
    x ^= x >> 15;
    x = x.wrapping_mul(0x846c_a68b);
    x ^ x >> 16
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_chosen_are_those_of_the_hash_and_as_many_as_the_chance_says() {
        let out = |dropout: Dropout, count: u32| -> Vec<u32> {
            (0..count).filter(|&i| dropout.leaves_out(i)).collect()
        };
        // As Python's whole numbers give them.
        assert_eq!(out(Dropout::new(0.15, 5), 60), [0, 3, 23, 28, 40, 48]);
        for chance in [0.15_f32, 0.5, 0.9] {
            for seed in 0..20 {
                let share = out(Dropout::new(chance, seed), 100_000).len() as f32 / 1e5;
                assert!((share - chance).abs() < 0.01, "{chance}: {share} of seed {seed}");
            }
        }
        assert!(out(Dropout::new(0.0, 5), 100).is_empty() && Dropout::new(0.0, 5) == Dropout::NONE);
    }
}
