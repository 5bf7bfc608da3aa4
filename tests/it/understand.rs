//! The stages that make the semantics of a scene, with stand-ins for the networks and with the
//! small networks of the fixture.

use std::{
    path::Path,
    sync::{
        Mutex,
        atomic::{AtomicBool, Ordering},
        mpsc,
    },
    time::Duration,
};

use segsplat::{
    config::Config,
    error::{ErrorCode, Result},
    pipeline::{
        Pipeline,
        masks::{GiveMasks, MasksOfPhotos},
        reconstruct,
        semantics::{Context, SemanticsInput, SemanticsTools, understand, understand_with},
    },
    sample::{self, SampleOptions},
    scene::{
        Camera, CameraToWorld, Crop, CropShape, DenseFeatures, Gaussians, IndexMap, Intrinsics,
        MaskInfo, Method, Photo, PhotoMasks, PosedPhoto, Preset, RawGaussians, SceneCamera,
        SceneOptions, Semantics, SourcePixel, Stage, Watch,
    },
    semantics::Scorer,
};

use crate::common::opened;

static NO_CANCEL: AtomicBool = AtomicBool::new(false);
const SIDE: u32 = 16;

fn lens(scale: u32) -> Intrinsics {
    let (size, focal) = (SIDE * scale, f64::from(SIDE * scale));
    Intrinsics { fx: focal, fy: focal, cx: focal / 2.0, cy: focal / 2.0, width: size, height: size }
}

/// Two photos of a wall: red to the left, green to the right. The network saw half their size.
struct Wall {
    photos: Vec<PosedPhoto>,
    cameras: Vec<SceneCamera>,
    gaussians: Gaussians,
}

fn wall() -> Wall {
    let pose = |v: u32| {
        let x = f64::from(v) * 0.25;
        let pose = [1., 0., 0., x, 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
        CameraToWorld::from_row_major(&pose, "test").unwrap()
    };
    let camera = |v| Camera { intrinsics: lens(2), camera_to_world: pose(v) };
    let file = |v: u32| format!("{v}.png");
    let photo = |v: u32| {
        let edge = SIDE - 2 * v;
        let row = (0..2 * SIDE).flat_map(|x| if x < edge { [200, 10, 10] } else { [10, 200, 10] });
        let rgb: Vec<u8> = row.collect::<Vec<u8>>().repeat(2 * SIDE as usize);
        let photo = Photo { width: 2 * SIDE, height: 2 * SIDE, rgb, valid: None };
        PosedPhoto { file: file(v), photo, camera: camera(v), intrinsics_made_for: None }
    };
    let input = |v| SceneCamera { file: file(v), camera: camera(v), network: Some(lens(1)) };
    let mut raw = RawGaussians::default();
    for v in 0..2_u16 {
        for (x, y) in (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y))) {
            let at = lens(1).unproject(f64::from(x) + 0.5, f64::from(y) + 0.5, 4.0);
            raw.means.push([at.x as f32 + 0.25 * f32::from(v), at.y as f32, 4.0]);
            raw.source.push(SourcePixel { view: v, x: x as u16, y: y as u16 });
        }
    }
    let n = raw.means.len();
    raw.quats = vec![[1.0, 0.0, 0.0, 0.0]; n];
    raw.scales = vec![[0.1; 3]; n];
    raw.opacities = vec![0.9; n];
    raw.sh = vec![[0.0; 3]; n];
    raw.semantic_index = vec![0; n];
    Wall {
        photos: (0..2).map(photo).collect(),
        cameras: (0..2).map(input).collect(),
        gaussians: Gaussians::sanitize(raw).unwrap().0,
    }
}

impl Wall {
    fn parts(&self) -> SemanticsInput<'_> {
        SemanticsInput { photos: &self.photos, cameras: &self.cameras, gaussians: &self.gaussians }
    }
}

