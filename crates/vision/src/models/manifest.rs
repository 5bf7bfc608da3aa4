//! The sections of `bundle.toml`: the geometry network, the mask network, the image and text
//! towers, the networks that mask what a text says, find keypoints, match them and guess cameras.
//! `models/README.md` lists every key. A bundle without the second and third has no semantics; one
//! without keypoints takes no photos without cameras.

use std::{
    fmt::{Debug, Display},
    ops::RangeInclusive,
    path::Path,
};

use serde::Deserialize;

use crate::{
    error::{Error, ErrorCode},
    models::ResizeFilter,
    scene::{CropShape, OverlapNms},
};

/// Name of the manifest in a bundle's folder.
pub(super) const MANIFEST: &str = "bundle.toml";
/// Largest side of a bucket, pixels: `SourcePixel` counts in u16 and memory grows with the area.
pub(super) const BUCKET_SIDE_MAX: u32 = 4_096;

/// Views in one run of a geometry network, or of one that says where photos were taken.
const VIEWS_MAX: usize = 64;
/// Points along one side of the grid of prompts: 65,536 prompts a photo are minutes of work.
const POINTS_PER_SIDE_MAX: u32 = 256;
/// 1 + 4 + 16 + 64 runs of the encoder a photo.
const CROP_LAYERS_MAX: u32 = 3;
/// Prompts in one run of a decoder: their logits are in memory together.
const POINTS_PER_BATCH_MAX: u32 = 1_024;
/// Over this an answer is another one.
const TOLERANCE_MAX: f64 = 0.1;
/// Crops in one run of an image tower.
const BATCH_MAX: usize = 256;
/// Steps of the weight of a context.
const WEIGHTS_MAX: usize = 16;
/// Largest weight of a context beside the crop's.
const WEIGHT_MAX: f64 = 100.0;
/// Numbers of one embedding.
const DIM_MAX: usize = 4_096;
/// Keypoints of a photo: two photos are compared each with each.
const KEYPOINTS_MAX: usize = 8_192;
/// Tokens of one text.
const CONTEXT_MAX: usize = 1_024;

/// The files of a network: name and sha256 of its own, and of the weights beside it.
pub(super) type Files<'a> = ([&'a String; 2], [&'a Option<String>; 2]);

/// Declares the section of a network: the keys of its files, which all have, and those of its own.
/// (`serde(flatten)` would not say which key has a value of another type.)
macro_rules! network {
    ($(#[$of:meta])* pub struct $name:ident { $($own:tt)* }) => {
        $(#[$of])*
        pub struct $name {
            /// File in the bundle's folder.
            pub file: String,
            /// Its sha256, hex.
            pub sha256: String,
            /// File of the weights that are not in `file`.
            pub data: Option<String>,
            /// Its sha256, hex.
            pub data_sha256: Option<String>,
            $($own)*
        }

        impl $name {
            pub(super) fn files(&self) -> Files<'_> {
                ([&self.file, &self.sha256], [&self.data, &self.data_sha256])
            }
        }
    };
}

/// The rigid frame that a geometry network's outputs are in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum OutputFrame {
    /// Each view's own camera.
    Camera,
    /// The model frame: the first camera of the set.
    Model,
}

/// How camera translations are scaled into the model frame.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Translation {
    /// The largest distance between two cameras of the set is 1.
    LargestBaseline,
    /// World units.
    World,
    /// The nearest measured depth of the set's photos is this many model units.
    Near(f64),
    /// The median measured depth of all photos is this many model units.
    MedianDepth(f64),
}

/// Input tensor names of a geometry network.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GeometryInputs {
    /// `[V, 3, H, W]` f32.
    pub images: String,
    /// `[V, 3, 3]` f32, row 0 divided by W and row 1 by H.
    pub intrinsics: String,
    /// `[V, 4, 4]` f32, model frame.
    pub camera_to_world: String,
    /// `[V]` f32, model units.
    pub near: String,
    /// `[V]` f32, model units.
    pub far: String,
    /// `[V, K]` i64; absent for a network that chooses by itself.
    pub neighbors: Option<String>,
}

/// Output tensor names of a geometry network.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GeometryOutputs {
    /// `[V, H, W, 3]` f32, model units.
    pub means: String,
    /// `[V, H, W, 3]` f32, model units.
    pub scales: String,
    /// `[V, H, W, 4]` f32, wxyz.
    pub quats: String,
    /// `[V, H, W]` f32.
    pub opacities: String,
    /// `[V, H, W, K, 3]` f32.
    pub sh: String,
    /// `[V, H, W]` f32, 0..1; absent where the network has none (1 is taken).
    pub confidence: Option<String>,
}

