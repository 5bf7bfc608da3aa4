//! Gaussians as a struct of arrays, world frame, f32 relative to an f64 origin.

use std::sync::{
    Arc, Weak,
    atomic::{AtomicU64, Ordering},
};

use glam::DVec3;
use rayon::prelude::*;

use crate::error::{Error, ErrorCode, Result};

/// What every renderer adds to both numbers on the diagonal of the 2D covariance, px²: a Gaussian
/// covers at least a pixel. The network learns its Gaussians together with it.
pub const BLUR_PX2: f32 = 0.3;
/// Spherical harmonics of degree 0: 1 / (2 √π).
pub const SH_C0: f32 = 0.282_094_79;

/// The view and pixel (of the network's input picture) that a Gaussian comes from.
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
    /// `[N]` entry of the bank, 0 = background.
    pub semantic_index: Vec<u16>,
    /// `[N]` where each came from.
    pub source: Vec<SourcePixel>,
}

impl RawGaussians {
    /// Coefficients a Gaussian: (degree + 1)².
    pub(super) fn sh_count(&self) -> usize {
        (usize::from(self.sh_degree) + 1).pow(2)
    }

    /// The name, length and right length of an array that does not fit the others.
    fn unequal(&self) -> Option<(&'static str, usize, usize)> {
        let n = self.means.len();
        let lengths = [
            ("quats", self.quats.len(), n),
            ("scales", self.scales.len(), n),
            ("opacities", self.opacities.len(), n),
            ("sh", self.sh.len(), n * self.sh_count()),
            ("semantic_index", self.semantic_index.len(), n),
            ("source", self.source.len(), n),
        ];
        lengths.into_iter().find(|(_, got, want)| got != want)
    }

    /// Those with these numbers, in this order.
    fn picked(&self, ids: &[u32]) -> Self {
        fn of<T: Copy + Send + Sync>(from: &[T], ids: &[u32]) -> Vec<T> {
            ids.par_iter().map(|&i| from[i as usize]).collect()
        }
        let (k, [index, all]) = (self.sh_count(), [self.semantic_index.len(), self.means.len()]);
        let mut sh = vec![[0.0; 3]; k * ids.len()];
        sh.par_chunks_mut(k).zip(ids).for_each(|(row, &i)| {
            row.copy_from_slice(&self.sh[i as usize * k..(i as usize + 1) * k]);
        });
        Self {
            origin: self.origin,
            sh_degree: self.sh_degree,
            means: of(&self.means, ids),
            quats: of(&self.quats, ids),
            scales: of(&self.scales, ids),
            opacities: of(&self.opacities, ids),
            sh,
            semantic_index: if index == all { of(&self.semantic_index, ids) } else { Vec::new() },
            source: of(&self.source, ids),
        }
    }

    /// Adds Gaussians of the same origin and degree.
    pub(super) fn append(&mut self, more: Self) {
        self.means.extend(more.means);
        self.quats.extend(more.quats);
        self.scales.extend(more.scales);
        self.opacities.extend(more.opacities);
        self.sh.extend(more.sh);
        self.semantic_index.extend(more.semantic_index);
        self.source.extend(more.source);
    }

    /// The Gaussians whose number `keep` takes, in their order.
    pub(super) fn only(&self, keep: impl Fn(usize) -> bool) -> Self {
        self.picked(&taken(self.means.len(), keep))
    }
}

/// The numbers under `count` that `keep` takes.
fn taken(count: usize, keep: impl Fn(usize) -> bool) -> Vec<u32> {
    (0..count as u32).filter(|&i| keep(i as usize)).collect()
}

/// Gaussians that one thread checks at a time.
const PART: usize = 1 << 12;

