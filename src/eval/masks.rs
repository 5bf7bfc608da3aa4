//! What each skip of the mask stage changes: `segsplat eval masks DIR`.
//!
//! The same photos go through the mask stage on several roads: nothing skipped first, then each
//! skip alone, then all. Of each road stand the time, the points asked, and how far its masks are
//! those of the first road. `dump` writes the masks before level choice and the one-mask-a-pixel
//! rule, for `tests/tools/official_masks.py` to compare with Segment Anything's own code.

use std::{
    cell::Cell,
    collections::BTreeMap,
    fmt,
    path::{Path, PathBuf},
    sync::atomic::{AtomicBool, AtomicUsize, Ordering},
    time::Instant,
};

use serde::Serialize;

use crate::{
    config::Config,
    error::{Error, ErrorCode, Result},
    models::MaskNetwork,
    photos,
    pipeline::{Engine, masks as stage, masks::SeenPhoto, reconstruct},
    scene::{Gaussians, Photo, PhotoMasks, PosedPhoto, SceneOptions},
    segment::{self, Bitset, Decoded, PromptDecoder, Proposals, Seed, Settings},
};

/// Masks of this much IoU are the same mask.
const ALIKE: f64 = 0.95;
/// Places along each side of a photo at which two index maps are compared.
const PLACES: u32 = 256;

/// What to run.
#[derive(Clone, Debug)]
pub struct MasksEval {
    /// A scene folder (with `transforms.json`), or a folder of scene folders.
    pub dir: PathBuf,
    /// Names of the scenes to take; empty: all.
    pub scenes: Vec<String>,
    /// Neighbouring photos of each scene; seeds need at least 2.
    pub photos: usize,
    /// Only the slowest and the product's road.
    pub short: bool,
    /// Folder for photos and proposals.
    pub dump: Option<PathBuf>,
}

/// A way through the mask stage.
#[derive(Clone, Debug)]
struct Road {
    name: &'static str,
    settings: Settings,
    /// The photo is encoded once, and not before each batch.
    once: bool,
    /// Points in one run of the decoder; `None`: as the bundle says.
    batch: Option<usize>,
}

/// One road, over all photos.
#[derive(Clone, Debug, Default, Serialize)]
pub struct RoadReport {
    /// What is skipped.
    pub road: String,
    /// Mean seconds a photo, encoding too.
    pub seconds: f64,
    /// Mean seconds a photo in the encoder.
    pub encode_seconds: f64,
    /// Mean points asked of a photo.
    pub asked: f64,
    /// Mean masks of a photo, one a pixel.
    pub masks: f64,
    /// Share of the first road's masks with a partner of IoU 0.95 and more here.
    pub found: f64,
    /// Share of the masks here with such a partner on the first road.
    pub found_back: f64,
    /// Mean IoU of the first road's masks with their best partner here.
    pub iou: f64,
    /// Share of the photo in some mask.
    pub covered: f64,
}

/// All roads.
#[derive(Clone, Debug, Serialize)]
pub struct MasksReport {
    /// Photos.
    pub photos: usize,
    /// Execution provider of the network.
    pub execution_provider: String,
    /// The roads; the first skips nothing.
    pub roads: Vec<RoadReport>,
}

/// A decoder as a road wants it, which counts.
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

    fn decode(&self, points: &[[f32; 2]]) -> Result<Decoded> {
        let before = self.asked.fetch_add(points.len(), Ordering::Relaxed);
        if self.once || before == 0 {
            return self.seen.decode(points);
        }
        SeenPhoto::new(self.network, self.photo)?.decode(points)
    }
}