network! {
    /// The geometry network in `bundle.toml`.
    #[derive(Clone, Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct GeometryManifest {
        /// The same network as the CPU runs it, where that is another file: 8-bit arithmetic, and
        /// operators of this program. It may take weights from the network's main file.
        pub cpu: Option<PlainFile>,
        /// The same network with other weights, for sets of more views.
        pub many: Option<ManyViews>,
        /// Licence of the weights.
        pub licence: String,
        /// Where the weights come from.
        pub source: String,
        /// Working sizes, `[height, width]`.
        pub buckets: Vec<[u32; 2]>,
        /// Fewest views at once.
        pub views_min: usize,
        /// Most views at once.
        pub views_max: usize,
        /// Most source views of a view.
        pub neighbors_max: usize,
        /// Degree of the spherical harmonics.
        pub sh_degree: u8,
        /// Frame of the outputs.
        pub output_frame: OutputFrame,
        /// Scale of the model frame.
        pub translation: Translation,
        /// `[near, far]` that every view gets, model units; absent: what is measured in each photo.
        pub near_far: Option<[f64; 2]>,
        /// Filter that brings a photo to the size of its bucket.
        #[serde(default)]
        pub resize: ResizeFilter,
        /// Subtracted from the 0..1 channels.
        pub mean: [f32; 3],
        /// Divides them after that.
        pub std: [f32; 3],
        /// Input names.
        pub inputs: GeometryInputs,
        /// Output names.
        pub outputs: GeometryOutputs,
    }
}

/// A file that has no section of its own.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PlainFile {
    /// File in the bundle's folder.
    pub file: String,
    /// Its sha256, hex.
    pub sha256: String,
}

impl PlainFile {
    pub(super) fn files(&self) -> Files<'_> {
        ([&self.file, &self.sha256], [&None, &None])
    }
}

/// Weights of a geometry network for sets of many views. Their file may take weights from the
/// network's main file.
#[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ManyViews {
    /// Fewest views of a set that they are for.
    pub views_min: usize,
    /// File in the bundle's folder.
    pub file: String,
    /// Its sha256, hex.
    pub sha256: String,
    /// The same as the CPU runs it, where that is another file.
    pub cpu: Option<PlainFile>,
}

/// A geometry network's weights, and the sets that they are for.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct GeometryWeights<'a> {
    /// The section that names them.
    pub part: &'static str,
    /// File in the bundle's folder.
    pub file: &'a str,
    /// The file that the CPU runs, where it is another one.
    pub cpu_file: Option<&'a str>,
    /// Views of a set.
    pub views: RangeInclusive<usize>,
}

impl GeometryManifest {
    /// All weights, by the views that they are for.
    #[must_use]
    pub fn weights(&self) -> Vec<GeometryWeights<'_>> {
        let least = self.views_min.max(2);
        let most = self.many.as_ref().map_or(self.views_max, |many| many.views_min - 1);
        let few = GeometryWeights {
            part: "geometry",
            file: &self.file,
            cpu_file: self.cpu.as_ref().map(|cpu| &*cpu.file),
            views: least..=most,
        };
        let many = self.many.as_ref().map(|many| GeometryWeights {
            part: "geometry.many",
            file: &many.file,
            cpu_file: many.cpu.as_ref().map(|cpu| &*cpu.file),
            views: many.views_min..=self.views_max,
        });
        [Some(few), many].into_iter().flatten().collect()
    }

    pub(super) fn validate(&self, faults: &mut Faults) {
        faults.network("geometry", self.files());
        if let Some(cpu) = &self.cpu {
            faults.network("geometry.cpu", cpu.files());
        }
        if let Some(many) = &self.many {
            faults.file("geometry.many", &many.file, &many.sha256);
            if let Some(cpu) = &many.cpu {
                faults.network("geometry.many.cpu", cpu.files());
            }
            let larger = self.views_min.max(2) + 1..=self.views_max;
            faults.range("geometry.many.views_min", many.views_min, larger);
        }
        let bad = |side: &u32| !(1..=BUCKET_SIDE_MAX).contains(side);
        if self.buckets.is_empty() || self.buckets.iter().flatten().any(bad) {
            let must = format!("hold [height, width] pairs of 1 to {BUCKET_SIDE_MAX}");
            faults.wrong("geometry.buckets", &self.buckets, &must);
        }
        if self.views_min < 1 || self.views_max < self.views_min || self.views_max < 2 {
            faults.0.push(format!(
                "geometry.views_min {} and views_max {} must be in order, and views_max at least 2",
                self.views_min, self.views_max
            ));
        }
        faults.range("geometry.views_max", self.views_max, 0..=VIEWS_MAX);
        if self.neighbors_max < 1 {
            faults.wrong("geometry.neighbors_max", &self.neighbors_max, "be at least 1");
        }
        faults.range("geometry.sh_degree", self.sh_degree, 0..=3);
        let positive = |v: f64| v.is_finite() && v > 0.0;
        if let Translation::Near(depth) | Translation::MedianDepth(depth) = self.translation
            && !positive(depth)
        {
            faults.wrong("geometry.translation", &self.translation, "hold a number over 0");
        }
        if let Some([near, far]) = self.near_far
            && !(positive(near) && positive(far) && near < far)
        {
            faults.wrong("geometry.near_far", &[near, far], "hold 0 < near < far");
        }
        faults.channels("geometry", self.mean, self.std);
    }
}