/// Masks 1 and 2 of each photo: its two colours, on a grid of 32 columns; photo 1 counts from
/// the right.
fn two_masks(v: u32) -> PhotoMasks {
    let edge = SIDE - 2 * v;
    let order = if v == 0 { [1, 2] } else { [2, 1] };
    let row: Vec<u16> = (0..2 * SIDE).map(|x| order[usize::from(x >= edge)]).collect();
    let map = IndexMap { width: 2 * SIDE, height: 4, index: row.repeat(4) };
    PhotoMasks { wholes: Vec::new(), map, masks: vec![MaskInfo::default(); 2] }
}

/// Mean colour of what is not black, unit length.
#[expect(clippy::ptr_arg, reason = "as `Embed` takes them")]
fn colour_of(crops: &Vec<Crop>) -> Result<Vec<f32>> {
    let mean = |crop: &Crop| {
        let mut sum = [0.0_f32; 3];
        for pixel in crop.rgb.chunks_exact(3) {
            sum.iter_mut().zip(pixel).for_each(|(s, v)| *s += f32::from(*v));
        }
        let length = sum.iter().map(|v| v * v).sum::<f32>().sqrt().max(1e-9);
        sum.map(|v| v / length)
    };
    Ok(crops.iter().flat_map(mean).collect())
}

type Masks<'a> = &'a MasksOfPhotos<'a>;
type Embed<'a> = &'a (dyn Fn(&Vec<Crop>) -> Result<Vec<f32>> + Sync);

/// Gives the masks of each photo, the last photo first.
fn each(give: &GiveMasks<'_>, masks: Vec<PhotoMasks>) -> Result<()> {
    masks.into_iter().enumerate().rev().try_for_each(|(photo, masks)| give(photo, masks))
}

type Tools<'a> = SemanticsTools<'a, Vec<Crop>>;

fn tools<'a>(masks: Masks<'a>, embed: Embed<'a>) -> Tools<'a> {
    SemanticsTools {
        masks,
        prepare: &|crops| crops.to_vec(),
        embed,
        dim: 3,
        crop_margin: 0.1,
        crop_shape: CropShape::Square,
        batch: 3,
        context: None,
    }
}

fn made(wall: &Wall, tools: &Tools<'_>, options: &Method) -> Result<Semantics> {
    let watch = Watch { progress: &|_, _| (), cancel: &NO_CANCEL };
    understand_with(tools, &wall.parts(), options, watch)
}

#[test]
fn each_gaussian_takes_the_bank_row_of_its_pixel() {
    let wall = wall();
    let told = Mutex::new(Vec::new());
    let masks: Masks<'_> = &|give| each(give, (0..2).map(two_masks).collect());
    let watch = Watch {
        progress: &|stage: Stage, fraction| {
            told.lock().unwrap().push((stage.name(), fraction));
        },
        cancel: &NO_CANCEL,
    };
    let options = Method::default();
    let made = understand_with(&tools(masks, &colour_of), &wall.parts(), &options, watch).unwrap();
    assert_eq!((made.bank.len(), made.bank.dim), (2, 3), "four masks of two colours");
    assert_eq!(made.report.masks, [2, 2]);
    assert_eq!((made.report.bank_size, made.report.labelled), (2, 512));
    let stages: Vec<&str> = made.report.stages.iter().map(|s| s.stage.as_str()).collect();
    assert_eq!(stages, ["masks", "embed", "bank", "assign"]);
    let red = made.index[0];
    let green = 3 - red;
    assert!((1..=2).contains(&red));
    for (i, source) in wall.gaussians.source().iter().enumerate() {
        let edge = SIDE as u16 / 2 - source.view;
        let want = if source.x < edge { red } else { green };
        assert_eq!(made.index[i], want, "{source:?}");
    }
    assert_eq!(made.photos[1].index[..2], [red, red]);
    assert_eq!(made.photos[1].index[14], green, "photo 1 turns green at column 14 of 32");
    let row = made.bank.row(usize::from(red) - 1);
    assert!(row[0] > 0.9 && row[1] < 0.2, "{row:?} is red");
    let told = told.into_inner().unwrap();
    assert!(told.contains(&("masks", 0.5)) && told.contains(&("assign", 1.0)), "{told:?}");
    let parts: Vec<&str> = told.iter().map(|t| t.0).collect();
    assert!(parts.is_sorted_by_key(|name| stages.iter().position(|s| s == name)), "{parts:?}");
}

