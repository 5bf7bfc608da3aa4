//! Views: request to camera to frame to file, one render a camera, bounded in time and number.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use futures_util::{Stream, StreamExt, stream};
use sha2::{Digest, Sha256};
use tokio::sync::mpsc;
use tracing::Instrument;

use super::{
    Inner, Service,
    asker::{Asked, Asker, SeenView},
    camera,
    encode::{self, Layer},
    schedule::Slot,
    semantics::{Understood, meaning_tag},
    texts,
    types::{Ask, CameraSpec, Format, Kind, RenderedView, ViewOptions, ViewSpec, ViewsSpec},
};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
    render::{Frame, Kinds, Labels, Quality, RenderRequest, Renderer, compose},
    scene::{Camera, Intrinsics, Region, Scene, SceneCamera, SceneId, SceneState, Semantics},
    semantics::{Scorer, mask_from_blend},
    store::Record,
    telemetry::meter,
};

/// Near plane where none is asked for, as a share of the scene's median depth.
const NEAR_SHARE: f64 = 0.01;
/// Near planes accepted, world units.
const NEAR_RANGE: [f32; 2] = [1e-9, 1e9];
/// Pictures of a `views` request that wait for the caller to take them.
const READY_MAX: usize = 2;

/// A request with nothing left open: equal ones give equal pictures.
#[derive(Clone, Debug)]
pub(super) struct Resolved {
    camera_index: usize,
    camera: Camera,
    kinds: Vec<Kind>,
    format: Format,
    background: Option<[f32; 3]>,
    antialiased: bool,
    near: f32,
    crop: Option<Region>,
    quality: Quality,
}

/// What the text kinds of a view are answered from.
pub(super) struct Told<'a> {
    asker: &'a Asker,
    scorer: Arc<Scorer>,
    /// What the kinds that take a text were asked.
    text: Option<Asked>,
    /// Tells scene and semantics.
    tag: String,
}

impl<'a> Told<'a> {
    pub(super) fn new(
        asker: &'a Asker,
        semantics: &Semantics,
        tag: String,
        ask: &Ask,
    ) -> Result<Self> {
        let scorer = asker.scorer(&tag, semantics, ask.profile)?;
        let text = asker.ask(&scorer, ask.text.as_slice())?.pop();
        Ok(Self { asker, scorer, text, tag })
    }

    fn text(&self) -> Result<&Asked> {
        self.text.as_ref().ok_or_else(|| Error::internal("a text kind without a text"))
    }
}

/// What a view's text kinds are read from.
enum Source {
    /// Entries, which answer every text.
    Seen(Arc<SeenView>),
    /// A blend that answers this one.
    Blend(Vec<[f32; 4]>),
}

impl Resolved {
    pub(super) fn camera(&self) -> Camera {
        self.camera
    }

    /// The camera of the picture that comes out.
    fn seen(&self) -> Camera {
        let whole = self.camera.intrinsics;
        let intrinsics = self.crop.map_or(whole, |crop| whole.part(crop));
        Camera { intrinsics, ..self.camera }
    }

    /// Pixels of the picture that comes out.
    pub(super) fn pixels(&self) -> u64 {
        let Intrinsics { width, height, .. } = self.seen().intrinsics;
        u64::from(width) * u64::from(height)
    }

    /// Tells E of this view from that of any other; its pixels do not depend on the background.
    pub(super) fn seen_key(&self, tag: &str, renderer: &str) -> String {
        let Self { camera, antialiased, near, crop, quality, .. } = self;
        format!("{tag} {renderer} {camera:?} {antialiased} {near:?} {crop:?} {quality:?}")
    }

    /// A request of these pictures without labels.
    pub(super) fn labels_request(&self, kinds: Kinds) -> RenderRequest {
        RenderRequest {
            camera: self.camera,
            crop: self.crop,
            kinds,
            labels: Labels::None,
            background: self.background.unwrap_or_default(),
            antialiased: self.antialiased,
            near: self.near,
            quality: self.quality,
        }
    }

    fn kinds(&self) -> Kinds {
        let has = |kind| self.kinds.contains(&kind);
        Kinds { color: has(Kind::Color), depth: has(Kind::Depth), alpha: has(Kind::Alpha) }
    }

