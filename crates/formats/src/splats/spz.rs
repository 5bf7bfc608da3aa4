//! SPZ, as nianticlabs/spz packs it: versions 3 and 4 are written, 1 to 4 are read.
//!
//! Versions 1 to 3 are one gzip stream: a header of 16 bytes, then a block of bytes for each
//! attribute. Version 4 has the header plain (32 bytes), then records of extensions, a table with
//! the packed and the whole size of each block, and each block as a stream of Zstandard. The blocks
//! are alike: positions
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
use ruzstd::{
    decoding::StreamingDecoder,
    encoding::{CompressionLevel, compress_to_vec},
};

use super::{
    OCTETS, SplatFile, SplatFormat, SplatsRead, TURN, TURN_QUAT, TURN_SH, begun, check_count,
    cut_short, fill_rest, places::Coarse, some, times, unreadable, world,
};
use crate::{
    error::{Error, Result},
    limits::Limits,
    scene::{Gaussians, RawGaussians},
};

/// SPZ, version 3.
pub static SPZ: SplatFormat = SplatFormat {
    name: "spz",
    ending: "spz",
    media_type: OCTETS,
    semantics: false,
    begins: &[0x1f, 0x8b],
    read,
    check,
    size_bytes: |_| None,
    write,
};

/// SPZ, version 4.
pub static SPZ4: SplatFormat = SplatFormat {
    name: "spz4",
    ending: "v4.spz",
    media_type: OCTETS,
    semantics: false,
    begins: &MAGIC,
    read: read_4,
    check,
    size_bytes: |_| None,
    write: write_4,
};

const MAGIC: [u8; 4] = *b"NGSP";
/// Bytes of the header of version 4.
const HEAD_4_BYTES: usize = 32;
/// The record of an extension that says other axes, `SPZ_ADOBE_coordinate_system`.
const OTHER_AXES: u32 = 0xADBE_0003;
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

