//! The mask network: it encodes a photo once, then decodes points of it to masks.
//!
//! The manifest's `adapter` names one of two signatures. The inputs of a file (a batch of prompts
//! or one, a former mask, the photo's size) are read from the file itself.

use ort::{
    session::{Session, SessionInputValue},
    value::{TensorElementType, ValueType},
};

use crate::{
    error::{Error, Result},
    models::{
        Bundle, MaskAdapter, MasksManifest, NetworkOptions, Runtime,
        manifest::unavailable,
        pool::{Pool, fault, fixed, input_shape, output, tensor},
        resize::{planes, resize},
    },
    scene::{MaskLogits, Photo},
};

/// Names of the two files in messages.
const ENCODER: &str = "mask encoder";
const DECODER: &str = "mask decoder";
/// Side of the logits of an `efficient_sam` decoder, before it enlarges them.
const EFFICIENT_SAM_LOGITS: u32 = 256;

/// The network, ready to run from any thread.
#[derive(Debug)]
pub struct MaskNetwork {
    manifest: MasksManifest,
    encoder: Pool,
    decoder: Pool,
    takes: Takes,
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
struct Takes {
    /// Prompts a run.
    batch: usize,
    /// Points of a prompt: the prompt itself, then padding.
    points: usize,
    /// Shape of the former mask, where there is such an input.
    mask: Option<Vec<usize>>,
    has_mask: bool,
    size: Option<TensorElementType>,
}

impl PhotoEmbedding {
    /// `[width, height]` of the part of the encoder's square that the photo fills, pixels.
    #[must_use]
    pub fn resized(&self) -> [u32; 2] {
        self.resized
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
        runtime: &Runtime,
        bundle: &Bundle,
        options: &NetworkOptions,
    ) -> Result<Option<Self>> {
        let Some(manifest) = bundle.masks().cloned() else { return Ok(None) };
        let open = |what, file: &str| -> Result<Pool> {
            Ok(Pool::open(runtime, bundle, options, what, file)?.0)
        };
        let encoder = open(ENCODER, &manifest.encoder.file)?;
        let decoder = open(DECODER, &manifest.decoder.file)?;
        let takes = Takes::of(&decoder.take(), &manifest)?;
        Ok(Some(Self { manifest, encoder, decoder, takes }))
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
        let (m, side) = (&self.manifest, self.manifest.size);
        let resized = match m.adapter {
            MaskAdapter::Sam => longest(photo, side),
            MaskAdapter::EfficientSam => [side, side],
        };
        let [width, height] = resized.map(|v| v as usize);
        let pixels =
            resize(&photo.rgb, [photo.width as usize, photo.height as usize], [width, height]);
        let side = side as usize;
        let image = planes(&pixels, [width, height], side, m.mean, m.std);
        let input = tensor(ENCODER, &[1, 3, side, side], &image)?;
        let mut session = self.encoder.take();
        let inputs = vec![(m.encoder.input.as_str(), input)];
        let outputs = session.run(inputs).map_err(fault(ENCODER, "run"))?;
        let main = (&m.encoder.output, &m.decoder.image_embeddings);
        let names = [main].into_iter().chain(m.encoder.features.iter().map(|name| (name, name)));
        let mut tensors = Vec::new();
        for (from, to) in names {
            let (shape, data) = output(ENCODER, &outputs, from)?;
            tensors.push((to.clone(), shape, data.to_vec()));
        }
        Ok(PhotoEmbedding { resized, tensors })
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
        for batch in points.chunks(self.takes.batch) {
            self.decode_batch(embedding, batch, (points.len(), iou_over), &mut all)?;
        }
        Ok(all)
    }

