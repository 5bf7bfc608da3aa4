//! A whole server in this process: port 0, its own folder, a stand-in for the network.
//!
//! The stand-in reads uploads as the product does and lifts each photo to a wall at one depth, so
//! that everything but the geometry is the product's own.

use std::{
    net::SocketAddr,
    sync::{
        Arc, LazyLock,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use glam::DVec3;
use segsplat::{
    api,
    config::Config,
    error::{Error, ErrorCode, Result},
    jobs::{NoSemantics, SceneNetworks},
    pipeline::{PhotoSet, Reconstruction},
    render::{Frame, FrameStats, Labels, PixelWeights, RenderRequest, Renderer, labels::selected},
    sample::{self, SampleOptions},
    scene::{
        Backdrop, Gaussians, HealthReport, PosedPhoto, RawGaussians, Refine, SceneCamera, SceneId,
        SceneOptions, SceneStatus, SourcePixel, Stage, Upload, UploadCameras, Watch,
    },
    service::{
        CameraSpec, CreateScene, LensSpec, ModelsInfo, Parts, PictureKind, PictureOptions,
        PoseSpec, Service, TextOptions, ViewOptions, ViewSpec,
    },
    store::StoreLocation,
};
use segsplat_testing::frames::{behind, rounded};
use tempfile::TempDir;
use tokio::{net::TcpListener, sync::oneshot, task::JoinHandle};

/// Depth of the wall that the stand-in lifts each photo to, world units.
pub(crate) const WALL_DEPTH: f64 = 3.6;
/// How long a test waits for what must come.
pub(crate) const PATIENCE: Duration = Duration::from_secs(60);

/// A running server.
pub(crate) struct TestServer {
    pub(crate) addr: SocketAddr,
    pub(crate) service: Service,
    place: StoreLocation,
    config: Config,
    parts: Parts,
    folder: TempDir,
    stop: oneshot::Sender<()>,
    served: JoinHandle<Result<()>>,
}

impl TestServer {
    /// A server with the stand-in networks and the default limits.
    pub(crate) async fn start() -> Self {
        Self::with(|_, _| {}).await
    }

    /// A server whose limits or parts `change` sets.
    pub(crate) async fn with(change: impl FnOnce(&mut Config, &mut Parts)) -> Self {
        Self::placed(None, change).await
    }

    /// As [`Self::with`], its scenes at this place.
    pub(crate) async fn at(
        place: &StoreLocation,
        change: impl FnOnce(&mut Config, &mut Parts),
    ) -> Self {
        Self::placed(Some(place.clone()), change).await
    }

    async fn placed(
        place: Option<StoreLocation>,
        change: impl FnOnce(&mut Config, &mut Parts),
    ) -> Self {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mut config = Config::default();
        config.data_dir = folder.path().join("data");
        // Versions of scenes come where a test asks for them.
        config.refine = Refine::Off;
        let mut parts = Parts {
            scenes: Arc::new(WallNetworks::default()),
            semantics: Arc::new(NoSemantics),
            renderer: Arc::new(PointRenderer),
            models: ModelsInfo::default(),
        };
        change(&mut config, &mut parts);
        let place = place.unwrap_or_else(|| StoreLocation::Folder(config.data_dir.clone()));
        Self::serve(place, config, parts, folder).await
    }

    async fn serve(place: StoreLocation, config: Config, parts: Parts, folder: TempDir) -> Self {
        let service = Service::open(&place, config.clone(), parts.clone());
        let service = service.expect("the place is usable");
        let listener = TcpListener::bind("127.0.0.1:0").await.expect("a free port");
        let addr = listener.local_addr().expect("a bound listener has an address");
        let (stop, stopped) = oneshot::channel();
        let of_server = service.clone();
        let served = tokio::spawn(async move {
            let stopped = async { drop(stopped.await) };
            api::Server::new(of_server)?.serve(listener, stopped).await
        });
        Self { addr, service, place, config, parts, folder, stop, served }
    }

    /// `http://…` of a path that begins with a slash.
    pub(crate) fn url(&self, path: &str) -> String {
        format!("http://{}{path}", self.addr)
    }

    /// Where scenes, uploads and statuses lie.
    pub(crate) fn data_dir(&self) -> &std::path::Path {
        &self.config.data_dir
    }

    /// Stops the server as SIGTERM does; gives the folder so that it lives on.
    pub(crate) async fn stop(self) -> TempDir {
        let Self { service, stop, served, folder, .. } = self;
        let _ = stop.send(());
        served.await.expect("the server does not panic").expect("the server ends well");
        tokio::task::spawn_blocking(move || service.shut_down()).await.expect("workers stop");
        folder
    }

    /// Stops the server and starts another one on the same folder.
    pub(crate) async fn restart(self) -> Self {
        let (config, parts, place) = (self.config.clone(), self.parts.clone(), self.place.clone());
        let folder = self.stop().await;
        Self::serve(place, config, parts, folder).await
    }

    /// Makes a scene of [`upload`] and waits for it.
    pub(crate) async fn scene(&self) -> SceneStatus {
        let request =
            CreateScene { upload: upload(), wait: Some(PATIENCE), ..CreateScene::default() };
        self.service.create_scene(request).await.expect("the sample is a good upload").status
    }

    /// Waits until nothing more will happen to a scene.
    pub(crate) async fn finished(&self, id: &SceneId) -> SceneStatus {
        let status = self.service.wait(id, PATIENCE).await.expect("the scene is known");
        assert!(status.state.is_final(), "still {status:?} after {PATIENCE:?}");
        status
    }
}

/// Three small posed photos of the sample room, as a caller sends them.
pub(crate) fn upload() -> Upload {
    static MADE: LazyLock<Upload> = LazyLock::new(|| {
        let options = SampleOptions { photos: 3, width: 64, height: 48, seed: 5 };
        sample::upload(&options).expect("the options are in range")
    });
    MADE.clone()
}

/// The same, with a last photo that makes [`WallNetworks`] panic.
pub(crate) fn panicking_upload() -> Upload {
    let mut bad = upload();
    let last = bad.photos.last_mut().expect("three photos");
    let old = std::mem::replace(&mut last.name, "panic.png".to_owned());
    let Some(UploadCameras::Transforms(json)) = &mut bad.cameras else {
        panic!("the sample sends transforms")
    };
    *json = String::from_utf8(json.clone()).unwrap().replace(&old, "panic.png").into_bytes();
    bad
}

/// Colour from the first input camera.
pub(crate) fn first_view() -> ViewSpec {
    let pose = PoseSpec::Between { from: 0, to: 1, t: 0.0 };
    let camera = CameraSpec { pose, lens: LensSpec::OfScene };
    ViewSpec {
        camera,
        kind: PictureKind::Color,
        options: ViewOptions::default(),
        picture: PictureOptions::default(),
        text: TextOptions::default(),
    }
}

/// Stands in for the network. Held back while `hold` is true, so that tests see work in progress;
/// a photo named `panic` makes it panic.
#[derive(Debug, Default)]
pub(crate) struct WallNetworks {
    pub(crate) hold: AtomicBool,
    /// Calls of `make`.
    pub(crate) calls: AtomicUsize,
}

impl SceneNetworks for WallNetworks {
    fn identity(&self) -> String {
        "stand-in".to_owned()
    }

    fn make(
        &self,
        photos: &PhotoSet,
        _: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<Reconstruction> {
        self.calls.fetch_add(1, Ordering::AcqRel);
        let photos = &photos.photos;
        (watch.progress)(Stage::Geometry, 0.5);
        let begun = Instant::now();
        while self.hold.load(Ordering::Acquire) {
            assert!(begun.elapsed() < PATIENCE, "nobody let go of the stand-in");
            if watch.cancel.load(Ordering::Acquire) {
                return Err(Error::new(ErrorCode::Cancelled, "stopped"));
            }
            std::thread::sleep(Duration::from_millis(2));
        }
        assert!(!photos.iter().any(|p| p.file.contains("panic")), "on purpose");
        let (gaussians, _) = Gaussians::sanitize(wall(photos))?;
        let report = HealthReport {
            photos: photos.len() as u32,
            views_used: photos.len() as u32,
            gaussians: gaussians.len() as u64,
            depth_range: [WALL_DEPTH, WALL_DEPTH],
            median_depth: WALL_DEPTH,
            ..HealthReport::default()
        };
        let cameras = photos
            .iter()
            .map(|p| SceneCamera { file: p.file.clone(), camera: p.camera, network: None })
            .collect();
        Ok(Reconstruction { gaussians, backdrop: Backdrop::default(), report, cameras })
    }
}

fn wall(photos: &[PosedPhoto]) -> RawGaussians {
    let mut raw = RawGaussians { origin: DVec3::new(0.5, 0.0, -0.25), ..RawGaussians::default() };
    for (view, posed) in photos.iter().enumerate() {
        let lens = posed.camera.intrinsics;
        let to_world = posed.camera.camera_to_world.matrix();
        for y in (0..lens.height).step_by(2) {
            for x in (0..lens.width).step_by(2) {
                let at = lens.unproject(f64::from(x) + 1.0, f64::from(y) + 1.0, WALL_DEPTH);
                let mean = to_world.transform_point3(at) - raw.origin;
                let pixel = (y * lens.width + x) as usize;
                if posed.photo.valid.as_ref().is_some_and(|valid| !valid[pixel]) {
                    continue;
                }
                let pixel = pixel * 3;
                let rgb = &posed.photo.rgb[pixel..pixel + 3];
                let colour = [0, 1, 2].map(|c| (f32::from(rgb[c]) / 255.0 - 0.5) / 0.282_094_8);
                raw.means.push(mean.as_vec3().to_array());
                raw.quats.push([1.0, 0.0, 0.0, 0.0]);
                raw.scales.push([(WALL_DEPTH / lens.fx) as f32; 3]);
                raw.opacities.push(0.9);
                raw.sh.push(colour);
                raw.semantic_index.push(view as u16);
                raw.source.push(SourcePixel { view: view as u16, x: x as u16, y: y as u16 });
            }
        }
    }
    raw
}

/// [`PointRenderer`] that counts what it drew.
#[derive(Debug, Default)]
pub(crate) struct CountingRenderer {
    /// Views drawn.
    pub(crate) drawn: AtomicUsize,
    /// Those with a mask.
    pub(crate) masks: AtomicUsize,
    /// Those with pixel weights.
    pub(crate) weights: AtomicUsize,
}

impl CountingRenderer {
    /// Views drawn, those with a mask, those with pixel weights.
    pub(crate) fn counts(&self) -> [usize; 3] {
        [&self.drawn, &self.masks, &self.weights].map(|count| count.load(Ordering::Acquire))
    }
}

impl Renderer for CountingRenderer {
    fn name(&self) -> String {
        PointRenderer.name()
    }

    fn concurrency(&self) -> usize {
        2
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        self.drawn.fetch_add(1, Ordering::AcqRel);
        match request.labels {
            Labels::None | Labels::Blend(_) => {}
            Labels::Mask { .. } => drop(self.masks.fetch_add(1, Ordering::AcqRel)),
            Labels::Weights => drop(self.weights.fetch_add(1, Ordering::AcqRel)),
        }
        PointRenderer.render(gaussians, request)
    }
}

/// Draws each Gaussian as the one pixel it falls on, the nearest in front.
#[derive(Clone, Copy, Debug)]
pub(crate) struct PointRenderer;

impl Renderer for PointRenderer {
    fn name(&self) -> String {
        "points".to_owned()
    }

    fn concurrency(&self) -> usize {
        2
    }

    fn render(&self, gaussians: &Gaussians, request: &RenderRequest) -> Result<Frame> {
        let lens = request.camera.intrinsics;
        let viewmat = request.camera.camera_to_world.viewmat();
        let pixels = lens.width as usize * lens.height as usize;
        let place = |i: usize| [i as u32 % lens.width, i as u32 / lens.width];
        let mut color: Vec<_> = (0..pixels).map(|i| behind(request, place(i))).collect();
        let mut depth = vec![0.0_f32; pixels];
        let mut labels = vec![0; pixels];
        let mut stats = FrameStats::default();
        for (i, (mean, sh)) in gaussians.means().iter().zip(gaussians.sh()).enumerate() {
            let world = DVec3::from_array(mean.map(f64::from)) + gaussians.origin();
            let at = viewmat.transform_point3(world);
            let (u, v) = lens.project(at);
            let inside =
                u >= 0.0 && v >= 0.0 && u < f64::from(lens.width) && v < f64::from(lens.height);
            if at.z <= f64::from(request.near) || !inside {
                continue;
            }
            let pixel = v as usize * lens.width as usize + u as usize;
            if depth[pixel] == 0.0 || depth[pixel] > at.z as f32 {
                depth[pixel] = at.z as f32;
                color[pixel] = sh.map(|v| v * 0.282_094_8 + 0.5);
                labels[pixel] = gaussians.semantic_index()[i];
            }
            stats.visible += 1;
        }
        let alpha: Vec<f32> = depth.iter().map(|&z| f32::from(u8::from(z > 0.0))).collect();
        let mask = match &request.labels {
            Labels::Mask { table, coverage_floor } => {
                let row = |(&m, &a): (&u16, &f32)| Labels::row(table, m).map(|v| v * a);
                let on = |row| u8::from(selected(row, *coverage_floor)) * u8::MAX;
                Some(labels.iter().zip(&alpha).map(row).map(on).collect())
            }
            _ => None,
        };
        let weights = (request.labels == Labels::Weights).then(|| {
            let mut weights = PixelWeights { offsets: vec![0], ..PixelWeights::default() };
            for &label in &labels {
                weights.entries.extend((label != 0).then_some(label));
                weights.offsets.push(weights.entries.len() as u32);
            }
            weights.weights = vec![1.0; weights.entries.len()];
            weights
        });
        let frame = Frame {
            width: lens.width,
            height: lens.height,
            color: request.kinds.color.then_some(color),
            depth: request.kinds.depth.then_some(depth),
            alpha: request.kinds.alpha.then_some(alpha),
            weights,
            mask,
            stats,
            ..Frame::default()
        };
        Ok(rounded(frame, request.samples))
    }
}
