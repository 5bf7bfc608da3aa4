//! Gaussians that no photo confirms: they float in front of what photos see.
//!
//! Each Gaussian names the photo that gave it. What a photo gave is, cell by cell of its picture,
//! how far it sees. A Gaussian that lies well in front of most of that is seen through, and one at
//! a depth where the photo has others is confirmed; behind it, it is hidden, and nothing is said.
//! A floater is confirmed by no other photo, and seen through by two, or by the one that gave it:
//! there it stands alone before what this photo sees.

use glam::DVec3;
use rayon::prelude::*;

use crate::scene::{Gaussians, SceneCamera};

/// Cells across the longer side of a photo.
const CELLS: u32 = 48;
/// Photos that are asked of each Gaussian, evenly chosen of the others.
const ASKED_MAX: usize = 24;
/// How far before or behind another Gaussian, as a share of the depth, is not beside it.
const BESIDE: f64 = 0.05;
/// Share of the Gaussians of a cell beside one that is confirmed; a photo's own floaters are fewer.
const CONFIRMED: f64 = 0.05;
/// Share of the Gaussians of a cell that are behind one that is seen through.
const BEHIND: f64 = 0.5;
/// What must see through a floater, at least: photos, of which the one that gave it counts `OWN`.
const THROUGH_MIN: usize = 2;
const OWN: usize = 2;

/// Fewest photos of a scene that can have floaters.
pub const FLOATERS_PHOTOS_MIN: usize = 3;

/// Which Gaussians of a scene with these cameras float.
#[must_use]
pub fn floaters(gaussians: &Gaussians, cameras: &[SceneCamera]) -> Vec<bool> {
    if cameras.len() < FLOATERS_PHOTOS_MIN {
        return vec![false; gaussians.len()];
    }
    let places: Vec<(usize, DVec3)> = gaussians
        .means()
        .par_iter()
        .zip(gaussians.source())
        .map(|(mean, source)| {
            let place = DVec3::from(mean.map(f64::from)) + gaussians.origin();
            (usize::from(source.view), place)
        })
        .collect();
    let mut own: Vec<Vec<DVec3>> = vec![Vec::new(); cameras.len()];
    for (photo, place) in &places {
        if let Some(own) = own.get_mut(*photo) {
            own.push(*place);
        }
    }
    let seen: Vec<Seen<'_>> =
        cameras.par_iter().zip(&own).map(|(camera, own)| Seen::of(camera, own)).collect();
    let step = cameras.len().div_ceil(ASKED_MAX).max(1);
    places
        .par_iter()
        .with_min_len(1 << 10)
        .map(|(photo, place)| {
            let mut through = 0;
            for (other, seen) in seen.iter().enumerate() {
                let is_own = other == *photo;
                if !is_own && (other + photo) % step != 0 {
                    continue;
                }
                match (seen.says(*place, is_own), is_own) {
                    (Some(Says::Through), true) => through += OWN,
                    (Some(Says::Through), false) => through += 1,
                    (Some(Says::Confirmed), false) => return false,
                    _ => {}
                }
            }
            through >= THROUGH_MIN
        })
        .collect()
}

enum Says {
    Confirmed,
    Through,
}

/// How far a photo sees.
struct Seen<'c> {
    camera: &'c SceneCamera,
    /// Pixels of a cell.
    cell: f64,
    width: usize,
    /// The depths of each cell, ascending.
    depths: Vec<Vec<f64>>,
}

impl<'c> Seen<'c> {
    /// By what the photo gave.
    fn of(camera: &'c SceneCamera, own: &[DVec3]) -> Self {
        let lens = camera.camera.intrinsics;
        let cell = f64::from(lens.width.max(lens.height)) / f64::from(CELLS);
        let side = |length: u32| ((f64::from(length) / cell).ceil() as usize).max(1);
        let (width, height) = (side(lens.width), side(lens.height));
        let mut seen = Self { camera, cell, width, depths: Vec::new() };
        seen.depths.resize(width * height, Vec::new());
        for place in own {
            if let Some((at, z)) = seen.at(*place) {
                seen.depths[at].push(z);
            }
        }
        seen.depths.iter_mut().for_each(|cell| cell.sort_by(f64::total_cmp));
        seen
    }

    /// The cell of a place, and its depth.
    fn at(&self, place: DVec3) -> Option<(usize, f64)> {
        let lens = &self.camera.camera.intrinsics;
        let seen = self.camera.camera.camera_to_world.viewmat().transform_point3(place);
        if seen.z <= f64::EPSILON {
            return None;
        }
        let (x, y) = lens.project(seen);
        let inside = (0.0..f64::from(lens.width)).contains(&x);
        if !(inside && (0.0..f64::from(lens.height)).contains(&y)) {
            return None;
        }
        Some(((y / self.cell) as usize * self.width + (x / self.cell) as usize, seen.z))
    }