#[test]
fn masks_of_several_photos_fill_a_batch() {
    let wall = wall();
    let masks: Masks<'_> = &|give| each(give, (0..2).map(two_masks).collect());
    let batches = Mutex::new(Vec::new());
    let embed: Embed<'_> = &|crops| {
        batches.lock().unwrap().push(crops.len());
        colour_of(crops)
    };
    made(&wall, &tools(masks, embed), &Method::default()).unwrap();
    assert_eq!(batches.into_inner().unwrap(), [3, 1], "two masks each of two photos");
}

#[test]
fn masks_of_a_photo_are_embedded_while_those_of_the_next_are_found() {
    let wall = wall();
    let (begun, begins) = mpsc::channel();
    let begins = Mutex::new(begins);
    let masks: Masks<'_> = &|give| {
        give(0, two_masks(0))?;
        let told = begins.lock().unwrap().recv_timeout(Duration::from_secs(60));
        told.expect("the first photo's masks are embedded meanwhile");
        give(1, two_masks(1))
    };
    let embed: Embed<'_> = &|crops| {
        begun.send(()).expect("the test listens");
        colour_of(crops)
    };
    let made = made(&wall, &Tools { batch: 2, ..tools(masks, embed) }, &Method::default());
    assert_eq!(made.unwrap().report.masks, [2, 2]);
}

#[test]
fn the_place_in_the_whole_photo_is_added_to_each_crop() {
    let wall = wall();
    let masks: Masks<'_> = &|give| {
        let mut masks = vec![two_masks(0), PhotoMasks::default()];
        masks[0].masks[0].area = 0.5;
        masks[0].masks[1].area = 0.001;
        each(give, masks)
    };
    let asked = Mutex::new(Vec::new());
    // Blue everywhere.
    let dense = |photo: &Photo| {
        asked.lock().unwrap().push(photo.width);
        Ok(Some(DenseFeatures { columns: 1, rows: 1, data: vec![0.0, 0.0, 3.0] }))
    };
    let (large, none) = (|area: f64| f64::from(u8::from(area > 0.01)), |_: f64| 0.0);
    let context = Some(Context { dense: &dense, weight: &large });
    let told = Mutex::new(Vec::new());
    let watch = Watch {
        progress: &|stage, share| told.lock().unwrap().push((stage, share)),
        cancel: &NO_CANCEL,
    };
    let with = SemanticsTools { context, ..tools(masks, &colour_of) };
    let method = Method { tracks: false, bank_rows: 2, merge_cosine: 0.0, ..Method::default() };
    let whole = understand_with(&with, &wall.parts(), &method, watch).unwrap();
    assert_eq!(*asked.lock().unwrap(), [32], "a photo without masks is not looked at");
    let told = told.into_inner().unwrap();
    let embed = told.iter().filter(|(stage, _)| *stage == Stage::Embed).map(|(_, share)| *share);
    let embed: Vec<f32> = embed.collect();
    assert!(embed.is_sorted() && embed.first() == Some(&0.0), "{embed:?}");
    assert_eq!(embed.last(), Some(&1.0), "{embed:?}");
    // Crops and photos that were done before all masks were there are not told.
    assert!(embed.iter().all(|share| [0.0, 5.0 / 7.0, 1.0].contains(share)), "{embed:?}");
    let rows = [0, 15].map(|i| whole.bank.row(usize::from(whole.index[i]) - 1));
    let half = 0.5_f32.sqrt();
    assert!([0, 2].iter().all(|i| (rows[0][*i] - half).abs() < 0.03), "{rows:?}");
    assert!(rows[1][2] < 0.1, "a small mask keeps its crop's: {rows:?}");
    let context = Some(Context { dense: &dense, weight: &none });
    let with = SemanticsTools { context, ..tools(masks, &colour_of) };
    made(&wall, &with, &method).unwrap();
    assert_eq!(asked.lock().unwrap().len(), 1, "no photo is looked at for nothing");
}

