//! Gaussians as a struct of arrays, world frame, f32 relative to an f64 origin.

use std::sync::{
    Arc, Weak,
    atomic::{AtomicU64, Ordering},
};

use glam::DVec3;

use crate::error::{Error, ErrorCode, Result};

/// What every renderer adds to both diagonal entries of the 2D covariance, px²: a Gaussian covers
/// at least a pixel. The network learns its Gaussians together with it.
pub const BLUR_PX2: f32 = 0.3;
/// Spherical harmonics of degree 0: 1 / (2 √π).
pub const SH_C0: f32 = 0.282_094_79;

/// The view and pixel (of the network's input picture) that made a Gaussian.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SourcePixel {
    /// Index of the photo in the scene.
    pub view: u16,
    /// Column in the network's picture of that view.
    pub x: u16,
    /// Row in the network's picture of that view.
    pub y: u16,
}

/// Unchecked Gaussians: what a network or a file gave.
#[derive(Clone, Debug, Default)]
pub struct RawGaussians {
    /// World position of the origin that `means` are relative to.
    pub origin: DVec3,
    /// `[N, 3]` centres, world axes, relative to `origin`.
    pub means: Vec<[f32; 3]>,
    /// `[N, 4]` rotations, wxyz.
    pub quats: Vec<[f32; 4]>,
    /// `[N, 3]` standard deviations, linear, world units.
    pub scales: Vec<[f32; 3]>,
    /// `[N]` opacity, 0..1.
    pub opacities: Vec<f32>,
    /// Degree of the spherical harmonics, 0..=3.
    pub sh_degree: u8,
    /// `[N, K, 3]` with K = (degree + 1)², 3DGS basis and order, world frame.
    pub sh: Vec<[f32; 3]>,
    /// `[N]` index into the semantic bank, 0 = background.
    pub semantic_index: Vec<u16>,
    /// `[N]` where each came from.
    pub source: Vec<SourcePixel>,
}

/// How many Gaussians were dropped or changed on the way in, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct SanitizeReport {
    /// A mean, quaternion, scale, opacity or colour was NaN or infinite.
    pub not_finite: u64,
    /// A mean was farther than [`Gaussians::COORDINATE_MAX`] from the origin.
    pub too_far: u64,
    /// Opacity under 1/255: it can never be seen.
    pub transparent: u64,
    /// The quaternion's norm was zero.
    pub zero_quat: u64,
    /// A scale was zero or negative.
    pub zero_scale: u64,
    /// Opacity over 1 was clamped to 1 (kept).
    pub opacity_clamped: u64,
    /// A scale was clamped into range (kept).
    pub scale_clamped: u64,
}

impl SanitizeReport {
    /// Reasons and counts, for the health report.
    #[must_use]
    pub fn counts(&self) -> [(&'static str, u64); 7] {
        [
            ("not_finite", self.not_finite),
            ("too_far", self.too_far),
            ("opacity_below_1_255", self.transparent),
            ("zero_quat", self.zero_quat),
            ("zero_scale", self.zero_scale),
            ("opacity_clamped", self.opacity_clamped),
            ("scale_clamped", self.scale_clamped),
        ]
    }
}

/// Checked Gaussians: finite, unit quaternions, positive scales, opacity in [1/255, 1].
///
/// Nothing below checks again.
#[derive(Clone, Debug, Default)]
pub struct Gaussians {
    raw: RawGaussians,
    identity: u64,
    /// Shared by Gaussians that differ in their bank indices only.
    shape: u64,
    /// Shared by clones: see [`Self::life`].
    life: Arc<()>,
}

/// Source of [`Gaussians::identity`] and [`Gaussians::shape_identity`]; 0 is the empty default.
static NEXT_IDENTITY: AtomicU64 = AtomicU64::new(1);

impl Gaussians {
    /// Largest |coordinate| of a mean relative to the origin, world units.
    pub const COORDINATE_MAX: f32 = 1e9;
    /// Smallest scale kept: under it a variance leaves f32's normal range when squared.
    pub const SCALE_MIN: f32 = 1e-12;
    /// Largest scale kept.
    pub const SCALE_MAX: f32 = 1e9;
    /// Smallest opacity that can be seen.
    pub const OPACITY_MIN: f32 = 1.0 / 255.0;
    /// Largest |coefficient| of a spherical harmonic.
    pub const SH_MAX: f32 = 1e4;

    fn new(raw: RawGaussians) -> Self {
        let identity = NEXT_IDENTITY.fetch_add(1, Ordering::Relaxed);
        Self { raw, identity, shape: identity, life: Arc::default() }
    }

