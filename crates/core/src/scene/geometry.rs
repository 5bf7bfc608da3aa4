//! The output of the geometry network for one photo: a Gaussian for each pixel, in a rigid frame.

use crate::scene::{Camera, CameraToWorld};

/// Gaussians of one photo, one for each pixel of the network's picture, row-major. Lengths and
/// positions are in world units already; only the rigid motion `frame_to_world` lies between them
/// and the world. Nothing here is checked: a network may say anything.
#[derive(Clone, Debug)]
pub struct ViewGaussians {
    /// Index of the photo in the scene.
    pub photo: u16,
    /// Camera of the network's picture, `H` x `W` pixels.
    pub camera: Camera,
    /// From the frame of `means`, `quats` and `sh` to the world.
    pub frame_to_world: CameraToWorld,
    /// Nearest and farthest depth that was searched, z of `camera`, world units.
    pub near_far: [f64; 2],
    /// `[H * W, 3]` centres, world units.
    pub means: Vec<[f32; 3]>,
    /// `[H * W, 3]` standard deviations, world units.
    pub scales: Vec<[f32; 3]>,
    /// `[H * W, 4]` rotations, wxyz.
    pub quats: Vec<[f32; 4]>,
    /// `[H * W]` opacities.
    pub opacities: Vec<f32>,
    /// Degree of the spherical harmonics, 0..=3.
    pub sh_degree: u8,
    /// `[H * W, K, 3]` coefficients, K = (degree + 1)².
    pub sh: Vec<[f32; 3]>,
    /// `[H * W]` how sure the network is of the depth, 0..1.
    pub confidence: Vec<f32>,
    /// `[H * W]`, false where the picture has no source pixel; `None` when all have one.
    pub valid: Option<Vec<bool>>,
}

impl ViewGaussians {
    /// Pixels, and so Gaussians.
    pub fn len(&self) -> usize {
        self.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.means.is_empty()
    }
}
