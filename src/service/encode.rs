//! A picture of numbers as a file: PNG, JPEG, WebP, or NPY with every bit of the f32.

use std::borrow::Cow;

use image::{
    ExtendedColorType, ImageEncoder,
    codecs::{jpeg::JpegEncoder, png::PngEncoder, webp::WebPEncoder},
};

use super::request::{Format, Kind};
use crate::{
    error::{Error, Result},
    render::{DepthSteps, Frame, levels::level},
    semantics::colour,
};

const JPEG_QUALITY: u8 = 90;

/// A file, and for a 16-bit depth PNG the world units of one step.
#[derive(Debug)]
pub(super) struct Encoded {
    pub(super) bytes: Vec<u8>,
    pub(super) depth_scale: Option<f64>,
}

/// One picture, a value a pixel.
#[derive(Clone, Copy, Debug)]
pub(super) enum Layer<'a> {
    /// sRGB, 0..1, for NPY.
    Color(&'a [[f32; 3]]),
    /// sRGB in levels.
    Rgb(&'a [[u8; 3]]),
    /// World units, for NPY.
    Depth(&'a [f32]),
    /// Depth in steps.
    Steps(&'a DepthSteps),
    /// Alpha or relevancy, 0..1.
    Share(&'a [f32]),
    /// Alpha, or a mask as it was drawn, in levels.
    Levels(&'a [u8]),
    /// Entries of the bank; a picture shows their colours, NPY has their numbers.
    Entries(&'a [u16]),
    /// Black or white.
    Mask(&'a [bool]),
}

/// A picture of a frame.
pub(super) fn layer(frame: &Frame, kind: Kind) -> Result<Layer<'_>> {
    let Frame { color, depth, alpha, mask, levels, .. } = frame;
    let rgb = || levels.rgb.as_deref().map(Layer::Rgb);
    let steps = || levels.depth.as_ref().map(Layer::Steps);
    let grey = || levels.alpha.as_deref().map(Layer::Levels);
    let layer = match kind {
        Kind::Color => color.as_deref().map(Layer::Color).or_else(rgb),
        Kind::Depth => depth.as_deref().map(Layer::Depth).or_else(steps),
        Kind::Alpha => alpha.as_deref().map(Layer::Share).or_else(grey),
        Kind::Mask => mask.as_deref().map(Layer::Levels),
        Kind::Semantics | Kind::Relevancy => None,
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
    let unfit = || Error::internal(format!("the renderer gave other numbers than {format} has"));
    if format == Format::Npy {
        let plain = |values: &[f32]| npy(values, &[height, width]);
        let bytes = match layer {
            Layer::Color(color) => npy(color.as_flattened(), &[height, width, 3]),
            Layer::Depth(values) | Layer::Share(values) => plain(values),
            Layer::Entries(entries) => {
                plain(&entries.iter().map(|m| f32::from(*m)).collect::<Vec<_>>())
            }
            Layer::Mask(mask) => plain(&mask.iter().map(|on| f32::from(*on)).collect::<Vec<_>>()),
            Layer::Levels(levels) => {
                plain(&levels.iter().map(|v| f32::from(*v) / 255.0).collect::<Vec<_>>())
            }
            Layer::Rgb(_) | Layer::Steps(_) => return Err(unfit()),
        };
        return Ok(Encoded { bytes, depth_scale: None });
    }
    let mut depth_scale = None;
    let (samples, color): (Cow<'_, [u8]>, _) = match layer {
        Layer::Rgb(rgb) => (rgb.as_flattened().into(), ExtendedColorType::Rgb8),
        Layer::Entries(entries) => {
            let colours = entries.iter().flat_map(|m| colour(*m)).map(level);
            (colours.collect(), ExtendedColorType::Rgb8)
        }
        Layer::Steps(DepthSteps { steps, scale }) => {
            depth_scale = Some(*scale);
            (steps.iter().flat_map(|step| step.to_ne_bytes()).collect(), ExtendedColorType::L16)
        }
        Layer::Share(values) => grey(values.iter().map(|v| level(*v)).collect(), format),
        Layer::Levels(levels) => grey(levels.into(), format),
        Layer::Mask(mask) => grey(mask.iter().map(|on| u8::from(*on) * 255).collect(), format),
        Layer::Color(_) | Layer::Depth(_) => return Err(unfit()),
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

/// Levels as an encoder takes them.
fn grey(levels: Cow<'_, [u8]>, format: Format) -> (Cow<'_, [u8]>, ExtendedColorType) {
    match format {
        // WebP knows no grey.
        Format::Webp => (levels.iter().flat_map(|v| [*v; 3]).collect(), ExtendedColorType::Rgb8),
        _ => (levels, ExtendedColorType::L8),
    }
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
