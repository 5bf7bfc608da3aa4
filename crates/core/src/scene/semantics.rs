//! The semantics of a scene: the bank of embeddings, and the entry of each Gaussian and of each
//! cell of the photos.
//!
//! Entry 0 is the background and has no row. Entry m is row m - 1 of the bank.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::scene::{Method, StageTime};

/// The entry of each cell of a grid over a whole photo; cells need not be square.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct IndexMap {
    /// Columns.
    pub width: u32,
    /// Rows.
    pub height: u32,
    /// `[height * width]`, row-major; 0 = none.
    pub index: Vec<u16>,
}

impl IndexMap {
    /// The entry at a place of the photo, `x` and `y` as shares 0..1 of its width and height.
    pub fn at(&self, x: f64, y: f64) -> u16 {
        let cell = |share: f64, cells: u32| {
            let last = f64::from(cells.max(1) - 1);
            (share * f64::from(cells)).floor().clamp(0.0, last) as usize
        };
        let at = cell(y, self.height) * self.width as usize + cell(x, self.width);
        self.index.get(at).copied().unwrap_or(0)
    }

    /// Share of the cells that have an entry, 0..1.
    pub fn share(&self) -> f64 {
        let some = self.index.iter().filter(|entry| **entry > 0).count();
        some as f64 / self.index.len().max(1) as f64
    }

    /// The same, where each cell has the largest entry of those that are at most so many cells
    /// away along rows and columns.
    pub fn wider(&self, cells: usize) -> Self {
        let (width, height) = (self.width as usize, self.height as usize);
        let window = |at: usize, end: usize| at.saturating_sub(cells)..(at + cells + 1).min(end);
        let most = |of: &[u16], at: &dyn Fn(usize) -> usize, range: std::ops::Range<usize>| {
            range.map(|i| of[at(i)]).max().unwrap_or(0)
        };
        let all = 0..self.index.len();
        let along = |i: usize| {
            let (x, y) = (i % width, i / width);
            most(&self.index, &|x| y * width + x, window(x, width))
        };
        let rows: Vec<u16> = all.clone().map(along).collect();
        let across = |i: usize| {
            let (x, y) = (i % width, i / width);
            most(&rows, &|y| y * width + x, window(y, height))
        };
        Self { index: all.map(across).collect(), ..*self }
    }
}

/// One mask of a photo, as the mask network saw it.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct MaskInfo {
    /// Share of the photo's cells, 0..1, after every pixel went to one mask.
    pub area: f64,
    /// Predicted `IoU`.
    pub predicted_iou: f32,
    /// Stability: `IoU` of the mask at a stricter and a looser threshold.
    pub stability: f32,
    /// Where it was asked for, shares 0..1 of width and height.
    pub point: [f32; 2],
}

/// `LangSplat`'s choice among masks that overlap; its settings are 0.8, 0.7 and 0.5.
#[derive(Clone, Copy, Debug, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct OverlapNms {
    /// A mask with more IoU than this with a surer one goes.
    pub iou: f32,
    /// A mask must have more predicted IoU times stability than this.
    pub score: f32,
    /// Of two masks of which one lies in the other the inner one goes where the product of the
    /// shares that they have in common is less than this.
    pub inner: f32,
}

/// The masks of one photo: at most one a pixel.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PhotoMasks {
    /// Cells of mask k of `masks` have the number k + 1.
    pub map: IndexMap,
    /// What the network said of each.
    pub masks: Vec<MaskInfo>,
    /// Cells of each mask before smaller ones were laid on it, as runs `[first, count]` over the
    /// map; empty where crops are cut after that.
    pub wholes: Vec<Vec<[u32; 2]>>,
}

/// Masks of a batch of points of a photo, as logits: over 0 is inside.
#[derive(Clone, Debug, Default)]
pub struct MaskLogits {
    /// Masks a point (K), from parts to the whole.
    pub levels: usize,
    /// `[width, height]` of the grid.
    pub grid: [usize; 2],
    /// `[B * K * height * width]`.
    pub logits: Vec<f32>,
    /// `[B * K]`.
    pub predicted_iou: Vec<f32>,
}

