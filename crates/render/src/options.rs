//! Which renderer to open, with which bounds, and what is known of the adapters.

use serde::{Deserialize, Serialize};

use crate::{limits::Limits, switches::Switches};

/// Which renderer serves views.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum RendererChoice {
    /// A hardware adapter where there is one, else the CPU renderer. Never a software adapter.
    #[default]
    Auto,
    /// The CPU renderer.
    Cpu,
    /// A wgpu adapter, software ones too when `adapter` names it; refuses to start without.
    Gpu,
}

/// Which renderer to open, and its bounds.
#[derive(Clone, Debug)]
pub struct RendererOptions {
    /// Which renderer.
    pub renderer: RendererChoice,
    /// Part of the name of the wgpu adapter to use, or of several, with commas between.
    pub adapter: Option<String>,
    /// Threads of the CPU renderer; 0: one for each core that the process may use.
    pub threads: usize,
    /// Bytes of scenes kept on one GPU device.
    pub scene_bytes_max: u64,
    /// For tests and the laboratory.
    pub switches: Switches,
}

impl Default for RendererOptions {
    fn default() -> Self {
        Self {
            renderer: RendererChoice::default(),
            adapter: None,
            threads: 0,
            scene_bytes_max: Limits::default().device_scene_bytes_max,
            switches: Switches::default(),
        }
    }
}

/// A GPU adapter as the driver describes it.
#[derive(Clone, Debug, PartialEq, Eq, Serialize)]
pub struct AdapterReport {
    /// The adapter's own name.
    pub name: String,
    /// `DiscreteGpu`, `IntegratedGpu`, `VirtualGpu`, `Cpu` or `Other`.
    pub kind: String,
    /// `vulkan`, `metal`, `dx12` or `gl`.
    pub backend: String,
    /// Driver and its version.
    pub driver: String,
    /// Whether it computes on the processor.
    pub software: bool,
    /// Whether it was taken.
    pub chosen: bool,
}
