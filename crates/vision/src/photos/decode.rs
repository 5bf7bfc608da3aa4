//! Decodes JPEG, PNG and WebP. The header and the limits are checked before the pixels.

use std::io::Cursor;

use image::{ImageFormat, ImageReader, imageops};

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
}

impl Header {
    /// Width and height, pixels.
    pub(super) fn size(&self) -> [u32; 2] {
        [self.width, self.height]
    }
}

/// A decoder that takes memory for the deepest pixel (RGBA of 16 bits) and working space at most.
fn reader<'a>(
    bytes: &'a [u8],
    format: ImageFormat,
    limits: &Limits,
) -> ImageReader<Cursor<&'a [u8]>> {
    let mut bounds = image::Limits::default();
    bounds.max_alloc = Some(limits.photo_pixels_max.saturating_mul(8).saturating_add(64 << 20));
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(bounds);
    reader
}

/// Size and format, read without decoding, and checked against the limits.
pub(super) fn header(bytes: &[u8], what: &str, limits: &Limits) -> Result<Header> {
    if bytes.is_empty() {
        return Err(Error::photo(format!("{what}: the file is empty")));
    }
    let guessed = image::guess_format(bytes);
    let Ok(format @ (ImageFormat::Jpeg | ImageFormat::Png | ImageFormat::WebP)) = guessed else {
        return Err(Error::photo(format!("{what}: not a JPEG, PNG or WebP file")));
    };
    // The PNG decoder refuses absurd sizes by memory; the size itself is the better message.
    let (width, height) = match png_size(bytes, format) {
        Some(size) => size,
        None => reader(bytes, format, limits).into_dimensions().map_err(|e| {
            Error::photo(format!("{what}: the {} header is damaged", name(format))).caused_by(e)
        })?,
    };
    if width == 0 || height == 0 {
        return Err(Error::photo(format!("{what}: {width}x{height} px; no side may be 0")));
    }
    if u64::from(width) * u64::from(height) > limits.photo_pixels_max {
        let bound = format!("{} px", limits.photo_pixels_max);
        return Err(Error::limit(what, format!("{width}x{height} px"), bound));
    }
    if format == ImageFormat::Jpeg && !jpeg_ends(bytes) {
        return Err(Error::photo(format!(
            "{what}: the JPEG is cut short ({} bytes, no end marker)",
            bytes.len()
        )));
    }
    Ok(Header { format, width, height })
}

fn name(format: ImageFormat) -> &'static str {
    match format {
        ImageFormat::Jpeg => "JPEG",
        ImageFormat::Png => "PNG",
        _ => "WebP",
    }
}

/// Width and height of a PNG's first chunk.
fn png_size(bytes: &[u8], format: ImageFormat) -> Option<(u32, u32)> {
    if format != ImageFormat::Png || bytes.get(12..16) != Some(b"IHDR") {
        return None;
    }
    let word = |at: usize| Some(u32::from_be_bytes(bytes.get(at..at + 4)?.try_into().ok()?));
    Some((word(16)?, word(20)?))
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
            0xD9 => return true,
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

/// The pixels as 8-bit RGB. Grey is repeated, 16 bits are rounded to 8, and pixels that are more
/// transparent than not are no part of the photo (not valid).
pub(super) fn pixels(bytes: &[u8], header: &Header, what: &str, limits: &Limits) -> Result<Photo> {
    let bare = (header.format == ImageFormat::Png).then(|| picture_of_png(bytes));
    let bytes = bare.as_deref().unwrap_or(bytes);
    let decoded = reader(bytes, header.format, limits).decode().map_err(|e| {
        let format = name(header.format);
        Error::photo(format!("{what}: the {format} data is damaged or cut short")).caused_by(e)
    })?;
    let (width, height) = (decoded.width(), decoded.height());
    if (width, height) != (header.width, header.height) {
        return Err(Error::photo(format!(
            "{what}: the header says {}x{} px, the data {width}x{height} px",
            header.width, header.height
        )));
    }
    if !decoded.color().has_alpha() {
        return Ok(Photo { width, height, rgb: decoded.into_rgb8().into_raw(), valid: None });
    }
    let rgba = decoded.into_rgba8();
    let valid: Vec<bool> = rgba.pixels().map(|p| p.0[3] >= 128).collect();
    let rgb = rgba.pixels().flat_map(|p| [p.0[0], p.0[1], p.0[2]]).collect();
    let valid = valid.contains(&false).then_some(valid);
    Ok(Photo { width, height, rgb, valid })
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
}
