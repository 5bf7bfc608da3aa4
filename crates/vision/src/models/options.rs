//! Options for opening the networks.

use std::path::PathBuf;

use serde::{Deserialize, Serialize};

/// The one command that gets the library.
pub const SETUP_COMMAND: &str = "scripts/setup";

/// Execution provider of the networks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum ProviderChoice {
    /// CUDA where the library has it and it works, else CPU; the choice is logged.
    #[default]
    Auto,
    /// CPU.
    Cpu,
    /// CUDA; refuses to start without.
    Cuda,
    /// WebGPU; refuses to start without.
    Webgpu,
}

/// How the networks are found and run.
#[derive(Clone, Debug)]
pub struct NetworkOptions {
    /// Folder of the model bundle; `None`: search.
    pub bundle: Option<PathBuf>,
    /// ONNX Runtime library; `None`: search.
    pub ort_library: Option<PathBuf>,
    /// Execution provider.
    pub provider: ProviderChoice,
    /// Threads, shared by all sessions that run at the same time.
    pub threads: usize,
    /// Scenes made at the same time: one session each.
    pub jobs: usize,
}

impl Default for NetworkOptions {
    /// The bundle and library that are found, on all cores that this process has, one job.
    fn default() -> Self {
        let threads = std::thread::available_parallelism().map_or(1, usize::from);
        Self { bundle: None, ort_library: None, provider: ProviderChoice::Auto, threads, jobs: 1 }
    }
}
