//! Scene folders: which there are, which of them choose constants and which are reported, and
//! their photos.

use std::path::{Path, PathBuf};

use rayon::prelude::*;

use crate::{
    error::{Error, Result},
    limits::Limits,
    models::fit,
    photo_files,
    render::{Kinds, RenderRequest, plan::default_near},
    scene::{Camera, Photo, PosedPhoto, Provenance, Scene, SceneId},
};

/// Side of the square photos that are compared, pixels.
pub const SIDE: u32 = 256;
/// Real scenes whose figures are reported. No constant is chosen on them from now on; all other
/// scenes choose constants.
pub const REPORTED: [&str; 4] = ["coke_can", "duck_toy", "fox", "red_kitchen"];

/// Folders on the command line.
#[derive(Clone, Debug, Default, clap::Args)]
pub struct Folders {
    /// A scene folder, or a folder of scene folders
    pub dir: PathBuf,
    /// Only these scenes, by name, separated by commas [default: all]
    #[arg(long, value_delimiter = ',')]
    pub scenes: Vec<String>,
}

impl Folders {
    /// The folders for which `is_scene`, sorted by name: `dir` itself, or those in it. Each with
    /// its name.
    ///
    /// # Errors
    /// `invalid_request` where there is none, or none of a name that was asked for.
    pub fn find(&self, is_scene: impl Fn(&Path) -> bool) -> Result<Vec<(String, PathBuf)>> {
        let fault = |e: std::io::Error| Error::invalid(format!("the folder: {}", e.kind()));
        let name = |path: &Path| path.file_name().unwrap_or_default().to_string_lossy().into();
        let mut found: Vec<(String, PathBuf)> = Vec::new();
        if is_scene(&self.dir) {
            found.push((name(&self.dir), self.dir.clone()));
        } else {
            for entry in fs_err::read_dir(&self.dir).map_err(fault)? {
                let path = entry.map_err(fault)?.path();
                if is_scene(&path) {
                    found.push((name(&path), path));
                }
            }
        }
        let unknown = |wanted: &&String| !found.iter().any(|(name, _)| name == *wanted);
        if let Some(wanted) = self.scenes.iter().find(unknown) {
            return Err(Error::invalid(format!("no scene folder is called {wanted:?}")));
        }
        found.retain(|(name, _)| self.scenes.is_empty() || self.scenes.contains(name));
        found.sort();
        if found.is_empty() {
            return Err(Error::invalid("there is no scene folder"));
        }
        Ok(found)
    }
}

/// Whether the folder holds posed photos.
#[must_use]
pub fn is_posed(dir: &Path) -> bool {
    dir.join("transforms.json").is_file()
}

/// The photos of a scene folder, undistorted, cropped in the middle to their short side, [`SIDE`]
/// pixels square.
///
/// # Errors
/// Those of the reader of photos.
pub fn squares(dir: &Path) -> Result<Vec<PosedPhoto>> {
    let photos = photo_files::read_dir(dir, &Limits::default())?;
    let square = |posed: &PosedPhoto| {
        let fitted = fit(&posed.photo, &posed.camera, [SIDE, SIDE]);
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
pub fn nearest(cameras: &[Camera], target: usize, count: usize) -> Vec<usize> {
    let center = |i: usize| cameras[i].camera_to_world.center();
    let mut others: Vec<usize> = (0..cameras.len()).filter(|i| *i != target).collect();
    let away = |i: &usize| center(*i).distance_squared(center(target));
    others.sort_by(|a, b| away(a).total_cmp(&away(b)));
    others.truncate(count);
    others
}

/// A view as the service draws it by default; `median_depth` is the scene's.
#[must_use]
pub fn view_request(camera: Camera, kinds: Kinds, median_depth: f64) -> RenderRequest {
    RenderRequest::plain(camera, kinds, default_near(median_depth))
}

/// A scene that nobody stores.
#[must_use]
pub fn scene_of(made: crate::pipeline::Reconstruction) -> Scene {
    made.into_scene(SceneId::from_bytes([0; 16]), 0, Provenance::default())
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{CameraToWorld, Intrinsics};

    #[test]
    fn the_nearest_other_photos_are_the_input() {
        let at = |x: f64| Camera {
            intrinsics: Intrinsics { fx: 9., fy: 9., cx: 4., cy: 4., width: 8, height: 8 },
            camera_to_world: CameraToWorld::from_row_major(
                &[1., 0., 0., x, 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.],
                "t",
            )
            .unwrap(),
        };
        let cameras = [at(5.0), at(0.0), at(1.0), at(-2.0)];
        assert_eq!(nearest(&cameras, 1, 2), [2, 3]);
        assert_eq!(nearest(&cameras, 0, 2), [2, 1]);
        assert_eq!(nearest(&cameras, 0, 9).len(), 3);
    }
}
