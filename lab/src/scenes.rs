//! Photos of scene folders, the scenes that are made of them, and which scenes are reported.

use std::{path::Path, sync::atomic::AtomicBool};

use rayon::prelude::*;
use serde_json::{Value, json};

use crate::{
    error::Result,
    limits::Limits,
    models::{ResizeFilter, fit},
    photo_files,
    pipeline::{Pipeline, Reconstruction, reconstruct},
    render::{Kinds, RenderRequest, plan::default_near},
    rows::means,
    scene::{Camera, Photo, PosedPhoto, Provenance, Scene, SceneId, SceneOptions},
};

/// Side of the square photos that are compared, pixels.
pub(crate) const SIDE: u32 = 256;
/// What scenes are used for. No constant is chosen on the scenes that are reported.
const USES: [&str; 2] = ["reported", "chooses"];
/// Real scenes whose figures are reported.
const REPORTED: [&str; 4] = ["coke_can", "duck_toy", "fox", "red_kitchen"];

/// What the scene is used for, one of [`USES`].
pub(crate) fn use_of(scene: &str) -> &'static str {
    USES[usize::from(!REPORTED.contains(&scene))]
}

/// A row of means over the rows of scenes for each use that has several scenes.
pub(crate) fn means_by_use(rows: &[Value]) -> Vec<Value> {
    let of_use = |of: &&str| {
        let rows: Vec<&Value> = rows.iter().filter(|row| row["use"] == **of).collect();
        let mut row = means(rows.iter().copied());
        row["scene"] = json!("**mean of scenes**");
        row["use"] = json!(of);
        (rows.len() > 1).then_some(row)
    };
    USES.iter().filter_map(of_use).collect()
}

/// Whether the folder holds posed photos.
pub(crate) fn is_posed(dir: &Path) -> bool {
    dir.join("transforms.json").is_file()
}

/// The photos of a scene folder, undistorted, cropped in the middle to their short side, [`SIDE`]
/// pixels square.
pub(crate) fn squares(dir: &Path) -> Result<Vec<PosedPhoto>> {
    let photos = photo_files::read_dir(dir, &Limits::default())?;
    let square = |posed: &PosedPhoto| {
        let fitted = fit(&posed.photo, &posed.camera, [SIDE, SIDE], ResizeFilter::Triangle);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..255")]
        let rgb = fitted.rgb.iter().map(|v| (v * 255.0).round() as u8).collect();
        PosedPhoto {
            file: posed.file.clone(),
            photo: Photo { width: SIDE, height: SIDE, rgb, valid: fitted.valid },
            camera: fitted.camera,
            intrinsics_made_for: None,
        }
    };
    Ok(photos.par_iter().map(square).collect())
}

/// The `count` other photos whose cameras are nearest to the target's, the nearest first.
#[must_use]
pub fn nearest(photos: &[PosedPhoto], target: usize, count: usize) -> Vec<usize> {
    let center = |i: usize| photos[i].camera.camera_to_world.center();
    let mut others: Vec<usize> = (0..photos.len()).filter(|i| *i != target).collect();
    let away = |i: &usize| center(*i).distance_squared(center(target));
    others.sort_by(|a, b| away(a).total_cmp(&away(b)));
    others.truncate(count);
    others
}

/// The Gaussians of the photos.
pub(crate) fn make(
    engine: &Pipeline,
    photos: &[PosedPhoto],
    options: &SceneOptions,
) -> Result<Reconstruction> {
    reconstruct(engine, photos, options, &|_, _| (), &AtomicBool::new(false))
}

/// A scene that is not stored.
pub(crate) fn scene_of(reconstruction: Reconstruction) -> Scene {
    reconstruction.into_scene(SceneId::from_bytes([0; 16]), 0, Provenance::default())
}

/// A view as the service draws it by default; `median_depth` is the scene's.
pub(crate) fn view_request(camera: Camera, kinds: Kinds, median_depth: f64) -> RenderRequest {
    RenderRequest::plain(camera, kinds, default_near(median_depth))
}