#[test]
fn a_photo_without_masks_and_a_scene_without_any_are_legal() {
    let wall = wall();
    let one: Masks<'_> = &|give| each(give, vec![two_masks(0), PhotoMasks::default()]);
    let options = Method { votes: true, ..Method::default() };
    let half = made(&wall, &tools(one, &colour_of), &options).unwrap();
    assert_eq!(half.report.masks, [2, 0]);
    assert!(half.index[..256].iter().all(|m| *m > 0), "photo 0 has its own");
    let alone = Method { votes: false, ..options };
    let plain = made(&wall, &tools(one, &colour_of), &alone).unwrap();
    assert!(plain.index[256..].iter().all(|m| *m == 0), "photo 1 has none");
    let filled = half.index[256..].iter().filter(|m| **m > 0).count();
    assert!(filled > 200, "photo 0 votes for what photo 1 also shows: {filled}");
    let none: Masks<'_> = &|give| each(give, vec![PhotoMasks::default(); 2]);
    let empty = made(&wall, &tools(none, &colour_of), &options).unwrap();
    assert_eq!((empty.bank.len(), empty.bank.dim, empty.report.labelled), (0, 3, 0));
    assert_eq!(empty.index, vec![0; 512]);
}

#[test]
fn masks_that_mean_nothing_stay_background() {
    let wall = wall();
    let masks: Masks<'_> = &|give| {
        let mut masks: Vec<PhotoMasks> = (0..2).map(two_masks).collect();
        masks[0].masks.push(MaskInfo::default());
        each(give, masks)
    };
    // Green crops get no embedding.
    let embed: Embed<'_> = &|crops| {
        let mut rows = colour_of(crops)?;
        rows.chunks_exact_mut(3).filter(|row| row[1] > 0.5).for_each(|row| row.fill(0.0));
        Ok(rows)
    };
    let made = made(&wall, &tools(masks, embed), &Method::default()).unwrap();
    assert_eq!((made.bank.len(), made.report.masks[0]), (1, 3));
    assert_eq!((made.index[0], made.index[15]), (1, 0), "red has a row, green has none");
}

#[test]
fn two_sides_of_one_thing_are_joined_only_when_asked() {
    let wall = wall();
    // Each photo has one mask over all; photo 1's embedding leans another way.
    let whole = || PhotoMasks {
        wholes: Vec::new(),
        map: IndexMap { width: 1, height: 1, index: vec![1] },
        masks: vec![MaskInfo::default()],
    };
    let masks: Masks<'_> = &|give| each(give, vec![whole(), whole()]);
    let embed: Embed<'_> = &|crops| {
        assert_eq!(crops.len(), 2);
        Ok(vec![1.0, 0.0, 0.0, 0.6, 0.8, 0.0])
    };
    // 1.2 masks a photo make two rows.
    let with = |merge_cosine| Method { tracks: false, merge_cosine, ..Method::default() };
    let apart = made(&wall, &tools(masks, embed), &with(0.0)).unwrap();
    assert_eq!((apart.bank.len(), apart.index[0] == apart.index[300]), (2, false));
    let strict = made(&wall, &tools(masks, embed), &with(0.7)).unwrap();
    assert_eq!(strict.bank.len(), 2, "the rows' cosine is 0.6");
    let joined = made(&wall, &tools(masks, embed), &with(0.5)).unwrap();
    assert_eq!((joined.bank.len(), joined.report.bank_size), (1, 1));
    assert!(joined.index.iter().all(|m| *m == 1));
    assert_eq!(joined.photos[1].index, [1]);
    assert_eq!(joined.bank.rows, [0.8, 0.4, 0.0], "the mean of both");
}

