//! What each shortcut of the mask stage changes.
//!
//! The same photos go through the mask stage in several variants: no shortcut first, then each
//! shortcut alone, then all. A row has the time of a variant, the points asked, and how many of its
//! masks are masks of the first variant. `--dump` writes the masks before a level is chosen and
//! before each pixel gets one mask. `tests/tools/official_masks.py` compares them with those of
//! Segment Anything's own code.

use std::{
    collections::BTreeMap,
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, AtomicUsize, Ordering},
    time::Instant,
};

use serde_json::{Value, json};

use crate::{
    error::{Error, ErrorCode, Result},
    grid,
    limits::Limits,
    models::MaskNetwork,
    photo_files,
    pipeline::{Pipeline, masks as stage, masks::SeenPhoto},
    rows::{Rows, means, progress},
    scene::{
        Gaussians, JudgedMasks, MaskJudging, MaskLogits, Method, Photo, PhotoMasks, PosedPhoto,
        SceneOptions,
    },
    scenes::{is_posed, make, nearest},
    segment::{self, Bitset, PromptDecoder, Proposals, Seed, Settings},
    setup::Inputs,
};

/// Masks of this much IoU are the same mask.
const ALIKE: f64 = 0.95;
/// Places along each side of a photo at which two index maps are compared.
const PLACES: u32 = 256;

/// What to run: neighbouring photos of each scene; seeds need at least 2.
#[derive(Clone, Debug, clap::Args)]
#[command(mut_arg("photos", |photos| photos.default_value("3")))]
pub(crate) struct Args {
    #[command(flatten)]
    inputs: Inputs,
    /// Only the variant without shortcuts and the product's
    #[arg(long)]
    short: bool,
    /// The decoder's file judges masks at full resolution, as on a device, and not this program
    #[arg(long)]
    judged: bool,
    /// Folder for the photos and their masks before one mask a pixel is left
    #[arg(long, value_name = "DIR")]
    dump: Option<PathBuf>,
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

/// A decoder as a variant wants it, which counts points.
struct Counted<'a> {
    seen: SeenPhoto<'a>,
    network: &'a MaskNetwork,
    photo: &'a Photo,
    once: bool,
    batch: Option<usize>,
    /// The file judges masks, whatever runs it.
    judged: bool,
    /// Points that were asked, and those of them whose masks the file judged.
    asked: &'a [AtomicUsize; 2],
}

impl PromptDecoder for Counted<'_> {
    fn batch(&self) -> usize {
        self.batch.unwrap_or_else(|| self.seen.batch())
    }

    fn placed(&self) -> (u32, [u32; 2]) {
        self.seen.placed()
    }

    fn decode(&self, points: &[[f32; 2]]) -> Result<MaskLogits> {
        let before = self.asked[0].fetch_add(points.len(), Ordering::Relaxed);
        if self.once || before == 0 {
            return self.seen.decode(points);
        }
        SeenPhoto::new(self.network, self.photo)?.decode(points)
    }

    fn judges(&self) -> Option<(usize, [usize; 2])> {
        let grid = self.network.judges().filter(|_| self.judged);
        grid.map(|grid| (self.network.manifest().levels.len(), grid)).or_else(|| self.seen.judges())
    }

    fn judge(&self, points: &[[f32; 2]], judging: &MaskJudging) -> Result<JudgedMasks> {
        for count in self.asked {
            count.fetch_add(points.len(), Ordering::Relaxed);
        }
        self.seen.judge(points, judging)
    }

    fn on<'b>(&'b self, photo: &'b Photo) -> Result<Box<dyn PromptDecoder + 'b>> {
        let seen = SeenPhoto::new(self.network, photo)?;
        Ok(Box::new(Counted { seen, photo, ..*self }))
    }
}

