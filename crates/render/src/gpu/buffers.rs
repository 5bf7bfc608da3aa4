//! Data that host and shaders share: `repr(C)` structs equal to those of
//! shaders/common/structs.wgsl, and the scenes on the device.
#![allow(missing_docs, reason = "shaders/common/structs.wgsl describes the fields")]

use std::sync::Arc;

use bytemuck::{Pod, Zeroable};
use rayon::prelude::*;

use super::{
    device::Gpu,
    pipelines::{GRADIENT_WORDS, LEVELS_RGB, LEVELS_RGBA, NO_PICTURE},
};
use crate::{
    Background, Labels, RenderRequest, Samples, Source,
    blocks::{BlockCache, Blocks, Bounds, Frustum},
    budget::{Budget, RayEnd, brightest},
    constants::{HALF_LEVEL, OWN_SIZE, TRANSMITTANCE_MIN},
    error::{Error, ErrorCode, Result},
    merged::Merged,
    scene::Gaussians,
    view::View,
};

/// `View` of the shaders: camera of one frame and the band of tile rows to draw.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct ViewRow {
    pub rotation_x: [f32; 4],
    pub rotation_y: [f32; 4],
    pub rotation_z: [f32; 4],
    pub rotation_z_low: [f32; 4],
    pub center: [f32; 4],
    pub center_low: [f32; 4],
    pub background: [f32; 4],
    pub ray_end: [f32; 4],
    pub focal: [f32; 2],
    pub principal: [f32; 2],
    pub slope_min: [f32; 2],
    pub slope_max: [f32; 2],
    pub near: f32,
    pub width: u32,
    pub height: u32,
    pub tiles_x: u32,
    pub tiles_y: u32,
    pub row_start: u32,
    pub row_end: u32,
    pub gaussian_count: u32,
    pub sh_count: u32,
    pub antialiased: u32,
    pub isect_capacity: u32,
    pub zero: u32,
    pub color_start: u32,
    pub depth_start: u32,
    pub alpha_start: u32,
    pub blend_start: u32,
    pub label_rows: u32,
    pub table_start: u32,
    pub weight_slots: u32,
    pub slot_start: u32,
    pub range_start: u32,
    pub pair_start: u32,
    pub levels: u32,
    pub alpha_byte_start: u32,
    pub mask_start: u32,
    pub steps_start: u32,
    pub backdrop_start: u32,
    pub room_min: f32,
    pub coverage_floor: f32,
    pub own_focal: f32,
    pub source_count: u32,
    pub source_start: u32,
    pub ray_first: [f32; 4],
    pub ray_across: [f32; 4],
    pub ray_down: [f32; 4],
    pub sides: [[f32; 4]; 4],
    pub photos: [f32; 4],
    pub photos_widen: f32,
    pub block_count: u32,
    pub detail: f32,
    pub rest: u32,
}

/// `Source` of the shaders.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct SourceRow {
    pub center: [f32; 3],
    pub scale: f32,
    pub axis: [f32; 3],
    pub layer: u32,
}

impl From<&Source> for SourceRow {
    fn from(source: &Source) -> Self {
        let Source { center, axis, scale, layer } = *source;
        Self { center, scale, axis, layer: layer as u32 }
    }
}

/// `Block` of the shaders.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct BlockRow {
    pub center: [f32; 3],
    pub reach: f32,
    pub half: [f32; 3],
    pub error: f32,
    pub parent: u32,
    pub rest: [u32; 3],
}

impl From<&Bounds> for BlockRow {
    fn from(bounds: &Bounds) -> Self {
        let Bounds { center, half, reach, error, parent } = *bounds;
        Self { center, reach, half, error, parent, rest: [0; 3] }
    }
}

/// `Gaussian` of the shaders.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct GaussianRow {
    pub mean: [f32; 3],
    pub opacity: f32,
    pub quat: [f32; 4],
    pub scale: [f32; 3],
    pub source: u32,
}

/// `Footprint` of the shaders.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Pod, Zeroable)]
pub struct FootprintRow {
    pub mean: [f32; 2],
    pub conic_shear: f32,
    pub conic_x: f32,
    pub conic_y: f32,
    pub power_max: f32,
    pub opacity: f32,
    pub depth: f32,
}

/// `Plan` of the shaders. Zeros before the first stage.
#[repr(C)]
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Pod, Zeroable)]
pub struct PlanRow {
    pub isects: u32,
    pub needed: u32,
    pub visible: u32,
    pub farthest: u32,
    pub rows: u32,
}

