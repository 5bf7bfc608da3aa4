//! Everything in a photo as masks: a grid of points is decoded, good masks stay, one a pixel.
//!
//! [`proposals`] is Segment Anything's everything-mode up to the end of its filters and NMS.
//! [`everything`] goes on to whole objects and one mask for each pixel. [`Settings`] has a switch
//! for each saving: masks are filtered on the decoder's own coarse grid, points are skipped where a
//! mask lies already, and points known from other photos come first. The decoder is behind
//! [`PromptDecoder`]: this module knows no network.

mod assign;
mod bitset;
mod crops;
mod filter;
mod nms;
mod photo_grid;
mod prompts;
mod regions;

use std::sync::atomic::AtomicBool;

pub use bitset::{Bitset, Box2};
pub use filter::iou_over;

use self::{filter::MaskFilter, photo_grid::PhotoGrid, prompts::Prompts};
use crate::{
    error::{Error, Result},
    scene::{
        JudgedMasks, MaskJudging, MaskLevel, MaskLogits, OverlapNms, Photo, PhotoMasks,
        unless_cancelled,
    },
};

/// A photo and the network that gives masks for its points.
pub trait PromptDecoder: Sync {
    /// Points that are best decoded together.
    fn batch(&self) -> usize;

    /// Side in pixels of the square that the network saw, and `[width, height]` of the photo in it.
    fn placed(&self) -> (u32, [u32; 2]);

    /// Masks of each point; points are shares 0..1 of the photo's width and height.
    ///
    /// # Errors
    /// What the network says.
    fn decode(&self, points: &[[f32; 2]]) -> Result<MaskLogits>;

    /// Levels and `[width, height]` of the grid of a decoder that judges masks at the photo's
    /// pixels by itself, and is to be asked for that.
    fn judges(&self) -> Option<(usize, [usize; 2])> {
        None
    }

    /// As [`Self::decode`], judged at the photo's pixels.
    ///
    /// # Errors
    /// What the network says; `internal` of a decoder that does not judge.
    fn judge(&self, _: &[[f32; 2]], _: &MaskJudging) -> Result<JudgedMasks> {
        Err(Error::internal("masks: the decoder does not judge masks"))
    }

    /// The same network on another photo: a part of this one, at its full size.
    ///
    /// # Errors
    /// What the network says.
    fn on<'a>(&'a self, photo: &'a Photo) -> Result<Box<dyn PromptDecoder + 'a>>;
}

/// A prompt that is known from elsewhere: where a mask of another photo reappears.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Seed {
    /// Shares 0..1 of width and height.
    pub point: [f32; 2],
}

/// Thresholds and switches.
#[derive(Clone, Debug, PartialEq)]
pub struct Settings {
    /// Points along one side of the grid.
    pub points_per_side: u32,
    /// A mask must have more predicted IoU than this.
    pub pred_iou_thresh: f32,
    /// A mask must have at least this stability.
    pub stability_score_thresh: f32,
    /// Logits between the stricter and the looser threshold, each side of 0.
    pub stability_score_offset: f32,
    /// Of two masks whose boxes have more IoU than this the less sure one goes.
    pub box_nms_thresh: f32,
    /// Of two masks with more IoU than this the less sure one goes; 1 switches it off.
    pub mask_nms_thresh: f32,
    /// Holes and islands of fewer cells go from a mask after NMS; 0: none. Judged at the photo's
    /// pixels where `full_resolution` is set.
    pub min_mask_region_area: u32,
    /// Layers of parts of the photo that the network sees again, where `full_resolution` is set;
    /// layer `i` has `2^i` parts each way.
    pub crop_n_layers: u32,
    /// How much the parts of layer 1 overlap, share of the photo's short side; the next half of it.
    pub crop_overlap_ratio: f64,
    /// In layer `i` the points of a side are divided by this to the power of `i`.
    pub crop_n_points_downscale_factor: u32,
    /// Of two masks of different parts whose boxes have more IoU than this that of the smaller part
    /// stays.
    pub crop_nms_thresh: f32,
    /// At the end, among all masks that are left.
    pub overlap_nms: Option<OverlapNms>,
    /// Smallest mask, share of the photo.
    pub min_area: f64,
    /// Largest mask, share of the photo.
    pub max_area: f64,
    /// A part goes where at least this share of it lies in the mask of a whole.
    pub part_thresh: f64,
    /// Cells of the index map along each side of a cell of logits, 1 and up.
    pub map_scale: u32,
    /// Filter masks at the photo's own pixels, as Segment Anything does, and not on the coarse
    /// grid.
    pub full_resolution: bool,
    /// Skip points where a mask lies already.
    pub skip_covered: bool,
    /// Decode the seeds first.
    pub use_seeds: bool,
    /// Which mask of a prompt [`everything`] takes.
    pub level: MaskLevel,
    /// Keep the cells of each mask from before others are laid on it.
    pub keep_wholes: bool,
    /// A pixel goes to the mask that is surest for its size, and stability counts as sureness
    /// ([`Proposal::sureness`]); else to the smallest, and predicted IoU alone counts.
    pub surest_first: bool,
}

