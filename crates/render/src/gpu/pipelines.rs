//! The shaders, assembled from shaders/*.wgsl, and their compiled kernels.

use std::{borrow::Cow, collections::HashMap, path::Path};

use parking_lot::Mutex;

use super::device::Gpu;
use crate::{
    Kinds, Labels, Layer, RenderRequest, Samples,
    constants::shared,
    error::{Error, Result},
    scene::Backdrop,
    switches::{Skip, Switches},
};

shared! { pub(super) u32;
    /// Invocations of a workgroup: WebGPU's portable floor, and the values of a radix digit.
    WORKGROUP_SIZE = 256;
    /// Gaussians of a block.
    BLOCK = crate::blocks::BLOCK as u32;
    /// Views that one submission draws at most.
    VIEWS_MAX = 8;
    /// Pairs of a tile that one workgroup sorts at once: 16 KiB, the portable floor.
    SORT_RUN = 2048;
    /// Tiles of a Gaussian above which a whole workgroup visits them.
    LARGE_TILES = 64;
    /// Tiles in which a workgroup counts by itself.
    BINS = 1024;
    /// Workgroups along x at most; more go to y. Under the portable 65,535.
    GROUPS_X_MAX = 32_768;
    /// Colour in three bytes, of 8 bits each.
    LEVELS_RGB = 1;
    /// Colour and alpha in four bytes.
    LEVELS_RGBA = 2;
    /// What a photo gave is behind all that is in front.
    BEHIND = Layer::Behind as u32;
    /// What a photo gave is not drawn.
    LEFT_OUT = Layer::LeftOut as u32;
    /// Sums that a tile gives for each of its pairs in the backward pass.
    PAIR_SUMS = 10;
    /// Derivatives of a Gaussian but for its harmonics, and whether it is seen.
    GRADIENT_WORDS = 12;
    /// Numbers of a photo's exposure, with its moments and the loss.
    EXPOSURE_WORDS = 20;
    /// Workgroups that add up what the loss says of a camera.
    POSE_GROUPS = 64;
    /// Cells of a backdrop, across.
    BACKDROP_WIDTH = Backdrop::WIDTH as u32;
    /// Cells of a backdrop, down.
    BACKDROP_HEIGHT = Backdrop::HEIGHT as u32;
    /// Start of a picture that was not asked for.
    NO_PICTURE = u32::MAX;
}

/// The source of one stage, common parts first.
#[derive(Clone, Copy, Debug)]
pub struct Shader {
    /// Name of its own.
    pub name: &'static str,
    /// Stem of shaders/*.wgsl and of crates/render/src/cpu/*.rs; variants share it.
    pub stem: &'static str,
    /// Files under shaders/, in their order.
    pub files: &'static [&'static str],
    /// WGSL.
    pub source: &'static str,
}

/// The source of a stage: constants, structs, views, then the named parts, then the stage itself.
macro_rules! shader {
    ($name:literal, $stem:literal $(, $part:literal)*) => {
        Shader {
            name: $name,
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
pub const SHADERS: [Shader; 17] = [
    shader!("cull", "cull"),
    shader!("project", "project", "rows", "camera", "tiles"),
    shader!("shade", "shade", "rows", "sh"),
    shader!("prefix_sum", "prefix_sum", "sum_before"),
    shader!("emit_isects", "emit_isects", "rows", "tiles"),
    shader!("tile_sort", "tile_sort"),
    shader!("rasterize", "rasterize", "parts", "backdrop", "labels_none"),
    shader!("rasterize_blend", "rasterize", "parts", "backdrop", "labels_entries", "labels_blend"),
    shader!(
        "rasterize_weights",
        "rasterize",
        "parts",
        "backdrop",
        "labels_entries",
        "labels_weights"
    ),
    shader!("depth_steps", "depth_steps"),
    shader!("rasterize_backward", "rasterize_backward", "parts", "backdrop"),
    shader!("project_backward", "project_backward", "camera", "tiles"),
    shader!("shade_backward", "shade_backward", "camera", "sh"),
    shader!("photo_loss", "photo_loss"),
    shader!("exposure", "exposure", "camera", "moments"),
    shader!("pose", "pose"),
    shader!("adam", "adam", "camera", "moments"),
];

/// Kernels, in the order of the stages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum Kernel {
    Cull,
    Project,
    Shade,
    PrefixSum,
    EmitIsects,
    TileSort,
    Rasterize(RasterKinds),
    Farthest,
    DepthSteps,
    /// With the pictures that the loss depends on.
    RasterizeBackward(Kinds),
    ProjectBackward,
    ShadeBackward,
    LossWindows,
    PhotoLoss,
    Exposure,
    PoseGradient,
    AddEarlier,
    Adam,
}

/// What a kernel of rasterize gives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) struct RasterKinds {
    pub(super) color: bool,
    pub(super) depth: bool,
    /// Pictures whose pixels share words: colour and alpha in levels, a mask.
    pub(super) bytes: bool,
    pub(super) labels: RasterLabels,
}

impl From<&RenderRequest> for RasterKinds {
    fn from(request: &RenderRequest) -> Self {
        let RenderRequest { kinds, labels, samples, .. } = request;
        let rgb = kinds.color && *samples == Samples::Levels;
        let alpha = kinds.alpha && *samples != Samples::F32;
        Self {
            color: kinds.color,
            depth: kinds.depth,
            bytes: rgb || alpha || matches!(labels, Labels::Mask { .. }),
            labels: match labels {
                Labels::None => RasterLabels::None,
                Labels::Blend(_) | Labels::Mask { .. } => RasterLabels::Blend,
                Labels::Weights => RasterLabels::Weights,
            },
        }
    }
}

/// Labels that a kernel of rasterize blends.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub(super) enum RasterLabels {
    None,
    Blend,
    Weights,
}