/// Quaternion, scales and opacity of a Gaussian.
type Checked = ([f32; 4], [f32; 3], f32);
/// Mean, quaternion, scales, opacity and coefficients of a Gaussian.
type Unchecked<'a> = (&'a [f32; 3], &'a [f32; 4], &'a [f32; 3], f32, &'a [[f32; 3]]);
/// Parts of the arrays that checking changes, and of those that it reads only.
type Changed<'a> = ((&'a mut [[f32; 4]], &'a mut [[f32; 3]]), &'a mut [f32]);
type Given<'a> = (&'a [[f32; 3]], &'a [[f32; 3]]);

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
    fn add(&mut self, other: &Self) {
        self.not_finite += other.not_finite;
        self.too_far += other.too_far;
        self.transparent += other.transparent;
        self.zero_quat += other.zero_quat;
        self.zero_scale += other.zero_scale;
        self.opacity_clamped += other.opacity_clamped;
        self.scale_clamped += other.scale_clamped;
    }

    /// Reasons and counts, for the health report.
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

/// Checked Gaussians: finite, unit quaternions, positive scales, opacity in [1/255, 1]. Nothing
/// below checks again. Clones share the arrays.
#[derive(Clone, Debug, Default)]
pub struct Gaussians {
    /// Without the entries.
    raw: Arc<RawGaussians>,
    semantic_index: Arc<Vec<u16>>,
    identity: u64,
    /// Shared by Gaussians that differ in their entries only.
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

    fn new(mut raw: RawGaussians) -> Self {
        let semantic_index = std::mem::take(&mut raw.semantic_index);
        Self::of(Arc::new(raw), semantic_index)
    }

    fn of(raw: Arc<RawGaussians>, semantic_index: Vec<u16>) -> Self {
        let identity = NEXT_IDENTITY.fetch_add(1, Ordering::Relaxed);
        let semantic_index = Arc::new(semantic_index);
        Self { raw, semantic_index, identity, shape: identity, life: Arc::default() }
    }

    /// Drops what can never be drawn, clamps what is out of range, counts both.
    ///
    /// # Errors
    /// `internal` when the arrays' lengths disagree or the SH degree is over 3.
    pub fn sanitize(mut raw: RawGaussians) -> Result<(Self, SanitizeReport)> {
        if let Some((name, got, want)) = raw.unequal() {
            return Err(Error::internal(format!("gaussians: {name} has {got} rows, not {want}")));
        }
        if raw.sh_degree > 3 {
            let degree = raw.sh_degree;
            return Err(Error::internal(format!("gaussians: SH degree {degree} is over 3")));
        }
        let k = raw.sh_count();
        let given = raw.means.par_chunks(PART).zip(raw.sh.par_chunks(PART * k));
        let changed = raw.quats.par_chunks_mut(PART).zip(raw.scales.par_chunks_mut(PART));
        let changed = changed.zip(raw.opacities.par_chunks_mut(PART));
        let of_part = |(((quats, scales), opacities), (means, sh)): (Changed<'_>, Given<'_>)| {
            let (mut report, mut dropped) = (SanitizeReport::default(), Vec::new());
            let numbers = quats.iter_mut().zip(scales).zip(opacities);
            let rows = means.iter().zip(sh.chunks_exact(k)).zip(numbers);
            for (i, ((mean, sh), ((quat, scale), opacity))) in rows.enumerate() {
                match check_one((mean, quat, scale, *opacity, sh), &mut report) {
                    Some(checked) => (*quat, *scale, *opacity) = checked,
                    None => dropped.push(i),
                }
            }
            (report, dropped)
        };
        let parts: Vec<_> = changed.zip(given).map(of_part).collect();
        let mut report = SanitizeReport::default();
        let mut keep = vec![true; raw.means.len()];
        for (part, (of_part, dropped)) in parts.iter().enumerate() {
            report.add(of_part);
            dropped.iter().for_each(|i| keep[part * PART + i] = false);
        }
        let whole = parts.iter().all(|(_, dropped)| dropped.is_empty());
        Ok((Self::new(if whole { raw } else { raw.only(|i| keep[i]) }), report))
    }

