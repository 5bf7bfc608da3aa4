//! The compressed PLY of `PlayCanvas` and `SuperSplat`: 16 bytes a Gaussian and 72 for each 256.
//!
//! `element chunk` has the bounds of 256 Gaussians each: positions, logarithms of scales, colours.
//! `element vertex` has four u32 each: position 11, 10 and 11 bits within the bounds, rotation (two
//! bits for the place of the largest number of w x y z, 10 bits for each other), scales as the
//! position, colour and opacity 8 bits each. `element sh` has harmonics over degree 0 as u8, from
//! -4 to 4. The Gaussians are in Morton order, so that those of a chunk are near each other. Axes
//! are those of the scene. The entries of the bank are lost.

use std::{
    f32::consts::{FRAC_1_SQRT_2, SQRT_2},
    io::{self, Read, Write},
};

use super::{SplatFile, begun, cut_short, fill_rest, steps, world};
use crate::{
    error::Result,
    scene::{Gaussians, RawGaussians, SH_C0},
};

/// Gaussians of a chunk.
pub(super) const CHUNK: usize = 256;
/// Names of a chunk's bounds; files without those of colours have colours of 0..1.
pub(super) const BOUNDS: [&str; 18] = [
    "min_x",
    "min_y",
    "min_z",
    "max_x",
    "max_y",
    "max_z",
    "min_scale_x",
    "min_scale_y",
    "min_scale_z",
    "max_scale_x",
    "max_scale_y",
    "max_scale_z",
    "min_r",
    "min_g",
    "min_b",
    "max_r",
    "max_g",
    "max_b",
];
pub(super) const PACKED: [&str; 4] =
    ["packed_position", "packed_rotation", "packed_scale", "packed_color"];
/// Largest |logarithm| of a scale.
const LN_SCALE_MAX: f32 = 20.0;

fn header(file: &SplatFile) -> String {
    let gaussians = &file.gaussians;
    let mode = if file.antialiased { "comment SplatRenderMode: mip\n" } else { "" };
    let (n, rest) = (gaussians.len(), 3 * (gaussians.sh_count() - 1));
    let floats = BOUNDS.map(|name| format!("property float {name}\n")).concat();
    let words = PACKED.map(|name| format!("property uint {name}\n")).concat();
    let bytes: String = (0..rest).map(|i| format!("property uchar f_rest_{i}\n")).collect();
    let sh = if rest == 0 { String::new() } else { format!("element sh {n}\n{bytes}") };
    let chunks = n.div_ceil(CHUNK);
    format!(
        "ply\nformat binary_little_endian 1.0\n{mode}element chunk {chunks}\n{floats}\
         element vertex {n}\n\
         {words}{sh}end_header\n"
    )
}

pub(super) fn size_bytes(file: &SplatFile) -> u64 {
    let (n, rest) = (file.gaussians.len(), 3 * (file.gaussians.sh_count() - 1));
    (header(file).len() + n.div_ceil(CHUNK) * 4 * BOUNDS.len() + n * (16 + rest)) as u64
}

/// Position, logarithms of scales and colour of a Gaussian: what lies within the bounds of its
/// chunk.
fn bounded(gaussians: &Gaussians, i: usize) -> [[f32; 3]; 3] {
    [
        world(gaussians, i).as_vec3().to_array(),
        gaussians.scales()[i].map(|s| s.ln().clamp(-LN_SCALE_MAX, LN_SCALE_MAX)),
        gaussians.sh()[i * gaussians.sh_count()].map(|c| SH_C0 * c + 0.5),
    ]
}

/// Smallest and largest numbers of a chunk, in the order of [`BOUNDS`].
type Bounds = [[[f32; 3]; 2]; 3];

fn bounds(gaussians: &Gaussians, chunk: &[u32]) -> Bounds {
    let mut all = [[[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]]; 3];
    for &i in chunk {
        for (of, numbers) in all.iter_mut().zip(bounded(gaussians, i as usize)) {
            of[0] = std::array::from_fn(|k| of[0][k].min(numbers[k]));
            of[1] = std::array::from_fn(|k| of[1][k].max(numbers[k]));
        }
    }
    all
}

