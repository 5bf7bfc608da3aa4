//! The mask network: it encodes a photo once, then decodes points of it to masks.
//!
//! The manifest's `adapter` names one of two signatures. The inputs of a file (a batch of prompts
//! or one, a former mask, the photo's size) are read from the file itself.

use std::{borrow::Cow, sync::Arc};

use tracing::warn;

use crate::{
    error::{Error, Result},
    models::{
        Bundle, MaskAdapter, MasksManifest, NetworkOptions, Provider, Runtime,
        manifest::unavailable,
        network::{self, Input, Network, Outputs, RunMemory, Side, Signature, Spec, Wanted, fixed},
        resize::{planes, resize},
        tensors::Numbers,
    },
    scene::{JudgedMasks, MaskJudging, MaskLogits, Photo},
};

/// Names of the two files in messages.
const ENCODER: &str = "mask encoder";
const DECODER: &str = "mask decoder";
/// Tensors of a decoder's file that judges masks at the photo's pixels; `models/export/sam.py`.
const JUDGED_LEVELS: &str = "judged_levels";
const PHOTO_ROWS: &str = "photo_rows";
const PHOTO_COLUMNS: &str = "photo_columns";
const STABILITY_OFFSET: &str = "stability_offset";
const MASK_BITS: &str = "mask_bits";
const MASK_COUNTS: &str = "mask_counts";
/// Prompts a run of the decoder on a CPU, which takes as long for each as with 64, and a quarter of
/// the memory (docs/adr/0034-many-photos.md).
const CPU_PROMPTS: usize = 16;
/// Most pixels of masks that are judged in one run: a quarter of a gigabyte of f32, a few times.
const JUDGED_PIXELS_MAX: usize = 1 << 26;
/// Largest share of judged pixels that may differ from the logits: those next to a threshold.
const JUDGED_OFF_MAX: f64 = 5e-3;
/// Side of the logits of an `efficient_sam` decoder, before it enlarges them.
const EFFICIENT_SAM_LOGITS: u32 = 256;

/// The network, ready to run from any thread.
#[derive(Debug)]
pub struct MaskNetwork {
    manifest: MasksManifest,
    encoder: Network,
    decoder: Network,
    takes: DecoderInputs,
}

/// A photo as the encoder saw it.
#[derive(Clone, Debug)]
pub struct PhotoEmbedding {
    resized: [u32; 2],
    /// Name for the decoder, shape and data.
    tensors: Vec<(String, Vec<usize>, Vec<f32>)>,
}

/// What the decoder's file takes.
#[derive(Clone, Debug)]
struct DecoderInputs {
    /// The signature `efficient_sam`.
    efficient: bool,
    /// Prompts a run.
    batch: usize,
    /// Points of a prompt: the prompt itself, then padding.
    points: usize,
    /// Shape of the former mask, where there is such an input.
    mask: Option<Vec<usize>>,
    has_mask: bool,
    /// Whether the photo's size is an input, and of whole numbers.
    size: Option<bool>,
    /// `[width, height]` of the grid of logits, where the file judges masks.
    judged: Option<[usize; 2]>,
}

impl PhotoEmbedding {
    /// `[width, height]` of the part of the encoder's square that the photo fills, pixels.
    #[must_use]
    pub fn resized(&self) -> [u32; 2] {
        self.resized
    }

    /// All numbers, one tensor after the other.
    #[must_use]
    pub fn numbers(&self) -> Vec<f32> {
        self.tensors.iter().flat_map(|(_, _, data)| data).copied().collect()
    }
}

