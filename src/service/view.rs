//! Views: request to camera to frame to file, one render a camera, bounded in time and number.

use std::{pin::pin, sync::Arc, time::Instant};

use futures_util::{Stream, StreamExt, TryFutureExt, TryStreamExt, stream};
use tokio::sync::mpsc;
use tracing::Instrument;

use super::{
    access::SceneAccess,
    camera,
    encode::{self, Layer},
    memory::Share,
    request::{
        BackgroundSpec, Format, PictureKind, PictureOptions, TextOptions, ViewOptions, ViewSpec,
        ViewsSpec,
    },
    schedule::Demand,
    search::{Backend, LabelledView, SceneTexts, ScoringChoice, SemanticScene},
    shared::{Service, Shared},
    tags::{cache_key, etag, record_semantics_tag, record_tag, scene_tag, text_key},
    tasks::Task,
    texts,
    times::{ViewTimes, ms, staged},
    types::RenderedView,
    work::{Work, until},
};
use crate::{
    error::{Error, Result},
    keys::Caller,
    limits::Limits,
    names::shown,
    render::{
        self, Frame, Kinds, Labels, RenderRequest, Samples,
        budget::{bound, check_error},
        merged::check_detail,
        plan::{self, NEAR_RANGE, ViewMethod, default_near},
    },
    scene::{Camera, Intrinsics, Method, Preset, Scene, SceneCamera, SceneId},
    store::Record,
};

/// Pictures of a `views` request that wait for the caller to take them.
const READY_MAX: usize = 2;

/// A request with nothing left open: equal ones give equal pictures.
#[derive(Clone, Debug)]
pub(super) struct Resolved {
    camera_index: usize,
    camera: Camera,
    kinds: Vec<PictureKind>,
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

    /// Most bytes that its pictures have as files.
    fn bytes_max(&self) -> u64 {
        let of_pixel = if self.picture.format == Format::Npy { 12 } else { 4 };
        self.pixels() * of_pixel * self.kinds.len() as u64
    }

    /// Tells the labels of this view from those of all others. They do not depend on the
    /// background.
    pub(super) fn labels_key(&self, tag: &str, renderer: &str) -> Result<String> {
        cache_key(&(tag, renderer, self.camera, &self.options, self.picture.crop))
    }

    /// A request of these pictures of the scene, without labels.
    pub(super) fn request(&self, scene: &Scene, kinds: Kinds) -> RenderRequest {
        RenderRequest {
            crop: self.picture.crop,
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
            antialiased: self.options.antialiased.unwrap_or(scene.meta.report.antialiased),
            error: self.options.error.0,
            detail: self.options.detail,
            ..RenderRequest::plain(self.camera, kinds, self.near)
        }
    }

    fn kinds(&self) -> Kinds {
        let has = |kind| self.kinds.contains(&kind);
        Kinds {
            color: has(PictureKind::Color),
            depth: has(PictureKind::Depth),
            alpha: has(PictureKind::Alpha) || self.has_holes(),
        }
    }

    /// Whether the scene before its edits is needed.
    fn has_holes(&self) -> bool {
        self.kinds.contains(&PictureKind::Holes)
    }

