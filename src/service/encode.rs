//! A picture as a file: PNG, JPEG, WebP, samples without a codec, or NPY with every bit of the f32.
//!
//! Which encoders, and what they cost: docs/adr/0026.

use std::borrow::Cow;

use image::{ExtendedColorType, ImageEncoder, codecs::webp::WebPEncoder};

use super::request::{Format, PictureKind};
use crate::{
    error::{Error, Result},
    formats::npy,
    render::{DepthSteps, Frame, levels::level},
    semantics::colour,
};

const JPEG_QUALITY: u8 = 90;
/// Most pixels of a JPEG with chroma at every pixel. Larger pictures have it at every second one of
/// each row and column, which halves their time and costs 0.4 to 0.6 dB there.
const FULL_CHROMA_PIXELS_MAX: u64 = 512 * 512;

/// A file, and for a 16-bit depth PNG the world units of one step.
#[derive(Debug)]
pub(super) struct Encoded {
    pub(super) bytes: Vec<u8>,
    pub(super) depth_scale: Option<f64>,
}

/// One picture, a value a pixel.
#[derive(Clone, Debug)]
pub(super) enum Layer<'a> {
    /// sRGB, 0..1, for NPY.
    Color(Vec<[f32; 3]>),
    /// sRGB in levels.
    Rgb(Vec<[u8; 3]>),
    /// sRGB and alpha in levels.
    Rgba(Vec<[u8; 4]>),
    /// World units, for NPY.
    Depth(Vec<f32>),
    /// Depth in steps.
    Steps(DepthSteps),
    /// Alpha or relevancy, 0..1.
    Share(Cow<'a, [f32]>),
    /// Alpha, or a mask as it was drawn, in levels.
    Levels(Vec<u8>),
    /// Entries of the bank; a picture shows their colours, NPY has their numbers.
    Entries(&'a [u16]),
    /// Black or white.
    Mask(&'a [bool]),
}

/// Takes a picture out of a frame.
pub(super) fn layer(frame: &mut Frame, kind: PictureKind) -> Result<Layer<'static>> {
    let Frame { color, depth, alpha, mask, levels, .. } = frame;
    let layer = match kind {
        PictureKind::Color => color
            .take()
            .map(Layer::Color)
            .or_else(|| levels.rgb.take().map(Layer::Rgb))
            .or_else(|| levels.rgba.take().map(Layer::Rgba)),
        PictureKind::Depth => {
            depth.take().map(Layer::Depth).or_else(|| levels.depth.take().map(Layer::Steps))
        }
        PictureKind::Alpha => alpha
            .take()
            .map(|alpha| Layer::Share(alpha.into()))
            .or_else(|| levels.alpha.take().map(Layer::Levels)),
        PictureKind::Mask => mask.take().map(Layer::Levels),
        PictureKind::Holes | PictureKind::Semantics | PictureKind::Relevancy => None,
    };
    layer.ok_or_else(|| Error::internal(format!("the renderer gave no {kind}")))
}

/// What of the opacity of `before` is not there in `after`.
pub(super) fn holes(before: &Frame, after: &Frame) -> Result<Layer<'static>> {
    if let (Some(before), Some(after)) = (&before.alpha, &after.alpha) {
        let less = before.iter().zip(after).map(|(before, after)| (before - after).max(0.0));
        return Ok(Layer::Share(less.collect()));
    }
    match (&before.levels.alpha, &after.levels.alpha) {
        (Some(before), Some(after)) => {
            let less =
                before.iter().zip(after).map(|(before, after)| before.saturating_sub(*after));
            Ok(Layer::Levels(less.collect()))
        }
        _ => Err(Error::internal("the renderer gave no alpha to compare")),
    }
}