impl Default for Settings {
    fn default() -> Self {
        Self {
            points_per_side: 32,
            pred_iou_thresh: 0.8,
            stability_score_thresh: 0.9,
            stability_score_offset: 1.0,
            box_nms_thresh: 0.7,
            mask_nms_thresh: 0.7,
            min_mask_region_area: 0,
            crop_n_layers: 0,
            crop_overlap_ratio: 512.0 / 1500.0,
            crop_n_points_downscale_factor: 1,
            crop_nms_thresh: 0.7,
            overlap_nms: None,
            min_area: 0.0005,
            max_area: 0.95,
            part_thresh: 0.85,
            map_scale: 2,
            full_resolution: false,
            skip_covered: true,
            use_seeds: true,
            level: MaskLevel::Widest,
            keep_wholes: false,
            surest_first: true,
        }
    }
}

impl Settings {
    /// These thresholds, but everything computed as Segment Anything does: full resolution, every
    /// point of the grid, no NMS of masks and none of `LangSplat`, no bounds on areas.
    #[must_use]
    pub fn exact(&self) -> Self {
        Self {
            mask_nms_thresh: 1.0,
            overlap_nms: None,
            min_area: 0.0,
            max_area: 1.0,
            full_resolution: true,
            skip_covered: false,
            use_seeds: false,
            surest_first: false,
            ..self.clone()
        }
    }
}

/// A mask that passed.
#[derive(Clone, Debug, Default)]
pub struct Proposal {
    /// Its cells.
    pub mask: Bitset,
    /// How many they are.
    pub area: u32,
    /// Around them.
    pub bounds: Box2,
    /// Which of the decoder's masks it is, from parts to the whole.
    pub level: usize,
    /// Predicted IoU.
    pub predicted_iou: f32,
    /// Stability.
    pub stability: f32,
    /// Its prompt, shares 0..1.
    pub point: [f32; 2],
    /// Logits of its box and one cell around it, where a finer map is wanted.
    logits: filter::Patch,
}

impl Proposal {
    /// Predicted IoU, times stability with [`Settings::surest_first`]. A network is unsure of the
    /// IoU on photos of a kind that it has not seen; whether the outline is sharp says more then.
    #[must_use]
    pub fn sureness(&self, settings: &Settings) -> f32 {
        if settings.surest_first { self.predicted_iou * self.stability } else { self.predicted_iou }
    }
}

/// The masks of a photo that passed.
#[derive(Clone, Debug, Default)]
pub struct Proposals {
    /// Columns of the masks' grid, which lies over the whole photo.
    pub width: usize,
    /// Rows.
    pub height: usize,
    /// The masks, surest first; those of the smallest parts of the photo before.
    pub masks: Vec<Proposal>,
    /// Points that were decoded.
    pub asked: usize,
}

