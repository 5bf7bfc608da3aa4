//! The use cases: create, look up, list, delete, watch, render, export. No transport's words.
//!
//! [`Service`] is a cheap clone; its calls are async and never do heavy work on the async threads.

mod types;

pub use types::{
    CameraSpec, CreateScene, Created, Export, ExportFormat, Format, Kind, LensSpec, ModelInfo,
    ModelsInfo, Page, PageRequest, PoseSpec, Readiness, RenderedView, ViewOptions, ViewSpec,
    ViewsSpec,
};

use std::sync::Arc;

use futures_util::Stream;

use crate::{
    config::Config,
    error::{Error, Result},
    limits::Limits,
    scene::SceneId,
};

pub use crate::scene::{
    Event, SceneCamera, SceneError, SceneOptions, SceneState, SceneStatus, Upload, UploadCameras,
    UploadFile,
};

/// The use cases. Cloning shares everything.
#[derive(Clone, Debug)]
pub struct Service {
    inner: Arc<Inner>,
}

#[derive(Debug)]
struct Inner {
    config: Config,
}

impl Service {
    /// The caps in force.
    #[must_use]
    pub fn limits(&self) -> &Limits {
        &self.inner.config.limits
    }

    /// Takes an upload, makes it safe on disk, queues it, and waits as long as asked.
    ///
    /// # Errors
    /// `invalid_request`, `limit_exceeded`, `overloaded`, `store_unavailable`.
    pub async fn create_scene(&self, request: CreateScene) -> Result<Created> {
        let _ = request;
        unfinished()
    }

    /// Where a scene stands, with its report and cameras once done.
    ///
    /// # Errors
    /// `scene_not_found`.
    pub fn get(&self, id: &SceneId) -> Result<SceneStatus> {
        let _ = id;
        unfinished()
    }

    /// A page of scenes, newest first.
    ///
    /// # Errors
    /// `invalid_request` when `after` is not a `next` of an earlier page.
    pub fn list(&self, page: &PageRequest) -> Result<Page> {
        let _ = page;
        unfinished()
    }

    /// Cancels the scene's job if it has one and removes everything kept of it.
    ///
    /// # Errors
    /// `scene_not_found`, `store_unavailable`.
    pub async fn delete(&self, id: &SceneId) -> Result<()> {
        let _ = id;
        unfinished()
    }

    /// What happens to a scene, from its present state to the last event.
    ///
    /// # Errors
    /// `scene_not_found`.
    pub fn watch(&self, id: &SceneId) -> Result<impl Stream<Item = Event> + Send + use<>> {
        let _ = id;
        unfinished::<futures_util::stream::Empty<Event>>()
    }

    /// The tag that [`Self::render`] would answer with, without rendering.
    ///
    /// # Errors
    /// As [`Self::render`], but for what only rendering meets.
    pub async fn view_etag(&self, id: &SceneId, spec: &ViewSpec) -> Result<String> {
        let _ = (id, spec);
        unfinished()
    }

    /// Renders and encodes one view.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready`, `scene_corrupt`, `invalid_request`,
    /// `limit_exceeded`, `overloaded`, `deadline_exceeded`, `gpu_unavailable`.
    pub async fn render(&self, id: &SceneId, spec: ViewSpec) -> Result<RenderedView> {
        let _ = (id, spec);
        unfinished()
    }

    /// Renders many cameras, each once for all kinds; pictures come camera by camera.
    ///
    /// The request as a whole is checked before the first picture; a later fault ends the stream.
    ///
    /// # Errors
    /// As [`Self::render`].
    pub async fn render_many(
        &self,
        id: &SceneId,
        spec: ViewsSpec,
    ) -> Result<impl Stream<Item = Result<RenderedView>> + Send + use<>> {
        let _ = (id, spec);
        unfinished::<futures_util::stream::Empty<Result<RenderedView>>>()
    }

    /// The scene as a file for other programs.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready`, `scene_corrupt`.
    pub async fn export(&self, id: &SceneId, format: ExportFormat) -> Result<Export> {
        let _ = (id, format);
        unfinished()
    }

    /// What makes and renders the scenes.
    #[must_use]
    pub fn models(&self) -> ModelsInfo {
        ModelsInfo::default()
    }

    /// Whether new work is taken.
    #[must_use]
    pub fn ready(&self) -> Readiness {
        Readiness { ready: false, jobs_queued: 0, jobs_running: 0, renders: 0 }
    }
}

fn unfinished<T>() -> Result<T> {
    Err(Error::internal("this call is not built in yet"))
}
