//! Views: request to camera to frame to file, one render a camera, bounded in time and number.

use std::{
    sync::Arc,
    time::{Duration, Instant},
};

use futures_util::{Stream, StreamExt, stream};
use serde::Serialize;
use sha2::{Digest, Sha256};
use tokio::sync::mpsc;
use tracing::Instrument;

use super::{
    Inner, Service,
    access::SceneAccess,
    camera,
    create::blocking,
    encode::{self, Layer},
    request::{
        BackgroundSpec, CameraSpec, Format, Kind, PictureOptions, ScoringOptions, TextOptions,
        ViewOptions, ViewSpec, ViewsSpec,
    },
    schedule::Slot,
    search::{Backend, LabelledView, SceneTexts, ScoringChoice},
    semantics::{Understood, record_meaning_tag},
    texts,
    times::{ViewTimes, ms, staged},
    types::RenderedView,
};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
    names::{hex, shown},
    render::{
        self, Frame, Kinds, Labels, RenderRequest, Samples,
        plan::{self, NEAR_RANGE, ViewMethod, default_near},
    },
    scene::{Camera, Intrinsics, Method, Preset, Scene, SceneCamera, SceneId},
    store::Record,
    telemetry::meter,
};

/// Pictures of a `views` request that wait for the caller to take them.
const READY_MAX: usize = 2;

/// A request with nothing left open: equal ones give equal pictures.
#[derive(Clone, Debug)]
pub(super) struct Resolved {
    camera_index: usize,
    camera: Camera,
    kinds: Vec<Kind>,
    near: f32,
    method: ViewMethod,
    /// The preset that was named, or that of the scene.
    preset: Preset,
    /// As in the request, with the size, near plane and method that were found.
    options: ViewOptions,
    picture: PictureOptions,
}

impl Resolved {
    pub(super) fn camera(&self) -> Camera {
        self.camera
    }

    /// The camera of the picture that comes out.
    fn seen(&self) -> Camera {
        let whole = self.camera.intrinsics;
        let intrinsics = self.picture.crop.map_or(whole, |crop| whole.part(crop));
        Camera { intrinsics, ..self.camera }
    }

    /// Pixels of the picture that comes out.
    pub(super) fn pixels(&self) -> u64 {
        let Intrinsics { width, height, .. } = self.seen().intrinsics;
        u64::from(width) * u64::from(height)
    }

    /// Tells the labels of this view from those of all others. They do not depend on the
    /// background.
    pub(super) fn labels_key(&self, tag: &str, renderer: &str) -> Result<String> {
        words(&(tag, renderer, self.camera, &self.options, self.picture.crop))
    }

    /// A request of these pictures of the scene, without labels.
    pub(super) fn request(&self, scene: &Scene, kinds: Kinds) -> RenderRequest {
        RenderRequest {
            camera: self.camera,
            crop: self.picture.crop,
            kinds,
            labels: Labels::None,
            background: match self.picture.background {
                BackgroundSpec::Backdrop if !self.method.backdrop => render::Background::BLACK,
                BackgroundSpec::Backdrop => {
                    render::Background::Backdrop(Arc::clone(&scene.backdrop))
                }
                BackgroundSpec::Color(color) => render::Background::Color(color),
            },
            sources: plan::sources(scene, &self.camera, self.method),
            samples: match self.picture.format {
                Format::Npy => Samples::F32,
                Format::Rgba8 => Samples::LevelsRgba,
                Format::Png | Format::Jpeg | Format::Webp | Format::Rgb8 | Format::Grey8 => {
                    Samples::Levels
                }
            },
            antialiased: self.options.antialiased,
            near: self.near,
            quality: self.options.quality,
        }
    }

    fn kinds(&self) -> Kinds {
        let has = |kind| self.kinds.contains(&kind);
        Kinds { color: has(Kind::Color), depth: has(Kind::Depth), alpha: has(Kind::Alpha) }
    }

    /// Hash of scene, renderer and request for one kind; `texts` are the words of [`text_words`].
    fn etag(&self, scene: &str, renderer: &str, kind: Kind, texts: &str) -> Result<String> {
        let version = env!("CARGO_PKG_VERSION");
        let request = (self.camera, kind, &self.options, &self.picture, self.method.backdrop);
        Ok(hash(&words(&(scene, version, renderer, request, texts))?))
    }

