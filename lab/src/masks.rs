//! What each shortcut of the mask stage changes.
//!
//! The same photos go through the mask stage in several variants: no shortcut first, then each
//! shortcut alone, then all. A row has the time of a variant, the points asked, and how far its
//! masks are those of the first variant. `--dump` writes the masks before level choice and the
//! rule of one mask a pixel, for `tests/tools/official_masks.py` to compare with Segment
//! Anything's own code.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, AtomicUsize, Ordering},
    time::Instant,
};

use serde::Serialize;
use serde_json::json;

use crate::{
    error::{Error, ErrorCode, Result},
    folders::{Folders, is_posed, nearest},
    grid,
    limits::Limits,
    models::MaskNetwork,
    photo_files,
    pipeline::{Pipeline, masks as stage, masks::SeenPhoto, reconstruct},
    rows::{Rows, progress},
    scene::{Camera, Gaussians, MaskLogits, Photo, PhotoMasks, PosedPhoto, SceneOptions},
    segment::{self, Bitset, PromptDecoder, Proposals, Seed, Settings},
    setup::Setup,
};

/// Masks of this much IoU are the same mask.
const ALIKE: f64 = 0.95;
/// Places along each side of a photo at which two index maps are compared.
const PLACES: u32 = 256;

/// What to run.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {
    #[command(flatten)]
    folders: Folders,
    /// Neighbouring photos of each scene; seeds need at least 2
    #[arg(long, default_value_t = 3)]
    photos: usize,
    /// Only the variant without shortcuts and the product's
    #[arg(long)]
    short: bool,
    /// Folder for the photos and their masks before one mask a pixel is left
    #[arg(long, value_name = "DIR")]
    dump: Option<PathBuf>,
    #[command(flatten)]
    setup: Setup,
}

/// A way through the mask stage.
#[derive(Clone, Debug)]
struct Variant {
    name: &'static str,
    settings: Settings,
    /// The photo is encoded once, and not before each batch.
    once: bool,
    /// Points in one run of the decoder; `None`: as the bundle says.
    batch: Option<usize>,
}

/// One variant: sums over photos, then means.
#[derive(Clone, Debug, Default, Serialize)]
struct Measured {
    variant: &'static str,
    photos: usize,
    /// Seconds a photo, encoding too.
    seconds: f64,
    /// Seconds a photo in the encoder.
    encode_seconds: f64,
    /// Points asked of a photo.
    asked: f64,
    /// Masks of a photo, one a pixel.
    masks: f64,
    /// Share of the first variant's masks with a partner of IoU 0.95 and more here.
    found: f64,
    /// Share of the masks here with such a partner in the first variant.
    found_back: f64,
    /// IoU of the first variant's masks with their best partner here.
    iou: f64,
    /// Share of the photo in some mask.
    covered: f64,
}

/// A decoder as a variant wants it, which counts points.
struct Counted<'a> {
    seen: SeenPhoto<'a>,
    network: &'a MaskNetwork,
    photo: &'a Photo,
    once: bool,
    batch: Option<usize>,
    asked: AtomicUsize,
}

impl PromptDecoder for Counted<'_> {
    fn batch(&self) -> usize {
        self.batch.unwrap_or_else(|| self.seen.batch())
    }

    fn placed(&self) -> (u32, [u32; 2]) {
        self.seen.placed()
    }

    fn decode(&self, points: &[[f32; 2]]) -> Result<MaskLogits> {
        let before = self.asked.fetch_add(points.len(), Ordering::Relaxed);
        if self.once || before == 0 {
            return self.seen.decode(points);
        }
        SeenPhoto::new(self.network, self.photo)?.decode(points)
    }
}

