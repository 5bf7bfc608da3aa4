//! Sums over the rows of a bank.

use crate::scene::Bank;

/// Length of a row in f64.
pub(super) fn norm(row: &[f32]) -> f64 {
    dot(row, row).sqrt()
}

/// Dot product in f64.
pub(super) fn dot(a: &[f32], b: &[f32]) -> f64 {
    sum_of(a, b, |x, y| x * y)
}

/// Sum of a term of each pair in f64: four sums in a fixed order, so the bits are always the same.
pub(super) fn sum_of<B: Copy + Into<f64>>(
    a: &[f32],
    b: &[B],
    term: impl Fn(f64, f64) -> f64,
) -> f64 {
    let term = |(x, y): (&f32, &B)| term(f64::from(*x), (*y).into());
    let mut sums = [0.0_f64; 4];
    let ((quads_a, rest_a), (quads_b, rest_b)) = (a.as_chunks::<4>(), b.as_chunks::<4>());
    for pair in quads_a.iter().zip(quads_b) {
        for (sum, pair) in sums.iter_mut().zip(pair.0.iter().zip(pair.1)) {
            *sum += term(pair);
        }
    }
    let rest: f64 = rest_a.iter().zip(rest_b).map(term).sum();
    (sums[0] + sums[1]) + (sums[2] + sums[3]) + rest
}

/// Scales a row to length 1; whether it had a length. A row of zeros stays zero.
pub(super) fn scale_to_unit(row: &mut [f32]) -> bool {
    let length = norm(row);
    let has_length = length > 0.0;
    if has_length {
        #[expect(clippy::cast_possible_truncation, reason = "rows are f32")]
        row.iter_mut().for_each(|v| *v = (f64::from(*v) / length) as f32);
    }
    has_length
}

/// The rows scaled to length 1. A row of zeros stays zero.
pub(super) fn unit_rows(bank: &Bank) -> Vec<f32> {
    let mut rows = bank.rows.clone();
    for row in rows.chunks_exact_mut(bank.dim.max(1)) {
        scale_to_unit(row);
    }
    rows
}

/// Mean of rows of `dim` numbers, summed in their order; zeros where there are none.
#[must_use]
pub fn mean_row<'a>(rows: impl Iterator<Item = &'a [f32]>, dim: usize) -> Vec<f32> {
    let (mut sums, mut count) = (vec![0.0_f64; dim], 0.0_f64);
    for row in rows {
        count += 1.0;
        sums.iter_mut().zip(row).for_each(|(sum, v)| *sum += f64::from(*v));
    }
    #[expect(clippy::cast_possible_truncation, reason = "rows are f32")]
    sums.into_iter().map(|sum| (sum / count.max(1.0)) as f32).collect()
}
