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

/// Bytes that decoding may take at most: the deepest pixel (RGBA of 16 bits) and working space.
fn decoder_limits(limits: &Limits) -> image::Limits {
    let mut bounds = image::Limits::default();
    bounds.max_alloc = Some(limits.photo_pixels_max.saturating_mul(8).saturating_add(64 << 20));
    bounds
}

fn reader<'a>(
    bytes: &'a [u8],
    format: ImageFormat,
    limits: &Limits,
) -> ImageReader<Cursor<&'a [u8]>> {
    let mut reader = ImageReader::with_format(Cursor::new(bytes), format);
    reader.limits(decoder_limits(limits));
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
        // Length, name, data, checksum; a chunk that is cut short is the decoder's to judge.
        let end = (u32::from_be_bytes(*length) as usize).saturating_add(12).min(rest.len());
        let (chunk, after) = rest.split_at(end);
        if [b"IHDR", b"PLTE", b"tRNS", b"IDAT", b"IEND"].iter().any(|n| name.starts_with(*n)) {
            kept.extend_from_slice(chunk);
        }
        rest = after;
    }
    kept
}

/// Whether the JPEG's data reaches its end-of-image marker (the decoder would fill the rest with
/// grey and say nothing).
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
/// No stage looks closer than that, and 64 photos of 24 megapixels would take 4.6 GB.
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

    fn encoded(image: &image::DynamicImage, format: ImageFormat) -> Vec<u8> {
        let mut out = Cursor::new(Vec::new());
        image.write_to(&mut out, format).unwrap();
        out.into_inner()
    }

    fn gradient() -> image::RgbImage {
        image::RgbImage::from_fn(40, 30, |x, y| image::Rgb([(x * 6) as u8, (y * 8) as u8, 90]))
    }

    fn decoded(bytes: &[u8]) -> Result<Photo> {
        let limits = Limits::default();
        let header = header(bytes, "photo 3", &limits)?;
        pixels(bytes, &header, "photo 3", &limits)
    }

    #[test]
    fn the_three_formats_and_all_depths_are_read() {
        let rgb = image::DynamicImage::from(gradient());
        for format in [ImageFormat::Png, ImageFormat::WebP] {
            let photo = decoded(&encoded(&rgb, format)).unwrap();
            assert_eq!(photo.rgb, gradient().into_raw(), "{format:?}");
        }
        let photo = decoded(&encoded(&rgb, ImageFormat::Jpeg)).unwrap();
        assert_eq!((photo.width, photo.height), (40, 30));
        let grey16 = image::DynamicImage::from(image::ImageBuffer::from_fn(4, 4, |x, _| {
            image::Luma([(x * 0x4040) as u16])
        }));
        let photo = decoded(&encoded(&grey16, ImageFormat::Png)).unwrap();
        assert_eq!(photo.rgb[3..6], [0x40; 3]);
        let alpha = image::DynamicImage::from(image::ImageBuffer::from_fn(4, 4, |x, _| {
            image::Rgba([9_u8, 9, 9, [127, 128, 0, 255][x as usize]])
        }));
        let photo = decoded(&encoded(&alpha, ImageFormat::Png)).unwrap();
        // Half a pixel's alpha is enough, and its colour is the stored one.
        assert_eq!(photo.valid.unwrap()[..4], [false, true, false, true]);
        assert_eq!(photo.rgb[3..6], [9; 3]);
    }

    #[test]
    fn damaged_files_are_told_apart() {
        let rgb = image::DynamicImage::from(gradient());
        let jpeg = encoded(&rgb, ImageFormat::Jpeg);
        let png = encoded(&rgb, ImageFormat::Png);
        let cases: [(&[u8], &str); 5] = [
            (&[], "empty"),
            (b"hello, this is a text", "not a JPEG"),
            (&jpeg[..jpeg.len() - 40], "cut short"),
            (&png[..png.len() / 2], "damaged or cut short"),
            (&jpeg[..60], "damaged"),
        ];
        for (bytes, word) in cases {
            let error = decoded(bytes).unwrap_err();
            assert!(error.message().contains(word), "{word}: {error}");
            assert!(error.message().starts_with("photo 3"), "{error}");
        }
    }

    #[test]
    fn of_a_png_only_the_picture_is_decoded() {
        let png = encoded(&image::DynamicImage::from(gradient()), ImageFormat::Png);
        assert_eq!(picture_of_png(&png), png, "there is nothing else in it");
        let text = [&[0, 0, 0, 3][..], b"zTXt", b"abc", &[1, 2, 3, 4]].concat();
        let with = [&png[..33], &text, &png[33..]].concat();
        assert_eq!(picture_of_png(&with), png);
        assert_eq!(decoded(&with).unwrap().rgb, gradient().into_raw());
        for cut in 0..png.len() {
            assert!(png.starts_with(&picture_of_png(&png[..cut])), "{cut}");
        }
    }

    #[test]
    fn a_tiny_file_that_claims_a_huge_picture_is_refused_by_its_header() {
        let mut png = encoded(&image::DynamicImage::from(gradient()), ImageFormat::Png);
        png[16..20].copy_from_slice(&100_000_u32.to_be_bytes());
        png[20..24].copy_from_slice(&100_000_u32.to_be_bytes());
        png.truncate(60);
        let error = decoded(&png).unwrap_err();
        assert_eq!(error.message(), "photo 3: 100000x100000 px is over 24000000 px");
    }

    #[test]
    fn large_photos_are_kept_smaller_with_their_camera() {
        let photo = Photo { width: 40, height: 30, rgb: gradient().into_raw(), valid: None };
        let k = Intrinsics { fx: 50.0, fy: 52.0, cx: 21.0, cy: 14.0, width: 40, height: 30 };
        let (small, k) = at_most(photo, k, 20);
        assert_eq!((small.width, small.height, small.rgb.len()), (20, 15, 900));
        assert_eq!((k.fx, k.fy, k.cx, k.cy), (25.0, 26.0, 10.5, 7.0));
        // The mean of pixels 2 and 3 of a ramp of 6 a pixel.
        assert!(small.rgb[3].abs_diff(15) <= 1, "{}", small.rgb[3]);
    }
}