/// Makes a row for each variant; its error is how little its masks are those of the first.
///
/// # Errors
/// `invalid_request` when there is no scene or an option is out of range, `model_unavailable` when
/// the bundle has no mask network, else whatever a stage says.
pub fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    if args.photos == 0 {
        return Err(Error::invalid("0 photos; it must be at least 1"));
    }
    let engine = Pipeline::open(&args.setup.networks(1))?;
    let network = engine.masks()?;
    let variants = variants(&stage::settings(network.manifest()), args.short);
    let named = |v: &Variant| Measured { variant: v.name, ..Measured::default() };
    let mut all: Vec<Measured> = variants.iter().map(named).collect();
    for (name, dir) in args.folders.find(is_posed)? {
        let photos = photo_files::read_dir(&dir, &Limits::default())?;
        let cameras: Vec<Camera> = photos.iter().map(|p| p.camera).collect();
        let middle = photos.len() / 2;
        let beside = nearest(&cameras, middle, args.photos - 1);
        let chosen: Vec<PosedPhoto> =
            [middle].into_iter().chain(beside).map(|i| photos[i].clone()).collect();
        let gaussians = gaussians(&engine, &chosen)?;
        let mut first: Vec<PhotoMasks> = Vec::new();
        for (variant, measured) in variants.iter().zip(&mut all) {
            let found = engine
                .workers()
                .install(|| drive(&network, &chosen, gaussians.as_ref(), variant, measured))?;
            if first.is_empty() {
                first = found.clone();
            }
            first.iter().zip(&found).for_each(|(a, b)| compare(a, b, measured));
        }
        if let Some(out) = &args.dump {
            for (i, posed) in chosen.iter().enumerate() {
                dump(&network, posed, &variants, &out.join(format!("{name}_{i}")))?;
            }
        }
        all.iter_mut().for_each(|measured| measured.photos += chosen.len());
        progress(&format!("{name}: {} photos", chosen.len()));
    }
    for mut measured in all {
        measured.finish();
        let error = json!({ "masks_lost": 1.0 - measured.found, "iou": measured.iou });
        rows.push(error, &measured)?;
    }
    Ok(())
}

/// No shortcut, each alone, and all of them.
fn variants(product: &Settings, short: bool) -> Vec<Variant> {
    // The product's own rules, at full resolution and with every point asked.
    let slow = Settings {
        full_resolution: true,
        skip_covered: false,
        use_seeds: false,
        ..product.clone()
    };
    let variant = |name, settings: Settings| Variant { name, settings, once: true, batch: None };
    let nothing = variant("no shortcut", slow.clone());
    let all = variant("all shortcuts", product.clone());
    if short {
        return vec![nothing, all];
    }
    vec![
        nothing,
        Variant { once: false, ..variant("encoded for each batch", slow.clone()) },
        Variant { batch: Some(1), ..variant("one point a run", slow.clone()) },
        variant("coarse logits", Settings { full_resolution: false, ..slow.clone() }),
        variant("covered points", Settings { skip_covered: true, ..slow.clone() }),
        variant("covered points, seeds", Settings { skip_covered: true, use_seeds: true, ..slow }),
        variant("all shortcuts but seeds", Settings { use_seeds: false, ..product.clone() }),
        all,
    ]
}

/// The Gaussians of these photos, for the seeds; `None` where they make no scene.
fn gaussians(engine: &Pipeline, photos: &[PosedPhoto]) -> Result<Option<Gaussians>> {
    if photos.len() < 2 {
        return Ok(None);
    }
    let never = AtomicBool::new(false);
    match reconstruct(engine, photos, &SceneOptions::default(), &|_, _| (), &never) {
        Ok(made) => Ok(Some(made.gaussians)),
        Err(e) if e.code() == ErrorCode::InvalidRequest => Ok(None),
        Err(e) => Err(e),
    }
}

