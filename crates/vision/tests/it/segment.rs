//! Everything-mode over a decoder that knows what is in the picture: flat shapes on each other.

use std::sync::{
    Mutex,
    atomic::{AtomicBool, Ordering},
};

use segsplat_core::{
    error::{ErrorCode, Result},
    scene::{JudgedMasks, MaskJudging, MaskLevel, MaskLogits, Photo, PhotoMasks},
};
use segsplat_vision::segment::{
    PromptDecoder, Proposal, Proposals, Seed, Settings, everything, iou_over, proposals,
};

/// Cells of the grid each way; the photo fills its upper three quarters.
const GRID: usize = 64;
const FILLED: f64 = 0.75;

/// Boxes `[x0, y0, x1, y1]` in shares of the photo, later ones lie on earlier ones.
struct Shapes {
    boxes: Vec<[f64; 4]>,
    asked: Mutex<Vec<[f32; 2]>>,
}

impl Shapes {
    fn new(boxes: &[[f64; 4]]) -> Self {
        Self { boxes: boxes.to_vec(), asked: Mutex::default() }
    }

    fn top(&self, u: f64, v: f64) -> Option<usize> {
        let has = |b: &[f64; 4]| (b[0]..b[2]).contains(&u) && (b[1]..b[3]).contains(&v);
        self.boxes.iter().rposition(has)
    }
}

impl PromptDecoder for Shapes {
    fn batch(&self) -> usize {
        64
    }

    fn placed(&self) -> (u32, [u32; 2]) {
        (256, [256, 192])
    }

    /// Levels: the shape near the point, nearer the whole, the whole. Nothing under the point: a
    /// mask that is not sure of itself.
    fn decode(&self, points: &[[f32; 2]]) -> Result<MaskLogits> {
        self.asked.lock().unwrap().extend(points);
        let mut decoded = MaskLogits { levels: 3, grid: [GRID; 2], ..MaskLogits::default() };
        for point in points {
            let [px, py] = point.map(f64::from);
            let shape = self.top(px, py);
            for radius in [0.06, 0.12, 9.0] {
                for y in 0..GRID {
                    for x in 0..GRID {
                        let u = (x as f64 + 0.5) / GRID as f64;
                        let v = (y as f64 + 0.5) / GRID as f64 / FILLED;
                        let near = (u - px).hypot(v - py) < radius;
                        let inside = near && v < 1.0 && self.top(u, v) == shape;
                        let sure = if shape.is_some() { 20.0 } else { 0.5 };
                        decoded.logits.push(if inside { sure } else { -20.0 });
                    }
                }
                let iou = if radius > 1.0 { 0.95 } else { 0.85 };
                decoded.predicted_iou.push(iou);
            }
        }
        Ok(decoded)
    }

    /// The part is found by the colour of its first pixel, which [`photo`] makes its place.
    fn on<'a>(&'a self, photo: &'a Photo) -> Result<Box<dyn PromptDecoder + 'a>> {
        let [x, y] = [0, 1].map(|channel| f64::from(photo.rgb[channel]));
        let part = [x / 160.0, y / 120.0];
        let size = [f64::from(photo.width) / 320.0, f64::from(photo.height) / 240.0];
        let seen = |b: &[f64; 4]| [0, 1, 2, 3].map(|i| (b[i] - part[i % 2]) / size[i % 2]);
        Ok(Box::new(Self::new(&self.boxes.iter().map(seen).collect::<Vec<_>>())))
    }
}

/// The same shapes by a decoder that judges masks itself, by dense products in f64.
struct Judge(Shapes);

impl PromptDecoder for Judge {
    fn batch(&self) -> usize {
        self.0.batch()
    }

    fn placed(&self) -> (u32, [u32; 2]) {
        self.0.placed()
    }

    fn decode(&self, _: &[[f32; 2]]) -> Result<MaskLogits> {
        panic!("it is to judge");
    }

    fn judges(&self) -> Option<(usize, [usize; 2])> {
        Some((3, [GRID; 2]))
    }

