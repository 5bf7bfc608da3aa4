//! The backdrop: the photos' colours by direction, for rays that meet no Gaussian.
//!
//! A small map over longitude and latitude about the world's y axis. It has no parallax. The alpha
//! of a view says where it shows. Where no photo looked, the nearest colours spread (see
//! `lift::backdrop`).

use std::f64::consts::{PI, TAU};

use glam::DVec3;

use crate::error::{Error, ErrorCode, Result};

/// Colours by direction, sRGB as the photos are.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Backdrop {
    /// `[HEIGHT * WIDTH]`, rows from -y to +y.
    rgb: Vec<[u8; 3]>,
}

impl Default for Backdrop {
    /// Black.
    fn default() -> Self {
        Self { rgb: vec![[0; 3]; Self::WIDTH * Self::HEIGHT] }
    }
}

impl Backdrop {
    /// Cells of longitude.
    pub const WIDTH: usize = 128;
    /// Cells of latitude.
    pub const HEIGHT: usize = 64;

    /// From `[HEIGHT * WIDTH]` colours.
    ///
    /// # Errors
    /// `scene_corrupt` when the number of cells is another.
    pub fn from_cells(rgb: Vec<[u8; 3]>) -> Result<Self> {
        let cells = Self::WIDTH * Self::HEIGHT;
        if rgb.len() != cells {
            return Err(Error::new(
                ErrorCode::SceneCorrupt,
                format!("the backdrop has {} cells, not {cells}", rgb.len()),
            ));
        }
        Ok(Self { rgb })
    }

    /// The cells, `[HEIGHT * WIDTH]`.
    pub fn cells(&self) -> &[[u8; 3]] {
        &self.rgb
    }

    /// Position of a direction in the map: cells along longitude and latitude, centres at +0.5.
    pub fn position(direction: DVec3) -> (f64, f64) {
        let longitude = direction.x.atan2(direction.z);
        let flat = direction.x.hypot(direction.z);
        let latitude = direction.y.atan2(flat);
        ((longitude / TAU + 0.5) * Self::WIDTH as f64, (latitude / PI + 0.5) * Self::HEIGHT as f64)
    }

    /// Bilinear colour in a world direction (any length but 0), 0..1.
    pub fn color(&self, direction: DVec3) -> [f32; 3] {
        let (u, v) = Self::position(direction);
        let (u, v) = (u - 0.5, (v - 0.5).clamp(0.0, (Self::HEIGHT - 1) as f64));
        let (u0, v0) = (u.floor(), v.floor());
        let (fu, fv) = ((u - u0) as f32, (v - v0) as f32);
        let (x0, y0) = ((u0 as i64).rem_euclid(Self::WIDTH as i64) as usize, v0 as usize);
        let (x1, y1) = ((x0 + 1) % Self::WIDTH, (y0 + 1).min(Self::HEIGHT - 1));
        let at = |x: usize, y: usize, c: usize| f32::from(self.rgb[y * Self::WIDTH + x][c]) / 255.0;
        std::array::from_fn(|c| {
            let top = at(x0, y0, c) * (1.0 - fu) + at(x1, y0, c) * fu;
            let low = at(x0, y1, c) * (1.0 - fu) + at(x1, y1, c) * fu;
            top * (1.0 - fv) + low * fv
        })
    }
}
