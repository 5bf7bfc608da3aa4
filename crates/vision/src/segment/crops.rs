//! Parts of a photo that the network sees again, each at its full size: Segment Anything's crop
//! layers.

use std::sync::atomic::AtomicBool;

use crate::{
    error::Result,
    scene::Photo,
    segment::{Bitset, Box2, PromptDecoder, Proposal, Proposals, Settings, decode::decoded, nms},
};

/// A mask that ends so near to an inner edge of its part is a cut thing, pixels.
const EDGE: u32 = 20;

/// A part of a photo, pixels.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
struct Part {
    /// Its layer, from 1.
    layer: u32,
    /// First column and row.
    from: [u32; 2],
    /// The column and the row after the last.
    to: [u32; 2],
}

/// Adds the masks of all parts to those of the whole `photo`. Of two masks whose boxes then have
/// more IoU than [`Settings::crop_nms_thresh`] that of the smaller part stays; and
/// [`Settings::mask_nms_thresh`] holds between all.
///
/// `found` is at the photo's pixels, after NMS.
pub(super) fn add(
    found: &mut Proposals,
    decoder: &dyn PromptDecoder,
    photo: &Photo,
    settings: &Settings,
    cancel: &AtomicBool,
    wholes: bool,
) -> Result<()> {
    let pixels = f64::from(photo.width) * f64::from(photo.height);
    let mut all = vec![(u64::MAX, std::mem::take(&mut found.masks))];
    for part in parts(photo, settings.crop_n_layers, settings.crop_overlap_ratio) {
        let cut = part.cut(photo);
        let fewer = settings.crop_n_points_downscale_factor.saturating_pow(part.layer).max(1);
        let of_part = Settings {
            points_per_side: settings.points_per_side / fewer,
            min_area: settings.min_area * pixels / part.area() as f64,
            ..settings.clone()
        };
        let (mut own, _) = decoded(&*decoder.on(&cut)?, &cut, &of_part, &[], cancel, wholes)?;
        own.masks.retain(|mask| !part.cuts(mask.bounds, photo));
        nms::suppress(&mut own.masks, settings);
        found.asked += own.asked;
        all.push((part.area(), own.masks.iter().map(|mask| part.placed(mask, photo)).collect()));
    }
    all.sort_by_key(|(area, _)| *area);
    found.masks = all.into_iter().flat_map(|(_, masks)| masks).collect();
    nms::thin(&mut found.masks, settings.crop_nms_thresh, settings.mask_nms_thresh);
    Ok(())
}

/// The parts of all layers, as `generate_crop_boxes` of `segment_anything.utils.amg` has them.
///
/// Layer `i` has `2^i` parts each way, which overlap by a share of the photo's short side.
fn parts(photo: &Photo, layers: u32, overlap_ratio: f64) -> Vec<Part> {
    let size = [photo.width, photo.height];
    let mut parts = Vec::new();
    for layer in 1..=layers {
        let each = 1_u32 << layer;
        let short = f64::from(photo.width.min(photo.height));
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "pixels")]
        let overlap = (overlap_ratio * short * (2.0 / f64::from(each))) as u32;
        let sides = size.map(|length| (overlap * (each - 1) + length).div_ceil(each));
        for (column, row) in (0..each).flat_map(|x| (0..each).map(move |y| (x, y))) {
            let at = |axis: usize, i: u32| (sides[axis] - overlap) * i;
            let from = [at(0, column), at(1, row)];
            let to = [0, 1].map(|axis| (from[axis] + sides[axis]).min(size[axis]));
            // A photo of a few pixels has no such part.
            if from[0] < to[0] && from[1] < to[1] {
                parts.push(Part { layer, from, to });
            }
        }
    }
    parts
}

impl Part {
    fn size(self) -> [u32; 2] {
        [0, 1].map(|axis| self.to[axis] - self.from[axis])
    }

    fn area(self) -> u64 {
        self.size().map(u64::from).into_iter().product()
    }

    /// The pixels of the part.
    fn cut(self, photo: &Photo) -> Photo {
        let [width, height] = self.size();
        let rows = (self.from[1]..self.to[1]).map(|y| {
            let at = |x: u32| (y * photo.width + x) as usize;
            at(self.from[0])..at(self.to[0])
        });
        let rgb = rows.clone().flat_map(|row| &photo.rgb[3 * row.start..3 * row.end]);
        let valid = photo
            .valid
            .as_ref()
            .map(|valid| rows.flat_map(|row| valid[row].iter().copied()).collect::<Vec<bool>>());
        Photo { width, height, rgb: rgb.copied().collect(), valid }
    }

