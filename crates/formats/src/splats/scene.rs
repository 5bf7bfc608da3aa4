//! A file of Gaussians as a scene.
//!
//! It has no photos. So that it can be looked at as any other, it has one camera, from which all of
//! it is seen: along the z axis, y down, in front of the sphere about the median centre that holds
//! nine of ten Gaussians. The distance of that camera is what the scene gives as its median depth.

use std::sync::Arc;

use glam::DVec3;

use super::{SplatFormat, SplatsRead, places::reach};
use crate::{
    error::{Error, Result},
    limits::BANK_ROWS_MAX,
    scene::{
        Backdrop, Camera, CameraToWorld, CamerasMode, DropCount, Gaussians, HealthReport,
        Intrinsics, Provenance, Refine, Scene, SceneCamera, SceneId, SceneMeta, SceneOptions,
        SemanticsMode,
    },
};

/// Name of the camera of a scene that is a file.
const OVERVIEW: &str = "overview";
/// Its picture, pixels.
const SIZE: [u32; 2] = [512, 384];
/// Half of its vertical field of view, degrees.
const HALF_FOV: f64 = 30.0;
/// Largest coordinate of that camera: that of any camera of a request.
const COORDINATE_MAX: f64 = 1e9;

impl SplatsRead {
    /// The scene, with its semantics where the file has some and the options do not say `off`. Its
    /// id and the time of its creation are 0, and nothing but its options is said of its origin.
    ///
    /// # Errors
    /// `invalid_request` where no Gaussian is left, where they lie too far away, for semantics that
    /// are not those of the Gaussians, and for options that need photos; `limit_exceeded` for a
    /// bank of too many rows.
    pub fn into_scene(self, options: &SceneOptions) -> Result<Scene> {
        let Self { format, gaussians, antialiased, dropped, semantics } = self;
        check_options(format, options, semantics.is_some())?;
        let counts = dropped.counts().into_iter().filter(|(_, count)| *count > 0);
        let dropped: Vec<DropCount> =
            counts.map(|(reason, count)| DropCount { reason: reason.to_owned(), count }).collect();
        let name = format.name;
        if gaussians.is_empty() {
            let why: Vec<String> =
                dropped.iter().map(|drop| format!("{} {}", drop.count, drop.reason)).collect();
            let why = if why.is_empty() { "it has none".to_owned() } else { why.join(", ") };
            return Err(Error::invalid(format!(
                "{name}: the file has no Gaussian that can be drawn: {why}"
            )));
        }
        let (camera, distance) = overview(&gaussians)?;
        let reach = camera.camera_to_world.center().abs().max_element();
        if reach > COORDINATE_MAX {
            return Err(Error::invalid(format!(
                "{name}: the Gaussians lie at {reach:e}; coordinates reach at most \
                 {COORDINATE_MAX:e}"
            )));
        }
        let report = HealthReport {
            file_format: Some(name.to_owned()),
            antialiased,
            method: options.method(),
            gaussians: gaussians.len() as u64,
            dropped,
            median_depth: distance,
            network_focal_px: vec![0.0],
            ..HealthReport::default()
        };
        let cameras = vec![SceneCamera { file: OVERVIEW.to_owned(), camera, network: None }];
        let provenance = Provenance { options: options.clone(), ..Provenance::default() };
        let id = SceneId::from_bytes([0; 16]);
        let meta = SceneMeta { id, created_ms: 0, cameras, report, provenance };
        let wanted = options.semantics != SemanticsMode::Off;
        let Some(mut semantics) = semantics.filter(|_| wanted) else {
            // Entries of a bank that is not there.
            let index = vec![0; gaussians.len()];
            let gaussians = gaussians.with_semantic_index(index)?;
            return Ok(Scene::new(meta, gaussians, Backdrop::default()));
        };
        let rows = semantics.bank.len();
        if rows > BANK_ROWS_MAX {
            return Err(Error::limit(format!("{name}: rows of the bank"), rows, BANK_ROWS_MAX));
        }
        semantics.report.bank_size = rows as u32;
        semantics.report.labelled =
            semantics.index.iter().filter(|entry| **entry > 0).count() as u64;
        let scene = Scene::new(meta, gaussians, Backdrop::default());
        let foreign = |e: Error| Error::invalid(format!("{name}: {}", e.message()));
        scene.with_semantics(Arc::new(semantics)).map_err(foreign)
    }
}

/// Refuses what only photos give.
fn check_options(format: &SplatFormat, options: &SceneOptions, has_semantics: bool) -> Result<()> {
    let eager = options.semantics == SemanticsMode::Eager && !has_semantics;
    let wrong = match options {
        SceneOptions { max_views: Some(_), .. } => "max_views",
        SceneOptions { cameras: CamerasMode::Solve, .. } => "cameras",
        SceneOptions { density: Some(_), .. } => "density",
        SceneOptions { refine: Some(Refine::Ms(_)), .. } => "refine",
        SceneOptions { ignore, .. } if !ignore.is_empty() => "ignore",
        _ if eager => "semantics=eager",
        _ => return Ok(()),
    };
    let name = format.name;
    Err(Error::invalid(format!(
        "{wrong}: it needs photos, and a file of Gaussians ({name}) has none"
    )))
}

