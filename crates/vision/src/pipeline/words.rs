//! Words that a network masks in the photos of a scene: each photo is encoded once, each text is
//! found in it, and what is found is lifted to the scene's Gaussians.

use std::sync::{Arc, atomic::AtomicBool};

use segsplat_render::{
    DifferentiableRenderer, Kinds, RenderRequest,
    backward::{FrameGradients, Gradients},
    cpu::CpuRenderer,
    plan::default_near,
};

use super::{
    Pipeline,
    networks::opened,
    semantics::{SemanticsInput, check_input},
};
use crate::{
    error::Result,
    models::TextMaskNetwork,
    scene::{Camera, Gaussians, IndexMap, SH_C0, SceneCamera, unless_cancelled},
    semantics,
};

/// Sum of the weights, pixels as large as the network's, under which no photo shows a Gaussian.
const SHOWN_MIN: f64 = 0.05;
/// A score of 1 in maps.
const SURE: f32 = 1_000.0;

impl Pipeline {
    /// The network that masks what a text says, opened at the first call.
    ///
    /// # Errors
    /// `model_unavailable` when the bundle has none or it does not open.
    pub fn text_masks(&self) -> Result<Arc<TextMaskNetwork>> {
        let open = || TextMaskNetwork::open(&self.runtime, &self.bundle, &self.lazy.options);
        opened(&self.lazy.text_masks, "network of text masks", open)
    }
}

/// Of each text the score at each Gaussian, thousandths: `[T][N]`. Photos that made no Gaussian are
/// not looked at.
///
/// # Errors
/// `model_unavailable`, `cancelled`, `internal`; `invalid_request` when the network cannot read a
/// text, or the scene does not say which pixel made each Gaussian.
pub fn find_words(
    pipeline: &Pipeline,
    input: &SemanticsInput<'_>,
    median_depth: f64,
    texts: &[String],
    cancel: &AtomicBool,
) -> Result<Vec<Vec<u16>>> {
    check_input(input)?;
    let network = pipeline.text_masks()?;
    let mut maps: Vec<Vec<IndexMap>> = vec![Vec::new(); texts.len()];
    for (posed, camera) in input.photos.iter().zip(input.cameras) {
        unless_cancelled(cancel)?;
        if camera.network.is_none() {
            maps.iter_mut().for_each(|of| of.push(IndexMap::default()));
            continue;
        }
        let seen = network.see(&posed.photo)?;
        for (of, text) in maps.iter_mut().zip(texts) {
            unless_cancelled(cancel)?;
            of.push(network.find(&seen, text)?);
        }
    }
    let renderer = CpuRenderer::new(pipeline.workers().current_num_threads())?;
    lift(&renderer, input, median_depth, &maps, cancel)
}

