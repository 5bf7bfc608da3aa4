//! A lens: focal length and one radial term about the photo's middle.

use nalgebra::{Matrix2, Matrix2x3, Vector2, Vector3};

/// Pixels from the photo's middle are `f (1 + k1 r²) (x, y)` of a direction (x, y, 1).
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Lens {
    pub(crate) focal: f64,
    pub(crate) k1: f64,
}

impl Lens {
    /// Pixels from the middle of a direction on the plane z = 1.
    pub(crate) fn pixel(&self, d: &Vector2<f64>) -> Vector2<f64> {
        d * (self.focal * (1.0 + self.k1 * d.norm_squared()))
    }

    /// Pixels from the middle of a point of the camera, where it is in front.
    pub(crate) fn project(&self, point: &Vector3<f64>) -> Option<Vector2<f64>> {
        (point.z > 1e-9).then(|| self.pixel(&(point.xy() / point.z)))
    }

    /// The direction, on the plane z = 1, that is seen at a pixel from the middle.
    pub(crate) fn direction(&self, pixel: &Vector2<f64>) -> Vector2<f64> {
        let seen = pixel / self.focal;
        let mut d = seen;
        for _ in 0..8 {
            d = seen / (1.0 + self.k1 * d.norm_squared()).max(0.2);
        }
        d
    }

    /// The pixel and its derivatives by the point of the camera, by ln(focal) and by k1.
    pub(crate) fn derivatives(
        &self,
        point: &Vector3<f64>,
    ) -> Option<(Vector2<f64>, Matrix2x3<f64>, Matrix2<f64>)> {
        if point.z <= 1e-9 {
            return None;
        }
        let d = point.xy() / point.z;
        let r2 = d.norm_squared();
        let stretch = 1.0 + self.k1 * r2;
        let pixel = d * (self.focal * stretch);
        let by_d =
            (Matrix2::identity() * stretch + d * d.transpose() * (2.0 * self.k1)) * self.focal;
        let z = 1.0 / point.z;
        let d_by_point = Matrix2x3::new(z, 0.0, -d.x * z, 0.0, z, -d.y * z);
        let by_lens = Matrix2::from_columns(&[pixel, d * (self.focal * r2)]);
        Some((pixel, by_d * d_by_point, by_lens))
    }
}
