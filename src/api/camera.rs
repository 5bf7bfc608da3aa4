//! Which camera fields go together, for the query string and JSON bodies alike.

use serde::Deserialize;

use crate::{
    error::{Error, Result},
    service::{CameraSpec, LensSpec, PoseSpec},
};

/// A camera as its separate fields; [`CameraFields::spec`] says which go together.
#[derive(Clone, Debug, Default, PartialEq, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct CameraFields {
    /// 16 numbers, row-major, OpenCV camera-to-world.
    pub(super) camera_to_world: Option<[f64; 16]>,
    /// Camera centre.
    pub(super) eye: Option<[f64; 3]>,
    /// Point looked at.
    pub(super) target: Option<[f64; 3]>,
    /// Up in the picture.
    pub(super) up: Option<[f64; 3]>,
    /// Index of an input camera.
    pub(super) from: Option<usize>,
    /// Index of another input camera.
    pub(super) to: Option<usize>,
    /// 0 at `from`, 1 at `to`.
    pub(super) t: Option<f64>,
    /// Focal length along x, pixels.
    pub(super) fx: Option<f64>,
    /// Focal length along y, pixels.
    pub(super) fy: Option<f64>,
    /// Principal point x, pixels.
    pub(super) cx: Option<f64>,
    /// Principal point y, pixels.
    pub(super) cy: Option<f64>,
    /// Vertical field of view, degrees.
    pub(super) fov: Option<f64>,
}

impl CameraFields {
    /// The camera these fields name. `what` starts the messages.
    pub(super) fn spec(&self, what: &str) -> Result<CameraSpec> {
        Ok(CameraSpec { pose: self.pose(what)?, lens: self.lens(what)? })
    }

    fn pose(&self, what: &str) -> Result<PoseSpec> {
        let matrix = self.camera_to_world.is_some();
        let look = self.eye.is_some() || self.target.is_some() || self.up.is_some();
        let between = self.from.is_some() || self.to.is_some() || self.t.is_some();
        match (matrix, look, between) {
            (false, false, false) => Err(Error::invalid(format!(
                "{what}: no pose given; give camera_to_world, or eye and target, or from"
            ))),
            (true, false, false) => {
                Ok(PoseSpec::CameraToWorld(self.camera_to_world.unwrap_or_default()))
            }
            (false, true, false) => {
                let (Some(eye), Some(target)) = (self.eye, self.target) else {
                    return Err(Error::invalid(format!("{what}: eye and target go together")));
                };
                Ok(PoseSpec::LookAt { eye, target, up: self.up })
            }
            (false, false, true) => {
                let Some(from) = self.from else {
                    return Err(Error::invalid(format!("{what}: to and t need from")));
                };
                Ok(PoseSpec::Between {
                    from,
                    to: self.to.unwrap_or(from),
                    t: self.t.unwrap_or(0.0),
                })
            }
            _ => Err(Error::invalid(format!(
                "{what}: give one of camera_to_world, eye and target, from and to; not several"
            ))),
        }
    }

    fn lens(&self, what: &str) -> Result<LensSpec> {
        match (self.fx, self.fov) {
            (Some(_), Some(_)) => Err(Error::invalid(format!("{what}: give fx or fov, not both"))),
            (Some(fx), None) => Ok(LensSpec::Focal { fx, fy: self.fy, cx: self.cx, cy: self.cy }),
            (None, _) if self.fy.is_some() || self.cx.is_some() || self.cy.is_some() => {
                Err(Error::invalid(format!("{what}: fy, cx and cy need fx")))
            }
            (None, Some(fov)) => Ok(LensSpec::Fov(fov)),
            (None, None) => Ok(LensSpec::OfScene),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn fields_that_do_not_go_together_are_refused_by_name() {
        let eye = Some([0.0, 0.0, -1.0]);
        let cases = [
            (CameraFields::default(), "no pose given"),
            (CameraFields { eye, ..Default::default() }, "eye and target go together"),
            (CameraFields { t: Some(0.5), ..Default::default() }, "need from"),
            (CameraFields { eye, from: Some(0), ..Default::default() }, "not several"),
            (CameraFields { from: Some(0), cx: Some(1.0), ..Default::default() }, "need fx"),
            (
                CameraFields {
                    from: Some(0),
                    fx: Some(1.0),
                    fov: Some(50.0),
                    ..Default::default()
                },
                "not both",
            ),
        ];
        for (fields, part) in cases {
            let error = fields.spec("view").expect_err("refused");
            assert!(error.message().contains(part), "{} lacks {part}", error.message());
        }
        let spec = CameraFields { from: Some(2), ..Default::default() }.spec("view").unwrap();
        assert_eq!(spec.pose, PoseSpec::Between { from: 2, to: 2, t: 0.0 });
        assert_eq!(spec.lens, LensSpec::OfScene);
    }
}
