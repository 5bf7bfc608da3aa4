//! SPZ, as nianticlabs/spz packs it: written as version 3, read as versions 1 to 3.
//!
//! One gzip stream: a header of 16 bytes, then a block of bytes for each attribute: positions
//! (three numbers of 24 bits with a fixed point), opacities (u8), colours (three u8), scales (three
//! u8), rotations (the three smallest numbers, 10 bits each; before version 3 the first three, 8
//! bits each), harmonics over degree 0 (u8). Version 1 has positions as half floats. Axes: y up, z
//! back.
//!
//! Steps: positions `2^-bits`, with as many bits as the farthest Gaussian leaves, 20 at most;
//! scales `1/16` of their natural logarithm, from -10 to 5.94; opacities `1/255`; colours `1/38.25`
//! of a coefficient of degree 0; rotations `1/723`; harmonics `1/16` in degree 1, `1/8` above, as
//! the reference rounds them. The entries of the bank are lost.

use std::{
    f32::consts::FRAC_1_SQRT_2,
    io::{self, BufRead, Read, Write},
};

use flate2::{Compression, bufread::GzDecoder, write::GzEncoder};
use half::f16;

use super::{
    SPZ, SplatFile, SplatsRead, TURN, TURN_QUAT, TURN_SH, begun, check_count, cut_short, fill_rest,
    some, times, world,
};
use crate::{
    error::{Error, Result},
    limits::Limits,
    scene::{Gaussians, RawGaussians},
};

const MAGIC: [u8; 4] = *b"NGSP";
const VERSION: u32 = 3;
/// Most bits behind the point of a position.
const BITS_MAX: u32 = 20;
/// Largest number of a position, in steps.
const STEPS_MAX: f64 = 8_388_607.0;
/// What a coefficient of degree 0 is multiplied by to be a colour of 0..1.
const COLOR_SCALE: f32 = 0.15;
/// Most bytes of extensions after the blocks; they are not read.
const REST_MAX: u64 = 1 << 20;
/// Steps of 1/128 that a coefficient of degree 1, and of a higher one, is rounded to.
const SH_BUCKETS: [i32; 2] = [8, 16];

pub(super) fn check(file: &SplatFile) -> Result<()> {
    some(file)?;
    bits(&file.gaussians).map(drop)
}

/// Bits behind the point that the farthest Gaussian leaves.
fn bits(gaussians: &Gaussians) -> Result<u32> {
    let farthest = |i| world(gaussians, i).abs().max_element();
    let farthest = (0..gaussians.len()).map(farthest).fold(0.0, f64::max);
    // Rounding may add half a step.
    let fits = |bits: &u32| (farthest * f64::from(1_u32 << bits)).round() <= STEPS_MAX;
    (0..=BITS_MAX).rev().find(fits).ok_or_else(|| {
        let most = STEPS_MAX;
        Error::invalid(format!(
            "spz: a Gaussian has the coordinate {farthest}; the format goes to {most}"
        ))
    })
}