/// Signature of a mask network.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MaskAdapter {
    /// Segment Anything's own ONNX signature: photo resized by its longer side, padded right and
    /// bottom; one prompt or a batch of prompts in dimension 0.
    Sam,
    /// `EfficientSAM`'s: photo stretched to a square, prompts in dimension 1.
    EfficientSam,
}

/// The mask network in `bundle.toml`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MasksManifest {
    /// Signature of the two files.
    pub adapter: MaskAdapter,
    /// Licence of the weights.
    pub licence: String,
    /// Where the weights come from.
    pub source: String,
    /// Side in pixels of the square that the encoder takes.
    pub size: u32,
    /// Subtracted from the 0..1 channels.
    pub mean: [f32; 3],
    /// Divides them after that.
    pub std: [f32; 3],
    /// Filter that brings a photo into the square.
    #[serde(default)]
    pub resize: ResizeFilter,
    /// Which of the decoder's masks are used, from parts to the whole object.
    pub levels: Vec<usize>,
    /// Points along one side of the grid of prompts.
    #[serde(default = "defaults::points_per_side")]
    pub points_per_side: u32,
    /// Prompts in one run of the decoder, where it takes several.
    #[serde(default = "defaults::points_per_batch")]
    pub points_per_batch: u32,
    /// A mask must have more predicted IoU than this.
    #[serde(default = "defaults::pred_iou_thresh")]
    pub pred_iou_thresh: f32,
    /// A mask must have at least this stability.
    #[serde(default = "defaults::stability_score_thresh")]
    pub stability_score_thresh: f32,
    /// Logits between the stricter and the looser threshold, each side of 0.
    #[serde(default = "defaults::stability_score_offset")]
    pub stability_score_offset: f32,
    /// Of two masks whose boxes have more IoU than this the less sure one goes.
    #[serde(default = "defaults::nms_thresh")]
    pub box_nms_thresh: f32,
    /// Of two masks with more IoU than this the less sure one goes.
    #[serde(default = "defaults::nms_thresh")]
    pub mask_nms_thresh: f32,
    /// Holes and islands of fewer pixels go from a mask; 0: none. Masks are judged at the photo's
    /// pixels then, which takes longer than on the decoder's grid.
    #[serde(default)]
    pub min_mask_region_area: u32,
    /// Layers of parts of a photo that the network sees again; 0: none. Layer `i` has `4^i` parts.
    /// Masks are judged at the photo's pixels then.
    #[serde(default)]
    pub crop_n_layers: u32,
    /// How much the parts of layer 1 overlap, share of the photo's short side; the next half of it.
    #[serde(default = "defaults::crop_overlap_ratio")]
    pub crop_overlap_ratio: f64,
    /// In layer `i` the points of a side are divided by this to the power of `i`.
    #[serde(default = "defaults::crop_n_points_downscale_factor")]
    pub crop_n_points_downscale_factor: u32,
    /// Of two masks of different parts whose boxes have more IoU than this that of the smaller part
    /// stays.
    #[serde(default = "defaults::nms_thresh")]
    pub crop_nms_thresh: f32,
    /// `LangSplat`'s NMS by IoU, score and overlap, at the end; none where absent.
    pub overlap_nms: Option<OverlapNms>,
    /// Smallest mask, share of the photo.
    #[serde(default = "defaults::min_area")]
    pub min_area: f64,
    /// Most by which a device may differ from the CPU, root of mean squares, share of the answer;
    /// files of f16 need more than the default.
    #[serde(default = "defaults::tolerance")]
    pub tolerance: f64,
    /// The image encoder.
    pub encoder: MaskEncoderManifest,
    /// The prompt decoder.
    pub decoder: MaskDecoderManifest,
}

network! {
    /// The image encoder of a mask network.
    #[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct MaskEncoderManifest {
        /// Input: `[1, 3, size, size]` f32.
        pub input: String,
        /// Output that becomes the decoder's `image_embeddings`.
        pub output: String,
        /// Further outputs that the decoder takes under the same names.
        #[serde(default)]
        pub features: Vec<String>,
    }
}