/// All photos of one scene in one variant; adds its times and counts.
fn drive(
    network: &MaskNetwork,
    photos: &[PosedPhoto],
    gaussians: Option<&Gaussians>,
    variant: &Variant,
    measured: &mut Measured,
) -> Result<Vec<PhotoMasks>> {
    let never = AtomicBool::new(false);
    let mut found: Vec<PhotoMasks> = Vec::new();
    for (at, posed) in photos.iter().enumerate() {
        let start = Instant::now();
        let seeds: Vec<Seed> = match gaussians {
            Some(gaussians) if variant.settings.use_seeds => {
                stage::seeds(gaussians, photos, &found, at)
            }
            _ => Vec::new(),
        };
        let begun = start.elapsed();
        let counted = Counted {
            seen: SeenPhoto::new(network, &posed.photo)?,
            network,
            photo: &posed.photo,
            once: variant.once,
            batch: variant.batch,
            asked: 0.into(),
        };
        measured.encode_seconds += (start.elapsed() - begun).as_secs_f64();
        let masks = segment::everything(&counted, &posed.photo, &variant.settings, &seeds, &never)?;
        measured.seconds += start.elapsed().as_secs_f64();
        measured.asked += counted.asked.into_inner() as f64;
        measured.masks += masks.masks.len() as f64;
        measured.covered += masks.masks.iter().map(|mask| mask.area).sum::<f64>();
        found.push(masks);
    }
    Ok(found)
}

/// How many of `a`'s masks are masks of `b`, and the other way round: means of this photo.
fn compare(a: &PhotoMasks, b: &PhotoMasks, measured: &mut Measured) {
    let mut common: BTreeMap<(u16, u16), u32> = BTreeMap::new();
    let (mut of_a, mut of_b) = (BTreeMap::new(), BTreeMap::new());
    for at in 0..PLACES * PLACES {
        let share = |v: u32| (f64::from(v) + 0.5) / f64::from(PLACES);
        let (x, y) = (share(at % PLACES), share(at / PLACES));
        let (i, j) = (a.map.at(x, y), b.map.at(x, y));
        *of_a.entry(i).or_insert(0_u32) += 1;
        *of_b.entry(j).or_insert(0_u32) += 1;
        *common.entry((i, j)).or_insert(0) += 1;
    }
    let (mut best_a, mut best_b) = (BTreeMap::new(), BTreeMap::new());
    for (&(i, j), &n) in common.iter().filter(|((i, j), _)| *i > 0 && *j > 0) {
        let iou = f64::from(n) / f64::from(of_a[&i] + of_b[&j] - n);
        let keep = |best: &mut BTreeMap<u16, f64>, key| {
            let old = best.entry(key).or_insert(0.0);
            *old = old.max(iou);
        };
        keep(&mut best_a, i);
        keep(&mut best_b, j);
    }
    let alike = |best: &BTreeMap<u16, f64>, masks: usize| match masks {
        0 => 1.0,
        n => best.values().filter(|iou| **iou >= ALIKE).count() as f64 / n as f64,
    };
    measured.found += alike(&best_a, a.masks.len());
    measured.found_back += alike(&best_b, b.masks.len());
    let total: f64 = best_a.values().sum();
    measured.iou += if a.masks.is_empty() { 1.0 } else { total / a.masks.len() as f64 };
}

/// The masks of one setting, as the comparison reads them.
#[derive(Serialize)]
struct Dumped {
    width: usize,
    height: usize,
    asked: usize,
    masks: Vec<DumpedMask>,
}

#[derive(Serialize)]
struct DumpedMask {
    predicted_iou: f32,
    stability: f32,
    point: [f32; 2],
    level: usize,
    /// Column-major runs, the first of them outside.
    counts: Vec<u32>,
}