impl MaskNetwork {
    /// Opens encoder and decoder on the provider of the configuration; `None` where the bundle has
    /// no masks.
    ///
    /// # Errors
    /// `model_unavailable` when the provider asked for is not there, a file does not load, or its
    /// inputs are not those of the manifest.
    pub fn open(
        runtime: &Arc<Runtime>,
        bundle: &Bundle,
        options: &NetworkOptions,
    ) -> Result<Option<Self>> {
        let Some(manifest) = bundle.masks().cloned() else { return Ok(None) };
        let photo = probe();
        let (names, resized, image) =
            (&manifest.encoder, placed(&manifest, &photo), image(&manifest, &photo));
        let side = manifest.size as usize;
        let input = || Input::new(&names.input, &[1, 3, side, side], &*image);
        let spec = Spec {
            what: ENCODER,
            file: &names.file,
            cpu_file: None,
            signature: encoder_signature(&manifest),
            memory: RunMemory::KeptOnDevices,
            tolerance: manifest.tolerance,
            probe: &|_| Ok(vec![input()]),
        };
        let encoder = Network::open(runtime, bundle, options, &spec)?;
        let read = |outputs: &dyn Outputs| embedding(&manifest, resized, outputs);
        let seen = encoder.run(&[input()], read)?;
        let points: Vec<[f32; 2]> = (0..manifest.points_per_batch)
            .map(|i| [(i % 8) as f32 / 8.0 + 0.05, (i / 8 % 8) as f32 / 8.0 + 0.05])
            .collect();
        let spec = Spec {
            what: DECODER,
            file: &manifest.decoder.file,
            cpu_file: None,
            signature: decoder_signature(&manifest),
            memory: RunMemory::Kept,
            tolerance: manifest.tolerance,
            probe: &|found| {
                let takes = DecoderInputs::of(found, &manifest, points.len())?;
                let points = &points[..takes.batch.min(points.len())];
                Ok(takes.inputs(&manifest, &seen, points, None))
            },
        };
        let decoder = Network::open(runtime, bundle, options, &spec)?;
        let most = match decoder.provider() {
            Provider::Cpu => points.len().min(CPU_PROMPTS),
            Provider::Cuda | Provider::Webgpu => points.len(),
        };
        let takes = DecoderInputs::of(decoder.signature(), &manifest, most)?;
        let mut network = Self { encoder, decoder, takes, manifest: manifest.clone() };
        if network.judges().is_some()
            && network.provider() != Provider::Cpu
            && let Err(error) = network.hold_judge(&seen)
        {
            warn!(network = DECODER, %error, "its masks are judged by the CPU");
            network.takes.judged = None;
        }
        Ok(Some(network))
    }

    /// Holds masks that the decoder judges to its own logits.
    ///
    /// # Errors
    /// `internal` when a run fails or more than [`JUDGED_OFF_MAX`] of the pixels differ.
    fn hold_judge(&self, seen: &PhotoEmbedding) -> Result<()> {
        let points = [[0.2_f32, 0.3], [0.6, 0.5], [0.9, 0.8]];
        let logits = self.decode(seen, &points)?;
        let ([width, height], [columns, rows]) = (logits.grid, [45, 37]);
        // As a photo's: each pixel lies between two cells.
        let weight = |cell: usize, cells: usize, at: usize, all: usize| {
            let place = (at as f32 + 0.5) * cells as f32 / all as f32 - 0.5;
            (1.0 - (place - cell as f32).abs()).max(0.0)
        };
        let row = |y| (0..height).map(move |cell| weight(cell, height, y, rows));
        let of_cell = |cell| (0..columns).map(move |x| weight(cell, width, x, columns));
        let judging = MaskJudging {
            levels: (0..logits.levels).collect(),
            pixels: [columns, rows],
            rows: (0..rows).flat_map(row).collect(),
            columns: (0..width).flat_map(of_cell).collect(),
            stability_offset: self.manifest.stability_score_offset,
        };
        let found = self.judge(seen, &points, &judging)?;
        let (all, bytes) = (columns * rows, (columns * rows).div_ceil(64) * 8);
        let mut off = 0;
        for (at, grid) in logits.logits.chunks_exact(width * height).enumerate() {
            let value = |pixel: usize| -> f32 {
                let (x, y) = (pixel % columns, pixel / columns);
                let of_line = |cell: usize| -> f32 {
                    let cells = grid[cell * width..].iter().take(width).enumerate();
                    cells.map(|(i, v)| v * judging.columns[i * columns + x]).sum()
                };
                let weights = judging.rows[y * height..].iter().take(height).enumerate();
                weights.filter(|(_, w)| **w > 0.0).map(|(cell, w)| w * of_line(cell)).sum()
            };
            let values: Vec<f32> = (0..all).map(value).collect();
            let over = |least: f32| values.iter().filter(|v| **v > least).count();
            let bit = |i: usize| found.bits[at * bytes + i / 8] >> (i % 8) & 1 == 1;
            off += (0..all).filter(|&i| bit(i) != (values[i] > 0.0)).count();
            for (count, sign) in found.counts[2 * at..].iter().zip([1.0, -1.0]) {
                let wanted = over(sign * judging.stability_offset) as f32;
                off += (wanted - count).abs().round() as usize;
            }
        }
        let share = off as f64 / (3 * all * points.len() * logits.levels) as f64;
        if share <= JUDGED_OFF_MAX {
            return Ok(());
        }
        Err(Error::internal(format!(
            "{DECODER}: {share:.1e} of the pixels that it judges are not those of its logits, over \
             {JUDGED_OFF_MAX:.0e}"
        )))
    }

