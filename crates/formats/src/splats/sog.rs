//! SOG, the bundle of `PlayCanvas`: a zip of `meta.json` and lossless WebP pictures, version 2.
//!
//! A Gaussian is a pixel, row by row, along a Morton curve. `means_l` and `means_u` have the low
//! and the high byte of a position: 65,535 steps between the bounds of `sign(v) ln(|v| + 1)`.
//! `quats` has the three smaller numbers of w x y z, `255 (q / √2 + ½)`, and 252 plus the place of
//! the largest. `scales` (logarithms) and `sh0` (coefficients of degree 0) have numbers of a table
//! of 256 each, and `sh0` the opacity as its fourth byte. Harmonics over degree 0 are a palette in
//! `shN_centroids`, 64 to a row, whose numbers are in a table too, and a label in `shN_labels`.
//! Axes are those of the scene.
//!
//! Where there are more Gaussians than the palette has rows, those whose harmonics are alike share
//! one: their set is cut in two at the median of its widest coefficient until there are as many
//! parts. Lost in writing: the entries of the bank.

use std::{
    f32::consts::{FRAC_1_SQRT_2, SQRT_2},
    io::{self, BufRead, Cursor, Read, Write},
};

use glam::DVec3;
use image::{
    ExtendedColorType, ImageDecoder, ImageEncoder,
    codecs::webp::{WebPDecoder, WebPEncoder},
};
use serde::Deserialize;
use serde_json::json;
use zip::{
    CompressionMethod, ZipReadOptions, ZipWriter, unstable::read::ZipIterable,
    write::SimpleFileOptions,
};

use super::{
    OCTETS, SplatFile, SplatFormat, SplatsRead, begun, check_count, fill_rest,
    packed_ply::morton_order, some, steps, unreadable, world,
};
use crate::{
    error::{Error, Result, short},
    limits::Limits,
    scene::Gaussians,
};

/// The bundle of pictures of `PlayCanvas`.
pub static SOG: SplatFormat = SplatFormat {
    name: "sog",
    ending: "sog",
    media_type: OCTETS,
    semantics: false,
    begins: b"PK",
    read,
    check,
    size_bytes: |_| None,
    write,
};

/// Name of the renderer that compensates opacity, in `meta.json`.
const ANTIALIASED: &str = "antialiased";
/// Numbers of a table.
const TABLE: usize = 256;
/// Most files of a bundle, and bytes of its `meta.json`.
const FILES_MAX: usize = 64;
const META_BYTES_MAX: u64 = 1 << 20;
/// Longest side of a WebP picture.
const SIDE_MAX: u32 = 16_383;
/// Centroids in a row of their picture, and most of them.
const CENTROIDS_A_ROW: usize = 64;
const CENTROIDS_MAX: usize = 65_536;
/// Bins of values from which a table is made.
const BINS: usize = 1 << 14;

fn log(v: f64) -> f64 {
    v.signum() * v.abs().ln_1p()
}

fn unlog(v: f64) -> f64 {
    v.signum() * v.abs().exp_m1()
}

/// Columns and rows of the pictures of so many Gaussians.
fn sides(count: usize) -> [usize; 2] {
    let width = ((count as f64).sqrt() / 4.0).ceil() as usize * 4;
    [width, (count.div_ceil(width)).next_multiple_of(4)]
}

fn check(file: &SplatFile) -> Result<()> {
    some(file)?;
    let count = file.gaussians.len();
    let longest = sides(count).into_iter().max().unwrap_or(0);
    if longest > SIDE_MAX as usize {
        return Err(Error::limit("sog: pixels of a side", longest, SIDE_MAX));
    }
    Ok(())
}