/// `Training` of the shaders: a step of training.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub struct TrainingRow {
    pub means: f32,
    pub quats: f32,
    pub scales: f32,
    pub opacities: f32,
    pub sh: f32,
    pub sh_rest: f32,
    pub exposure: f32,
    pub opacity_min: f32,
    pub ssim_share: f32,
    pub photo: u32,
    pub photo_start: u32,
    pub blames: u32,
}

/// What `project_backward` writes of each Gaussian: [`GRADIENT_WORDS`] numbers.
#[repr(C)]
#[derive(Clone, Copy, Debug, Pod, Zeroable)]
pub(super) struct GradientRow {
    pub(super) mean: [f32; 3],
    pub(super) opacity: f32,
    pub(super) quat: [f32; 4],
    pub(super) scale: [f32; 3],
    pub(super) seen: f32,
}

const _: () = assert!(size_of::<GradientRow>() == 4 * GRADIENT_WORDS as usize, "its words");
const _: () = assert!(size_of::<ViewRow>().is_multiple_of(16), "a uniform block");
const _: () = assert!(size_of::<TrainingRow>().is_multiple_of(16), "a uniform block");
const _: () = assert!(size_of::<GaussianRow>() == 48, "three rows of four");
const _: () = assert!(size_of::<FootprintRow>() == 32, "two rows of four");

impl ViewRow {
    /// The row of the whole picture. The caller sets band, capacity and picture starts.
    pub fn new(view: &View, background: [f32; 3], antialiased: bool) -> Self {
        let rotation = view.rotation;
        let (rx, ry, rz) = (rotation.row(0), rotation.row(1), rotation.row(2));
        let high = |v: glam::DVec3| v.as_vec3();
        let low = |v: glam::DVec3| (v - v.as_vec3().as_dvec3()).as_vec3();
        let row = |v: glam::Vec3| [v.x, v.y, v.z, 0.0];
        let narrow = |v: [f64; 2]| v.map(|value| value as f32);
        Self {
            rotation_x: row(high(rx)),
            rotation_y: row(high(ry)),
            rotation_z: row(high(rz)),
            rotation_z_low: row(low(rz)),
            center: row(high(view.center)),
            center_low: row(low(view.center)),
            background: [background[0], background[1], background[2], 0.0],
            ray_end: [TRANSMITTANCE_MIN, 0.0, 0.0, 0.0],
            focal: narrow(view.focal),
            principal: narrow(view.principal),
            slope_min: narrow(view.slope_min),
            slope_max: narrow(view.slope_max),
            near: view.near as f32,
            width: view.width,
            height: view.height,
            tiles_x: view.tiles_x(),
            tiles_y: view.tiles_y(),
            row_start: 0,
            row_end: view.tiles_y(),
            antialiased: u32::from(antialiased),
            color_start: NO_PICTURE,
            depth_start: NO_PICTURE,
            alpha_start: NO_PICTURE,
            blend_start: NO_PICTURE,
            alpha_byte_start: NO_PICTURE,
            mask_start: NO_PICTURE,
            steps_start: NO_PICTURE,
            backdrop_start: NO_PICTURE,
            ..Self::zeroed()
        }
    }

    /// The row of a request, of which `view` is the camera. The caller sets also where the view's
    /// photos, its table and its backdrop start. Colours are at most `brightest`.
    pub fn of(view: &View, request: &RenderRequest, brightest: f32) -> Self {
        let background = match &request.background {
            Background::Color(color) => *color,
            Background::Backdrop(_) => [0.0; 3],
        };
        let exact = request.samples == Samples::F32;
        let frustum = Frustum::new(view, request);
        let wide = |(v, w): (glam::DVec3, f64)| v.extend(w).as_vec4().to_array();
        let ray_end = RayEnd::new(Budget::of(request).rays, request, brightest);
        let [first, across, down] = view.rays().map(|[x, y, z]| [x, y, z, 0.0]);
        Self {
            levels: match request.samples {
                Samples::F32 => 0,
                Samples::Levels => LEVELS_RGB,
                Samples::LevelsRgba => LEVELS_RGBA,
            },
            room_min: if exact { f32::MIN_POSITIVE } else { HALF_LEVEL },
            coverage_floor: match request.labels {
                Labels::Mask { coverage_floor, .. } => coverage_floor,
                _ => 0.0,
            },
            own_focal: (view.focal[0].max(view.focal[1]) / f64::from(OWN_SIZE)) as f32,
            source_count: request.sources.len() as u32,
            ray_end: [ray_end.transmittance, ray_end.behind, 0.0, 0.0],
            ray_first: first,
            ray_across: across,
            ray_down: down,
            sides: frustum.sides.map(wide),
            photos: wide(frustum.photos),
            photos_widen: frustum.widens as f32,
            detail: frustum.detail as f32,
            ..Self::new(view, background, request.antialiased)
        }
    }
}