    /// One drawing for the pixel kinds and, where they are not known, for the labels; and the
    /// weights where texts need them.
    fn drawn(
        &self,
        backend: &Backend,
        scene: &Scene,
        texts: Option<&SceneTexts<'_>>,
    ) -> Result<(Frame, Option<Arc<LabelledView>>)> {
        let mut request = self.request(scene, self.kinds());
        let draw = |request: &RenderRequest| backend.renderer.render(&scene.gaussians, request);
        let Some(texts) = texts else { return Ok((draw(&request)?, None)) };
        let key = self.labels_key(texts.of.tag, &backend.renderer.name())?;
        if let Some(known) = texts.known_view(&key) {
            let (width, height) = (known.width, known.height);
            let frame = match request.kinds {
                Kinds::NONE => Frame { width, height, ..Frame::default() },
                _ => draw(&request)?,
            };
            return Ok((frame, Some(known)));
        }
        request.labels = self.labels(texts);
        let mut frame = draw(&request)?;
        let size = [frame.width, frame.height];
        let weights = frame.weights.take().map(|weights| texts.keep_view(key, size, weights));
        Ok((frame, weights))
    }

    /// A mask alone is drawn as such; all else needs the weights.
    fn labels(&self, texts: &SceneTexts<'_>) -> Labels {
        let mask_alone =
            self.kinds.iter().all(|kind| !kind.needs_semantics() || *kind == Kind::Mask);
        let tables = texts.texts.first().map(|text| text.scores.tables()).unwrap_or_default();
        match <[_; 1]>::try_from(tables) {
            Ok([table]) if mask_alone && texts.scorer.scoring().is_signed() => {
                let coverage_floor = texts.scorer.scoring().coverage_floor() as f32;
                Labels::Mask { table, coverage_floor }
            }
            _ => Labels::Weights,
        }
    }

    /// The pictures of all kinds; `scene_tag` tells the scene in their tags, `times` has the stages
    /// before. Calls `drawn` when only scores of pixels and the encoding are left to do.
    pub(super) fn draw(
        &self,
        backend: &Backend,
        scene: &Scene,
        scene_tag: &str,
        texts: Option<&SceneTexts<'_>>,
        times: ViewTimes,
        drawn: impl FnOnce(),
    ) -> Result<Vec<RenderedView>> {
        let (frame, render_ms) = staged("render", || self.drawn(backend, scene, texts));
        let (mut frame, weights) = frame?;
        drawn();
        let name = backend.renderer.name();
        let (width, height, format) = (frame.width, frame.height, self.picture.format);
        let view = |&kind: &Kind| -> Result<RenderedView> {
            let mut times = ViewTimes { render_ms, ..times };
            let texts = texts.filter(|_| kind.needs_semantics());
            let scored = match (texts, &weights) {
                (Some(texts), Some(weights)) => {
                    let (scored, ms) = staged("score", || Scored::new(kind, texts, weights));
                    *times.score_ms.get_or_insert_default() += ms;
                    Some(scored?)
                }
                _ => None,
            };
            if texts.is_none() {
                times.score_ms = None;
            }
            let layer = match &scored {
                Some(scored) => scored.layer(),
                None => encode::layer(&mut frame, kind)?,
            };
            let (encoded, ms) = staged("encode", || encode::encode(layer, width, height, format));
            let encoded = encoded?;
            times.encode_ms = ms;
            let texts = texts.map(SceneTexts::words).transpose()?.unwrap_or_default();
            Ok(RenderedView {
                camera_index: self.camera_index,
                kind,
                format,
                width,
                height,
                bytes: encoded.bytes,
                depth_scale: encoded.depth_scale,
                camera: self.seen(),
                etag: self.etag(scene_tag, &name, kind, &texts)?,
                stats: frame.stats,
                times,
            })
        };
        self.kinds.iter().map(view).collect()
    }
}

/// A text that is embedded, and the scene that it asks about.
#[derive(Clone)]
struct Asked {
    understood: Understood,
    ask: TextOptions,
    embed_ms: f64,
}

/// A picture that is computed from the weights of a view.
enum Scored {
    Mask(Vec<bool>),
    Relevancy(Vec<f32>),
    Entries(Vec<u16>),
}

