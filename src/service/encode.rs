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

/// One picture, a value a pixel.
#[derive(Clone, Copy, Debug)]
pub(super) enum Layer<'a> {
    /// sRGB, 0..1.
    Color(&'a [[f32; 3]]),
    /// World units.
    Depth(&'a [f32]),
    /// Alpha or relevancy, 0..1.
    Share(&'a [f32]),
    /// Entries of the bank; a picture shows their colours, NPY has their numbers.
    Entries(&'a [u16]),
    /// Black or white.
    Mask(&'a [bool]),
}

/// Colour, depth or alpha of a frame.
pub(super) fn layer(frame: &Frame, kind: Kind) -> Result<Layer<'_>> {
    let layer = match kind {
        Kind::Color => frame.color.as_deref().map(Layer::Color),
        Kind::Depth => frame.depth.as_deref().map(Layer::Depth),
        Kind::Alpha => frame.alpha.as_deref().map(Layer::Share),
        Kind::Semantics | Kind::Relevancy | Kind::Mask => None,
    };
    layer.ok_or_else(|| Error::internal(format!("the renderer gave no {kind}")))
}

/// Refuses pairs of kind and format that would lose the picture.
pub(super) fn check(kind: Kind, format: Format) -> Result<()> {
    match (kind, format) {
        (Kind::Depth, Format::Jpeg | Format::Webp) => Err(Error::invalid(
            "depth does not fit 8 bits: ask for png (16-bit, with its scale) or npy (float32)",
        )),
        (Kind::Mask | Kind::Semantics, Format::Jpeg) => {
            let why = "does not survive JPEG: ask for png, webp or npy";
            Err(Error::invalid(format!("kind={kind} {why}")))
        }
        _ => Ok(()),
    }
}

/// A layer as a file.
///
/// Values of 0..1 are clamped and rounded to the nearest of 256 levels, except as NPY.
pub(super) fn encode(layer: Layer<'_>, width: u32, height: u32, format: Format) -> Result<Encoded> {
    if format == Format::Npy {
        let plain = |values: &[f32]| npy(values, &[height, width]);
        let bytes = match layer {
            Layer::Color(color) => npy(color.as_flattened(), &[height, width, 3]),
            Layer::Depth(values) | Layer::Share(values) => plain(values),
            Layer::Entries(entries) => {
                plain(&entries.iter().map(|m| f32::from(*m)).collect::<Vec<_>>())
            }
            Layer::Mask(mask) => plain(&mask.iter().map(|on| f32::from(*on)).collect::<Vec<_>>()),
        };
        return Ok(Encoded { bytes, depth_scale: None });
    }
    let grey = |levels: Vec<u8>| match format {
        // WebP knows no grey.
        Format::Webp => (levels.iter().flat_map(|v| [*v; 3]).collect(), ExtendedColorType::Rgb8),
        _ => (levels, ExtendedColorType::L8),
    };
    let mut depth_scale = None;
    let (samples, color) = match layer {
        Layer::Color(color) => (levels(color.as_flattened()), ExtendedColorType::Rgb8),
        Layer::Entries(entries) => {
            let colours: Vec<f32> = entries.iter().flat_map(|m| colour(*m)).collect();
            (levels(&colours), ExtendedColorType::Rgb8)
        }
        Layer::Depth(depth) => {
            let (steps, scale) = depth_steps(depth);
            depth_scale = Some(scale);
            (steps, ExtendedColorType::L16)
        }
        Layer::Share(values) => grey(levels(values)),
        Layer::Mask(mask) => grey(mask.iter().map(|on| u8::from(*on) * 255).collect()),
    };
    let mut bytes = Vec::new();
    let to = &mut bytes;
    match format {
        Format::Jpeg => JpegEncoder::new_with_quality(to, JPEG_QUALITY)
            .write_image(&samples, width, height, color),
        Format::Webp => WebPEncoder::new_lossless(to).write_image(&samples, width, height, color),
        Format::Png | Format::Npy => {
            PngEncoder::new(to).write_image(&samples, width, height, color)
        }
    }
    .map_err(|e| Error::internal("the picture cannot be encoded").caused_by(e))?;
    Ok(Encoded { bytes, depth_scale })
}

/// 0..1 as 0..255, rounded; NaN is 0.
fn levels(values: &[f32]) -> Vec<u8> {
    let level = |v: &f32| (v.clamp(0.0, 1.0) * 255.0 + 0.5) as u8;
    values.iter().map(level).collect()
}

/// Depths as native-endian 16-bit steps of the scale; a depth over 0 is at least 1.
fn depth_steps(depth: &[f32]) -> (Vec<u8>, f64) {
    let farthest = depth.iter().copied().filter(|d| d.is_finite()).fold(0.0_f32, f32::max);
    let scale = if farthest > 0.0 { f64::from(farthest) / f64::from(DEPTH_STEPS) } else { 1.0 };
    let step = |&d: &f32| -> u16 {
        if d > 0.0 {
            (f64::from(d) / scale).round().clamp(1.0, f64::from(DEPTH_STEPS)) as u16
        } else {
            0
        }
    };
    (depth.iter().map(step).flat_map(u16::to_ne_bytes).collect(), scale)
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
    let length = header.len() as u16;
    let mut file = b"\x93NUMPY\x01\x00".to_vec();
    file.extend(length.to_le_bytes());
    file.extend(header.as_bytes());
    file.extend(values.iter().flat_map(|v| v.to_le_bytes()));
    file
}
