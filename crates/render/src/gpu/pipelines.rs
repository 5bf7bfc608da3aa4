//! The shaders, assembled from shaders/*.wgsl, and their compiled kernels.

use std::{borrow::Cow, path::Path, sync::OnceLock};

use super::{GpuOptions, device::Gpu};
use crate::{
    error::{Error, Result},
    skip::Skip,
};

/// Invocations of a workgroup: WebGPU's portable floor, and the values of a radix digit.
pub const WORKGROUP_SIZE: u32 = 256;
/// Views that one submission draws at most.
pub const VIEWS_MAX: u32 = 8;
/// Invocations of a workgroup that moves pairs.
pub const SORT_SIZE: u32 = 128;
/// Pairs that one workgroup sorts.
pub const SORT_BLOCK: u32 = 2048;
/// Gaussians whose tile pairs one workgroup emits.
pub const SCAN_BLOCK: u32 = 1024;
/// Workgroups along x at most; more go to y. Under the portable 65,535.
pub const GROUPS_X_MAX: u32 = 32_768;
/// First row of workgroup counts of digits 1 to 3 of the depth sort, by blocks.
pub const GROUPS_DEPTH: u32 = 0;
/// The same, by values of the digit.
pub const GROUPS_DIGITS: u32 = 3;
/// Row of workgroup counts of the tile sort.
pub const GROUPS_TILES: u32 = 6;
/// Row of workgroup counts of the tile ranges.
pub const GROUPS_RANGES: u32 = 7;
/// Bits of a fast view's depth keys: two digits of the sort.
pub const FAST_KEY_BITS: u32 = 16;
/// Depth key of a dropped Gaussian.
pub const DROPPED_KEY: u32 = u32::MAX;
/// Value of a pair that was counted and not emitted.
pub const NO_GAUSSIAN: u32 = u32::MAX;
/// Start of a picture that was not asked for.
pub const NO_PICTURE: u32 = u32::MAX;

/// The kernels' numbers by the name they have in WGSL, beside
/// [`crate::constants::SHARED`].
pub const SHARED: [(&str, u32); 14] = [
    ("WORKGROUP_SIZE", WORKGROUP_SIZE),
    ("VIEWS_MAX", VIEWS_MAX),
    ("SORT_SIZE", SORT_SIZE),
    ("SORT_BLOCK", SORT_BLOCK),
    ("SCAN_BLOCK", SCAN_BLOCK),
    ("GROUPS_X_MAX", GROUPS_X_MAX),
    ("GROUPS_DEPTH", GROUPS_DEPTH),
    ("GROUPS_DIGITS", GROUPS_DIGITS),
    ("GROUPS_TILES", GROUPS_TILES),
    ("GROUPS_RANGES", GROUPS_RANGES),
    ("FAST_KEY_BITS", FAST_KEY_BITS),
    ("DROPPED_KEY", DROPPED_KEY),
    ("NO_GAUSSIAN", NO_GAUSSIAN),
    ("NO_PICTURE", NO_PICTURE),
];

/// One stage's shader: its file's stem and its whole source, common parts first.
#[derive(Clone, Copy, Debug)]
pub struct Shader {
    /// Stem of shaders/*.wgsl and of crates/render/src/cpu/*.rs; variants share it.
    pub stem: &'static str,
    /// Files under shaders/, in their order.
    pub files: &'static [&'static str],
    /// WGSL.
    pub source: &'static str,
}

/// The source of a stage: constants, structs, views, then the named parts, then the stage itself.
macro_rules! shader {
    ($stem:literal $(, $part:literal)*) => {
        Shader {
            stem: $stem,
            files: &[
                "common/constants.wgsl",
                "common/structs.wgsl",
                "common/views.wgsl",
                $(concat!("common/", $part, ".wgsl"),)*
                concat!($stem, ".wgsl"),
            ],
            source: concat!(
                include_str!("../../../../shaders/common/constants.wgsl"),
                include_str!("../../../../shaders/common/structs.wgsl"),
                include_str!("../../../../shaders/common/views.wgsl"),
                $(include_str!(concat!("../../../../shaders/common/", $part, ".wgsl")),)*
                include_str!(concat!("../../../../shaders/", $stem, ".wgsl")),
            ),
        }
    };
}

