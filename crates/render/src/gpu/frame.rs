//! One submission: it makes room for the Gaussian-tile pairs of a batch of views, draws them and
//! reads their pictures back. A view that does not fit is drawn in bands.

use std::{ops::Range, sync::Arc};

use bytemuck::Pod;
use glam::DVec3;
use rayon::prelude::*;

use super::{
    buffers::{DeviceScene, PlanRow, SourceRow, ViewRow},
    device::Gpu,
    pipelines::{Kernels, NO_PICTURE, RasterKinds},
    profile::Marks,
    readback,
    recorder::Recorder,
    scratch::{BatchBuffers, Need, Scratch, WEIGHT_SLOTS_MIN, first_cell},
};
use crate::{
    Background, DepthSteps, Frame, Labels, RenderRequest, Samples,
    constants::TILE_SIZE,
    error::{Error, Result},
    labels::{BLEND_WIDTH, WeightRows},
    scene::Backdrop,
    view::View,
};

/// Smallest room, in Gaussian-tile pairs.
const ISECT_CAPACITY_MIN: u32 = 1 << 16;
/// How often a band is drawn: the first try may lack room, the second knows what it needs.
pub(super) const ATTEMPTS_MAX: u32 = 3;
/// Factor by which the room for weights grows when it is too small.
const WEIGHT_SLOTS_GROWTH: u32 = 4;
/// Bytes of a tile pair: key and Gaussian, stored twice.
const PAIR_BYTES: u64 = 16;
pub(super) const PLAN_BYTES: u64 = size_of::<PlanRow>() as u64;
/// Pictures of more bytes than this are copied by all cores.
const PARALLEL_BYTES: usize = 4 << 20;

/// Places of a band's pictures in the buffers of its batch: first words, or [`NO_PICTURE`].
pub(super) struct Layout {
    pub(super) color: u32,
    /// In f32. Where it is asked for in steps it is not read back: it lies behind all pictures that
    /// are.
    pub(super) depth: u32,
    pub(super) alpha: u32,
    blend: u32,
    alpha_bytes: u32,
    mask: u32,
    steps: u32,
    /// Words of the pictures that are read back.
    words: u64,
    /// Words of those that are not.
    inner_words: u64,
    /// Pixels of the band.
    pixels: u64,
    /// Room of a pixel, in weights; 0 if none are asked for.
    slots: u32,
    tiles: u32,
}

impl Layout {
    pub(super) fn picture_bytes(&self) -> u64 {
        self.words * 4
    }

    /// Words: one count for each pixel, then an entry and a weight for each slot.
    fn slot_bytes(&self) -> u64 {
        if self.slots == 0 { 0 } else { self.pixels * 4 * (1 + 2 * u64::from(self.slots)) }
    }

    fn all_bytes(&self) -> u64 {
        self.picture_bytes() + self.inner_words * 4 + self.slot_bytes()
    }
}

/// The band of one view after the read-back, with its pictures and slots.
type Part<'a, 'b> = (&'a mut Drawing<'b>, &'a Layout, PlanRow, &'a [u8], &'a [u32]);

/// Result of one view of a submission.
pub(super) struct Ended {
    /// Counts of the device.
    pub(super) plan: PlanRow,
    pub(super) drawn: bool,
    /// New room of a pixel, in weights, if the old one was too small.
    more_slots: Option<u32>,
}

/// Everything that drawing a frame needs.
pub(super) struct Tools<'a> {
    pub(super) gpu: &'a Gpu,
    pub(super) kernels: &'a Kernels,
    pub(super) scratch: &'a mut Scratch,
    pub(super) scene: &'a DeviceScene,
    pub(super) isects_max: u32,
    pub(super) marks: Option<&'a mut Marks>,
}

/// A frame in work. Its bands are drawn from top to bottom.
pub(super) struct Drawing<'a> {
    row: ViewRow,
    request: &'a RenderRequest,
    frame: Frame,
    /// Weights of the bands drawn.
    weights: Vec<WeightRows>,
    /// Most weights of a pixel in them.
    weights_max: u32,
}

impl<'a> Drawing<'a> {
    /// Errors: those of [`View::new`].
    pub(super) fn new(
        origin: DVec3,
        request: &'a RenderRequest,
        scene: &DeviceScene,
    ) -> Result<Self> {
        let view = View::new(origin, request)?;
        let mut row = ViewRow::of(&view, request);
        (row.gaussian_count, row.sh_count) = (scene.count, scene.sh_count);
        // The bands are appended.
        let frame = Frame::blank([view.width, view.height], request, 0);
        Ok(Self { row, request, frame, weights: Vec::new(), weights_max: 0 })
    }

