//! Stands in for the semantic networks: the photo that a Gaussian came from is what it means.
//!
//! Entry m of the bank is photo m - 1; the texts "photo 0", "photo 1", ... name them, any other
//! word is a direction of its own, and words that begin with `?` are unknown.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    thread::ThreadId,
    time::{Duration, Instant},
};

use segsplat::{
    error::{Error, ErrorCode, Result},
    jobs::{Phrases, SemanticNetworks},
    pipeline::PhotoSet,
    scene::{
        Bank, IndexMap, Method, PosedPhoto, Scene, Semantics, SemanticsReport, Stage,
        TextEmbedding, Watch,
    },
};

use super::server::PATIENCE;

/// Numbers of an embedding.
pub(crate) const DIM: usize = 16;

/// The stand-in, and what it was asked.
#[derive(Debug, Default)]
pub(crate) struct PhotoMeaning {
    /// Whether it is begun while the scene is made.
    pub(crate) early: bool,
    /// Held back while true.
    pub(crate) hold: AtomicBool,
    /// Fails with this code while set.
    pub(crate) fails: std::sync::Mutex<Option<ErrorCode>>,
    /// What the bundle is said to lack.
    pub(crate) lack: Option<&'static str>,
    /// Calls of `make`.
    pub(crate) calls: AtomicUsize,
    /// Pixels of the photos of the last call, one photo after the other.
    pub(crate) pixels: std::sync::Mutex<Vec<u8>>,
    /// Words that photos were to be without, each time.
    pub(crate) ignored: std::sync::Mutex<Vec<Vec<String>>>,
    /// Texts embedded, from the begin of their call on.
    pub(crate) embedded: AtomicUsize,
    /// The text tower is held back while true.
    pub(crate) hold_texts: AtomicBool,
    /// Threads on which the text tower was asked: it may have to be opened there.
    pub(crate) asked_on: std::sync::Mutex<Vec<ThreadId>>,
}

impl PhotoMeaning {
    /// Share of the stage `masks` that is done while it is held back.
    pub(crate) const HELD_AT: f32 = 0.25;
}

fn axis(at: usize) -> Vec<f32> {
    let mut row = vec![0.0; DIM];
    row[at % DIM] = 1.0;
    row
}

impl SemanticNetworks for PhotoMeaning {
    fn lacks(&self) -> Option<String> {
        self.lack.map(str::to_owned)
    }

    fn phrases(&self) -> Result<Phrases> {
        self.asked_on.lock().unwrap().push(std::thread::current().id());
        let canon = ["object", "things", "stuff"].map(str::to_owned).to_vec();
        Ok(Phrases { canon, tau: 10.0, coverage_floor: 0.05, margin: 0.0, rivals: 1.0 })
    }

    fn embed_texts(&self, texts: &[String]) -> Result<Vec<TextEmbedding>> {
        self.asked_on.lock().unwrap().push(std::thread::current().id());
        self.embedded.fetch_add(texts.len(), Ordering::AcqRel);
        let begun = Instant::now();
        while self.hold_texts.load(Ordering::Acquire) {
            assert!(begun.elapsed() < PATIENCE, "nobody let go of the text tower");
            std::thread::sleep(Duration::from_millis(2));
        }
        let embed = |text: &String| {
            let photo = text.strip_prefix("photo ").and_then(|n| n.parse::<usize>().ok());
            let row = match photo {
                Some(photo) if photo < 8 => axis(photo),
                _ => axis(8 + text.bytes().map(usize::from).sum::<usize>() % 8),
            };
            let unknown = usize::from(text.starts_with('?'));
            TextEmbedding { row, tokens: 1, unknown, cut: false }
        };
        Ok(texts.iter().map(embed).collect())
    }

    /// A thing of any word is the left half of each photo.
    fn without_words(
        &self,
        mut photos: PhotoSet,
        words: &[String],
        _: &Method,
        _: Watch<'_>,
    ) -> Result<PhotoSet> {
        if !photos.is_without_words {
            self.ignored.lock().expect("no panic holds it").push(words.to_vec());
            let left = IndexMap { width: 2, height: 1, index: vec![1, 0] };
            photos.photos.iter_mut().for_each(|posed| posed.photo.leave_out(&left));
            photos.is_without_words = true;
        }
        Ok(photos)
    }

    fn begin_early(&self, _: &Method) -> bool {
        self.early
    }

    fn make(
        &self,
        given: &[PosedPhoto],
        _: &Method,
        scene: &dyn Fn() -> Result<Arc<Scene>>,
        watch: Watch<'_>,
    ) -> Result<Semantics> {
        self.calls.fetch_add(1, Ordering::AcqRel);
        let pixels = given.iter().flat_map(|posed| &posed.photo.rgb).copied().collect();
        *self.pixels.lock().expect("no panic holds it") = pixels;
        (watch.progress)(Stage::Masks, Self::HELD_AT);
        let begun = Instant::now();
        while self.hold.load(Ordering::Acquire) {
            assert!(begun.elapsed() < PATIENCE, "nobody let go of the stand-in");
            if watch.cancel.load(Ordering::Acquire) {
                return Err(Error::new(ErrorCode::Cancelled, "stopped"));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        if let Some(code) = *self.fails.lock().expect("no panic holds it") {
            return Err(Error::new(code, "made to fail"));
        }
        let scene = scene()?;
        (watch.progress)(Stage::Assign, 0.75);
        let photos = scene.meta.cameras.len();
        assert_eq!(given.len(), photos, "the photos are kept with the scene");
        let index: Vec<u16> =
            scene.gaussians.source().iter().map(|source| source.view + 1).collect();
        let report = SemanticsReport {
            masks: vec![1; photos],
            bank_size: photos as u32,
            labelled: index.len() as u64,
            ..SemanticsReport::default()
        };
        let rows = (0..photos).flat_map(axis).collect();
        let map = |photo: usize| IndexMap { width: 1, height: 1, index: vec![photo as u16 + 1] };
        Ok(Semantics {
            bank: Bank { dim: DIM, rows },
            index,
            photos: (0..photos).map(map).collect(),
            report,
            ..Semantics::default()
        })
    }
}
