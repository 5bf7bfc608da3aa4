//! Decodes photos. The header and the limits are checked before the pixels. A JPEG too large to be
//! decoded whole, or larger than is asked for, is decoded at a half or a quarter of its size.

use std::io::Cursor;

use image::{
    DynamicImage, ImageDecoder, ImageFormat, ImageReader, imageops, metadata::Orientation,
};

use super::{exif, kinds};
use crate::{
    error::{Error, Result},
    limits::Limits,
    scene::{Intrinsics, Photo},
};

/// What the header of a photo says.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Header {
    format: ImageFormat,
    pub(super) width: u32,
    pub(super) height: u32,
    /// How EXIF says that the photo is to be turned to be upright.
    pub(super) orientation: Orientation,
    /// The photo is decoded at one over this of its size.
    pub(super) reduction: u32,
    /// All of its coefficients are in memory before a pixel is: a reduced progressive JPEG.
    is_whole_first: bool,
}

impl Header {
    /// Width and height, pixels, as stored.
    pub(super) fn size(&self) -> [u32; 2] {
        [self.width, self.height]
    }

    /// Width and height, pixels, after a turn.
    pub(super) fn size_after(&self, turn: Orientation) -> [u32; 2] {
        let [w, h] = self.size();
        if swaps_sides(turn) { [h, w] } else { [w, h] }
    }

    /// Width and height at which it is decoded, pixels.
    fn decoded_size(&self) -> [u32; 2] {
        self.size().map(|side| side.div_ceil(self.reduction))
    }

    /// Pixels that are decoded.
    pub(super) fn decoded_pixels(&self) -> u64 {
        self.decoded_size().map(u64::from).into_iter().product()
    }

    /// The same of a photo whose longer side need not be over `side` pixels: decoded at the least
    /// part of its size that has as many, where that takes less memory than all of it.
    pub(super) fn at_least(self, side: u32, bytes: &[u8]) -> Self {
        let longer = self.width.max(self.height);
        let mut smaller = REDUCTIONS.into_iter().rev().filter(|by| longer / by >= side);
        match smaller.next().filter(|by| *by > self.reduction && is_reducible(self.format, bytes)) {
            Some(reduction) => Self { reduction, ..self },
            None => self,
        }
    }

    /// Pixels that take memory while it is decoded: some 7 bytes each, as coefficients do at most.
    pub(super) fn working_pixels(&self) -> u64 {
        match self.is_whole_first {
            true => u64::from(self.width) * u64::from(self.height),
            false => self.decoded_pixels(),
        }
    }
}

/// Whether a turn makes width of height.
pub(super) fn swaps_sides(turn: Orientation) -> bool {
    turn.to_exif() >= 5
}

/// Reductions that a JPEG can be decoded at.
const REDUCTIONS: [u32; 3] = [1, 2, 4];
/// Bytes that decoding a photo takes at most, for each pixel of the largest that is taken in any
/// format: four channels of 16 bits.
const BYTES_A_PIXEL: u64 = 8;
/// Progressive JPEGs are kept whole as coefficients while they are decoded, so of these no more
/// pixels are taken than this many times the limit: 120 megapixels take at most 0.7 GiB, and are
/// decoded alone.
const PROGRESSIVE_TIMES: u64 = 5;

/// A decoder that takes memory for the deepest pixel (RGBA of 16 bits) and working space at most.
fn reader<'a>(
    bytes: &'a [u8],
    format: ImageFormat,
    limits: &Limits,
) -> ImageReader<Cursor<&'a [u8]>> {
    let mut bounds = image::Limits::default();
    let pixels = limits.photo_pixels_max.saturating_mul(BYTES_A_PIXEL);
    bounds.max_alloc = Some(pixels.saturating_add(64 << 20));
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(bounds);
    reader
}