/// Gaussians on the device.
#[derive(Clone, Debug)]
pub(super) struct DeviceScene {
    shape: u64,
    /// Number of Gaussians, with the merged ones.
    pub(super) count: u32,
    /// Spherical harmonics of each Gaussian.
    pub(super) sh_count: u32,
    /// A bound of their colours.
    pub(super) brightest: f32,
    /// `[N]` of [`GaussianRow`].
    pub(super) gaussians: wgpu::Buffer,
    /// `[N, K, 3]` f32.
    pub(super) sh: wgpu::Buffer,
    pub(super) blocks: Option<DeviceBlocks>,
    /// Uploaded when a request first permits them.
    merged: Option<Arc<Merged>>,
    /// Uploaded when a request first asks for labels.
    pub(super) labels: Option<DeviceLabels>,
    /// The blocks of the scene that it has, ascending, where it has not all.
    pub(super) part: Option<Arc<[u32]>>,
}

/// The blocks of a scene on the device.
#[derive(Clone, Debug)]
pub(super) struct DeviceBlocks {
    count: u32,
    /// Of [`BlockRow`].
    pub(super) bounds: wgpu::Buffer,
    /// Gaussians, block after block.
    pub(super) order: wgpu::Buffer,
}

impl DeviceBlocks {
    fn upload(gpu: &Gpu, blocks: &Blocks) -> Result<Self> {
        let rows: Vec<BlockRow> = blocks.bounds.iter().map(BlockRow::from).collect();
        Ok(Self {
            count: rows.len() as u32,
            bounds: gpu.upload("blocks", &[bytemuck::cast_slice(&rows)], None)?,
            order: gpu.upload("order of blocks", &[bytemuck::cast_slice(&blocks.order)], None)?,
        })
    }
}

/// Entries of the Gaussians on the device.
#[derive(Clone, Debug)]
pub(super) struct DeviceLabels {
    identity: u64,
    /// `[N]` u16, two in a word.
    pub(super) entries: wgpu::Buffer,
    /// Number of different entries over 0: no pixel shows more.
    pub(super) distinct: u32,
}

impl DeviceLabels {
    /// Uploads entries of Gaussians of the scene of that [`Gaussians::identity`].
    pub(super) fn upload(gpu: &Gpu, identity: u64, mut entries: Vec<u16>) -> Result<Self> {
        let mut seen = vec![false; 1 << u16::BITS];
        entries.iter().for_each(|&entry| seen[usize::from(entry)] = true);
        let distinct = seen[1..].iter().filter(|seen| **seen).count() as u32;
        // Uploads are whole words.
        entries.resize(entries.len().next_multiple_of(2), 0);
        let entries = gpu.upload("bank entries", &[bytemuck::cast_slice(&entries)], None)?;
        Ok(Self { identity, entries, distinct })
    }
}

impl DeviceScene {
    /// Whether these are the Gaussians of that shape.
    pub(super) fn has_shape(&self, shape: u64) -> bool {
        self.shape == shape
    }

    /// Whether its entries are those of `source`.
    pub(super) fn has_labels_of(&self, source: &Gaussians) -> bool {
        self.labels.as_ref().is_some_and(|labels| labels.identity == source.identity())
    }

    fn size_bytes(&self) -> u64 {
        let labels = self.labels.as_ref().map_or(0, |labels| labels.entries.size());
        let blocks = self.blocks.as_ref().map_or(0, |blocks| blocks.order.size());
        self.gaussians.size() + self.sh.size() + labels + blocks
    }

    /// Whether it has all Gaussians; if `detailed`, with merged ones where it has blocks.
    fn is_whole(&self, detailed: bool) -> bool {
        self.part.is_none() && (!detailed || self.blocks.is_none() || self.merged.is_some())
    }