    fn judge(&self, points: &[[f32; 2]], how: &MaskJudging) -> Result<JudgedMasks> {
        let decoded = self.0.decode(points)?;
        let [width, height] = how.pixels;
        let of = |logits: &[f32], x: usize, y: usize| -> f64 {
            let cell = |at: usize| f64::from(logits[at]);
            let weight = |row: usize, column: usize| {
                f64::from(how.rows[y * GRID + row]) * f64::from(how.columns[column * width + x])
            };
            let (rows, columns) = (y / 5, x / 5);
            let near = |at: usize| at.saturating_sub(3)..(at + 4).min(GRID);
            // 320 pixels lie over 64 cells: the weights of all others are 0.
            let cells = near(rows).flat_map(|row| near(columns).map(move |column| (row, column)));
            cells.map(|(row, column)| weight(row, column) * cell(row * GRID + column)).sum()
        };
        let mut judged = JudgedMasks::default();
        for point in 0..points.len() {
            for level in &how.levels {
                let at = point * 3 + level;
                let logits = &decoded.logits[at * GRID * GRID..(at + 1) * GRID * GRID];
                let pixels = (0..height).flat_map(|y| (0..width).map(move |x| (x, y)));
                let values: Vec<f64> = pixels.map(|(x, y)| of(logits, x, y)).collect();
                let offset = f64::from(how.stability_offset);
                let over = |least: f64| values.iter().filter(|v| **v > least).count() as f32;
                let bit = |(i, v): (usize, &f64)| u8::from(*v > 0.0) << i;
                judged
                    .bits
                    .extend(values.chunks(8).map(|c| c.iter().enumerate().map(bit).sum::<u8>()));
                judged.counts.extend([over(offset), over(-offset)]);
                judged.predicted_iou.push(decoded.predicted_iou[at]);
            }
        }
        Ok(judged)
    }

    fn on<'a>(&'a self, _: &'a Photo) -> Result<Box<dyn PromptDecoder + 'a>> {
        panic!("no crop layers are asked for");
    }
}

#[test]
fn masks_that_the_decoder_judges_are_those_of_its_logits() {
    for level in [MaskLevel::Widest, MaskLevel::Whole, MaskLevel::Part] {
        let settings = Settings { points_per_side: 8, level, ..Settings::default().exact() };
        let cancel = AtomicBool::new(false);
        let wanted = run(&room(), &settings, &[]);
        let found = everything(&Judge(room()), &photo(), &settings, &[], &cancel).unwrap();
        assert!(wanted.masks.len() >= 3, "{level:?}: {:?}", wanted.masks);
        assert_eq!((&found.map, &found.masks), (&wanted.map, &wanted.masks), "{level:?}");
        let all = |decoder: &dyn PromptDecoder| {
            let found = proposals(decoder, &photo(), &settings, &[], &cancel).unwrap();
            let key = |p: &Proposal| (p.area, p.bounds, p.level, p.point, p.stability);
            found.masks.iter().map(key).collect::<Vec<_>>()
        };
        assert_eq!(all(&Judge(room())), all(&room()), "{level:?}: every level");
    }
}

fn photo() -> Photo {
    let place = |at: u32| [(at % 320 / 2) as u8, (at / 320 / 2) as u8, 0];
    Photo { width: 320, height: 240, rgb: (0..320 * 240).flat_map(place).collect(), valid: None }
}

fn run(shapes: &Shapes, settings: &Settings, seeds: &[Seed]) -> PhotoMasks {
    everything(shapes, &photo(), settings, seeds, &AtomicBool::new(false)).unwrap()
}

/// A table, a mug on it, a picture on the wall behind; the wall itself is nothing.
fn room() -> Shapes {
    Shapes::new(&[[0.1, 0.5, 0.9, 0.95], [0.4, 0.6, 0.48, 0.7], [0.6, 0.1, 0.8, 0.3]])
}

/// The share of the photo's places at which two maps say the same things, up to numbering.
fn agreement(a: &PhotoMasks, b: &PhotoMasks) -> f64 {
    let places = (0..200).flat_map(|y| (0..200).map(move |x| (x, y)));
    let at = |masks: &PhotoMasks, (x, y): (u32, u32)| {
        let share = |v: u32| (f64::from(v) + 0.5) / 200.0;
        let index = masks.map.at(share(x), share(y));
        index.checked_sub(1).map(|k| (masks.masks[usize::from(k)].area * 50.0).round() as u32)
    };
    places.filter(|&p| at(a, p) == at(b, p)).count() as f64 / 40_000.0
}