/// A table of values, ascending. Half of its entries divide the whole range, so that no value is
/// farther than 1/256 of it from an entry; half divide the cube root of the density, which is
/// nearly the table of least squares (Panter and Dite).
fn table(values: impl Iterator<Item = f32> + Clone) -> Vec<f32> {
    let start = [f32::INFINITY, f32::NEG_INFINITY];
    let [low, high] = values.clone().fold(start, |[a, b], v| [a.min(v), b.max(v)]);
    let wide = (high - low).max(f32::MIN_POSITIVE);
    let bin = |v: f32| (((v - low) / wide * BINS as f32) as usize).min(BINS - 1);
    let mut counts = vec![0.0_f64; BINS];
    values.for_each(|v| counts[bin(v)] += 1.0);
    let dense: Vec<f64> = counts.iter().map(|count| count.cbrt()).collect();
    let even = dense.iter().sum::<f64>() / BINS as f64;
    let shares: Vec<f64> = dense.into_iter().map(|share| share + even).collect();
    let all: f64 = shares.iter().sum();
    let (mut at, mut below) = (0, 0.0);
    let entry = |k: usize| {
        let wanted = all * (k as f64 + 0.5) / TABLE as f64;
        while at + 1 < BINS && below + shares[at] < wanted {
            below += shares[at];
            at += 1;
        }
        let within = ((wanted - below) / shares[at].max(1e-300)).clamp(0.0, 1.0);
        low + wide * ((at as f64 + within) / BINS as f64) as f32
    };
    (0..TABLE).map(entry).collect()
}

/// The nearest entry of an ascending table.
fn nearest(table: &[f32], value: f32) -> u8 {
    let above = table.partition_point(|entry| *entry < value).min(table.len() - 1);
    let below = above.saturating_sub(1);
    let is_below = value - table[below] < table[above] - value;
    (if is_below { below } else { above }) as u8
}

/// Rows of `dim` numbers in parts of alike ones, `most` at most: which part each is in, and the
/// mean of each part. Up to `most` rows are a part each.
struct Palette {
    labels: Vec<u16>,
    centroids: Vec<f32>,
}

impl Palette {
    fn of(rows: &[f32], dim: usize, most: usize) -> Self {
        let n = rows.len() / dim;
        let mut palette = Self { labels: vec![0; n], centroids: Vec::new() };
        let mut all: Vec<u32> = (0..n as u32).collect();
        palette.cut(rows, dim, &mut all, most.min(n));
        palette
    }

    fn count(&self, dim: usize) -> usize {
        self.centroids.len() / dim
    }

    /// Cuts some rows into so many parts.
    fn cut(&mut self, rows: &[f32], dim: usize, of: &mut [u32], parts: usize) {
        let number = |i: u32, d: usize| f64::from(rows[i as usize * dim + d]);
        let moment = |d: usize, power: i32| {
            of.iter().map(|i| number(*i, d).powi(power)).sum::<f64>() / of.len() as f64
        };
        let spread = |d: &usize| moment(*d, 2) - moment(*d, 1).powi(2);
        if parts < 2 {
            let label = self.count(dim) as u16;
            self.centroids.extend((0..dim).map(|d| moment(d, 1) as f32));
            of.iter().for_each(|i| self.labels[*i as usize] = label);
            return;
        }
        let widest = (0..dim).max_by(|a, b| spread(a).total_cmp(&spread(b))).unwrap_or(0);
        let middle = of.len() / 2;
        of.select_nth_unstable_by(middle, |a, b| number(*a, widest).total_cmp(&number(*b, widest)));
        let (low, high) = of.split_at_mut(middle);
        self.cut(rows, dim, low, parts / 2);
        self.cut(rows, dim, high, parts - parts / 2);
    }
}

/// The three smaller numbers and 252 plus the place of the largest, which is positive.
fn packed_quat(quat: [f32; 4]) -> [u8; 4] {
    let largest = (0..4).fold(0, |a, b| if quat[b].abs() > quat[a].abs() { b } else { a });
    let sign = quat[largest].signum();
    let mut packed = [252 + largest as u8; 4];
    let rest = quat.into_iter().enumerate().filter(|(k, _)| *k != largest);
    for (to, (_, q)) in packed.iter_mut().zip(rest) {
        *to = steps(q * sign * FRAC_1_SQRT_2 + 0.5, 255) as u8;
    }
    packed
}

/// The rotation as w x y z; none where the fourth byte names no place.
fn unpacked_quat([a, b, c, tag]: [u8; 4]) -> [f32; 4] {
    let Some(largest) = tag.checked_sub(252).map(usize::from) else { return [1.0, 0.0, 0.0, 0.0] };
    let mut rest = [a, b, c].into_iter().map(|q| (f32::from(q) / 255.0 - 0.5) * SQRT_2);
    let mut quat = [0.0_f32; 4];
    for k in (0..4).filter(|k| *k != largest) {
        quat[k] = rest.next().unwrap_or(0.0);
    }
    quat[largest] = (1.0 - quat.iter().map(|q| q * q).sum::<f32>()).max(0.0).sqrt();
    quat
}