impl Scored {
    fn new(kind: Kind, texts: &SceneTexts<'_>, view: &LabelledView) -> Result<Self> {
        let (scorer, text) = (&texts.scorer, texts.texts.first());
        match (kind, text) {
            (Kind::Mask, Some(text)) => Ok(Self::Mask(scorer.mask(&text.scores, &view.weights)?)),
            (Kind::Relevancy, Some(text)) => {
                Ok(Self::Relevancy(view.relevancy(scorer, &text.scores)?))
            }
            (Kind::Semantics, _) => Ok(Self::Entries(view.strongest(scorer))),
            _ => Err(Error::internal(format!("kind={kind} was not drawn"))),
        }
    }

    fn layer(&self) -> Layer<'_> {
        match self {
            Self::Mask(mask) => Layer::Mask(mask),
            Self::Relevancy(relevancy) => Layer::Share(relevancy.as_slice().into()),
            Self::Entries(entries) => Layer::Entries(entries),
        }
    }
}

/// Values as text: equal text means equal values. Numbers are written to their last bit.
pub(super) fn words(values: &impl Serialize) -> Result<String> {
    serde_json::to_string(values)
        .map_err(|e| Error::internal("a request cannot be written down").caused_by(e))
}

/// 32 hexadecimal digits of the sha256 of a text.
pub(super) fn hash(words: &str) -> String {
    hex(&Sha256::digest(words)[..16])
}

/// Tells a version of a scene from all others, in tags.
pub(super) fn scene_tag(scene: &Scene) -> String {
    tag(&scene.sha256, &scene.meta.id)
}

/// The tag of the version that a record names. Another one may be served a moment later.
pub(super) fn record_tag(record: &Record) -> String {
    tag(record.scene_sha256.as_deref().unwrap_or_default(), &record.status.id)
}

fn tag(sha256: &str, id: &SceneId) -> String {
    format!("{sha256} {id}")
}

/// What views of a scene are resolved against.
#[derive(Clone, Copy)]
pub(super) struct Inputs<'a> {
    cameras: &'a [SceneCamera],
    median_depth: f64,
    /// `None`: that of the default.
    method: Option<&'a Method>,
}

impl<'a> From<&'a Record> for Inputs<'a> {
    fn from(record: &'a Record) -> Self {
        let report = record.status.report.as_ref();
        let median_depth = report.map_or(0.0, |report| report.median_depth);
        let method = report.map(|report| &report.method);
        Self { cameras: &record.status.cameras, median_depth, method }
    }
}

impl<'a> From<&'a Scene> for Inputs<'a> {
    fn from(scene: &'a Scene) -> Self {
        let report = &scene.meta.report;
        let (median_depth, method) = (report.median_depth, Some(&report.method));
        Self { cameras: &scene.meta.cameras, median_depth, method }
    }
}

impl Inputs<'_> {
    /// How a view is drawn: as the scene was made, or by the preset that is named, with the changes
    /// of the request.
    fn look(&self, options: &ViewOptions) -> Result<(ViewMethod, Preset)> {
        let own = self.method.cloned().unwrap_or_default();
        let of = options.preset.map_or(own, Method::of);
        let changed = Method {
            front_photos: options.front_photos.unwrap_or(of.front_photos),
            magnify: options.magnify.unwrap_or(of.magnify),
            ..of
        };
        changed.check()?;
        Ok((ViewMethod::from(&changed), changed.preset))
    }
}

/// The request of one camera and one kind.
pub(super) fn resolve_one<'a>(
    limits: &Limits,
    inputs: impl Into<Inputs<'a>>,
    camera: CameraSpec,
    kind: Kind,
    options: (&ViewOptions, &PictureOptions),
) -> Result<Resolved> {
    let mut all = resolve(limits, inputs.into(), &[camera], &[kind], options)?;
    all.pop().ok_or_else(|| Error::internal("one camera gave no request"))
}

