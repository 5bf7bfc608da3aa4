//! The shaders, put together of shaders/*.wgsl, and their compiled kernels.

use std::borrow::Cow;

use super::device::Gpu;
use crate::error::Result;

/// Invocations of a workgroup: WebGPU's portable floor, and the values of a radix digit.
pub const WORKGROUP_SIZE: u32 = 256;
/// Pairs that one workgroup sorts.
pub const SORT_BLOCK: u32 = 2048;
/// Numbers that one workgroup sums.
pub const SCAN_BLOCK: u32 = 2048;
/// Workgroups along x at most; more go to y. Under the portable 65,535.
pub const GROUPS_X_MAX: u32 = 32_768;
/// Count that means "as many as `Plan.isects` says".
pub const COUNT_FROM_PLAN: u32 = u32::MAX;
/// Depth key of a dropped Gaussian.
pub const DROPPED_KEY: u32 = u32::MAX;
/// Value of a pair that was counted and not emitted.
pub const NO_GAUSSIAN: u32 = u32::MAX;
/// Start of a picture that was not asked for.
pub const NO_PICTURE: u32 = u32::MAX;

/// The kernels' numbers by the name they have in WGSL, beside
/// [`crate::render::constants::SHARED`].
pub const SHARED: [(&str, u32); 8] = [
    ("WORKGROUP_SIZE", WORKGROUP_SIZE),
    ("SORT_BLOCK", SORT_BLOCK),
    ("SCAN_BLOCK", SCAN_BLOCK),
    ("GROUPS_X_MAX", GROUPS_X_MAX),
    ("COUNT_FROM_PLAN", COUNT_FROM_PLAN),
    ("DROPPED_KEY", DROPPED_KEY),
    ("NO_GAUSSIAN", NO_GAUSSIAN),
    ("NO_PICTURE", NO_PICTURE),
];

/// One stage's shader: its file's stem and its whole source, common parts first.
#[derive(Clone, Copy, Debug)]
pub struct Shader {
    /// Stem of shaders/*.wgsl and of its twin src/render/cpu/*.rs; variants share it.
    pub stem: &'static str,
    /// WGSL.
    pub source: &'static str,
}

/// The source of a stage: constants, structs, then the named parts, then the stage itself.
macro_rules! shader {
    ($stem:literal $(, $part:literal)*) => {
        Shader {
            stem: $stem,
            source: concat!(
                include_str!("../../../shaders/common/constants.wgsl"),
                include_str!("../../../shaders/common/structs.wgsl"),
                $(include_str!(concat!("../../../shaders/common/", $part, ".wgsl")),)*
                include_str!(concat!("../../../shaders/", $stem, ".wgsl")),
            ),
        }
    };
}

/// Every shader, in the order of the stages.
pub const SHADERS: [Shader; 9] = [
    shader!("project", "camera", "tiles"),
    shader!("radix_sort"),
    shader!("prefix_sum"),
    shader!("shade", "sh"),
    shader!("emit_isects", "tiles"),
    shader!("tile_ranges"),
    shader!("rasterize", "labels_none"),
    shader!("rasterize", "labels_index", "labels_blend"),
    shader!("rasterize", "labels_index", "labels_entries"),
];

/// The compiled kernels.
#[derive(Debug)]
pub(super) struct Kernels {
    pub(super) project: wgpu::ComputePipeline,
    pub(super) histogram: wgpu::ComputePipeline,
    pub(super) scatter: wgpu::ComputePipeline,
    pub(super) scan_blocks: wgpu::ComputePipeline,
    pub(super) add_blocks: wgpu::ComputePipeline,
    pub(super) shade: wgpu::ComputePipeline,
    pub(super) make_plan: wgpu::ComputePipeline,
    pub(super) emit_isects: wgpu::ComputePipeline,
    pub(super) tile_ranges: wgpu::ComputePipeline,
    pub(super) rasterize: wgpu::ComputePipeline,
    pub(super) rasterize_blend: wgpu::ComputePipeline,
    pub(super) rasterize_entries: wgpu::ComputePipeline,
}

impl Kernels {
    /// Compiles every kernel.
    ///
    /// # Errors
    /// `internal` when the driver refuses one.
    pub(super) fn compile(gpu: &Gpu) -> Result<Self> {
        let [
            project,
            radix_sort,
            prefix_sum,
            shade,
            emit_isects,
            tile_ranges,
            rasterize,
            rasterize_blend,
            rasterize_entries,
        ] = SHADERS.map(|shader| {
            gpu.scoped(shader.stem, || {
                gpu.device.create_shader_module(wgpu::ShaderModuleDescriptor {
                    label: Some(shader.stem),
                    source: wgpu::ShaderSource::Wgsl(Cow::Borrowed(shader.source)),
                })
            })
        });
        let (radix_sort, prefix_sum, emit_isects) = (radix_sort?, prefix_sum?, emit_isects?);
        let compile = |module: &wgpu::ShaderModule, entry: &'static str| {
            gpu.scoped(entry, || {
                gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                    label: Some(entry),
                    layout: None,
                    module,
                    entry_point: Some(entry),
                    // Every shader writes its workgroup memory before it reads it.
                    compilation_options: wgpu::PipelineCompilationOptions {
                        zero_initialize_workgroup_memory: false,
                        ..Default::default()
                    },
                    cache: None,
                })
            })
        };
        Ok(Self {
            project: compile(&project?, "main")?,
            histogram: compile(&radix_sort, "histogram")?,
            scatter: compile(&radix_sort, "scatter")?,
            scan_blocks: compile(&prefix_sum, "scan_blocks")?,
            add_blocks: compile(&prefix_sum, "add_blocks")?,
            shade: compile(&shade?, "main")?,
            make_plan: compile(&emit_isects, "make_plan")?,
            emit_isects: compile(&emit_isects, "main")?,
            tile_ranges: compile(&tile_ranges?, "main")?,
            rasterize: compile(&rasterize?, "main")?,
            rasterize_blend: compile(&rasterize_blend?, "main")?,
            rasterize_entries: compile(&rasterize_entries?, "main")?,
        })
    }
}
