//! What refinement needs of the other stages: photos at the size at which they are learnt, the
//! scene of the photos that are not held out, and semantics that follow other Gaussians.

use super::Reconstruction;
use crate::{
    error::Result,
    models::{ResizeFilter, fit},
    refine,
    scene::{
        Gaussians, HealthReport, Method, Photo, PosedPhoto, RefineReport, Scene, SceneCamera,
        SceneMeta, Semantics,
    },
    semantics::{Views, from_source},
};

/// A photo whose longer side is `side` pixels, or as it is if that is shorter.
#[must_use]
pub fn at_side(posed: &PosedPhoto, side: u32) -> PosedPhoto {
    let (width, height) = (posed.photo.width, posed.photo.height);
    let longer = width.max(height);
    if longer <= side {
        return posed.clone();
    }
    let scaled = |length: u32| (length * side).div_ceil(longer).max(1);
    let size = [scaled(height), scaled(width)];
    let fitted = fit(&posed.photo, &posed.camera, size, ResizeFilter::default());
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..255")]
    let rgb = fitted.rgb.iter().map(|v| (v * 255.0).round() as u8).collect();
    let photo = Photo { width: scaled(width), height: scaled(height), rgb, valid: fitted.valid };
    PosedPhoto { photo, camera: fitted.camera, ..posed.clone() }
}

/// What refinement begins with: `learnt` and `one_set` were made of the photos of `scene` less
/// those held out, and get its place. Photos keep their numbers.
///
/// # Errors
/// `internal` when it is not a scene of these photos.
pub fn start_of(
    scene: &Scene,
    held: &[usize],
    (learnt, one_set): (Reconstruction, Gaussians),
) -> Result<(Scene, Gaussians)> {
    let kept = |i: &usize| !held.contains(i);
    let numbers: Vec<usize> = (0..scene.meta.cameras.len()).filter(kept).collect();
    let numbered = |gaussians: Gaussians| {
        let mut raw = gaussians.into_raw();
        for source in &mut raw.source {
            let number = numbers.get(usize::from(source.view)).copied().unwrap_or(usize::MAX);
            source.view = u16::try_from(number).unwrap_or(u16::MAX);
        }
        Gaussians::restore(raw)
    };
    let gaussians = numbered(learnt.gaussians)?;
    let mut cameras: Vec<SceneCamera> = scene.meta.cameras.clone();
    let mut focals = vec![0.0; cameras.len()];
    cameras.iter_mut().for_each(|camera| camera.network = None);
    for (i, &number) in numbers.iter().enumerate() {
        cameras[number].network = learnt.cameras.get(i).and_then(|camera| camera.network);
        focals[number] = learnt.report.network_focal_px.get(i).copied().unwrap_or(0.0);
    }
    let report = HealthReport {
        gaussians: gaussians.len() as u64,
        method: learnt.report.method,
        median_depth: learnt.report.median_depth,
        network_focal_px: focals,
        refinement: None,
        ..scene.meta.report.clone()
    };
    let meta = SceneMeta { cameras, report, ..scene.meta.clone() };
    Ok((Scene::new(meta, gaussians, learnt.backdrop), numbered(one_set)?))
}

/// A report with the numbers of the photos that are held out of `photos`.
#[must_use]
pub fn reported(photos: usize, found: &RefineReport) -> RefineReport {
    let held = refine::held_out(photos).into_iter();
    let held_out = held.filter_map(|i| u32::try_from(i).ok()).collect();
    RefineReport { held_out, ..found.clone() }
}

/// A version as a scene: of `start`, with the semantics that `served` has now.
///
/// # Errors
/// `internal` when the parts do not fit each other.
pub fn version_of(
    start: &Scene,
    served: &Scene,
    version: &refine::RefinedVersion,
) -> Result<Scene> {
    // One set of Gaussians: plain views show what was learnt.
    let method = Method { front_photos: 0, magnify: false, ..start.meta.report.method.clone() };
    let report = HealthReport {
        gaussians: version.gaussians.len() as u64,
        method,
        refinement: Some(reported(start.meta.cameras.len(), &version.report)),
        ..start.meta.report.clone()
    };
    let meta = SceneMeta { report, ..start.meta.clone() };
    let plain = Scene {
        meta,
        gaussians: version.gaussians.clone(),
        semantics: None,
        sha256: String::new(),
        semantics_sha256: String::new(),
        ..start.clone()
    };
    let Some(semantics) = &served.semantics else { return Ok(plain) };
    let semantics = follow(semantics, &plain);
    let with = plain.with_semantics(std::sync::Arc::new(semantics))?;
    Ok(Scene { semantics_sha256: served.semantics_sha256.clone(), ..with })
}

/// Semantics whose entries are given to the Gaussians of another version: by the same maps of the
/// photos, as at first.
fn follow(semantics: &Semantics, scene: &Scene) -> Semantics {
    let (gaussians, cameras) = (&scene.gaussians, &scene.meta.cameras[..]);
    let own = from_source(gaussians.source(), cameras, &semantics.photos);
    let index = match scene.meta.report.method.votes {
        true => Views::new(gaussians, cameras).vote(&own, &semantics.photos),
        false => own,
    };
    Semantics { index, ..semantics.clone() }
}