    fn decode_batch(
        &self,
        embedding: &PhotoEmbedding,
        points: &[[f32; 2]],
        (points_in_all, iou_over): (usize, f32),
        all: &mut MaskLogits,
    ) -> Result<()> {
        let (names, takes) = (&self.manifest.decoder, &self.takes);
        let (count, each) = (points.len(), takes.points);
        let efficient = self.manifest.adapter == MaskAdapter::EfficientSam;
        // EfficientSAM takes points in pixels of the size that its masks come back in.
        let frame = if efficient { [EFFICIENT_SAM_LOGITS; 2] } else { embedding.resized };
        let mut coords = vec![0.0_f32; count * each * 2];
        let mut labels = vec![-1.0_f32; count * each];
        for (i, point) in points.iter().enumerate() {
            for axis in 0..2 {
                coords[i * each * 2 + axis] = point[axis] * frame[axis] as f32;
            }
            labels[i * each] = 1.0;
        }
        let mut inputs: Vec<(&str, SessionInputValue<'_>)> = Vec::new();
        for (name, shape, data) in &embedding.tensors {
            inputs.push((name, tensor(DECODER, shape, data)?));
        }
        let lead: &[usize] = if efficient { &[1] } else { &[] };
        inputs.push((
            &names.point_coords,
            tensor(DECODER, &[lead, &[count, each, 2]].concat(), &coords)?,
        ));
        inputs.push((
            &names.point_labels,
            tensor(DECODER, &[lead, &[count, each]].concat(), &labels)?,
        ));
        let mask = vec![0.0_f32; takes.mask.iter().flatten().product()];
        if let Some(shape) = &takes.mask {
            inputs.push((&names.mask_input, tensor(DECODER, shape, &mask)?));
        }
        if takes.has_mask {
            inputs.push((&names.has_mask_input, tensor(DECODER, &[1], &[0.0_f32])?));
        }
        // SAM's decoder enlarges its masks to this size. Nobody reads these, so it is the smallest.
        let size = if efficient { frame } else { [1, 1] };
        let (floats, ints) = (size.map(|v| v as f32), size.map(i64::from));
        match takes.size {
            Some(TensorElementType::Int64) => {
                inputs.push((&names.orig_im_size, tensor(DECODER, &[2], &ints)?));
            }
            Some(_) => inputs.push((&names.orig_im_size, tensor(DECODER, &[2], &floats)?)),
            None => {}
        }
        let mut session = self.decoder.take();
        let outputs = session.run(inputs).map_err(fault(DECODER, "run"))?;
        let get = |name: &str, tail: usize| -> Result<(Vec<usize>, &[f32])> {
            let (shape, data) = output(DECODER, &outputs, name)?;
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
            all.logits = vec![0.0; points_in_all * levels.len() * cells];
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

impl Takes {
    /// Reads the inputs of the decoder's file.
    fn of(session: &Session, manifest: &MasksManifest) -> Result<Self> {
        let names = &manifest.decoder;
        let wanted = if manifest.adapter == MaskAdapter::EfficientSam { 4 } else { 3 };
        let coords = input_shape(session, &names.point_coords).unwrap_or_default();
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
        let points = fixed(coords[wanted - 2]).unwrap_or(if wanted == 4 { 1 } else { 2 });
        let most = manifest.points_per_batch as usize;
        Ok(Self {
            batch: fixed(coords[wanted - 3]).map_or(most, |batch| batch.min(most)),
            points,
            mask: input_shape(session, &names.mask_input)
                .map(|shape| shape.iter().map(|&n| fixed(n).unwrap_or(1)).collect()),
            has_mask: input_shape(session, &names.has_mask_input).is_some(),
            size: session.inputs().iter().find(|i| i.name() == names.orig_im_size).map(|input| {
                match input.dtype() {
                    ValueType::Tensor { ty, .. } => *ty,
                    _ => TensorElementType::Float32,
                }
            }),
        })
    }
}

/// `[width, height]` with the longer side at `side`, rounded as Segment Anything does.
fn longest(photo: &Photo, side: u32) -> [u32; 2] {
    let (w, h) = (f64::from(photo.width), f64::from(photo.height));
    let scale = f64::from(side) / w.max(h);
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "at most `side`")]
    [w, h].map(|v| ((v * scale + 0.5) as u32).clamp(1, side))
}