#[test]
fn masks_of_one_thing_are_a_row_whatever_each_looks_like() {
    let wall = wall();
    // The larger mask of each photo is the second one.
    let masks: Masks<'_> = &|give| {
        let mut masks: Vec<PhotoMasks> = (0..2).map(two_masks).collect();
        masks.iter_mut().for_each(|of| of.masks[1].area = 0.5);
        each(give, masks)
    };
    let looks = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0], [-1.0, 0.0, 0.0]];
    let embedded = Mutex::new(looks.iter());
    let embed: Embed<'_> = &|crops| {
        let mut next = embedded.lock().unwrap();
        Ok(crops.iter().flat_map(|_| *next.next().unwrap()).collect())
    };
    let made = made(&wall, &tools(masks, embed), &Method::default()).unwrap();
    // Photo 0 has masks 0 (left) and 1 (right), photo 1 masks 2 (right) and 3 (left) of them all.
    let [left, right] = [0, 15].map(|i| usize::from(made.index[i]));
    assert_eq!((made.bank.len(), made.report.bank_size), (2, 2));
    let of_row = |entry: usize| -> Vec<[f32; 3]> {
        let all = made.views.entries.iter().zip(made.views.rows.as_chunks::<3>().0);
        all.filter(|(m, _)| usize::from(**m) == entry).map(|(_, row)| *row).collect()
    };
    assert_eq!(of_row(right), [looks[1], looks[2]]);
    assert_eq!(of_row(left), [looks[3], looks[0]], "the larger mask first");
    assert_eq!(made.bank.row(right - 1), [0.0, 0.5, 0.5], "the mean");
    assert_eq!(
        made.masks.iter().map(|m| usize::from(m.entry)).collect::<Vec<_>>(),
        [left, right, right, left]
    );
}

#[test]
fn wrong_answers_and_wrong_scenes_are_refused_by_name() {
    let good = wall();
    let masks: Masks<'_> = &|give| each(give, (0..2).map(two_masks).collect());
    let fails = |wall: &Wall, tools: &Tools<'_>| made(wall, tools, &Method::default()).unwrap_err();
    let few: Masks<'_> = &|give| each(give, vec![two_masks(0)]);
    let error = fails(&good, &tools(few, &colour_of));
    assert!(error.message().contains("masks of 1 photos, not of 2"), "{error}");
    let error = fails(&good, &tools(masks, &|_| Ok(vec![1.0])));
    assert!(error.message().contains("1 numbers for 3 crops"), "{error}");
    let mut other = wall();
    other.photos[1].file = "x.png".to_owned();
    assert_eq!(fails(&other, &tools(masks, &colour_of)).code(), ErrorCode::Internal);
    let mut old = wall();
    old.cameras.iter_mut().for_each(|c| c.network = None);
    let error = fails(&old, &tools(masks, &colour_of));
    assert_eq!(error.code(), ErrorCode::InvalidRequest);
    let stop = AtomicBool::new(true);
    let watch = Watch { progress: &|_, _| (), cancel: &stop };
    let options = Method::default();
    let error = understand_with(&tools(masks, &colour_of), &good.parts(), &options, watch);
    assert_eq!(error.unwrap_err().code(), ErrorCode::Cancelled);
}

fn engine(threads: usize) -> Option<Pipeline> {
    let mut config = Config::default();
    config.bundle = Some(Path::new("tests/fixtures/colours").to_owned());
    config.threads = threads;
    config.jobs = 1;
    opened(Pipeline::open(&config.networks()))
}

fn understood(engine: &Pipeline, wall: &Wall) -> Semantics {
    let watch = Watch { progress: &|_, _| (), cancel: &NO_CANCEL };
    understand(engine, &wall.parts(), &Method::default(), watch).unwrap()
}