    /// Takes back what [`Self::into_raw`] gave, bit for bit.
    ///
    /// # Errors
    /// `scene_corrupt` when a Gaussian breaks what [`Self::sanitize`] promises, or lengths differ.
    pub fn restore(raw: RawGaussians) -> Result<Self> {
        let bad = |what: String| Error::new(ErrorCode::SceneCorrupt, format!("gaussians: {what}"));
        if raw.unequal().is_some() || raw.sh_degree > 3 || !raw.origin.is_finite() {
            return Err(bad(format!("arrays of unequal length, or origin {}", raw.origin)));
        }
        let k = raw.sh_count();
        let is_bad = |&i: &usize| {
            let (quat, scale, opacity) = (&raw.quats[i], &raw.scales[i], raw.opacities[i]);
            let row = (&raw.means[i], quat, scale, opacity, &raw.sh[i * k..(i + 1) * k]);
            !check_one(row, &mut SanitizeReport::default()).is_some_and(|kept| {
                let turned = kept.0.iter().zip(quat).any(|(a, b)| (a - b).abs() > 1e-5);
                !turned && kept.1 == *scale && kept.2.total_cmp(&opacity).is_eq()
            })
        };
        let all = (0..raw.means.len()).into_par_iter().with_min_len(PART);
        match all.find_first(is_bad) {
            Some(i) => Err(bad(format!("number {i} is out of range"))),
            None => Ok(Self::new(raw)),
        }
    }

    /// The Gaussians whose number `keep` takes, in their order.
    pub fn only(&self, keep: impl Fn(usize) -> bool) -> Self {
        self.picked(&taken(self.len(), keep))
    }

    /// Those with these numbers, in this order.
    pub fn picked(&self, ids: &[u32]) -> Self {
        let semantic_index = ids.iter().map(|&i| self.semantic_index[i as usize]).collect();
        Self::of(Arc::new(self.raw.picked(ids)), semantic_index)
    }

    /// These Gaussians, then `more`, about the origin of these.
    ///
    /// # Errors
    /// `internal` when the degrees of their harmonics differ; `scene_corrupt` when a centre is out
    /// of range about this origin.
    pub fn joined(&self, more: &Self) -> Result<Self> {
        if self.sh_degree() != more.sh_degree() {
            return Err(Error::internal(format!(
                "gaussians: harmonics of degree {} beside {}",
                self.sh_degree(),
                more.sh_degree()
            )));
        }
        let offset = more.origin() - self.origin();
        let mut all = self.clone().into_raw();
        let more = more.clone().into_raw();
        let centre =
            |mean: [f32; 3]| (DVec3::from(mean.map(f64::from)) + offset).as_vec3().to_array();
        let means = more.means.into_iter().map(centre).collect();
        all.append(RawGaussians { means, ..more });
        Self::restore(all)
    }

    /// The same Gaussians with other entries of the bank, `[N]`.
    ///
    /// # Errors
    /// `internal` when the number of entries is another.
    pub fn with_semantic_index(&self, semantic_index: Vec<u16>) -> Result<Self> {
        if semantic_index.len() != self.len() {
            return Err(Error::internal(format!(
                "gaussians: semantic_index has {} rows, not {}",
                semantic_index.len(),
                self.len()
            )));
        }
        Ok(Self { shape: self.shape, ..Self::of(Arc::clone(&self.raw), semantic_index) })
    }

    /// Number that no other content of this process has; clones share it, for they cannot change. A
    /// renderer keeps what it uploaded under this number.
    pub fn identity(&self) -> u64 {
        self.identity
    }

    /// As [`Self::identity`], but shared by Gaussians that differ in `semantic_index` only.
    pub fn shape_identity(&self) -> u64 {
        self.shape
    }

    /// Lives as long as any Gaussians of this identity do.
    pub fn life(&self) -> Weak<()> {
        Arc::downgrade(&self.life)
    }

