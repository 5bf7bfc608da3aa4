//! The model frame: the first camera is the identity, and the manifest names the scale.

use glam::{DMat3, DMat4};

use crate::{
    error::{Error, Result},
    models::Translation,
    scene::CameraToWorld,
};

/// The similarity between the world and the model frame of one set of cameras.
#[derive(Clone, Copy, Debug)]
pub struct ModelFrame {
    first: CameraToWorld,
    /// World units in one model unit.
    unit: f64,
}

impl ModelFrame {
    /// The frame of `cameras`, the first of which becomes the identity. `near` is the nearest depth
    /// of their photos and `median_depth` the median one, world units.
    ///
    /// # Errors
    /// `invalid_request` when there is no camera, or all stand at one place and the scale is the
    /// largest baseline.
    pub fn new(
        cameras: &[CameraToWorld],
        translation: Translation,
        near: f64,
        median_depth: f64,
    ) -> Result<Self> {
        let first = *cameras
            .first()
            .ok_or_else(|| Error::invalid("a set of views must have at least one camera"))?;
        let unit = match translation {
            Translation::World => 1.0,
            Translation::LargestBaseline => largest_baseline(cameras),
            Translation::Near(units) => near / units,
            Translation::MedianDepth(units) => median_depth / units,
        };
        if !unit.is_finite() || unit <= 0.0 {
            return Err(Error::invalid(
                "the photos were all taken at one place: without a baseline there is no depth",
            ));
        }
        Ok(Self { first, unit })
    }

    /// World units in one model unit.
    #[must_use]
    pub fn unit(&self) -> f64 {
        self.unit
    }

    /// The model frame's rigid pose in the world: the first camera's.
    #[must_use]
    pub fn pose(&self) -> CameraToWorld {
        self.first
    }

    /// A camera's pose in the model frame.
    #[must_use]
    pub fn camera(&self, camera_to_world: &CameraToWorld) -> DMat4 {
        let back = self.first.rotation().transpose();
        let rotation: DMat3 = back * camera_to_world.rotation();
        let center = back * (camera_to_world.center() - self.first.center()) / self.unit;
        DMat4::from_cols(
            rotation.x_axis.extend(0.0),
            rotation.y_axis.extend(0.0),
            rotation.z_axis.extend(0.0),
            center.extend(1.0),
        )
    }
}

/// Largest distance between two of the cameras, world units.
fn largest_baseline(cameras: &[CameraToWorld]) -> f64 {
    let mut largest = 0.0_f64;
    for (i, a) in cameras.iter().enumerate() {
        for b in &cameras[..i] {
            largest = largest.max(a.center().distance(b.center()));
        }
    }
    largest
}
