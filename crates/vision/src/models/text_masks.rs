//! The network that masks what a text says: it encodes a photo once, then finds each text in it.
//!
//! Its answer of a photo and a text is one map: at each cell the best score of the masks that hold
//! it, so that the network may give one mask a thing or one for all.

use std::sync::Arc;

use tokenizers::Tokenizer;

use crate::{
    error::{Error, Result},
    models::{
        Bundle, NetworkOptions, Provider, Runtime, TextMasksManifest,
        image_text::{cut_ids, read_tokenizer, size},
        network::{Input, Network, Outputs, RunMemory, Side, Signature, Spec, Wanted},
        resize::{planes, resize},
        tensors::Numbers,
    },
    scene::{IndexMap, Photo},
};

/// Names of the two files in messages.
const IMAGE: &str = "image encoder of text masks";
const FIND: &str = "text masks";
/// The score 1 in a map.
const SURE: f32 = 1_000.0;

/// The network, ready to run from any thread.
#[derive(Debug)]
pub struct TextMaskNetwork {
    manifest: TextMasksManifest,
    image: Network,
    find: Network,
    tokenizer: Tokenizer,
    /// Tokens a run, where the file fixes them.
    tokens: Option<usize>,
}

/// A photo as the encoder saw it.
#[derive(Clone, Debug)]
pub struct EncodedPhoto {
    /// Name, shape and data of each feature.
    features: Vec<(String, Vec<usize>, Vec<f32>)>,
}

impl EncodedPhoto {
    fn of(manifest: &TextMasksManifest, outputs: &dyn Outputs) -> Result<Self> {
        let feature = |name: &String| {
            let (shape, data) = outputs.get(name)?;
            Ok((name.clone(), shape, data.into_owned()))
        };
        let features = manifest.image.features.iter().map(feature).collect::<Result<_>>()?;
        Ok(Self { features })
    }
}

impl TextMaskNetwork {
    /// Opens both files on the provider of the configuration; `None` where the bundle has none.
    ///
    /// # Errors
    /// `model_unavailable` when the provider asked for is not there, a file does not load, or its
    /// tensors are not those of the manifest.
    pub fn open(
        runtime: &Arc<Runtime>,
        bundle: &Bundle,
        options: &NetworkOptions,
    ) -> Result<Option<Self>> {
        let Some(manifest) = bundle.text_masks().cloned() else { return Ok(None) };
        let tokenizer = read_tokenizer(bundle, &manifest.find.tokenizer)?;
        let (photo, side) = (pixels(&manifest, &probe()), manifest.size as usize);
        let input = || Input::new(&manifest.image.input, &[1, 3, side, side], &*photo);
        let spec = Spec {
            what: IMAGE,
            file: &manifest.image.file,
            cpu_file: None,
            signature: image_signature(&manifest),
            memory: RunMemory::KeptOnDevices,
            tolerance: manifest.tolerance,
            probe: &|_| Ok(vec![input()]),
        };
        let image = Network::open(runtime, bundle, options, &spec)?;
        let seen = image.run(&[input()], |outputs| EncodedPhoto::of(&manifest, outputs))?;
        let known = i64::try_from(tokenizer.get_vocab_size(false)).unwrap_or(1).max(1);
        let spec = Spec {
            what: FIND,
            file: &manifest.find.file,
            cpu_file: None,
            signature: find_signature(&manifest, tokenizer.get_vocab_size(true)),
            memory: RunMemory::KeptOnDevices,
            tolerance: manifest.tolerance,
            probe: &|takes| {
                let fixed = size(takes, &manifest.find.input_ids, 1);
                let length = fixed.unwrap_or(manifest.find.context.min(4));
                let ids = (1..).map(|i: i64| i * 37 % known).take(length).collect();
                Ok(inputs(&manifest, &seen, ids, length))
            },
        };
        let find = Network::open(runtime, bundle, options, &spec)?;
        let tokens = size(find.signature(), &manifest.find.input_ids, 1);
        Ok(Some(Self { image, find, tokenizer, tokens, manifest }))
    }

    /// Looks for two texts in a photo.
    ///
    /// # Errors
    /// `internal` when a run fails, or an output has another shape than the manifest says or holds
    /// a number that is not finite.
    pub(super) fn try_out(&self) -> Result<()> {
        let seen = self.see(&probe())?;
        ["box", "a photo of two boxes"].iter().try_for_each(|text| self.find(&seen, text).map(drop))
    }

    /// The section of the manifest.
    #[must_use]
    pub fn manifest(&self) -> &TextMasksManifest {
        &self.manifest
    }

    /// What computes the image encoder.
    #[must_use]
    pub fn provider(&self) -> Provider {
        self.image.provider()
    }

    /// Why a part is not computed where it was to be; `None` where both are.
    #[must_use]
    pub fn remark(&self) -> Option<String> {
        self.image.remark().or_else(|| self.find.remark())
    }

    /// Encodes a photo.
    ///
    /// # Errors
    /// `internal` when the network fails or has not the outputs of its manifest.
    pub fn see(&self, photo: &Photo) -> Result<EncodedPhoto> {
        let (manifest, side) = (&self.manifest, self.manifest.size as usize);
        let input = Input::new(&manifest.image.input, &[1, 3, side, side], pixels(manifest, photo));
        self.image.run(&[input], |outputs| EncodedPhoto::of(manifest, outputs))
    }