    /// Number of Gaussians.
    pub fn len(&self) -> usize {
        self.raw.means.len()
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.raw.means.is_empty()
    }

    /// World position that `means` are relative to.
    pub fn origin(&self) -> DVec3 {
        self.raw.origin
    }

    /// Degree of the spherical harmonics.
    pub fn sh_degree(&self) -> u8 {
        self.raw.sh_degree
    }

    /// Coefficients a Gaussian: (degree + 1)².
    pub fn sh_count(&self) -> usize {
        self.raw.sh_count()
    }

    /// The arrays, for a stage that makes new Gaussians of them; copies where clones have them too.
    pub fn into_raw(self) -> RawGaussians {
        let semantic_index = Arc::unwrap_or_clone(self.semantic_index);
        RawGaussians { semantic_index, ..Arc::unwrap_or_clone(self.raw) }
    }

    /// `[N]` entries of the bank.
    pub fn semantic_index(&self) -> &[u16] {
        &self.semantic_index
    }

    /// Bytes held.
    pub fn size_bytes(&self) -> u64 {
        Self::bytes_of(self.len(), self.sh_degree())
    }

    /// Bytes that so many Gaussians of this degree hold.
    pub fn bytes_of(count: usize, sh_degree: u8) -> u64 {
        let coefficients = (u64::from(sh_degree) + 1).pow(2);
        count as u64 * (12 + 16 + 12 + 4 + 2 + 6 + 12 * coefficients)
    }
}

/// Methods that give an array.
macro_rules! arrays {
    ($($(#[$doc:meta])+ $name:ident: $of:ty;)+) => {
        impl Gaussians {
            $(
                $(#[$doc])+
                pub fn $name(&self) -> &[$of] {
                    &self.raw.$name
                }
            )+
        }
    };
}

arrays! {
    /// `[N, 3]` centres relative to the origin.
    means: [f32; 3];
    /// `[N, 4]` unit quaternions, wxyz.
    quats: [f32; 4];
    /// `[N, 3]` standard deviations.
    scales: [f32; 3];
    /// `[N]` opacities.
    opacities: f32;
    /// `[N, K, 3]` coefficients, flattened over N and K.
    sh: [f32; 3];
    /// `[N]` sources.
    source: SourcePixel;
}

/// Checks a Gaussian; what to keep of it, or `None` after counting why not.
fn check_one(
    (mean, quat, scale, opacity, sh): Unchecked<'_>,
    report: &mut SanitizeReport,
) -> Option<Checked> {
    let finite = mean.iter().chain(quat).chain(scale).all(|v| v.is_finite())
        && opacity.is_finite()
        && sh.iter().flatten().all(|v| v.is_finite() && v.abs() <= Gaussians::SH_MAX);
    let norm = quat.iter().map(|&v| f64::from(v) * f64::from(v)).sum::<f64>().sqrt();
    let faults = [
        (!finite, &mut report.not_finite),
        (mean.iter().any(|v| v.abs() > Gaussians::COORDINATE_MAX), &mut report.too_far),
        (opacity < Gaussians::OPACITY_MIN, &mut report.transparent),
        (norm < 1e-12, &mut report.zero_quat),
        (scale.iter().any(|&v| v <= 0.0), &mut report.zero_scale),
    ];
    if let Some((_, count)) = faults.into_iter().find(|(fault, _)| *fault) {
        *count += 1;
        return None;
    }
    let clamped = scale.map(|v| v.clamp(Gaussians::SCALE_MIN, Gaussians::SCALE_MAX));
    if clamped != *scale {
        report.scale_clamped += 1;
    }
    if opacity > 1.0 {
        report.opacity_clamped += 1;
    }
    let unit = quat.map(|v| (f64::from(v) / norm) as f32);
    Some((unit, clamped, opacity.min(1.0)))
}