    /// Hash of scene, renderer and request for one kind; `asked` tells what was asked by text.
    fn etag(&self, scene: &str, renderer: &str, kind: Kind, asked: &str) -> String {
        let Self { camera, format, background, antialiased, near, crop, quality, .. } = self;
        let version = env!("CARGO_PKG_VERSION");
        // Debug prints floats so that they read back the same.
        let words = format!(
            "{scene} {version} {renderer} {camera:?} {kind:?} {format:?} {background:?} \
             {antialiased} {near:?} {crop:?} {quality:?} {asked}"
        );
        Sha256::digest(words)[..16].iter().map(|byte| format!("{byte:02x}")).collect()
    }

    /// One drawing for the pixel kinds and, where they are not known any more, for the labels.
    fn drawn(
        &self,
        renderer: &dyn Renderer,
        scene: &Scene,
        told: Option<&Told<'_>>,
    ) -> Result<(Frame, Option<Source>)> {
        let mut request = self.labels_request(self.kinds());
        let mut known = None;
        if let Some(told) = told {
            let key = self.seen_key(&told.tag, &renderer.name());
            known = told.asker.known_view(&key).map(Source::Seen);
            if known.is_none() {
                request.labels = self.labels(told);
            }
        }
        let nothing = request.kinds == Kinds::NONE && request.labels == Labels::None;
        if let (true, Some(Source::Seen(seen))) = (nothing, &known) {
            let frame = Frame { width: seen.width, height: seen.height, ..Frame::default() };
            return Ok((frame, known));
        }
        let mut frame =
            compose::render_scene(renderer, scene, &request, self.background.is_none())?;
        if let (Some(told), Some(entries)) = (told, frame.entries.take()) {
            let key = self.seen_key(&told.tag, &renderer.name());
            known =
                Some(Source::Seen(told.asker.keep_view(key, frame.width, frame.height, entries)));
        } else if let Some(blend) = frame.blend.take() {
            known = Some(Source::Blend(blend));
        }
        Ok((frame, known))
    }

    /// A mask alone is the blend of a few numbers; all else needs E.
    fn labels(&self, told: &Told<'_>) -> Labels {
        let mask_alone =
            self.kinds.iter().all(|kind| !kind.needs_semantics() || *kind == Kind::Mask);
        let tables = told.text.as_ref().map(|text| text.scores.tables()).unwrap_or_default();
        match <[_; 1]>::try_from(tables) {
            Ok([table]) if mask_alone => Labels::Blend(table),
            _ => Labels::Entries,
        }
    }

    /// The pictures of all kinds; `scene_tag` tells the scene in their tags. Calls `drawn` when
    /// only the encoding is left to do.
    fn draw(
        &self,
        renderer: &dyn Renderer,
        scene: &Scene,
        scene_tag: &str,
        told: Option<&Told<'_>>,
        asked: &str,
        drawn: impl FnOnce(),
    ) -> Result<Vec<RenderedView>> {
        let started = Instant::now();
        let (frame, source) = self.drawn(renderer, scene, told)?;
        drawn();
        let render_ms = started.elapsed().as_secs_f64() * 1e3;
        meter::stage("render", render_ms / 1e3);
        let name = renderer.name();
        let view = |&kind: &Kind| -> Result<RenderedView> {
            let encoding = Instant::now();
            let (bytes, depth_scale) = match (kind.needs_semantics(), told, &source) {
                (true, Some(told), Some(source)) => {
                    (self.answer(kind, told, source, &frame)?, None)
                }
                _ => {
                    let encoded = encode::encode(&frame, kind, self.format)?;
                    (encoded.bytes, encoded.depth_scale)
                }
            };
            let encode_ms = encoding.elapsed().as_secs_f64() * 1e3;
            meter::stage("encode", encode_ms / 1e3);
            let asked = if kind.needs_semantics() { asked } else { "" };
            Ok(RenderedView {
                camera_index: self.camera_index,
                kind,
                format: self.format,
                width: frame.width,
                height: frame.height,
                bytes,
                depth_scale,
                camera: self.seen(),
                etag: self.etag(scene_tag, &name, kind, asked),
                stats: frame.stats,
                render_ms,
                encode_ms,
            })
        };
        self.kinds.iter().map(view).collect()
    }