impl Kernel {
    /// Those that every view needs.
    const ALWAYS: [Self; 5] =
        [Self::Project, Self::Shade, Self::PrefixSum, Self::EmitIsects, Self::TileSort];

    /// Those of a step of training beside the ones of its picture.
    pub(super) const TRAINING: [Self; 7] = [
        Self::LossWindows,
        Self::PhotoLoss,
        Self::Exposure,
        Self::RasterizeBackward(Kinds::COLOR),
        Self::ProjectBackward,
        Self::ShadeBackward,
        Self::Adam,
    ];

    /// Name in measurements, name of the shader, and entry point on a GPU and on a software
    /// adapter.
    fn row(self) -> (&'static str, &'static str, [&'static str; 2]) {
        match self {
            Self::Cull => ("cull", "cull", ["main"; 2]),
            Self::Project => ("project", "project", ["main"; 2]),
            Self::Shade => ("shade", "shade", ["main"; 2]),
            Self::PrefixSum => ("prefix_sum", "prefix_sum", ["main"; 2]),
            Self::EmitIsects => ("emit_isects", "emit_isects", ["main"; 2]),
            Self::TileSort => ("tile_sort", "tile_sort", ["main", "serial"]),
            Self::Farthest => ("farthest", "depth_steps", ["farthest"; 2]),
            Self::DepthSteps => ("depth_steps", "depth_steps", ["main"; 2]),
            Self::RasterizeBackward(_) => ("rasterize_backward", "rasterize_backward", ["main"; 2]),
            Self::ProjectBackward => ("project_backward", "project_backward", ["main"; 2]),
            Self::ShadeBackward => ("shade_backward", "shade_backward", ["main"; 2]),
            Self::LossWindows => ("loss_windows", "photo_loss", ["windows"; 2]),
            Self::PhotoLoss => ("photo_loss", "photo_loss", ["main"; 2]),
            Self::Exposure => ("exposure", "exposure", ["main"; 2]),
            Self::PoseGradient => ("pose", "pose", ["main"; 2]),
            Self::AddEarlier => ("add_earlier", "adam", ["add_earlier"; 2]),
            Self::Adam => ("adam", "adam", ["main"; 2]),
            Self::Rasterize(kinds) => {
                let shader = match kinds.labels {
                    RasterLabels::None => "rasterize",
                    RasterLabels::Blend => "rasterize_blend",
                    RasterLabels::Weights => "rasterize_weights",
                };
                ("rasterize", shader, ["main"; 2])
            }
        }
    }

    /// Name in measurements.
    pub(super) fn name(self) -> &'static str {
        self.row().0
    }
}

/// The compiled kernels.
#[derive(Debug)]
pub(super) struct Kernels {
    /// In the order of [`SHADERS`].
    modules: Vec<wgpu::ShaderModule>,
    /// Those of rasterize are compiled for the first view that needs them: a server that is asked
    /// for colour needs one of many.
    pipelines: Mutex<HashMap<Kernel, wgpu::ComputePipeline>>,
    /// Whether they are those for a software adapter.
    pub(super) serial: bool,
    /// Needless work that is done all the same.
    without: Option<Skip>,
}