    /// Whether a mask with this box in the part ends at an edge of the part that is none of the
    /// photo: `is_box_near_crop_edge`.
    fn cuts(self, bounds: Box2, photo: &Photo) -> bool {
        let near = |a: u32, b: u32| a.abs_diff(b) <= EDGE;
        let ends = |at: u32, edge: u32, outer: u32| near(at, edge) && !near(at, outer);
        let [x, y] = self.from;
        ends(bounds.x0 + x, x, 0)
            || ends(bounds.y0 + y, y, 0)
            || ends(bounds.x1 + x, self.to[0], photo.width)
            || ends(bounds.y1 + y, self.to[1], photo.height)
    }

    /// A mask of the part as one of the photo.
    fn placed(self, mask: &Proposal, photo: &Photo) -> Proposal {
        let ([x, y], size) = (self.from, self.size());
        let [width, all] = [size[0], photo.width].map(|side| side as usize);
        let cell = |cell: usize| (cell / width + y as usize) * all + cell % width + x as usize;
        let bounds = mask.bounds;
        let whole = [photo.width, photo.height];
        #[expect(clippy::cast_possible_truncation, reason = "a share of the photo")]
        let point = [0, 1].map(|axis| {
            let at = f64::from(mask.point[axis]) * f64::from(size[axis]);
            ((at + f64::from(self.from[axis])) / f64::from(whole[axis])) as f32
        });
        Proposal {
            mask: Bitset::of(all * photo.height as usize, mask.mask.cells().map(cell)),
            bounds: Box2 {
                x0: bounds.x0 + x,
                y0: bounds.y0 + y,
                x1: bounds.x1 + x,
                y1: bounds.y1 + y,
            },
            point,
            ..mask.clone()
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn photo(width: u32, height: u32) -> Photo {
        let rgb = (0..width * height * 3).map(|i| (i % 251) as u8).collect();
        Photo { width, height, rgb, valid: None }
    }

    #[test]
    fn parts_are_those_of_segment_anything() {
        // generate_crop_boxes((48, 64), 2, 512 / 1500)
        let boxes = |photo: &Photo, layers: u32| -> Vec<[u32; 4]> {
            let flat = |part: Part| [part.from[0], part.from[1], part.to[0], part.to[1]];
            parts(photo, layers, 512.0 / 1500.0).into_iter().map(flat).collect()
        };
        let found = boxes(&photo(64, 48), 2);
        let first = [[0, 0, 40, 32], [0, 16, 40, 48], [24, 0, 64, 32], [24, 16, 64, 48]];
        assert_eq!((&found[..4], found.len()), (&first[..], 20), "4 and 16");
        assert_eq!((found[5], found[19]), ([0, 10, 22, 28], [42, 30, 64, 48]), "columns first");
        let odd = [[0, 0, 201, 161], [0, 80, 201, 240], [120, 0, 320, 161], [120, 80, 320, 240]];
        assert_eq!(boxes(&photo(320, 240), 1), odd, "sizes that do not divide");
        assert_eq!(boxes(&photo(64, 48), 0), [[0; 4]; 0], "no layers");
        assert!(boxes(&photo(1, 1), 3).iter().all(|b| *b == [0, 0, 1, 1]), "one pixel");
    }

    #[test]
    fn a_mask_of_a_part_is_where_it_was() {
        let photo = photo(64, 48);
        let part = Part { layer: 1, from: [24, 16], to: [64, 48] };
        let cut = part.cut(&photo);
        assert_eq!((cut.width, cut.height, cut.rgb.len()), (40, 32, 40 * 32 * 3), "its size");
        let at = |photo: &Photo, x: u32, y: u32| photo.rgb[((y * photo.width + x) * 3) as usize];
        assert_eq!(at(&cut, 7, 5), at(&photo, 31, 21), "its pixels");
        let mask = Bitset::of(40 * 32, [5 * 40 + 7, 6 * 40 + 7]);
        let bounds = mask.bounds(40);
        let own = Proposal { mask, area: 2, bounds, point: [0.5, 0.5], ..Proposal::default() };
        let placed = part.placed(&own, &photo);
        let cells: Vec<usize> = placed.mask.cells().collect();
        assert_eq!(cells, [21 * 64 + 31, 22 * 64 + 31], "its cells");
        assert_eq!(placed.bounds, placed.mask.bounds(64), "its box");
        assert_eq!(placed.point, [44.0 / 64.0, 32.0 / 48.0], "its point");
    }

    #[test]
    fn what_an_inner_edge_cuts_goes() {
        let whole = photo(200, 200);
        let part = Part { layer: 1, from: [0, 100], to: [120, 200] };
        let cuts = |x0, y0, x1, y1| part.cuts(Box2 { x0, y0, x1, y1 }, &whole);
        assert!(!cuts(0, 21, 99, 99), "at edges of the photo, 21 pixels from inner ones");
        assert!(cuts(0, 20, 99, 99), "20 pixels from the upper edge");
        assert!(cuts(0, 21, 100, 99), "20 pixels from the right one");
    }
}