    /// Encodes a photo and decodes points of it, one and a batch, and looks at all numbers.
    ///
    /// # Errors
    /// `internal` when a run fails, or an output has another shape than the manifest says or holds
    /// a number that is not finite.
    pub(super) fn try_out(&self) -> Result<()> {
        let embedding = self.encode(&probe())?;
        for count in [1, self.manifest.points_per_batch as usize + 1] {
            let found = self.decode(&embedding, &vec![[0.5; 2]; count])?;
            if !found.logits.iter().chain(&found.predicted_iou).all(|v| v.is_finite()) {
                return Err(Error::internal(format!("{DECODER}: a number is not finite")));
            }
        }
        if self.judges().is_some() {
            self.hold_judge(&embedding)?;
        }
        Ok(())
    }

    /// Why a part is not computed where it was to be; `None` where all are.
    #[must_use]
    pub fn remark(&self) -> Option<String> {
        self.encoder.remark().or_else(|| self.decoder.remark())
    }

    /// The network's section of the manifest.
    #[must_use]
    pub fn manifest(&self) -> &MasksManifest {
        &self.manifest
    }

    /// Runs the encoder.
    ///
    /// # Errors
    /// `internal` when the network fails or has not the outputs of its manifest.
    pub fn encode(&self, photo: &Photo) -> Result<PhotoEmbedding> {
        let (manifest, side) = (&self.manifest, self.manifest.size as usize);
        let image = image(manifest, photo);
        let input = Input::new(&manifest.encoder.input, &[1, 3, side, side], &*image);
        let resized = placed(manifest, photo);
        self.encoder.run(&[input], |outputs| embedding(manifest, resized, outputs))
    }

    /// Masks of each point; points are shares 0..1 of the photo's width and height.
    ///
    /// # Errors
    /// `internal` when the network fails or answers with other shapes than its manifest says.
    pub fn decode(&self, embedding: &PhotoEmbedding, points: &[[f32; 2]]) -> Result<MaskLogits> {
        self.decode_over(embedding, points, f32::NEG_INFINITY)
    }

    /// As [`Self::decode`], with logits of 0 where a mask's predicted IoU is not over `iou_over`:
    /// most masks are not copied.
    ///
    /// # Errors
    /// As [`Self::decode`].
    pub fn decode_over(
        &self,
        embedding: &PhotoEmbedding,
        points: &[[f32; 2]],
        iou_over: f32,
    ) -> Result<MaskLogits> {
        let mut all = MaskLogits {
            levels: self.manifest.levels.len(),
            grid: [0, 0],
            logits: Vec::new(),
            predicted_iou: Vec::new(),
        };
        let names = &self.manifest.decoder;
        let only = [&*names.low_res_masks, &*names.iou_predictions];
        for batch in points.chunks(self.takes.batch) {
            let inputs = self.takes.inputs(&self.manifest, embedding, batch, None);
            let counts = [batch.len(), points.len()];
            let read = |outputs: &dyn Outputs| self.append(counts, iou_over, outputs, &mut all);
            self.decoder.run_for(&inputs, &only, read)?;
        }
        Ok(all)
    }

    /// `[width, height]` of the decoder's grid of logits, where its file judges masks at the
    /// photo's pixels ([`Self::judge`]).
    #[must_use]
    pub fn judges(&self) -> Option<[usize; 2]> {
        self.takes.judged
    }