#[test]
fn the_bundles_networks_give_a_bank_that_words_select_and_the_same_one_every_time() {
    let Some(engine) = engine(1) else { return };
    let wall = wall();
    assert_eq!(engine.bundle().lacks_semantics(), None);
    let made = understood(&engine, &wall);
    assert!(made.report.masks.iter().all(|count| *count >= 2), "{:?}", made.report);
    assert_eq!(made.report.bundle_sha256, engine.bundle().sha256());
    assert_eq!(made.report.execution_provider, "cpu");
    // The same photos, another process's worth of sessions, one thread each.
    let again = understood(&self::engine(1).unwrap(), &wall);
    let bits = |of: &Semantics| of.bank.rows.iter().map(|v| v.to_bits()).collect::<Vec<u32>>();
    assert_eq!(bits(&made), bits(&again), "the bank, bit for bit");
    assert_eq!((&made.index, &made.photos), (&again.index, &again.photos));

    let scoring = engine.scoring(&engine.scoring_method(Preset::Default).unwrap()).unwrap();
    let scorer = Scorer::new(&made.bank, scoring.into()).unwrap();
    let towers = engine.image_text().unwrap();
    let mut right = 0;
    for (word, is_red) in [("red", true), ("green", false)] {
        let text = towers.embed_texts(&[word.to_owned()]).unwrap().remove(0);
        let scores = scorer.text(&text.row).unwrap();
        for (m, source) in made.index.iter().zip(wall.gaussians.source()) {
            let red = source.x < SIDE as u16 / 2 - source.view;
            right += usize::from(scores.selects(*m) == (red == is_red));
        }
    }
    assert!(right > 1000, "{right} of 1024 Gaussians answer to their colour and no other");
}

#[test]
fn a_scene_of_the_pipeline_says_which_pixels_made_it() {
    let Some(engine) = engine(2) else { return };
    let options = SampleOptions { photos: 3, width: 120, height: 64, seed: 4 };
    let photos = sample::photos(&options).unwrap();
    let made = reconstruct(&engine, &photos, &SceneOptions::default(), &|_, _| (), &NO_CANCEL);
    let made = made.unwrap();
    let network = made.cameras[0].network.unwrap();
    assert_eq!((network.width, network.height), (48, 32), "the bundle's bucket of this shape");
    assert!((network.fx - made.report.network_focal_px[0]).abs() < 1e-9, "square pixels");
    let parts =
        SemanticsInput { photos: &photos, cameras: &made.cameras, gaussians: &made.gaussians };
    let watch = Watch { progress: &|_, _| (), cancel: &NO_CANCEL };
    let alone = Method { votes: false, ..Method::default() };
    let meant = understand(&engine, &parts, &alone, watch).unwrap();
    assert_eq!(meant.index.len(), made.gaussians.len());
    assert_eq!(meant.photos.len(), 3);
    for (m, source) in meant.index.iter().zip(made.gaussians.source()) {
        // The picture is the photo without 12 columns on each side, at half its size.
        let (x, y) = (2.0 * f64::from(source.x) + 13.0, 2.0 * f64::from(source.y) + 1.0);
        let map = &meant.photos[usize::from(source.view)];
        assert_eq!(*m, map.at(x / 120.0, y / 64.0), "{source:?}");
    }
    assert!(meant.report.labelled > 0, "{:?}", meant.report);
}

#[test]
fn a_job_that_waits_keeps_no_other_job_waiting() {
    let Some(engine) = engine(1) else { return };
    let (wall, engine) = (wall(), &engine);
    let options = SampleOptions { photos: 2, width: 96, height: 64, seed: 4 };
    let photos = sample::photos(&options).unwrap();
    let (waits, waiting) = mpsc::channel();
    let (goes_on, go_on) = mpsc::channel();
    let go_on = Mutex::new(go_on);
    let patience = Duration::from_secs(120);
    std::thread::scope(|scope| {
        let photos = &photos;
        scope.spawn(move || {
            waiting.recv_timeout(patience).expect("the semantics begin");
            let made =
                reconstruct(engine, photos, &SceneOptions::default(), &|_, _| (), &NO_CANCEL);
            made.expect("a scene");
            goes_on.send(()).expect("the other job waits");
        });
        // It waits in its first stage, as for a network, until the other job has its scene.
        let begun = AtomicBool::new(false);
        let progress = |_: Stage, _: f32| {
            if !begun.swap(true, Ordering::AcqRel) {
                waits.send(()).expect("the other job listens");
                let other = go_on.lock().unwrap().recv_timeout(patience);
                other.expect("a scene is made while semantics wait");
            }
        };
        let watch = Watch { progress: &progress, cancel: &NO_CANCEL };
        understand(engine, &wall.parts(), &Method::default(), watch).unwrap();
    });
}