/// Runs every road; `done` hears of each photo.
///
/// # Errors
/// `invalid_request` when there is no scene or an option is out of range, `model_unavailable` when
/// the bundle has no mask network, else whatever a stage says.
pub fn run(config: &Config, options: &MasksEval, done: &dyn Fn(&str)) -> Result<MasksReport> {
    if options.photos == 0 {
        return Err(Error::invalid("eval masks: 0 photos; it must be at least 1"));
    }
    let engine = Engine::open(&config.networks())?;
    let network = engine.masks()?;
    let roads = roads(&stage::settings(network.manifest()), options.short);
    let mut reports: Vec<RoadReport> = roads
        .iter()
        .map(|road| RoadReport { road: road.name.to_owned(), ..RoadReport::default() })
        .collect();
    let mut count = 0;
    for dir in super::scene_dirs(&options.dir, &options.scenes)? {
        let name = dir.file_name().unwrap_or_default().to_string_lossy().into_owned();
        let all = photos::read_dir(&dir, &config.limits)?;
        let chosen = neighbours(all, options.photos);
        let gaussians = gaussians(&engine, &chosen)?;
        let mut first: Vec<PhotoMasks> = Vec::new();
        for (road, report) in roads.iter().zip(&mut reports) {
            let found = engine
                .workers()
                .install(|| drive(&network, &chosen, gaussians.as_ref(), road, report))?;
            if first.is_empty() {
                first = found.clone();
            }
            for (a, b) in first.iter().zip(&found) {
                compare(a, b, report);
            }
        }
        if let Some(out) = &options.dump {
            for (i, posed) in chosen.iter().enumerate() {
                dump(&network, posed, &roads, &out.join(format!("{name}_{i}")))?;
            }
        }
        count += chosen.len();
        done(&format!("{name}: {} photos", chosen.len()));
    }
    for report in &mut reports {
        report.finish(count as f64);
    }
    Ok(MasksReport {
        photos: count,
        execution_provider: network.provider().name().to_owned(),
        roads: reports,
    })
}

/// Nothing skipped, each skip alone, and all of them.
fn roads(product: &Settings, short: bool) -> Vec<Road> {
    // The product's own rules, at full resolution and with every point asked.
    let slow = Settings {
        full_resolution: true,
        skip_covered: false,
        use_seeds: false,
        ..product.clone()
    };
    let road = |name, settings: Settings| Road { name, settings, once: true, batch: None };
    let nothing = road("nothing skipped", slow.clone());
    let all = road("all skips", product.clone());
    if short {
        return vec![nothing, all];
    }
    vec![
        nothing,
        Road { once: false, ..road("encoded for each batch", slow.clone()) },
        Road { batch: Some(1), ..road("one point a run", slow.clone()) },
        road("coarse logits", Settings { full_resolution: false, ..slow.clone() }),
        road("covered points", Settings { skip_covered: true, ..slow.clone() }),
        road("covered points, seeds", Settings { skip_covered: true, use_seeds: true, ..slow }),
        road("all skips but seeds", Settings { use_seeds: false, ..product.clone() }),
        all,
    ]
}

/// The middle photo and those taken nearest to it.
fn neighbours(mut photos: Vec<PosedPhoto>, count: usize) -> Vec<PosedPhoto> {
    let centre = |posed: &PosedPhoto| posed.camera.camera_to_world.center();
    if let Some(middle) = photos.get(photos.len() / 2).map(centre) {
        let away = |posed: &PosedPhoto| centre(posed).distance(middle);
        photos.sort_by(|a, b| away(a).total_cmp(&away(b)));
    }
    photos.truncate(count);
    photos
}