    fn answer(
        &self,
        kind: Kind,
        told: &Told<'_>,
        source: &Source,
        frame: &Frame,
    ) -> Result<Vec<u8>> {
        let file = |layer| encode::layer(layer, frame.width, frame.height, self.format);
        match (kind, source) {
            (Kind::Mask, Source::Blend(blend)) => {
                file(Layer::Mask(&mask_from_blend(&[blend.as_slice()], told.scorer.scoring())))
            }
            (Kind::Mask, Source::Seen(seen)) => {
                file(Layer::Mask(&told.scorer.mask(&told.text()?.scores, seen.entries())?))
            }
            (Kind::Relevancy, Source::Seen(seen)) => {
                file(Layer::Relevancy(&seen.relevancy(&told.scorer, &told.text()?.scores)?))
            }
            (Kind::Semantics, Source::Seen(seen)) => {
                file(Layer::Entries(&seen.strongest(&told.scorer)))
            }
            _ => Err(Error::internal(format!("kind={} was not drawn", kind.name()))),
        }
    }
}

/// Refuses a part of a picture where the whole view is what is asked about.
pub(super) fn refuse_crop(options: &ViewOptions, call: &str) -> Result<()> {
    match options.crop {
        None => Ok(()),
        Some(_) => Err(Error::invalid(format!("crop goes with views, not with {call}"))),
    }
}

/// What tells one scene from any other, in tags.
pub(super) fn scene_tag(record: &Record) -> String {
    format!("{} {}", record.scene_sha256.as_deref().unwrap_or_default(), record.status.id)
}

/// Cameras and median depth of a record, as [`resolve`] takes them.
pub(super) fn resolve_for(
    inner: &Inner,
    record: &Record,
    cameras: &[CameraSpec],
    kinds: &[Kind],
    options: &ViewOptions,
) -> Result<Vec<Resolved>> {
    let depth = record.status.report.as_ref().map_or(0.0, |report| report.median_depth);
    resolve(&inner.limits(), &record.status.cameras, depth, cameras, kinds, options)
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
        let camera = camera::resolve(spec, options, inputs, limits, &what)?;
        let Intrinsics { width, height, .. } = camera.intrinsics;
        Ok(Resolved {
            camera_index,
            camera,
            kinds: kinds.to_vec(),
            format: options.format,
            background: options.background,
            antialiased: options.antialiased,
            near,
            crop: options.crop.map(|crop| crop.inside(width, height, &what)).transpose()?,
            quality: options.quality,
        })
    };
    cameras.iter().enumerate().map(resolved).collect()
}

/// One camera of a scene that is not in the service's store.
pub(super) fn resolve_one(
    scene: &Scene,
    camera: CameraSpec,
    kind: Kind,
    options: &ViewOptions,
    limits: &Limits,
) -> Result<Resolved> {
    let meta = &scene.meta;
    let depth = meta.report.median_depth;
    let mut all = resolve(limits, &meta.cameras, depth, &[camera], &[kind], options)?;
    all.pop().ok_or_else(|| Error::internal("one camera gave no request"))
}

