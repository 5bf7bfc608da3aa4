//! Cuts a mask out of its photo: its box with a margin, black outside the mask.
//!
//! Where the masks come with their whole cells ([`PhotoMasks::wholes`]), a crop shows all of its
//! mask, also what smaller masks cover in the index map.

use crate::scene::{Crop, CropShape, Photo, PhotoMasks};

/// First and last column and row of a mask, pixels of the photo.
#[derive(Clone, Copy, Debug)]
struct Bounds {
    x: [u32; 2],
    y: [u32; 2],
}

/// A photo with its masks. It gives one crop at a time, so that few are in memory.
#[derive(Debug)]
pub struct Cutter<'a> {
    photo: &'a Photo,
    masks: &'a PhotoMasks,
    /// Cell column of each pixel column.
    columns: Vec<usize>,
    /// Start of the cell row of each pixel row.
    rows: Vec<usize>,
    /// The boxes of all masks as they lie in the index map; none where the masks are whole.
    bounds: Vec<Option<Bounds>>,
}

/// Adds a pixel; rows come in order.
fn grow(bounds: &mut Option<Bounds>, x: u32, y: u32) {
    match bounds {
        None => *bounds = Some(Bounds { x: [x, x], y: [y, y] }),
        Some(b) => {
            b.x = [b.x[0].min(x), b.x[1].max(x)];
            b.y[1] = y;
        }
    }
}

/// The cell of each pixel's centre along one axis.
fn cells_of(pixels: u32, cells: u32) -> Vec<usize> {
    let (pixels_u64, cells) = (u64::from(pixels.max(1)), u64::from(cells));
    // (i + 1/2) / pixels * cells, rounded down, in integers.
    let cell = |i: u64| ((2 * i + 1) * cells / (2 * pixels_u64)) as usize;
    (0..u64::from(pixels)).map(cell).collect()
}

impl<'a> Cutter<'a> {
    /// Finds the boxes of masks that are not whole; that of a whole one is found when it is cut.
    #[must_use]
    pub fn new(photo: &'a Photo, masks: &'a PhotoMasks) -> Self {
        let map = &masks.map;
        let columns = cells_of(photo.width, map.width);
        let rows: Vec<usize> = cells_of(photo.height, map.height)
            .into_iter()
            .map(|row| row * map.width as usize)
            .collect();
        let mut cutter = Self { photo, masks, columns, rows, bounds: Vec::new() };
        if masks.wholes.is_empty() {
            cutter.bounds = cutter.bounds_in_map();
        }
        cutter
    }

    fn bounds_in_map(&self) -> Vec<Option<Bounds>> {
        let mut bounds: Vec<Option<Bounds>> = vec![None; self.masks.masks.len()];
        for (y, row) in (0..).zip(&self.rows) {
            for (x, column) in (0..).zip(&self.columns) {
                let mask = self.masks.map.index.get(row + column).copied().unwrap_or(0);
                let Some(of) = usize::from(mask).checked_sub(1) else { continue };
                let Some(found) = bounds.get_mut(of) else { continue };
                grow(found, x, y);
            }
        }
        bounds
    }

    /// The box of these cells of the map.
    fn bounds_of(&self, whole: &[bool]) -> Option<Bounds> {
        let mut bounds = None;
        for (y, row) in (0..).zip(&self.rows) {
            for (x, column) in (0..).zip(&self.columns) {
                if whole.get(row + column).copied().unwrap_or(false) {
                    grow(&mut bounds, x, y);
                }
            }
        }
        bounds
    }

    /// Whether each cell of the map is in mask `k` before smaller masks; `None` if that is unknown.
    fn whole(&self, k: usize) -> Option<Vec<bool>> {
        let mut cells = vec![false; self.masks.map.index.len()];
        for [first, count] in self.masks.wholes.get(k)? {
            let run = *first as usize..(*first as usize).saturating_add(*count as usize);
            if let Some(run) = cells.get_mut(run) {
                run.fill(true);
            }
        }
        Some(cells)
    }

    /// The crop of mask `k`, counted from 0, with a margin of `margin` times the longer side of its
    /// box. `None` if the mask has no pixel of the photo.
    #[must_use]
    pub fn cut(&self, k: usize, margin: f64, shape: CropShape) -> Option<Crop> {
        let whole = self.whole(k);
        let bounds = match &whole {
            Some(whole) => self.bounds_of(whole),
            None => *self.bounds.get(k)?,
        }?;
        let [wide, high] = [bounds.x, bounds.y].map(|[first, last]| last - first + 1);
        let longer = wide.max(high);
        #[expect(
            clippy::cast_possible_truncation,
            clippy::cast_sign_loss,
            reason = "a margin is a small share of a photo's side"
        )]
        let border = (margin.max(0.0) * f64::from(longer)).round().min(f64::from(longer)) as u32;
        let box_size = match shape {
            CropShape::Square => [longer; 2],
            CropShape::Stretched => [wide, high],
        };
        let [width, height] = box_size.map(|side| side + 2 * border);
        // The box is in the middle. An odd pixel goes to the right and to the bottom.
        let start = |[first, last]: [u32; 2], side: u32| {
            i64::from(first) - i64::from(side - (last - first + 1)) / 2
        };
        let (left, top) = (start(bounds.x, width), start(bounds.y, height));
        let mut rgb = vec![0; width as usize * height as usize * 3];
        let wanted = k + 1;
        let inside = |cell: usize| match &whole {
            Some(whole) => whole.get(cell).copied().unwrap_or(false),
            None => usize::from(self.masks.map.index.get(cell).copied().unwrap_or(0)) == wanted,
        };
        for y in bounds.y[0]..=bounds.y[1] {
            let into = (i64::from(y) - top) as usize * width as usize;
            for x in bounds.x[0]..=bounds.x[1] {
                let cell = self.rows[y as usize] + self.columns[x as usize];
                let from = y as usize * self.photo.width as usize + x as usize;
                let sourced = self.photo.valid.as_ref().is_none_or(|valid| valid[from]);
                if inside(cell) && sourced {
                    let to = (into + (i64::from(x) - left) as usize) * 3;
                    rgb[to..to + 3].copy_from_slice(&self.photo.rgb[from * 3..from * 3 + 3]);
                }
            }
        }
        Some(Crop { width, height, rgb })
    }
}