/// The Gaussians of these photos, for the seeds; `None` where they make no scene.
fn gaussians(engine: &Engine, photos: &[PosedPhoto]) -> Result<Option<Gaussians>> {
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

/// All photos of one scene on one road; times and counts go to the report.
fn drive(
    network: &MaskNetwork,
    photos: &[PosedPhoto],
    gaussians: Option<&Gaussians>,
    road: &Road,
    report: &mut RoadReport,
) -> Result<Vec<PhotoMasks>> {
    let never = AtomicBool::new(false);
    let mut found: Vec<PhotoMasks> = Vec::new();
    for (at, posed) in photos.iter().enumerate() {
        let start = Instant::now();
        let seeds: Vec<Seed> = match gaussians {
            Some(gaussians) if road.settings.use_seeds => {
                stage::seeds(gaussians, photos, &found, at)
            }
            _ => Vec::new(),
        };
        let begun = start.elapsed();
        let counted = Counted {
            seen: SeenPhoto::new(network, &posed.photo)?,
            network,
            photo: &posed.photo,
            once: road.once,
            batch: road.batch,
            asked: 0.into(),
        };
        report.encode_seconds += (start.elapsed() - begun).as_secs_f64();
        let masks = segment::everything(&counted, &posed.photo, &road.settings, &seeds, &never)?;
        report.seconds += start.elapsed().as_secs_f64();
        report.asked += counted.asked.into_inner() as f64;
        report.masks += masks.masks.len() as f64;
        report.covered += masks.masks.iter().map(|mask| mask.area).sum::<f64>();
        found.push(masks);
    }
    Ok(found)
}

/// How many of `a`'s masks are masks of `b`, and the other way round: means of this photo.
fn compare(a: &PhotoMasks, b: &PhotoMasks, report: &mut RoadReport) {
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
    report.found += alike(&best_a, a.masks.len());
    report.found_back += alike(&best_b, b.masks.len());
    let total: f64 = best_a.values().sum();
    report.iou += if a.masks.is_empty() { 1.0 } else { total / a.masks.len() as f64 };
}

/// The masks of one road, as the comparison reads them.
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
fn dump(network: &MaskNetwork, posed: &PosedPhoto, roads: &[Road], to: &Path) -> Result<()> {
    let exact = roads[0].settings.exact();
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
    let written = |e: std::io::Error| Error::invalid(format!("eval masks: the dump: {e}"));
    if let Some(folder) = to.parent() {
        fs_err::create_dir_all(folder).map_err(written)?;
    }
    let text = serde_json::to_string(&found).map_err(|e| Error::internal("dump").caused_by(e))?;
    fs_err::write(to.with_extension("json"), text).map_err(written)?;
    let picture = image::RgbImage::from_raw(photo.width, photo.height, photo.rgb.clone())
        .ok_or_else(|| Error::internal("a photo of another size than it says"))?;
    picture
        .save(to.with_extension("png"))
        .map_err(|e| Error::invalid(format!("eval masks: the dump: {e}")))
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
    let (mut counts, mut inside, run) = (Vec::new(), false, Cell::new(0_u32));
    for cell in (0..width).flat_map(|x| (0..height).map(move |y| y * width + x)) {
        if mask.has(cell) != inside {
            counts.push(run.replace(0));
            inside = !inside;
        }
        run.set(run.get() + 1);
    }
    counts.push(run.get());
    counts
}

impl RoadReport {
    /// Sums over photos to means.
    fn finish(&mut self, photos: f64) {
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
            *sum /= photos.max(1.0);
        }
    }
}

impl fmt::Display for RoadReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:<24} {:>8.2} {:>8.2} {:>7.0} {:>6.1} {:>8.1} {:>8.1} {:>6.3} {:>8.1}",
            self.road,
            self.seconds,
            self.encode_seconds,
            self.asked,
            self.masks,
            100.0 * self.found,
            100.0 * self.found_back,
            self.iou,
            100.0 * self.covered
        )
    }
}

impl fmt::Display for MasksReport {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{:<24} {:>8} {:>8} {:>7} {:>6} {:>8} {:>8} {:>6} {:>8}",
            "skipped",
            "s/photo",
            "encoder",
            "points",
            "masks",
            "found %",
            "back %",
            "IoU",
            "cover %"
        )?;
        for road in &self.roads {
            writeln!(f, "{road}")?;
        }
        write!(f, "{} photos; masks on {}", self.photos, self.execution_provider)
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
        let mut report = RoadReport::default();
        compare(&a, &b, &mut report);
        assert!((report.found - 1.0 / 3.0).abs() < 1e-9, "one of three: {report:?}");
        assert!((report.found_back - 0.5).abs() < 1e-9, "one of two: {report:?}");
        assert!((report.iou - (1.0 + 0.75 + 0.0) / 3.0).abs() < 1e-9, "mean: {report:?}");
    }

    #[test]
    fn runs_go_down_the_columns() {
        let values: Vec<f32> = [0, 1, 0, 1, 1, 0].map(|v: u8| f32::from(v)).to_vec();
        assert_eq!(runs(&Bitset::over(&values, 0.5), 3, 2), [1, 3, 2], "3 wide, 2 high");
        assert_eq!(runs(&Bitset::over(&[1.0, 0.0], 0.5), 1, 2), [0, 1, 1], "begins inside");
    }
}
