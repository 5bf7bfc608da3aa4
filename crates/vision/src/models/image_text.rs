//! The image tower and the text tower: crops and texts to embeddings of length 1 in one space.

use std::{
    collections::{BTreeMap, HashSet},
    sync::{Arc, OnceLock},
};

use rayon::prelude::*;
use serde::Deserialize;
use tokenizers::{Encoding, Tokenizer};

use crate::{
    error::{Error, Result},
    models::{
        Bundle, ImageTextManifest, NetworkOptions, Provider, Runtime,
        manifest::unavailable,
        network::{
            FileSignature, Input, Network, Outputs, RunMemory, Side, Signature, Spec, Wanted, fixed,
        },
        resize::{planes, resize},
        tensors::Numbers,
    },
    scene::{Crop, DenseFeatures, Photo, TextEmbedding},
};

/// Names of the two files in messages.
const IMAGE: &str = "image tower";
const TEXT: &str = "text tower";

/// Image and text tower, ready to run from any thread.
#[derive(Debug)]
pub struct ImageText {
    manifest: ImageTextManifest,
    image: Network,
    text: Network,
    tokenizer: Tokenizer,
    unknown: Option<u32>,
    /// Words of the bundle's list of everyday words that name things.
    rivals: Vec<String>,
    /// Their embeddings, after the first call that asks for them.
    embedded: OnceLock<Arc<[Vec<f32>]>>,
    /// The list's single words, in lower case.
    known: HashSet<String>,
    /// Crops a run of the image tower, where its file or a device fixes them.
    crops: Option<usize>,
    /// Tokens a run of the text tower, where its file fixes them.
    tokens: Option<usize>,
    /// Texts a run of the text tower, where its file fixes them.
    texts: Option<usize>,
}

/// Largest difference of a provider to the CPU, of embeddings of texts.
const TOLERANCE: f64 = 2e-3;
/// Crops a run of the image tower on a CPU, which takes as long for each as with 16, and a quarter
/// of the memory (docs/adr/0034-many-photos.md).
const CPU_CROPS: usize = 4;
/// Texts a run of the text tower where its file leaves that free.
const TEXTS_A_RUN: usize = 64;

/// Crops as an image tower takes them.
#[derive(Clone, Debug)]
pub struct PreparedCrops {
    crops: usize,
    /// `[runs * crops of a run, 3, side, side]`.
    pixels: Vec<f32>,
}

/// A text in the tokenizer's ids.
struct Tokens {
    /// With markers of begin and end, cut to the network's context.
    ids: Vec<i64>,
    /// Tokens, markers left out.
    count: usize,
    /// How many of them the tokenizer does not know.
    unknown: usize,
    cut: bool,
}

impl ImageText {
    /// Opens both towers on the provider of the configuration; `None` where the bundle has none.
    ///
    /// # Errors
    /// `model_unavailable` when the provider asked for is not there, or a file does not load.
    pub fn open(
        runtime: &Arc<Runtime>,
        bundle: &Bundle,
        options: &NetworkOptions,
    ) -> Result<Option<Self>> {
        let Some(manifest) = bundle.image_text().cloned() else { return Ok(None) };
        let tokenizer = read_tokenizer(bundle, &manifest.text.tokenizer)?;
        let tower = &manifest.image;
        let side = tower.size as usize;
        let spec = Spec {
            what: IMAGE,
            file: &tower.file,
            cpu_file: None,
            signature: image_signature(&manifest),
            memory: RunMemory::KeptOnDevices,
            tolerance: tower.tolerance,
            probe: &|takes| {
                let count = size(takes, &tower.input, 0).unwrap_or(tower.batch);
                let wave = |i: usize| (i as f32 * 0.013).sin() + (i as f32 * 0.000_7).cos();
                let images: Vec<f32> = (0..count * 3 * side * side).map(wave).collect();
                Ok(vec![Input::new(&tower.input, &[count, 3, side, side], images)])
            },
        };
        let image = Network::open(runtime, bundle, options, &spec)?;
        let tower = &manifest.text;
        let spec = Spec {
            what: TEXT,
            file: &tower.file,
            cpu_file: None,
            signature: text_signature(&manifest, tokenizer.get_vocab_size(true)),
            memory: RunMemory::Kept,
            tolerance: TOLERANCE,
            probe: &|takes| {
                let length = size(takes, &tower.input_ids, 1).unwrap_or(tower.context.min(8));
                let count = size(takes, &tower.input_ids, 0).unwrap_or(3);
                let known = i64::try_from(tokenizer.get_vocab_size(false)).unwrap_or(1).max(1);
                let ids: Vec<i64> =
                    (1..).map(|i: i64| i * 37 % known).take(count * length).collect();
                let mut inputs = vec![Input::new(&tower.input_ids, &[count, length], ids)];
                if let Some(name) = &tower.attention_mask {
                    inputs.push(Input::new(name, &[count, length], vec![1_i64; count * length]));
                }
                Ok(inputs)
            },
        };
        let text = Network::open(runtime, bundle, options, &spec)?;
        let words: Vec<ListedWord> = bundle.words()?;
        Ok(Some(Self {
            // A device looks for its fastest kernels again at each new shape.
            crops: size(image.signature(), &manifest.image.input, 0)
                .or((image.provider() != Provider::Cpu).then_some(manifest.image.batch)),
            tokens: size(text.signature(), &manifest.text.input_ids, 1),
            texts: size(text.signature(), &manifest.text.input_ids, 0),
            unknown: tokenizer.token_to_id(&manifest.text.unknown),
            known: words
                .iter()
                .flat_map(|listed| listed.word.split_whitespace())
                .map(str::to_lowercase)
                .collect(),
            rivals: words.into_iter().filter(|one| one.rival).map(|one| one.word).collect(),
            embedded: OnceLock::new(),
            image,
            text,
            tokenizer: tokenizer.clone(),
            manifest: manifest.clone(),
        }))
    }

