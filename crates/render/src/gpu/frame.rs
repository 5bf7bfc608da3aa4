//! One submission: it makes room for the Gaussian-tile pairs of a batch of views, draws them and
//! reads their pictures back. A view that does not fit is drawn in bands.

use std::{ops::Range, slice, sync::Arc};

use rayon::prelude::*;

use super::{
    batch_buffers::{BatchBuffers, BatchSizes, BufferCopy, first_cell},
    bindings::Inputs,
    buffers::{DeviceScene, PlanRow, SourceRow, ViewRow},
    device::Gpu,
    drawing::{Drawing, Ended, Layout, ReadBack},
    pipelines::{BLOCK, Kernels, NO_PICTURE, RasterKinds},
    profile::Marks,
    readback,
    recorder::Recorder,
    scratch::Scratch,
};
use crate::{
    Background, Labels, RenderRequest,
    error::{Error, Result},
    labels::BLEND_WIDTH,
    scene::Backdrop,
};

/// Smallest room, in Gaussian-tile pairs.
const ISECT_CAPACITY_MIN: u32 = 1 << 16;
/// How often a band is drawn: the first try may lack room, the second knows what it needs.
pub(super) const ATTEMPTS_MAX: u32 = 3;
/// Bytes of a tile pair: key and Gaussian, stored twice.
const PAIR_BYTES: u64 = 16;
pub(super) const PLAN_BYTES: u64 = size_of::<PlanRow>() as u64;

/// Everything that drawing a frame needs.
pub(super) struct Tools<'a> {
    pub(super) gpu: &'a Gpu,
    pub(super) kernels: &'a Kernels,
    pub(super) scratch: &'a mut Scratch,
    pub(super) scene: &'a DeviceScene,
    pub(super) isects_max: u32,
    pub(super) marks: Option<&'a mut Marks>,
}

/// The views of a submission: what the device must know of them, and what they need together.
pub(super) struct Batch {
    rows: Vec<ViewRow>,
    /// Columns and rows of tiles of the largest view.
    grid: [u32; 2],
    /// Tiles of all views, and one more for each.
    tiles: u32,
    /// Tile pairs that each view has room for.
    capacity: u32,
    table: Vec<[f32; BLEND_WIDTH]>,
    sources: Vec<SourceRow>,
    backdrops: Vec<Arc<Backdrop>>,
    /// Words of the pictures that are read back.
    words: u64,
    /// The same and those that are not, which come after all others.
    all_words: u64,
    slot_words: u64,
    /// Words of the largest picture in steps.
    step_words: u32,
}