/// `[T][N]` score of each word at each Gaussian, thousandths, from what each photo has at its
/// cells, `[T][V]`.
///
/// A photo's camera sees each Gaussian with a weight at each pixel, which is what the Gaussian adds
/// there. A word is at a Gaussian where at least half of these weights, over all photos, lie on the
/// word; its score is their mean there. Where no photo shows a Gaussian counts what its own photo
/// has at its pixel.
///
/// The sums are the derivative of a picture by the colours of its Gaussians: of a loss whose
/// derivative by each pixel is 1, whether the word is there, and its score. What is shown is summed
/// once for all words.
///
/// # Errors
/// `cancelled`, `internal`; `limit_exceeded` where a photo shows more Gaussians than a backward
/// pass holds at once.
pub fn lift(
    renderer: &dyn DifferentiableRenderer,
    input: &SemanticsInput<'_>,
    median_depth: f64,
    maps: &[Vec<IndexMap>],
    cancel: &AtomicBool,
) -> Result<Vec<Vec<u16>>> {
    let grey = grey(input.gaussians)?;
    let request = |camera| RenderRequest::plain(camera, Kinds::COLOR, default_near(median_depth));
    let mut gradients = Gradients::default();
    // Of each layer the sums at the Gaussians, three layers a pass.
    let mut summed = |layers: &[Layer<'_>]| -> Result<Vec<Vec<f64>>> {
        let mut sums = vec![vec![0.0_f64; grey.len()]; layers.len()];
        for (photo, camera) in input.cameras.iter().enumerate() {
            unless_cancelled(cancel)?;
            let Some(camera) = small(camera) else { continue };
            for (layers, sums) in layers.chunks(3).zip(sums.chunks_mut(3)) {
                let by =
                    FrameGradients { color: Some(said(&camera, photo, layers)), ..<_>::default() };
                let give = &mut |_: &_| Ok(by.clone());
                renderer.backward(&grey, &request(camera), give, &mut gradients)?;
                for (channel, sums) in sums.iter_mut().enumerate() {
                    let of = gradients.sh.iter().map(|of| f64::from(of[channel] / SH_C0));
                    sums.iter_mut().zip(of).for_each(|(sum, v)| *sum += v);
                }
            }
        }
        Ok(sums)
    };
    let (mut shown, mut found) = (Vec::new(), Vec::new());
    // The first word goes with what is shown, further ones are three in two passes.
    let (first, rest) = maps.split_at(maps.len().min(1));
    for words in first.chunks(1).chain(rest.chunks(3)) {
        let with = found.is_empty().then_some(Layer::Shown).into_iter();
        let layers: Vec<_> =
            with.chain(words.iter().flat_map(|of| [Layer::There(of), Layer::Score(of)])).collect();
        let mut sums = summed(&layers)?;
        if found.is_empty() {
            shown = sums.remove(0);
        }
        for (maps, sums) in words.iter().zip(sums.chunks_exact(2)) {
            let own = semantics::from_source(input.gaussians.source(), input.cameras, maps);
            let each = shown.iter().zip(&sums[0]).zip(&sums[1]).zip(own);
            found.push(each.map(|(((a, b), c), own)| score([*a, *b, *c], own)).collect());
        }
    }
    Ok(found)
}

/// What is summed of the weights of Gaussians, by what a word has at the cells of each photo.
#[derive(Clone, Copy, Debug)]
enum Layer<'a> {
    /// All weights.
    Shown,
    /// Those on the word.
    There(&'a [IndexMap]),
    /// The same, times the word's score, 0 to 1.
    Score(&'a [IndexMap]),
}

impl Layer<'_> {
    /// What counts at a place of a photo, shares of its sides.
    fn at(self, photo: usize, [x, y]: [f64; 2]) -> f32 {
        match self {
            Self::Shown => 1.0,
            Self::There(maps) => f32::from(u8::from(maps[photo].at(x, y) > 0)),
            Self::Score(maps) => f32::from(maps[photo].at(x, y)) / SURE,
        }
    }
}

/// The Gaussians in one colour, so that none is at the end of the range of colours.
fn grey(gaussians: &Gaussians) -> Result<Gaussians> {
    let mut raw = gaussians.clone().into_raw();
    (raw.sh_degree, raw.sh) = (0, vec![[0.0; 3]; gaussians.len()]);
    Gaussians::restore(raw)
}

/// A photo's camera with pixels as large as those of the network's picture, which may lack edges.
fn small(camera: &SceneCamera) -> Option<Camera> {
    let lens = camera.camera.intrinsics;
    let scale = camera.network?.fx / lens.fx;
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "pixels")]
    let side = |of: u32| (f64::from(of) * scale).round().max(1.0) as u32;
    let intrinsics = lens.resized(side(lens.width), side(lens.height));
    Some(Camera { intrinsics, ..camera.camera })
}

/// Of each pixel of a photo what up to three layers have there.
fn said(camera: &Camera, photo: usize, layers: &[Layer<'_>]) -> Vec<[f32; 3]> {
    let (width, height) = (camera.intrinsics.width, camera.intrinsics.height);
    let share = |at: u32, of: u32| (f64::from(at) + 0.5) / f64::from(of);
    let pixel = |(x, y)| {
        let place = [share(x, width), share(y, height)];
        [0, 1, 2].map(|c| layers.get(c).map_or(0.0, |layer| layer.at(photo, place)))
    };
    (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).map(pixel).collect()
}

/// The score of a word from the weights of a Gaussian: all, on the word, and times its score.
fn score([shown, with, sum]: [f64; 3], own: u16) -> u16 {
    if shown < SHOWN_MIN {
        return own;
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "thousandths")]
    let mean = (f64::from(SURE) * sum / with).round() as u16;
    if with > 0.0 && 2.0 * with >= shown { mean } else { 0 }
}