    /// Embeds crops and texts: one, and more than a batch.
    ///
    /// # Errors
    /// `internal` when a run fails, or an output has another shape than the manifest says or holds
    /// a number that is not finite.
    pub(super) fn try_out(&self) -> Result<()> {
        let crop = Crop { width: 3, height: 2, rgb: (0..18).map(|i| i * 13).collect() };
        let Crop { width, height, rgb } = crop.clone();
        self.dense(&Photo { width, height, rgb, valid: None })?;
        let text = |i: usize| format!("a photo of {} boxes", i + 1);
        for count in [1, self.manifest.image.batch + 1] {
            self.embed_images(&vec![crop.clone(); count])?;
            self.embed_texts(&(0..count).map(text).collect::<Vec<_>>())?;
        }
        Ok(())
    }

    /// The section of the manifest.
    #[must_use]
    pub fn manifest(&self) -> &ImageTextManifest {
        &self.manifest
    }

    /// The image tower itself.
    #[must_use]
    pub fn image_tower(&self) -> &Network {
        &self.image
    }

    /// The text tower itself.
    #[must_use]
    pub fn text_tower(&self) -> &Network {
        &self.text
    }

    /// What computes them.
    #[must_use]
    pub fn provider(&self) -> Provider {
        self.image.provider()
    }

    /// Why a tower is not computed where it was to be; `None` where both are.
    #[must_use]
    pub fn remark(&self) -> Option<String> {
        self.image.remark().or_else(|| self.text.remark())
    }

    /// Embeddings of the words of the bundle's list that name things; none where it has no list.
    ///
    /// # Errors
    /// As [`Self::embed_texts`].
    pub fn rivals(&self) -> Result<Arc<[Vec<f32>]>> {
        if let Some(known) = self.embedded.get() {
            return Ok(Arc::clone(known));
        }
        let rows = self.embed_texts(&self.rivals)?;
        let made = rows.into_iter().map(|text| text.row).collect();
        Ok(Arc::clone(self.embedded.get_or_init(|| made)))
    }

    /// `[crops * dim]`, rows of unit length; a row that has no length stays 0.
    ///
    /// # Errors
    /// `internal` when the network fails or answers with another shape than its manifest says.
    pub fn embed_images(&self, crops: &[Crop]) -> Result<Vec<f32>> {
        let mut rows = Vec::with_capacity(crops.len() * self.manifest.dim);
        for batch in crops.chunks(self.manifest.image.batch.max(self.crops_a_run())) {
            rows.extend(self.embed_prepared(&self.prepare(batch))?);
        }
        Ok(rows)
    }

