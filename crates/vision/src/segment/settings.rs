//! Thresholds and switches of the masks, and points that are known from elsewhere.

use crate::scene::{MaskLevel, OverlapNms};

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
    /// Which mask of a prompt [`crate::segment::everything`] takes.
    pub level: MaskLevel,
    /// Keep the cells of each mask from before others are laid on it.
    pub keep_wholes: bool,
    /// A pixel goes to the mask that is surest for its size, and stability counts as sureness
    /// ([`crate::segment::Proposal::sureness`]); else to the smallest, and predicted IoU alone
    /// counts.
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