/// Every shader, in the order of the stages.
pub const SHADERS: [Shader; 9] = [
    shader!("project", "camera", "tiles"),
    shader!("radix_sort", "sum_before"),
    shader!("prefix_sum", "sum_before"),
    shader!("shade", "sh"),
    shader!("emit_isects", "tiles", "sum_before"),
    shader!("tile_ranges"),
    shader!("rasterize", "labels_none"),
    shader!("rasterize", "labels_index", "labels_blend"),
    shader!("rasterize", "labels_index", "labels_weights"),
];

/// Kernels, in the order of [`KERNELS`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Kernel {
    Project,
    Histogram,
    Spine,
    Scatter,
    SumBlocks,
    ScanSums,
    Shade,
    EmitIsects,
    TileRanges,
    Rasterize(Raster),
}

/// What a kernel of rasterize is made for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct Raster {
    pub(super) color: bool,
    pub(super) depth: bool,
    pub(super) labels: RasterLabels,
}

/// Labels that a kernel of rasterize blends, in the order of [`SHADERS`].
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum RasterLabels {
    None,
    Blend,
    Weights,
}

/// Name in measurements, place in [`SHADERS`] and entry point of every kernel but rasterize; those
/// of [`SERIAL`] have one more, for software adapters.
const KERNELS: [(&str, usize, &str); 9] = [
    ("project", 0, "main"),
    ("histogram", 1, "histogram"),
    ("spine", 1, "spine"),
    ("scatter", 1, "scatter"),
    ("sum_blocks", 2, "sum_blocks"),
    ("scan_sums", 2, "scan_sums"),
    ("shade", 3, "main"),
    ("emit_isects", 4, "main"),
    ("tile_ranges", 5, "main"),
];
/// Kernels with an entry point of their own for software adapters: `{name}_serial`.
const SERIAL: [&str; 2] = ["spine", "scatter"];
/// Pixels that an invocation of rasterize blends: on a GPU, and on a software adapter.
const PIXELS: [f64; 2] = [1.0, 8.0];
/// Place in [`SHADERS`] of rasterize without labels.
const RASTERIZE: usize = 6;
/// Sets of pictures, each a kernel of rasterize, by labels.
const PICTURES: usize = 4;

impl Kernel {
    fn place(self) -> Option<usize> {
        Some(match self {
            Self::Project => 0,
            Self::Histogram => 1,
            Self::Spine => 2,
            Self::Scatter => 3,
            Self::SumBlocks => 4,
            Self::ScanSums => 5,
            Self::Shade => 6,
            Self::EmitIsects => 7,
            Self::TileRanges => 8,
            Self::Rasterize(_) => return None,
        })
    }

    /// Name in measurements.
    pub(super) fn name(self) -> &'static str {
        self.place().map_or("rasterize", |place| KERNELS[place].0)
    }
}

/// The compiled kernels.
#[derive(Debug)]
pub(super) struct Kernels {
    modules: Vec<wgpu::ShaderModule>,
    pipelines: Vec<wgpu::ComputePipeline>,
    /// Made when first wanted: a server that is asked for colour needs one of twelve.
    rasterize: [OnceLock<wgpu::ComputePipeline>; 3 * PICTURES],
    /// Whether they are those for a software adapter.
    pub(super) serial: bool,
    /// Needless work that is not left out.
    without: Option<Skip>,
}

