//! The mask network as a decoder of points, and the masks of all photos of a scene.
//!
//! The first prompts of a photo lie where the masks of earlier photos reappear. The Gaussians of
//! these masks give the places in the world.

use std::{
    collections::BTreeMap,
    sync::atomic::{AtomicBool, AtomicUsize, Ordering},
};

use glam::DVec3;
use parking_lot::Mutex;
use rayon::prelude::*;

use crate::{
    center_of,
    error::Result,
    models::{MaskNetwork, MasksManifest, PhotoEmbedding, Provider},
    scene::{
        Gaussians, JudgedMasks, MaskJudging, MaskLogits, Method, Photo, PhotoMasks, PosedPhoto,
        SourcePixel, unless_cancelled,
    },
    seen_at,
    segment::{self, PromptDecoder, Seed, Settings},
};

/// Gives the masks of each photo to its argument, in any order.
pub type MasksOfPhotos<'a> = dyn Fn(&GiveMasks<'_>) -> Result<()> + Sync + 'a;
/// Takes the masks of the photo of this number. Fails with `cancelled` where they are not wanted.
pub type GiveMasks<'a> = dyn Fn(usize, PhotoMasks) -> Result<()> + Sync + 'a;

/// Cells along one side of the photo, each of which gets one seed: two views of a thing seed once.
const SEED_CELLS: usize = 32;
/// Gaussians that one thread looks up at a time.
const GAUSSIANS_A_TASK: usize = 1 << 12;

/// Whose turn it is where photos of a scene are at work side by side: each part of the network runs
/// for one of them at a time, so that a device needs no more memory than for one photo.
#[derive(Debug, Default)]
struct PartLocks {
    encoder: Mutex<()>,
    decoder: Mutex<()>,
}

/// A photo that the mask network has seen.
#[derive(Debug)]
pub struct SeenPhoto<'a> {
    network: &'a MaskNetwork,
    embedding: PhotoEmbedding,
    locks: Option<&'a PartLocks>,
}

impl<'a> SeenPhoto<'a> {
    /// Encodes the photo, once for all points.
    ///
    /// # Errors
    /// `internal` when the network fails.
    pub fn new(network: &'a MaskNetwork, photo: &Photo) -> Result<Self> {
        Self::in_turn(network, photo, None)
    }

    fn in_turn(
        network: &'a MaskNetwork,
        photo: &Photo,
        locks: Option<&'a PartLocks>,
    ) -> Result<Self> {
        let _lock = locks.map(|locks| locks.encoder.lock());
        Ok(Self { network, embedding: network.encode(photo)?, locks })
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
        let _lock = self.locks.map(|locks| locks.decoder.lock());
        // Masks under the threshold are dropped by the filter, which does not look at them.
        let least = segment::iou_over(self.network.manifest().pred_iou_thresh);
        self.network.decode_over(&self.embedding, points, least)
    }

    /// Where a device decodes: on a CPU the sparse sums of the filter are faster than products of
    /// matrices.
    fn judges(&self) -> Option<(usize, [usize; 2])> {
        let grid = self.network.judges().filter(|_| self.network.provider() != Provider::Cpu)?;
        Some((self.network.manifest().levels.len(), grid))
    }

    fn judge(&self, points: &[[f32; 2]], judging: &MaskJudging) -> Result<JudgedMasks> {
        let _lock = self.locks.map(|locks| locks.decoder.lock());
        self.network.judge(&self.embedding, points, judging)
    }

    fn on<'b>(&'b self, photo: &'b Photo) -> Result<Box<dyn PromptDecoder + 'b>> {
        Ok(Box::new(SeenPhoto::in_turn(self.network, photo, self.locks)?))
    }
}

