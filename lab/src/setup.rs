//! What the command line says of scenes, networks and renderers.

use std::{
    path::{Path, PathBuf},
    sync::Arc,
};

use segsplat_core::{limits::Limits, names::named};

use crate::{
    error::{Error, Result},
    models::NetworkOptions,
    render::{
        DifferentiableRenderer, RendererChoice, RendererOptions, Switches, options::AdapterReport,
        select::select,
    },
};

/// Scene folders, how many photos of them are put in, and what runs the networks.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Inputs {
    /// A scene folder, or a folder of scene folders
    dir: PathBuf,
    /// Only these scenes, by name, separated by commas [default: all]
    #[arg(long, value_delimiter = ',')]
    scenes: Vec<String>,
    /// Photos put in: those nearest to the target
    #[arg(long, default_value_t = 2)]
    pub(crate) photos: usize,
    #[command(flatten)]
    pub(crate) setup: Setup,
}

/// What runs the measured code.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Setup {
    /// Folder of the model bundle [default: as the server finds it]
    #[arg(long, env = "SEGSPLAT_BUNDLE")]
    bundle: Option<PathBuf>,
    /// ONNX Runtime library [default: as the server finds it]
    #[arg(long, env = "SEGSPLAT_ORT_LIBRARY")]
    ort_library: Option<PathBuf>,
    /// Threads of the networks and of the CPU renderer [default: all cores]
    #[arg(long)]
    threads: Option<usize>,
    /// Renderer: auto, cpu or gpu
    #[arg(long, default_value = "cpu", value_parser = named::<RendererChoice>)]
    renderer: RendererChoice,
    /// Part of the name of the GPU adapter
    #[arg(long)]
    adapter: Option<String>,
    /// Bytes of scenes that the GPU may hold
    #[arg(long, default_value_t = Limits::default().device_scene_bytes_max)]
    scene_bytes: u64,
}

impl Inputs {
    /// The folders for which `is_scene`, sorted by name: `dir` itself, or those in it. Each with
    /// its name.
    ///
    /// # Errors
    /// `invalid_request` where there is none, or none of a name that was asked for.
    pub(crate) fn find(&self, is_scene: impl Fn(&Path) -> bool) -> Result<Vec<(String, PathBuf)>> {
        let mut paths = vec![self.dir.clone()];
        if !is_scene(&self.dir) {
            let fault = |e: std::io::Error| Error::invalid(format!("the folder: {}", e.kind()));
            let listed = fs_err::read_dir(&self.dir).map_err(fault)?;
            paths = listed.flatten().map(|entry| entry.path()).filter(|p| is_scene(p)).collect();
        }
        let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into();
        let mut found: Vec<(String, PathBuf)> =
            paths.into_iter().map(|path| (name(&path), path)).collect();
        let unknown = |wanted: &&String| !found.iter().any(|(name, _)| name == *wanted);
        if let Some(wanted) = self.scenes.iter().find(unknown) {
            return Err(Error::invalid(format!("no scene folder is called {wanted:?}")));
        }
        found.retain(|(name, _)| self.scenes.is_empty() || self.scenes.contains(name));
        found.sort();
        if found.is_empty() {
            return Err(Error::invalid("there is no scene folder"));
        }
        Ok(found)
    }
}

impl Setup {
    /// Threads in use.
    pub(crate) fn threads(&self) -> usize {
        self.threads.unwrap_or_else(|| NetworkOptions::default().threads)
    }

    /// What makes `segsplat serve` choose the same renderer and threads.
    pub(crate) fn serve_args(&self) -> Vec<String> {
        let renderer = match self.renderer {
            RendererChoice::Auto => "auto",
            RendererChoice::Cpu => "cpu",
            RendererChoice::Gpu => "gpu",
        };
        let (renderer, threads) = (renderer.to_owned(), self.threads().to_string());
        let mut args = vec!["--renderer".to_owned(), renderer, "--threads".to_owned(), threads];
        args.extend(self.adapter.iter().flat_map(|name| ["--adapter".to_owned(), name.clone()]));
        args
    }

    /// What opening the networks needs, for `jobs` scenes at a time.
    pub(crate) fn networks(&self, jobs: usize) -> NetworkOptions {
        NetworkOptions {
            bundle: self.bundle.clone(),
            ort_library: self.ort_library.clone(),
            threads: self.threads(),
            jobs,
            ..NetworkOptions::default()
        }
    }

    /// The renderer, and the adapters that there are.
    pub(crate) fn renderer(
        &self,
        switches: Switches,
    ) -> Result<(Arc<dyn DifferentiableRenderer>, Vec<AdapterReport>)> {
        select(&RendererOptions {
            renderer: self.renderer,
            adapter: self.adapter.clone(),
            threads: self.threads(),
            scene_bytes_max: self.scene_bytes,
            switches,
        })
    }
}