/// Writes the photo and its proposals: all that is computed, coarsely judged, and coarsely judged
/// where not covered.
fn dump(network: &MaskNetwork, posed: &PosedPhoto, variants: &[Variant], to: &Path) -> Result<()> {
    let exact = variants[0].settings.exact();
    let coarse = Settings { full_resolution: false, ..exact };
    let covered = Settings { skip_covered: true, ..coarse };
    // The other code is not told which pixels undistortion left without a source.
    let photo = &Photo { valid: None, ..posed.photo.clone() };
    let never = AtomicBool::new(false);
    let mut found = BTreeMap::new();
    for (name, settings) in [("exact", exact), ("coarse", coarse), ("covered", covered)] {
        let seen = SeenPhoto::new(network, photo)?;
        let proposals = segment::proposals(&seen, photo, &settings, &[], &never)?;
        found.insert(name, dumped(&proposals));
    }
    let written = |e: std::io::Error| Error::invalid(format!("the dump: {e}"));
    if let Some(folder) = to.parent() {
        fs_err::create_dir_all(folder).map_err(written)?;
    }
    let text = serde_json::to_string(&found).map_err(|e| Error::internal("dump").caused_by(e))?;
    fs_err::write(to.with_extension("json"), text).map_err(written)?;
    grid::photo(photo)
        .save(to.with_extension("png"))
        .map_err(|e| Error::invalid(format!("the dump: {e}")))
}

fn dumped(proposals: &Proposals) -> Dumped {
    let (width, height) = (proposals.width, proposals.height);
    let masks = proposals.masks.iter().map(|mask| DumpedMask {
        predicted_iou: mask.predicted_iou,
        stability: mask.stability,
        point: mask.point,
        level: mask.level,
        counts: runs(&mask.mask, width, height),
    });
    Dumped { width, height, asked: proposals.asked, masks: masks.collect() }
}

/// Column-major runs of a mask, outside first.
fn runs(mask: &Bitset, width: usize, height: usize) -> Vec<u32> {
    let (mut counts, mut inside) = (vec![0], false);
    for cell in (0..width).flat_map(|x| (0..height).map(move |y| y * width + x)) {
        if mask.has(cell) != inside {
            counts.push(0);
            inside = !inside;
        }
        counts.last_mut().into_iter().for_each(|run| *run += 1);
    }
    counts
}

impl Measured {
    /// Turns sums over photos into means.
    fn finish(&mut self) {
        let photos = self.photos.max(1) as f64;
        for sum in [
            &mut self.seconds,
            &mut self.encode_seconds,
            &mut self.asked,
            &mut self.masks,
            &mut self.found,
            &mut self.found_back,
            &mut self.iou,
            &mut self.covered,
        ] {
            *sum /= photos;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{IndexMap, MaskInfo};

    fn masks(index: [u16; 16], count: usize) -> PhotoMasks {
        PhotoMasks {
            map: IndexMap { width: 4, height: 4, index: index.to_vec() },
            masks: vec![MaskInfo::default(); count],
        }
    }

    #[test]
    fn masks_find_their_partners_whatever_their_numbers() {
        let a = masks([1, 1, 2, 2, 1, 1, 2, 2, 0, 0, 0, 0, 3, 0, 0, 0], 3);
        let b = masks([2, 2, 1, 1, 2, 2, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0], 2);
        let mut measured = Measured::default();
        compare(&a, &b, &mut measured);
        assert!((measured.found - 1.0 / 3.0).abs() < 1e-9, "one of three: {measured:?}");
        assert!((measured.found_back - 0.5).abs() < 1e-9, "one of two: {measured:?}");
        assert!((measured.iou - (1.0 + 0.75 + 0.0) / 3.0).abs() < 1e-9, "mean: {measured:?}");
    }

    #[test]
    fn runs_go_down_the_columns() {
        let values: Vec<f32> = [0, 1, 0, 1, 1, 0].map(|v: u8| f32::from(v)).to_vec();
        assert_eq!(runs(&Bitset::over(&values, 0.5), 3, 2), [1, 3, 2], "3 wide, 2 high");
        assert_eq!(runs(&Bitset::over(&[1.0, 0.0], 0.5), 1, 2), [0, 1, 1], "begins inside");
    }
}
