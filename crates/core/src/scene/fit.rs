//! Planes through points that lie near one.

use glam::{DMat3, DVec3};

/// The three numbers whose products with the rows come nearest to the values: the weighted least
/// squares of (row, value, weight). `None` where the rows do not tell them.
#[must_use]
pub fn least_squares(rows: impl Iterator<Item = (DVec3, f64, f64)>) -> Option<DVec3> {
    let (mut square, mut side) = (DMat3::ZERO, DVec3::ZERO);
    for (row, value, weight) in rows {
        let weighed = row * weight;
        square += DMat3::from_cols(weighed * row.x, weighed * row.y, weighed * row.z);
        side += weighed * value;
    }
    let found = square.inverse() * side;
    (square.determinant() > 0.0 && found.is_finite()).then_some(found)
}

/// How much one that is off by so much counts where `most` is too much: Tukey's biweight.
#[must_use]
pub fn biweight(off: f64, most: f64) -> f64 {
    (1.0 - (off / most).powi(2)).max(0.0).powi(2)
}
