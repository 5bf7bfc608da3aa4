//! Scenes that a device cannot hold. They stay in host memory; the device has a part of them: the
//! Gaussians of the blocks that the last views showed.
//!
//! A part is in the order of the scene. So its numbers compare as those of the whole scene do, ties
//! at equal depth stay, and a view of the part has every bit of a view of the whole.

use bytemuck::Pod;
use rayon::prelude::*;

use super::{
    buffers::{DeviceLabels, DeviceScene, GaussianRow, SceneCache, merged_row, narrow, row_of},
    device::{Gpu, STORAGE},
};
use crate::{
    Labels, RenderRequest,
    blocks::{Blocks, Frustum},
    budget::brightest,
    cpu::cull::Shown,
    error::{Error, Result},
    scene::Gaussians,
    view::View,
};

/// Bytes of a Gaussian's entry.
const LABEL_BYTES: u64 = 2;
/// Gaussians that are gathered and written at once.
const PIECE: usize = 1 << 17;

/// Bytes of a Gaussian's row and of its harmonics.
fn row_bytes(source: &Gaussians) -> [u64; 2] {
    [size_of::<GaussianRow>() as u64, size_of::<[f32; 3]>() as u64 * source.sh_count() as u64]
}

/// Most Gaussians of a part.
fn gaussians_max(gpu: &Gpu, source: &Gaussians, bytes_max: u64) -> u64 {
    let [row, sh] = row_bytes(source);
    (bytes_max / (row + sh + LABEL_BYTES)).min(gpu.binding_bytes_max / row.max(sh))
}

/// The blocks that the device must have to draw those `shown`, at most `max` Gaussians, where it
/// has those of `part`. `None`: no others.
/// Errors: `limit_exceeded` where those shown are more.
fn needed(
    blocks: &Blocks,
    part: Option<&[u32]>,
    shown: Vec<u32>,
    max: u64,
) -> Result<Option<Vec<u32>>> {
    let count =
        |part: &[u32]| part.iter().map(|&at| blocks.ids(at as usize).len() as u64).sum::<u64>();
    if part.is_some_and(|part| part == shown) {
        return Ok(None);
    }
    if count(&shown) > max {
        let what =
            "render: Gaussians in a row of tiles, by limits.device_scene_bytes_max and adapter";
        return Err(Error::limit(what, count(&shown), max));
    }
    // More Gaussians than are shown do not touch the picture, but a merged one and its members are
    // never both drawn.
    let own = |part: &[u32]| part.last().is_none_or(|&at| (at as usize) < blocks.own);
    let Some(part) = part.filter(|part| own(part) && own(&shown)) else { return Ok(Some(shown)) };
    let mut all = [part, &shown].concat();
    all.sort_unstable();
    all.dedup();
    // What the views before showed stays as long as it fits.
    Ok(match all.len() == part.len() {
        true => None,
        false if count(&all) <= max => Some(all),
        false => Some(shown),
    })
}

impl SceneCache {
    /// The Gaussians that `view` shows, all of `request` or a band of it: the whole scene where the
    /// device may hold it, else a part.
    /// Errors: `limit_exceeded` when they fit neither budget, adapter nor memory.
    pub(super) fn shown(
        &mut self,
        gpu: &Gpu,
        source: &Gaussians,
        request: &RenderRequest,
        view: &View,
    ) -> Result<DeviceScene> {
        let (labelled, detailed) = (request.labels != Labels::None, request.detail > 0.0);
        if !self.pages(gpu, source, detailed) {
            return self.get(gpu, source, labelled, detailed);
        }
        let blocks = self.blocks.get(source, detailed)?;
        let blocks = blocks.ok_or_else(|| Error::internal("a large scene has no blocks"))?;
        let shape = source.shape_identity();
        let held = self.scenes.iter().position(|scene| scene.has_shape(shape));
        let part = held.and_then(|at| self.scenes[at].part.clone());
        let shown = blocks.shown(&Frustum::new(view, request));
        let max = gaussians_max(gpu, source, self.bytes_max);
        let part = needed(&blocks, part.as_deref(), shown, max)?;
        let mut scene = match (part, held.map(|at| self.scenes.remove(at))) {
            (None, Some(scene)) => scene,
            (part, old) => {
                let brightest = old.map_or_else(|| brightest(source), |old| old.brightest);
                gpu.forget();
                let part = part.unwrap_or_default();
                self.uploaded(gpu, || upload(gpu, source, &blocks, &part, brightest))?
            }
        };
        if labelled && !scene.has_labels_of(source) {
            let ids = Shown::ids_of(&blocks, scene.part.as_deref().unwrap_or_default());
            let part = Shown::Some { ids, merged: blocks.merged.clone() };
            let entries = part.entries(source).into_owned();
            scene.labels = Some(DeviceLabels::upload(gpu, source.identity(), entries)?);
        }
        self.scenes.push(scene.clone());
        Ok(scene)
    }

