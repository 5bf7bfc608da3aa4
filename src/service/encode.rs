//! A picture of numbers as a file: PNG, JPEG, WebP, or NPY with every bit of the f32.

use image::{
    ExtendedColorType, ImageEncoder,
    codecs::{jpeg::JpegEncoder, png::PngEncoder, webp::WebPEncoder},
};

use super::request::{Format, Kind};
use crate::{
    error::{Error, Result},
    render::Frame,
    semantics::colour,
};

const JPEG_QUALITY: u8 = 90;
/// Largest value of a 16-bit depth PNG; 0 is kept for "nothing there".
const DEPTH_STEPS: f32 = 65_535.0;

/// A file, and for a 16-bit depth PNG the world units of one step.
#[derive(Debug)]
pub(super) struct Encoded {
    pub(super) bytes: Vec<u8>,
    pub(super) depth_scale: Option<f64>,
}

/// What texts find in a view, a value a pixel.
#[derive(Clone, Copy, Debug)]
pub(super) enum Layer<'a> {
    /// Entries of the bank; a picture shows their colours.
    Entries(&'a [u16]),
    /// 0..1.
    Relevancy(&'a [f32]),
    /// Black or white.
    Mask(&'a [bool]),
}

/// A layer as a file: entries in their colours (as NPY their numbers), the others in grey.
pub(super) fn layer(layer: Layer<'_>, width: u32, height: u32, format: Format) -> Result<Vec<u8>> {
    if format == Format::Npy {
        let values: Vec<f32> = match layer {
            Layer::Entries(entries) => entries.iter().map(|m| f32::from(*m)).collect(),
            Layer::Relevancy(scores) => scores.to_vec(),
            Layer::Mask(mask) => mask.iter().map(|on| f32::from(u8::from(*on))).collect(),
        };
        return Ok(npy(&values, &[height, width]));
    }
    let grey: Vec<u8> = match layer {
        Layer::Entries(entries) => {
            let colours: Vec<f32> = entries.iter().flat_map(|m| colour(*m)).collect();
            return picture(&levels(&colours), width, height, ExtendedColorType::Rgb8, format);
        }
        Layer::Relevancy(scores) => levels(scores),
        Layer::Mask(mask) => mask.iter().map(|on| if *on { 255 } else { 0 }).collect(),
    };
    if format == Format::Webp {
        // WebP knows no grey.
        let rgb: Vec<u8> = grey.iter().flat_map(|&v| [v; 3]).collect();
        return picture(&rgb, width, height, ExtendedColorType::Rgb8, format);
    }
    picture(&grey, width, height, ExtendedColorType::L8, format)
}

/// Refuses pairs of kind and format that would lose the picture.
pub(super) fn check(kind: Kind, format: Format) -> Result<()> {
    match (kind, format) {
        (Kind::Depth, Format::Jpeg | Format::Webp) => Err(Error::invalid(
            "depth does not fit 8 bits: ask for png (16-bit, with its scale) or npy (float32)",
        )),
        (Kind::Mask | Kind::Semantics, Format::Jpeg) => Err(Error::invalid(format!(
            "kind={} does not survive JPEG: ask for png, webp or npy",
            kind
        ))),
        _ => Ok(()),
    }
}

/// One kind of a frame as a file: colour, depth or alpha.
///
/// Colour and alpha are clamped to 0..1 and rounded to the nearest of 256 levels, except as NPY.
pub(super) fn encode(frame: &Frame, kind: Kind, format: Format) -> Result<Encoded> {
    check(kind, format)?;
    let missing = || Error::internal(format!("the renderer gave no {kind:?}"));
    let (width, height) = (frame.width, frame.height);
    let plain = |bytes| Ok(Encoded { bytes, depth_scale: None });
    match kind {
        Kind::Color => {
            let color = frame.color.as_ref().ok_or_else(missing)?.as_flattened();
            match format {
                Format::Npy => plain(npy(color, &[height, width, 3])),
                _ => {
                    plain(picture(&levels(color), width, height, ExtendedColorType::Rgb8, format)?)
                }
            }
        }
        Kind::Alpha => {
            let alpha = frame.alpha.as_ref().ok_or_else(missing)?;
            match format {
                Format::Npy => plain(npy(alpha, &[height, width])),
                // WebP knows no grey.
                Format::Webp => {
                    let rgb: Vec<u8> = levels(alpha).iter().flat_map(|&v| [v; 3]).collect();
                    plain(picture(&rgb, width, height, ExtendedColorType::Rgb8, format)?)
                }
                Format::Png | Format::Jpeg => {
                    plain(picture(&levels(alpha), width, height, ExtendedColorType::L8, format)?)
                }
            }
        }
        Kind::Depth => {
            let depth = frame.depth.as_ref().ok_or_else(missing)?;
            if format == Format::Npy {
                return plain(npy(depth, &[height, width]));
            }
            let (steps, scale) = depth_steps(depth);
            let bytes = picture(&steps, width, height, ExtendedColorType::L16, format)?;
            Ok(Encoded { bytes, depth_scale: Some(scale) })
        }
        Kind::Semantics | Kind::Relevancy | Kind::Mask => Err(missing()),
    }
}

/// 0..1 as 0..255, rounded; NaN is 0.
fn levels(values: &[f32]) -> Vec<u8> {
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped first")]
    let level = |v: &f32| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    values.iter().map(level).collect()
}

/// Depths as native-endian 16-bit steps of the scale; whatever has a depth is at least 1.
fn depth_steps(depth: &[f32]) -> (Vec<u8>, f64) {
    let farthest = depth.iter().copied().filter(|d| d.is_finite()).fold(0.0_f32, f32::max);
    let scale = if farthest > 0.0 { f64::from(farthest) / f64::from(DEPTH_STEPS) } else { 1.0 };
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "clamped first")]
    let step = |&d: &f32| -> u16 {
        if d > 0.0 {
            (f64::from(d) / scale).round().clamp(1.0, f64::from(DEPTH_STEPS)) as u16
        } else {
            0
        }
    };
    (depth.iter().map(step).flat_map(u16::to_ne_bytes).collect(), scale)
}