/// The thresholds of the bundle, with the savings, level and filters of the method.
#[must_use]
pub fn settings(manifest: &MasksManifest, method: &Method) -> Settings {
    let at_pixels = manifest.min_mask_region_area > 0 || manifest.crop_n_layers > 0;
    let settings = Settings {
        points_per_side: manifest.points_per_side,
        pred_iou_thresh: manifest.pred_iou_thresh,
        stability_score_thresh: manifest.stability_score_thresh,
        stability_score_offset: manifest.stability_score_offset,
        box_nms_thresh: manifest.box_nms_thresh,
        mask_nms_thresh: manifest.mask_nms_thresh,
        min_mask_region_area: manifest.min_mask_region_area,
        crop_n_layers: manifest.crop_n_layers,
        crop_overlap_ratio: manifest.crop_overlap_ratio,
        crop_n_points_downscale_factor: manifest.crop_n_points_downscale_factor,
        crop_nms_thresh: manifest.crop_nms_thresh,
        overlap_nms: manifest.overlap_nms,
        min_area: manifest.min_area,
        full_resolution: method.full_resolution || at_pixels,
        skip_covered: method.skip_covered,
        use_seeds: method.seeds,
        level: method.mask_level,
        keep_wholes: method.crop_whole,
        ..Settings::default()
    };
    match method.mask_filters {
        true => settings,
        false => Settings {
            mask_nms_thresh: 1.0,
            min_area: 0.0,
            max_area: 1.0,
            surest_first: false,
            ..settings
        },
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
    collected(photos.len(), progress, &|give| {
        each_photo(network, photos, gaussians, settings, give, cancel)
    })
}

/// As [`photo_masks`]; those of a photo are given as soon as they are found.
///
/// # Errors
/// As [`photo_masks`], and what `give` says.
pub fn each_photo(
    network: &MaskNetwork,
    photos: &[PosedPhoto],
    gaussians: Option<&Gaussians>,
    settings: &Settings,
    give: &GiveMasks<'_>,
    cancel: &AtomicBool,
) -> Result<()> {
    let gaussians = gaussians.filter(|_| settings.use_seeds);
    if gaussians.is_none() && network.provider() != Provider::Cpu {
        return each_of_two(network, photos, settings, give, cancel);
    }
    let encoded = |posed: &PosedPhoto| SeenPhoto::new(network, &posed.photo);
    let mut places: Vec<DVec3> = Vec::new();
    let mut next = photos.first().map(encoded);
    for (at, posed) in photos.iter().enumerate() {
        let seeds = seeds_at(posed, &places);
        let seen = next.take().unwrap_or_else(|| encoded(posed))?;
        // The next photo is encoded meanwhile.
        let of_photo = std::thread::scope(|scope| {
            let ahead = photos.get(at + 1).map(|posed| scope.spawn(move || encoded(posed)));
            let found = segment::everything(&seen, &posed.photo, settings, &seeds, cancel);
            // One that panicked is encoded again, and panics where it can be seen.
            next = ahead.and_then(|ahead| ahead.join().ok());
            found
        })?;
        if let Some(gaussians) = gaussians {
            places.extend(middles(gaussians, photos, at, &of_photo));
        }
        give(at, of_photo)?;
    }
    Ok(())
}

/// As [`photo_masks`] without seeds, two photos at a time: while the host filters the masks of one,
/// a device decodes those of the other.
///
/// # Errors
/// As [`photo_masks`].
pub fn side_by_side(
    network: &MaskNetwork,
    photos: &[PosedPhoto],
    settings: &Settings,
    progress: &(dyn Fn(f32) + Sync),
    cancel: &AtomicBool,
) -> Result<Vec<PhotoMasks>> {
    collected(photos.len(), progress, &|give| each_of_two(network, photos, settings, give, cancel))
}

fn each_of_two(
    network: &MaskNetwork,
    photos: &[PosedPhoto],
    settings: &Settings,
    give: &GiveMasks<'_>,
    cancel: &AtomicBool,
) -> Result<()> {
    let (locks, next) = (PartLocks::default(), AtomicUsize::new(0));
    let found = |posed: &PosedPhoto| {
        unless_cancelled(cancel)?;
        let seen = SeenPhoto::in_turn(network, &posed.photo, Some(&locks))?;
        segment::everything(&seen, &posed.photo, settings, &[], cancel)
    };
    let work = || {
        loop {
            let at = next.fetch_add(1, Ordering::Relaxed);
            let Some(posed) = photos.get(at) else { return Ok(()) };
            // After a failure no other photo is begun.
            found(posed)
                .and_then(|masks| give(at, masks))
                .inspect_err(|_| next.store(photos.len(), Ordering::Relaxed))?;
        }
    };
    let (mine, other) = std::thread::scope(|scope| {
        let other = scope.spawn(work);
        let mine = work();
        (mine, other.join().unwrap_or_else(|panic| std::panic::resume_unwind(panic)))
    });
    mine.and(other)
}

/// The masks that `find` gives, in the order of the photos.
fn collected(
    photos: usize,
    progress: &(dyn Fn(f32) + Sync),
    find: &MasksOfPhotos<'_>,
) -> Result<Vec<PhotoMasks>> {
    let all = Mutex::new(BTreeMap::new());
    find(&|at, masks| {
        let mut all = all.lock();
        all.insert(at, masks);
        progress(all.len() as f32 / photos as f32);
        Ok(())
    })?;
    Ok(all.into_inner().into_values().collect())
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
    let of_view = |(view, masks): (usize, &PhotoMasks)| middles(gaussians, photos, view, masks);
    let places: Vec<DVec3> = earlier.iter().enumerate().flat_map(of_view).collect();
    seeds_at(&photos[to], &places)
}

/// At most one seed a cell, where the photo shows world points.
fn seeds_at(photo: &PosedPhoto, places: &[DVec3]) -> Vec<Seed> {
    let mut taken = vec![false; SEED_CELLS * SEED_CELLS];
    let mut seeds = Vec::new();
    for &world in places {
        let Some(point) = share_at(photo, world) else { continue };
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

/// The Gaussian nearest to the middle of each mask of a photo, where it has one: its world point.
fn middles(
    gaussians: &Gaussians,
    photos: &[PosedPhoto],
    view: usize,
    masks: &PhotoMasks,
) -> Vec<DVec3> {
    // The photo's Gaussians, the mask that each is of, and where in the photo.
    let of = |(i, source): (usize, &SourcePixel)| {
        let posed = photos.get(view).filter(|_| usize::from(source.view) == view)?;
        let point = share_at(posed, center_of(gaussians, i))?;
        let mask = usize::from(masks.map.at(point[0], point[1])).checked_sub(1)?;
        (mask < masks.masks.len()).then_some((i, mask, point))
    };
    let all = gaussians.source().par_iter().enumerate().with_min_len(GAUSSIANS_A_TASK);
    let found: Vec<(usize, usize, [f64; 2])> = all.filter_map(of).collect();
    let mut sums = vec![([0.0; 2], 0.0); masks.masks.len()];
    for (_, mask, point) in &found {
        let (sum, count) = &mut sums[*mask];
        *sum = [sum[0] + point[0], sum[1] + point[1]];
        *count += 1.0;
    }
    let mut best = vec![(f64::INFINITY, None); masks.masks.len()];
    for (i, mask, point) in found {
        let (sum, count) = sums[mask];
        let off = [0, 1].map(|axis| point[axis] - sum[axis] / count);
        let away = off[0] * off[0] + off[1] * off[1];
        if away < best[mask].0 {
            best[mask] = (away, Some(center_of(gaussians, i)));
        }
    }
    best.into_iter().filter_map(|(_, middle)| middle).collect()
}

/// Where a photo shows a world point, shares of width and height; `None` outside of it.
fn share_at(posed: &PosedPhoto, world: DVec3) -> Option<[f64; 2]> {
    let (_, u, v) = seen_at(&posed.camera, world)?;
    let lens = posed.camera.intrinsics;
    Some([u / f64::from(lens.width), v / f64::from(lens.height)])
}