    /// The encoder itself.
    #[must_use]
    pub fn encoder(&self) -> &Network {
        &self.encoder
    }

    /// The decoder itself.
    #[must_use]
    pub fn decoder(&self) -> &Network {
        &self.decoder
    }

    /// What computes the decoder.
    #[must_use]
    pub fn provider(&self) -> Provider {
        self.decoder.provider()
    }

    /// Masks of each point at the photo's pixels: a device gives bits back, and no logits.
    ///
    /// # Errors
    /// `internal` when the network fails, answers with other shapes than asked for, or its file
    /// does not judge.
    pub fn judge(
        &self,
        embedding: &PhotoEmbedding,
        points: &[[f32; 2]],
        judging: &MaskJudging,
    ) -> Result<JudgedMasks> {
        if self.takes.judged.is_none() {
            return Err(Error::internal(format!("{DECODER}: its file does not judge masks")));
        }
        let kinds = judging.levels.len();
        let pixels = judging.pixels[0] * judging.pixels[1];
        let most = (JUDGED_PIXELS_MAX / (kinds * pixels).max(1)).max(1);
        let iou_predictions = &*self.manifest.decoder.iou_predictions;
        let only = [iou_predictions, MASK_BITS, MASK_COUNTS];
        let mut all = JudgedMasks::default();
        for batch in points.chunks(self.takes.batch.min(most)) {
            let inputs = self.takes.inputs(&self.manifest, embedding, batch, Some(judging));
            self.decoder.run_for(&inputs, &only, |outputs| {
                let (bits_shape, bits) = outputs.bytes(MASK_BITS)?;
                let (counts_shape, counts) = outputs.get(MASK_COUNTS)?;
                let (iou_shape, iou) = outputs.get(iou_predictions)?;
                let of = |last: usize| [batch.len(), kinds, last];
                let all_kinds = iou_shape.get(1).copied().unwrap_or(0);
                let levels = &self.manifest.levels;
                let own: Vec<usize> = judging.levels.iter().map(|&at| levels[at]).collect();
                if bits_shape != of(pixels.div_ceil(64) * 8)
                    || counts_shape != of(2)
                    || iou_shape != [batch.len(), all_kinds]
                    || own.iter().any(|&level| level >= all_kinds)
                {
                    return Err(Error::internal(format!(
                        "{DECODER}: {} prompts and levels {own:?} of {pixels} pixels are judged \
                         by {bits_shape:?} bytes, {counts_shape:?} counts and {iou_shape:?} IoUs",
                        batch.len()
                    )));
                }
                all.bits.extend_from_slice(bits);
                all.counts.extend_from_slice(&counts);
                for of_point in iou.chunks_exact(all_kinds) {
                    all.predicted_iou.extend(own.iter().map(|&level| of_point[level]));
                }
                Ok(())
            })?;
        }
        Ok(all)
    }

    /// Appends the masks that one run of the decoder gave for `count` points of `in_all`.
    fn append(
        &self,
        [count, in_all]: [usize; 2],
        iou_over: f32,
        outputs: &dyn Outputs,
        all: &mut MaskLogits,
    ) -> Result<()> {
        let names = &self.manifest.decoder;
        let lead: &[usize] = if self.takes.efficient { &[1] } else { &[] };
        let get = |name: &str, tail: usize| -> Result<(Vec<usize>, Cow<'_, [f32]>)> {
            let (shape, data) = outputs.get(name)?;
            let wanted = [lead, &[count]].concat();
            if shape.len() != wanted.len() + tail || shape[..wanted.len()] != wanted {
                return Err(Error::internal(format!(
                    "{DECODER}: output {name:?} is {shape:?} for {count} prompts"
                )));
            }
            Ok((shape[wanted.len()..].to_vec(), data))
        };
        let (shape, logits) = get(&names.low_res_masks, 3)?;
        let (found, iou) = get(&names.iou_predictions, 1)?;
        let (kinds, grid) = (shape[0], [shape[2], shape[1]]);
        let levels = &self.manifest.levels;
        let fits = found[0] == kinds && levels.iter().all(|&level| level < kinds);
        if !fits || (all.grid != grid && all.grid != [0, 0]) || grid.contains(&0) {
            return Err(Error::internal(format!(
                "{DECODER}: masks are {shape:?} and IoUs {found:?}, with levels {levels:?}"
            )));
        }
        all.grid = grid;
        let cells = grid[0] * grid[1];
        if all.logits.is_empty() {
            // Zeroed memory that is never written takes no time.
            all.logits = vec![0.0; in_all * levels.len() * cells];
        }
        for prompt in 0..count {
            for level in levels {
                let (at, to) = (prompt * kinds + level, all.predicted_iou.len());
                if iou[at] > iou_over {
                    let own = &logits[at * cells..(at + 1) * cells];
                    all.logits[to * cells..(to + 1) * cells].copy_from_slice(own);
                }
                all.predicted_iou.push(iou[at]);
            }
        }
        Ok(())
    }
}

