//! Networks and renderers, opened from the command line.

use std::{path::PathBuf, sync::Arc};

use serde::Deserialize;

use crate::{
    error::Result,
    models::NetworkOptions,
    render::{
        Renderer, RendererChoice, RendererOptions, Switches,
        select::{AdapterReport, select},
    },
};

/// What runs the measured code.
#[derive(Clone, Debug, clap::Args)]
pub struct Setup {
    /// Folder of the model bundle [default: as the server finds it]
    #[arg(long, env = "SEGSPLAT_BUNDLE")]
    pub bundle: Option<PathBuf>,
    /// ONNX Runtime library [default: as the server finds it]
    #[arg(long, env = "SEGSPLAT_ORT_LIBRARY")]
    pub ort_library: Option<PathBuf>,
    /// Threads of the networks and of the CPU renderer [default: all cores]
    #[arg(long)]
    pub threads: Option<usize>,
    /// Renderer: auto, cpu or gpu
    #[arg(long, default_value = "cpu", value_parser = named::<RendererChoice>)]
    pub renderer: RendererChoice,
    /// Part of the name of the GPU adapter
    #[arg(long)]
    pub adapter: Option<String>,
}

/// A value by the name that serde knows it by.
pub(crate) fn named<T: for<'a> Deserialize<'a>>(name: &str) -> Result<T, String> {
    T::deserialize(serde::de::value::StrDeserializer::<serde::de::value::Error>::new(name))
        .map_err(|e| e.to_string())
}

impl Default for Setup {
    fn default() -> Self {
        let renderer = RendererChoice::Cpu;
        Self { bundle: None, ort_library: None, threads: None, renderer, adapter: None }
    }
}

impl Setup {
    /// Threads in use.
    #[must_use]
    pub fn threads(&self) -> usize {
        self.threads.unwrap_or_else(|| NetworkOptions::default().threads)
    }

    /// What opening the networks needs, for `jobs` scenes at a time.
    #[must_use]
    pub fn networks(&self, jobs: usize) -> NetworkOptions {
        NetworkOptions {
            bundle: self.bundle.clone(),
            ort_library: self.ort_library.clone(),
            threads: self.threads(),
            jobs,
            ..NetworkOptions::default()
        }
    }

    /// The renderer, and the adapters that there are.
    ///
    /// # Errors
    /// Those of [`select`].
    pub fn renderer(&self, switches: Switches) -> Result<(Arc<dyn Renderer>, Vec<AdapterReport>)> {
        select(&RendererOptions {
            renderer: self.renderer,
            adapter: self.adapter.clone(),
            threads: self.threads(),
            switches,
            ..RendererOptions::default()
        })
    }
}
