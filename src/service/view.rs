//! Views: request to camera to frame to file, one render a camera, bounded in time and number.

use std::{sync::Arc, time::Instant};

use futures_util::Stream;
use sha2::{Digest, Sha256};
use tokio::sync::mpsc;

use super::{
    Inner, Service, camera, encode,
    types::{CameraSpec, Format, Kind, RenderedView, ViewOptions, ViewSpec, ViewsSpec},
};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
    render::{Kinds, Labels, RenderRequest, Renderer, compose},
    scene::{Camera, Scene, SceneCamera, SceneId, SceneState},
    store::Record,
};

/// Near plane where none is asked for, as a share of the scene's median depth.
const NEAR_SHARE: f64 = 0.01;
/// Near planes accepted, world units.
const NEAR_RANGE: [f32; 2] = [1e-9, 1e9];
/// Pictures of a `views` request that wait for the caller to take them.
const READY_MAX: usize = 2;

/// A request with nothing left open: equal ones give equal pictures.
#[derive(Clone, Debug)]
struct Resolved {
    camera_index: usize,
    camera: Camera,
    kinds: Vec<Kind>,
    format: Format,
    background: Option<[f32; 3]>,
    antialiased: bool,
    near: f32,
}

impl Resolved {
    fn request(&self) -> RenderRequest {
        let has = |kind| self.kinds.contains(&kind);
        RenderRequest {
            camera: self.camera,
            kinds: Kinds {
                color: has(Kind::Color),
                depth: has(Kind::Depth),
                alpha: has(Kind::Alpha),
            },
            labels: Labels::None,
            background: self.background.unwrap_or_default(),
            antialiased: self.antialiased,
            near: self.near,
        }
    }