/// A picture of so many columns and rows; what is left of it is 0.
fn webp([width, height]: [usize; 2], pixels: impl Iterator<Item = [u8; 4]>) -> io::Result<Vec<u8>> {
    let mut rgba: Vec<u8> = pixels.flatten().collect();
    rgba.resize(4 * width * height, 0);
    let mut webp = Vec::new();
    WebPEncoder::new_lossless(&mut webp)
        .write_image(&rgba, width as u32, height as u32, ExtendedColorType::Rgba8)
        .map_err(io::Error::other)?;
    Ok(webp)
}

fn write(file: &SplatFile, to: &mut dyn Write) -> io::Result<()> {
    let gaussians = &file.gaussians;
    let order = morton_order(&(0..gaussians.len() as u32), gaussians.means());
    // Not streamed: some readers of zips want sizes before the bytes.
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in files(gaussians, &order, file.antialiased)? {
        let stored = SimpleFileOptions::default().compression_method(CompressionMethod::Stored);
        zip.start_file(name, stored)?;
        zip.write_all(&bytes)?;
    }
    to.write_all(zip.finish()?.get_ref())
}

/// The files of a bundle that has the Gaussians in this order.
pub(super) fn files(
    gaussians: &Gaussians,
    order: &[u32],
    antialiased: bool,
) -> io::Result<Vec<(&'static str, Vec<u8>)>> {
    let (n, k) = (gaussians.len(), gaussians.sh_count());
    let [width, height] = sides(n);
    let place = |i: usize| world(gaussians, i).to_array().map(log);
    let start = [[f64::INFINITY; 3], [f64::NEG_INFINITY; 3]];
    let [mins, maxs] = (0..n).map(place).fold(start, |[low, high], at| {
        [0, 1].map(|of| {
            std::array::from_fn(|a| match of {
                0 => low[a].min(at[a]),
                _ => high[a].max(at[a]),
            })
        })
    });
    let position = |i: usize| -> [u16; 3] {
        let at = place(i);
        std::array::from_fn(|a| {
            let wide = maxs[a] - mins[a];
            let share = if wide > 0.0 { (at[a] - mins[a]) / wide } else { 0.0 };
            (share * 65_535.0).round() as u16
        })
    };
    let scales = table(gaussians.scales().iter().flatten().map(|scale| scale.ln()));
    let colors = table(gaussians.sh().iter().step_by(k).flatten().copied());
    let mut files = Vec::new();
    let picture = |pixel: &dyn Fn(usize) -> [u8; 4]| {
        webp([width, height], order.iter().map(|&i| pixel(i as usize)))
    };
    let byte = |i: usize, of: usize| {
        let [x, y, z] = position(i).map(|at| at.to_le_bytes()[of]);
        [x, y, z, 255]
    };
    files.push(("means_l.webp", picture(&|i| byte(i, 0))?));
    files.push(("means_u.webp", picture(&|i| byte(i, 1))?));
    files.push(("quats.webp", picture(&|i| packed_quat(gaussians.quats()[i]))?));
    files.push((
        "scales.webp",
        picture(&|i| {
            let [x, y, z] = gaussians.scales()[i].map(|scale| nearest(&scales, scale.ln()));
            [x, y, z, 255]
        })?,
    ));
    files.push((
        "sh0.webp",
        picture(&|i| {
            let [r, g, b] = gaussians.sh()[i * k].map(|c| nearest(&colors, c));
            [r, g, b, steps(gaussians.opacities()[i], 255).max(1) as u8]
        })?,
    ));
    let mut meta = json!({
        "version": 2,
        "asset": { "generator": concat!("segsplat ", env!("CARGO_PKG_VERSION")) },
        "count": n,
        "means": { "mins": mins, "maxs": maxs, "files": ["means_l.webp", "means_u.webp"] },
        "scales": { "codebook": scales, "files": ["scales.webp"] },
        "quats": { "files": ["quats.webp"] },
        "sh0": { "codebook": colors, "files": ["sh0.webp"] },
    });
    if antialiased {
        meta["model"] = json!(ANTIALIASED);
    }
    if k > 1 {
        let dim = 3 * (k - 1);
        let rest = gaussians.sh().chunks_exact(k).flat_map(|row| row[1..].as_flattened());
        let rows: Vec<f32> = rest.copied().collect();
        let palette = Palette::of(&rows, dim, CENTROIDS_MAX);
        drop(rows);
        let (numbers, count) = (&palette.centroids, palette.count(dim));
        let codebook = table(numbers.iter().copied());
        let (pixels, _) = numbers.as_chunks::<3>();
        let pixels = pixels.iter().map(|&rgb| {
            let [r, g, b] = rgb.map(|c| nearest(&codebook, c));
            [r, g, b, 255]
        });
        let sides = [CENTROIDS_A_ROW * (k - 1), count.div_ceil(CENTROIDS_A_ROW)];
        files.push(("shN_centroids.webp", webp(sides, pixels)?));
        let label = |i: usize| {
            let [low, high] = palette.labels[i].to_le_bytes();
            [low, high, 0, 255]
        };
        files.push(("shN_labels.webp", picture(&label)?));
        meta["shN"] = json!({
            "count": count, "bands": gaussians.sh_degree(), "codebook": codebook,
            "files": ["shN_centroids.webp", "shN_labels.webp"],
        });
    }
    files.push(("meta.json", meta.to_string().into_bytes()));
    Ok(files)
}