pub(super) fn write(file: &SplatFile, to: &mut dyn Write) -> io::Result<()> {
    let gaussians = &file.gaussians;
    let (n, k) = (gaussians.len(), gaussians.sh_count());
    let count = u32::try_from(n).map_err(io::Error::other)?;
    let bits = bits(gaussians).map_err(io::Error::other)?;
    let mut to = GzEncoder::new(to, Compression::default());
    to.write_all(&MAGIC)?;
    to.write_all(&VERSION.to_le_bytes())?;
    to.write_all(&count.to_le_bytes())?;
    to.write_all(&[gaussians.sh_degree(), bits as u8, 0, 0])?;
    for i in 0..n {
        let at = world(gaussians, i).to_array();
        for (value, sign) in at.into_iter().zip(TURN) {
            let steps = (value * f64::from(sign) * f64::from(1_u32 << bits)).round() as i32;
            to.write_all(&steps.to_le_bytes()[..3])?;
        }
    }
    for opacity in gaussians.opacities() {
        to.write_all(&[byte(opacity * 255.0)])?;
    }
    for i in 0..n {
        let color = gaussians.sh()[i * k].map(|c| byte((c * COLOR_SCALE + 0.5) * 255.0));
        to.write_all(&color)?;
    }
    for scale in gaussians.scales() {
        to.write_all(&scale.map(|s| byte((s.ln() + 10.0) * 16.0)))?;
    }
    for quat in gaussians.quats() {
        to.write_all(&packed_quat(times(*quat, TURN_QUAT)).to_le_bytes())?;
    }
    for row in gaussians.sh().chunks_exact(k) {
        for (j, coefficient) in row.iter().enumerate().skip(1) {
            to.write_all(&coefficient.map(|c| packed_sh(c * TURN_SH[j], j)))?;
        }
    }
    to.finish().map(drop)
}

fn byte(value: f32) -> u8 {
    value.round().clamp(0.0, 255.0) as u8
}

/// Two bits for the place of the largest number among x y z w; then for each other its sign and
/// nine bits of its size. q and -q are one rotation: the largest is positive.
fn packed_quat([w, x, y, z]: [f32; 4]) -> u32 {
    let quat = [x, y, z, w];
    let largest = (0..4).fold(0, |a, b| if quat[b].abs() > quat[a].abs() { b } else { a });
    let flip = quat[largest] < 0.0;
    let rest = quat.into_iter().enumerate().filter(|(k, _)| *k != largest);
    rest.fold(largest as u32, |packed, (_, q)| {
        let size = (511.0 * (q.abs() / FRAC_1_SQRT_2) + 0.5) as u32;
        packed << 10 | u32::from((q < 0.0) != flip) << 9 | size.min(511)
    })
}

/// The rotation as w x y z.
fn unpacked_quat(mut packed: u32) -> [f32; 4] {
    let largest = (packed >> 30) as usize;
    let mut quat = [0.0_f32; 4];
    for k in (0..4).rev().filter(|&k| k != largest) {
        let size = FRAC_1_SQRT_2 * (packed & 511) as f32 / 511.0;
        quat[k] = if packed & 512 == 0 { size } else { -size };
        packed >>= 10;
    }
    quat[largest] = (1.0 - quat.iter().map(|q| q * q).sum::<f32>()).max(0.0).sqrt();
    let [x, y, z, w] = quat;
    [w, x, y, z]
}

/// Coefficient `j`, 128 for 0, to the middle of its bucket.
fn packed_sh(value: f32, j: usize) -> u8 {
    let bucket = SH_BUCKETS[usize::from(j > 3)];
    let steps = (value * 128.0).round() as i32 + 128;
    ((steps + bucket / 2).div_euclid(bucket) * bucket).clamp(0, 255) as u8
}

pub(super) fn read(from: &mut dyn BufRead, limits: &Limits) -> Result<SplatsRead> {
    let mut from = Blocks { from: GzDecoder::new(from), count: 0 };
    let head: [u8; 16] = from.row(0, "bytes of the header")?;
    let word = |k: usize| u32::from_le_bytes([head[k], head[k + 1], head[k + 2], head[k + 3]]);
    let (version, count, sh_degree, bits) = (word(4), word(8) as usize, head[12], head[13]);
    if head[..4] != MAGIC {
        return Err(bad("the unpacked bytes do not begin with NGSP"));
    }
    if !(1..=VERSION).contains(&version) {
        return Err(bad(format!("version {version}; 1 to {VERSION} are read")));
    }
    if sh_degree > 3 {
        return Err(bad(format!("harmonics of degree {sh_degree}; 0 to 3 are read")));
    }
    check_count("SPZ: Gaussians", count, sh_degree, limits)?;
    if count == 0 {
        return Err(bad("the header says 0 Gaussians"));
    }
    if bits > 30 {
        return Err(bad(format!("{bits} bits behind the point; 0 to 30 are read")));
    }
    from.count = count;
    let mut raw = begun(count, sh_degree);
    from.read(&mut raw, version, f64::from(1_u32 << bits))?;
    from.end()?;
    fill_rest(&mut raw);
    SplatsRead::new(&SPZ, raw, None)
}

