//! Stage 3: where the tile pairs of each visible Gaussian start. Shader: `shaders/prefix_sum.wgsl`

/// Writes the exclusive prefix sum of `counts` into `offsets` (one longer). Returns the total. The
/// caller checks that the total fits its budget before it uses the offsets.
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
