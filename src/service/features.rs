//! What researchers take away as arrays: the bank and the index maps of a scene, and the weights E
//! or the features F of a view.
//!
//! F is written row by row of the picture, so that one row of it is in memory.

use std::{
    io::{self, Write},
    sync::Arc,
};

use rayon::prelude::*;

use super::{
    request::{FeatureKind, FeaturesSpec, PictureKind, ViewSpec},
    schedule::Demand,
    search::{LabelledView, SceneTexts, ScoringChoice},
    shared::Service,
    tags::{cache_key, etag},
    texts::check_scoring,
    types::Export,
    view::{Inputs, Resolved, resolve_one},
    work::Work,
};
use crate::{
    error::{Error, ErrorCode, Result},
    formats::npz::NpzWriter,
    limits::Limits,
    scene::{Bank, PixelWeights, SceneId, Semantics},
};

/// The view that is asked for.
pub(super) fn features_view<'a>(
    limits: &Limits,
    inputs: impl Into<Inputs<'a>>,
    spec: &FeaturesSpec,
) -> Result<Resolved> {
    check_scoring(&spec.scoring, limits)?;
    let options = spec.options.clone();
    resolve_one(limits, inputs, &ViewSpec::new(spec.camera, PictureKind::Semantics, options))
}

/// Refuses features of more bytes than the limit.
pub(super) fn check_size(
    texts: &SceneTexts,
    view: &LabelledView,
    kind: FeatureKind,
    limits: &Limits,
) -> Result<()> {
    let (pixels, dim) = (view.weights.pixels() as u64, texts.scorer.bank().dim as u64);
    let (bytes, max) = (4 * pixels * dim, limits.features_bytes_max);
    if kind == FeatureKind::Features && bytes > max {
        let what = format!("features: {}x{} px of {dim} numbers", view.width, view.height);
        return Err(Error::limit(what, format!("{bytes} bytes"), format!("{max} bytes")));
    }
    Ok(())
}

/// Writes E or F.
pub(super) fn write(
    texts: &SceneTexts,
    view: &LabelledView,
    kind: FeatureKind,
    to: &mut dyn Write,
) -> Result<()> {
    let (width, height) = (view.width as usize, view.height as usize);
    let (weights, bank) = (&view.weights, texts.scorer.bank());
    let write = || -> io::Result<()> {
        let mut npz = NpzWriter::new(to);
        match kind {
            FeatureKind::Weights => {
                npz.array("size", &[2], &[view.height, view.width])?;
                npz.array("offsets", &[weights.offsets.len()], &weights.offsets)?;
                npz.array("entries", &[weights.entries.len()], &weights.entries)?;
                npz.array("weights", &[weights.weights.len()], &weights.weights)?;
            }
            FeatureKind::Features => {
                npz.begin::<f32>("features", &[height, width, bank.dim])?;
                for y in 0..height {
                    npz.extend(&features(bank, weights, y * width, width))?;
                }
            }
        }
        npz.finish()
    };
    write().map_err(unwritten)
}

/// `[count, D]` features of the pixels from `first` on: `E^T B` at length 1; zeros where it has no
/// length.
fn features(bank: &Bank, weights: &PixelWeights, first: usize, count: usize) -> Vec<f32> {
    let mut row = vec![0.0_f32; count * bank.dim];
    let pixels = row.par_chunks_exact_mut(bank.dim.max(1)).enumerate().with_min_len(8);
    pixels.for_each(|(i, feature)| {
        let mut sum = vec![0.0_f64; bank.dim];
        for (m, weight) in weights.pixel(first + i) {
            let Some(m) = usize::from(m).checked_sub(1).filter(|m| *m < bank.len()) else {
                continue;
            };
            let weight = f64::from(weight);
            sum.iter_mut().zip(bank.row(m)).for_each(|(s, v)| *s += weight * f64::from(*v));
        }
        let length = sum.iter().map(|v| v * v).sum::<f64>().sqrt();
        if length > 0.0 {
            feature.iter_mut().zip(sum).for_each(|(to, v)| *to = (v / length) as f32);
        }
    });
    row
}

/// Writes the bank, its masks and all indices of a scene.
pub(super) fn write_semantics(semantics: &Semantics, to: &mut dyn Write) -> Result<()> {
    let bank = &semantics.bank;
    let masks: Vec<[u32; 3]> =
        semantics.masks.iter().map(|m| [m.photo, m.mask, u32::from(m.entry)]).collect();
    let write = || -> io::Result<()> {
        let mut npz = NpzWriter::new(to);
        npz.array("bank", &[bank.len(), bank.dim], &bank.rows)?;
        npz.array("sizes", &[bank.len()], &semantics.row_sizes())?;
        npz.array("masks", &[masks.len(), 3], masks.as_flattened())?;
        npz.array("index", &[semantics.index.len()], &semantics.index)?;
        for (i, map) in semantics.photos.iter().enumerate() {
            let shape = [map.height as usize, map.width as usize];
            npz.array(&format!("photo_{i:03}"), &shape, &map.index)?;
        }
        npz.finish()
    };
    write().map_err(unwritten)
}

fn unwritten(cause: io::Error) -> Error {
    Error::new(ErrorCode::StoreUnavailable, "the arrays cannot be written").caused_by(cause)
}

impl Service {
    /// The pixels of a view over the bank, as an npz file. `weights`: E as `size` (height, width),
    /// `offsets` `[H * W + 1]`, `entries` and `weights`; the entries of pixel i are those from
    /// `offsets[i]` to `offsets[i + 1]`. `features`: F, `[H, W, D]` f32 of length 1, zeros where
    /// nothing is.
    ///
    /// # Errors
    /// As [`Service::query`]; `limit_exceeded` for F of more bytes than
    /// `limits.features_bytes_max`.
    pub async fn features(&self, id: &SceneId, spec: FeaturesSpec) -> Result<Export> {
        let scene = self.scene(id).await?;
        let inner = &self.inner;
        inner.can_understand("features")?;
        let scene = scene.finished()?;
        let view = features_view(&self.limits(), scene.record(), &spec)?;
        let of = inner.semantic_scene(&scene, "features", spec.wait).await?;
        let deadline = inner.deadline(&spec.options);
        let tag = view.labels_key(&of.tag, &inner.backend.renderer.name())?;
        let etag = etag(&cache_key(&(tag, spec.kind, spec.options.preset, &spec.scoring))?);
        let how = ScoringChoice { preset: spec.options.preset, changes: spec.scoring };
        let texts = inner.score_bank(of, how, Vec::new(), deadline).await?;
        let (drawn, limits) = (Arc::clone(&texts), self.limits());
        let demand = Demand::view(&self.caller, view.pixels());
        let draw = move |work: &mut Work| {
            let (weights, _new) = view.weights(&drawn)?;
            work.leave_renderer();
            check_size(&drawn, &weights, spec.kind, &limits)?;
            Ok(weights)
        };
        let weights = inner.scheduled(demand, deadline, "the features", draw).await?;
        let (offsets, entries) = (&weights.weights.offsets, &weights.weights.entries);
        let work_bytes = 4 * offsets.len() as u64 + 6 * entries.len() as u64;
        let write = move |to: &mut dyn Write| write(&texts, &weights, spec.kind, to);
        let export = Export::streamed(etag, write).placed(inner, work_bytes, None);
        Ok(Export { file_name: format!("{id}-view.npz"), ..export })
    }
}