    /// Of a place, which is one of its own or not.
    fn says(&self, place: DVec3, is_own: bool) -> Option<Says> {
        let (at, z) = self.at(place)?;
        let cell = self.depths.get(at).filter(|cell| !cell.is_empty())?;
        let before = |z: f64| cell.partition_point(|one| *one < z);
        let [nearer, all_but_behind] = [z * (1.0 - BESIDE), z / (1.0 - BESIDE)].map(before);
        let beside = all_but_behind - nearer - usize::from(is_own);
        let all = cell.len() as f64;
        if beside as f64 > CONFIRMED * all {
            return Some(Says::Confirmed);
        }
        let behind = (cell.len() - all_but_behind) as f64;
        (behind >= BEHIND * all).then_some(Says::Through)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{Camera, CameraToWorld, Intrinsics, RawGaussians, SourcePixel};

    /// Cameras in a row that look at a wall at z = 4.
    fn camera(x: f64) -> SceneCamera {
        let intrinsics =
            Intrinsics { fx: 60.0, fy: 60.0, cx: 32.0, cy: 24.0, width: 64, height: 48 };
        let pose = [1., 0., 0., x, 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
        let camera_to_world = CameraToWorld::from_row_major(&pose, "test").unwrap();
        let camera = Camera { intrinsics, camera_to_world };
        SceneCamera { file: format!("{x}.png"), camera, network: None }
    }

    /// The wall as each photo gave it, then these places of the first photo.
    fn scene(photos: usize, more: &[[f32; 3]]) -> (Gaussians, Vec<SceneCamera>) {
        let cameras: Vec<_> = (0..photos).map(|i| camera(0.2 * i as f64)).collect();
        let mut raw = RawGaussians::default();
        let mut push = |mean: [f32; 3], view: u16| {
            raw.means.push(mean);
            raw.quats.push([1.0, 0.0, 0.0, 0.0]);
            raw.scales.push([0.02; 3]);
            raw.opacities.push(0.9);
            raw.sh.push([0.0; 3]);
            raw.semantic_index.push(0);
            raw.source.push(SourcePixel { view, x: 0, y: 0 });
        };
        for view in 0..photos as u16 {
            for i in 0..64 * 48 {
                let (x, y) = ((i % 64) as f32 + 0.5, (i / 64) as f32 + 0.5);
                let z = 4.0 + 0.01 * f32::from(view);
                push(
                    [0.2 * f32::from(view) + (x - 32.0) / 60.0 * z, (y - 24.0) / 60.0 * z, z],
                    view,
                );
            }
        }
        more.iter().for_each(|mean| push(*mean, 0));
        (Gaussians::sanitize(raw).unwrap().0, cameras)
    }

    #[test]
    fn what_two_photos_see_through_and_none_confirms_floats() {
        // In front of the wall; near it; behind it; where its own photo alone sees the wall.
        let more = [[0.3, 0.0, 2.0], [0.3, 0.1, 3.9], [0.3, 0.0, 6.0], [-1.0, 0.0, 2.0]];
        let (gaussians, cameras) = scene(5, &more);
        let found = floaters(&gaussians, &cameras);
        let count = gaussians.len();
        assert_eq!(found[count - 4..], [true, false, false, true]);
        assert!(!found[..count - 4].contains(&true), "the wall stays");
        let (gaussians, cameras) = scene(2, &more);
        assert!(!floaters(&gaussians, &cameras).contains(&true), "one other photo is too few");
        assert_eq!(floaters(&gaussians, &[]).len(), gaussians.len(), "a file without photos");
    }

    /// A thing that one photo gave and another one gave too is there, though others see past it.
    #[test]
    fn what_another_photo_confirms_stays() {
        let (gaussians, cameras) = scene(5, &[[0.3, 0.0, 2.0]; 30]);
        let mut raw = gaussians.into_raw();
        let count = raw.means.len();
        // Seen by photo 1 as well, where it is all that this one gave in its cells.
        raw.source[count - 10..].iter_mut().for_each(|source| source.view = 1);
        let near = |mean: &[f32; 3]| (mean[0] - 0.5).abs() < 0.6 && mean[1].abs() < 0.3;
        for i in 0..count - 30 {
            if raw.source[i].view == 1 && near(&raw.means[i]) {
                raw.source[i].view = 4;
            }
        }
        let gaussians = Gaussians::restore(raw).unwrap();
        let found = floaters(&gaussians, &cameras);
        assert!(found[count - 30..count - 10].iter().all(|is| !is), "photo 1 confirms them");
    }
}