/// Size and format, read without decoding, and checked against the limits.
pub(super) fn header(bytes: &[u8], what: &str, limits: &Limits) -> Result<Header> {
    if bytes.is_empty() {
        return Err(Error::photo(format!("{what}: the file is empty")));
    }
    let format = kinds::of(bytes).map_err(|why| Error::photo(format!("{what}: {why}")))?;
    let damaged = |e: image::ImageError| {
        let name = kinds::name(format);
        Error::photo(format!("{what}: the {name} header is damaged")).caused_by(e)
    };
    // The PNG decoder refuses absurd sizes by memory; the size itself is the better message.
    let of_png = png_size(bytes, format);
    let (width, height) = match of_png {
        Some(size) => size,
        None => reader(bytes, format, limits).into_dimensions().map_err(damaged)?,
    };
    if width == 0 || height == 0 {
        return Err(Error::photo(format!("{what}: {width}x{height} px; no side may be 0")));
    }
    let orientation = match format {
        ImageFormat::Png => png_orientation(bytes),
        // What cannot be read of it says nothing.
        _ => reader(bytes, format, limits).into_decoder().and_then(|mut d| d.orientation()).ok(),
    };
    let orientation = orientation.unwrap_or(Orientation::NoTransforms);
    let (pixels, max) = (u64::from(width) * u64::from(height), limits.photo_pixels_max);
    let is_whole_first = format == ImageFormat::Jpeg && pixels > max && is_progressive(bytes);
    let header =
        |reduction| Header { format, width, height, orientation, reduction, is_whole_first };
    let reduction = match format {
        _ if pixels <= max => Some(1),
        ImageFormat::Jpeg => {
            let fits = |reduction: &u32| header(*reduction).decoded_pixels() <= max;
            let taken = !is_whole_first || pixels <= PROGRESSIVE_TIMES.saturating_mul(max);
            REDUCTIONS.into_iter().find(fits).filter(|_| taken)
        }
        _ => {
            let color = reader(bytes, format, limits).into_decoder().map(|d| d.color_type());
            // Other pixels become RGB beside themselves.
            let taken = |color: image::ColorType| match color {
                image::ColorType::Rgb8 => 3,
                _ => u64::from(color.bytes_per_pixel()) + 4,
            };
            let bytes = color.map_or(u64::MAX, |color| pixels.saturating_mul(taken(color)));
            (bytes <= max.saturating_mul(BYTES_A_PIXEL)).then_some(1)
        }
    };
    let Some(reduction) = reduction else {
        let bound = match format {
            ImageFormat::Jpeg if is_whole_first => {
                let bound = PROGRESSIVE_TIMES.saturating_mul(max);
                format!("{bound} px of a progressive JPEG; save it as a baseline JPEG")
            }
            ImageFormat::Jpeg => format!("{} px of a JPEG", max.saturating_mul(16)),
            _ => format!("{max} px of a {}; as JPEG larger ones are read", kinds::name(format)),
        };
        return Err(Error::limit(what, format!("{width}x{height} px"), bound));
    };
    if format == ImageFormat::Jpeg && !jpeg_ends(bytes) {
        return Err(Error::photo(format!(
            "{what}: the JPEG is cut short ({} bytes, no end marker)",
            bytes.len()
        )));
    }
    Ok(header(reduction))
}

/// Focal length of the EXIF of a photo, pixels of a picture of this size.
pub(super) fn focal(bytes: &[u8], header: &Header, size: [u32; 2]) -> Option<f64> {
    let exif = match header.format {
        ImageFormat::Png => png_exif(bytes)?.to_vec(),
        // Their decoders take limits of memory that a header needs none of.
        ImageFormat::Jpeg | ImageFormat::WebP | ImageFormat::Tiff => {
            let mut decoder =
                ImageReader::with_format(Cursor::new(bytes), header.format).into_decoder().ok()?;
            decoder.exif_metadata().ok()??
        }
        _ => return None,
    };
    exif::focal(&exif, size)
}

/// Width and height of a PNG's first chunk.
fn png_size(bytes: &[u8], format: ImageFormat) -> Option<(u32, u32)> {
    if format != ImageFormat::Png || bytes.get(12..16) != Some(b"IHDR") {
        return None;
    }
    let word = |at: usize| Some(u32::from_be_bytes(bytes.get(at..at + 4)?.try_into().ok()?));
    Some((word(16)?, word(20)?))
}

/// How a PNG's EXIF chunk says that it is to be turned.
fn png_orientation(bytes: &[u8]) -> Option<Orientation> {
    Orientation::from_exif_chunk(png_exif(bytes)?)
}