impl DecoderInputs {
    /// Reads the inputs of the decoder's file; `most` prompts a run where it leaves that free.
    fn of(file: &network::FileSignature, manifest: &MasksManifest, most: usize) -> Result<Self> {
        let names = &manifest.decoder;
        let efficient = manifest.adapter == MaskAdapter::EfficientSam;
        let wanted = if efficient { 4 } else { 3 };
        let coords = file.get(&names.point_coords).map_or(&[][..], |taken| &taken.shape);
        if coords.len() != wanted {
            return Err(unavailable(format!(
                "{DECODER}: input {:?} of {} has {} dimensions, not {wanted}",
                names.point_coords,
                names.file,
                coords.len()
            )));
        }
        // A padding point follows the prompt, as SAM's own code adds one where there is no box.
        // EfficientSAM pads by itself.
        let points = fixed(coords[wanted - 2]).unwrap_or(if efficient { 1 } else { 2 });
        let batch = manifest.points_per_batch as usize;
        Ok(Self {
            efficient,
            batch: fixed(coords[wanted - 3]).map_or(most, |fixed| fixed.min(batch)),
            points,
            mask: file
                .get(&names.mask_input)
                .map(|taken| taken.shape.iter().map(|&n| fixed(n).unwrap_or(1)).collect()),
            has_mask: file.get(&names.has_mask_input).is_some(),
            size: file.get(&names.orig_im_size).map(network::FileTensor::whole),
            judged: file.get(PHOTO_ROWS).zip(file.get(PHOTO_COLUMNS)).and_then(
                |(rows, columns)| {
                    let side =
                        |taken: &network::FileTensor, axis: usize| fixed(*taken.shape.get(axis)?);
                    Some([side(columns, 0)?, side(rows, 1)?])
                },
            ),
        })
    }

    /// The inputs of one run for these points, shares of the photo's sides.
    fn inputs<'a>(
        &self,
        manifest: &'a MasksManifest,
        embedding: &'a PhotoEmbedding,
        points: &[[f32; 2]],
        judging: Option<&'a MaskJudging>,
    ) -> Vec<Input<'a>> {
        let (names, count, each) = (&manifest.decoder, points.len(), self.points);
        // EfficientSAM takes points in pixels of the size that its masks come back in.
        let frame = if self.efficient { [EFFICIENT_SAM_LOGITS; 2] } else { embedding.resized };
        let mut coords = vec![0.0_f32; count * each * 2];
        let mut labels = vec![-1.0_f32; count * each];
        for (i, point) in points.iter().enumerate() {
            for axis in 0..2 {
                coords[i * each * 2 + axis] = point[axis] * frame[axis] as f32;
            }
            labels[i * each] = 1.0;
        }
        let tensors = embedding.tensors.iter();
        let mut inputs: Vec<Input<'_>> =
            tensors.map(|(name, shape, data)| Input::new(name, shape, &**data)).collect();
        let lead: &[usize] = if self.efficient { &[1] } else { &[] };
        let coords_shape = [lead, &[count, each, 2]].concat();
        inputs.push(Input::new(&names.point_coords, &coords_shape, coords));
        let labels_shape = [lead, &[count, each]].concat();
        inputs.push(Input::new(&names.point_labels, &labels_shape, labels));
        if let Some(shape) = &self.mask {
            let mask = vec![0.0_f32; shape.iter().product()];
            inputs.push(Input::new(&names.mask_input, shape, mask));
        }
        if self.has_mask {
            inputs.push(Input::new(&names.has_mask_input, &[1], vec![0.0_f32]));
        }
        // SAM's decoder enlarges its masks to this size. Nobody reads these, so it is the smallest.
        let size = if self.efficient { frame } else { [1, 1] };
        let name = &names.orig_im_size;
        match self.size {
            Some(true) => inputs.push(Input::new(name, &[2], size.map(i64::from).to_vec())),
            Some(false) => inputs.push(Input::new(name, &[2], size.map(|v| v as f32).to_vec())),
            None => {}
        }
        if let Some([width, height]) = self.judged {
            inputs.extend(judged_inputs(manifest, [width, height], judging));
        }
        inputs
    }
}