pub(super) fn write(file: &SplatFile, to: &mut dyn Write) -> io::Result<()> {
    let gaussians = &file.gaussians;
    let order = morton_order(&(0..gaussians.len() as u32), gaussians.means());
    to.write_all(header(file).as_bytes())?;
    for chunk in order.chunks(CHUNK) {
        for bound in bounds(gaussians, chunk).as_flattened().as_flattened() {
            to.write_all(&bound.to_le_bytes())?;
        }
    }
    for chunk in order.chunks(CHUNK) {
        let bounds = bounds(gaussians, chunk);
        for &i in chunk {
            for word in packed(gaussians, i as usize, &bounds) {
                to.write_all(&word.to_le_bytes())?;
            }
        }
    }
    let k = gaussians.sh_count();
    for &i in &order {
        let rest = &gaussians.sh()[i as usize * k + 1..(i as usize + 1) * k];
        for channel in 0..3 {
            for row in rest {
                to.write_all(&[((row[channel] / 8.0 + 0.5) * 256.0).clamp(0.0, 255.0) as u8])?;
            }
        }
    }
    Ok(())
}

/// These Gaussians along a Morton curve, 21 bits an axis.
pub(super) fn morton_order(
    ids: &(impl Iterator<Item = u32> + Clone),
    means: &[[f32; 3]],
) -> Vec<u32> {
    let means = || ids.clone().map(|i| &means[i as usize]);
    let fold = |f: fn(f32, f32) -> f32, start| {
        means().fold([start; 3], |a, b| std::array::from_fn(|k| f(a[k], b[k])))
    };
    let (low, high) = (fold(f32::min, f32::INFINITY), fold(f32::max, f32::NEG_INFINITY));
    let code = |mean: &[f32; 3]| {
        (0..3).fold(0, |code, k| {
            let part = f64::from(mean[k] - low[k]) / f64::from(high[k] - low[k]).max(1e-30);
            code | spread((part.clamp(0.0, 1.0) * f64::from((1 << 21) - 1)) as u64) << k
        })
    };
    let mut order: Vec<(u64, u32)> = means().map(code).zip(ids.clone()).collect();
    order.sort_unstable();
    order.into_iter().map(|(_, i)| i).collect()
}

/// The low 21 bits with two zeros between each and the next.
fn spread(mut bits: u64) -> u64 {
    for (shift, mask) in [
        (32, 0x1f_0000_0000_ffff),
        (16, 0x1f_0000_ff00_00ff),
        (8, 0x100f_00f0_0f00_f00f),
        (4, 0x10c3_0c30_c30c_30c3),
        (2, 0x1249_2492_4924_9249),
    ] {
        bits = (bits | bits << shift) & mask;
    }
    bits
}

fn packed(gaussians: &Gaussians, i: usize, bounds: &Bounds) -> [u32; 4] {
    let numbers = bounded(gaussians, i);
    let within = |of: usize, k: usize| {
        let [low, high] = bounds[of];
        if high[k] > low[k] { (numbers[of][k] - low[k]) / (high[k] - low[k]) } else { 0.0 }
    };
    let three = |of: usize| {
        let step = |k: usize, bits: u32| steps(within(of, k), (1_u32 << bits) - 1);
        step(0, 11) << 21 | step(1, 10) << 11 | step(2, 11)
    };
    let color = (0..3).map(|k| within(2, k)).chain([gaussians.opacities()[i]]);
    let color = color.fold(0, |word, part| word << 8 | steps(part, 255));
    [three(0), packed_quat(gaussians.quats()[i]), three(1), color]
}

fn packed_quat(quat: [f32; 4]) -> u32 {
    let largest = (0..4).fold(0, |a, b| if quat[b].abs() > quat[a].abs() { b } else { a });
    let sign = quat[largest].signum();
    let rest = quat.into_iter().enumerate().filter(|(k, _)| *k != largest);
    rest.fold(largest as u32, |word, (_, q)| {
        word << 10 | steps(q * sign * FRAC_1_SQRT_2 + 0.5, 1023)
    })
}