fn picture(
    samples: &[u8],
    width: u32,
    height: u32,
    color: ExtendedColorType,
    format: Format,
) -> Result<Vec<u8>> {
    let mut file = Vec::new();
    match format {
        Format::Png => PngEncoder::new(&mut file).write_image(samples, width, height, color),
        Format::Jpeg => JpegEncoder::new_with_quality(&mut file, JPEG_QUALITY)
            .write_image(samples, width, height, color),
        Format::Webp => {
            WebPEncoder::new_lossless(&mut file).write_image(samples, width, height, color)
        }
        Format::Npy => return Err(Error::internal("npy is not a picture")),
    }
    .map_err(|e| Error::internal("the picture cannot be encoded").caused_by(e))?;
    Ok(file)
}

/// `NumPy`'s format version 1.0, C order.
fn npy(values: &[f32], shape: &[u32]) -> Vec<u8> {
    let sides: Vec<String> = shape.iter().map(u32::to_string).collect();
    let mut header =
        format!("{{'descr': '<f4', 'fortran_order': False, 'shape': ({}), }}", sides.join(", "));
    // Magic, version and length take 10 bytes; the data starts at a multiple of 64.
    let padded = (10 + header.len() + 1).next_multiple_of(64) - 10;
    header.push_str(&" ".repeat(padded - header.len() - 1));
    header.push('\n');
    #[expect(clippy::cast_possible_truncation, reason = "some hundred bytes")]
    let length = header.len() as u16;
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend(length.to_le_bytes());
    file.extend(header.as_bytes());
    file.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    file
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame() -> Frame {
        Frame {
            width: 3,
            height: 1,
            color: Some(vec![[-1.0, 0.0, 0.5], [1.0, 7.0, f32::NAN], [0.2, 0.25, 0.999]]),
            depth: Some(vec![0.0, 2.0, 4.0]),
            alpha: Some(vec![0.0, 0.5, 1.0]),
            ..Frame::default()
        }
    }

    fn decoded(kind: Kind, format: Format) -> image::DynamicImage {
        image::load_from_memory(&encode(&frame(), kind, format).unwrap().bytes).unwrap()
    }

    #[test]
    fn colour_is_clamped_and_rounded_and_nan_is_black() {
        let want = [0, 0, 128, 255, 255, 0, 51, 64, 255];
        for format in [Format::Png, Format::Webp] {
            assert_eq!(decoded(Kind::Color, format).to_rgb8().as_raw()[..], want, "{format:?}");
        }
    }

    #[test]
    fn depth_png_times_its_scale_is_the_depth() {
        let scale = encode(&frame(), Kind::Depth, Format::Png).unwrap().depth_scale.unwrap();
        let steps = decoded(Kind::Depth, Format::Png).to_luma16();
        let depths: Vec<f64> = steps.as_raw().iter().map(|&v| f64::from(v) * scale).collect();
        for (got, want) in depths.iter().zip([0.0, 2.0, 4.0]) {
            assert!((got - want).abs() <= scale / 2.0, "{got} is not {want}");
        }
        assert_eq!(depth_steps(&[1e-9, 1.0]).0[..2], 1_u16.to_ne_bytes(), "there, though near");
        assert_eq!(depth_steps(&[0.0; 2]).1, 1.0, "an empty picture has a scale too");
    }

    #[test]
    fn npy_holds_every_bit() {
        let file = encode(&frame(), Kind::Color, Format::Npy).unwrap().bytes;
        assert_eq!(file.len() % 4, 0);
        let header_end = file.iter().position(|&b| b == b'\n').unwrap() + 1;
        assert_eq!(header_end % 64, 0);
        let header = String::from_utf8_lossy(&file[10..header_end]);
        assert!(header.contains("'shape': (1, 3, 3)") && header.contains("'<f4'"), "{header}");
        let bits: Vec<[u8; 4]> =
            file[header_end..].chunks(4).map(|b| b.try_into().unwrap()).collect();
        let want = frame().color.unwrap().into_iter().flatten().map(f32::to_le_bytes);
        assert!(bits.into_iter().eq(want));
    }

    #[test]
    fn depth_is_not_squeezed_into_8_bits() {
        for format in [Format::Jpeg, Format::Webp] {
            let error = encode(&frame(), Kind::Depth, format).unwrap_err();
            assert!(error.message().contains("npy"), "{error}");
        }
        assert_eq!(decoded(Kind::Alpha, Format::Png).to_luma8().as_raw()[..], [0, 128, 255]);
    }
}