fn resolve(
    limits: &Limits,
    inputs: Inputs<'_>,
    cameras: &[CameraSpec],
    kinds: &[Kind],
    (options, picture): (&ViewOptions, &PictureOptions),
) -> Result<Vec<Resolved>> {
    for kind in kinds {
        encode::check(*kind, picture.format)?;
    }
    let background = picture.background.color();
    if let Some(bad) = background.iter().flatten().find(|v| !(0.0..=1.0).contains(*v)) {
        let bad = shown(f64::from(*bad));
        return Err(Error::invalid(format!("background has {bad}; its values must be 0 to 1")));
    }
    let near = match options.near {
        Some(near) if (NEAR_RANGE[0]..=NEAR_RANGE[1]).contains(&near) => near,
        Some(near) => {
            let [least, most] = NEAR_RANGE;
            let near = shown(f64::from(near));
            return Err(Error::invalid(format!("near is {near}; it must be {least} to {most}")));
        }
        None => default_near(inputs.median_depth),
    };
    let (method, preset) = inputs.look(options)?;
    let resolved = |(camera_index, spec)| {
        let what = match cameras.len() {
            1 => "camera".to_owned(),
            _ => format!("camera {camera_index}"),
        };
        let camera = camera::resolve(spec, options, inputs.cameras, limits, &what)?;
        let Intrinsics { width, height, .. } = camera.intrinsics;
        Ok(Resolved {
            camera_index,
            camera,
            kinds: kinds.to_vec(),
            near,
            method,
            preset,
            options: ViewOptions {
                width: Some(width),
                height: Some(height),
                near: Some(near),
                preset: None,
                front_photos: Some(method.front_photos),
                magnify: Some(method.magnify),
                ..options.clone()
            },
            picture: PictureOptions {
                crop: picture.crop.map(|crop| crop.inside(width, height, &what)).transpose()?,
                ..picture.clone()
            },
        })
    };
    cameras.iter().enumerate().map(resolved).collect()
}

impl Inner {
    /// The scene itself. It is marked as failed when its file is bad. Blocks on the store.
    pub(super) fn load(&self, access: &SceneAccess) -> Result<Arc<Scene>> {
        let (scene, _ms) = staged("load", || self.store.scene(access.id()));
        scene.inspect_err(|error| {
            if error.code() == ErrorCode::SceneCorrupt {
                self.jobs.spoil(access.id(), error);
            }
        })
    }

    /// The scene as the text kinds of a request need it, `None` where it has none of them.
    async fn understood_for(
        self: &Arc<Self>,
        scene: &SceneAccess,
        kinds: &[Kind],
        ask: &TextOptions,
    ) -> Result<Option<Understood>> {
        let Some(kind) = kinds.iter().find(|kind| kind.needs_semantics()) else { return Ok(None) };
        Ok(Some(self.understood(scene, &format!("kind={kind}"), ask.wait).await?))
    }

    /// Checks the text of a request; the bundle first, because no text works without networks.
    fn checked_ask(&self, kinds: &[Kind], ask: &TextOptions) -> Result<TextOptions> {
        if let Some(kind) = kinds.iter().find(|kind| kind.needs_semantics()) {
            self.can_understand(&format!("kind={kind}"))?;
        }
        texts::check_ask(kinds, ask, &self.limits())
    }

    /// Renders on a blocking thread within the deadline; encodes each kind.
    async fn render_one(
        self: &Arc<Self>,
        scene: SceneAccess,
        view: Resolved,
        texts: Option<Asked>,
        deadline: Instant,
    ) -> Result<Vec<RenderedView>> {
        let inner = Arc::clone(self);
        let pixels = view.pixels();
        let work = move |slot: &mut Slot| {
            let backend = &inner.backend;
            let mut times = ViewTimes { queue_ms: slot.queue_ms, ..ViewTimes::default() };
            let drawn = || slot.drawn();
            let Some(Asked { understood, ask, embed_ms }) = texts else {
                let begun = Instant::now();
                let scene = inner.load(&scene)?;
                times.load_ms = ms(begun);
                return view.draw(backend, &scene, &scene_tag(&scene), None, times, drawn);
            };
            let subject = understood.subject();
            let text = ask.text.as_slice();
            let how = (Some(view.preset), &ask.scoring);
            let scored = || SceneTexts::new(backend, subject, how, text);
            let (texts, ms) = staged("score", scored);
            (times.load_ms, times.score_ms) = (understood.load_ms, Some(embed_ms + ms));
            let tag = scene_tag(subject.scene);
            view.draw(backend, subject.scene, &tag, Some(&texts?), times, drawn)
        };
        self.scheduled(deadline, pixels, "the view", work).await
    }