    /// The frame of all bands.
    pub(super) fn finish(mut self, scratch: &mut Scratch) -> Result<Frame> {
        if self.request.labels == Labels::Weights {
            // The next view needs about the same room. One unusual view does not change that.
            scratch.weight_slots = self.weights_max.next_power_of_two().max(WEIGHT_SLOTS_MIN);
            self.frame.weights = Some(WeightRows::join(self.weights)?);
        }
        // Depth in steps came so from the device, unless it was drawn in bands.
        let stepped = self.frame.levels.depth.is_some();
        Ok(if stepped { self.frame } else { self.frame.finish(self.request.samples) })
    }

    /// All rows of tiles.
    pub(super) fn whole(&self) -> Range<u32> {
        0..self.row.tiles_y
    }

    /// Columns and rows of tiles.
    pub(super) fn tiles(&self) -> [u32; 2] {
        [self.row.tiles_x, self.row.tiles_y]
    }

    /// The row of the whole picture, alone in its submission, with room for `capacity` pairs.
    pub(super) fn alone(&self, layout: &Layout, capacity: u32) -> ViewRow {
        let backdrop_start = match self.request.background {
            Background::Backdrop(_) if self.request.kinds.color => first_cell(0),
            _ => NO_PICTURE,
        };
        ViewRow {
            isect_capacity: capacity,
            color_start: layout.color,
            depth_start: layout.depth,
            alpha_start: layout.alpha,
            backdrop_start,
            ..self.row
        }
    }

    pub(super) fn layout(&self, rows: &Range<u32>, slots: u32) -> Layout {
        let pixel_rows = (rows.end * TILE_SIZE).min(self.row.height) - rows.start * TILE_SIZE;
        let pixels = u64::from(pixel_rows) * u64::from(self.row.width);
        let RenderRequest { kinds, labels, samples, .. } = self.request;
        let exact = *samples == Samples::F32;
        let mut words = 0;
        let mut take = |wanted: bool, size: u64| {
            let start = if wanted { words as u32 } else { NO_PICTURE };
            words += if wanted { size } else { 0 };
            start
        };
        // Rows of numbers that share words start at whole ones.
        let packed = |bytes: u32| {
            u64::from(pixel_rows) * (u64::from(self.row.width) * u64::from(bytes)).div_ceil(4)
        };
        // Steps are of one size in all bands.
        let stepped = kinds.depth && !exact && *rows == self.whole();
        let color_words = match samples {
            Samples::F32 => 3 * pixels,
            Samples::Levels => packed(3),
            Samples::LevelsRgba => pixels,
        };
        let color = take(kinds.color, color_words);
        let alpha = take(kinds.alpha && exact, pixels);
        let blend = take(matches!(labels, Labels::Blend(_)), BLEND_WIDTH as u64 * pixels);
        let alpha_bytes = take(kinds.alpha && !exact, packed(1));
        let mask = take(matches!(labels, Labels::Mask { .. }), packed(1));
        let steps = take(stepped, packed(2));
        let depth = take(kinds.depth && !stepped, pixels);
        let depth = if stepped { 0 } else { depth };
        let inner_words = if stepped { pixels } else { 0 };
        let tiles = self.row.tiles_x * (rows.end - rows.start);
        Layout {
            color,
            depth,
            alpha,
            blend,
            alpha_bytes,
            mask,
            steps,
            words,
            inner_words,
            pixels,
            slots,
            tiles,
        }
    }

    /// Rows of the table to blend. An empty table is one row of zeros.
    fn table(&self) -> &[[f32; BLEND_WIDTH]] {
        match self.request.labels.table() {
            Some([]) => &[[0.0; BLEND_WIDTH]],
            Some(table) => &table[..table.len().min(1 << u16::BITS)],
            None => &[],
        }
    }