/// A camera that sees the Gaussians, of which there is one at least, and its distance from their
/// middle, world units.
fn overview(gaussians: &Gaussians) -> Result<(Camera, f64)> {
    let (middle, radius) = reach(gaussians);
    let half = HALF_FOV.to_radians();
    let distance = radius / half.sin();
    let DVec3 { x, y, z } = gaussians.origin() + middle - DVec3::Z * distance;
    let pose = [1.0, 0.0, 0.0, x, 0.0, 1.0, 0.0, y, 0.0, 0.0, 1.0, z, 0.0, 0.0, 0.0, 1.0];
    let camera_to_world = CameraToWorld::from_row_major(&pose, OVERVIEW)?;
    let [width, height] = SIZE;
    let (w, h) = (f64::from(width), f64::from(height));
    let focal = h / 2.0 / half.tan();
    let intrinsics = Intrinsics { fx: focal, fy: focal, cx: w / 2.0, cy: h / 2.0, width, height };
    Ok((Camera { intrinsics, camera_to_world }, distance))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::{
        scene::{Density, RawGaussians, SourcePixel},
        splats::PLY,
    };

    fn read(means: Vec<[f32; 3]>, origin: DVec3) -> SplatsRead {
        let n = means.len();
        let raw = RawGaussians {
            origin,
            means,
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: vec![[0.5; 3]; n],
            opacities: vec![1.0; n],
            sh_degree: 0,
            sh: vec![[0.0; 3]; n],
            semantic_index: vec![7; n],
            source: vec![SourcePixel::default(); n],
        };
        SplatsRead::new(&PLY, raw, None).unwrap()
    }

    fn scene(read: SplatsRead) -> Result<Scene> {
        read.into_scene(&SceneOptions::default())
    }

    #[test]
    fn the_camera_sees_nine_of_ten_gaussians_in_the_middle_of_its_picture() {
        // A line of 100 along x, and one far away that must not matter.
        let mut means: Vec<[f32; 3]> = (0..100).map(|i| [i as f32, 2.0, 0.0]).collect();
        means.push([1e6, 0.0, 0.0]);
        let origin = DVec3::new(1e7, 0.0, -4.0);
        let scene = scene(read(means, origin)).unwrap();
        let SceneCamera { camera, network, .. } = &scene.meta.cameras[0];
        assert_eq!((scene.meta.cameras.len(), *network), (1, None));
        let distance = scene.meta.report.median_depth;
        assert!((distance - 2.0 * 45.0).abs() < 2.5, "{distance}");
        let project = |x: f64| {
            let at = camera.camera_to_world.viewmat();
            camera.intrinsics.project(at.transform_point3(origin + DVec3::new(x, 2.0, 0.0)))
        };
        assert!((project(50.0).0 - 256.0).abs() < 1e-6 && (project(50.0).1 - 192.0).abs() < 1e-6);
        assert!((5..95).all(|x| (0.0..512.0).contains(&project(f64::from(x)).0)));
        assert_eq!(scene.gaussians.semantic_index()[0], 0, "there is no bank");
        assert_eq!(scene.meta.report.file_format.as_deref(), Some("ply"));
    }

    #[test]
    fn one_gaussian_is_seen_and_none_and_a_far_one_are_refused() {
        let one = scene(read(vec![[0.0; 3]], DVec3::ZERO)).unwrap();
        assert!((one.meta.report.median_depth - 3.0).abs() < 1e-6);
        let none = scene(read(vec![[f32::NAN; 3]], DVec3::ZERO)).unwrap_err();
        assert!(none.message().contains("1 not_finite"), "{none}");
        let far = scene(read(vec![[0.0; 3]], DVec3::new(0.0, 2e9, 0.0))).unwrap_err();
        assert!(far.message().contains("at most 1e9"), "{far}");
    }

    #[test]
    fn options_that_need_photos_are_refused_by_name() {
        let none = SceneOptions::default;
        for (options, name) in [
            (SceneOptions { max_views: Some(2), ..none() }, "max_views"),
            (SceneOptions { density: Some(Density::Full), ..none() }, "density"),
            (SceneOptions { refine: Some(Refine::Ms(5)), ..none() }, "refine"),
            (SceneOptions { ignore: vec!["person".to_owned()], ..none() }, "ignore"),
            (SceneOptions { semantics: SemanticsMode::Eager, ..none() }, "semantics=eager"),
        ] {
            let refused = read(vec![[0.0; 3]], DVec3::ZERO).into_scene(&options).unwrap_err();
            assert!(refused.message().starts_with(name), "{refused}");
        }
        for refine in [Refine::Auto, Refine::Off] {
            let options = SceneOptions { refine: Some(refine), ..none() };
            assert!(read(vec![[0.0; 3]], DVec3::ZERO).into_scene(&options).is_ok());
        }
    }
}