    /// Drops what can never be drawn, clamps what is out of range, counts both.
    ///
    /// # Errors
    /// `internal` when the arrays' lengths disagree or the SH degree is over 3.
    #[expect(
        clippy::needless_pass_by_value,
        reason = "the unchecked arrays are given up, so that nothing uses them any more"
    )]
    pub fn sanitize(raw: RawGaussians) -> Result<(Self, SanitizeReport)> {
        let n = raw.means.len();
        let k = (usize::from(raw.sh_degree) + 1).pow(2);
        let lengths = [
            ("quats", raw.quats.len(), n),
            ("scales", raw.scales.len(), n),
            ("opacities", raw.opacities.len(), n),
            ("sh", raw.sh.len(), n * k),
            ("semantic_index", raw.semantic_index.len(), n),
            ("source", raw.source.len(), n),
        ];
        for (name, got, want) in lengths {
            if got != want {
                return Err(Error::internal(format!(
                    "gaussians: {name} has {got} rows, not {want}"
                )));
            }
        }
        if raw.sh_degree > 3 {
            return Err(Error::internal(format!(
                "gaussians: SH degree {} is over 3",
                raw.sh_degree
            )));
        }
        let mut report = SanitizeReport::default();
        let mut kept =
            RawGaussians { origin: raw.origin, sh_degree: raw.sh_degree, ..Default::default() };
        for i in 0..n {
            if let Some((quat, scales, opacity)) = check_one(&raw, i, k, &mut report) {
                kept.means.push(raw.means[i]);
                kept.quats.push(quat);
                kept.scales.push(scales);
                kept.opacities.push(opacity);
                kept.sh.extend_from_slice(&raw.sh[i * k..(i + 1) * k]);
                kept.semantic_index.push(raw.semantic_index[i]);
                kept.source.push(raw.source[i]);
            }
        }
        Ok((Self::new(kept), report))
    }

    /// Takes back what [`Self::into_raw`] gave, bit for bit.
    ///
    /// # Errors
    /// `scene_corrupt` when a Gaussian breaks what [`Self::sanitize`] promises, or lengths differ.
    pub fn restore(raw: RawGaussians) -> Result<Self> {
        let bad = |what: String| Error::new(ErrorCode::SceneCorrupt, format!("gaussians: {what}"));
        let k = (usize::from(raw.sh_degree) + 1).pow(2);
        let lengths = [raw.quats.len(), raw.scales.len(), raw.opacities.len()];
        let n = raw.means.len();
        let equal = lengths.iter().all(|&len| len == n)
            && raw.sh_degree <= 3
            && raw.sh.len() == n * k
            && raw.semantic_index.len() == n
            && raw.source.len() == n;
        if !equal || !raw.origin.is_finite() {
            return Err(bad(format!("arrays of unequal length, or origin {}", raw.origin)));
        }
        let mut report = SanitizeReport::default();
        for i in 0..n {
            let kept = check_one(&raw, i, k, &mut report);
            let same = kept.is_some_and(|(quat, scale, opacity)| {
                let turned = quat.iter().zip(&raw.quats[i]).any(|(a, b)| (a - b).abs() > 1e-5);
                !turned && scale == raw.scales[i] && opacity.total_cmp(&raw.opacities[i]).is_eq()
            });
            if !same {
                return Err(bad(format!("number {i} is out of range")));
            }
        }
        Ok(Self::new(raw))
    }

    /// The Gaussians whose index `keep` takes, in their order.
    #[must_use]
    pub fn only(&self, keep: impl Fn(usize) -> bool) -> Self {
        let (k, all) = (self.sh_count(), &self.raw);
        let mut raw =
            RawGaussians { origin: all.origin, sh_degree: all.sh_degree, ..Default::default() };
        for i in (0..self.len()).filter(|&i| keep(i)) {
            raw.means.push(all.means[i]);
            raw.quats.push(all.quats[i]);
            raw.scales.push(all.scales[i]);
            raw.opacities.push(all.opacities[i]);
            raw.sh.extend_from_slice(&all.sh[i * k..(i + 1) * k]);
            raw.semantic_index.push(all.semantic_index[i]);
            raw.source.push(all.source[i]);
        }
        Self::new(raw)
    }

    /// The same Gaussians with other scales, `[N, 3]`, clamped into range.
    ///
    /// # Panics
    /// When the number of scales is another: a bug of the caller.
    #[must_use]
    #[expect(clippy::manual_clamp, reason = "`clamp` would keep a NaN; this makes it the smallest")]
    pub fn with_scales(&self, mut scales: Vec<[f32; 3]>) -> Self {
        assert_eq!(scales.len(), self.len(), "one scale a Gaussian; this is a bug");
        for scale in scales.iter_mut().flatten() {
            *scale = scale.max(Self::SCALE_MIN).min(Self::SCALE_MAX);
        }
        Self::new(RawGaussians { scales, ..self.raw.clone() })
    }

    /// The same Gaussians with other bank indices, `[N]`.
    ///
    /// # Errors
    /// `internal` when the number of indices is another.
    pub fn with_semantic_index(&self, semantic_index: Vec<u16>) -> Result<Self> {
        if semantic_index.len() != self.len() {
            return Err(Error::internal(format!(
                "gaussians: semantic_index has {} rows, not {}",
                semantic_index.len(),
                self.len()
            )));
        }
        Ok(Self {
            raw: RawGaussians { semantic_index, ..self.raw.clone() },
            identity: NEXT_IDENTITY.fetch_add(1, Ordering::Relaxed),
            shape: self.shape,
            life: Arc::default(),
        })
    }

    /// Number that no other content of this process has; clones share it, for they cannot change.
    ///
    /// A renderer keeps what it uploaded under this number.
    #[must_use]
    pub fn identity(&self) -> u64 {
        self.identity
    }

    /// As [`Self::identity`], but shared by Gaussians that differ in `semantic_index` only.
    #[must_use]
    pub fn shape_identity(&self) -> u64 {
        self.shape
    }

    /// Lives as long as any Gaussians of this identity do.
    #[must_use]
    pub fn life(&self) -> Weak<()> {
        Arc::downgrade(&self.life)
    }

    /// Number of Gaussians.
    #[must_use]
    pub fn len(&self) -> usize {
        self.raw.means.len()
    }

    /// Whether there are none.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.raw.means.is_empty()
    }

    /// World position that `means` are relative to.
    #[must_use]
    pub fn origin(&self) -> DVec3 {
        self.raw.origin
    }

    /// `[N, 3]` centres relative to the origin.
    #[must_use]
    pub fn means(&self) -> &[[f32; 3]] {
        &self.raw.means
    }

    /// `[N, 4]` unit quaternions, wxyz.
    #[must_use]
    pub fn quats(&self) -> &[[f32; 4]] {
        &self.raw.quats
    }

    /// `[N, 3]` standard deviations.
    #[must_use]
    pub fn scales(&self) -> &[[f32; 3]] {
        &self.raw.scales
    }

    /// `[N]` opacities.
    #[must_use]
    pub fn opacities(&self) -> &[f32] {
        &self.raw.opacities
    }

    /// Degree of the spherical harmonics.
    #[must_use]
    pub fn sh_degree(&self) -> u8 {
        self.raw.sh_degree
    }

    /// Coefficients a Gaussian: (degree + 1)².
    #[must_use]
    pub fn sh_count(&self) -> usize {
        (usize::from(self.raw.sh_degree) + 1).pow(2)
    }

    /// `[N, K, 3]` coefficients, flattened over N and K.
    #[must_use]
    pub fn sh(&self) -> &[[f32; 3]] {
        &self.raw.sh
    }

    /// `[N]` bank indices.
    #[must_use]
    pub fn semantic_index(&self) -> &[u16] {
        &self.raw.semantic_index
    }

    /// `[N]` sources.
    #[must_use]
    pub fn source(&self) -> &[SourcePixel] {
        &self.raw.source
    }

    /// The arrays, for a stage that makes new Gaussians of them.
    #[must_use]
    pub fn into_raw(self) -> RawGaussians {
        self.raw
    }

    /// The arrays.
    #[must_use]
    pub fn as_raw(&self) -> &RawGaussians {
        &self.raw
    }

    /// Bytes held.
    #[must_use]
    pub fn size_bytes(&self) -> u64 {
        let each = 12 + 16 + 12 + 4 + 2 + 6 + 12 * self.sh_count();
        (self.len() * each) as u64
    }
}