#[test]
fn each_thing_is_one_mask_and_small_ones_lie_on_large_ones() {
    let masks = run(&room(), &Settings::default(), &[]);
    assert_eq!((masks.map.width, masks.map.height), (128, 96), "twice the cells over the photo");
    assert_eq!(masks.masks.len(), 3, "{:?}", masks.masks);
    let area = |k: usize| masks.masks[k].area;
    assert!(area(0) > area(1) && area(1) > area(2), "the largest first: {:?}", masks.masks);
    assert!((area(0) - (0.8 * 0.45 - 0.008)).abs() < 0.02, "the table: {}", area(0));
    for (u, v, index) in
        [(0.2, 0.8, 1), (0.44, 0.65, 3), (0.7, 0.2, 2), (0.3, 0.2, 0), (0.05, 0.7, 0)]
    {
        assert_eq!(masks.map.at(u, v), index, "({u}, {v})");
    }
    let counted: usize = masks.map.index.iter().filter(|&&k| k > 0).count();
    let shares: f64 = masks.masks.iter().map(|mask| mask.area).sum();
    let all = masks.map.index.len() as f64;
    assert!((counted as f64 / all - shares).abs() < 1e-9, "areas are those of the map");
}

/// Two masks that overlap in the third of four columns: of points on the left three columns with
/// 0.9 of predicted IoU, and of others the last two columns' upper half.
struct Rivals {
    small: f32,
}

impl PromptDecoder for Rivals {
    fn batch(&self) -> usize {
        8
    }

    fn placed(&self) -> (u32, [u32; 2]) {
        (64, [64, 64])
    }

    fn decode(&self, points: &[[f32; 2]]) -> Result<MaskLogits> {
        let mut decoded = MaskLogits { levels: 1, grid: [4, 4], ..MaskLogits::default() };
        for point in points {
            let large = point[0] < 0.5;
            let inside = |at: usize| if large { at % 4 < 3 } else { at % 4 > 1 && at < 8 };
            decoded.logits.extend((0..16).map(|at| if inside(at) { 9.0_f32 } else { -9.0 }));
            decoded.predicted_iou.push(if large { 0.9 } else { self.small });
        }
        Ok(decoded)
    }

    fn on<'a>(&'a self, _: &'a Photo) -> Result<Box<dyn PromptDecoder + 'a>> {
        Ok(Box::new(Self { small: self.small }))
    }
}

#[test]
fn a_pixel_goes_to_the_surest_mask_and_nearly_as_sure_a_small_one_lies_on_a_large_one() {
    let settings = Settings {
        points_per_side: 4,
        pred_iou_thresh: 0.3,
        skip_covered: false,
        map_scale: 1,
        ..Settings::default()
    };
    let owner = |small: f32, surest_first: bool| {
        let settings = Settings { surest_first, ..settings.clone() };
        let cancel = AtomicBool::new(false);
        let masks = everything(&Rivals { small }, &photo(), &settings, &[], &cancel).unwrap();
        assert_eq!(masks.masks.len(), 2, "{:?}", masks.masks);
        assert_eq!([masks.map.at(0.1, 0.1), masks.map.at(0.9, 0.1)], [1, 2], "the largest first");
        masks.map.at(0.6, 0.1)
    };
    assert_eq!(owner(0.5, true), 1, "the small one is far less sure");
    assert_eq!(owner(0.85, true), 2, "a third of the area is worth 0.11 of sureness");
    assert_eq!(owner(0.5, false), 2, "the smallest, however sure");
}

#[test]
fn each_skip_leaves_the_masks_as_they_are_and_asks_less() {
    let all = Settings { skip_covered: false, ..Settings::default() };
    let (full, fast) = (room(), room());
    let slow = run(&full, &all, &[]);
    assert_eq!(full.asked.lock().unwrap().len(), 1024, "every point of the grid");
    let quick = run(&fast, &Settings::default(), &[]);
    let asked = fast.asked.lock().unwrap().len();
    assert!(asked < 800, "{asked} points with what is covered left out");
    assert!(agreement(&slow, &quick) > 0.999, "covered: {}", agreement(&slow, &quick));
    let fine = Settings { full_resolution: true, ..all };
    let fine = run(&room(), &fine, &[]);
    assert_eq!((fine.map.width, fine.map.height), (320, 240), "the photo's own pixels");
    assert!(agreement(&slow, &fine) > 0.97, "full resolution: {}", agreement(&slow, &fine));
    let seeds: Vec<Seed> =
        [[0.2, 0.8], [0.44, 0.65], [0.7, 0.2]].map(|point| Seed { point }).to_vec();
    let seeded = room();
    let with = run(&seeded, &Settings::default(), &seeds);
    assert!(agreement(&slow, &with) > 0.999, "seeds: {}", agreement(&slow, &with));
    assert_eq!(
        seeded.asked.lock().unwrap()[..3],
        seeds.iter().map(|s| s.point).collect::<Vec<_>>()[..]
    );
    let off = room();
    run(&off, &Settings { use_seeds: false, ..Settings::default() }, &seeds);
    assert_eq!(off.asked.lock().unwrap().len(), asked, "seeds that are switched off");
}