/// What a file that judges masks takes for that; without `judging` one pixel of the first level,
/// which nobody reads.
fn judged_inputs<'a>(
    manifest: &MasksManifest,
    [grid_width, grid_height]: [usize; 2],
    judging: Option<&'a MaskJudging>,
) -> [Input<'a>; 4] {
    let [width, height] = judging.map_or([1, 1], |how| how.pixels);
    let level = |at: &usize| i64::try_from(manifest.levels[*at]).unwrap_or(i64::MAX);
    let levels: Vec<i64> = judging.map_or(&[0][..], |how| &how.levels).iter().map(level).collect();
    let (rows, columns): (Cow<'a, [f32]>, Cow<'a, [f32]>) = match judging {
        Some(how) => ((&how.rows).into(), (&how.columns).into()),
        None => (vec![0.0; grid_height].into(), vec![0.0; grid_width].into()),
    };
    let offset = judging.map_or(0.0, |how| how.stability_offset);
    [
        Input::new(JUDGED_LEVELS, &[levels.len()], levels),
        Input::new(PHOTO_ROWS, &[height, grid_height], rows),
        Input::new(PHOTO_COLUMNS, &[grid_width, width], columns),
        Input::new(STABILITY_OFFSET, &[1], vec![offset]),
    ]
}

/// `[width, height]` of the photo in the encoder's square.
fn placed(manifest: &MasksManifest, photo: &Photo) -> [u32; 2] {
    match manifest.adapter {
        MaskAdapter::Sam => longest(photo, manifest.size),
        MaskAdapter::EfficientSam => [manifest.size; 2],
    }
}

/// `[3, size, size]`: the photo as the encoder takes it.
fn image(manifest: &MasksManifest, photo: &Photo) -> Vec<f32> {
    let placed = placed(manifest, photo).map(|side| side as usize);
    let from = [photo.width, photo.height].map(|side| side as usize);
    let pixels = resize(&photo.rgb, from, placed, manifest.resize);
    planes(&pixels, placed, [manifest.size as usize; 2], manifest.mean, manifest.std)
}

/// Each file with its tensors.
pub(super) fn signatures(manifest: &MasksManifest) -> Vec<Signature<'_>> {
    let (encoder, decoder) = (encoder_signature(manifest), decoder_signature(manifest));
    vec![(ENCODER, &manifest.encoder.file, encoder), (DECODER, &manifest.decoder.file, decoder)]
}

/// The encoder's tensors; what its outputs are is between the two files.
fn encoder_signature(manifest: &MasksManifest) -> Vec<Wanted<'_>> {
    let (names, side) = (&manifest.encoder, manifest.size as usize);
    let shape = [1, 3, side, side].map(|size| vec![size]).to_vec();
    let outputs = [&names.output].into_iter().chain(&names.features);
    [Wanted::new(Side::Input, &names.input, shape)]
        .into_iter()
        .chain(outputs.map(|name| Wanted::unshaped(Side::Output, name)))
        .collect()
}