impl Resolved {
    /// The first picture, of a scene that is not in the service's store.
    pub(super) fn draw_one(
        &self,
        renderer: &dyn Renderer,
        scene: &Scene,
        told: Option<&Told<'_>>,
    ) -> Result<RenderedView> {
        let mut views = self.draw(renderer, scene, scene.meta.id.as_str(), told, "", || ())?;
        views.pop().ok_or_else(|| Error::internal("a render gave no picture"))
    }
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
        let started = Instant::now();
        let scene = self.store.scene(id);
        meter::stage("load", started.elapsed().as_secs_f64());
        scene.inspect_err(|error| {
            if error.code() == ErrorCode::SceneCorrupt {
                self.jobs.spoil(id, error);
            }
        })
    }

    /// What the text kinds of a request need, `None` where it has none of them.
    async fn about(
        self: &Arc<Self>,
        id: &SceneId,
        kinds: &[Kind],
        ask: Ask,
    ) -> Result<Option<Arc<About>>> {
        let Some(kind) = kinds.iter().find(|kind| kind.needs_semantics()) else { return Ok(None) };
        let what = format!("kind={}", kind.name());
        let understood = self.understood(id, &what, ask.wait).await?;
        Ok(Some(Arc::new(About { understood, ask })))
    }

    /// Checks what a request asks by text, the bundle first: without networks no text is any good.
    fn checked_ask(&self, kinds: &[Kind], ask: &Ask) -> Result<Ask> {
        if let Some(kind) = kinds.iter().find(|kind| kind.needs_semantics()) {
            self.can_understand(&format!("kind={}", kind.name()))?;
        }
        texts::check_ask(kinds, ask, &self.limits())
    }

    /// Renders on a blocking thread within the deadline; encodes each kind.
    async fn render_one(
        self: &Arc<Self>,
        record: Arc<Record>,
        resolved: Resolved,
        about: Option<Arc<About>>,
        deadline: Instant,
    ) -> Result<Vec<RenderedView>> {
        let inner = Arc::clone(self);
        let pixels = resolved.pixels();
        let work = move |slot: &mut Slot| {
            let drawn = || slot.drawn();
            let Some(about) = about else {
                let scene = inner.load(&record.status.id)?;
                let tag = scene_tag(&record);
                return resolved.draw(&*inner.renderer, &scene, &tag, None, "", drawn);
            };
            let Understood { scene, semantics, .. } = &about.understood;
            let tag = about.understood.tag();
            let asked = asked_words(&tag, &about.ask);
            let told = Told::new(&inner.asker, semantics, tag, &about.ask)?;
            let tag = scene_tag(&record);
            resolved.draw(&*inner.renderer, scene, &tag, Some(&told), &asked, drawn)
        };
        self.scheduled(deadline, pixels, "the view", work).await
    }

    /// Does work on a blocking thread as soon as the scheduler starts it, within the deadline.
    /// `pixels` are those of the view that it draws.
    pub(super) async fn scheduled<T: Send + 'static>(
        &self,
        deadline: Instant,
        pixels: u64,
        what: &str,
        work: impl FnOnce(&mut Slot) -> Result<T> + Send + 'static,
    ) -> Result<T> {
        let started = Instant::now();
        let limits = self.limits();
        let work = async {
            let mut slot = self.scheduler.enter(pixels, &limits).await?;
            meter::stage("queue", started.elapsed().as_secs_f64());
            let span = tracing::Span::current();
            tokio::task::spawn_blocking(move || span.in_scope(|| work(&mut slot)))
                .await
                .map_err(|e| Error::internal("the work was broken off").caused_by(e))?
        };
        let late = || {
            let ms = started.elapsed().as_millis();
            Error::new(ErrorCode::DeadlineExceeded, format!("{what} was not ready after {ms} ms"))
        };
        if deadline <= started {
            return Err(late());
        }
        tokio::time::timeout_at(deadline.into(), work).await.map_err(|_elapsed| late())?
    }

    pub(super) fn deadline(&self, options: &ViewOptions) -> Instant {
        let most = Duration::from_millis(self.limits().render_timeout_ms);
        Instant::now() + options.deadline.map_or(most, |asked| asked.min(most))
    }
}

/// What text kinds of one request are answered from.
struct About {
    understood: Understood,
    ask: Ask,
}

/// What was asked by text, in tags.
fn asked_words(tag: &str, ask: &Ask) -> String {
    format!("{tag} {:?} {:?}", ask.text, ask.profile)
}

impl Service {
    /// The tag that [`Self::render`] would answer with, without rendering; `None` where it needs
    /// semantics that are not made yet.
    ///
    /// # Errors
    /// As [`Self::render`], but for what only rendering meets.
    pub async fn view_etag(&self, id: &SceneId, spec: &ViewSpec) -> Result<Option<String>> {
        self.sees(id).await?;
        let inner = &self.inner;
        let ask = inner.checked_ask(&[spec.kind], &spec.ask)?;
        let record = inner.finished(id)?;
        let resolved = resolve_for(inner, &record, &[spec.camera], &[spec.kind], &spec.options)?;
        let asked = match (spec.kind.needs_semantics(), &record.semantics_sha256) {
            (false, _) => String::new(),
            (true, Some(_)) => asked_words(&meaning_tag(&record), &ask),
            (true, None) => return Ok(None),
        };
        let name = inner.renderer.name();
        Ok(Some(resolved[0].etag(&scene_tag(&record), &name, spec.kind, &asked)))
    }

