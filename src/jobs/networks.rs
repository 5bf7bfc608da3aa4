//! The networks of jobs: those of the bundle, or the stand-ins of a test.

use std::sync::{Arc, atomic::AtomicBool};

use crate::{
    error::{Error, ErrorCode, Result},
    models::Provider,
    pipeline::{
        self, PhotoSet, Pipeline, PipelineLoader, Reconstruction, Seen, UnposedSet,
        growth::{self, Grown},
        ignored,
        semantics::{LabelledPhotos, SemanticsInput, label_more},
        words,
    },
    refine::split,
    scene::{Gaussians, Method, PosedPhoto, Scene, SceneOptions, Semantics, TextEmbedding, Watch},
};

/// When to ask again for networks that are being opened, seconds.
const OPENING_RETRY_S: u32 = 2;

/// Whether the networks are open.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NetworkState {
    /// They are being opened; queued jobs wait for them.
    Opening,
    /// They are open, on this execution provider; empty: there are none to open.
    Open(&'static str),
    /// They do not open. No job is taken from the queue, so that none fails.
    Broken,
}

impl NetworkState {
    /// Name in answers.
    pub(crate) fn name(self) -> &'static str {
        match self {
            Self::Opening => "opening",
            Self::Open(_) => "open",
            Self::Broken => "broken",
        }
    }
}

/// Makes scenes of photos.
pub trait SceneNetworks: Send + Sync {
    /// What decides the scene beside photos and options: sha256 of the bundle's manifest, hex;
    /// empty where no network is used.
    fn identity(&self) -> String {
        String::new()
    }

    /// Whether they are open.
    fn state(&self) -> NetworkState {
        NetworkState::Open("")
    }

    /// Waits until they are open, or are known to stay closed.
    fn opened(&self) -> NetworkState {
        self.state()
    }

    /// Why a network is not computed where it was to be; `None` where all are.
    fn remark(&self) -> Option<String> {
        None
    }

    /// The open networks, to run one by itself.
    ///
    /// # Errors
    /// `model_unavailable` while they are being opened, where they do not open, or where there are
    /// none.
    fn pipeline(&self) -> Result<&Pipeline> {
        Err(Error::new(ErrorCode::ModelUnavailable, "there are no networks"))
    }

    /// Whether there is a network that finds the cameras of photos. Else the call that sends photos
    /// alone is refused.
    fn finds_cameras(&self) -> bool {
        false
    }

    /// Finds the cameras of photos that came without, on the calling thread.
    ///
    /// # Errors
    /// Any code; it becomes the scene's `error`.
    fn pose(&self, _: UnposedSet, _: Watch<'_>) -> Result<PhotoSet> {
        Err(Error::internal("no network finds cameras"))
    }