network! {
    /// The prompt decoder of a mask network, with the names of its tensors; SAM's where not given.
    /// Inputs that the file does not have are not fed.
    #[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct MaskDecoderManifest {
        /// The encoder's output.
        #[serde(default = "defaults::image_embeddings")]
        pub image_embeddings: String,
        /// `[B, N, 2]` f32 (`efficient_sam`: `[1, B, N, 2]`), x and y.
        #[serde(default = "defaults::point_coords")]
        pub point_coords: String,
        /// `[B, N]` f32 (`efficient_sam`: `[1, B, N]`): 1 in, 0 out, 2 and 3 corners, -1 none.
        #[serde(default = "defaults::point_labels")]
        pub point_labels: String,
        /// `[1, 1, h, w]` f32, a former mask; none is given.
        #[serde(default = "defaults::mask_input")]
        pub mask_input: String,
        /// `[1]` f32, 0.
        #[serde(default = "defaults::has_mask_input")]
        pub has_mask_input: String,
        /// `[2]` f32 or i64, height and width of the photo.
        #[serde(default = "defaults::orig_im_size")]
        pub orig_im_size: String,
        /// `[B, K, h, w]` f32 (`efficient_sam`: `[1, B, K, h, w]`), logits.
        #[serde(default = "defaults::low_res_masks")]
        pub low_res_masks: String,
        /// `[B, K]` f32 (`efficient_sam`: `[1, B, K]`).
        #[serde(default = "defaults::iou_predictions")]
        pub iou_predictions: String,
    }
}

/// The pair of an image and a text tower in `bundle.toml`.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImageTextManifest {
    /// Licence of the weights.
    pub licence: String,
    /// Where the weights come from.
    pub source: String,
    /// Numbers of an embedding (D).
    pub dim: usize,
    /// Sharpness of the relevancy.
    pub tau: f32,
    /// Phrases that a text must beat.
    pub canon: Vec<String>,
    /// By how much (difference of cosines); less than 0: it may also be a little under them.
    #[serde(default)]
    pub margin: f32,
    /// Share of `words` that may fit an entry better than a text that selects it; 1: any.
    #[serde(default = "defaults::rivals")]
    pub rivals: f32,
    /// Coverage under which a pixel means nothing, 0..1.
    #[serde(default = "defaults::coverage_floor")]
    pub coverage_floor: f32,
    /// The image tower.
    pub image: ImageTowerManifest,
    /// The text tower.
    pub text: TextTowerManifest,
    /// What was measured of everyday words: JSON, a list of words.
    pub words: Option<PlainFile>,
}

network! {
    /// The image tower.
    #[derive(Clone, Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct ImageTowerManifest {
        /// Input: `[B, 3, size, size]` f32.
        pub input: String,
        /// Output: `[B, dim]` f32, of any length.
        pub output: String,
        /// Side of a crop, pixels.
        pub size: u32,
        /// Subtracted from the 0..1 channels.
        pub mean: [f32; 3],
        /// Divides them after that.
        pub std: [f32; 3],
        /// Filter that brings a crop to that side.
        #[serde(default)]
        pub resize: ResizeFilter,
        /// Added around a mask's box on each side, share of the box's longer side.
        #[serde(default)]
        pub crop_margin: f32,
        /// What a crop shows of a box that is no square.
        #[serde(default)]
        pub crop_shape: CropShape,
        /// Crops in one run, where the file takes several.
        #[serde(default = "defaults::batch")]
        pub batch: usize,
        /// Most by which a device may differ from the CPU, root of mean squares, share of the
        /// answer; a file of f16 needs more than the default.
        #[serde(default = "defaults::tolerance")]
        pub tolerance: f64,
        /// What it says of whole photos; absent where it takes crops only.
        pub dense: Option<DenseManifest>,
    }
}

/// The dense output of an image tower, which also takes whole photos.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct DenseManifest {
    /// Output: `[B, dim, H / cell, W / cell]` f32. Its mean under a mask is the mask's context, an
    /// embedding of any length.
    pub output: String,
    /// Longer side of a photo, pixels.
    pub side: u32,
    /// Side of a cell of the output, pixels; both sides of a photo are whole multiples of it.
    pub cell: u32,
    /// `[area, weight]`: how much the context of a mask of at least this area (share of the photo)
    /// weighs beside its crop, which weighs 1. Areas ascend; under the first the weight is 0.
    pub weights: Vec<[f64; 2]>,
}

impl DenseManifest {
    /// Weight of the context of a mask of this area, share of the photo.
    #[must_use]
    pub fn weight(&self, area: f64) -> f64 {
        let step = self.weights.iter().rev().find(|[least, _]| area >= *least);
        step.map_or(0.0, |[_, weight]| *weight)
    }

    /// Width and height at which a photo of `[width, height]` pixels goes in.
    #[must_use]
    pub fn fitted(&self, photo: [u32; 2]) -> [u32; 2] {
        in_cells(photo, self.side, self.cell)
    }