/// The points that are asked in a picture of nothing, in order.
fn asked(settings: &Settings, seeds: &[Seed]) -> Vec<[f32; 2]> {
    let nothing = Shapes::new(&[]);
    run(&nothing, settings, seeds);
    nothing.asked.into_inner().unwrap()
}

#[test]
fn without_skips_it_is_segment_anythings_grid() {
    let settings = Settings { points_per_side: 3, skip_covered: false, ..Settings::default() };
    let points = asked(&settings, &[]);
    assert_eq!(points.len(), 9, "{points:?}");
    let close = |a: [f32; 2], b: [f32; 2]| (0..2).all(|i| (a[i] - b[i]).abs() < 1e-6);
    assert!(close(points[0], [1.0 / 6.0, 1.0 / 6.0]), "{points:?}");
    assert!(close(points[1], [0.5, 1.0 / 6.0]), "rows first: {points:?}");
    assert!(close(points[8], [5.0 / 6.0, 5.0 / 6.0]), "{points:?}");
}

#[test]
fn every_point_is_asked_once_coarse_ones_first() {
    let mut points = asked(&Settings { points_per_side: 16, ..Settings::default() }, &[]);
    assert_eq!(points.len(), 256, "all");
    let gap = (points[0][0] - points[1][0]).abs();
    assert!((gap - 0.25).abs() < 1e-6, "the first round is coarse: {gap}");
    points.sort_by(|a, b| a.partial_cmp(b).unwrap());
    points.dedup();
    assert_eq!(points.len(), 256, "none twice");
}

#[test]
fn seeds_come_first_and_outside_ones_not_at_all() {
    let settings = Settings { points_per_side: 4, ..Settings::default() };
    let seeds = [[0.3, 0.4], [1.2, 0.5], [0.9, 0.1]].map(|point| Seed { point });
    let points = asked(&settings, &seeds);
    assert_eq!(points[..2], [[0.3, 0.4], [0.9, 0.1]], "{points:?}");
    assert_eq!(points.len(), 2 + 16, "then the grid");
}

#[test]
fn proposals_are_parts_and_wholes_above_the_thresholds() {
    let settings = Settings::default().exact();
    let found = proposals(&room(), &photo(), &settings, &[], &AtomicBool::new(false)).unwrap();
    assert_eq!((found.width, found.height, found.asked), (320, 240, 1024), "full resolution");
    let wholes = found.masks.iter().filter(|mask| mask.level == 2).count();
    assert!(wholes == 3 && found.masks.len() > 20, "{wholes} of {}", found.masks.len());
    assert!(found.masks.windows(2).all(|m| m[0].predicted_iou >= m[1].predicted_iou), "order");
    assert!(found.masks.iter().all(|mask| mask.stability >= 0.9), "what is not sure went");
    let strict = Settings { pred_iou_thresh: 0.9, ..settings };
    let found = proposals(&room(), &photo(), &strict, &[], &AtomicBool::new(false)).unwrap();
    assert_eq!(found.masks.len(), 3, "only the wholes predict so much");
}

#[test]
fn parts_of_the_photo_give_their_own_masks_where_they_are() {
    // A small thing in the part at the right bottom, and a table that every part cuts.
    let shapes = || Shapes::new(&[[0.05, 0.1, 0.95, 0.95], [0.6, 0.55, 0.66, 0.63]]);
    let exact = Settings { points_per_side: 6, ..Settings::default().exact() };
    let found = |settings: &Settings| {
        let never = AtomicBool::new(false);
        proposals(&shapes(), &photo(), settings, &[], &never).unwrap()
    };
    let wholes = |found: &Proposals| {
        let whole = |mask: &&Proposal| mask.level == 2;
        found.masks.iter().filter(whole).map(|mask| mask.bounds).collect::<Vec<_>>()
    };
    let once = found(&exact);
    assert_eq!((once.asked, wholes(&once).len()), (36, 1), "6 x 6 points miss the thing");
    let layer = Settings { crop_n_layers: 1, ..exact };
    let parts = found(&layer);
    assert_eq!(parts.asked, 5 * 36, "the photo and four parts");
    let [thing, table] = wholes(&parts)[..] else { panic!("{:?}", wholes(&parts)) };
    let near = |a: u32, b: f64| (f64::from(a) - b).abs() <= 5.0;
    assert!(near(thing.x0, 192.0) && near(thing.x1, 211.0), "{thing:?}");
    assert!(near(thing.y0, 132.0) && near(thing.y1, 151.0), "{thing:?}");
    assert_eq!(table, wholes(&once)[0], "cut tables went, the whole one stays, last");
    let fewer = Settings { crop_n_points_downscale_factor: 2, ..layer };
    assert_eq!(found(&fewer).asked, 36 + 4 * 9, "fewer points in parts");
    let coarse = Settings { full_resolution: false, ..layer };
    assert_eq!(found(&coarse).asked, 36, "at the photo's pixels only");
}

