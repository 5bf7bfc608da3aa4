//! Photos of scene folders, the scenes that are made of them, and which scenes are reported.

use std::{cmp::Ordering, path::Path, sync::atomic::AtomicBool};

use glam::DVec3;
use rayon::prelude::*;
use serde_json::{Value, json};

use crate::{
    error::Result,
    limits::Limits,
    models::{ResizeFilter, fit},
    photo_files,
    pipeline::{
        self, PhotoSet, Pipeline, Reconstruction, Seen,
        growth::{self, Grown},
        reconstruct,
    },
    render::{Kinds, RenderRequest, plan::default_near},
    rows::means,
    scene::{
        Camera, Gaussians, Photo, PosedPhoto, Provenance, Scene, SceneId, SceneOptions, Watch,
    },
};

/// Side of the square photos that are compared, pixels, where none is asked for: the network's.
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

/// The photos of a scene folder, undistorted, cropped in the middle to their short side, `side`
/// pixels square.
pub(crate) fn squares(dir: &Path, side: u32) -> Result<Vec<PosedPhoto>> {
    let photos = photo_files::read_dir(dir, &Limits::default())?;
    let square = |posed: &PosedPhoto| {
        let fitted = fit(&posed.photo, &posed.camera, [side, side], ResizeFilter::Triangle);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..255")]
        let rgb = fitted.rgb.iter().map(|v| (v * 255.0).round() as u8).collect();
        PosedPhoto {
            file: posed.file.clone(),
            photo: Photo { width: side, height: side, rgb, valid: fitted.valid },
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

/// The *projected overlap* of two photos, 0 to 1, by which pixelSplat, MVSplat and the paper choose
/// pairs of inputs: the share of a photo's pixels whose ray, without an end, comes into the other's
/// picture; of both shares the smaller one. Nothing is known of depth, so what hides what does not
/// count, and cameras that look the same way overlap wholly.
#[must_use]
pub fn overlap(a: &Camera, b: &Camera) -> f64 {
    crossing(a, b).min(crossing(b, a))
}

/// Share of the pixels of `from` whose ray comes into the picture of `to`.
fn crossing(from: &Camera, to: &Camera) -> f64 {
    let (lens, other) = (from.intrinsics, to.intrinsics);
    let moved = to.camera_to_world.viewmat() * from.camera_to_world.matrix();
    let [width, height] = [other.width, other.height].map(f64::from);
    // Distances to the planes that bound what `to` sees: none is negative inside.
    let sides = |p: DVec3| {
        let (u, v) = (other.fx * p.x + other.cx * p.z, other.fy * p.y + other.cy * p.z);
        [p.z, u, width * p.z - u, v, height * p.z - v]
    };
    let origin = sides(moved.w_axis.truncate());
    let crosses = |x: u32, y: u32| {
        let way = lens.unproject(f64::from(x) + 0.5, f64::from(y) + 0.5, 1.0);
        let (mut near, mut far) = (0.0_f64, f64::INFINITY);
        for (at, slope) in origin.into_iter().zip(sides(moved.transform_vector3(way))) {
            match slope.total_cmp(&0.0) {
                Ordering::Greater => near = near.max(-at / slope),
                Ordering::Less => far = far.min(-at / slope),
                Ordering::Equal if at < 0.0 => return false,
                Ordering::Equal => (),
            }
        }
        near < far
    };
    let row = |y: u32| (0..lens.width).filter(|x| crosses(*x, y)).count();
    let count: usize = (0..lens.height).into_par_iter().map(row).sum();
    count as f64 / (f64::from(lens.width) * f64::from(lens.height))
}

/// `count` photos beside the target, each two of which overlap by `least` or more: from the nearest
/// one on, the nearest that fit. `None` where there are not so many.
#[must_use]
pub fn inputs(
    photos: &[PosedPhoto],
    target: usize,
    count: usize,
    least: f64,
) -> Option<Vec<usize>> {
    let near = nearest(photos, target, photos.len());
    let fits =
        |a: usize, b: usize| least <= 0.0 || overlap(&photos[a].camera, &photos[b].camera) >= least;
    (0..near.len()).find_map(|first| {
        let mut chosen = Vec::new();
        for &next in &near[first..] {
            if chosen.len() < count && chosen.iter().all(|&one| fits(one, next)) {
                chosen.push(next);
            }
        }
        (chosen.len() == count).then_some(chosen)
    })
}

/// `count` of the photos that are not `asked`, evenly spread; all of them where there are no more.
pub(crate) fn spread(photos: usize, asked: &[usize], count: usize) -> Vec<usize> {
    let others: Vec<usize> = (0..photos).filter(|photo| !asked.contains(photo)).collect();
    let count = count.min(others.len());
    (0..count).map(|i| others[(2 * i + 1) * others.len() / (2 * count)]).collect()
}

/// The Gaussians of the photos.
pub(crate) fn make(
    engine: &Pipeline,
    photos: &[PosedPhoto],
    options: &SceneOptions,
) -> Result<Reconstruction> {
    reconstruct(engine, photos, options, &|_, _| (), &AtomicBool::new(false))
}

/// As [`make`], and what the network said of the photos.
pub(crate) fn make_keeping(
    engine: &Pipeline,
    photos: &[PosedPhoto],
    options: &SceneOptions,
) -> Result<(Reconstruction, Seen)> {
    let photos = PhotoSet::given(photos.to_vec(), Vec::new(), 0.0);
    pipeline::make_keeping(engine, &photos, options, SILENT)
}

/// A scene of photos of which the first `before` were there already.
pub(crate) fn make_more(
    engine: &Pipeline,
    photos: &[PosedPhoto],
    before: usize,
    known: Seen,
    options: &SceneOptions,
) -> Result<Grown> {
    let photos = PhotoSet::given(photos.to_vec(), Vec::new(), 0.0);
    growth::make_more(engine, &photos, before, Some(known), options, SILENT)
}

/// What a refinement without the photos `held` begins with: the scene and its one set.
pub(crate) fn make_for_refinement(
    engine: &Pipeline,
    photos: &[PosedPhoto],
    held: &[usize],
    seen: &Seen,
) -> Result<(Reconstruction, Gaussians)> {
    pipeline::make_for_refinement(engine, photos, held, seen, SILENT)
}

/// The photos with cameras that their keypoints tell, and what the network says of them there.
pub(crate) fn recast(
    engine: &Pipeline,
    photos: &[PosedPhoto],
    options: &SceneOptions,
) -> Result<Option<(Vec<PosedPhoto>, Seen)>> {
    pipeline::cameras::recast(engine, photos, options, SILENT)
}

static NEVER: AtomicBool = AtomicBool::new(false);
pub(crate) const SILENT: Watch<'static> = Watch { progress: &|_, _| (), cancel: &NEVER };

/// A scene that is not stored.
pub(crate) fn scene_of(reconstruction: Reconstruction) -> Scene {
    reconstruction.into_scene(SceneId::from_bytes([0; 16]), 0, Provenance::default())
}

/// A view as the service draws it by default; `median_depth` is the scene's.
pub(crate) fn view_request(camera: Camera, kinds: Kinds, median_depth: f64) -> RenderRequest {
    RenderRequest::plain(camera, kinds, default_near(median_depth))
}