fn unpacked_quat(word: u32) -> [f32; 4] {
    let largest = (word >> 30) as usize;
    let mut quat = [0.0_f32; 4];
    let mut left = word;
    for k in (0..4).rev().filter(|&k| k != largest) {
        quat[k] = ((left & 1023) as f32 / 1023.0 - 0.5) * SQRT_2;
        left >>= 10;
    }
    quat[largest] = (1.0 - quat.iter().map(|q| q * q).sum::<f32>()).max(0.0).sqrt();
    quat
}

/// What the header of a compressed PLY says of its rows, and where their numbers are.
pub(super) struct PackedLayout {
    pub(super) count: usize,
    pub(super) sh_degree: u8,
    /// Bytes of a row of each element.
    pub(super) strides: [usize; 3],
    /// Offsets in a chunk's row, in the order of [`BOUNDS`]; 12 or 18.
    pub(super) bounds: Vec<usize>,
    /// Offsets in a vertex' row, in the order of [`PACKED`].
    pub(super) packed: [usize; 4],
}

/// Reads what follows the header.
pub(super) fn read(from: &mut dyn Read, layout: &PackedLayout) -> Result<RawGaussians> {
    let [of_chunk, of_vertex, of_sh] = layout.strides;
    let n = layout.count;
    let mut rows = |stride: usize, i: usize, count: usize, of: &str| -> Result<Vec<u8>> {
        let mut row = vec![0; stride];
        from.read_exact(&mut row).map_err(|e| cut_short("PLY", e, i, count, of))?;
        Ok(row)
    };
    let word =
        |row: &[u8], k: usize| u32::from_le_bytes([row[k], row[k + 1], row[k + 2], row[k + 3]]);
    let chunks = n.div_ceil(CHUNK);
    let mut all = Vec::new();
    for i in 0..chunks {
        let row = rows(of_chunk, i, chunks, "chunks")?;
        let mut bounds = [0.0; 18];
        bounds[15..].fill(1.0);
        for (bound, &at) in bounds.iter_mut().zip(&layout.bounds) {
            *bound = f32::from_bits(word(&row, at));
        }
        all.push(bounds);
    }
    let mut raw = begun(n, layout.sh_degree);
    let k = (usize::from(layout.sh_degree) + 1).pow(2);
    for i in 0..n {
        let row = rows(of_vertex, i, n, "Gaussians")?;
        let [position, rotation, scale, color] = layout.packed.map(|at| word(&row, at));
        let bounds = &all[i / CHUNK];
        let between = |of: usize, parts: [f32; 3]| -> [f32; 3] {
            let (low, high) = (&bounds[6 * of..6 * of + 3], &bounds[6 * of + 3..6 * of + 6]);
            std::array::from_fn(|k| low[k] * (1.0 - parts[k]) + high[k] * parts[k])
        };
        let three = |word: u32| {
            let part = |shift: u32, most: u32| (word >> shift & most) as f32 / most as f32;
            [part(21, 2047), part(11, 1023), part(0, 2047)]
        };
        let [r, g, b, opacity] = color.to_be_bytes().map(|level| f32::from(level) / 255.0);
        raw.means.push(between(0, three(position)));
        raw.scales.push(between(1, three(scale)).map(f32::exp));
        raw.sh.push(between(2, [r, g, b]).map(|c| (c - 0.5) / SH_C0));
        raw.sh.resize((i + 1) * k, [0.0; 3]);
        raw.quats.push(unpacked_quat(rotation));
        raw.opacities.push(opacity);
    }
    if k > 1 {
        for i in 0..n {
            let row = rows(of_sh, i, n, "rows of harmonics")?;
            for (at, &level) in row.iter().enumerate() {
                let part = match level {
                    0 => 0.0,
                    255 => 1.0,
                    other => (f32::from(other) + 0.5) / 256.0,
                };
                raw.sh[i * k + 1 + at % (k - 1)][at / (k - 1)] = (part - 0.5) * 8.0;
            }
        }
    }
    fill_rest(&mut raw);
    Ok(raw)
}