    /// Hash of scene, renderer and request for one kind.
    fn etag(&self, scene: &str, renderer: &str, kind: Kind) -> String {
        let Self { camera, format, background, antialiased, near, .. } = self;
        let version = env!("CARGO_PKG_VERSION");
        // Debug prints floats so that they read back the same.
        let words = format!(
            "{scene} {version} {renderer} {camera:?} {kind:?} {format:?} {background:?} \
             {antialiased} {near:?}"
        );
        Sha256::digest(words)[..16].iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// The pictures of all kinds; `scene_tag` tells the scene in their tags.
    fn draw(
        &self,
        renderer: &dyn Renderer,
        scene: &Scene,
        scene_tag: &str,
    ) -> Result<Vec<RenderedView>> {
        let started = Instant::now();
        let frame =
            compose::render_scene(renderer, scene, &self.request(), self.background.is_none())?;
        let render_ms = started.elapsed().as_secs_f64() * 1e3;
        let name = renderer.name();
        let view = |&kind: &Kind| -> Result<RenderedView> {
            let encoded = encode::encode(&frame, kind, self.format)?;
            Ok(RenderedView {
                camera_index: self.camera_index,
                kind,
                format: self.format,
                width: frame.width,
                height: frame.height,
                bytes: encoded.bytes,
                depth_scale: encoded.depth_scale,
                camera: self.camera,
                etag: self.etag(scene_tag, &name, kind),
                stats: frame.stats,
                render_ms,
            })
        };
        self.kinds.iter().map(view).collect()
    }
}

/// What tells one scene from any other, in tags.
fn scene_tag(record: &Record) -> String {
    format!("{} {}", record.scene_sha256.as_deref().unwrap_or_default(), record.status.id)
}

/// Cameras and median depth of a record, as [`resolve`] takes them.
fn resolve_for(
    inner: &Inner,
    record: &Record,
    cameras: &[CameraSpec],
    kinds: &[Kind],
    options: &ViewOptions,
) -> Result<Vec<Resolved>> {
    let depth = record.status.report.as_ref().map_or(0.0, |report| report.median_depth);
    resolve(&inner.config.limits, &record.status.cameras, depth, cameras, kinds, options)
}

fn resolve(
    limits: &Limits,
    inputs: &[SceneCamera],
    median_depth: f64,
    cameras: &[CameraSpec],
    kinds: &[Kind],
    options: &ViewOptions,
) -> Result<Vec<Resolved>> {
    for kind in kinds {
        encode::check(*kind, options.format)?;
    }
    if let Some(bad) = options.background.iter().flatten().find(|v| !(0.0..=1.0).contains(*v)) {
        return Err(Error::invalid(format!("background has {bad}; its values must be 0 to 1")));
    }
    let near = match options.near {
        Some(near) if (NEAR_RANGE[0]..=NEAR_RANGE[1]).contains(&near) => near,
        Some(near) => {
            let [least, most] = NEAR_RANGE;
            return Err(Error::invalid(format!("near is {near}; it must be {least} to {most}")));
        }
        None => default_near(median_depth),
    };
    let resolved = |(camera_index, spec)| {
        let what = match cameras.len() {
            1 => "camera".to_owned(),
            _ => format!("camera {camera_index}"),
        };
        Ok(Resolved {
            camera_index,
            camera: camera::resolve(spec, options, inputs, limits, &what)?,
            kinds: kinds.to_vec(),
            format: options.format,
            background: options.background,
            antialiased: options.antialiased,
            near,
        })
    };
    cameras.iter().enumerate().map(resolved).collect()
}

/// Renders and encodes one view of a scene that is not in the service's store.
///
/// # Errors
/// As [`Service::render`].
pub fn render_scene(
    renderer: &dyn Renderer,
    scene: &Scene,
    spec: &ViewSpec,
    limits: &Limits,
) -> Result<RenderedView> {
    let meta = &scene.meta;
    let depth = meta.report.median_depth;
    let (cameras, kinds) = ([spec.camera], [spec.kind]);
    let resolved = resolve(limits, &meta.cameras, depth, &cameras, &kinds, &spec.options)?;
    let one = resolved.first().ok_or_else(|| Error::internal("one camera gave no request"))?;
    let mut views = one.draw(renderer, scene, meta.id.as_str())?;
    views.pop().ok_or_else(|| Error::internal("a render gave no picture"))
}

/// The near plane of a scene whose median depth is `median_depth`, world units.
#[must_use]
pub fn default_near(median_depth: f64) -> f32 {
    #[expect(clippy::cast_possible_truncation, reason = "clamped to the range accepted")]
    let near = (median_depth * NEAR_SHARE) as f32;
    if near.is_finite() && near > 0.0 { near.clamp(NEAR_RANGE[0], NEAR_RANGE[1]) } else { 0.01 }
}

impl Inner {
    /// The record of a scene that can be rendered.
    pub(super) fn finished(&self, id: &SceneId) -> Result<Record> {
        let record = self.jobs.record(id)?;
        let not_ready = |why: String| Err(Error::new(ErrorCode::SceneNotReady, why));
        match (record.status.state, &record.status.error) {
            (SceneState::Done, _) => Ok(record),
            (_, Some(error)) if error.to_error().code() == ErrorCode::SceneCorrupt => {
                Err(error.to_error())
            }
            (SceneState::Failed, Some(error)) => {
                not_ready(format!("scene {id} failed with {}: {}", error.code, error.message))
            }
            (state, _) => not_ready(format!("scene {id} is {}", state.name())),
        }
    }

    /// The scene itself; marks it when its file turns out to be bad. Blocks on the disk.
    pub(super) fn load(&self, id: &SceneId) -> Result<Arc<Scene>> {
        self.store.scene(id).inspect_err(|error| {
            if error.code() == ErrorCode::SceneCorrupt {
                self.jobs.spoil(id, error);
            }
        })
    }

    /// Renders on a blocking thread within the deadline; encodes each kind.
    async fn render_one(
        self: &Arc<Self>,
        record: Arc<Record>,
        resolved: Resolved,
        deadline: Instant,
    ) -> Result<Vec<RenderedView>> {
        let started = Instant::now();
        let work = async {
            let pass = self.gate.enter().await?;
            let inner = Arc::clone(self);
            tokio::task::spawn_blocking(move || {
                let _pass = pass;
                let scene = inner.load(&record.status.id)?;
                resolved.draw(&*inner.renderer, &scene, &scene_tag(&record))
            })
            .await
            .map_err(|e| Error::internal("the render was broken off").caused_by(e))?
        };
        let late = || {
            let ms = started.elapsed().as_millis();
            Error::new(ErrorCode::DeadlineExceeded, format!("the view was not ready after {ms} ms"))
        };
        if deadline <= started {
            return Err(late());
        }
        tokio::time::timeout_at(deadline.into(), work).await.map_err(|_elapsed| late())?
    }

