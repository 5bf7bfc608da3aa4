//! A pipeline that opens in the background. The bundle's manifest is read at once, so that scenes
//! can be queued and stored scenes can be shown. A thread checks the hashes and opens library and
//! network.

use std::{
    sync::{Arc, OnceLock},
    thread::JoinHandle,
    time::Instant,
};

use super::Pipeline;
use crate::{
    error::{Error, Result},
    models::{Bundle, NetworkOptions},
};

/// A [`Pipeline`] that is open or is being opened.
#[derive(Debug)]
pub struct PipelineLoader {
    bundle: Bundle,
    opened: Arc<OnceLock<Result<Pipeline>>>,
    opening: Option<JoinHandle<()>>,
}

impl PipelineLoader {
    /// Reads the manifest of the configuration's bundle. A thread opens the rest.
    ///
    /// # Errors
    /// `model_unavailable` when there is no bundle or its manifest is malformed.
    pub fn open(options: &NetworkOptions) -> Result<Self> {
        let bundle = Bundle::named(options)?;
        let opened = Arc::<OnceLock<_>>::default();
        let (of_thread, options, named) = (Arc::clone(&opened), options.clone(), bundle.clone());
        let open = move || {
            let begun = Instant::now();
            let pipeline = Pipeline::open_bundle(&named, &options);
            if let Ok(pipeline) = &pipeline {
                // Beside the first jobs it would make them wait for seconds.
                if let Err(error) = pipeline.geometry().warm() {
                    tracing::warn!(%error, "the geometry network was not run in every size");
                }
                let ms = begun.elapsed().as_secs_f64() * 1e3;
                tracing::info!(ms, "the networks are open");
            }
            // This thread alone sets it.
            let _ = of_thread.set(pipeline);
        };
        let thread = std::thread::Builder::new().name("networks".to_owned()).spawn(open);
        let opening =
            thread.map_err(|e| Error::internal("no thread to open the networks").caused_by(e))?;
        Ok(Self { bundle, opened, opening: Some(opening) })
    }

    /// The bundle, whose files may not have been checked yet.
    #[must_use]
    pub fn bundle(&self) -> &Bundle {
        &self.bundle
    }

    /// Waits until the pipeline is open.
    ///
    /// # Errors
    /// `model_unavailable` when it does not open.
    pub fn get(&self) -> Result<&Pipeline> {
        shared(self.opened.wait())
    }

    /// The pipeline; `None` while it is being opened.
    #[must_use]
    pub fn peek(&self) -> Option<Result<&Pipeline>> {
        self.opened.get().map(shared)
    }
}

impl From<Pipeline> for PipelineLoader {
    fn from(pipeline: Pipeline) -> Self {
        let bundle = pipeline.bundle().clone();
        Self { bundle, opened: Arc::new(OnceLock::from(Ok(pipeline))), opening: None }
    }
}

impl Drop for PipelineLoader {
    /// Waits for the thread: the library crashes if the process ends while it opens a network.
    fn drop(&mut self) {
        if let Some(opening) = self.opening.take() {
            // A panic has printed its own message.
            let _ = opening.join();
        }
    }
}

/// Each caller gets an error of its own with the same words.
fn shared(opened: &Result<Pipeline>) -> Result<&Pipeline> {
    opened.as_ref().map_err(|error| {
        let again = Error::new(error.code(), error.message());
        match std::error::Error::source(error) {
            Some(cause) => again.caused_by(cause.to_string()),
            None => again,
        }
    })
}
