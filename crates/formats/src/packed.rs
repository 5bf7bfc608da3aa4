//! A scene as the page draws it: 32 bytes a Gaussian, those that cover most first, so that the
//! start of the file is already a picture. A large scene begins with coarser forms of itself, and
//! then has the order that these give it.
//!
//! Little-endian: the length of the JSON header in bytes (u32); the header, filled with blanks to a
//! multiple of four bytes; the cells of the backdrop, `[64, 128, 3]` u8; then for each Gaussian
//! eight u32: the centre (three f32, relative to `origin`), colour and opacity (four u8), then
//! eight u16. These are the three scales (`ln(scale / unit)` from -16 to 4 in 65,535 steps), the
//! rotation, the photo it comes from, and its entry of the bank. The rotation (w x y z, unit) is
//! its three smallest numbers, each from -√½ to √½ in 32,767 steps; the number left out, which is
//! positive, is the top bit of the first plus twice that of the second.
//!
//! `coarse` of the header lists the coarser forms, which come first, the coarsest before the
//! others: each is the whole scene in `gaussians` records, in place of all that follows it. The
//! members of its records lie in the next form (after the last one: in the scene's own Gaussians)
//! in the same order. `ends[k]` is where those of its first `2048 (k + 1)` records end there. So
//! who has read up to there draws these members in place of the records.
//!
//! Colours are those of degree 0: a scene of a higher degree loses its shine.

use std::{f32::consts::SQRT_2, io::Write};

use serde::Serialize;

use crate::{
    error::{Error, ErrorCode, Result},
    scene::{Gaussians, SH_C0, Scene, SceneCamera, SceneId},
};

/// Natural logarithms of the smallest and largest scale in units of the scene's median depth.
const LN_SCALE: [f32; 2] = [-16.0, 4.0];
/// Gaussians packed before they are written.
const PART: usize = 8192;
/// Records of a coarser form that are replaced together: a row of the page's texture.
const ROW: usize = 2048;

/// Coarser forms of a scene.
#[derive(Clone, Copy, Debug)]
pub struct CoarseForms<'a> {
    /// Those of one form after the other, the coarsest form first.
    pub gaussians: &'a Gaussians,
    /// Their entries of the bank.
    pub entries: &'a [u16],
    /// Of each form and each of its Gaussians, where its members in the next form end.
    pub ends: &'a [Vec<u32>],
    /// The scene's own Gaussians in the order of the finest form.
    pub order: &'a [u32],
}

/// What the page must know besides the Gaussians.
#[derive(Serialize)]
struct Header<'a> {
    version: u32,
    id: &'a SceneId,
    gaussians: usize,
    /// World position that centres are relative to.
    origin: [f64; 3],
    /// What scales are relative to, and the scene's extent: the median depth.
    unit: f32,
    near: f32,
    sh_degree: u8,
    front_photos: u32,
    magnify: bool,
    /// Whether opacity is compensated for the blur of small Gaussians.
    antialiased: bool,
    backdrop: bool,
    /// Whether entries of the bank are known.
    understood: bool,
    cameras: &'a [SceneCamera],
    network_focal_px: &'a [f64],
    coarse: Vec<FormHeader>,
}

/// What the header says of a coarser form.
#[derive(Serialize)]
struct FormHeader {
    gaussians: usize,
    /// Where the members of each [`ROW`] of its records end in the next form.
    ends: Vec<u32>,
}

impl FormHeader {
    fn of(ends: &[u32]) -> Self {
        let rows = ends.chunks(ROW).filter_map(|row| row.last().copied());
        Self { gaussians: ends.len(), ends: rows.collect() }
    }
}

/// Writes the whole file; `near` is the near plane of its views, world units.
///
/// # Errors
/// `store_unavailable` where `to` fails.
pub fn write_packed(
    scene: &Scene,
    near: f32,
    coarse: Option<CoarseForms<'_>>,
    to: &mut dyn Write,
) -> Result<()> {
    let unwritten = |cause| {
        Error::new(ErrorCode::StoreUnavailable, "the scene cannot be written").caused_by(cause)
    };
    let (gaussians, report) = (&scene.gaussians, &scene.meta.report);
    let unit = if report.median_depth > 0.0 { report.median_depth as f32 } else { 1.0 };
    let header = Header {
        version: 2,
        id: &scene.meta.id,
        gaussians: gaussians.len(),
        origin: gaussians.origin().to_array(),
        unit,
        near,
        sh_degree: gaussians.sh_degree(),
        front_photos: report.method.front_photos,
        magnify: report.method.magnify,
        antialiased: report.antialiased,
        backdrop: report.method.backdrop,
        understood: scene.semantics.is_some(),
        cameras: &scene.meta.cameras,
        network_focal_px: &report.network_focal_px,
        coarse: coarse.iter().flat_map(|all| all.ends).map(|ends| FormHeader::of(ends)).collect(),
    };
    let mut header = serde_json::to_vec(&header)
        .map_err(|e| Error::internal("the scene has no header").caused_by(e))?;
    header.resize(header.len().next_multiple_of(4), b' ');
    let length = u32::try_from(header.len()).map_err(|_| Error::internal("a header over 4 GiB"))?;
    to.write_all(&length.to_le_bytes()).map_err(unwritten)?;
    to.write_all(&header).map_err(unwritten)?;
    to.write_all(scene.backdrop.cells().as_flattened()).map_err(unwritten)?;
    let entries = gaussians.semantic_index();
    let mut put = |mut order: &mut dyn Iterator<Item = usize>, of: (&Gaussians, &[u16])| {
        let mut bytes = Vec::with_capacity(PART * size_of::<[u32; 8]>());
        loop {
            let part = (&mut order).take(PART);
            bytes.extend(part.flat_map(|i| packed(of, i, unit)).flat_map(u32::to_le_bytes));
            if bytes.is_empty() {
                return Ok(());
            }
            to.write_all(&bytes).map_err(unwritten)?;
            bytes.clear();
        }
    };
    let Some(coarse) = coarse else {
        return put(&mut largest_first(gaussians).into_iter(), (gaussians, entries));
    };
    put(&mut (0..coarse.gaussians.len()), (coarse.gaussians, coarse.entries))?;
    put(&mut coarse.order.iter().map(|&i| i as usize), (gaussians, entries))
}