#[test]
fn a_threshold_of_0_asks_nothing() {
    // Networks predict IoUs under 0 too. What is not over `iou_over` need not be decoded.
    assert!(iou_over(0.0) < -1e6 && iou_over(0.5) > 0.49, "0 is no bound");
}

#[test]
fn a_picture_of_nothing_has_no_masks_and_a_mask_of_everything_is_none() {
    let empty = run(&Shapes::new(&[]), &Settings::default(), &[]);
    assert!(empty.masks.is_empty() && empty.map.index.iter().all(|&k| k == 0), "nothing");
    let whole = run(&Shapes::new(&[[0.0, 0.0, 1.0, 1.0]]), &Settings::default(), &[]);
    assert!(whole.masks.iter().all(|mask| mask.area < 0.95), "{:?}", whole.masks);
}

#[test]
fn pixels_without_a_source_are_in_no_mask() {
    let mut blank = photo();
    blank.valid = Some((0..320 * 240).map(|at| at % 320 >= 160).collect());
    let cancel = AtomicBool::new(false);
    let masks = everything(&room(), &blank, &Settings::default(), &[], &cancel).unwrap();
    assert_eq!(masks.map.at(0.3, 0.8), 0, "the left half has no source");
    assert_ne!(masks.map.at(0.7, 0.8), 0, "the right half has");
}

#[test]
fn a_cancelled_scene_stops_and_a_senseless_decoder_is_named() {
    let cancel = AtomicBool::new(true);
    let error = everything(&room(), &photo(), &Settings::default(), &[], &cancel).unwrap_err();
    assert_eq!(error.code(), ErrorCode::Cancelled, "{error}");
    cancel.store(false, Ordering::Relaxed);

    struct Broken(MaskLogits, [u32; 2]);
    impl PromptDecoder for Broken {
        fn batch(&self) -> usize {
            8
        }
        fn placed(&self) -> (u32, [u32; 2]) {
            (64, self.1)
        }
        fn decode(&self, _: &[[f32; 2]]) -> Result<MaskLogits> {
            Ok(self.0.clone())
        }
        fn on<'a>(&'a self, _: &'a Photo) -> Result<Box<dyn PromptDecoder + 'a>> {
            Ok(Box::new(Self(self.0.clone(), self.1)))
        }
    }
    let whole = MaskLogits {
        levels: 1,
        grid: [4, 4],
        logits: vec![1.0; 8 * 16],
        predicted_iou: vec![1.0; 8],
    };
    let short = MaskLogits { logits: vec![1.0; 7], ..whole.clone() };
    let flat = MaskLogits { grid: [0, 4], ..whole.clone() };
    let none = MaskLogits { levels: 0, ..whole.clone() };
    for (decoded, placed) in
        [(short, [64, 64]), (flat, [64, 64]), (none, [64, 64]), (whole, [65, 0])]
    {
        let broken = Broken(decoded, placed);
        let error = everything(&broken, &photo(), &Settings::default(), &[], &cancel).unwrap_err();
        assert_eq!(error.code(), ErrorCode::Internal, "{error}");
        assert!(error.message().starts_with("masks:"), "{error}");
    }
    let poison = MaskLogits {
        levels: 1,
        grid: [4, 4],
        logits: vec![f32::NAN; 8 * 16],
        predicted_iou: vec![f32::NAN; 8],
    };
    let settings = Settings { points_per_side: 4, ..Settings::default() };
    let masks = everything(&Broken(poison, [64, 64]), &photo(), &settings, &[], &cancel).unwrap();
    assert!(masks.masks.is_empty(), "numbers that are none are no masks");
}

#[test]
fn masks_are_the_same_for_any_number_of_threads() {
    let on = |threads: usize| {
        let pool = rayon::ThreadPoolBuilder::new().num_threads(threads).build().unwrap();
        pool.install(|| run(&room(), &Settings::default(), &[]))
    };
    let alone = on(1);
    for threads in [2, 5] {
        let many = on(threads);
        assert_eq!((&many.map, &many.masks), (&alone.map, &alone.masks), "{threads} threads");
    }
}
