//! Gaussians that no photo confirms: they float in front of what photos see.
//!
//! Each Gaussian names the photo that gave it. What a photo gave is, cell by cell of its picture,
//! how far it sees. A Gaussian of another photo that lies well in front of that is seen through,
//! and one at that depth is confirmed; behind it, it is hidden, and nothing is said. A floater is
//! seen through by two photos or more, and confirmed by none.

use glam::DVec3;
use rayon::prelude::*;

use crate::scene::{Gaussians, SceneCamera};

/// Cells across the longer side of a photo.
const CELLS: u32 = 48;
/// Photos that are asked of each Gaussian, evenly chosen of the others.
const ASKED_MAX: usize = 24;
/// Share of the Gaussians of a cell, on each side, whose depth says nothing.
const TRIM: f64 = 0.1;
/// How far in front of what a photo sees, as a share of its depth, a Gaussian is seen through.
const IN_FRONT: f64 = 0.1;
/// Photos that see through a floater, at least.
const THROUGH_MIN: usize = 2;

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
                if other == *photo || (other + photo) % step != 0 {
                    continue;
                }
                match seen.says(*place) {
                    Some(Says::Confirmed) => return false,
                    Some(Says::Through) => through += 1,
                    None => {}
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
    /// Nearest and farthest depth of each cell; none where it gave nothing.
    depths: Vec<Option<[f64; 2]>>,
}

impl<'c> Seen<'c> {
    /// By what the photo gave.
    fn of(camera: &'c SceneCamera, own: &[DVec3]) -> Self {
        let lens = camera.camera.intrinsics;
        let cell = f64::from(lens.width.max(lens.height)) / f64::from(CELLS);
        let side = |length: u32| ((f64::from(length) / cell).ceil() as usize).max(1);
        let (width, height) = (side(lens.width), side(lens.height));
        let mut seen = Self { camera, cell, width, depths: Vec::new() };
        let mut all: Vec<Vec<f64>> = vec![Vec::new(); width * height];
        for place in own {
            if let Some((at, z)) = seen.at(*place) {
                all[at].push(z);
            }
        }
        let between = |mut cell: Vec<f64>| {
            cell.sort_by(f64::total_cmp);
            let out = (TRIM * cell.len() as f64) as usize;
            Some([*cell.get(out)?, *cell.get(cell.len() - 1 - out)?])
        };
        seen.depths = all.into_iter().map(between).collect();
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

    fn says(&self, place: DVec3) -> Option<Says> {
        let (at, z) = self.at(place)?;
        let [near, far] = (*self.depths.get(at)?)?;
        if z < near * (1.0 - IN_FRONT) {
            return Some(Says::Through);
        }
        (z <= far * (1.0 + IN_FRONT)).then_some(Says::Confirmed)
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
        // In front of the wall; near it; behind it; beside all photos but its own.
        let more = [[0.3, 0.0, 2.0], [0.3, 0.1, 3.9], [0.3, 0.0, 6.0], [-1.0, 0.0, 2.0]];
        let (gaussians, cameras) = scene(5, &more);
        let found = floaters(&gaussians, &cameras);
        let count = gaussians.len();
        assert_eq!(found[count - 4..], [true, false, false, false]);
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