/// Makes a row for each variant; its error is the share of the first variant's masks that it lacks.
/// A row has means over photos: seconds (also those of the encoder), points asked, those that the
/// file judged, masks, the share of the photo in some mask, and what [`compare`] says.
///
/// # Errors
/// `invalid_request` when there is no scene or an option is out of range, `model_unavailable` when
/// the bundle has no mask network, else whatever a stage says.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    if args.inputs.photos == 0 {
        return Err(Error::invalid("0 photos; it must be at least 1"));
    }
    let engine = Pipeline::open(&args.inputs.setup.networks(1))?;
    let network = engine.masks()?;
    if args.judged && network.judges().is_none() {
        return Err(Error::invalid("the mask decoder of the bundle does not judge masks"));
    }
    let variants = variants(&stage::settings(network.manifest(), &Method::default()), args.short);
    let mut measured: Vec<Vec<Value>> = vec![Vec::new(); variants.len()];
    for (name, dir) in args.inputs.find(is_posed)? {
        let photos = photo_files::read_dir(&dir, &Limits::default())?;
        let middle = photos.len() / 2;
        let beside = nearest(&photos, middle, args.inputs.photos - 1);
        let chosen: Vec<PosedPhoto> =
            [middle].into_iter().chain(beside).map(|i| photos[i].clone()).collect();
        let gaussians = gaussians(&engine, &chosen)?;
        let mut first: Vec<PhotoMasks> = Vec::new();
        for (variant, of_variant) in variants.iter().zip(&mut measured) {
            let found = engine
                .workers()
                .install(|| drive(&network, &chosen, gaussians.as_ref(), variant, args.judged))?;
            if first.is_empty() {
                first = found.iter().map(|(masks, _)| masks.clone()).collect();
            }
            for (first, (masks, mut row)) in first.iter().zip(found) {
                let [found, found_back, iou] = compare(first, &masks);
                row["found"] = json!(found);
                row["found_back"] = json!(found_back);
                row["iou"] = json!(iou);
                of_variant.push(row);
            }
        }
        if let Some(out) = &args.dump {
            for (i, posed) in chosen.iter().enumerate() {
                let to = out.join(format!("{name}_{i}"));
                dump(&network, posed, &variants, args.judged, &to)?;
            }
        }
        progress(&format!("{name}: {} photos", chosen.len()));
    }
    for (variant, of_photos) in variants.iter().zip(&measured) {
        let mut row = means(of_photos);
        row["variant"] = json!(variant.name);
        row["photos"] = json!(of_photos.len());
        let lost = 1.0 - row["found"].as_f64().unwrap_or(f64::NAN);
        rows.push(json!({ "masks_lost": lost, "iou": row["iou"] }), row)?;
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
    match make(engine, photos, &SceneOptions::default()) {
        Ok(scene) => Ok(Some(scene.gaussians)),
        Err(e) if e.code() == ErrorCode::InvalidRequest => Ok(None),
        Err(e) => Err(e),
    }
}

/// All photos of one scene in one variant: the masks of each, with times and counts.
fn drive(
    network: &MaskNetwork,
    photos: &[PosedPhoto],
    gaussians: Option<&Gaussians>,
    variant: &Variant,
    judged: bool,
) -> Result<Vec<(PhotoMasks, Value)>> {
    let never = AtomicBool::new(false);
    let (mut found, mut rows) = (Vec::new(), Vec::new());
    for (at, posed) in photos.iter().enumerate() {
        let start = Instant::now();
        let seeds: Vec<Seed> = match gaussians {
            Some(gaussians) if variant.settings.use_seeds => {
                stage::seeds(gaussians, photos, &found, at)
            }
            _ => Vec::new(),
        };
        let (begun, asked) = (start.elapsed(), <[AtomicUsize; 2]>::default());
        let counted = Counted {
            seen: SeenPhoto::new(network, &posed.photo)?,
            network,
            photo: &posed.photo,
            once: variant.once,
            batch: variant.batch,
            judged,
            asked: &asked,
        };
        let encode_seconds = (start.elapsed() - begun).as_secs_f64();
        let masks = segment::everything(&counted, &posed.photo, &variant.settings, &seeds, &never)?;
        rows.push(json!({
            "seconds": start.elapsed().as_secs_f64(),
            "encode_seconds": encode_seconds,
            "asked": asked[0].load(Ordering::Relaxed),
            "judged": asked[1].load(Ordering::Relaxed),
            "masks": masks.masks.len(),
            "covered": masks.masks.iter().map(|mask| mask.area).sum::<f64>(),
        }));
        found.push(masks);
    }
    Ok(found.into_iter().zip(rows).collect())
}