    /// Renders and encodes one view.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready`, `scene_corrupt`, `invalid_request`,
    /// `limit_exceeded`, `overloaded`, `deadline_exceeded`, `gpu_unavailable`; for kinds that need
    /// semantics also what [`Service::query`] says.
    pub async fn render(&self, id: &SceneId, spec: ViewSpec) -> Result<RenderedView> {
        self.sees(id).await?;
        let inner = &self.inner;
        let kinds = [spec.kind];
        let ask = inner.checked_ask(&kinds, &spec.ask)?;
        let record = Arc::new(inner.finished(id)?);
        let mut resolved = resolve_for(inner, &record, &[spec.camera], &kinds, &spec.options)?;
        let about = inner.about(id, &kinds, ask).await?;
        let deadline = inner.deadline(&spec.options);
        let one = resolved.remove(0);
        inner
            .render_one(record, one, about, deadline)
            .await?
            .pop()
            .ok_or_else(|| Error::internal("a render gave no picture"))
    }

    /// Renders many cameras, each once for all kinds; pictures come camera by camera.
    ///
    /// The request as a whole is checked before the first picture; a later fault ends the stream.
    /// Each camera has `limits.render_timeout_ms`; all together have `limits.views_timeout_ms`,
    /// less where the caller's deadline is nearer, and `limits.views_pixels_max` pixels.
    ///
    /// # Errors
    /// As [`Self::render`].
    pub async fn render_many(
        &self,
        id: &SceneId,
        spec: &ViewsSpec,
    ) -> Result<impl Stream<Item = Result<RenderedView>> + Send + use<>> {
        self.sees(id).await?;
        let inner = Arc::clone(&self.inner);
        let limits = &inner.limits();
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
        let ask = inner.checked_ask(&kinds, &spec.ask)?;
        if kinds.iter().any(|kind| kind.needs_semantics()) {
            Inner::may_be_asked(&record, "views")?;
        }
        let all = resolve_for(&inner, &record, &spec.cameras, &kinds, &spec.options)?;
        let pixels: u64 = all.iter().map(Resolved::pixels).sum::<u64>() * kinds.len() as u64;
        if pixels > limits.views_pixels_max {
            let (cameras, kinds) = (all.len(), kinds.len());
            let what = format!("views: {cameras} cameras, {kinds} kinds");
            let max = limits.views_pixels_max;
            return Err(Error::limit(what, format!("{pixels} px"), format!("{max} px")));
        }
        let most = Duration::from_millis(limits.views_timeout_ms);
        let last = Instant::now() + spec.options.deadline.map_or(most, |asked| asked.min(most));
        let at_once = self.inner.scheduler.views_at_once(pixels / (all.len() * kinds.len()) as u64);
        let (to, pictures) = mpsc::channel(READY_MAX);
        let id = id.clone();
        let task = async move {
            let about = match inner.about(&id, &kinds, ask).await {
                Ok(about) => about,
                Err(error) => {
                    // Whoever stopped listening needs no reason.
                    let _ = to.send(Err(error)).await;
                    return;
                }
            };
            // Each on a task of its own: a slot must not wait for a slow reader.
            let render = |one: Resolved| {
                let deadline = last.min(inner.deadline(&ViewOptions::default()));
                let (inner, record) = (Arc::clone(&inner), Arc::clone(&record));
                let about = about.clone();
                let work = async move { inner.render_one(record, one, about, deadline).await };
                tokio::spawn(work.in_current_span())
            };
            let mut rendered = stream::iter(all).map(render).buffered(at_once);
            while let Some(views) = rendered.next().await {
                let lost = |e| Err(Error::internal("a view was broken off").caused_by(e));
                let views = match views.unwrap_or_else(lost) {
                    Ok(views) => views,
                    Err(error) => {
                        let _ = to.send(Err(error)).await;
                        return;
                    }
                };
                for view in views {
                    // Whoever stopped listening wants no more.
                    if to.send(Ok(view)).await.is_err() {
                        return;
                    }
                }
            }
        };
        tokio::spawn(task);
        Ok(tokio_stream::wrappers::ReceiverStream::new(pictures))
    }
}