/// All Gaussians by what they cover: opacity times the product of the two larger scales.
pub(crate) fn largest_first(gaussians: &Gaussians) -> Vec<usize> {
    let covers = |i: usize| {
        let [a, b, c] = gaussians.scales()[i];
        gaussians.opacities()[i] * (a * b).max(b * c).max(a * c)
    };
    let mut order: Vec<usize> = (0..gaussians.len()).collect();
    order.sort_by(|&i, &j| covers(j).total_cmp(&covers(i)));
    order
}

/// `value` of 0..1 in steps of `1 / most`; what is outside is clamped.
fn steps(value: f32, most: u16) -> u32 {
    (value.clamp(0.0, 1.0) * f32::from(most) + 0.5) as u32
}

fn packed((gaussians, entries): (&Gaussians, &[u16]), i: usize, unit: f32) -> [u32; 8] {
    let [x, y, z] = gaussians.means()[i].map(f32::to_bits);
    let [r, g, b] = gaussians.sh()[i * gaussians.sh_count()].map(|c| steps(SH_C0 * c + 0.5, 255));
    let color = r | g << 8 | b << 16 | steps(gaussians.opacities()[i], 255).max(1) << 24;
    let [low, high] = LN_SCALE;
    let scales = gaussians.scales()[i].map(|s| ((s / unit).ln() - low) / (high - low));
    let [s0, s1, s2] = scales.map(|s| steps(s, u16::MAX));
    let [q0, q1, q2] = rotation(gaussians.quats()[i]);
    let photo = u32::from(gaussians.source()[i].view);
    let entry = u32::from(entries[i]);
    [x, y, z, color, s0 | s1 << 16, s2 | q0 << 16, q1 | q2 << 16, photo | entry << 16]
}

/// The three smallest numbers of a unit quaternion, and which one is left out.
fn rotation(quat: [f32; 4]) -> [u32; 3] {
    let largest = (0..4).max_by(|&a, &b| quat[a].abs().total_cmp(&quat[b].abs())).unwrap_or(0);
    let sign = quat[largest].signum();
    let mut rest = quat.iter().enumerate().filter(|(k, _)| *k != largest).map(|(_, v)| v * sign);
    let mut next = |bit: usize| {
        let value = rest.next().unwrap_or(0.0);
        steps(value / SQRT_2 + 0.5, 0x7fff) | u32::from(bit == 1) << 15
    };
    [next(largest & 1), next(largest >> 1), next(0)]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_rotation_is_its_three_smallest_numbers() {
        let unpacked = |[a, b, c]: [u32; 3]| {
            let rest = [a, b, c].map(|q| ((q & 0x7fff) as f32 / 32767.0 - 0.5) * SQRT_2);
            let out = ((a >> 15) | (b >> 15) << 1) as usize;
            let mut quat = rest.to_vec();
            quat.insert(out, (1.0 - rest.iter().map(|v| v * v).sum::<f32>()).max(0.0).sqrt());
            quat
        };
        for quat in [
            [1.0, 0.0, 0.0, 0.0],
            [0.1, -0.9, 0.3, -0.3],
            [0.2, 0.1, -0.2, -0.95],
            [0.5, 0.5, -0.5, 0.5],
            [0.0, 0.6, 0.8, 0.0],
        ] {
            let norm = quat.iter().map(|v: &f32| v * v).sum::<f32>().sqrt();
            let unit = quat.map(|v| v / norm);
            let found = unpacked(rotation(unit));
            // q and -q are one rotation.
            let dot: f32 = unit.iter().zip(&found).map(|(a, b)| a * b).sum();
            assert!(1.0 - dot.abs() < 1e-7, "{unit:?} became {found:?}");
        }
    }

    #[test]
    fn steps_cover_both_ends() {
        assert_eq!([steps(-1.0, 255), steps(0.5, 255), steps(7.0, 255)], [0, 128, 255]);
        assert_eq!(steps(f32::NAN, 255), 0);
    }
}