fn bad(why: impl std::fmt::Display) -> Error {
    Error::invalid(format!("SOG: {why}"))
}

// The parts of `meta.json` that are read.

#[derive(Deserialize)]
struct Meta {
    version: Option<u32>,
    #[serde(default)]
    count: usize,
    /// `antialiased` or `2dgs`, where it is not the usual one.
    model: Option<serde_json::Value>,
    means: Option<Bounded>,
    scales: Option<Table>,
    quats: Option<Files>,
    sh0: Option<Table>,
    #[serde(rename = "shN")]
    harmonics: Option<Harmonics>,
}

#[derive(Deserialize)]
struct Bounded {
    mins: [f64; 3],
    maxs: [f64; 3],
    files: [String; 2],
}

#[derive(Deserialize)]
struct Table {
    codebook: Vec<f32>,
    files: [String; 1],
}

#[derive(Deserialize)]
struct Files {
    files: [String; 1],
}

#[derive(Deserialize)]
struct Harmonics {
    count: usize,
    bands: u8,
    codebook: Vec<f32>,
    files: [String; 2],
}

/// A bundle in memory.
struct Bundle<'a> {
    zip: &'a [u8],
    limits: &'a Limits,
}

impl Bundle<'_> {
    /// A file of the bundle, not over so many bytes.
    fn file(&self, wanted: &str, bytes_max: u64) -> Result<Vec<u8>> {
        let shown = short(wanted);
        let damaged = || bad("the zip is damaged or cut short");
        let config = zip::read::Config::default();
        let mut zip = ZipIterable::try_new(Cursor::new(self.zip), config).map_err(|_| damaged())?;
        if zip.len() > FILES_MAX {
            return Err(Error::limit("SOG: files of the zip", zip.len(), FILES_MAX));
        }
        for entry in zip.files().map_err(|_| damaged())? {
            let entry = entry.map_err(|_| damaged())?;
            if entry.name().map_err(|_| damaged())? != wanted {
                continue;
            }
            let mut body = Cursor::new(self.zip);
            let entry = entry.with_reader(&mut body, ZipReadOptions::new());
            let entry = entry.map_err(|_| bad(format!("{shown:?} is packed in an unknown way")))?;
            let mut bytes = Vec::new();
            let read = entry.take(bytes_max.saturating_add(1)).read_to_end(&mut bytes);
            read.map_err(|_| bad(format!("{shown:?} is damaged or cut short")))?;
            if bytes.len() as u64 > bytes_max {
                return Err(Error::limit(format!("SOG: bytes of {shown:?}"), "more", bytes_max));
            }
            return Ok(bytes);
        }
        Err(bad(format!("the zip has no {shown:?}")))
    }

    /// Columns and pixels of a picture that has so many pixels at least.
    fn picture(&self, name: &str, pixels_min: usize) -> Result<(usize, Vec<[u8; 4]>)> {
        let shown = short(name);
        let webp = self.file(name, self.limits.splats_bytes_max)?;
        let damaged = || bad(format!("{shown:?} is no WebP picture that can be read"));
        let decoder = WebPDecoder::new(Cursor::new(&webp)).map_err(|_| damaged())?;
        let (width, height) = decoder.dimensions();
        let pixels = width as usize * height as usize;
        // Some rows more than are needed, as writers round them up.
        let most = 2 * pixels_min + 64 * SIDE_MAX as usize;
        if pixels < pixels_min || pixels > most {
            return Err(bad(format!(
                "{shown:?} has {width} x {height} pixels; {pixels_min} to {most} are read"
            )));
        }
        let samples = decoder.color_type().bytes_per_pixel() as usize;
        let mut bytes = vec![0; pixels * samples];
        decoder.read_image(&mut bytes).map_err(|_| damaged())?;
        let pixel = |p: &[u8]| [p[0], p[1], p[2], p.get(3).copied().unwrap_or(255)];
        Ok((width as usize, bytes.chunks_exact(samples).map(pixel).collect()))
    }
}