impl Batch {
    /// The bands of the views that `layouts` are for.
    pub(super) fn new(drawings: &[Drawing<'_>], layouts: &[Layout], capacity: u32) -> Self {
        let mut batch = Self {
            rows: Vec::with_capacity(drawings.len()),
            grid: [0; 2],
            tiles: 0,
            capacity,
            table: Vec::new(),
            sources: Vec::new(),
            backdrops: Vec::new(),
            words: 0,
            all_words: layouts.iter().map(|layout| layout.words).sum(),
            slot_words: 0,
            step_words: 0,
        };
        drawings.iter().zip(layouts).for_each(|(drawing, layout)| batch.add(drawing, layout));
        batch
    }

    fn add(&mut self, drawing: &Drawing<'_>, layout: &Layout) {
        let (row, words) = (&drawing.row, self.words as u32);
        let after = |start: u32| if start == NO_PICTURE { start } else { start + words };
        let stepped = layout.steps != NO_PICTURE;
        let backdrop_start = self.backdrop_start(drawing.request);
        self.rows.push(ViewRow {
            row_start: layout.rows.start,
            row_end: layout.rows.end,
            isect_capacity: self.capacity,
            color_start: after(layout.color),
            depth_start: if stepped { self.all_words as u32 } else { after(layout.depth) },
            alpha_start: after(layout.alpha),
            blend_start: after(layout.blend),
            alpha_byte_start: after(layout.alpha_bytes),
            mask_start: after(layout.mask),
            steps_start: after(layout.steps),
            backdrop_start,
            source_start: self.sources.len() as u32,
            label_rows: drawing.table().len() as u32,
            table_start: self.table.len() as u32,
            weight_slots: layout.slots,
            slot_start: self.slot_words as u32,
            range_start: self.tiles,
            pair_start: self.rows.len() as u32 * self.capacity,
            ..*row
        });
        let [columns, rows] = self.grid;
        self.grid = [columns.max(row.tiles_x), rows.max(layout.rows.len() as u32)];
        self.words += layout.words;
        self.all_words += layout.inner_words;
        if stepped {
            self.step_words = self.step_words.max(row.width.div_ceil(2) * row.height);
        }
        self.slot_words += layout.slot_bytes() / 4;
        self.tiles += layout.tiles + 1;
        self.table.extend_from_slice(drawing.table());
        self.sources.extend(drawing.request.sources.iter().map(SourceRow::from));
    }

    /// First cell of the backdrop of a request. Views of one backdrop share it.
    fn backdrop_start(&mut self, request: &RenderRequest) -> u32 {
        let Background::Backdrop(wanted) = &request.background else { return NO_PICTURE };
        if !request.kinds.color {
            return NO_PICTURE;
        }
        let known = self.backdrops.iter().position(|one| Arc::ptr_eq(one, wanted));
        first_cell(known.unwrap_or_else(|| {
            self.backdrops.push(Arc::clone(wanted));
            self.backdrops.len() - 1
        }))
    }

    /// Bytes that are read back: plans, pictures and slots.
    fn read_bytes(&self) -> [u64; 3] {
        [PLAN_BYTES * self.rows.len() as u64, self.words * 4, self.slot_words * 4]
    }

    /// What the buffers must hold for this scene.
    pub(super) fn sizes(&self, scene: &DeviceScene, shades: bool) -> BatchSizes {
        BatchSizes {
            views: self.rows.len() as u32,
            count: scene.count,
            rows: scene.block_count() * BLOCK,
            capacity: self.capacity,
            tiles: self.tiles,
            shades,
            source_bytes: size_of_val(self.sources.as_slice()) as u64,
            picture_bytes: self.all_words * 4,
            table_bytes: size_of_val(self.table.as_slice()) as u64,
            slot_bytes: self.slot_words * 4,
            staging_bytes: self.read_bytes().iter().sum(),
        }
    }

    /// Writes it into `room`, which holds the backdrops `held`.
    pub(super) fn write(&self, gpu: &Gpu, room: &BatchBuffers, held: &[Arc<Backdrop>]) {
        room.put_backdrops(gpu, &self.backdrops, held);
        gpu.queue.write_buffer(&room.views, 0, bytemuck::cast_slice(&self.rows));
        if !self.table.is_empty() {
            gpu.queue.write_buffer(&room.table, 0, bytemuck::cast_slice(&self.table));
        }
        if !self.sources.is_empty() {
            gpu.queue.write_buffer(&room.sources, 0, bytemuck::cast_slice(&self.sources));
        }
    }

    /// The backdrops that the device has after this, where it had those `held`.
    pub(super) fn held_after(mut self, held: Vec<Arc<Backdrop>>) -> Vec<Arc<Backdrop>> {
        let written = self.backdrops.len();
        self.backdrops.extend(held.into_iter().skip(written));
        self.backdrops
    }
}

impl Tools<'_> {
    /// Draws the tile rows `rows`; halves them while they are over a limit of the adapter.
    pub(super) fn rows(&mut self, drawing: &mut Drawing<'_>, rows: Range<u32>) -> Result<()> {
        let layout = drawing.layout(rows.clone(), self.weight_slots(drawing));
        let single = rows.end - rows.start == 1;
        let bytes = layout.all_bytes();
        let bytes_max = self.gpu.binding_bytes_max - PLAN_BYTES;
        if single || bytes.max((u64::from(layout.tiles) + 1) * 8) <= bytes_max {
            let (mut needed, mut attempts, capacity_max) = (0, 0, self.capacity_max(1));
            while attempts < ATTEMPTS_MAX && needed <= capacity_max {
                let capacity = self.capacity(1);
                let (alone, layouts) = (slice::from_mut(drawing), slice::from_ref(&layout));
                let (ended, _) = self.attempt(alone, layouts, capacity)?;
                if ended[0].complete {
                    return Ok(());
                }
                needed = ended[0].plan.needed;
                if needed <= capacity {
                    // Slots grew. The next try checks again whether the band fits.
                    return self.rows(drawing, rows);
                }
                attempts += 1;
            }
            if single {
                let what = "render: Gaussian-tile pairs in one row of tiles";
                return Err(Error::limit(what, needed, capacity_max));
            }
        }
        let middle = rows.start.midpoint(rows.end);
        self.rows(drawing, rows.start..middle)?;
        self.rows(drawing, middle..rows.end)
    }

