//! The backward pass of the one model: from what a loss says of a frame to what it says of the
//! Gaussians.
//!
//! An oracle in `tests/support` judges the others: f64, pixel by pixel. Finite differences of the
//! forward oracle judge it. [`crate::cpu::backward`] is the tiled kernel, shaders/*_backward.wgsl
//! its twin. A renderer that has a backward pass is a [`crate::DifferentiableRenderer`].
//!
//! For a pixel with Gaussians i front to back, `w_i = alpha_i T_i`, `A = sum w_i` and `B` behind:
//! the colour is `sum w_i c_i + (1 - A) B`, the depth `sum w_i z_i / A`. With `g` for what the loss
//! says of each, a weight is worth
//! `v_i = g_color . (c_i - B) + g_depth (z_i - depth) / A + g_alpha`, so
//! `dL/dalpha_i = T_i v_i - sum_{j>i} w_j v_j / (1 - alpha_i)`.
//!
//! What is constant has no gradient: which Gaussians count (1/255, the end of a ray, the order, the
//! near plane), an alpha at its largest, a colour at 0, and what lies behind.

use crate::{
    Frame, Kinds, Labels, RenderRequest, Samples,
    constants::{SH_C1, SH_C2, SH_C3},
    error::{Error, Result},
};

/// What a loss says of a frame: its derivative by each number of the pictures, `[H * W]`; `None`
/// where it does not depend on a picture.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct FrameGradients {
    /// By colours over the background.
    pub color: Option<Vec<[f32; 3]>>,
    /// By expected depths; not counted where alpha is 0.
    pub depth: Option<Vec<f32>>,
    /// By accumulated opacities.
    pub alpha: Option<Vec<f32>>,
}

impl FrameGradients {
    /// Refuses pictures of another size than `pixels`.
    ///
    /// # Errors
    /// `internal`, with both numbers.
    pub fn check(&self, pixels: usize) -> Result<()> {
        let lengths = [
            ("color", self.color.as_ref().map(Vec::len)),
            ("depth", self.depth.as_ref().map(Vec::len)),
            ("alpha", self.alpha.as_ref().map(Vec::len)),
        ];
        match lengths.into_iter().find(|(_, length)| length.is_some_and(|n| n != pixels)) {
            None => Ok(()),
            Some((name, length)) => Err(Error::internal(format!(
                "backward: {name} has {} pixels, not {pixels}",
                length.unwrap_or_default()
            ))),
        }
    }

    /// Refuses pictures of another size than those of `frame`, and depth where it has none.
    pub(crate) fn check_of(&self, frame: &Frame) -> Result<()> {
        if self.depth.is_some() && frame.depth.is_none() {
            return Err(Error::internal("backward: the loss depends on depth, which is not drawn"));
        }
        self.check(frame.width as usize * frame.height as usize)
    }
}

/// Derivatives of a loss by the numbers of Gaussians, in the order of [`crate::scene::Gaussians`];
/// all finite, 0 where a Gaussian adds to no pixel.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Gradients<T = f32> {
    /// `[N, 3]` by centres, 1 / world units.
    pub means: Vec<[T; 3]>,
    /// `[N, 4]` by quaternions, wxyz, at right angles to them: length does not count.
    pub quats: Vec<[T; 4]>,
    /// `[N, 3]` by linear scales, 1 / world units.
    pub scales: Vec<[T; 3]>,
    /// `[N]` by opacities.
    pub opacities: Vec<T>,
    /// `[N, K, 3]` by coefficients of the harmonics.
    pub sh: Vec<[T; 3]>,
    /// `[N]` whether the footprint touches the picture.
    pub seen: Vec<bool>,
}

impl<T: Copy + Default> Gradients<T> {
    /// Zeros for `count` Gaussians of `sh_count` coefficients, in the memory that is there.
    pub fn clear(&mut self, count: usize, sh_count: usize) {
        fn zeros<N: Copy + Default>(numbers: &mut Vec<N>, count: usize) {
            numbers.clear();
            numbers.resize(count, N::default());
        }
        zeros(&mut self.means, count);
        zeros(&mut self.quats, count);
        zeros(&mut self.scales, count);
        zeros(&mut self.opacities, count);
        zeros(&mut self.sh, count * sh_count);
        zeros(&mut self.seen, count);
    }
}

/// The request as it is drawn for a backward pass.
pub(crate) fn backward_request(request: &RenderRequest) -> RenderRequest {
    let kinds = Kinds { depth: request.kinds.depth, ..Kinds { depth: false, ..Kinds::ALL } };
    let (labels, samples) = (Labels::None, Samples::F32);
    RenderRequest { kinds, labels, samples, error: 0.0, detail: 0.0, ..request.clone() }
}

/// Derivatives of the 16 basis functions up to degree 3 by the unit direction (x, y, z).
pub fn basis_slopes([x, y, z]: [f64; 3]) -> [[f64; 3]; 16] {
    let c1 = f64::from(SH_C1);
    let a = SH_C2.map(f64::from);
    let b = SH_C3.map(f64::from);
    let (xx, yy, zz) = (x * x, y * y, z * z);
    let scaled = |c: f64, v: [f64; 3]| [c * v[0], c * v[1], c * v[2]];
    [
        [0.0; 3],
        [0.0, -c1, 0.0],
        [0.0, 0.0, c1],
        [-c1, 0.0, 0.0],
        scaled(a[0], [y, x, 0.0]),
        scaled(a[1], [0.0, z, y]),
        scaled(a[2], [-2.0 * x, -2.0 * y, 4.0 * z]),
        scaled(a[3], [z, 0.0, x]),
        scaled(a[4], [2.0 * x, -2.0 * y, 0.0]),
        scaled(b[0], [6.0 * x * y, 3.0 * (xx - yy), 0.0]),
        scaled(b[1], [y * z, x * z, x * y]),
        scaled(b[2], [-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z]),
        scaled(b[3], [-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy]),
        scaled(b[4], [4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z]),
        scaled(b[5], [2.0 * x * z, -2.0 * y * z, xx - yy]),
        scaled(b[6], [3.0 * (xx - yy), -6.0 * x * y, 0.0]),
    ]
}