/// The number of a table; 0 where it has no such entry, as in the reference.
fn looked_up(table: &[f32], at: u8) -> f32 {
    table.get(usize::from(at)).copied().unwrap_or(0.0)
}

fn read(from: &mut dyn BufRead, limits: &Limits) -> Result<SplatsRead> {
    let mut zip = Vec::new();
    let max = limits.splats_bytes_max;
    from.take(max.saturating_add(1)).read_to_end(&mut zip).map_err(unreadable)?;
    if zip.len() as u64 > max {
        return Err(Error::limit("SOG: bytes", "more", max));
    }
    let bundle = Bundle { zip: &zip, limits };
    let meta = bundle.file("meta.json", META_BYTES_MAX)?;
    let meta: Meta = serde_json::from_slice(&meta).map_err(|e| bad(format!("meta.json: {e}")))?;
    match meta.version {
        Some(2) => {}
        Some(other) => return Err(bad(format!("version {other}; 2 is read"))),
        None => return Err(bad("meta.json says no version: version 1 is not read, 2 is")),
    }
    let n = meta.count;
    let degree = meta.harmonics.as_ref().map_or(0, |harmonics| harmonics.bands);
    if degree > 3 {
        return Err(bad(format!("harmonics of degree {degree}; 0 to 3 are read")));
    }
    check_count("SOG: Gaussians", n, degree, limits)?;
    if n == 0 {
        return Err(bad("meta.json says 0 Gaussians"));
    }
    let lacks = |name: &str| bad(format!("meta.json has no {name:?}"));
    let means = meta.means.ok_or_else(|| lacks("means"))?;
    let scales = meta.scales.ok_or_else(|| lacks("scales"))?;
    let quats = meta.quats.ok_or_else(|| lacks("quats"))?;
    let colors = meta.sh0.ok_or_else(|| lacks("sh0"))?;
    let mut raw = begun(n, degree);
    let [low, high] = [0, 1].map(|of| bundle.picture(&means.files[of], n));
    let (low, high) = (low?.1, high?.1);
    // Far scenes are kept near the bound next to zero, where f32 is fine enough.
    let origin: [f64; 3] = std::array::from_fn(|a| match [means.mins[a], means.maxs[a]] {
        [min, _] if min > 0.0 => unlog(min),
        [_, max] if max < 0.0 => unlog(max),
        _ => 0.0,
    });
    raw.origin = DVec3::from_array(origin);
    if !raw.origin.is_finite() {
        return Err(bad("the bounds of the positions are not finite"));
    }
    for (low, high) in low.iter().zip(&high).take(n) {
        raw.means.push(std::array::from_fn(|a| {
            let share = f64::from(u16::from_le_bytes([low[a], high[a]])) / 65_535.0;
            let at = unlog(means.mins[a] + (means.maxs[a] - means.mins[a]) * share);
            (at - origin[a]) as f32
        }));
    }
    drop((low, high));
    let (_, pixels) = bundle.picture(&quats.files[0], n)?;
    raw.quats.extend(pixels.iter().take(n).map(|pixel| unpacked_quat(*pixel)));
    let (_, pixels) = bundle.picture(&scales.files[0], n)?;
    raw.scales.extend(
        pixels
            .iter()
            .take(n)
            .map(|&[x, y, z, _]| [x, y, z].map(|at| looked_up(&scales.codebook, at).exp())),
    );
    let (_, pixels) = bundle.picture(&colors.files[0], n)?;
    let k = (usize::from(degree) + 1).pow(2);
    for (i, &[r, g, b, opacity]) in pixels.iter().take(n).enumerate() {
        raw.sh.push([r, g, b].map(|at| looked_up(&colors.codebook, at)));
        raw.sh.resize((i + 1) * k, [0.0; 3]);
        raw.opacities.push(f32::from(opacity) / 255.0);
    }
    if let Some(harmonics) = meta.harmonics.filter(|_| degree > 0) {
        bundle.read_harmonics(&harmonics, &mut raw.sh, n)?;
    }
    fill_rest(&mut raw);
    let antialiased = meta.model.is_some_and(|model| model == ANTIALIASED);
    Ok(SplatsRead::new(&SOG, raw, None)?.antialiased(antialiased))
}