    /// What edits took of the opacity of this view; `before` is the scene without them.
    fn holes(&self, backend: &Backend, before: &Scene, after: &Frame) -> Result<Layer<'static>> {
        let alpha = Kinds { alpha: true, ..Kinds::NONE };
        let before = backend.renderer.render(&before.gaussians, &self.request(before, alpha))?;
        encode::holes(&before, after)
    }

    /// Hash of scene, renderer and request for one kind; `text` is that of [`text_key`].
    fn etag(&self, scene: &str, renderer: &str, kind: PictureKind, text: &str) -> Result<String> {
        let version = env!("CARGO_PKG_VERSION");
        let request = (self.camera, kind, &self.options, &self.picture, self.method.backdrop);
        Ok(etag(&cache_key(&(scene, version, renderer, request, text))?))
    }

    /// The weights of this view for texts, drawn where they are not known; and whether they are
    /// new.
    pub(super) fn weights(&self, texts: &SceneTexts) -> Result<(Arc<LabelledView>, bool)> {
        let key = self.labels_key(&texts.of.tag, &texts.backend.renderer.name())?;
        texts.view(&self.request(&texts.of.scene, Kinds::NONE), key)
    }

    /// One frame of the pixel kinds and, where they are not known, of the labels; and the weights
    /// where texts need them.
    fn frame(
        &self,
        backend: &Backend,
        scene: &Scene,
        texts: Option<&SceneTexts>,
    ) -> Result<(Frame, Option<Arc<LabelledView>>)> {
        let mut request = self.request(scene, self.kinds());
        let draw = |request: &RenderRequest| backend.renderer.render(&scene.gaussians, request);
        let Some(texts) = texts else { return Ok((draw(&request)?, None)) };
        let key = self.labels_key(&texts.of.tag, &backend.renderer.name())?;
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
    fn labels(&self, texts: &SceneTexts) -> Labels {
        let mask_alone =
            self.kinds.iter().all(|kind| !kind.needs_semantics() || *kind == PictureKind::Mask);
        let tables = texts.texts.first().map(|text| text.scores.tables()).unwrap_or_default();
        match <[_; 1]>::try_from(tables) {
            Ok([table]) if mask_alone && texts.scorer.scoring().is_signed() => {
                let coverage_floor = texts.scorer.scoring().coverage_floor() as f32;
                Labels::Mask { table, coverage_floor }
            }
            _ => Labels::Weights,
        }
    }

    /// The pictures of all kinds; `before` is the scene without its edits, or the same one, and
    /// `times` has the stages before.
    pub(super) fn draw(
        &self,
        backend: &Backend,
        [before, scene]: [&Scene; 2],
        texts: Option<&SceneTexts>,
        times: ViewTimes,
        work: &mut Work,
    ) -> Result<Vec<RenderedView>> {
        let (drawn, render_ms) = staged("render", || {
            let (frame, weights) = self.frame(backend, scene, texts)?;
            let holes = self.has_holes().then(|| self.holes(backend, before, &frame));
            Ok::<_, Error>((frame, weights, holes.transpose()?))
        });
        let (mut frame, weights, mut holes) = drawn?;
        work.leave_renderer();
        let name = backend.renderer.name();
        let (width, height, format) = (frame.width, frame.height, self.picture.format);
        let view = |&kind: &PictureKind| -> Result<RenderedView> {
            work.unless_stopped()?;
            let mut times = ViewTimes { queue_ms: work.queue_ms, render_ms, ..times };
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
            let layer = match (&scored, holes.take_if(|_| kind == PictureKind::Holes)) {
                (Some(scored), _) => scored.layer(),
                (None, Some(holes)) => holes,
                (None, None) => encode::layer(&mut frame, kind)?,
            };
            let (encoded, ms) = staged("encode", || encode::encode(layer, width, height, format));
            let encoded = encoded?;
            times.encode_ms = ms;
            let text = texts.map(SceneTexts::key).transpose()?.unwrap_or_default();
            Ok(RenderedView {
                camera_index: self.camera_index,
                kind,
                format,
                width,
                height,
                bytes: encoded.bytes,
                depth_scale: encoded.depth_scale,
                error: bound(self.options.error.0, self.kinds()),
                detail: self.options.detail,
                camera: self.seen(),
                etag: self.etag(&scene_tag(scene), &name, kind, &text)?,
                stats: frame.stats,
                times,
                held: None,
            })
        };
        self.kinds.iter().map(view).collect()
    }
}

/// A picture that is computed from the weights of a view.
enum Scored {
    Mask(Vec<bool>),
    Relevancy(Vec<f32>),
    Entries(Vec<u16>),
}

