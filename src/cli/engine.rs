//! The parts of the product, put together from a configuration.

use std::sync::Arc;

use crate::{
    config::Config,
    error::Result,
    jobs::{NoSemantics, PipelineNetworks, SemanticNetworks},
    models::Bundle,
    pipeline::{Pipeline, PipelineLoader},
    render::{Renderer, select::select},
    service::{ModelInfo, ModelsInfo, OfflineService, Parts},
};

/// Bundle, networks and renderer as the server runs them. A thread of the loader still opens the
/// networks; `PipelineLoader::get` waits for it.
///
/// # Errors
/// `model_unavailable`, `gpu_unavailable`, each with what is missing.
pub fn parts(config: &Config) -> Result<(Parts, Arc<PipelineLoader>)> {
    // For loops that belong to no renderer. It can be set once: another call keeps the first.
    let _ = rayon::ThreadPoolBuilder::new().num_threads(config.threads).build_global();
    let engine = Arc::new(PipelineLoader::open(&config.networks())?);
    let renderer = renderer(config)?;
    let models = models_info(engine.bundle(), "opening")?;
    let networks = Arc::new(PipelineNetworks(Arc::clone(&engine)));
    let semantics = Arc::clone(&networks) as Arc<dyn SemanticNetworks>;
    Ok((Parts { scenes: networks, semantics, renderer, models }, engine))
}

/// The renderer that the configuration asks for.
///
/// # Errors
/// `gpu_unavailable` when an adapter is named and none fits.
pub fn renderer(config: &Config) -> Result<Arc<dyn Renderer>> {
    let (renderer, _adapters) = select(&config.renderer())?;
    Ok(renderer)
}

/// What answers for scenes that lie in files; opens library and bundle only where texts are asked.
///
/// # Errors
/// `model_unavailable`, `gpu_unavailable`.
pub fn offline(config: &Config, texts: bool) -> Result<OfflineService> {
    let (mut networks, mut words): (Arc<dyn SemanticNetworks>, _) =
        (Arc::new(NoSemantics), Vec::new());
    if texts {
        let engine = Pipeline::open(&config.networks())?;
        words = engine.bundle().words()?;
        networks = Arc::new(PipelineNetworks(Arc::new(engine.into())));
    }
    Ok(OfflineService::new(networks, renderer(config)?, &words, config.limits.clone()))
}

/// The description of a bundle for callers.
///
/// # Errors
/// `model_unavailable` when its file of words cannot be read.
pub fn models_info(bundle: &Bundle, execution_provider: &str) -> Result<ModelsInfo> {
    let geometry = bundle.geometry();
    let models = bundle.files().into_iter().map(|entry| {
        let (views_max, sizes) = match entry.part {
            part if part.starts_with("geometry") => (geometry.views_max, geometry.buckets.clone()),
            "masks.encoder" => (1, bundle.masks().map(|m| [m.size; 2]).into_iter().collect()),
            "image_text.image" => {
                (1, bundle.image_text().map(|m| [m.image.size; 2]).into_iter().collect())
            }
            "text_masks.image" => {
                (1, bundle.text_masks().map(|m| [m.size; 2]).into_iter().collect())
            }
            "cameras" => (bundle.cameras().map_or(0, |m| m.views_max), Vec::new()),
            _ => (0, Vec::new()),
        };
        ModelInfo {
            name: entry.part.to_owned(),
            file: entry.file.to_owned(),
            sha256: entry.sha256.to_owned(),
            size_bytes: bundle.size_bytes(entry.file),
            licence: entry.licence.to_owned(),
            views_max,
            sizes,
        }
    });
    Ok(ModelsInfo {
        bundle: bundle.name().to_owned(),
        bundle_sha256: bundle.sha256().to_owned(),
        models: models.collect(),
        words: bundle.words()?,
        execution_provider: execution_provider.to_owned(),
        ..ModelsInfo::default()
    })
}