    /// Crops as the image tower takes them, which needs no network.
    #[must_use]
    pub fn prepare(&self, crops: &[Crop]) -> PreparedCrops {
        let tower = &self.manifest.image;
        let side = tower.size as usize;
        // Where the number of crops of a run is fixed, the last run is filled up.
        let count = match self.crops {
            Some(fixed) => crops.len().next_multiple_of(fixed),
            None => crops.len(),
        };
        let mut pixels = vec![0.0; count * 3 * side * side];
        pixels.par_chunks_exact_mut(3 * side * side).zip(crops).for_each(|(out, crop)| {
            let from = [crop.width, crop.height].map(|side| side as usize);
            let resized = resize(&crop.rgb, from, [side; 2], tower.resize);
            out.copy_from_slice(&planes(&resized, [side; 2], [side; 2], tower.mean, tower.std));
        });
        PreparedCrops { crops: crops.len(), pixels }
    }

    /// `[crops * dim]` unit embeddings.
    ///
    /// # Errors
    /// As [`Self::embed_images`].
    pub fn embed_prepared(&self, prepared: &PreparedCrops) -> Result<Vec<f32>> {
        let tower = &self.manifest.image;
        let side = tower.size as usize;
        let each = 3 * side * side;
        let mut rows = Vec::with_capacity(prepared.crops * self.manifest.dim);
        for pixels in prepared.pixels.chunks(self.crops_a_run() * each) {
            let count = pixels.len() / each;
            let input = Input::new(&tower.input, &[count, 3, side, side], pixels);
            let read = |outputs: &dyn Outputs| self.rows(outputs, &tower.output, count, IMAGE);
            rows.extend(self.image.run_for(&[input], &[&tower.output], read)?);
        }
        rows.truncate(prepared.crops * self.manifest.dim);
        Ok(rows)
    }

    /// The features of a whole photo, whose means under masks are their contexts; `None` where the
    /// image tower has none.
    ///
    /// # Errors
    /// `internal` when the network fails, or answers with another shape than its manifest says or
    /// with a number that is not finite.
    pub fn dense(&self, photo: &Photo) -> Result<Option<DenseFeatures>> {
        let tower = &self.manifest.image;
        let Some(dense) = &tower.dense else { return Ok(None) };
        let placed = dense.fitted([photo.width, photo.height]).map(|side| side as usize);
        let from = [photo.width, photo.height].map(|side| side as usize);
        let resized = resize(&photo.rgb, from, placed, tower.resize);
        let pixels = planes(&resized, placed, placed, tower.mean, tower.std);
        // A file or a device that fixes the number of pictures gets the same one in each place.
        let count = size(self.image.signature(), &tower.input, 0).unwrap_or(1);
        let input =
            Input::new(&tower.input, &[count, 3, placed[1], placed[0]], pixels.repeat(count));
        let [columns, rows] = placed.map(|side| side / dense.cell as usize);
        let each = self.manifest.dim * rows * columns;
        let read = |outputs: &dyn Outputs| {
            let (shape, data) = outputs.get(&dense.output)?;
            let wanted = [count, self.manifest.dim, rows, columns];
            if shape != wanted {
                return Err(Error::internal(format!(
                    "{IMAGE}: {:?} is {shape:?}, not {wanted:?}",
                    dense.output
                )));
            }
            let data = data[..each].to_vec();
            match data.iter().all(|v| v.is_finite()) {
                true => Ok(Some(DenseFeatures { columns, rows, data })),
                false => Err(Error::internal(format!("{IMAGE}: a feature is not finite"))),
            }
        };
        self.image.run_for(&[input], &[&dense.output], read)
    }

    fn crops_a_run(&self) -> usize {
        self.crops.unwrap_or(self.manifest.image.batch.min(CPU_CROPS)).max(1)
    }

    /// The embedding of each text. Texts of one length run together; a row depends on the others
    /// by rounding at most, and with the embedded bundle by no bit.
    ///
    /// # Errors
    /// `invalid_request` when a text holds nothing that the tower reads; `internal` when the
    /// network fails or answers with another shape than its manifest says.
    pub fn embed_texts(&self, texts: &[String]) -> Result<Vec<TextEmbedding>> {
        let read: Vec<Tokens> = texts.iter().map(|text| self.read(text)).collect::<Result<_>>()?;
        let mut by_length: BTreeMap<usize, Vec<usize>> = BTreeMap::new();
        for (i, tokens) in read.iter().enumerate() {
            by_length.entry(self.tokens.unwrap_or(tokens.ids.len())).or_default().push(i);
        }
        let mut rows = vec![Vec::new(); texts.len()];
        for (length, alike) in by_length {
            for batch in alike.chunks(self.texts.unwrap_or(TEXTS_A_RUN)) {
                let found = self.run_texts(batch.iter().map(|&i| &read[i]), length)?;
                for (&i, row) in batch.iter().zip(found.chunks_exact(self.manifest.dim)) {
                    rows[i] = row.to_vec();
                }
            }
        }
        let embedding = |(row, Tokens { count, unknown, cut, .. })| TextEmbedding {
            row,
            tokens: count,
            unknown,
            cut,
        };
        Ok(rows.into_iter().zip(read).map(embedding).collect())
    }