    /// Number of its blocks; 0 if it has none.
    pub(super) fn block_count(&self) -> u32 {
        self.blocks.as_ref().map_or(0, |blocks| blocks.count)
    }

    /// Uploads `source` for views, with blocks if it has `blocks_from` Gaussians or more; with
    /// merged ones too if it is to be `detailed`.
    /// Errors: as [`Self::upload`].
    pub(super) fn for_views(
        gpu: &Gpu,
        source: &Gaussians,
        blocks_from: usize,
        detailed: bool,
    ) -> Result<Self> {
        if source.len() < blocks_from {
            return Self::upload(gpu, source, None);
        }
        let blocks = if detailed { Blocks::detailed(source)? } else { Blocks::of(source) };
        let merged = blocks.merged.as_deref();
        let mut rows = rows_of(source);
        if let Some(merged) = merged {
            rows.extend((0..merged.sums.len()).map(|i| merged_row(merged, i)));
        }
        let more = merged.map_or(&[][..], |merged| merged.gaussians.sh());
        let mut scene = Self::of_rows(gpu, source, &rows, &[source.sh(), more], None)?;
        scene.blocks = Some(DeviceBlocks::upload(gpu, &blocks)?);
        scene.merged = blocks.merged;
        Ok(scene)
    }

    /// Uploads `source` without blocks, into the buffers of `old` where they have room.
    /// Errors: `limit_exceeded` when it does not fit the adapter's limits or memory.
    pub(super) fn upload(gpu: &Gpu, source: &Gaussians, old: Option<Self>) -> Result<Self> {
        Self::of_rows(gpu, source, &rows_of(source), &[source.sh()], old)
    }

    /// Uploads `source` with so many places, those behind its Gaussians with opacity 0.
    /// Errors: as [`Self::upload`].
    pub(super) fn with_places(gpu: &Gpu, source: &Gaussians, places: usize) -> Result<Self> {
        let mut rows = rows_of(source);
        rows.resize(places, GaussianRow::zeroed());
        let more = vec![[0.0; 3]; (places - source.len()) * source.sh_count()];
        Self::of_rows(gpu, source, &rows, &[source.sh(), &more], None)
    }

    /// Uploads these rows and harmonics, in parts, of `source`, without blocks.
    fn of_rows(
        gpu: &Gpu,
        source: &Gaussians,
        rows: &[GaussianRow],
        sh: &[&[[f32; 3]]],
        old: Option<Self>,
    ) -> Result<Self> {
        let (old_gaussians, old_sh) = old.map(|old| (old.gaussians, old.sh)).unzip();
        let sh: Vec<&[u8]> = sh.iter().map(|part| bytemuck::cast_slice(part)).collect();
        Ok(Self::without_blocks(
            source,
            narrow("gaussians", rows.len())?,
            brightest(source),
            gpu.upload("gaussians", &[bytemuck::cast_slice(rows)], old_gaussians)?,
            gpu.upload("sh", &sh, old_sh)?,
        ))
    }

    /// `count` Gaussians of `source`, whose colours are at most `brightest`, in these buffers.
    pub(super) fn without_blocks(
        source: &Gaussians,
        count: u32,
        brightest: f32,
        gaussians: wgpu::Buffer,
        sh: wgpu::Buffer,
    ) -> Self {
        Self {
            shape: source.shape_identity(),
            count,
            sh_count: source.sh_count() as u32,
            brightest,
            gaussians,
            sh,
            blocks: None,
            merged: None,
            labels: None,
            part: None,
        }
    }
}

/// Gaussians as the shaders read them.
fn rows_of(source: &Gaussians) -> Vec<GaussianRow> {
    let all = (0..source.len()).into_par_iter().with_min_len(1 << 14);
    all.map(|i| row_of(source, i)).collect()
}

/// Gaussian `i` as the shaders read it.
pub(super) fn row_of(source: &Gaussians, i: usize) -> GaussianRow {
    GaussianRow {
        mean: source.means()[i],
        opacity: source.opacities()[i],
        quat: source.quats()[i],
        scale: source.scales()[i],
        source: source.source()[i].view.into(),
    }
}

/// Merged Gaussian `i` as the shaders read it: the upper half of `source` is that of the sum.
pub(super) fn merged_row(merged: &Merged, i: usize) -> GaussianRow {
    let row = row_of(&merged.gaussians, i);
    GaussianRow { source: row.source | merged.sums[i].to_bits(), ..row }
}

