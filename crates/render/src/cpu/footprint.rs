//! A Gaussian on the picture: what the stages of the CPU renderer pass on.

/// A Gaussian on the picture.
///
/// With d = pixel - mean, half the squared Mahalanobis distance is
/// `(conic_x · (d.x - conic_shear · d.y))² + (conic_y · d.y)²`: x given y, then y
/// (Cholesky). Unlike the conic `a d.x² + 2 b d.x d.y + c d.y²` it does not cancel for long
/// thin Gaussians.
///
/// One line of the cache each: the blend fetches them in no order of memory.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
#[repr(align(64))]
pub struct Footprint {
    /// Centre, pixels. f64: a tile subtracts its corner before it narrows.
    pub mean: [f64; 2],
    /// Covariance xy over variance y.
    pub conic_shear: f64,
    /// √(½ / variance of x given y), 1/px.
    pub conic_x: f32,
    /// √(½ / variance of y), 1/px.
    pub conic_y: f32,
    /// Half the squared distance at which alpha reaches 1/255, with slack.
    pub power_max: f32,
    /// Opacity, compensated in antialiased mode.
    pub opacity: f32,
    /// t.z, world units; also the sort key.
    pub depth: f32,
    /// Colour; filled by `shade`.
    pub color: [f32; 3],
}