    /// A text as the text tower reads it.
    fn read(&self, text: &str) -> Result<Tokens> {
        let tower = &self.manifest.text;
        let context = self.tokens.map_or(tower.context, |fixed| fixed.min(tower.context));
        let encoding = self.tokenizer.encode(text, true).map_err(|e| {
            Error::invalid(format!("text {text:?} cannot be read by the tokenizer: {e}"))
        })?;
        let special = encoding.get_special_tokens_mask();
        let words = || encoding.get_ids().iter().zip(special).filter(|(_, s)| **s == 0);
        let count = words().count();
        if count == 0 {
            return Err(Error::invalid(format!(
                "text {text:?} holds nothing that the text tower reads; write words"
            )));
        }
        let mut unknown = words().filter(|(id, _)| self.unknown == Some(**id)).count();
        if unknown == 0 {
            unknown = self.in_short_pieces(text, &encoding);
        }
        let (ids, cut) = (cut_ids(&encoding, context), encoding.get_ids().len() > context);
        Ok(Tokens { ids, count, unknown, cut })
    }

    /// Pieces of words that are cut into very short ones and that the bundle's list does not have:
    /// the tower has not learnt them.
    fn in_short_pieces(&self, text: &str, encoding: &Encoding) -> usize {
        let least = self.manifest.text.piece_letters;
        if least <= 0.0 {
            return 0;
        }
        // Of each word its pieces and its place in the text.
        let mut words: BTreeMap<u32, (usize, [usize; 2])> = BTreeMap::new();
        for (word, (from, to)) in encoding.get_word_ids().iter().zip(encoding.get_offsets()) {
            let Some(word) = word else { continue };
            let (pieces, at) = words.entry(*word).or_insert((0, [*from, *to]));
            *pieces += 1;
            *at = [at[0].min(*from), at[1].max(*to)];
        }
        let short = |(pieces, [from, to]): &(usize, [usize; 2])| {
            let word = text.get(*from..*to).unwrap_or_default().to_lowercase();
            *pieces > 1
                && word.chars().all(char::is_alphabetic)
                && (word.chars().count() as f32) < least * *pieces as f32
                && !self.known.contains(&word)
        };
        words.values().filter(|word| short(word)).map(|(pieces, _)| pieces).sum()
    }

    /// Rows of texts of at most `length` ids, in one run; a file of fixed batch gets its last one
    /// filled up, and the rows of that follow the others.
    fn run_texts<'a>(
        &self,
        texts: impl Iterator<Item = &'a Tokens>,
        length: usize,
    ) -> Result<Vec<f32>> {
        let tower = &self.manifest.text;
        let (mut ids, mut there) = (Vec::new(), Vec::new());
        let mut count = 0;
        for text in texts {
            count += 1;
            ids.extend(&text.ids);
            ids.resize(count * length, self.padding());
            there.resize((count - 1) * length + text.ids.len(), 1_i64);
            there.resize(count * length, 0);
        }
        if let Some(fixed) = self.texts {
            count = fixed;
            ids = ids.into_iter().cycle().take(count * length).collect();
            there = there.into_iter().cycle().take(count * length).collect();
        }
        let mut inputs = vec![Input::new(&tower.input_ids, &[count, length], ids)];
        if let Some(name) = &tower.attention_mask {
            inputs.push(Input::new(name, &[count, length], there));
        }
        self.text.run(&inputs, |outputs| self.rows(outputs, &tower.output, count, TEXT))
    }

    /// Id that fills up a text.
    fn padding(&self) -> i64 {
        self.tokenizer.get_padding().map_or(0, |padding| i64::from(padding.pad_id))
    }

    /// Rows of an output, made unit length in f64.
    fn rows(
        &self,
        outputs: &dyn Outputs,
        name: &str,
        count: usize,
        what: &str,
    ) -> Result<Vec<f32>> {
        let dim = self.manifest.dim;
        let (shape, data) = outputs.get(name)?;
        let wanted = [count, dim];
        if shape != wanted {
            return Err(Error::internal(format!("{what}: output is {shape:?}, not {wanted:?}")));
        }
        let mut rows = data.to_vec();
        for row in rows.chunks_exact_mut(dim) {
            let length = row.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
            if !length.is_finite() {
                return Err(Error::internal(format!("{what}: an embedding is not finite")));
            }
            if length > 0.0 {
                #[expect(clippy::cast_possible_truncation, reason = "embeddings are f32")]
                row.iter_mut().for_each(|v| *v = (f64::from(*v) / length) as f32);
            }
        }
        Ok(rows)
    }
}