/// Checks Gaussian `i`; what to keep of it, or `None` after counting why not.
fn check_one(
    raw: &RawGaussians,
    i: usize,
    k: usize,
    report: &mut SanitizeReport,
) -> Option<([f32; 4], [f32; 3], f32)> {
    let (mean, quat, scale, opacity) =
        (raw.means[i], raw.quats[i], raw.scales[i], raw.opacities[i]);
    let sh = &raw.sh[i * k..(i + 1) * k];
    let finite = mean.iter().chain(&quat).chain(&scale).all(|v| v.is_finite())
        && opacity.is_finite()
        && sh.iter().flatten().all(|v| v.is_finite() && v.abs() <= Gaussians::SH_MAX);
    if !finite {
        report.not_finite += 1;
        return None;
    }
    if mean.iter().any(|v| v.abs() > Gaussians::COORDINATE_MAX) {
        report.too_far += 1;
        return None;
    }
    if opacity < Gaussians::OPACITY_MIN {
        report.transparent += 1;
        return None;
    }
    let norm = quat.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>().sqrt();
    if norm < 1e-12 {
        report.zero_quat += 1;
        return None;
    }
    if scale.iter().any(|&v| v <= 0.0) {
        report.zero_scale += 1;
        return None;
    }
    let clamped = scale.map(|v| v.clamp(Gaussians::SCALE_MIN, Gaussians::SCALE_MAX));
    if clamped != scale {
        report.scale_clamped += 1;
    }
    if opacity > 1.0 {
        report.opacity_clamped += 1;
    }
    #[expect(clippy::cast_possible_truncation, reason = "a unit quaternion fits f32")]
    let unit = quat.map(|v| (f64::from(v) / norm) as f32);
    Some((unit, clamped, opacity.min(1.0)))
}
