//! Gives each Gaussian of a photo the entry of its source pixel's cell.

use rayon::prelude::*;

use crate::scene::{IndexMap, SceneCamera, SourcePixel};

/// Replaces mask numbers by entries: mask k becomes `becomes[k - 1]`; 0 stays 0.
#[must_use]
pub fn relabel(map: &IndexMap, becomes: &[u16]) -> IndexMap {
    let entry = |mask: &u16| {
        usize::from(*mask).checked_sub(1).and_then(|k| becomes.get(k)).copied().unwrap_or(0)
    };
    IndexMap { index: map.index.iter().map(entry).collect(), ..*map }
}

/// `[N]` entry of each Gaussian, from its source pixel; 0 if its photo has no picture or no map.
#[must_use]
pub fn from_source(source: &[SourcePixel], cameras: &[SceneCamera], maps: &[IndexMap]) -> Vec<u16> {
    let shares: Vec<Option<[Vec<f64>; 2]>> = cameras.iter().map(shares).collect();
    let entry = |pixel: &SourcePixel| {
        let view = usize::from(pixel.view);
        let [columns, rows] = shares.get(view)?.as_ref()?;
        let (x, y) = (columns.get(usize::from(pixel.x))?, rows.get(usize::from(pixel.y))?);
        Some(maps.get(view)?.at(*x, *y))
    };
    source.par_iter().map(|pixel| entry(pixel).unwrap_or(0)).collect()
}

/// Where the columns and rows of the network's picture lie on the photo, shares 0..1 of its sides.
fn shares(camera: &SceneCamera) -> Option<[Vec<f64>; 2]> {
    let (n, p) = (camera.network?, camera.camera.intrinsics);
    let axis = |count: u32, [nc, nf]: [f64; 2], [pc, pf]: [f64; 2], side: u32| {
        let share = |i: u32| ((f64::from(i) + 0.5 - nc) / nf * pf + pc) / f64::from(side.max(1));
        (0..count).map(share).collect()
    };
    Some([
        axis(n.width, [n.cx, n.fx], [p.cx, p.fx], p.width),
        axis(n.height, [n.cy, n.fy], [p.cy, p.fy], p.height),
    ])
}
