//! Stage 3: where the tile pairs of each visible Gaussian start. Shader: `shaders/prefix_sum.wgsl`

/// Writes the exclusive prefix sum of `counts` into `offsets` (one longer). Returns the total.
///
/// The caller checks that the total fits its budget before it uses the offsets.
pub fn prefix_sum(counts: impl Iterator<Item = u32>, offsets: &mut Vec<u64>) -> u64 {
    offsets.clear();
    let mut total = 0;
    offsets.push(total);
    for count in counts {
        total += u64::from(count);
        offsets.push(total);
    }
    total
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_do_not_wrap_at_32_bits() {
        let mut offsets = vec![9];
        let total = prefix_sum([u32::MAX, 0, u32::MAX].into_iter(), &mut offsets);
        let max = u64::from(u32::MAX);
        assert_eq!(offsets, [0, max, max, 2 * max], "exclusive sums");
        assert_eq!(total, 2 * max, "total");
    }
}
