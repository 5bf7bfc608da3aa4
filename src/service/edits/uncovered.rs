//! How much of what photos show has nothing any more after edits: the hole that is left where no
//! photo saw what is behind a deleted thing.

use glam::DVec3;
use rayon::prelude::*;

use crate::scene::{Gaussians, SceneCamera};

/// Cells across the longer side of a photo.
const CELLS: u32 = 96;
/// Photos that are looked at, evenly chosen.
const PHOTOS_MAX: usize = 16;

/// The share of the cells of all photos with Gaussians of `before` that have none of `after`, 0 to
/// 1. A Gaussian covers the cells that its largest scale reaches around its centre.
pub(super) fn uncovered(cameras: &[SceneCamera], before: &Gaussians, after: &Gaussians) -> f64 {
    let step = cameras.len().div_ceil(PHOTOS_MAX).max(1);
    let chosen: Vec<_> = cameras.iter().step_by(step).collect();
    let count = |camera: &&SceneCamera| {
        let [before, after] = [before, after].map(|gaussians| covered(camera, gaussians));
        let gone = before.iter().zip(&after).filter(|(before, after)| **before && !**after);
        (gone.count(), before.iter().filter(|cell| **cell).count())
    };
    let counts: Vec<_> = chosen.par_iter().map(count).collect();
    let (gone, all) = counts.iter().fold((0, 0), |sum, one| (sum.0 + one.0, sum.1 + one.1));
    gone as f64 / all.max(1) as f64
}

/// Which cells of a photo, row by row, some Gaussian covers.
fn covered(camera: &SceneCamera, gaussians: &Gaussians) -> Vec<bool> {
    let whole = camera.camera.intrinsics;
    let longest = whole.width.max(whole.height).max(1);
    let side = |length: u32| (CELLS * length).div_ceil(longest).max(1);
    let lens = whole.resized(side(whole.width), side(whole.height));
    let (width, height) = (lens.width as usize, lens.height as usize);
    let view = camera.camera.camera_to_world.viewmat();
    let mut cells = vec![false; width * height];
    for (mean, scale) in gaussians.means().iter().zip(gaussians.scales()) {
        let point = DVec3::from(mean.map(f64::from)) + gaussians.origin();
        let seen = view.transform_point3(point);
        if seen.z <= f64::EPSILON {
            continue;
        }
        let (x, y) = lens.project(seen);
        let largest = f64::from(scale.iter().copied().fold(0.0, f32::max));
        let reach = lens.fx * largest / seen.z;
        let range = |at: f64, most: usize| {
            let [from, to] = [at - reach, at + reach].map(|v| v.floor().clamp(-1.0, most as f64));
            (from.max(0.0) as usize)..((to + 1.0).max(0.0) as usize).min(most)
        };
        let columns = range(x, width);
        for row in range(y, height) {
            cells[row * width + columns.start..row * width + columns.end.max(columns.start)]
                .fill(true);
        }
    }
    cells
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Camera, CameraToWorld, Intrinsics, RawGaussians, SourcePixel};

    /// Walls of 40 by 30 Gaussians, one at each depth.
    fn wall(depths: &[f32]) -> Gaussians {
        let at = |i: usize| [(i % 40) as f32 / 10.0 - 1.95, (i / 40 % 30) as f32 / 10.0 - 1.45];
        let means: Vec<_> = depths
            .iter()
            .flat_map(|depth| (0..1200).map(move |i| [at(i)[0], at(i)[1], *depth]))
            .collect();
        let n = means.len();
        let raw = RawGaussians {
            origin: DVec3::ZERO,
            means,
            quats: vec![[1.0, 0.0, 0.0, 0.0]; n],
            scales: vec![[0.06; 3]; n],
            opacities: vec![0.9; n],
            sh_degree: 0,
            sh: vec![[0.0; 3]; n],
            semantic_index: vec![0; n],
            source: vec![SourcePixel::default(); n],
        };
        Gaussians::sanitize(raw).unwrap().0
    }

    fn photo() -> SceneCamera {
        let intrinsics =
            Intrinsics { width: 400, height: 300, fx: 200.0, fy: 200.0, cx: 200.0, cy: 150.0 };
        let pose = CameraToWorld::look_at(DVec3::ZERO, DVec3::Z, DVec3::NEG_Y, "camera").unwrap();
        let camera = Camera { intrinsics, camera_to_world: pose };
        SceneCamera { file: "a.png".to_owned(), camera, network: None }
    }

    #[test]
    fn a_hole_is_what_nothing_is_behind() {
        let cameras = [photo(), photo()];
        let (one, two) = (wall(&[2.0]), wall(&[2.0, 2.5]));
        let left = |i: usize| one.means()[i][0] < 0.0;
        assert_eq!(uncovered(&cameras, &one, &one), 0.0);
        let half = uncovered(&cameras, &one, &one.only(left));
        assert!((0.45..0.5).contains(&half), "{half}");
        // The wall behind covers all but a margin: it is as large and farther away.
        let behind = uncovered(&cameras, &two, &two.only(|i| i >= 1200));
        assert!((0.3..0.4).contains(&behind), "1 - (2 / 2.5)^2 is not {behind}");
        let front = uncovered(&cameras, &two, &two.only(|i| i < 1200));
        assert_eq!(front, 0.0, "what was hidden leaves no hole");
        assert_eq!(uncovered(&[], &one, &one.only(left)), 0.0);
    }
}