/// Refuses pairs of kind and format that would lose the picture, or that have other samples.
pub(super) fn check(kind: PictureKind, format: Format) -> Result<()> {
    let refused = |why: &str| Err(Error::invalid(format!("kind={kind} {why}")));
    match (kind, format) {
        (_, Format::Png | Format::Npy) => Ok(()),
        (PictureKind::Depth, _) => Err(Error::invalid(
            "depth does not fit 8 bits: ask for png (16-bit, with its scale) or npy (float32)",
        )),
        (PictureKind::Mask | PictureKind::Semantics, Format::Jpeg) => {
            refused("does not survive JPEG: ask for png, webp or npy")
        }
        (
            PictureKind::Alpha | PictureKind::Holes | PictureKind::Relevancy | PictureKind::Mask,
            Format::Rgb8 | Format::Rgba8,
        ) => refused("has one sample a pixel: ask for grey8"),
        (PictureKind::Semantics, Format::Rgba8) => refused("has no alpha: ask for rgb8"),
        (PictureKind::Color | PictureKind::Semantics, Format::Grey8) => {
            refused("has three samples a pixel: ask for rgb8")
        }
        _ => Ok(()),
    }
}

/// Samples of a picture, row-major.
enum Samples {
    Grey(Vec<u8>),
    Rgb(Vec<u8>),
    Rgba(Vec<u8>),
    Steps(DepthSteps),
}

/// A layer as a file.
///
/// Values of 0..1 are clamped and rounded to the nearest of 256 levels, except as NPY.
pub(super) fn encode(layer: Layer<'_>, width: u32, height: u32, format: Format) -> Result<Encoded> {
    let plain = |bytes| Ok(Encoded { bytes, depth_scale: None });
    if format == Format::Npy {
        return plain(numbers(layer, width, height)?);
    }
    let unfit = || Error::internal(format!("the renderer gave other numbers than {format} has"));
    let samples = match layer {
        Layer::Rgb(rgb) => Samples::Rgb(rgb.into_flattened()),
        Layer::Rgba(rgba) => Samples::Rgba(rgba.into_flattened()),
        Layer::Entries(entries) => Samples::Rgb(coloured(entries)),
        Layer::Steps(steps) => Samples::Steps(steps),
        Layer::Share(values) => Samples::Grey(values.iter().map(|v| level(*v)).collect()),
        Layer::Levels(levels) => Samples::Grey(levels),
        Layer::Mask(mask) => Samples::Grey(mask.iter().map(|on| u8::from(*on) * 255).collect()),
        Layer::Color(_) | Layer::Depth(_) => return Err(unfit()),
    };
    let size = [width, height];
    match (format, samples) {
        (Format::Grey8, Samples::Grey(samples))
        | (Format::Rgb8, Samples::Rgb(samples))
        | (Format::Rgba8, Samples::Rgba(samples)) => plain(samples),
        (Format::Png, Samples::Grey(samples)) => {
            plain(png(&samples, size, png::ColorType::Grayscale, png::BitDepth::Eight)?)
        }
        (Format::Png, Samples::Rgb(samples)) => {
            plain(png(&samples, size, png::ColorType::Rgb, png::BitDepth::Eight)?)
        }
        (Format::Png, Samples::Steps(DepthSteps { steps, scale })) => {
            let samples: Vec<u8> = steps.iter().flat_map(|step| step.to_be_bytes()).collect();
            let bytes = png(&samples, size, png::ColorType::Grayscale, png::BitDepth::Sixteen)?;
            Ok(Encoded { bytes, depth_scale: Some(scale) })
        }
        (Format::Jpeg, Samples::Grey(samples)) => {
            plain(jpeg(&samples, size, jpeg_encoder::ColorType::Luma)?)
        }
        (Format::Jpeg, Samples::Rgb(samples)) => {
            plain(jpeg(&samples, size, jpeg_encoder::ColorType::Rgb)?)
        }
        (Format::Webp, Samples::Rgb(samples)) => plain(webp(&samples, size)?),
        // WebP knows no grey.
        (Format::Webp, Samples::Grey(samples)) => {
            let rgb: Vec<u8> = samples.iter().flat_map(|v| [*v; 3]).collect();
            plain(webp(&rgb, size)?)
        }
        _ => Err(unfit()),
    }
}