    fn deadline(&self, options: &ViewOptions) -> Instant {
        let most = std::time::Duration::from_millis(self.config.limits.render_timeout_ms);
        Instant::now() + options.deadline.map_or(most, |asked| asked.min(most))
    }
}

impl Service {
    /// The tag that [`Self::render`] would answer with, without rendering.
    ///
    /// # Errors
    /// As [`Self::render`], but for what only rendering meets.
    pub fn view_etag(&self, id: &SceneId, spec: &ViewSpec) -> Result<String> {
        let record = self.inner.finished(id)?;
        let resolved =
            resolve_for(&self.inner, &record, &[spec.camera], &[spec.kind], &spec.options)?;
        Ok(resolved[0].etag(&scene_tag(&record), &self.inner.renderer.name(), spec.kind))
    }

    /// Renders and encodes one view.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready`, `scene_corrupt`, `invalid_request`,
    /// `limit_exceeded`, `overloaded`, `deadline_exceeded`, `gpu_unavailable`.
    pub async fn render(&self, id: &SceneId, spec: ViewSpec) -> Result<RenderedView> {
        let inner = &self.inner;
        let record = Arc::new(inner.finished(id)?);
        let mut resolved =
            resolve_for(inner, &record, &[spec.camera], &[spec.kind], &spec.options)?;
        let deadline = inner.deadline(&spec.options);
        let one = resolved.remove(0);
        inner
            .render_one(record, one, deadline)
            .await?
            .pop()
            .ok_or_else(|| Error::internal("a render gave no picture"))
    }

    /// Renders many cameras, each once for all kinds; pictures come camera by camera.
    ///
    /// The request as a whole is checked before the first picture; a later fault ends the stream.
    /// Each camera has `limits.render_timeout_ms`; a caller's deadline holds for all together.
    ///
    /// # Errors
    /// As [`Self::render`].
    pub fn render_many(
        &self,
        id: &SceneId,
        spec: &ViewsSpec,
    ) -> Result<impl Stream<Item = Result<RenderedView>> + Send + use<>> {
        let inner = Arc::clone(&self.inner);
        let limits = &inner.config.limits;
        for (what, count, max) in [
            ("cameras", spec.cameras.len(), limits.cameras_max),
            ("kinds", spec.kinds.len(), limits.kinds_max),
        ] {
            if count == 0 {
                return Err(Error::invalid(format!("no {what}; give 1 to {max}")));
            }
            if count > max {
                return Err(Error::limit(what, count, max));
            }
        }
        let record = Arc::new(inner.finished(id)?);
        let mut kinds = spec.kinds.clone();
        let mut seen = std::collections::HashSet::new();
        kinds.retain(|kind| seen.insert(*kind));
        let all = resolve_for(&inner, &record, &spec.cameras, &kinds, &spec.options)?;
        let last = spec.options.deadline.map(|asked| Instant::now() + asked);
        let (to, pictures) = mpsc::channel(READY_MAX);
        let task = async move {
            for one in all {
                let each = inner.deadline(&ViewOptions::default());
                let deadline = last.map_or(each, |last| last.min(each));
                let views = inner.render_one(Arc::clone(&record), one, deadline).await;
                let (views, failed) = match views {
                    Ok(views) => (views.into_iter().map(Ok).collect(), false),
                    Err(error) => (vec![Err(error)], true),
                };
                for view in views {
                    // Whoever stopped listening wants no more.
                    if to.send(view).await.is_err() {
                        return;
                    }
                }
                if failed {
                    return;
                }
            }
        };
        tokio::spawn(task);
        Ok(tokio_stream::wrappers::ReceiverStream::new(pictures))
    }
}