    fn validate(&self, faults: &mut Faults) {
        let key = "image_text.image.dense";
        faults.range(&format!("{key}.cell"), self.cell, 1..=BUCKET_SIDE_MAX);
        faults.range(&format!("{key}.side"), self.side, self.cell.max(1)..=BUCKET_SIDE_MAX);
        let fine = |[area, weight]: &[f64; 2]| {
            (0.0..=1.0).contains(area) && (0.0..=WEIGHT_MAX).contains(weight)
        };
        let count = (1..=WEIGHTS_MAX).contains(&self.weights.len());
        let ascend = self.weights.is_sorted_by(|a, b| a[0] < b[0]);
        if !count || !ascend || !self.weights.iter().all(fine) {
            let must = format!(
                "hold 1 to {WEIGHTS_MAX} pairs [area, weight], areas ascending in 0 to 1 and \
                 weights 0 to {WEIGHT_MAX}"
            );
            faults.wrong(&format!("{key}.weights"), &self.weights, &must);
        }
    }
}

network! {
    /// The text tower.
    #[derive(Clone, Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct TextTowerManifest {
        /// Tokenizer file in the bundle's folder.
        pub tokenizer: String,
        /// Its sha256, hex.
        pub tokenizer_sha256: String,
        /// Most tokens of a text; a longer one is cut.
        pub context: usize,
        /// Token of a word that is not known.
        #[serde(default = "defaults::unknown")]
        pub unknown: String,
        /// A word that the tokenizer cuts into pieces of fewer letters than this, on average,
        /// counts as not known, unless `words` has it; 0: none does.
        #[serde(default)]
        pub piece_letters: f32,
        /// Input: `[B, T]` i64.
        pub input_ids: String,
        /// Input: `[B, T]` i64, 1 for a token and 0 for padding; absent where the network has none.
        pub attention_mask: Option<String>,
        /// Output: `[B, dim]` f32, of any length.
        pub output: String,
    }
}

/// The network that masks what a text says in `bundle.toml`: a photo is encoded once, and each text
/// is looked for in what came of that.
#[derive(Clone, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TextMasksManifest {
    /// Licence of the weights.
    pub licence: String,
    /// Where the weights come from.
    pub source: String,
    /// Side in pixels of the square that a photo is stretched to.
    pub size: u32,
    /// Subtracted from the 0..1 channels.
    pub mean: [f32; 3],
    /// Divides them after that.
    pub std: [f32; 3],
    /// Filter that brings a photo into the square.
    #[serde(default)]
    pub resize: ResizeFilter,
    /// Least score of a mask, 0.5 to 1.
    #[serde(default = "defaults::threshold")]
    pub threshold: f32,
    /// Most by which a device may differ from the CPU, root of mean squares, share of the answer.
    #[serde(default = "defaults::tolerance")]
    pub tolerance: f64,
    /// What encodes a photo.
    pub image: TextMasksImageManifest,
    /// What finds a text in it.
    pub find: TextMasksFindManifest,
}

network! {
    /// The image encoder of a network that masks what a text says.
    #[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct TextMasksImageManifest {
        /// Input: `[1, 3, size, size]` f32.
        pub input: String,
        /// Outputs, which the other file takes under the same names.
        pub features: Vec<String>,
    }
}

network! {
    /// What finds a text in an encoded photo.
    #[derive(Clone, Debug, PartialEq, Eq, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct TextMasksFindManifest {
        /// Tokenizer file in the bundle's folder.
        pub tokenizer: String,
        /// Its sha256, hex.
        pub tokenizer_sha256: String,
        /// Most tokens of a text; a longer one is cut.
        pub context: usize,
        /// Input: `[1, T]` i64.
        pub input_ids: String,
        /// Input: `[1, T]` i64, 1 for a token and 0 for padding; absent where the network has none.
        pub attention_mask: Option<String>,
        /// Output: `[1, Q, h, w]` f32, logits over the whole photo; over 0 is inside.
        pub masks: String,
        /// Output: `[1, Q]` f32, 0..1: how sure it is that the mask is what the text says.
        pub scores: String,
    }
}

impl TextMasksManifest {
    pub(super) fn validate(&self, faults: &mut Faults) {
        let Self { image, find, .. } = self;
        faults.network("text_masks.image", image.files());
        faults.network("text_masks.find", find.files());
        faults.file("text_masks.find.tokenizer", &find.tokenizer, &find.tokenizer_sha256);
        faults.range("text_masks.size", self.size, 1..=BUCKET_SIDE_MAX);
        faults.channels("text_masks", self.mean, self.std);
        faults.range("text_masks.threshold", self.threshold, 0.5..=1.0);
        faults.range("text_masks.tolerance", self.tolerance, 0.0..=TOLERANCE_MAX);
        faults.range("text_masks.find.context", find.context, 1..=CONTEXT_MAX);
        if image.features.is_empty() {
            faults.wrong("text_masks.image.features", &image.features, "hold 1 or more names");
        }
    }
}