/// All masks of a photo that pass the filters and NMS, parts and wholes alike.
///
/// # Errors
/// `cancelled`; `internal` when the decoder fails or its answer has no sense.
pub fn proposals(
    decoder: &dyn PromptDecoder,
    photo: &Photo,
    settings: &Settings,
    seeds: &[Seed],
    cancel: &AtomicBool,
) -> Result<Proposals> {
    Ok(passed(decoder, photo, settings, seeds, cancel, false)?.0)
}

/// What is in a photo: whole objects (or those of [`Settings::level`]), at most one a pixel.
///
/// # Errors
/// `cancelled`; `internal` when the decoder fails or its answer has no sense.
pub fn everything(
    decoder: &dyn PromptDecoder,
    photo: &Photo,
    settings: &Settings,
    seeds: &[Seed],
    cancel: &AtomicBool,
) -> Result<PhotoMasks> {
    let (found, photo_grid) = passed(decoder, photo, settings, seeds, cancel, true)?;
    let masks = photo_grid.map(|grid| assign::one_a_pixel(&found, grid, photo, settings));
    Ok(masks.unwrap_or_default())
}

/// The masks that pass the filters and NMS. With `wholes` one mask of each point,
/// by [`Settings::level`].
fn passed(
    decoder: &dyn PromptDecoder,
    photo: &Photo,
    settings: &Settings,
    seeds: &[Seed],
    cancel: &AtomicBool,
    wholes: bool,
) -> Result<(Proposals, Option<PhotoGrid>)> {
    let (mut found, photo_grid) = decoded(decoder, photo, settings, seeds, cancel, wholes)?;
    nms::suppress(&mut found.masks, settings);
    if settings.full_resolution && settings.crop_n_layers > 0 {
        crops::add(&mut found, decoder, photo, settings, cancel, wholes)?;
    }
    if settings.min_mask_region_area > 0 {
        let boxes = settings.box_nms_thresh.max(settings.crop_nms_thresh);
        regions::clean(&mut found, settings.min_mask_region_area as usize, boxes);
    }
    if let Some(nms) = &settings.overlap_nms {
        nms::overlap(&mut found.masks, nms);
    }
    Ok((found, photo_grid))
}

/// The masks that pass the filters, in the order of points; arguments as [`passed`].
fn decoded(
    decoder: &dyn PromptDecoder,
    photo: &Photo,
    settings: &Settings,
    seeds: &[Seed],
    cancel: &AtomicBool,
    wholes: bool,
) -> Result<(Proposals, Option<PhotoGrid>)> {
    let seeds = if settings.use_seeds { seeds } else { &[] };
    let mut prompts = Prompts::new(settings, seeds);
    let mut found = Proposals::default();
    let of = |answer| MaskFilter::new(decoder.placed(), answer, photo, settings);
    let judges = decoder.judges().filter(|_| settings.full_resolution);
    let mut filter: Option<MaskFilter> = judges.map(of).transpose()?;
    let judging = filter.as_ref().and_then(|filter| filter.judging(wholes));
    loop {
        let points = prompts.next(decoder.batch());
        if points.is_empty() {
            break;
        }
        unless_cancelled(cancel)?;
        let (masks, filter) = match (&judging, &mut filter) {
            (Some(how), Some(filter)) => {
                let judged = decoder.judge(&points, how)?;
                (filter.pass_judged(&judged, how, &points, wholes)?, filter)
            }
            (_, filter) => {
                let decoded = decoder.decode(&points)?;
                let filter = match filter {
                    Some(filter) => filter,
                    none => none.insert(of((decoded.levels, decoded.grid))?),
                };
                (filter.pass(&decoded, &points, wholes)?, filter)
            }
        };
        found.asked += points.len();
        [found.width, found.height] = filter.map();
        prompts.cover(&masks, filter.map(), filter.levels());
        found.masks.extend(masks);
    }
    Ok((found, filter.map(|filter| filter.photo_grid())))
}
