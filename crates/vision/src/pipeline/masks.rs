//! The mask network as a decoder of points, and the masks of all photos of a scene.
//!
//! The first prompts of a photo lie where the masks of earlier photos reappear. The Gaussians of
//! these masks give the places in the world.

use std::sync::atomic::AtomicBool;

use crate::{
    center_of,
    error::Result,
    models::{MaskNetwork, MasksManifest, PhotoEmbedding},
    scene::{Gaussians, MaskLogits, Photo, PhotoMasks, PosedPhoto},
    seen_at,
    segment::{self, PromptDecoder, Seed, Settings},
};

/// Cells along one side of the photo, each of which gets one seed: two views of a thing seed once.
const SEED_CELLS: usize = 32;

/// A photo that the mask network has seen.
#[derive(Debug)]
pub struct SeenPhoto<'a> {
    network: &'a MaskNetwork,
    embedding: PhotoEmbedding,
}

impl<'a> SeenPhoto<'a> {
    /// Encodes the photo, once for all points.
    ///
    /// # Errors
    /// `internal` when the network fails.
    pub fn new(network: &'a MaskNetwork, photo: &Photo) -> Result<Self> {
        Ok(Self { network, embedding: network.encode(photo)? })
    }
}

impl PromptDecoder for SeenPhoto<'_> {
    fn batch(&self) -> usize {
        self.network.manifest().points_per_batch as usize
    }

    fn placed(&self) -> (u32, [u32; 2]) {
        (self.network.manifest().size, self.embedding.resized())
    }

    fn decode(&self, points: &[[f32; 2]]) -> Result<MaskLogits> {
        self.network.decode(&self.embedding, points)
    }
}

/// The thresholds of the bundle, with every saving on.
#[must_use]
pub fn settings(manifest: &MasksManifest) -> Settings {
    Settings {
        points_per_side: manifest.points_per_side,
        pred_iou_thresh: manifest.pred_iou_thresh,
        stability_score_thresh: manifest.stability_score_thresh,
        stability_score_offset: manifest.stability_score_offset,
        box_nms_thresh: manifest.box_nms_thresh,
        mask_nms_thresh: manifest.mask_nms_thresh,
        min_area: manifest.min_area,
        ..Settings::default()
    }
}

/// The masks of each photo. `gaussians` are those of the scene, for the seeds; `progress` gets the
/// fraction, 0 to 1.
///
/// # Errors
/// `cancelled`, or `internal` when the network fails.
pub fn photo_masks(
    network: &MaskNetwork,
    photos: &[PosedPhoto],
    gaussians: Option<&Gaussians>,
    settings: &Settings,
    progress: &(dyn Fn(f32) + Sync),
    cancel: &AtomicBool,
) -> Result<Vec<PhotoMasks>> {
    let mut masks: Vec<PhotoMasks> = Vec::new();
    for (at, posed) in photos.iter().enumerate() {
        progress(at as f32 / photos.len() as f32);
        let seeds = match gaussians {
            Some(gaussians) if settings.use_seeds => seeds(gaussians, photos, &masks, at),
            _ => Vec::new(),
        };
        let seen = SeenPhoto::new(network, &posed.photo)?;
        masks.push(segment::everything(&seen, &posed.photo, settings, &seeds, cancel)?);
    }
    progress(1.0);
    Ok(masks)
}

/// Where the masks of earlier photos reappear in photo `to`: of each mask the Gaussian nearest to
/// its middle, seen from there. At most one a cell of a coarse grid, in the order of the masks.
#[must_use]
pub fn seeds(
    gaussians: &Gaussians,
    photos: &[PosedPhoto],
    earlier: &[PhotoMasks],
    to: usize,
) -> Vec<Seed> {
    let middles = middles(gaussians, photos, earlier);
    let mut taken = vec![false; SEED_CELLS * SEED_CELLS];
    let mut seeds = Vec::new();
    for world in middles.into_iter().flatten().flatten() {
        let Some(point) = share_at(&photos[to], world) else { continue };
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "a cell")]
        let cell = point.map(|share| (share * SEED_CELLS as f64) as usize);
        let at = cell[1] * SEED_CELLS + cell[0];
        if !std::mem::replace(&mut taken[at], true) {
            #[expect(clippy::cast_possible_truncation, reason = "a share of the photo")]
            seeds.push(Seed { point: point.map(|share| share as f32) });
        }
    }
    seeds
}

/// Of each mask of each earlier photo the world point of the Gaussian nearest to its middle.
fn middles(
    gaussians: &Gaussians,
    photos: &[PosedPhoto],
    earlier: &[PhotoMasks],
) -> Vec<Vec<Option<glam::DVec3>>> {
    // The mask that each Gaussian is of, in the photo that made it, and where in that photo.
    let of = |i: usize| {
        let view = usize::from(gaussians.source().get(i)?.view);
        let point = share_at(photos.get(view)?, center_of(gaussians, i))?;
        let mask = usize::from(earlier.get(view)?.map.at(point[0], point[1])).checked_sub(1)?;
        Some((view, mask, point))
    };
    let found: Vec<_> = (0..gaussians.len()).map(of).collect();
    let each = |masks: &PhotoMasks| masks.masks.len();
    let mut sums: Vec<Vec<([f64; 2], f64)>> =
        earlier.iter().map(|masks| vec![([0.0; 2], 0.0); each(masks)]).collect();
    for (view, mask, point) in found.iter().flatten() {
        if let Some((sum, count)) = sums[*view].get_mut(*mask) {
            *sum = [sum[0] + point[0], sum[1] + point[1]];
            *count += 1.0;
        }
    }
    let mut best: Vec<Vec<(f64, Option<glam::DVec3>)>> =
        earlier.iter().map(|masks| vec![(f64::INFINITY, None); each(masks)]).collect();
    for (i, (view, mask, point)) in found.iter().enumerate().filter_map(|(i, f)| Some((i, (*f)?))) {
        let Some((sum, count)) = sums[view].get(mask) else { continue };
        let off = [0, 1].map(|axis| point[axis] - sum[axis] / count.max(1.0));
        let away = off[0] * off[0] + off[1] * off[1];
        if away < best[view][mask].0 {
            best[view][mask] = (away, Some(center_of(gaussians, i)));
        }
    }
    best.into_iter().map(|view| view.into_iter().map(|(_, middle)| middle).collect()).collect()
}

/// Where a photo shows a world point, shares of width and height; `None` outside of it.
fn share_at(posed: &PosedPhoto, world: glam::DVec3) -> Option<[f64; 2]> {
    let (_, u, v) = seen_at(&posed.camera, world)?;
    let lens = posed.camera.intrinsics;
    Some([u / f64::from(lens.width), v / f64::from(lens.height)])
}