fn bad(why: impl std::fmt::Display) -> Error {
    Error::invalid(format!("SPZ: {why}"))
}

/// The blocks of bytes of a file.
struct Blocks<R> {
    from: R,
    count: usize,
}

impl<R: Read> Blocks<R> {
    /// The bytes of Gaussian `i` in the block that `of` names.
    fn row<const N: usize>(&mut self, i: usize, of: &str) -> Result<[u8; N]> {
        let mut row = [0; N];
        self.from.read_exact(&mut row).map_err(|e| cut_short("SPZ", e, i, self.count, of))?;
        Ok(row)
    }

    /// Goes to the end of the stream, where gzip's sum of all bytes is checked.
    fn end(&mut self) -> Result<()> {
        let count = self.count;
        let rest = io::copy(&mut (&mut self.from).take(REST_MAX + 1), &mut io::sink());
        match rest.map_err(|e| cut_short("SPZ", e, count, count, "Gaussians"))? {
            bytes if bytes > REST_MAX => {
                Err(Error::limit("SPZ: bytes after the Gaussians", "more", REST_MAX))
            }
            _ => Ok(()),
        }
    }

    fn read(&mut self, raw: &mut RawGaussians, version: u32, unit: f64) -> Result<()> {
        let (n, k) = (self.count, (usize::from(raw.sh_degree) + 1).pow(2));
        for i in 0..n {
            let at = if version == 1 {
                let row: [u8; 6] = self.row(i, "positions")?;
                [0, 2, 4].map(|b| f16::from_le_bytes([row[b], row[b + 1]]).to_f32())
            } else {
                let row: [u8; 9] = self.row(i, "positions")?;
                // The third byte has the sign.
                let steps =
                    [0, 3, 6].map(|b| i32::from_le_bytes([0, row[b], row[b + 1], row[b + 2]]) >> 8);
                steps.map(|steps| (f64::from(steps) / unit) as f32)
            };
            raw.means.push(times(at, TURN));
        }
        for i in 0..n {
            let [opacity] = self.row(i, "opacities")?;
            raw.opacities.push(f32::from(opacity) / 255.0);
        }
        for i in 0..n {
            let color: [u8; 3] = self.row(i, "colours")?;
            raw.sh.push(color.map(|c| (f32::from(c) / 255.0 - 0.5) / COLOR_SCALE));
            raw.sh.resize((i + 1) * k, [0.0; 3]);
        }
        for i in 0..n {
            let scale: [u8; 3] = self.row(i, "scales")?;
            raw.scales.push(scale.map(|s| (f32::from(s) / 16.0 - 10.0).exp()));
        }
        for i in 0..n {
            let quat = if version < 3 {
                let first: [u8; 3] = self.row(i, "rotations")?;
                let [x, y, z] = first.map(|q| f32::from(q) / 127.5 - 1.0);
                [(1.0 - x * x - y * y - z * z).max(0.0).sqrt(), x, y, z]
            } else {
                unpacked_quat(u32::from_le_bytes(self.row(i, "rotations")?))
            };
            raw.quats.push(times(quat, TURN_QUAT));
        }
        for i in 0..n {
            for (coefficient, sign) in raw.sh[i * k..(i + 1) * k].iter_mut().zip(TURN_SH).skip(1) {
                let bytes: [u8; 3] = self.row(i, "harmonics")?;
                *coefficient = bytes.map(|c| (f32::from(c) - 128.0) / 128.0 * sign);
            }
        }
        Ok(())
    }
}