/// The colours of entries.
fn coloured(entries: &[u16]) -> Vec<u8> {
    let most = entries.iter().copied().max().unwrap_or_default();
    let colours: Vec<[u8; 3]> = (0..=most).map(|m| colour(m).map(level)).collect();
    entries.iter().flat_map(|m| colours[usize::from(*m)]).collect()
}

fn failed(e: impl std::error::Error + Send + Sync + 'static) -> Error {
    Error::internal("the picture cannot be encoded").caused_by(e)
}

/// One filter for all rows: trying each costs twice the time for the same size.
fn png(
    samples: &[u8],
    [width, height]: [u32; 2],
    color: png::ColorType,
    depth: png::BitDepth,
) -> Result<Vec<u8>> {
    let mut bytes = Vec::with_capacity(samples.len() / 2);
    let mut encoder = png::Encoder::new(&mut bytes, width, height);
    encoder.set_color(color);
    encoder.set_depth(depth);
    encoder.set_compression(png::Compression::Fast);
    encoder.set_filter(png::Filter::Paeth);
    let mut writer = encoder.write_header().map_err(failed)?;
    writer.write_image_data(samples).map_err(failed)?;
    writer.finish().map_err(failed)?;
    Ok(bytes)
}

fn jpeg(
    samples: &[u8],
    [width, height]: [u32; 2],
    color: jpeg_encoder::ColorType,
) -> Result<Vec<u8>> {
    let mut bytes = Vec::with_capacity(samples.len() / 8);
    let mut encoder = jpeg_encoder::Encoder::new(&mut bytes, JPEG_QUALITY);
    let full = u64::from(width) * u64::from(height) <= FULL_CHROMA_PIXELS_MAX;
    encoder.set_sampling_factor(match full {
        true => jpeg_encoder::SamplingFactor::F_1_1,
        false => jpeg_encoder::SamplingFactor::F_2_2,
    });
    let side = |side: u32| {
        let max = u16::MAX;
        u16::try_from(side).map_err(|_| Error::limit("jpeg: side", side, max))
    };
    encoder.encode(samples, side(width)?, side(height)?, color).map_err(failed)?;
    Ok(bytes)
}

fn webp(rgb: &[u8], [width, height]: [u32; 2]) -> Result<Vec<u8>> {
    let mut bytes = Vec::new();
    let encoder = WebPEncoder::new_lossless(&mut bytes);
    encoder.write_image(rgb, width, height, ExtendedColorType::Rgb8).map_err(failed)?;
    Ok(bytes)
}

/// A layer as NPY.
fn numbers(layer: Layer<'_>, width: u32, height: u32) -> Result<Vec<u8>> {
    let plain = |values: &[f32]| npy(values, &[height, width]);
    Ok(match layer {
        Layer::Color(color) => npy(color.as_flattened(), &[height, width, 3]),
        Layer::Depth(values) => plain(&values),
        Layer::Share(values) => plain(&values),
        Layer::Entries(entries) => {
            plain(&entries.iter().map(|m| f32::from(*m)).collect::<Vec<_>>())
        }
        Layer::Mask(mask) => plain(&mask.iter().map(|on| f32::from(*on)).collect::<Vec<_>>()),
        Layer::Levels(levels) => {
            plain(&levels.iter().map(|v| f32::from(*v) / 255.0).collect::<Vec<_>>())
        }
        Layer::Rgb(_) | Layer::Rgba(_) | Layer::Steps(_) => {
            return Err(Error::internal("the renderer gave other numbers than npy has"));
        }
    })
}

/// An array in C order.
fn npy(values: &[f32], shape: &[u32]) -> Vec<u8> {
    let shape: Vec<usize> = shape.iter().map(|side| *side as usize).collect();
    let mut file = npy::header::<f32>(&shape);
    file.extend_from_slice(bytemuck::cast_slice(values));
    file
}