/// How masks are judged at the photo's pixels where the network runs.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct MaskJudging {
    /// Which of the decoder's masks (K), counted as in [`MaskLogits::levels`].
    pub levels: Vec<usize>,
    /// `[width, height]` of the photo, pixels.
    pub pixels: [usize; 2],
    /// `[height * grid height]`: weights that make rows of pixels of rows of logits.
    pub rows: Vec<f32>,
    /// `[grid width * width]`: the same for columns.
    pub columns: Vec<f32>,
    /// Logits between the stricter and the looser threshold, each side of 0.
    pub stability_offset: f32,
}

/// Masks of a batch of points at the photo's pixels.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct JudgedMasks {
    /// `[B * K * ceil(pixels / 64) * 8]`: pixels over 0, row by row, the first in the lowest bit.
    pub bits: Vec<u8>,
    /// `[B * K * 2]`: pixels over the stricter and over the looser threshold.
    pub counts: Vec<f32>,
    /// `[B * K]`.
    pub predicted_iou: Vec<f32>,
}

/// Features of a photo on a coarse grid over all of it; cells need not be square.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct DenseFeatures {
    /// Columns.
    pub columns: usize,
    /// Rows.
    pub rows: usize,
    /// `[D * rows * columns]`. The mean over cells is an embedding, of any length.
    pub data: Vec<f32>,
}

/// A text as the text tower sees it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct TextEmbedding {
    /// `[D]`, unit length.
    pub row: Vec<f32>,
    /// Tokens that were read, markers of begin and end left out.
    pub tokens: usize,
    /// How many of them stand for something that the tokenizer does not know.
    pub unknown: usize,
    /// Whether the text was longer than the network reads, and was cut.
    pub cut: bool,
}

/// Rows of the bank.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Bank {
    /// Numbers a row (D).
    pub dim: usize,
    /// `[M * dim]`, row-major.
    pub rows: Vec<f32>,
}

impl Bank {
    /// Number of rows (M).
    pub fn len(&self) -> usize {
        self.rows.len().checked_div(self.dim).unwrap_or(0)
    }

    /// Whether there are none.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    /// Row `m`, counted from 0.
    pub fn row(&self, m: usize) -> &[f32] {
        &self.rows[m * self.dim..(m + 1) * self.dim]
    }
}

/// Embeddings of single masks beside the rows of a bank: what a thing looks like from here and
/// from there. A row alone is the mean of its masks, and a name that fits some is lost there.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RowViews {
    /// `[V]` entry of each, ascending, from 1.
    pub entries: Vec<u16>,
    /// `[V * dim]`, each of length 1; `dim` is that of the bank.
    pub rows: Vec<f32>,
}

/// Counts and times of making the semantics.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SemanticsReport {
    /// Masks of each photo.
    pub masks: Vec<u32>,
    /// Rows of the bank (M).
    pub bank_size: u32,
    /// Gaussians that have an index.
    pub labelled: u64,
    /// sha256 of the bundle's manifest, hex.
    pub bundle_sha256: String,
    /// How they were made.
    #[serde(default)]
    #[schema(required = true)]
    pub method: Method,
    /// Time of each stage: `masks`, `embed`, `bank`, `assign`.
    pub stages: Vec<StageTime>,
    /// Execution provider of the networks.
    pub execution_provider: String,
}

/// A mask and the row of the bank that its embedding went into.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct BankMask {
    /// Index of the photo.
    pub photo: u32,
    /// Number of the mask in its photo, from 0, the largest first.
    pub mask: u32,
    /// Entry of the bank, from 1; 0 where the mask has no embedding.
    pub entry: u16,
}

/// The semantics of a scene.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Semantics {
    /// The bank.
    pub bank: Bank,
    /// Masks that its rows stand for; empty where a row is all that is kept.
    pub views: RowViews,
    /// `[N]` entry of each Gaussian, in the order of the scene's Gaussians.
    pub index: Vec<u16>,
    /// Index maps of the photos, in their order.
    pub photos: Vec<IndexMap>,
    /// All masks, photo by photo; empty where an older program made them.
    pub masks: Vec<BankMask>,
    /// How it went.
    pub report: SemanticsReport,
}

impl Semantics {
    /// `[M]` masks of each row of the bank.
    pub fn row_sizes(&self) -> Vec<u32> {
        let mut sizes = vec![0; self.bank.len()];
        for mask in &self.masks {
            if let Some(size) = sizes.get_mut(usize::from(mask.entry).wrapping_sub(1)) {
                *size += 1;
            }
        }
        sizes
    }
}