    /// Draws whole views in one submission, with the same pixels as alone. Returns which of them
    /// were drawn. The others need more room, or do not fit together.
    pub(super) fn together(&mut self, drawings: &mut [Drawing<'_>]) -> Result<Vec<bool>> {
        let layouts: Vec<_> = drawings
            .iter()
            .map(|drawing| drawing.layout(drawing.whole(), self.weight_slots(drawing)))
            .collect();
        let bytes = layouts.iter().map(Layout::all_bytes).sum::<u64>();
        let views = drawings.len() as u32;
        let capacity = self.capacity(views);
        if bytes + PLAN_BYTES * u64::from(views) > self.gpu.binding_bytes_max {
            return Ok(vec![false; drawings.len()]);
        }
        let (ended, _) = self.attempt(drawings, &layouts, capacity)?;
        Ok(ended.into_iter().map(|ended| ended.complete).collect())
    }

    /// Room of a pixel, in weights: what the last views needed, at most one for each entry.
    fn weight_slots(&self, drawing: &Drawing<'_>) -> u32 {
        match (&drawing.request.labels, &self.scene.labels) {
            (Labels::Weights, Some(labels)) => {
                self.scratch.weight_slots.min(labels.distinct.max(1))
            }
            _ => 0,
        }
    }

    pub(super) fn capacity_max(&self, views: u32) -> u32 {
        let bound = self.gpu.binding_bytes_max / (PAIR_BYTES * u64::from(views));
        self.isects_max.min(u32::try_from(bound).unwrap_or(u32::MAX))
    }

    /// Room of each of `views` views, in tile pairs.
    pub(super) fn capacity(&self, views: u32) -> u32 {
        let guess = self.scene.count.saturating_mul(4).max(ISECT_CAPACITY_MIN);
        // A quarter more than the last view needed.
        let seen = self.scratch.isects.saturating_add(self.scratch.isects / 4);
        guess.max(seen).min(self.capacity_max(views))
    }

    /// Runs all stages over one band of each view, with room for `capacity` pairs in each. Also the
    /// buffers, in which everything is left.
    pub(super) fn attempt(
        &mut self,
        drawings: &mut [Drawing<'_>],
        layouts: &[Layout],
        capacity: u32,
    ) -> Result<(Vec<Ended>, BatchBuffers)> {
        let batch = Batch::new(drawings, layouts, capacity);
        // All have the same.
        let kinds = RasterKinds::from(drawings[0].request);
        let shades = kinds.color && !self.kernels.flat(self.scene.sh_count);
        let room = self.scratch.room(self.gpu, &batch.sizes(self.scene, shades))?;
        let parts = batch.read_bytes();
        self.submit(&room, batch, kinds)?;
        let ended = readback::read(self.gpu, &room.staging, parts.iter().sum(), |bytes| {
            take_all(drawings, layouts, capacity, bytes, parts)
        })?;
        self.scratch.isects = ended.iter().map(|ended| ended.plan.needed).max().unwrap_or(0);
        let more_slots = ended.iter().filter_map(|ended| ended.more_slots).max();
        self.scratch.weight_slots = more_slots.unwrap_or(self.scratch.weight_slots);
        Ok((ended, room))
    }

    /// Writes the batch, runs its stages, and copies what is read back.
    fn submit(&mut self, room: &BatchBuffers, batch: Batch, kinds: RasterKinds) -> Result<()> {
        // Nothing is known to be there while an upload may fail.
        let held = std::mem::take(&mut self.scratch.backdrops);
        let gpu = self.gpu;
        let inputs = Inputs::new(self.kernels, room, Some(self.scene), batch.rows.len() as u32);
        let [plan_bytes, picture_bytes, slot_bytes] = batch.read_bytes();
        let copy = |from, at, bytes| BufferCopy { from: (from, 0), to: (&room.staging, at), bytes };
        gpu.scoped("render", || {
            batch.write(gpu, room, &held);
            let mut stages = self.recorder(inputs, &room.zeros());
            stages.draw(kinds, batch.grid);
            if batch.step_words > 0 {
                stages.depth_steps(batch.step_words);
            }
            stages.submit(&[
                copy(&room.plans, 0, plan_bytes),
                copy(&room.pictures, plan_bytes, picture_bytes),
                copy(&room.slots, plan_bytes + picture_bytes, slot_bytes),
            ])
        })??;
        self.scratch.backdrops = batch.held_after(held);
        Ok(())
    }

    /// Starts a submission. Sets the buffers `cleared` to zeros.
    pub(super) fn recorder<'b>(
        &'b mut self,
        inputs: Inputs<'b>,
        cleared: &[&wgpu::Buffer],
    ) -> Recorder<'b> {
        let (bindings, marks) = (&mut self.scratch.bindings, self.marks.as_deref_mut());
        Recorder::new(self.gpu, self.kernels, bindings, inputs, cleared, marks)
    }
}

/// Hands each view its part of what was read back: plans, pictures and slots of so many bytes.
fn take_all(
    drawings: &mut [Drawing<'_>],
    layouts: &[Layout],
    capacity: u32,
    bytes: &[u8],
    [plan_bytes, picture_bytes, _]: [u64; 3],
) -> Vec<Ended> {
    let (plans, rest) = bytes.split_at(plan_bytes as usize);
    let (mut all_pictures, all_slots) = rest.split_at(picture_bytes as usize);
    let mut all_slots: &[u32] = bytemuck::cast_slice(all_slots);
    let plans: Vec<PlanRow> = bytemuck::pod_collect_to_vec(plans);
    let mut parts = Vec::with_capacity(plans.len());
    for ((drawing, layout), plan) in drawings.iter_mut().zip(layouts).zip(plans) {
        let (pictures, slots);
        (pictures, all_pictures) = all_pictures.split_at(layout.picture_bytes() as usize);
        (slots, all_slots) = all_slots.split_at(layout.slot_bytes() as usize / 4);
        parts.push((drawing, layout, ReadBack { plan, pictures, slots }));
    }
    let take = |(drawing, layout, read): (&mut Drawing<'_>, &Layout, ReadBack<'_>)| {
        drawing.take(layout, capacity, &read)
    };
    match parts.len() {
        1 => parts.into_iter().map(take).collect(),
        _ => parts.into_par_iter().map(take).collect(),
    }
}