impl Scored {
    fn new(kind: PictureKind, texts: &SceneTexts, view: &LabelledView) -> Result<Self> {
        let (scorer, text) = (&texts.scorer, texts.texts.first());
        match (kind, text) {
            (PictureKind::Mask, Some(text)) => {
                Ok(Self::Mask(scorer.mask(&text.scores, &view.weights)?))
            }
            (PictureKind::Relevancy, Some(text)) => {
                Ok(Self::Relevancy(view.relevancy(scorer, &text.scores)?))
            }
            (PictureKind::Semantics, _) => Ok(Self::Entries(view.strongest(scorer))),
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
    fn draw_method(&self, options: &ViewOptions) -> Result<(ViewMethod, Preset)> {
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
    spec: &ViewSpec,
) -> Result<Resolved> {
    let mut all = resolve(limits, inputs, &ViewsSpec::from(spec.clone()))?;
    all.pop().ok_or_else(|| Error::internal("one camera gave no request"))
}

/// The requests of all cameras, each for all kinds.
fn resolve<'a>(
    limits: &Limits,
    inputs: impl Into<Inputs<'a>>,
    spec: &ViewsSpec,
) -> Result<Vec<Resolved>> {
    let inputs = inputs.into();
    let ViewsSpec { cameras, kinds, options, picture, .. } = spec;
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
    check_error(options.error.0)?;
    check_detail(options.detail)?;
    let (method, preset) = inputs.draw_method(options)?;
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
            kinds: kinds.clone(),
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

impl Shared {
    /// Checks the text of a request; the bundle first, because no text works without networks.
    fn checked_ask(&self, kinds: &[PictureKind], ask: &TextOptions) -> Result<TextOptions> {
        if let Some(kind) = kinds.iter().find(|kind| kind.needs_semantics()) {
            self.can_understand(&format!("kind={kind}"))?;
        }
        texts::check_ask(kinds, ask, &self.limits())
    }

    /// The scene as the text kinds of a request need it, `None` where it has none of them.
    async fn semantics_for(
        self: &Arc<Self>,
        scene: &SceneAccess,
        kinds: &[PictureKind],
        ask: &TextOptions,
    ) -> Result<Option<SemanticScene>> {
        let Some(kind) = kinds.iter().find(|kind| kind.needs_semantics()) else { return Ok(None) };
        Ok(Some(self.semantic_scene(scene, &format!("kind={kind}"), ask.wait).await?))
    }

    /// The text of a view, scored; `None` where the view needs no semantics.
    async fn score_ask(
        self: &Arc<Self>,
        of: Option<SemanticScene>,
        ask: TextOptions,
        preset: Option<Preset>,
        deadline: Instant,
    ) -> Result<Option<Arc<SceneTexts>>> {
        let Some(of) = of else { return Ok(None) };
        let how = ScoringChoice { preset, changes: ask.scoring };
        self.score(of, how, ask.text.into_iter().collect(), deadline).await.map(Some)
    }

    /// Renders on a blocking thread within the deadline; encodes each kind. `held` are the bytes of
    /// the pictures; where there are none they are taken when the view is drawn.
    async fn render_one(
        self: &Arc<Self>,
        access: SceneAccess,
        view: Resolved,
        held: Option<Share>,
        texts: Option<Arc<SceneTexts>>,
        caller: &Caller,
        deadline: Instant,
    ) -> Result<Vec<RenderedView>> {
        let (inner, demand) = (Arc::clone(self), Demand::view(caller, view.pixels()));
        let bytes_max = view.bytes_max();
        let draw = move |work: &mut Work| match texts {
            Some(texts) => {
                let scene = &texts.of.scene;
                let before = match view.has_holes() {
                    true => inner.load_unedited(&access)?,
                    false => Arc::clone(scene),
                };
                view.draw(&inner.backend, [&before, scene], Some(&texts), texts.times(), work)
            }
            None => {
                let begun = Instant::now();
                let before = inner.load_unedited(&access)?;
                let scene = inner.edited(&access, Arc::clone(&before))?;
                let times = ViewTimes { load_ms: ms(begun), ..ViewTimes::default() };
                view.draw(&inner.backend, [&before, &scene], None, times, work)
            }
        };
        let inner = Arc::clone(self);
        let draw = move |work: &mut Work| {
            let held = held.map_or_else(|| inner.memory.answer(bytes_max, &inner.limits()), Ok)?;
            Ok(holding(draw(work)?, held))
        };
        self.scheduled(demand, deadline, "the view", draw).await
    }
}

/// Pictures that hold their bytes until all of them are dropped.
fn holding(mut views: Vec<RenderedView>, mut held: Share) -> Vec<RenderedView> {
    held.shrink(views.iter().map(|view| view.bytes.len() as u64).sum());
    let held = Arc::new(held);
    views.iter_mut().for_each(|view| view.held = Some(Arc::clone(&held)));
    views
}

impl Service {
    /// The tag that [`Self::render`] would answer with, without rendering; `None` where it needs
    /// semantics that do not exist yet.
    ///
    /// # Errors
    /// As [`Self::render`], without those of the rendering itself.
    pub async fn view_etag(&self, id: &SceneId, spec: &ViewSpec) -> Result<Option<String>> {
        let (scene, ask, view) = self.checked_view(id, spec).await?;
        let (record, edits) = (scene.record(), scene.edits().sha256());
        let text = match (spec.kind.needs_semantics(), &record.semantics_sha256) {
            (false, _) => String::new(),
            (true, Some(_)) => {
                let tag = record_semantics_tag(record, edits);
                text_key(&tag, ask.text.as_deref(), view.preset, &ask.scoring)?
            }
            (true, None) => return Ok(None),
        };
        let name = self.inner.backend.renderer.name();
        view.etag(&record_tag(record, edits), &name, spec.kind, &text).map(Some)
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
        let of = inner.semantics_for(&scene, &[spec.kind], &ask).await?;
        let deadline = inner.deadline(&spec.options);
        let texts = inner.score_ask(of, ask, spec.options.preset, deadline).await?;
        let mut views = inner.render_one(scene, view, None, texts, &self.caller, deadline).await?;
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
        let view = resolve_one(&self.limits(), scene.record(), spec)?;
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
        let mut spec = spec.clone();
        let mut seen = std::collections::HashSet::new();
        spec.kinds.retain(|kind| seen.insert(*kind));
        let kinds = spec.kinds.clone();
        let ask = inner.checked_ask(&kinds, &spec.text)?;
        if kinds.iter().any(|kind| kind.needs_semantics()) {
            Shared::may_be_asked(scene.record(), "views")?;
        }
        let all = resolve(limits, scene.record(), &spec)?;
        let pixels: u64 = all.iter().map(Resolved::pixels).sum::<u64>() * kinds.len() as u64;
        if pixels > limits.views_pixels_max {
            let (cameras, kinds) = (all.len(), kinds.len());
            let what = format!("views: {cameras} cameras, {kinds} kinds");
            let max = limits.views_pixels_max;
            return Err(Error::limit(what, format!("{pixels} px"), format!("{max} px")));
        }
        let last = until(spec.options.deadline, limits.views_timeout_ms);
        let at_once = self.inner.scheduler.views_at_once(pixels / (all.len() * kinds.len()) as u64);
        let (preset, caller) = (spec.options.preset, self.caller.clone());
        let (to, pictures) = mpsc::channel(READY_MAX);
        let task = async move {
            let views = async {
                let of = inner.semantics_for(&scene, &kinds, &ask).await?;
                let texts = inner.score_ask(of, ask, preset, last).await?;
                // Bytes are taken in the order in which the pictures are sent, so that none waits
                // for a later one.
                let held = |one: Resolved| {
                    let inner = Arc::clone(&inner);
                    async move {
                        let held = inner
                            .memory
                            .answer_by(one.bytes_max(), &inner.limits(), last.into())
                            .await?;
                        Ok::<_, Error>((one, held))
                    }
                };
                // Each on a task of its own: a slot must not wait for a slow reader.
                let render = |(one, held): (Resolved, Share)| {
                    let deadline = last.min(inner.deadline(&ViewOptions::default()));
                    let (inner, scene, texts) = (Arc::clone(&inner), scene.clone(), texts.clone());
                    let caller = caller.clone();
                    let views = async move {
                        inner.render_one(scene, one, Some(held), texts, &caller, deadline).await
                    };
                    Task::spawn(views.in_current_span())
                        .map_err(|e| Error::internal("a view was broken off").caused_by(e))
                };
                let rendered = stream::iter(all).then(held).map_ok(render);
                let mut rendered = pin!(rendered.try_buffered(at_once));
                while let Some(views) = rendered.try_next().await? {
                    for view in views? {
                        let _ = to.send(Ok(view)).await;
                    }
                }
                Ok::<(), Error>(())
            };
            tokio::select! {
                // The caller stopped listening and wants no more.
                () = to.closed() => {}
                ended = views => if let Err(error) = ended {
                    let _ = to.send(Err(error)).await;
                },
            }
        };
        tokio::spawn(task);
        Ok(tokio_stream::wrappers::ReceiverStream::new(pictures))
    }
}