network! {
    /// The feature network in `bundle.toml`.
    #[derive(Clone, Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct FeaturesManifest {
        /// Licence of the weights.
        pub licence: String,
        /// Where the weights come from.
        pub source: String,
        /// Input: `[1, 3, H, W]` f32.
        pub input: String,
        /// Output: `[N, 2]` f32, x and y in pixels of the input, best first; the centre of the top
        /// left pixel is (0.5, 0.5).
        pub keypoints: String,
        /// Output: `[N]` f32, how good each is.
        pub scores: String,
        /// Output: `[N, dim]` f32, of length 1.
        pub descriptors: String,
        /// Longer side of a photo, pixels.
        pub side: u32,
        /// Both sides of a photo are whole multiples of this, pixels.
        pub cell: u32,
        /// Numbers of a descriptor.
        pub dim: usize,
        /// Most keypoints of a photo.
        pub count: usize,
        /// Two keypoints match only where the cosine of their descriptors is over this.
        pub similarity_min: f32,
        /// Filter that brings a photo to that size.
        #[serde(default)]
        pub resize: ResizeFilter,
        /// Subtracted from the 0..1 channels.
        pub mean: [f32; 3],
        /// Divides them after that.
        pub std: [f32; 3],
    }
}

impl FeaturesManifest {
    /// Width and height at which a photo of `[width, height]` pixels goes in.
    #[must_use]
    pub fn fitted(&self, photo: [u32; 2]) -> [u32; 2] {
        in_cells(photo, self.side, self.cell)
    }

    pub(super) fn validate(&self, faults: &mut Faults) {
        faults.network("features", self.files());
        faults.range("features.cell", self.cell, 1..=BUCKET_SIDE_MAX);
        faults.range("features.side", self.side, self.cell.max(1)..=BUCKET_SIDE_MAX);
        faults.range("features.dim", self.dim, 1..=DIM_MAX);
        faults.range("features.count", self.count, 1..=KEYPOINTS_MAX);
        faults.range("features.similarity_min", self.similarity_min, -1.0..=1.0);
        faults.channels("features", self.mean, self.std);
    }
}

network! {
    /// The network that matches keypoints in `bundle.toml`.
    #[derive(Clone, Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct MatcherManifest {
        /// Licence of the weights.
        pub licence: String,
        /// Where the weights come from.
        pub source: String,
        /// Inputs of the first and of the second photo: `[N, 2]` f32, x and y from the middle of
        /// the photo, halves of its longer side.
        pub keypoints: [String; 2],
        /// Inputs: `[N, dim]` f32, the descriptors of `[features]`.
        pub descriptors: [String; 2],
        /// Output: `[N]` f32 for each keypoint of the first photo, the place of its match among
        /// those of the second; -1: none.
        pub matches: String,
        /// Output: `[N]` f32, how sure each match is, 0..1.
        pub scores: String,
        /// Most keypoints of a photo, the best of those that there are.
        pub count: usize,
        /// A match counts where its score is over this.
        pub score_min: f32,
    }
}

impl MatcherManifest {
    /// `features`: whether the bundle has the network whose keypoints are matched.
    pub(super) fn validate(&self, features: bool, faults: &mut Faults) {
        faults.network("matcher", self.files());
        faults.range("matcher.count", self.count, 1..=KEYPOINTS_MAX);
        faults.range("matcher.score_min", self.score_min, 0.0..=1.0);
        if !features {
            faults.wrong("matcher.file", &self.file, "have the section [features] beside it");
        }
    }
}

network! {
    /// The network that says where photos were taken in `bundle.toml`.
    #[derive(Clone, Debug, PartialEq, Deserialize)]
    #[serde(deny_unknown_fields)]
    pub struct CamerasManifest {
        /// Licence of the weights.
        pub licence: String,
        /// Where the weights come from.
        pub source: String,
        /// Input: `[V, 3, H, W]` f32, photos of one shape.
        pub input: String,
        /// Output: `[V, 3, 4]` f32, world to camera, of one world and scale.
        pub world_to_camera: String,
        /// Output: `[V, 3, 3]` f32, pixels of the input.
        pub intrinsics: String,
        /// Output: `[V, H, W]` f32, depths in the scale of the cameras; absent where the network
        /// gives none. For callers that run the network by itself.
        pub depth: Option<String>,
        /// Output: `[V, H, W]` f32, how sure each depth is.
        pub depth_confidence: Option<String>,
        /// Most photos of a run.
        pub views_max: usize,
        /// Longer side of a photo, pixels.
        pub side: u32,
        /// Both sides of a photo are whole multiples of this, pixels.
        pub cell: u32,
        /// Filter that brings a photo to that size.
        #[serde(default)]
        pub resize: ResizeFilter,
        /// Subtracted from the 0..1 channels.
        pub mean: [f32; 3],
        /// Divides them after that.
        pub std: [f32; 3],
        /// Most by which a device may differ from the CPU, root of mean squares, share of the
        /// answer.
        #[serde(default = "defaults::tolerance")]
        pub tolerance: f64,
    }
}