    /// Runs `work` on a blocking thread as soon as the scheduler starts it, within the deadline.
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
            let span = tracing::info_span!("stage", stage = "queue");
            let mut slot = self.scheduler.enter(pixels, &limits).instrument(span).await?;
            blocking(move || {
                slot.queue_ms = ms(started);
                meter::stage("queue", slot.queue_ms / 1e3);
                work(&mut slot)
            })
            .await?
        };
        in_time(deadline, what, work).await
    }

    /// Embeds texts that are not known yet, for no slot may wait for a network. Milliseconds that
    /// it took.
    pub(super) async fn embed(
        self: &Arc<Self>,
        understood: &Understood,
        how: ScoringChoice<'_>,
        texts: &[String],
        deadline: Instant,
    ) -> Result<f64> {
        if self.backend.knows(understood.subject(), how, texts)? {
            return Ok(0.0);
        }
        let (inner, of, texts) = (Arc::clone(self), understood.clone(), texts.to_vec());
        let (preset, changes) = (how.0, how.1.clone());
        let embed = move || {
            SceneTexts::new(&inner.backend, of.subject(), (preset, &changes), &texts).map(drop)
        };
        let embed = async { blocking(|| staged("score", embed)).await };
        let (embedded, ms) = in_time(deadline, "the text", embed).await?;
        embedded.map(|()| ms)
    }

    /// The text of a view, embedded; `None` where the view has none.
    async fn asked(
        self: &Arc<Self>,
        understood: Option<Understood>,
        ask: TextOptions,
        preset: Option<Preset>,
        deadline: Instant,
    ) -> Result<Option<Asked>> {
        let Some(understood) = understood else { return Ok(None) };
        let text = ask.text.as_slice();
        let how = (preset, &ask.scoring);
        let embed_ms = self.embed(&understood, how, text, deadline).await?;
        Ok(Some(Asked { understood, ask, embed_ms }))
    }

    pub(super) fn deadline(&self, options: &ViewOptions) -> Instant {
        until(options.deadline, self.limits().render_timeout_ms)
    }
}

/// What `work` gives within the deadline; `what` names it in the error.
async fn in_time<T>(
    deadline: Instant,
    what: &str,
    work: impl Future<Output = Result<T>>,
) -> Result<T> {
    let started = Instant::now();
    let late = || {
        let ms = started.elapsed().as_millis();
        Error::new(ErrorCode::DeadlineExceeded, format!("{what} was not ready after {ms} ms"))
    };
    if deadline <= started {
        return Err(late());
    }
    tokio::time::timeout_at(deadline.into(), work).await.map_err(|_elapsed| late())?
}

/// The caller's deadline, at most `most_ms` from now.
fn until(deadline: Option<Duration>, most_ms: u64) -> Instant {
    let most = Duration::from_millis(most_ms);
    Instant::now() + deadline.map_or(most, |deadline| deadline.min(most))
}

/// A text of a scene and how it is scored, in tags; `tag` tells scene and semantics.
pub(super) fn text_words(
    tag: &str,
    text: Option<&str>,
    how: (Preset, &ScoringOptions),
) -> Result<String> {
    words(&(tag, text, how))
}

impl Service {
    /// The tag that [`Self::render`] would answer with, without rendering; `None` where it needs
    /// semantics that do not exist yet.
    ///
    /// # Errors
    /// As [`Self::render`], without those of the rendering itself.
    pub async fn view_etag(&self, id: &SceneId, spec: &ViewSpec) -> Result<Option<String>> {
        let (scene, ask, view) = self.checked_view(id, spec).await?;
        let record = scene.record();
        let texts = match (spec.kind.needs_semantics(), &record.semantics_sha256) {
            (false, _) => String::new(),
            (true, Some(_)) => {
                let how = (view.preset, &ask.scoring);
                text_words(&record_meaning_tag(record), ask.text.as_deref(), how)?
            }
            (true, None) => return Ok(None),
        };
        let name = self.inner.backend.renderer.name();
        view.etag(&record_tag(record), &name, spec.kind, &texts).map(Some)
    }