/// At most `context` ids of a text. The end marker stays at the end of one that is cut: networks
/// read the sentence there.
pub(super) fn cut_ids(encoding: &Encoding, context: usize) -> Vec<i64> {
    let whole = encoding.get_ids();
    let mut ids: Vec<i64> = whole.iter().take(context).map(|&id| i64::from(id)).collect();
    if let (true, Some(1), Some(last), Some(end)) = (
        whole.len() > context,
        encoding.get_special_tokens_mask().last(),
        ids.last_mut(),
        whole.last(),
    ) {
        *last = i64::from(*end);
    }
    ids
}

/// Each file with its tensors.
pub(super) fn signatures(manifest: &ImageTextManifest) -> Vec<Signature<'_>> {
    let (image, text) = (&manifest.image, &manifest.text);
    vec![
        (IMAGE, &image.file, image_signature(manifest)),
        (TEXT, &text.file, text_signature(manifest, usize::MAX)),
    ]
}

fn image_signature(manifest: &ImageTextManifest) -> Vec<Wanted<'_>> {
    let (tower, mut sides) = (&manifest.image, vec![manifest.image.size as usize]);
    let mut dense = None;
    if let Some(of) = &tower.dense {
        let cell = of.cell as usize;
        sides.extend((1..=of.side as usize / cell).map(|cells| cells * cell));
        let cells = vec![vec![], vec![manifest.dim], vec![], vec![]];
        dense = Some(Wanted::new(Side::Output, &of.output, cells));
    }
    let pictures = vec![vec![], vec![3], sides.clone(), sides];
    let taken = Wanted::new(Side::Input, &tower.input, pictures);
    let output = Wanted::new(Side::Output, &tower.output, vec![vec![], vec![manifest.dim]]);
    let taken = taken.at_most(&[tower.batch.min(CPU_CROPS)]);
    [taken, output].into_iter().chain(dense).collect()
}

/// `ids`: ids of the tokenizer.
fn text_signature(manifest: &ImageTextManifest, ids: usize) -> Vec<Wanted<'_>> {
    let tower = &manifest.text;
    let tokens = |name, most: usize| {
        let tokens = Wanted::new(Side::Input, name, vec![vec![], vec![]])
            .at_most(&[TEXTS_A_RUN, tower.context])
            .of(Numbers::Within([0.0, most as f64]));
        Wanted { whole: Some(true), ..tokens }
    };
    let ids = tokens(&*tower.input_ids, ids.saturating_sub(1));
    let there = tower.attention_mask.iter().map(|name| tokens(&**name, 1));
    let output = Wanted::new(Side::Output, &tower.output, vec![vec![], vec![manifest.dim]]);
    [ids].into_iter().chain(there).chain([output]).collect()
}

/// A dimension of an input, where the file fixes it.
pub(super) fn size(takes: &FileSignature, input: &str, axis: usize) -> Option<usize> {
    takes.get(input)?.shape.get(axis).copied().and_then(fixed)
}

/// A row of the list of words that the bundle measured, as far as it is needed here.
#[derive(Deserialize)]
struct ListedWord {
    word: String,
    /// Whether it names a thing, as no colour does.
    #[serde(default = "yes")]
    rival: bool,
}

fn yes() -> bool {
    true
}

/// The tokenizer's file, whose own truncation is switched off: it is done here.
pub(super) fn read_tokenizer(bundle: &Bundle, named: &str) -> Result<Tokenizer> {
    let refused = |why: String| unavailable(format!("{named}: {why}"));
    let bytes = fs_err::read(bundle.path(named)).map_err(|e| refused(e.kind().to_string()))?;
    let mut tokenizer = Tokenizer::from_bytes(&bytes).map_err(|e| refused(e.to_string()))?;
    tokenizer.with_truncation(None).map_err(|e| refused(e.to_string()))?;
    Ok(tokenizer)
}