impl CamerasManifest {
    /// Width and height at which a photo of `[width, height]` pixels goes in.
    #[must_use]
    pub fn fitted(&self, photo: [u32; 2]) -> [u32; 2] {
        in_cells(photo, self.side, self.cell)
    }

    /// `features`: whether the bundle has the network whose keypoints judge the cameras.
    pub(super) fn validate(&self, features: bool, faults: &mut Faults) {
        faults.network("cameras", self.files());
        faults.range("cameras.views_max", self.views_max, 2..=VIEWS_MAX);
        faults.range("cameras.cell", self.cell, 1..=BUCKET_SIDE_MAX);
        faults.range("cameras.side", self.side, self.cell.max(1)..=BUCKET_SIDE_MAX);
        faults.range("cameras.tolerance", self.tolerance, 0.0..=TOLERANCE_MAX);
        faults.channels("cameras", self.mean, self.std);
        if !features {
            faults.wrong("cameras.file", &self.file, "have the section [features] beside it");
        }
    }
}

/// Width and height of a photo whose longer side becomes `side`, both whole multiples of `cell`.
fn in_cells(photo: [u32; 2], side: u32, cell: u32) -> [u32; 2] {
    let longer = f64::from(photo[0].max(photo[1]).max(1));
    photo.map(|length| {
        let cells = f64::from(length) / longer * f64::from(side) / f64::from(cell);
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "few")]
        let cells = cells.round_ties_even().max(1.0) as u32;
        cells * cell
    })
}

/// Declares a function for each default value, as serde wants them.
macro_rules! defaults {
    ($($name:ident: $kind:ty = $value:expr;)*) => {
        $(pub(super) fn $name() -> $kind { $value.into() })*
    };
}

/// SAM's names, and the numbers that most bundles use.
mod defaults {
    defaults! {
        points_per_side: u32 = 32_u32;
        points_per_batch: u32 = 64_u32;
        pred_iou_thresh: f32 = 0.8_f32;
        stability_score_thresh: f32 = 0.9_f32;
        stability_score_offset: f32 = 1.0_f32;
        nms_thresh: f32 = 0.7_f32;
        crop_overlap_ratio: f64 = 512.0 / 1500.0;
        crop_n_points_downscale_factor: u32 = 1_u32;
        min_area: f64 = 0.0005;
        coverage_floor: f32 = 0.05_f32;
        rivals: f32 = 1.0_f32;
        batch: usize = 16_usize;
        tolerance: f64 = 2e-3;
        threshold: f32 = 0.5_f32;
        image_embeddings: String = "image_embeddings";
        point_coords: String = "point_coords";
        point_labels: String = "point_labels";
        mask_input: String = "mask_input";
        has_mask_input: String = "has_mask_input";
        orig_im_size: String = "orig_im_size";
        low_res_masks: String = "low_res_masks";
        iou_predictions: String = "iou_predictions";
        unknown: String = "[UNK]";
    }
}

/// `model_unavailable` with `message`.
pub(super) fn unavailable(message: impl Into<String>) -> Error {
    Error::new(ErrorCode::ModelUnavailable, message)
}

/// Whether a file of this name lies in the bundle's folder itself.
pub(super) fn is_plain(file: &str) -> bool {
    !file.is_empty() && Path::new(file).components().count() == 1 && !file.starts_with('.')
}

/// Everything that does not fit in a manifest: each with its key, its value and what it must be.
#[derive(Debug, Default)]
pub(super) struct Faults(pub(super) Vec<String>);

impl Faults {
    fn wrong(&mut self, key: &str, value: &dyn Debug, must: &str) {
        self.0.push(format!("{key} is {value:?}; it must {must}"));
    }

    /// A file of the bundle: its name and hash.
    fn file(&mut self, section: &str, file: &str, sha256: &str) {
        if !is_plain(file) {
            self.wrong(&format!("{section}.file"), &file, "be a plain file name");
        }
        if sha256.len() != 64 || !sha256.bytes().all(|b| b.is_ascii_hexdigit()) {
            self.wrong(&format!("{section}.sha256"), &sha256, "be 64 hex digits");
        }
    }

    /// A network: its file, and one of weights beside it with both keys or none.
    fn network(&mut self, section: &str, ([file, sha256], data): Files<'_>) {
        self.file(section, file, sha256);
        match data {
            [Some(file), Some(sha256)] => self.file(&format!("{section}.data"), file, sha256),
            [None, None] => {}
            _ => self.0.push(format!("{section}.data and data_sha256 go together")),
        }
    }

    /// A number between two bounds, both included.
    fn range<T: Copy + PartialOrd + Debug + Display>(
        &mut self,
        key: &str,
        value: T,
        range: RangeInclusive<T>,
    ) {
        if !range.contains(&value) {
            self.wrong(key, &value, &format!("be {} to {}", range.start(), range.end()));
        }
    }