    /// Copies a band out of the read-back, if there was room for all of it.
    fn take(
        &mut self,
        layout: &Layout,
        plan: PlanRow,
        capacity: u32,
        pictures: &[u8],
        slots: &[u32],
    ) -> Ended {
        let mut ended = Ended { plan, drawn: false, more_slots: None };
        if plan.needed > capacity {
            return ended;
        }
        let counts = &slots[..slots.len().min(layout.pixels as usize)];
        let weights = counts.iter().copied().max().unwrap_or(0);
        if weights > layout.slots {
            ended.more_slots = Some(layout.slots.saturating_mul(WEIGHT_SLOTS_GROWTH));
            return ended;
        }
        self.store(layout, plan.farthest, pictures, slots);
        self.weights_max = self.weights_max.max(weights);
        let stats = &mut self.frame.stats;
        stats.visible = stats.visible.max(u64::from(plan.visible));
        stats.intersections += u64::from(plan.isects);
        Ended { drawn: true, ..ended }
    }

    /// Copies the pictures and weights of a band out of the read-back. `farthest` has the bits of
    /// the largest depth, where depth is in steps.
    fn store(&mut self, layout: &Layout, farthest: u32, pictures: &[u8], slots: &[u32]) {
        let pixels = layout.pixels as usize;
        let width = self.row.width as usize;
        let all = width * self.row.height as usize;
        let part = |start: u32, words: usize| {
            let start = start as usize * 4;
            &pictures[start..start + pixels * words * 4]
        };
        let from = |start: u32| &pictures[start as usize * 4..];
        let rows = pixels / width;
        let Frame { color, depth, alpha, levels, blend, mask, .. } = &mut self.frame;
        if let Some(color) = color {
            append(color, all, part(layout.color, 3), |color| color);
        }
        if let Some(rgb) = &mut levels.rgb {
            append_rows(rgb, all, from(layout.color), [width, rows]);
        }
        if let Some(rgba) = &mut levels.rgba {
            append(rgba, all, part(layout.color, 1), |word: [u8; 4]| word);
        }
        if let Some(alpha) = &mut levels.alpha {
            append_rows(alpha, all, from(layout.alpha_bytes), [width, rows]);
        }
        if let Some(alpha) = alpha {
            append(alpha, all, part(layout.alpha, 1), |alpha| alpha);
        }
        if layout.steps != NO_PICTURE {
            let mut steps = Vec::new();
            append_rows(&mut steps, all, from(layout.steps), [width, rows]);
            levels.depth = Some(DepthSteps { steps, ..DepthSteps::to(f32::from_bits(farthest)) });
            *depth = None;
        } else if let Some(depth) = depth {
            append(depth, all, part(layout.depth, 1), |depth| depth);
        }
        if let Some(blend) = blend {
            append(blend, all, part(layout.blend, BLEND_WIDTH), |row| row);
        }
        if let Some(mask) = mask {
            append_rows(mask, all, from(layout.mask), [width, rows]);
        }
        if layout.slots > 0 {
            self.weights.push(weight_rows(slots, layout, width));
        }
    }
}