/// A PNG's EXIF chunk.
fn png_exif(bytes: &[u8]) -> Option<&[u8]> {
    let mut rest = bytes.get(8..)?;
    loop {
        let (length, named) = rest.split_first_chunk::<4>()?;
        let end = (u32::from_be_bytes(*length) as usize).saturating_add(12);
        if named.starts_with(b"eXIf") {
            return rest.get(8..end - 4);
        }
        rest = rest.get(end..)?;
    }
}

/// A PNG's signature and those of its chunks that make the picture. Others can be packed texts and
/// profiles that a decoder would unpack to hundreds of megabytes.
fn picture_of_png(bytes: &[u8]) -> Vec<u8> {
    let (signature, mut rest) = bytes.split_at(bytes.len().min(8));
    let mut kept = signature.to_vec();
    while let Some((length, name)) = rest.split_first_chunk::<4>() {
        // Length, name, data, checksum. The decoder refuses a chunk that is cut short.
        let end = (u32::from_be_bytes(*length) as usize).saturating_add(12).min(rest.len());
        let (chunk, after) = rest.split_at(end);
        if [b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"].iter().any(|n| name.starts_with(*n)) {
            kept.extend_from_slice(chunk);
        }
        rest = after;
    }
    kept
}

/// Whether the JPEG's data reaches its end-of-image marker. The decoder fills a missing rest with
/// grey and reports no error.
fn jpeg_ends(bytes: &[u8]) -> bool {
    has_marker(bytes, |marker| marker == 0xD9)
}

/// Whether fewer pixels take less memory: of a JPEG of one scan, in colours that can be reduced.
fn is_reducible(format: ImageFormat, bytes: &[u8]) -> bool {
    if format != ImageFormat::Jpeg || is_progressive(bytes) {
        return false;
    }
    let mut decoder = jpeg_decoder::Decoder::new(bytes);
    let kind = decoder.read_info().ok().and_then(|()| decoder.info()).map(|it| it.pixel_format);
    matches!(kind, Some(jpeg_decoder::PixelFormat::L8 | jpeg_decoder::PixelFormat::RGB24))
}

/// Whether all scans of a JPEG must be there before a pixel is: it has several.
fn is_progressive(bytes: &[u8]) -> bool {
    let mut scans = 0;
    let is_so = |marker| {
        scans += usize::from(marker == 0xDA);
        marker == 0xC2 || scans > 1
    };
    has_marker(bytes, is_so)
}

/// Whether a marker of a JPEG is one of those looked for.
fn has_marker(bytes: &[u8], mut is_one: impl FnMut(u8) -> bool) -> bool {
    let mut at = 2;
    let mut in_scan = false;
    while at + 1 < bytes.len() {
        if bytes[at] != 0xFF {
            if !in_scan {
                return false;
            }
            at += 1;
            continue;
        }
        match bytes[at + 1] {
            marker if !matches!(marker, 0xFF | 0x00) && is_one(marker) => return true,
            0xD9 => return false,
            0xFF => at += 1,
            0x00 | 0x01 | 0xD0..=0xD8 => at += 2,
            marker => {
                let Some(&[high, low]) = bytes.get(at + 2..at + 4).and_then(|b| b.first_chunk())
                else {
                    return false;
                };
                at += 2 + usize::from(u16::from_be_bytes([high, low]));
                in_scan = marker == 0xDA;
            }
        }
    }
    false
}

/// The pixels as 8-bit RGB, after a turn. Grey is repeated, 16 bits are rounded to 8, and pixels
/// that are more transparent than not are no part of the photo (not valid).
pub(super) fn pixels(
    bytes: &[u8],
    header: &Header,
    turn: Orientation,
    what: &str,
    limits: &Limits,
) -> Result<Photo> {
    let mut decoded = decoded(bytes, header, what, limits)?;
    decoded.apply_orientation(turn);
    let (width, height) = (decoded.width(), decoded.height());
    if !decoded.color().has_alpha() {
        return Ok(Photo { width, height, rgb: decoded.into_rgb8().into_raw(), valid: None });
    }
    let rgba = decoded.into_rgba8();
    let valid: Vec<bool> = rgba.pixels().map(|p| p.0[3] >= 128).collect();
    let rgb = rgba.pixels().flat_map(|p| [p.0[0], p.0[1], p.0[2]]).collect();
    let valid = valid.contains(&false).then_some(valid);
    Ok(Photo { width, height, rgb, valid })
}