    /// The normalisation of channels.
    fn channels(&mut self, section: &str, mean: [f32; 3], std: [f32; 3]) {
        if mean.iter().any(|v| !v.is_finite()) {
            self.wrong(&format!("{section}.mean"), &mean, "hold numbers");
        }
        if std.iter().any(|v| !v.is_finite() || *v <= 0.0) {
            self.wrong(&format!("{section}.std"), &std, "hold numbers over 0");
        }
    }
}

impl MasksManifest {
    pub(super) fn validate(&self, faults: &mut Faults) {
        let (encoder, decoder) = (&self.encoder, &self.decoder);
        faults.network("masks.encoder", encoder.files());
        faults.network("masks.decoder", decoder.files());
        faults.range("masks.size", self.size, 1..=BUCKET_SIDE_MAX);
        faults.channels("masks", self.mean, self.std);
        if self.levels.is_empty() || self.levels.iter().any(|&level| level > 15) {
            faults.wrong("masks.levels", &self.levels, "hold 1 or more of 0 to 15");
        }
        faults.range("masks.tolerance", self.tolerance, 0.0..=TOLERANCE_MAX);
        faults.range("masks.points_per_side", self.points_per_side, 1..=POINTS_PER_SIDE_MAX);
        faults.range("masks.points_per_batch", self.points_per_batch, 1..=POINTS_PER_BATCH_MAX);
        faults.range("masks.pred_iou_thresh", self.pred_iou_thresh, 0.0..=1.0);
        faults.range("masks.stability_score_thresh", self.stability_score_thresh, 0.0..=1.0);
        faults.range("masks.box_nms_thresh", self.box_nms_thresh, 0.0..=1.0);
        faults.range("masks.mask_nms_thresh", self.mask_nms_thresh, 0.0..=1.0);
        faults.range("masks.crop_n_layers", self.crop_n_layers, 0..=CROP_LAYERS_MAX);
        faults.range("masks.crop_overlap_ratio", self.crop_overlap_ratio, 0.0..=1.0);
        let fewer = self.crop_n_points_downscale_factor;
        faults.range("masks.crop_n_points_downscale_factor", fewer, 1..=POINTS_PER_SIDE_MAX);
        faults.range("masks.crop_nms_thresh", self.crop_nms_thresh, 0.0..=1.0);
        if let Some(nms) = &self.overlap_nms {
            faults.range("masks.overlap_nms.iou", nms.iou, 0.0..=1.0);
            faults.range("masks.overlap_nms.score", nms.score, 0.0..=1.0);
            faults.range("masks.overlap_nms.inner", nms.inner, 0.0..=1.0);
        }
        let offset = self.stability_score_offset;
        if !offset.is_finite() || offset < 0.0 {
            faults.wrong("masks.stability_score_offset", &offset, "be >= 0");
        }
        if !(0.0..1.0).contains(&self.min_area) {
            faults.wrong("masks.min_area", &self.min_area, "be 0 to 1");
        }
    }
}

impl ImageTextManifest {
    pub(super) fn validate(&self, faults: &mut Faults) {
        let (image, text) = (&self.image, &self.text);
        faults.network("image_text.image", image.files());
        faults.network("image_text.text", text.files());
        faults.file("image_text.text.tokenizer", &text.tokenizer, &text.tokenizer_sha256);
        if let Some(words) = &self.words {
            faults.network("image_text.words", words.files());
        }
        faults.range("image_text.image.size", image.size, 1..=BUCKET_SIDE_MAX);
        faults.channels("image_text.image", image.mean, image.std);
        faults.range("image_text.dim", self.dim, 1..=DIM_MAX);
        if !self.tau.is_finite() || self.tau <= 0.0 {
            faults.wrong("image_text.tau", &self.tau, "be a number over 0");
        }
        if self.canon.is_empty() || self.canon.iter().any(|phrase| phrase.trim().is_empty()) {
            faults.wrong("image_text.canon", &self.canon, "hold 1 or more phrases");
        }
        faults.range("image_text.coverage_floor", self.coverage_floor, 0.0..=1.0);
        faults.range("image_text.margin", self.margin, -2.0..=2.0);
        faults.range("image_text.rivals", self.rivals, 0.0..=1.0);
        faults.range("image_text.image.crop_margin", image.crop_margin, 0.0..=4.0);
        faults.range("image_text.image.tolerance", image.tolerance, 0.0..=TOLERANCE_MAX);
        faults.range("image_text.image.batch", image.batch, 1..=BATCH_MAX);
        if let Some(dense) = &image.dense {
            dense.validate(faults);
        }
        faults.range("image_text.text.context", text.context, 1..=CONTEXT_MAX);
        faults.range("image_text.text.piece_letters", text.piece_letters, 0.0..=100.0);
    }
}