impl Bundle<'_> {
    /// The coefficients over degree 0 of all Gaussians, `[N, K, 3]`.
    fn read_harmonics(&self, of: &Harmonics, sh: &mut [[f32; 3]], n: usize) -> Result<()> {
        let k = sh.len() / n;
        if of.count > CENTROIDS_MAX {
            return Err(Error::limit("SOG: centroids", of.count, CENTROIDS_MAX));
        }
        let wanted = CENTROIDS_A_ROW * (k - 1);
        let rows = of.count.div_ceil(CENTROIDS_A_ROW);
        let (width, centroids) = self.picture(&of.files[0], wanted * rows)?;
        if width != wanted {
            let name = short(&of.files[0]);
            return Err(bad(format!("{name:?} is {width} pixels wide; it must be {wanted}")));
        }
        let (_, labels) = self.picture(&of.files[1], n)?;
        for (row, label) in sh.chunks_exact_mut(k).zip(labels) {
            let label = usize::from(u16::from_le_bytes([label[0], label[1]]));
            if label >= of.count {
                return Err(bad(format!("a label is {label}; there are {} centroids", of.count)));
            }
            let centroid = &centroids[label * (k - 1)..(label + 1) * (k - 1)];
            for (to, &[r, g, b, _]) in row[1..].iter_mut().zip(centroid) {
                *to = [r, g, b].map(|at| looked_up(&of.codebook, at));
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_that_are_alike_share_a_part() {
        // Eight places, far from each other, of 100 rows each, one after the other.
        let place = |i: usize| [0, 1, 2].map(|d| if i >> d & 1 == 1 { 5.0_f32 } else { -5.0 });
        let near = |i: usize, d: usize| ((i * 37 + d * 11) % 100) as f32 / 1000.0;
        let row = |i: usize| [0, 1, 2].map(|d| place(i)[d] + near(i, d));
        let rows: Vec<f32> = (0..800).flat_map(row).collect();
        let palette = Palette::of(&rows, 3, 8);
        assert_eq!(palette.count(3), 8);
        for i in 0..800 {
            let at = 3 * usize::from(palette.labels[i]);
            let centroid = &palette.centroids[at..at + 3];
            let off = centroid.iter().zip(row(i)).map(|(a, b)| (a - b).abs()).fold(0.0, f32::max);
            assert!(off < 0.1, "row {i}: {centroid:?}");
        }
        // As many parts as rows: each has its own numbers.
        let palette = Palette::of(&rows, 3, 800);
        let own = (0..800).all(|i| {
            let at = 3 * usize::from(palette.labels[i]);
            palette.centroids[at..at + 3] == row(i)
        });
        assert!(own && palette.count(3) == 800);
        // Rows that are all the same.
        let palette = Palette::of(&[0.5; 30], 3, 4);
        assert!(palette.centroids.iter().all(|c| *c == 0.5));
    }
}