/// The pixels of a mask that are kept.
pub(super) struct Kept {
    /// Width and height, pixels.
    pub(super) size: [u32; 2],
    /// `[height * width]`
    pub(super) pixels: Vec<bool>,
}

/// The pixels of a mask that are not black and not transparent. The black of a JPEG is not exact:
/// there they are those over half of white.
pub(super) fn kept(bytes: &[u8], header: &Header, what: &str, limits: &Limits) -> Result<Kept> {
    let decoded = decoded(bytes, header, what, limits)?;
    let least = if header.format == ImageFormat::Jpeg { 1 << 15 } else { 1 };
    let size = [decoded.width(), decoded.height()];
    // 16 bits, so that a 1 of 65,535 is no 0.
    let luma = decoded.into_luma_alpha16();
    let pixels = luma.pixels().map(|p| p.0[0] >= least && p.0[1] >= 1 << 15).collect();
    Ok(Kept { size, pixels })
}

/// The picture as stored.
fn decoded(bytes: &[u8], header: &Header, what: &str, limits: &Limits) -> Result<DynamicImage> {
    let bare = (header.format == ImageFormat::Png).then(|| picture_of_png(bytes));
    let bytes = bare.as_deref().unwrap_or(bytes);
    let damaged = || {
        let format = kinds::name(header.format);
        Error::photo(format!("{what}: the {format} data is damaged or cut short"))
    };
    let decoded = match header.reduction {
        1 => reader(bytes, header.format, limits).decode().map_err(|e| damaged().caused_by(e))?,
        _ => reduced_jpeg(bytes, header).map_err(|e| damaged().caused_by(e))?.ok_or_else(|| {
            Error::photo(format!("{what}: a large JPEG of other colours than RGB and grey"))
        })?,
    };
    let [width, height] = [decoded.width(), decoded.height()];
    if [width, height] != header.decoded_size() {
        return Err(Error::photo(format!(
            "{what}: the header says {}x{} px, the data {width}x{height} px",
            header.width, header.height
        )));
    }
    Ok(decoded)
}

/// A JPEG decoded at a part of its size, by fewer frequencies of each block; `None` for CMYK.
fn reduced_jpeg(
    bytes: &[u8],
    header: &Header,
) -> std::result::Result<Option<DynamicImage>, jpeg_decoder::Error> {
    let mut decoder = jpeg_decoder::Decoder::new(bytes);
    let [width, height] = header.decoded_size();
    let side = |side: u32| u16::try_from(side).unwrap_or(u16::MAX);
    decoder.scale(side(width), side(height))?;
    let pixels = decoder.decode()?;
    let Some(info) = decoder.info() else { return Ok(None) };
    let (width, height) = (u32::from(info.width), u32::from(info.height));
    Ok(match info.pixel_format {
        jpeg_decoder::PixelFormat::L8 => {
            image::GrayImage::from_raw(width, height, pixels).map(DynamicImage::from)
        }
        jpeg_decoder::PixelFormat::RGB24 => {
            image::RgbImage::from_raw(width, height, pixels).map(DynamicImage::from)
        }
        _ => None,
    })
}