    /// At each cell of the photo the best score of a mask of the text that holds it, thousandths; 0
    /// where none of at least the manifest's `threshold` does.
    ///
    /// # Errors
    /// `invalid_request` when the text holds nothing that the network reads; `internal` when it
    /// fails, or answers with other shapes than its manifest says or a number that is not finite.
    pub fn find(&self, seen: &EncodedPhoto, text: &str) -> Result<IndexMap> {
        let encoding = self.tokenizer.encode(text, true).map_err(|e| {
            Error::invalid(format!("text {text:?} cannot be read by the tokenizer: {e}"))
        })?;
        if encoding.get_special_tokens_mask().iter().all(|special| *special == 1) {
            return Err(Error::invalid(format!(
                "text {text:?} holds nothing that the network of text masks reads; write words"
            )));
        }
        let context = self.manifest.find.context;
        let ids = cut_ids(&encoding, self.tokens.map_or(context, |fixed| fixed.min(context)));
        let length = self.tokens.unwrap_or(ids.len());
        let inputs = inputs(&self.manifest, seen, ids, length);
        let names = [&*self.manifest.find.masks, &*self.manifest.find.scores];
        self.find.run_for(&inputs, &names, |outputs| self.best(outputs))
    }

    fn best(&self, outputs: &dyn Outputs) -> Result<IndexMap> {
        let names = &self.manifest.find;
        let (shape, logits) = outputs.get(&names.masks)?;
        let (found, scores) = outputs.get(&names.scores)?;
        let [1, queries, height, width] = shape[..] else {
            return Err(Error::internal(format!("{FIND}: {:?} is {shape:?}", names.masks)));
        };
        if found != [1, queries] || height * width == 0 {
            return Err(Error::internal(format!("{FIND}: masks {shape:?} and scores {found:?}")));
        }
        if !logits.iter().chain(scores.iter()).all(|v| v.is_finite()) {
            return Err(Error::internal(format!("{FIND}: a number is not finite")));
        }
        let mut index = vec![0_u16; height * width];
        for (mask, score) in logits.chunks_exact(height * width).zip(scores.iter()) {
            if *score < self.manifest.threshold {
                continue;
            }
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..=1000")]
            let score = (score.clamp(0.0, 1.0) * SURE).round() as u16;
            for (cell, logit) in index.iter_mut().zip(mask) {
                if *logit > 0.0 {
                    *cell = score.max(*cell);
                }
            }
        }
        let [width, height] = [width, height].map(|cells| u32::try_from(cells).unwrap_or(u32::MAX));
        Ok(IndexMap { width, height, index })
    }
}

/// What finds a text of these ids, filled up to `length`.
fn inputs<'a>(
    manifest: &'a TextMasksManifest,
    seen: &'a EncodedPhoto,
    mut ids: Vec<i64>,
    length: usize,
) -> Vec<Input<'a>> {
    let names = &manifest.find;
    let mut there = vec![1_i64; ids.len()];
    there.resize(length, 0);
    ids.resize(length, 0);
    let feature = |(name, shape, data): &'a (String, Vec<usize>, Vec<f32>)| {
        Input::new(name, shape, data.as_slice())
    };
    let mut inputs: Vec<Input<'a>> = seen.features.iter().map(feature).collect();
    inputs.push(Input::new(&names.input_ids, &[1, length], ids));
    inputs.extend(names.attention_mask.as_ref().map(|name| Input::new(name, &[1, length], there)));
    inputs
}

/// `[3, size, size]`: the photo stretched to the square.
fn pixels(manifest: &TextMasksManifest, photo: &Photo) -> Vec<f32> {
    let (from, side) = ([photo.width as usize, photo.height as usize], manifest.size as usize);
    let resized = resize(&photo.rgb, from, [side; 2], manifest.resize);
    planes(&resized, [side; 2], [side; 2], manifest.mean, manifest.std)
}

/// The fixed photo that a provider is held to the CPU with.
fn probe() -> Photo {
    let (width, height) = (96_u32, 64);
    let level = |i: u32| u8::try_from(i * i % 251).unwrap_or(0);
    Photo { width, height, rgb: (0..width * height * 3).map(level).collect(), valid: None }
}

/// Each file with its tensors.
pub(super) fn signatures(manifest: &TextMasksManifest) -> Vec<Signature<'_>> {
    vec![
        (IMAGE, &manifest.image.file, image_signature(manifest)),
        (FIND, &manifest.find.file, find_signature(manifest, usize::MAX)),
    ]
}

/// The encoder's tensors; what its outputs are is between the two files.
fn image_signature(manifest: &TextMasksManifest) -> Vec<Wanted<'_>> {
    let side = manifest.size as usize;
    let shape = [1, 3, side, side].map(|size| vec![size]).to_vec();
    let features = manifest.image.features.iter();
    [Wanted::new(Side::Input, &manifest.image.input, shape)]
        .into_iter()
        .chain(features.map(|name| Wanted::unshaped(Side::Output, name)))
        .collect()
}

/// `ids`: ids of the tokenizer.
fn find_signature(manifest: &TextMasksManifest, ids: usize) -> Vec<Wanted<'_>> {
    let names = &manifest.find;
    let tokens = |name, most: usize| {
        let tokens = Wanted::new(Side::Input, name, vec![vec![1], vec![]])
            .at_most(&[1, names.context])
            .of(Numbers::Within([0.0, most as f64]));
        Wanted { whole: Some(true), ..tokens }
    };
    let masks = vec![vec![1], vec![], vec![], vec![]];
    manifest
        .image
        .features
        .iter()
        .map(|name| Wanted::unshaped(Side::Input, name))
        .chain([tokens(&*names.input_ids, ids.saturating_sub(1))])
        .chain(names.attention_mask.iter().map(|name| tokens(&**name, 1)))
        .chain([Wanted::new(Side::Output, &names.masks, masks)])
        .chain([Wanted::new(Side::Output, &names.scores, vec![vec![1], vec![]])])
        .collect()
}