fn check(file: &SplatFile) -> Result<()> {
    some(file)?;
    let step = 0.5_f64.powi(bits(&file.gaussians)? as i32);
    let coarse = Coarse::of(&file.gaussians, |_| step);
    coarse.map_or(Ok(()), |coarse| Err(coarse.refused(file.format.name)))
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

/// What writes a block of bytes, one row a Gaussian.
type Block = fn(&Gaussians, u32, &mut dyn Write) -> io::Result<()>;

/// The blocks in their order. The last is empty without harmonics over degree 0.
const BLOCKS: [Block; 6] = [
    |gaussians, bits, to| {
        for i in 0..gaussians.len() {
            for (value, sign) in world(gaussians, i).to_array().into_iter().zip(TURN) {
                let steps = (value * f64::from(sign) * f64::from(1_u32 << bits)).round() as i32;
                to.write_all(&steps.to_le_bytes()[..3])?;
            }
        }
        Ok(())
    },
    |gaussians, _, to| {
        gaussians.opacities().iter().try_for_each(|o| to.write_all(&[byte(o * 255.0)]))
    },
    |gaussians, _, to| {
        let colors = gaussians.sh().iter().step_by(gaussians.sh_count());
        let bytes = |color: &[f32; 3]| color.map(|c| byte((c * COLOR_SCALE + 0.5) * 255.0));
        colors.map(bytes).try_for_each(|color| to.write_all(&color))
    },
    |gaussians, _, to| {
        let bytes = |scale: &[f32; 3]| scale.map(|s| byte((s.ln() + 10.0) * 16.0));
        gaussians.scales().iter().map(bytes).try_for_each(|scale| to.write_all(&scale))
    },
    |gaussians, _, to| {
        let word = |quat: &[f32; 4]| packed_quat(times(*quat, TURN_QUAT)).to_le_bytes();
        gaussians.quats().iter().map(word).try_for_each(|quat| to.write_all(&quat))
    },
    |gaussians, _, to| {
        for row in gaussians.sh().chunks_exact(gaussians.sh_count()) {
            for (j, coefficient) in row.iter().enumerate().skip(1) {
                to.write_all(&coefficient.map(|c| packed_sh(c * TURN_SH[j], j)))?;
            }
        }
        Ok(())
    },
];

/// The 16 bytes that a file of any version begins with. The last one is the number of streams,
/// from version 4 on.
fn head(file: &SplatFile, version: u32, bits: u32, streams: u8) -> io::Result<Vec<u8>> {
    let gaussians = &file.gaussians;
    let count = u32::try_from(gaussians.len()).map_err(io::Error::other)?;
    let words = [u32::from_le_bytes(MAGIC), version, count];
    let mut head: Vec<u8> = words.iter().flat_map(|word| word.to_le_bytes()).collect();
    head.extend([gaussians.sh_degree(), bits as u8, u8::from(file.antialiased), streams]);
    Ok(head)
}

fn write(file: &SplatFile, to: &mut dyn Write) -> io::Result<()> {
    let gaussians = &file.gaussians;
    let bits = bits(gaussians).map_err(io::Error::other)?;
    let mut to = GzEncoder::new(to, Compression::default());
    to.write_all(&head(file, 3, bits, 0)?)?;
    BLOCKS.iter().try_for_each(|block| block(gaussians, bits, &mut to))?;
    to.finish().map(drop)
}

/// The table of the streams is before them, so that all are packed before the first is written.
fn write_4(file: &SplatFile, to: &mut dyn Write) -> io::Result<()> {
    let gaussians = &file.gaussians;
    let bits = bits(gaussians).map_err(io::Error::other)?;
    let (mut table, mut packed) = (Vec::new(), Vec::new());
    for block in BLOCKS {
        let mut whole = Vec::new();
        block(gaussians, bits, &mut whole)?;
        if !whole.is_empty() {
            let stream = compress_to_vec(&whole[..], CompressionLevel::Fastest);
            table.extend([stream.len() as u64, whole.len() as u64]);
            packed.push(stream);
        }
    }
    to.write_all(&head(file, 4, bits, packed.len() as u8)?)?;
    to.write_all(&(HEAD_4_BYTES as u32).to_le_bytes())?;
    to.write_all(&[0; 12])?;
    table.iter().try_for_each(|size| to.write_all(&size.to_le_bytes()))?;
    packed.iter().try_for_each(|stream| to.write_all(stream))
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

/// What the first 16 bytes of a file say.
struct Head {
    version: u32,
    count: usize,
    sh_degree: u8,
    /// Steps of a position in a unit.
    unit: f64,
    /// Whether the renderer compensates opacity for the blur of small Gaussians.
    antialiased: bool,
    /// Whether records of extensions are in the file.
    extended: bool,
    streams: u8,
}

impl Head {
    fn read(head: [u8; 16], versions: [u32; 2], limits: &Limits) -> Result<Self> {
        let word = |k: usize| u32::from_le_bytes([head[k], head[k + 1], head[k + 2], head[k + 3]]);
        let (version, count) = (word(4), word(8) as usize);
        let [sh_degree, bits, flags, streams] = word(12).to_le_bytes();
        if head[..4] != MAGIC {
            return Err(bad("the unpacked bytes do not begin with NGSP"));
        }
        let [least, most] = versions;
        if !(least..=most).contains(&version) {
            return Err(bad(format!("version {version}; 1 to 3 are read as gzip, 4 by its head")));
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
        let [antialiased, extended] = [1, 2].map(|flag| flags & flag != 0);
        let unit = f64::from(1_u32 << bits);
        Ok(Self { version, count, sh_degree, unit, antialiased, extended, streams })
    }

    fn read_blocks<R: Read>(&self, blocks: &mut Blocks<R>) -> Result<RawGaussians> {
        let mut raw = begun(self.count, self.sh_degree);
        blocks.count = self.count;
        blocks.read(&mut raw, self.version, self.unit)?;
        fill_rest(&mut raw);
        Ok(raw)
    }

    /// Bytes of each block of version 4; that of harmonics is left out where it is empty.
    fn block_bytes(&self) -> Vec<u64> {
        let harmonics = 3 * ((u64::from(self.sh_degree) + 1).pow(2) - 1);
        let each = [9, 1, 3, 3, 4, harmonics].into_iter().filter(|bytes| *bytes > 0);
        each.map(|bytes| bytes * self.count as u64).collect()
    }
}

/// Versions 1 to 3.
fn read(from: &mut dyn BufRead, limits: &Limits) -> Result<SplatsRead> {
    let (raw, antialiased) = unpacked(from, limits)?;
    Ok(SplatsRead::new(&SPZ, raw, None)?.antialiased(antialiased))
}

/// Version 4.
fn read_4(from: &mut dyn BufRead, limits: &Limits) -> Result<SplatsRead> {
    let (raw, antialiased) = unpacked_4(from, limits)?;
    Ok(SplatsRead::new(&SPZ4, raw, None)?.antialiased(antialiased))
}

/// The Gaussians of a file in a file, of any version, and whether they are for a renderer that
/// compensates opacity.
pub(super) fn enclosed(mut file: &[u8], limits: &Limits) -> Result<(RawGaussians, bool)> {
    if file.starts_with(&MAGIC) {
        unpacked_4(&mut file, limits)
    } else {
        unpacked(&mut file, limits)
    }
}

fn unpacked(from: &mut dyn BufRead, limits: &Limits) -> Result<(RawGaussians, bool)> {
    let mut from = Blocks { from: GzDecoder::new(from), count: 0 };
    let head = Head::read(from.row(0, "bytes of the header")?, [1, 3], limits)?;
    let raw = head.read_blocks(&mut from)?;
    let rest = from.end()?;
    if head.extended {
        check_extensions(&rest)?;
    }
    Ok((raw, head.antialiased))
}

fn unpacked_4(from: &mut dyn BufRead, limits: &Limits) -> Result<(RawGaussians, bool)> {
    let mut from = Blocks { from, count: HEAD_4_BYTES };
    let head = Head::read(from.row(0, "bytes of the header")?, [4, 4], limits)?;
    let rest: [u8; 16] = from.row(16, "bytes of the header")?;
    let table_at = u64::from(u32::from_le_bytes([rest[0], rest[1], rest[2], rest[3]]));
    let records = table_at.checked_sub(HEAD_4_BYTES as u64).filter(|bytes| *bytes <= REST_MAX);
    let records = records.ok_or_else(|| {
        bad(format!(
            "the table of the streams is at byte {table_at}; {HEAD_4_BYTES} to 1 MiB is read"
        ))
    })?;
    let records = from.bytes(records, "the block of extensions")?;
    if head.extended {
        check_extensions(&records)?;
    }
    let sizes = head.block_bytes();
    if usize::from(head.streams) != sizes.len() {
        let (streams, degree) = (head.streams, head.sh_degree);
        let want = sizes.len();
        return Err(bad(format!("{streams} streams; of degree {degree} there are {want}")));
    }
    let mut table = Vec::new();
    for (i, size) in sizes.iter().enumerate() {
        let row = from.bytes(16, "the table of the streams")?;
        let word = |k: usize| row[k..k + 8].iter().rev().fold(0, |n, b| n << 8 | u64::from(*b));
        let whole = word(8);
        if whole != *size {
            return Err(bad(format!("stream {i} is of {whole} bytes; it must be of {size}")));
        }
        table.push((word(0), whole));
    }
    let mut blocks = Vec::new();
    for (i, (packed, whole)) in table.into_iter().enumerate() {
        let packed = from.bytes(packed, &format!("stream {i}"))?;
        let damaged = || bad(format!("stream {i}: the compressed bytes are damaged"));
        let mut stream = StreamingDecoder::new(&packed[..]).map_err(|_| damaged())?;
        let read = (&mut stream).take(whole + 1).read_to_end(&mut blocks);
        let read = read.map_err(|_| damaged())?;
        let said = stream.decoder.get_checksum_from_data();
        if said.is_some() && said != stream.decoder.get_calculated_checksum() {
            return Err(damaged());
        }
        if read as u64 != whole {
            return Err(bad(format!("stream {i} unpacks to {read} bytes, not {whole}")));
        }
    }
    let raw = head.read_blocks(&mut Blocks { from: &blocks[..], count: 0 })?;
    Ok((raw, head.antialiased))
}

/// Refuses records that change what the numbers mean; others are skipped, as the reference does.
fn check_extensions(mut records: &[u8]) -> Result<()> {
    while let Some((head, rest)) = records.split_at_checked(8) {
        let word = |k: usize| u32::from_le_bytes([head[k], head[k + 1], head[k + 2], head[k + 3]]);
        if word(0) == OTHER_AXES {
            return Err(bad(
                "it has the extension SPZ_ADOBE_coordinate_system; axes other than y up and z back \
                 are not read",
            ));
        }
        records = rest.get(word(4) as usize..).unwrap_or_default();
    }
    Ok(())
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

    /// So many bytes that `of` names.
    fn bytes(&mut self, bytes: u64, of: &str) -> Result<Vec<u8>> {
        let mut read = Vec::new();
        (&mut self.from).take(bytes).read_to_end(&mut read).map_err(unreadable)?;
        match read.len() as u64 {
            all if all == bytes => Ok(read),
            some => Err(bad(format!("{of} ends after {some} of {bytes} bytes"))),
        }
    }

    /// What follows, to the end of the stream, where gzip's sum of all bytes is checked.
    fn end(&mut self) -> Result<Vec<u8>> {
        let (count, mut rest) = (self.count, Vec::new());
        let read = (&mut self.from).take(REST_MAX + 1).read_to_end(&mut rest);
        match read.map_err(|e| cut_short("SPZ", e, count, count, "Gaussians"))? as u64 {
            bytes if bytes > REST_MAX => {
                Err(Error::limit("SPZ: bytes after the Gaussians", "more", REST_MAX))
            }
            _ => Ok(rest),
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