    /// Does the whole work on the calling thread.
    ///
    /// # Errors
    /// Any code; it becomes the scene's `error`.
    fn make(
        &self,
        photos: &PhotoSet,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<Reconstruction>;

    /// As [`Self::make`], and what the networks said of the photos, where they can be united again
    /// without them.
    ///
    /// # Errors
    /// As [`Self::make`].
    fn make_keeping(
        &self,
        photos: &PhotoSet,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<(Reconstruction, Option<Seen>)> {
        Ok((self.make(photos, options, watch)?, None))
    }

    /// The scene of photos of which the first `before` were there already: `known` is what the
    /// networks said of these, as [`Self::make_keeping`] or this gave it.
    ///
    /// # Errors
    /// As [`Self::make`].
    fn make_more(
        &self,
        photos: &PhotoSet,
        before: usize,
        _known: Option<Seen>,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<Grown> {
        let made = self.make(photos, options, watch)?;
        let source = made.gaussians.source();
        let of_new = made.gaussians.only(|i| usize::from(source[i].view) >= before);
        Ok(Grown { made, of_new, seen: None })
    }

    /// The scene of the photos but those of the numbers `held`, and the Gaussians with which its
    /// refinement begins: one set of the same photos (`front_photos` = 0), or what was made. `seen`
    /// is what the networks said of all photos, as [`Self::make_keeping`] gave it.
    ///
    /// # Errors
    /// As [`Self::make`].
    fn make_for_refinement(
        &self,
        photos: &PhotoSet,
        held: &[usize],
        _seen: Option<&Seen>,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<(Reconstruction, Gaussians)> {
        let kept = split(&photos.photos, held).0;
        let kept = PhotoSet::given(kept, Vec::new(), 0.0);
        let made = self.make(&kept, options, watch)?;
        let one_set = made.gaussians.clone();
        Ok((made, one_set))
    }

    /// The photos with cameras that their keypoints tell, and what the networks say of them there;
    /// `None` where nothing tells.
    ///
    /// # Errors
    /// As [`Self::make`].
    fn recast(
        &self,
        _photos: &[PosedPhoto],
        _options: &SceneOptions,
        _watch: Watch<'_>,
    ) -> Result<Option<(Vec<PosedPhoto>, Seen)>> {
        Ok(None)
    }
}

/// What the bundle compares texts with, and how.
#[derive(Clone, Debug, PartialEq)]
pub struct Phrases {
    /// Canonical phrases: what a thing is called when nothing is known of it.
    pub canon: Vec<String>,
    /// Steepness of the comparison.
    pub tau: f32,
    /// Coverage under which a pixel has no semantics, 0..1.
    pub coverage_floor: f32,
    /// Difference of cosines at which the relevancy is 0.5.
    pub margin: f32,
    /// Share of the bundle's words that may fit an entry better than a text that selects it.
    pub rivals: f32,
}

/// Makes the semantics of scenes, and embeds texts.
pub trait SemanticNetworks: Send + Sync {
    /// What the loaded bundle lacks for it, as in "no mask network"; `None` where nothing.
    fn lacks(&self) -> Option<String>;

    /// What the bundle compares texts with.
    ///
    /// # Errors
    /// `model_unavailable`.
    fn phrases(&self) -> Result<Phrases>;

    /// Embeddings of the everyday words that name things, by the bundle's list; none where it has
    /// no list. On the calling thread.
    ///
    /// # Errors
    /// `model_unavailable`, `internal`.
    fn rivals(&self) -> Result<Arc<[Vec<f32>]>> {
        Ok(Arc::default())
    }

    /// Embeds texts, one after the other in their order. On the calling thread.
    ///
    /// # Errors
    /// `model_unavailable`, `internal`.
    fn embed_texts(&self, texts: &[String]) -> Result<Vec<TextEmbedding>>;

    /// Whether a network masks what a text says in the photos of a scene. Else texts are compared
    /// with the scene's bank.
    fn masks_texts(&self) -> bool {
        false
    }

    /// Of each text the score at each Gaussian of a scene, thousandths, as that network finds it in
    /// the scene's photos. On the calling thread.
    ///
    /// # Errors
    /// `model_unavailable`, `invalid_request`, `cancelled`, `internal`.
    fn find_words(
        &self,
        _photos: &[PosedPhoto],
        _scene: &Scene,
        _texts: &[String],
        _cancel: &AtomicBool,
    ) -> Result<Vec<Vec<u16>>> {
        Err(Error::internal("no network masks texts"))
    }

    /// Photos without what these words name, where they are not yet. On the calling thread.
    ///
    /// # Errors
    /// `model_unavailable`, `invalid_request`, `cancelled`, `internal`.
    fn without_words(
        &self,
        _photos: PhotoSet,
        _words: &[String],
        _method: &Method,
        _watch: Watch<'_>,
    ) -> Result<PhotoSet> {
        Err(Error::internal("no network finds words in photos"))
    }

    /// Whether the semantics of a scene are best begun before the scene is made: they need its
    /// Gaussians only at the end, and do not take the processor from the job that makes it.
    fn begin_early(&self, _: &Method) -> bool {
        false
    }

    /// Does the whole work on the calling thread. `photos` are those that the scene is made of;
    /// `scene` gives it, and waits until it is made.
    ///
    /// # Errors
    /// Any code; it becomes the `error` of the scene's semantics.
    fn make(
        &self,
        photos: &[PosedPhoto],
        method: &Method,
        scene: &dyn Fn() -> Result<Arc<Scene>>,
        watch: Watch<'_>,
    ) -> Result<Semantics>;

    /// As [`Self::make`], where the first photos were labelled before (`known`); also the labels of
    /// all photos, for the next time, where they can be used again.
    ///
    /// # Errors
    /// As [`Self::make`].
    fn make_more(
        &self,
        photos: &[PosedPhoto],
        _known: Option<&LabelledPhotos>,
        method: &Method,
        scene: &dyn Fn() -> Result<Arc<Scene>>,
        watch: Watch<'_>,
    ) -> Result<(Semantics, Option<LabelledPhotos>)> {
        Ok((self.make(photos, method, scene, watch)?, None))
    }
}

/// Makes no semantics: the bundle has no networks for them.
#[derive(Clone, Copy, Debug, Default)]
pub struct NoSemantics;

impl NoSemantics {
    fn refusal() -> Error {
        Error::new(ErrorCode::ModelUnavailable, "the bundle has no semantic networks")
    }
}

impl SemanticNetworks for NoSemantics {
    fn lacks(&self) -> Option<String> {
        Some("no semantic networks".to_owned())
    }

    fn phrases(&self) -> Result<Phrases> {
        Err(Self::refusal())
    }

    fn embed_texts(&self, _: &[String]) -> Result<Vec<TextEmbedding>> {
        Err(Self::refusal())
    }

    fn make(
        &self,
        _: &[PosedPhoto],
        _: &Method,
        _: &dyn Fn() -> Result<Arc<Scene>>,
        _: Watch<'_>,
    ) -> Result<Semantics> {
        Err(Self::refusal())
    }
}

/// Makes scenes and semantics with the networks of an engine.
#[derive(Clone, Debug)]
pub struct PipelineNetworks(pub Arc<PipelineLoader>);

impl SceneNetworks for PipelineNetworks {
    fn identity(&self) -> String {
        self.0.bundle().sha256().to_owned()
    }

    fn state(&self) -> NetworkState {
        match self.0.peek() {
            None => NetworkState::Opening,
            Some(Ok(engine)) => NetworkState::Open(engine.geometry().provider().name()),
            Some(Err(_)) => NetworkState::Broken,
        }
    }

    fn opened(&self) -> NetworkState {
        // Waits for the thread that opens them.
        let _ = self.0.get();
        self.state()
    }

    fn remark(&self) -> Option<String> {
        self.0.peek()?.ok()?.remark()
    }

    fn pipeline(&self) -> Result<&Pipeline> {
        self.0.peek().unwrap_or_else(|| {
            let why = "the networks are being opened; ask again";
            Err(Error::new(ErrorCode::ModelUnavailable, why).retry_after_s(OPENING_RETRY_S))
        })
    }

    fn finds_cameras(&self) -> bool {
        self.0.bundle().features().is_some()
    }

    fn pose(&self, photos: UnposedSet, watch: Watch<'_>) -> Result<PhotoSet> {
        pipeline::cameras::posed(self.0.get()?, photos, watch)
    }

    fn make(
        &self,
        photos: &PhotoSet,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<Reconstruction> {
        pipeline::make(self.0.get()?, photos, options, watch)
    }

    fn make_keeping(
        &self,
        photos: &PhotoSet,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<(Reconstruction, Option<Seen>)> {
        let (made, seen) = pipeline::make_keeping(self.0.get()?, photos, options, watch)?;
        Ok((made, Some(seen)))
    }

    fn make_more(
        &self,
        photos: &PhotoSet,
        before: usize,
        known: Option<Seen>,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<Grown> {
        growth::make_more(self.0.get()?, photos, before, known, options, watch)
    }

    fn make_for_refinement(
        &self,
        photos: &PhotoSet,
        held: &[usize],
        seen: Option<&Seen>,
        _options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<(Reconstruction, Gaussians)> {
        let lacks = || Error::internal("what the networks said of the photos is not here");
        let seen = seen.ok_or_else(lacks)?;
        pipeline::make_for_refinement(self.0.get()?, &photos.photos, held, seen, watch)
    }

    fn recast(
        &self,
        photos: &[PosedPhoto],
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<Option<(Vec<PosedPhoto>, Seen)>> {
        pipeline::cameras::recast(self.0.get()?, photos, options, watch)
    }
}

impl SemanticNetworks for PipelineNetworks {
    fn lacks(&self) -> Option<String> {
        self.0.bundle().lacks_semantics().map(str::to_owned)
    }

    fn phrases(&self) -> Result<Phrases> {
        let towers = self.0.get()?.image_text()?;
        let manifest = towers.manifest();
        Ok(Phrases {
            canon: manifest.canon.clone(),
            tau: manifest.tau,
            coverage_floor: manifest.coverage_floor,
            margin: manifest.margin,
            rivals: manifest.rivals,
        })
    }

    fn embed_texts(&self, texts: &[String]) -> Result<Vec<TextEmbedding>> {
        self.0.get()?.image_text()?.embed_texts(texts)
    }

    fn rivals(&self) -> Result<Arc<[Vec<f32>]>> {
        self.0.get()?.image_text()?.rivals()
    }

    fn masks_texts(&self) -> bool {
        self.0.bundle().text_masks().is_some()
    }

    fn find_words(
        &self,
        photos: &[PosedPhoto],
        scene: &Scene,
        texts: &[String],
        cancel: &AtomicBool,
    ) -> Result<Vec<Vec<u16>>> {
        let (cameras, gaussians) = (&scene.meta.cameras[..], &scene.gaussians);
        let input = SemanticsInput { photos, cameras, gaussians };
        let depth = scene.meta.report.median_depth;
        words::find_words(self.0.get()?, &input, depth, texts, cancel)
    }

    fn without_words(
        &self,
        photos: PhotoSet,
        words: &[String],
        method: &Method,
        watch: Watch<'_>,
    ) -> Result<PhotoSet> {
        ignored::without_words(self.0.get()?, photos, words, method, watch)
    }

    fn begin_early(&self, method: &Method) -> bool {
        let on_device = |engine: &Pipeline| engine.geometry().provider() != Provider::Cpu;
        !method.seeds && self.pipeline().is_ok_and(on_device)
    }

    fn make(
        &self,
        photos: &[PosedPhoto],
        method: &Method,
        scene: &dyn Fn() -> Result<Arc<Scene>>,
        watch: Watch<'_>,
    ) -> Result<Semantics> {
        let made = SemanticNetworks::make_more(self, photos, None, method, scene, watch);
        made.map(|(semantics, _)| semantics)
    }

    fn make_more(
        &self,
        photos: &[PosedPhoto],
        known: Option<&LabelledPhotos>,
        method: &Method,
        scene: &dyn Fn() -> Result<Arc<Scene>>,
        watch: Watch<'_>,
    ) -> Result<(Semantics, Option<LabelledPhotos>)> {
        let engine = self.0.get()?;
        let seeds = if method.seeds { Some(scene()?) } else { None };
        let gaussians = seeds.as_ref().map(|scene| &scene.gaussians);
        let labelled = label_more(engine, photos, known, gaussians, method, watch)?;
        let scene = scene()?;
        let (cameras, gaussians) = (&scene.meta.cameras[..], &scene.gaussians);
        let input = SemanticsInput { photos, cameras, gaussians };
        // Seeded masks depend on the photos before: they are of no use beside others.
        let kept = (!method.seeds).then(|| labelled.clone());
        Ok((labelled.label_gaussians(&input, watch)?, kept))
    }
}