/// The photo with its longer side at most `side_max`, intrinsics following exactly.
///
/// 64 photos of 24 megapixels would take 4.6 GB.
pub(super) fn at_most(photo: Photo, k: Intrinsics, side_max: u32) -> (Photo, Intrinsics) {
    let longer = photo.width.max(photo.height);
    if longer <= side_max {
        return (photo, k);
    }
    let scaled = |side: u32| {
        let side =
            (u64::from(side) * u64::from(side_max) + u64::from(longer) / 2) / u64::from(longer);
        u32::try_from(side).unwrap_or(side_max).max(1)
    };
    let (width, height) = (scaled(photo.width), scaled(photo.height));
    let Photo { width: w0, height: h0, rgb, valid } = photo;
    let full = image::RgbImage::from_raw(w0, h0, rgb)
        .expect("a photo holds 3 bytes a pixel; this is a bug");
    let rgb = imageops::resize(&full, width, height, imageops::FilterType::Triangle).into_raw();
    let valid = valid.map(|valid| {
        // Valid only where the footprint's corners and centre are.
        let source = |i: u32, n: u32, n0: u32, part: u64| {
            let at = (u64::from(i) * 2 + part) * u64::from(n0) / (2 * u64::from(n));
            usize::try_from(at.min(u64::from(n0) - 1)).unwrap_or(0)
        };
        let mut small = Vec::with_capacity((width * height) as usize);
        for y in 0..height {
            for x in 0..width {
                small.push((0..3).all(|py| {
                    let row = source(y, height, h0, py) * w0 as usize;
                    (0..3).all(|px| valid[row + source(x, width, w0, px)])
                }));
            }
        }
        small
    });
    (Photo { width, height, rgb, valid }, k.resized(width, height))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn of_a_png_only_the_picture_is_decoded() {
        let image = image::RgbImage::from_fn(40, 30, |x, y| image::Rgb([x as u8, y as u8, 90]));
        let mut out = Cursor::new(Vec::new());
        image.write_to(&mut out, ImageFormat::Png).unwrap();
        let png = out.into_inner();
        assert_eq!(picture_of_png(&png), png, "there is nothing else in it");
        let text = [&[0, 0, 0, 3][..], b"zTXt", b"abc", &[1, 2, 3, 4]].concat();
        let with = [&png[..33], &text, &png[33..]].concat();
        assert_eq!(picture_of_png(&with), png);
        for cut in 0..png.len() {
            assert!(png.starts_with(&picture_of_png(&png[..cut])), "{cut}");
        }
    }

    #[test]
    fn a_photo_that_may_be_smaller_is_decoded_smaller_where_that_takes_less_memory() {
        let limits = Limits::default();
        let rgb = image::RgbImage::from_fn(640, 480, |x, y| image::Rgb([x as u8, y as u8, 90]));
        let written = |format: ImageFormat| {
            let mut out = Cursor::new(Vec::new());
            rgb.write_to(&mut out, format).unwrap();
            out.into_inner()
        };
        let decoded = |bytes: &[u8], side: u32| {
            let header = header(bytes, "a photo", &limits).unwrap().at_least(side, bytes);
            let photo = pixels(bytes, &header, Orientation::NoTransforms, "a photo", &limits);
            let Photo { width, height, rgb, .. } = photo.unwrap();
            assert_eq!(header.decoded_pixels(), u64::from(width) * u64::from(height));
            ([width, height], rgb)
        };
        let jpeg = written(ImageFormat::Jpeg);
        let sides = [(640, 640), (321, 640), (320, 320), (161, 320), (160, 160), (16, 160)];
        for (side, width) in sides {
            assert_eq!(decoded(&jpeg, side).0, [width, width * 3 / 4], "for {side}");
        }
        let [whole, quarter] = [640, 160].map(|side| decoded(&jpeg, side).1);
        let mean = |rgb: &[u8]| rgb.iter().map(|v| f64::from(*v)).sum::<f64>() / rgb.len() as f64;
        assert!((mean(&whole) - mean(&quarter)).abs() < 1.0, "the same picture");
        assert_eq!(decoded(&written(ImageFormat::Png), 16).0, [640, 480], "no other format");
        let progressive = include_bytes!("../../tests/fixtures/progressive.jpg");
        assert_eq!(decoded(progressive, 16).0, [64, 48], "all its coefficients are kept anyway");
    }

    #[test]
    fn a_progressive_jpeg_is_reduced_up_to_five_times_the_limit_and_counts_whole() {
        let jpeg = include_bytes!("../../tests/fixtures/progressive.jpg");
        let read = |photo_pixels_max: u64| {
            let limits = Limits { photo_pixels_max, ..Limits::default() };
            let header = header(jpeg, "a photo", &limits)?;
            let photo = pixels(jpeg, &header, Orientation::NoTransforms, "a photo", &limits)?;
            Ok::<_, Error>((header.working_pixels(), [photo.width, photo.height]))
        };
        assert_eq!(read(64 * 48).unwrap(), (64 * 48, [64, 48]), "whole");
        assert_eq!(read(64 * 48 / 4).unwrap(), (64 * 48, [32, 24]), "at a half, alone");
        assert_eq!(read(64 * 48 / 5 + 1).unwrap(), (64 * 48, [16, 12]), "at a quarter");
        let told = read(64 * 48 / 5 - 1).unwrap_err();
        assert!(told.message().contains("3065 px of a progressive JPEG"), "{told}");
    }
}