impl Kernels {
    /// Compiles the kernels for an adapter that is `software` or not.
    /// Errors: `internal` when the driver refuses one, `invalid_request` when a file cannot be
    /// read.
    pub(super) fn compile(gpu: &Gpu, switches: &Switches, software: bool) -> Result<Self> {
        let modules = SHADERS
            .iter()
            .map(|shader| {
                let source = source_of(shader, switches.shaders().as_deref())?;
                gpu.scoped(shader.stem, || {
                    let described = wgpu::ShaderModuleDescriptor {
                        label: Some(shader.name),
                        source: wgpu::ShaderSource::Wgsl(source),
                    };
                    if switches.checked() {
                        return gpu.device.create_shader_module(described);
                    }
                    let checks = wgpu::ShaderRuntimeChecks::unchecked();
                    // SAFETY: the shaders are our own. Every index is compared with a count that
                    // the host has made room for, and every loop ends. Tests run them with the
                    // checks too.
                    #[expect(unsafe_code, reason = "the checks cost a fifth of a frame")]
                    unsafe {
                        gpu.device.create_shader_module_trusted(described, checks)
                    }
                })
            })
            .collect::<Result<Vec<_>>>()?;
        let serial = switches.serial().unwrap_or(software);
        let pipelines = Mutex::default();
        let kernels = Self { modules, pipelines, serial, without: switches.without() };
        for kernel in Kernel::ALWAYS {
            kernels.get(gpu, kernel)?;
        }
        Ok(kernels)
    }

    /// Whether rasterize takes colours out of the harmonics of a scene with `sh_count`, not from
    /// shade.
    pub(super) fn flat(&self, sh_count: u32) -> bool {
        sh_count == 1 && Skip::FlatColor.applies(self.without)
    }

    /// The pipeline of a kernel.
    /// Errors: `internal` when the driver refuses one that is needed for the first time.
    pub(super) fn get(&self, gpu: &Gpu, kernel: Kernel) -> Result<wgpu::ComputePipeline> {
        if let Some(pipeline) = self.pipelines.lock().get(&kernel) {
            return Ok(pipeline.clone());
        }
        // Not under the lock: other submissions go on while a kernel is compiled.
        let pipeline = self.pipeline(gpu, kernel)?;
        Ok(self.pipelines.lock().entry(kernel).or_insert(pipeline).clone())
    }

    fn pipeline(&self, gpu: &Gpu, kernel: Kernel) -> Result<wgpu::ComputePipeline> {
        let (name, shader, entry_points) = kernel.row();
        let found = SHADERS.iter().zip(&self.modules).find(|(one, _)| one.name == shader);
        let Some((shader, module)) = found else {
            return Err(Error::internal(format!("{name}: there is no shader {shader}")));
        };
        let mut constants = Vec::new();
        let with = match kernel {
            Kernel::Rasterize(RasterKinds { color, depth, bytes, .. }) => {
                Some([("WITH_COLOR", color), ("WITH_DEPTH", depth), ("WITH_BYTES", bytes)])
            }
            Kernel::RasterizeBackward(Kinds { color, depth, alpha }) => {
                Some([("BY_COLOR", color), ("BY_DEPTH", depth), ("BY_ALPHA", alpha)])
            }
            _ => None,
        };
        if let Some(with) = with {
            constants.extend(with.map(|(name, with)| (name, f64::from(u8::from(with)))));
            // Pixels that an invocation works for.
            constants.push(("PIXELS", if self.serial { 8.0 } else { 1.0 }));
        }
        // The shader does the work that its constant names, if it knows that work.
        let known = |name: &String| shader.source.contains(&format!("override {name}: bool"));
        let without = self.without.map(Skip::constant).filter(known);
        constants.extend(without.iter().map(|name| (name.as_str(), 0.0)));
        gpu.scoped(name, || {
            gpu.device.create_compute_pipeline(&wgpu::ComputePipelineDescriptor {
                label: Some(name),
                layout: None,
                module,
                entry_point: Some(entry_points[usize::from(self.serial)]),
                compilation_options: wgpu::PipelineCompilationOptions {
                    constants: &constants,
                    // Every shader writes its workgroup memory before it reads it.
                    zero_initialize_workgroup_memory: false,
                },
                cache: None,
            })
        })
    }
}

fn source_of(shader: &Shader, folder: Option<&Path>) -> Result<Cow<'static, str>> {
    let Some(folder) = folder else { return Ok(Cow::Borrowed(shader.source)) };
    let read = |file: &&str| {
        fs_err::read_to_string(folder.join(file))
            .map_err(|e| Error::invalid(format!("shaders: {file} cannot be read")).caused_by(e))
    };
    Ok(Cow::Owned(shader.files.iter().map(read).collect::<Result<String>>()?))
}