/// The share of `a`'s masks with a partner in `b` of IoU [`ALIKE`] and more, the share of `b`'s
/// with one in `a`, and the mean IoU of `a`'s masks with their best partner.
fn compare(a: &PhotoMasks, b: &PhotoMasks) -> [f64; 3] {
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
    let total: f64 = best_a.values().sum();
    let iou = if a.masks.is_empty() { 1.0 } else { total / a.masks.len() as f64 };
    [alike(&best_a, a.masks.len()), alike(&best_b, b.masks.len()), iou]
}

/// Writes the photo and its proposals: all that is computed, coarsely judged, and coarsely judged
/// where not covered.
fn dump(
    network: &MaskNetwork,
    posed: &PosedPhoto,
    variants: &[Variant],
    judged: bool,
    to: &Path,
) -> Result<()> {
    let exact = variants[0].settings.exact();
    let coarse = Settings { full_resolution: false, ..exact };
    let covered = Settings { skip_covered: true, ..coarse };
    // The other code is not told which pixels undistortion left without a source.
    let photo = &Photo { valid: None, ..posed.photo.clone() };
    let never = AtomicBool::new(false);
    let mut found = serde_json::Map::new();
    for (name, settings) in [("exact", exact), ("coarse", coarse), ("covered", covered)] {
        let seen = SeenPhoto::new(network, photo)?;
        let asked = &<[AtomicUsize; 2]>::default();
        let seen = Counted { seen, network, photo, once: true, batch: None, judged, asked };
        let proposals = segment::proposals(&seen, photo, &settings, &[], &never)?;
        found.insert(name.to_owned(), dumped(&proposals));
    }
    let written = |e: std::io::Error| Error::invalid(format!("the dump: {e}"));
    if let Some(folder) = to.parent() {
        fs_err::create_dir_all(folder).map_err(written)?;
    }
    let text = Value::Object(found).to_string();
    fs_err::write(to.with_extension("json"), text).map_err(written)?;
    grid::photo(photo)
        .save(to.with_extension("png"))
        .map_err(|e| Error::invalid(format!("the dump: {e}")))
}

/// The masks of one setting; `counts` are column-major runs, the first of them outside.
fn dumped(proposals: &Proposals) -> Value {
    let (width, height) = (proposals.width, proposals.height);
    let masks = proposals.masks.iter().map(|mask| {
        json!({
            "predicted_iou": mask.predicted_iou,
            "stability": mask.stability,
            "point": mask.point,
            "level": mask.level,
            "counts": runs(&mask.mask, width, height),
        })
    });
    let masks: Vec<Value> = masks.collect();
    json!({ "width": width, "height": height, "asked": proposals.asked, "masks": masks })
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

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{IndexMap, MaskInfo};

    fn masks(index: [u16; 16], count: usize) -> PhotoMasks {
        PhotoMasks {
            wholes: Vec::new(),
            map: IndexMap { width: 4, height: 4, index: index.to_vec() },
            masks: vec![MaskInfo::default(); count],
        }
    }

    #[test]
    fn masks_find_their_partners_whatever_their_numbers() {
        let a = masks([1, 1, 2, 2, 1, 1, 2, 2, 0, 0, 0, 0, 3, 0, 0, 0], 3);
        let b = masks([2, 2, 1, 1, 2, 2, 1, 0, 0, 0, 0, 0, 0, 0, 0, 0], 2);
        let found = compare(&a, &b);
        // One of three, one of two, and the mean of 1, 0.75 and 0.
        for (found, want) in found.into_iter().zip([1.0 / 3.0, 0.5, 1.75 / 3.0]) {
            assert!((found - want).abs() < 1e-9, "{found} is not {want}");
        }
    }

    #[test]
    fn runs_go_down_the_columns() {
        let values: Vec<f32> = [0, 1, 0, 1, 1, 0].map(|v: u8| f32::from(v)).to_vec();
        assert_eq!(runs(&Bitset::over(&values, 0.5), 3, 2), [1, 3, 2], "3 wide, 2 high");
        assert_eq!(runs(&Bitset::over(&[1.0, 0.0], 0.5), 1, 2), [0, 1, 1], "begins inside");
    }
}