/// Scenes on the device, the most recently drawn last.
#[derive(Debug)]
pub(super) struct SceneCache {
    pub(super) scenes: Vec<DeviceScene>,
    /// Bytes of the scenes, of which one may be larger: then the device has a part of it.
    pub(super) bytes_max: u64,
    pub(super) blocks_from: usize,
    /// Blocks of the scenes that it has parts of.
    pub(super) blocks: BlockCache,
}

impl SceneCache {
    /// For `bytes_max` bytes of scenes, with blocks from so many Gaussians on.
    pub(super) fn new(bytes_max: u64, blocks_from: usize) -> Self {
        let blocks = BlockCache::new(blocks_from);
        Self { scenes: Vec::new(), bytes_max, blocks_from, blocks }
    }

    /// The scene of `source`, uploaded once; if `labelled`, with the entries of `source`, and if
    /// `detailed`, with merged Gaussians where it has blocks: then it is uploaded again.
    /// Errors: `limit_exceeded` when it does not fit the adapter's limits or memory.
    pub(super) fn get(
        &mut self,
        gpu: &Gpu,
        source: &Gaussians,
        labelled: bool,
        detailed: bool,
    ) -> Result<DeviceScene> {
        let shape = source.shape_identity();
        let held = self.scenes.iter().position(|scene| scene.shape == shape);
        let scene = match held.map(|at| self.scenes.remove(at)) {
            Some(scene) if scene.is_whole(detailed) => scene,
            coarse => {
                if coarse.is_some() {
                    drop(coarse);
                    gpu.forget();
                }
                self.upload(gpu, source, detailed)?
            }
        };
        let last = self.scenes.len();
        self.scenes.push(scene);
        let scene = &mut self.scenes[last];
        if labelled && !scene.has_labels_of(source) {
            let mut entries = source.semantic_index().to_vec();
            entries.extend(scene.merged.iter().flat_map(|merged| merged.entries(source).to_vec()));
            scene.labels = Some(DeviceLabels::upload(gpu, source.identity(), entries)?);
        }
        Ok(scene.clone())
    }

    /// Uploads a scene.
    fn upload(&mut self, gpu: &Gpu, source: &Gaussians, detailed: bool) -> Result<DeviceScene> {
        let from = self.blocks_from;
        self.uploaded(gpu, || DeviceScene::for_views(gpu, source, from, detailed))
    }

    /// What `upload` uploads. Others leave to make room, the least recently drawn first.
    pub(super) fn uploaded(
        &mut self,
        gpu: &Gpu,
        upload: impl Fn() -> Result<DeviceScene>,
    ) -> Result<DeviceScene> {
        let scene = match upload() {
            // The other scenes may hold the memory: drop them and try once more.
            Err(error) if error.code() == ErrorCode::LimitExceeded && !self.scenes.is_empty() => {
                self.clear(gpu);
                upload()?
            }
            other => other?,
        };
        self.make_room(gpu, &scene);
        Ok(scene)
    }

    /// Takes a scene that is uploaded already, unless it is there or is larger than all may be.
    pub(super) fn put(&mut self, gpu: &Gpu, scene: DeviceScene) {
        if scene.size_bytes() <= self.bytes_max && !self.shapes().contains(&scene.shape) {
            self.make_room(gpu, &scene);
            self.scenes.push(scene);
        } else {
            drop(scene);
            gpu.forget();
        }
    }

    fn make_room(&mut self, gpu: &Gpu, scene: &DeviceScene) {
        let size_bytes = |scenes: &[_]| scenes.iter().map(DeviceScene::size_bytes).sum::<u64>();
        let bytes_max = self.bytes_max.saturating_sub(scene.size_bytes());
        while size_bytes(&self.scenes) > bytes_max {
            self.scenes.remove(0);
            gpu.forget();
        }
    }

    /// Shape identities of the scenes.
    pub(super) fn shapes(&self) -> Vec<u64> {
        self.scenes.iter().map(|scene| scene.shape).collect()
    }

    /// Drops all scenes.
    pub(super) fn clear(&mut self, gpu: &Gpu) {
        self.scenes.clear();
        gpu.forget();
    }
}

/// Narrows a count that the limits keep under 2³².
/// Errors: `limit_exceeded` with `what` and the count.
pub(super) fn narrow(what: &str, count: usize) -> Result<u32> {
    u32::try_from(count).map_err(|_| Error::limit(what, count, u32::MAX))
}
