//! COLMAP's sparse models: [`read`] of a capture, [`write`] of a scene.
//!
//! Formats: COLMAP's documentation, "Output Format". A pose is world-to-camera, a quaternion w x y
//! z and a translation, in OpenCV axes; the centre of the first pixel is (0.5, 0.5).

mod read;
mod write;

pub(crate) use self::{read::Colmap, write::write};