    /// Renders and encodes one view.
    ///
    /// # Errors
    /// `scene_not_found`, `scene_not_ready`, `scene_corrupt`, `invalid_request`,
    /// `limit_exceeded`, `overloaded`, `deadline_exceeded`, `gpu_unavailable`; for kinds that need
    /// semantics also what [`Service::query`] says.
    pub async fn render(&self, id: &SceneId, spec: ViewSpec) -> Result<RenderedView> {
        let (scene, ask, view) = self.checked_view(id, &spec).await?;
        let inner = &self.inner;
        let understood = inner.understood_for(&scene, &[spec.kind], &ask).await?;
        let deadline = inner.deadline(&spec.options);
        let texts = inner.asked(understood, ask, spec.options.preset, deadline).await?;
        let mut views = inner.render_one(scene, view, texts, deadline).await?;
        views.pop().ok_or_else(|| Error::internal("a render gave no picture"))
    }

    /// The scene of a view, its text and its request, all checked.
    async fn checked_view(
        &self,
        id: &SceneId,
        spec: &ViewSpec,
    ) -> Result<(SceneAccess, TextOptions, Resolved)> {
        let scene = self.scene(id).await?;
        let ask = self.inner.checked_ask(&[spec.kind], &spec.text)?;
        let scene = scene.finished()?;
        let options = (&spec.options, &spec.picture);
        let view = resolve_one(&self.limits(), scene.record(), spec.camera, spec.kind, options)?;
        Ok((scene, ask, view))
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
        let scene = self.scene(id).await?;
        let inner = Arc::clone(&self.inner);
        let limits = &inner.limits();
        texts::check_count("cameras", spec.cameras.len(), limits.cameras_max)?;
        texts::check_count("kinds", spec.kinds.len(), limits.kinds_max)?;
        let scene = scene.finished()?;
        let mut kinds = spec.kinds.clone();
        let mut seen = std::collections::HashSet::new();
        kinds.retain(|kind| seen.insert(*kind));
        let ask = inner.checked_ask(&kinds, &spec.text)?;
        if kinds.iter().any(|kind| kind.needs_semantics()) {
            Inner::may_be_asked(scene.record(), "views")?;
        }
        let options = (&spec.options, &spec.picture);
        let all = resolve(limits, scene.record().into(), &spec.cameras, &kinds, options)?;
        let pixels: u64 = all.iter().map(Resolved::pixels).sum::<u64>() * kinds.len() as u64;
        if pixels > limits.views_pixels_max {
            let (cameras, kinds) = (all.len(), kinds.len());
            let what = format!("views: {cameras} cameras, {kinds} kinds");
            let max = limits.views_pixels_max;
            return Err(Error::limit(what, format!("{pixels} px"), format!("{max} px")));
        }
        let last = until(spec.options.deadline, limits.views_timeout_ms);
        let at_once = self.inner.scheduler.views_at_once(pixels / (all.len() * kinds.len()) as u64);
        let preset = spec.options.preset;
        let (to, pictures) = mpsc::channel(READY_MAX);
        let task = async move {
            let views = async {
                let understood = inner.understood_for(&scene, &kinds, &ask).await?;
                let texts = inner.asked(understood, ask, preset, last).await?;
                // Each on a task of its own: a slot must not wait for a slow reader.
                let render = |one: Resolved| {
                    let deadline = last.min(inner.deadline(&ViewOptions::default()));
                    let (inner, scene, texts) = (Arc::clone(&inner), scene.clone(), texts.clone());
                    let views = async move { inner.render_one(scene, one, texts, deadline).await };
                    tokio::spawn(views.in_current_span())
                };
                let mut rendered = stream::iter(all).map(render).buffered(at_once);
                while let Some(views) = rendered.next().await {
                    let lost = |e| Error::internal("a view was broken off").caused_by(e);
                    for view in views.map_err(lost)?? {
                        // The caller stopped listening and wants no more.
                        if to.send(Ok(view)).await.is_err() {
                            return Ok(());
                        }
                    }
                }
                Ok::<(), Error>(())
            };
            if let Err(error) = views.await {
                let _ = to.send(Err(error)).await;
            }
        };
        tokio::spawn(task);
        Ok(tokio_stream::wrappers::ReceiverStream::new(pictures))
    }
}
