//! A whole server whose scenes need no network: the product's own code reads photos and judges the
//! capture. Then the first photo becomes a plane of Gaussians at the median depth of the capture.

use std::sync::{Arc, LazyLock};

use glam::DVec3;
use segsplat::{
    capture,
    config::Config,
    error::{Error, ErrorCode, Result},
    jobs::SceneNetworks,
    pipeline::{PhotoSet, Reconstruction},
    render::cpu::CpuRenderer,
    sample::{self, SampleOptions},
    scene::{
        Backdrop, Gaussians, HealthReport, PosedPhoto, RawGaussians, SceneCamera, SceneOptions,
        SourcePixel, Stage, Upload, Watch,
    },
    service::ModelsInfo,
};

use super::server::TestServer;

/// Degree 0 of the 3DGS basis.
const SH_C0: f32 = 0.282_094_79;
/// Gaussians along the longer side of the plane.
const PLANE: u32 = 80;

/// Makes a plane of the first photo.
#[derive(Debug, Default)]
pub(crate) struct PlaneNetworks {
    /// Fails every scene with this code instead.
    pub(crate) fails: Option<ErrorCode>,
}

impl SceneNetworks for PlaneNetworks {
    fn make(
        &self,
        photos: &PhotoSet,
        options: &SceneOptions,
        watch: Watch<'_>,
    ) -> Result<Reconstruction> {
        if let Some(code) = self.fails {
            return Err(Error::new(code, format!("made to fail with {}", code.name())));
        }
        let PhotoSet { photos, warnings, .. } = photos;
        (watch.progress)(Stage::Capture, 0.5);
        let capture = capture::analyse(photos, watch.cancel)?;
        (watch.progress)(Stage::Lift, 0.5);
        let (gaussians, _) = Gaussians::sanitize(plane(&photos[0], capture.median_depth))?;
        let report = HealthReport {
            method: options.method(),
            photos: u32::try_from(photos.len()).expect("few photos"),
            views_used: u32::try_from(photos.len()).expect("few photos"),
            gaussians: gaussians.len() as u64,
            median_depth: capture.median_depth,
            warnings: [&warnings[..], &capture.warnings].concat(),
            ..HealthReport::default()
        };
        let camera = |posed: &PosedPhoto| SceneCamera {
            file: posed.file.clone(),
            camera: posed.camera,
            network: None,
        };
        let cameras = photos.iter().map(camera).collect();
        Ok(Reconstruction { gaussians, backdrop: Backdrop::default(), report, cameras })
    }
}

/// The photo's pixels as round Gaussians at depth `z` of its camera.
fn plane(posed: &PosedPhoto, z: f64) -> RawGaussians {
    let (photo, camera) = (&posed.photo, posed.camera);
    let step = photo.width.max(photo.height).div_ceil(PLANE).max(1);
    let origin = camera.camera_to_world.center();
    let mut raw = RawGaussians { origin, ..RawGaussians::default() };
    for y in (0..photo.height).step_by(step as usize) {
        for x in (0..photo.width).step_by(step as usize) {
            let at = camera.intrinsics.unproject(f64::from(x) + 0.5, f64::from(y) + 0.5, z);
            let world = camera.camera_to_world.matrix().transform_point3(at) - origin;
            let size = (z / camera.intrinsics.fx * f64::from(step) * 0.6) as f32;
            let pixel = ((y * photo.width + x) * 3) as usize;
            let rgb = |c: usize| f32::from(photo.rgb[pixel + c]) / 255.0;
            raw.means.push(DVec3::to_array(&world).map(|v| v as f32));
            raw.quats.push([1.0, 0.0, 0.0, 0.0]);
            raw.scales.push([size; 3]);
            raw.opacities.push(0.9);
            raw.sh.push([0, 1, 2].map(|c| (rgb(c) - 0.5) / SH_C0));
            raw.semantic_index.push(0);
            raw.source.push(SourcePixel::default());
        }
    }
    raw
}

/// A [`TestServer`] that judges captures and renders with the product's CPU renderer.
pub(crate) struct CpuServer(TestServer);

impl std::ops::Deref for CpuServer {
    type Target = TestServer;

    fn deref(&self) -> &TestServer {
        &self.0
    }
}

impl CpuServer {
    /// A server with default limits.
    pub(crate) async fn start() -> Self {
        Self::with(PlaneNetworks::default(), |_| {}).await
    }

    /// A server with these networks and a changed configuration.
    pub(crate) async fn with(networks: PlaneNetworks, change: impl FnOnce(&mut Config)) -> Self {
        let server = TestServer::with(|config, parts| {
            parts.scenes = Arc::new(networks);
            parts.renderer = Arc::new(CpuRenderer::new(config.threads).expect("a CPU renderer"));
            parts.models = ModelsInfo { bundle: "plane".to_owned(), ..ModelsInfo::default() };
            change(config);
        });
        Self(server.await)
    }

    /// Sends the stop signal and waits for the end.
    pub(crate) async fn stop(self) {
        self.0.stop().await;
    }
}

/// Three small photos of the sample room, which match each other.
pub(crate) fn upload() -> Upload {
    static MADE: LazyLock<Upload> =
        LazyLock::new(|| sample::upload(&options()).expect("the sample is made"));
    MADE.clone()
}

/// How [`upload`] is made.
pub(crate) fn options() -> SampleOptions {
    SampleOptions { photos: 3, width: 160, height: 120, seed: 5 }
}