impl Tools<'_> {
    /// Draws the tile rows `rows`; halves them while they are over a limit of the adapter.
    pub(super) fn rows(&mut self, drawing: &mut Drawing<'_>, rows: Range<u32>) -> Result<()> {
        let layout = drawing.layout(&rows, self.weight_slots(drawing));
        let single = rows.end - rows.start == 1;
        let bytes = layout.all_bytes();
        let bytes_max = self.gpu.binding_bytes_max - PLAN_BYTES;
        if single || bytes.max((u64::from(layout.tiles) + 1) * 8) <= bytes_max {
            let (mut needed, mut attempts, capacity_max) = (0, 0, self.capacity_max(1));
            while attempts < ATTEMPTS_MAX && needed <= capacity_max {
                let capacity = self.capacity(1);
                let (alone, band) = (std::slice::from_mut(drawing), std::slice::from_ref(&rows));
                let (ended, _) =
                    self.attempt(alone, band, std::slice::from_ref(&layout), capacity)?;
                if ended[0].drawn {
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
            .map(|drawing| drawing.layout(&drawing.whole(), self.weight_slots(drawing)))
            .collect();
        let bytes = layouts.iter().map(Layout::all_bytes).sum::<u64>();
        let views = drawings.len() as u32;
        let capacity = self.capacity(views);
        if bytes + PLAN_BYTES * u64::from(views) > self.gpu.binding_bytes_max {
            return Ok(vec![false; drawings.len()]);
        }
        let bands: Vec<_> = drawings.iter().map(Drawing::whole).collect();
        let (ended, _) = self.attempt(drawings, &bands, &layouts, capacity)?;
        Ok(ended.into_iter().map(|ended| ended.drawn).collect())
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
        bands: &[Range<u32>],
        layouts: &[Layout],
        capacity: u32,
    ) -> Result<(Vec<Ended>, BatchBuffers)> {
        let views = drawings.len() as u32;
        let mut rows = Vec::with_capacity(drawings.len());
        let mut grid = [0; 2];
        let (mut words, mut slot_words, mut tiles, mut step_words) = (0_u64, 0_u64, 0, 0);
        let mut table: Vec<[f32; BLEND_WIDTH]> = Vec::new();
        let mut sources: Vec<SourceRow> = Vec::new();
        let mut backdrops: Vec<Arc<Backdrop>> = Vec::new();
        // Pictures that are not read back come after all others.
        let mut inner = layouts.iter().map(|layout| layout.words).sum::<u64>();
        for (i, ((drawing, band), layout)) in drawings.iter().zip(bands).zip(layouts).enumerate() {
            let after = |start: u32| match start {
                NO_PICTURE => NO_PICTURE,
                start => start + words as u32,
            };
            let backdrop_start = match &drawing.request.background {
                Background::Backdrop(wanted) if drawing.request.kinds.color => {
                    let known = backdrops.iter().position(|one| Arc::ptr_eq(one, wanted));
                    first_cell(known.unwrap_or_else(|| {
                        backdrops.push(Arc::clone(wanted));
                        backdrops.len() - 1
                    }))
                }
                _ => NO_PICTURE,
            };
            rows.push(ViewRow {
                row_start: band.start,
                row_end: band.end,
                isect_capacity: capacity,
                color_start: after(layout.color),
                depth_start: match layout.steps {
                    NO_PICTURE => after(layout.depth),
                    _ => inner as u32,
                },
                alpha_start: after(layout.alpha),
                blend_start: after(layout.blend),
                alpha_byte_start: after(layout.alpha_bytes),
                mask_start: after(layout.mask),
                steps_start: after(layout.steps),
                backdrop_start,
                source_start: sources.len() as u32,
                label_rows: drawing.table().len() as u32,
                table_start: table.len() as u32,
                weight_slots: layout.slots,
                slot_start: slot_words as u32,
                range_start: tiles,
                pair_start: i as u32 * capacity,
                ..drawing.row
            });
            grid = [grid[0].max(drawing.row.tiles_x), grid[1].max(band.end - band.start)];
            words += layout.words;
            inner += layout.inner_words;
            step_words = step_words.max(match layout.steps {
                NO_PICTURE => 0,
                _ => drawing.row.width.div_ceil(2) * drawing.row.height,
            });
            slot_words += layout.slot_bytes() / 4;
            tiles += layout.tiles + 1;
            table.extend_from_slice(drawing.table());
            sources.extend(drawing.request.sources.iter().map(SourceRow::from));
        }
        let plan_bytes = PLAN_BYTES * u64::from(views);
        let (picture_bytes, slot_bytes) = (words * 4, slot_words * 4);
        let staging_bytes = plan_bytes + picture_bytes + slot_bytes;
        let (gpu, scene) = (self.gpu, self.scene);
        // All have the same.
        let kinds = RasterKinds::from(drawings[0].request);
        let shades = kinds.color && !self.kernels.flat(scene.sh_count);
        let room = self.scratch.room(
            gpu,
            &Need {
                views,
                count: scene.count,
                capacity,
                tiles,
                shades,
                source_bytes: size_of_val(sources.as_slice()) as u64,
                picture_bytes: inner * 4,
                table_bytes: size_of_val(table.as_slice()) as u64,
                slot_bytes,
                staging_bytes,
            },
        )?;
        let buffers = scene.buffers();
        let entries = self.scene.labels.as_ref().map(|labels| &labels.entries);
        // Nothing is known to be there while an upload may fail.
        let held = std::mem::take(&mut self.scratch.backdrops);
        let bindings = &mut self.scratch.bindings;
        let (kernels, marks) = (self.kernels, self.marks.as_deref_mut());
        gpu.scoped("render", || {
            room.put_backdrops(gpu, &backdrops, &held);
            gpu.queue.write_buffer(&room.views, 0, bytemuck::cast_slice(&rows));
            if !table.is_empty() {
                gpu.queue.write_buffer(&room.table, 0, bytemuck::cast_slice(&table));
            }
            if !sources.is_empty() {
                gpu.queue.write_buffer(&room.sources, 0, bytemuck::cast_slice(&sources));
            }
            let sizes = (views, scene.count);
            let mut stages =
                Recorder::new(gpu, kernels, bindings, (&room, &room.zeros()), sizes, marks);
            stages.draw(buffers, kinds, entries, grid);
            if step_words > 0 {
                stages.depth_steps(step_words);
            }
            stages.submit(&[
                (&room.plans, 0, &room.staging, 0, plan_bytes),
                (&room.pictures, 0, &room.staging, plan_bytes, picture_bytes),
                (&room.slots, 0, &room.staging, plan_bytes + picture_bytes, slot_bytes),
            ])
        })??;
        backdrops.extend(held.into_iter().skip(backdrops.len()));
        self.scratch.backdrops = backdrops;
        let ended = readback::read(gpu, &room.staging, staging_bytes, |bytes| {
            let (plans, rest) = bytes.split_at(plan_bytes as usize);
            let (mut pictures, slots) = rest.split_at(picture_bytes as usize);
            let mut slots: &[u32] = bytemuck::cast_slice(slots);
            let plans: Vec<PlanRow> = bytemuck::pod_collect_to_vec(plans);
            let mut parts = Vec::with_capacity(plans.len());
            for ((drawing, layout), plan) in drawings.iter_mut().zip(layouts).zip(plans) {
                let (mine, mine_slots);
                (mine, pictures) = pictures.split_at(layout.picture_bytes() as usize);
                (mine_slots, slots) = slots.split_at(layout.slot_bytes() as usize / 4);
                parts.push((drawing, layout, plan, mine, mine_slots));
            }
            let take = |(drawing, layout, plan, mine, mine_slots): Part<'_, '_>| {
                drawing.take(layout, plan, capacity, mine, mine_slots)
            };
            match parts.len() {
                1 => parts.into_iter().map(take).collect(),
                _ => parts.into_par_iter().map(take).collect::<Vec<_>>(),
            }
        })?;
        self.scratch.isects = ended.iter().map(|ended| ended.plan.needed).max().unwrap_or(0);
        let more_slots = ended.iter().filter_map(|ended| ended.more_slots).max();
        self.scratch.weight_slots = more_slots.unwrap_or(self.scratch.weight_slots);
        Ok((ended, room))
    }
}

/// Copies the values that `bytes` hold to the end of `to`, which gets `all` values in the end; many
/// by all cores, for most of the time goes into new pages.
fn append<F: Pod + Send + Sync, T: Send>(
    to: &mut Vec<T>,
    all: usize,
    bytes: &[u8],
    read: impl Fn(F) -> T + Send + Sync,
) {
    let values: &[F] = bytemuck::cast_slice(bytes);
    to.reserve_exact(all - to.len());
    if bytes.len() < PARALLEL_BYTES {
        to.extend(values.iter().map(|value| read(*value)));
    } else {
        let values = values.par_iter().with_min_len(PARALLEL_BYTES / 16);
        to.par_extend(values.map(|value| read(*value)));
    }
}

/// Copies rows of numbers that share words to the end of `to`, as [`append`] does.
fn append_rows<T: Pod + Send + Sync>(
    to: &mut Vec<T>,
    all: usize,
    bytes: &[u8],
    [width, rows]: [usize; 2],
) {
    let stride = (width * size_of::<T>()).next_multiple_of(4);
    if stride == width * size_of::<T>() {
        return append(to, all, &bytes[..stride * rows], |value| value);
    }
    to.reserve_exact(all - to.len());
    for row in bytes.chunks_exact(stride).take(rows) {
        to.extend_from_slice(bytemuck::cast_slice(&row[..width * size_of::<T>()]));
    }
}

/// The weights of a band's pixels, ascending, out of its slots.
fn weight_rows(slots: &[u32], layout: &Layout, width: usize) -> WeightRows {
    let pixels = layout.pixels as usize;
    let mut rows = WeightRows::new(pixels / width, width);
    let mut pixel = Vec::with_capacity(layout.slots as usize);
    for (i, &count) in slots[..pixels].iter().enumerate() {
        let plane = |slot: usize| pixels * (1 + slot) + i;
        pixel.clear();
        pixel.extend((0..count as usize).map(|slot| {
            let weight = f32::from_bits(slots[plane(2 * slot + 1)]);
            (slots[plane(2 * slot)] as u16, weight)
        }));
        pixel.sort_unstable_by_key(|pair| pair.0);
        for &(entry, weight) in &pixel {
            rows.push(i % width, i / width, entry, weight);
        }
    }
    rows
}