/// The decoder's tensors; prompts and points of a prompt are read from the file.
fn decoder_signature(manifest: &MasksManifest) -> Vec<Wanted<'_>> {
    let names = &manifest.decoder;
    let any = Vec::new;
    let lead = match manifest.adapter {
        MaskAdapter::Sam => vec![],
        MaskAdapter::EfficientSam => vec![vec![1]],
    };
    let of = |side, name, tail: &[Vec<usize>]| {
        let prompts = vec![CPU_PROMPTS; lead.len() + tail.len()];
        Wanted::new(side, name, [&lead, tail].concat()).at_most(&prompts)
    };
    let kinds = manifest.levels.iter().max().map_or(0.0, |level| *level as f64);
    let side = f64::from(EFFICIENT_SAM_LOGITS);
    let mut all = vec![
        of(Side::Input, &*names.point_coords, &[any(), any(), vec![2]]),
        of(Side::Input, &names.point_labels, &[any(), any()]),
        of(Side::Output, &names.low_res_masks, &[any(), any(), any(), any()]),
        of(Side::Output, &names.iou_predictions, &[any(), any()]),
        Wanted::new(Side::MayTake, &names.mask_input, vec![any(), any(), any(), any()]),
        Wanted::new(Side::MayTake, &names.has_mask_input, vec![vec![1]]),
        Wanted { whole: None, ..Wanted::new(Side::MayTake, &names.orig_im_size, vec![vec![2]]) }
            .of(Numbers::Within([1.0, side])),
    ];
    all.extend([
        Wanted { whole: Some(true), ..Wanted::new(Side::MayTake, JUDGED_LEVELS, vec![any()]) }
            .at_most(&[manifest.levels.len()])
            .of(Numbers::Within([0.0, kinds])),
        Wanted::new(Side::MayTake, PHOTO_ROWS, vec![any(), any()]),
        Wanted::new(Side::MayTake, PHOTO_COLUMNS, vec![any(), any()]),
        Wanted::new(Side::MayTake, STABILITY_OFFSET, vec![vec![1]]),
        Wanted::new(Side::MayGive, MASK_BITS, vec![any(), any(), any()]),
        Wanted::new(Side::MayGive, MASK_COUNTS, vec![any(), any(), any()]),
    ]);
    let features = [&names.image_embeddings].into_iter().chain(&manifest.encoder.features);
    all.extend(features.map(|name| Wanted::unshaped(Side::Input, name)));
    all
}

/// The encoder's outputs under the decoder's names.
fn embedding(
    manifest: &MasksManifest,
    resized: [u32; 2],
    outputs: &dyn Outputs,
) -> Result<PhotoEmbedding> {
    let main = (&manifest.encoder.output, &manifest.decoder.image_embeddings);
    let features = manifest.encoder.features.iter().map(|name| (name, name));
    let tensor = |(from, to): (&String, &String)| {
        let (shape, data) = outputs.get(from)?;
        Ok((to.clone(), shape, data.into_owned()))
    };
    let tensors = [main].into_iter().chain(features).map(tensor).collect::<Result<_>>()?;
    Ok(PhotoEmbedding { resized, tensors })
}

/// The fixed photo that a provider is held to the CPU with: shapes of several sizes.
fn probe() -> Photo {
    let (width, height) = (320, 240);
    let pixel = |(x, y): (u32, u32)| {
        let (u, v) = (f64::from(x) / 40.0, f64::from(y) / 40.0);
        let disc = if (u - 4.0).hypot(v - 3.0) < 1.6 { 90.0 } else { 0.0 };
        [0.0, 1.3, 2.6].map(|c| {
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0 to 250")]
            let level =
                (80.0 + disc + 40.0 * (u + c).sin() + 40.0 * (3.0 * v * u.cos()).cos()) as u8;
            level
        })
    };
    let rgb = (0..height).flat_map(|y| (0..width).map(move |x| (x, y))).flat_map(pixel).collect();
    Photo { width, height, rgb, valid: None }
}

/// `[width, height]` with the longer side at `side`, rounded as Segment Anything does.
fn longest(photo: &Photo, side: u32) -> [u32; 2] {
    let (w, h) = (f64::from(photo.width), f64::from(photo.height));
    let scale = f64::from(side) / w.max(h);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "at most `side`")]
    [w, h].map(|v| ((v * scale + 0.5) as u32).clamp(1, side))
}
