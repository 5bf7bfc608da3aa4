//! An engine that opens in the background: the bundle's manifest is read at once, so that scenes
//! can be queued and stored ones be seen; hashes, library and network follow on a thread.

use std::{
    sync::{Arc, OnceLock},
    thread::JoinHandle,
    time::Instant,
};

use super::Engine;
use crate::{
    error::{Error, Result},
    models::{Bundle, NetworkOptions},
};

/// An [`Engine`], open or about to be.
#[derive(Debug)]
pub struct LateEngine {
    bundle: Bundle,
    opened: Arc<OnceLock<Result<Engine>>>,
    opening: Option<JoinHandle<()>>,
}

impl LateEngine {
    /// Reads the manifest of the configuration's bundle and has the rest opened by a thread.
    ///
    /// # Errors
    /// `model_unavailable` when there is no bundle or its manifest is malformed.
    pub fn open(options: &NetworkOptions) -> Result<Self> {
        let bundle = Bundle::named(options)?;
        let opened = Arc::<OnceLock<_>>::default();
        let (of_thread, options, named) = (Arc::clone(&opened), options.clone(), bundle.clone());
        let open = move || {
            let begun = Instant::now();
            let engine = Engine::open_bundle(&named, &options);
            if engine.is_ok() {
                let ms = begun.elapsed().as_secs_f64() * 1e3;
                tracing::info!(ms, "the networks are open");
            }
            // This thread alone sets it.
            let _ = of_thread.set(engine);
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

    /// The engine, once it is open: waits for that.
    ///
    /// # Errors
    /// `model_unavailable` when it does not open.
    pub fn get(&self) -> Result<&Engine> {
        told(self.opened.wait())
    }

    /// The engine; `None` while it is being opened.
    #[must_use]
    pub fn peek(&self) -> Option<Result<&Engine>> {
        self.opened.get().map(told)
    }
}

impl From<Engine> for LateEngine {
    fn from(engine: Engine) -> Self {
        let bundle = engine.bundle().clone();
        Self { bundle, opened: Arc::new(OnceLock::from(Ok(engine))), opening: None }
    }
}

impl Drop for LateEngine {
    /// Waits for the thread: the library does not bear the process's end while it opens a network.
    fn drop(&mut self) {
        if let Some(opening) = self.opening.take() {
            // A panic was told by its own message.
            let _ = opening.join();
        }
    }
}

/// An error is kept for everybody who asks, so each gets one of the same words.
fn told(opened: &Result<Engine>) -> Result<&Engine> {
    opened.as_ref().map_err(|error| {
        let again = Error::new(error.code(), error.message());
        match std::error::Error::source(error) {
            Some(cause) => again.caused_by(cause.to_string()),
            None => again,
        }
    })
}