impl Kernels {
    /// Compiles every kernel as `options` say, for an adapter that is `software` or not.
    ///
    /// # Errors
    /// `internal` when the driver refuses one, `invalid_request` when a file cannot be read.
    pub(super) fn compile(gpu: &Gpu, options: &GpuOptions, software: bool) -> Result<Self> {
        let serial = options.serial.unwrap_or(software);
        let modules = SHADERS
            .iter()
            .map(|shader| {
                let source = source_of(shader, options.shaders.as_deref())?;
                gpu.scoped(shader.stem, || {
                    let described = wgpu::ShaderModuleDescriptor {
                        label: Some(shader.stem),
                        source: wgpu::ShaderSource::Wgsl(source),
                    };
                    if options.checked {
                        return gpu.device.create_shader_module(described);
                    }
                    let checks = wgpu::ShaderRuntimeChecks::unchecked();
                    // SAFETY: the shaders are our own. Every index is held against a count that
                    // the host has made room for, and every loop ends; the twin tests run them
                    // with the checks too.
                    #[expect(unsafe_code, reason = "the checks cost a fifth of a frame")]
                    unsafe {
                        gpu.device.create_shader_module_trusted(described, checks)
                    }
                })
            })
            .collect::<Result<Vec<_>>>()?;
        let pipelines = KERNELS
            .iter()
            .map(|&(name, module, entry)| {
                let own = if serial && SERIAL.contains(&name) { "_serial" } else { "" };
                let constants: Vec<_> = left_in(&SHADERS[module], options.without).collect();
                pipeline(gpu, name, &modules[module], &format!("{entry}{own}"), &constants)
            })
            .collect::<Result<_>>()?;
        let rasterize = [const { OnceLock::new() }; 3 * PICTURES];
        Ok(Self { modules, pipelines, rasterize, serial, without: options.without })
    }

    /// Whether rasterize takes colours out of the harmonics of a scene with `sh_count`, not from
    /// shade.
    pub(super) fn flat(&self, sh_count: u32) -> bool {
        sh_count == 1 && self.without != Some(Skip::FlatColor)
    }

    /// Whether digits that are the same for all are sorted too.
    pub(super) fn sorts_all(&self) -> bool {
        self.without == Some(Skip::EqualDigits)
    }

    /// The pipeline of a kernel.
    ///
    /// # Errors
    /// `internal` when the driver refuses one that is wanted for the first time.
    pub(super) fn get(&self, gpu: &Gpu, kernel: Kernel) -> Result<&wgpu::ComputePipeline> {
        let Kernel::Rasterize(raster) = kernel else {
            return Ok(&self.pipelines[kernel.place().unwrap_or_default()]);
        };
        let labels = raster.labels as usize;
        let at = labels * PICTURES + usize::from(raster.color) * 2 + usize::from(raster.depth);
        if self.rasterize[at].get().is_none() {
            let mut constants = vec![
                ("WITH_COLOR", f64::from(u8::from(raster.color))),
                ("WITH_DEPTH", f64::from(u8::from(raster.depth))),
                ("PIXELS", PIXELS[usize::from(self.serial)]),
            ];
            constants.extend(left_in(&SHADERS[RASTERIZE + labels], self.without));
            let module = &self.modules[RASTERIZE + labels];
            let made = pipeline(gpu, "rasterize", module, "main", &constants)?;
            return Ok(self.rasterize[at].get_or_init(|| made));
        }
        self.rasterize[at].get().ok_or_else(|| Error::internal("a kernel was made and is gone"))
    }
}

/// The constant that has a shader do the work `without` names, if it knows that work.
fn left_in(shader: &Shader, without: Option<Skip>) -> impl Iterator<Item = (&'static str, f64)> {
    let known = |name: &&str| shader.source.contains(&format!("override {name}: bool"));
    without.map(Skip::constant).filter(known).map(|name| (name, 0.0)).into_iter()
}

fn pipeline(
    gpu: &Gpu,
    name: &'static str,
    module: &wgpu::ShaderModule,
    entry: &str,
    constants: &[(&str, f64)],
) -> Result<wgpu::ComputePipeline> {
    gpu.scoped(name, || {
        gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
            label: Some(name),
            layout: None,
            module,
            entry_point: Some(entry),
            compilation_options: wgpu::PipelineCompilationOptions {
                constants,
                // Every shader writes its workgroup memory before it reads it.
                zero_initialize_workgroup_memory: false,
            },
            cache: None,
        })
    })
}

fn source_of(shader: &Shader, folder: Option<&Path>) -> Result<Cow<'static, str>> {
    let Some(folder) = folder else { return Ok(Cow::Borrowed(shader.source)) };
    let read = |file: &&str| {
        fs_err::read_to_string(folder.join(file))
            .map_err(|e| Error::invalid(format!("shaders: {file} cannot be read")).caused_by(e))
    };
    Ok(Cow::Owned(shader.files.iter().map(read).collect::<Result<String>>()?))
}