    /// Whether the device has only parts of a scene, with merged Gaussians if it is `detailed`: it
    /// is over the budget or over what the adapter binds.
    pub(super) fn pages(&self, gpu: &Gpu, source: &Gaussians, detailed: bool) -> bool {
        let [row, sh] = row_bytes(source);
        let count = source.len() as u64;
        // Merged ones are about a third more.
        let count = if detailed { count + count / 3 } else { count };
        let over = count * (row + sh) > self.bytes_max;
        source.len() >= self.blocks_from.max(1)
            && (over || count * row.max(sh) > gpu.binding_bytes_max)
    }
}

/// Uploads the Gaussians of these blocks. `brightest` is a bound of the colours of all.
fn upload(
    gpu: &Gpu,
    source: &Gaussians,
    blocks: &Blocks,
    part: &[u32],
    brightest: f32,
) -> Result<DeviceScene> {
    let ids = Shown::ids_of(blocks, part);
    let merged = blocks.merged.as_deref();
    let find = |id: u32| match (merged, (id as usize).checked_sub(source.len())) {
        (Some(merged), Some(at)) => (&merged.gaussians, at),
        _ => (source, id as usize),
    };
    let row = |&id: &u32| match (merged, (id as usize).checked_sub(source.len())) {
        (Some(merged), Some(at)) => merged_row(merged, at),
        _ => row_of(source, id as usize),
    };
    let k = source.sh_count();
    let harmonics = |ids: &[u32]| {
        let mut all = vec![[0.0_f32; 3]; ids.len() * k];
        all.par_chunks_mut(k).zip(ids).for_each(|(to, &id)| {
            let (of, at) = find(id);
            to.copy_from_slice(&of.sh()[at * k..(at + 1) * k]);
        });
        all
    };
    let [row_bytes, sh_bytes] = row_bytes(source).map(|bytes| bytes * ids.len() as u64);
    let rows = ids.chunks(PIECE).map(|ids| ids.par_iter().map(row).collect());
    let count = narrow("gaussians", ids.len())?;
    let rows = fill(gpu, "gaussians", row_bytes, rows)?;
    let sh = fill(gpu, "sh", sh_bytes, ids.chunks(PIECE).map(harmonics))?;
    let mut scene = DeviceScene::without_blocks(source, count, brightest, rows, sh);
    scene.part = Some(part.into());
    Ok(scene)
}

/// A storage buffer of these pieces, one after the other.
fn fill<T: Pod>(
    gpu: &Gpu,
    label: &'static str,
    size_bytes: u64,
    pieces: impl Iterator<Item = Vec<T>>,
) -> Result<wgpu::Buffer> {
    let buffer = gpu.create_buffer(label, size_bytes, STORAGE)?;
    gpu.scoped(label, || {
        let mut to = 0;
        for piece in pieces {
            let bytes: &[u8] = bytemuck::cast_slice(&piece);
            gpu.queue.write_buffer(&buffer, to, bytes);
            gpu.queue.submit([]);
            to += bytes.len() as u64;
        }
    })?;
    Ok(buffer)
}
