//! `preset=paper` against the paper, step by step: a slow plain f64 road from masks and embeddings
//! to the mask of a text, held against what the product gives.

use std::{
    io::{Cursor, Read},
    path::Path,
    sync::{Arc, atomic::AtomicBool},
};

use segsplat::{
    config::Config,
    jobs::PipelineNetworks,
    pipeline::{
        Pipeline, Reconstruction, masks, reconstruct,
        semantics::{SemanticsInput, understand},
    },
    render::{Background, Kinds, RenderRequest, cpu::CpuRenderer, oracle},
    sample::{self, SampleOptions},
    scene::{
        Bank, Camera, Crop, IndexMap, Method, Photo, PosedPhoto, Preset, Provenance, Scene,
        SceneCamera, SceneId, SceneOptions, Semantics, Watch,
    },
    service::{
        CameraSpec, FeatureKind, FeaturesSpec, LensSpec, MaskFormat, OfflineService, PoseSpec,
        QuerySpec, ScoringOptions, ViewOptions, default_near,
    },
};
use segsplat_testing::labels::literal;

use crate::common::opened;

static NO_CANCEL: AtomicBool = AtomicBool::new(false);
/// A pixel whose score is this near to its threshold is a tie.
const TIE: f64 = 1e-2;

fn engine() -> Option<Pipeline> {
    let mut config = Config::default();
    config.bundle = Some(Path::new("tests/fixtures/colours").to_owned());
    config.threads = 2;
    config.jobs = 1;
    opened(Pipeline::open(&config.networks()))
}

fn photos() -> Vec<PosedPhoto> {
    let options = SampleOptions { photos: 2, width: 120, height: 80, seed: 4 };
    sample::photos(&options).unwrap()
}

fn paper() -> SceneOptions {
    SceneOptions { preset: Preset::Paper, ..SceneOptions::default() }
}

fn made(engine: &Pipeline, photos: &[PosedPhoto], options: &SceneOptions) -> Arc<Scene> {
    let made: Reconstruction =
        reconstruct(engine, photos, options, &|_, _| (), &NO_CANCEL).unwrap();
    let scene = made.into_scene(SceneId::from_bytes([3; 16]), 0, Provenance::default());
    let (cameras, gaussians) = (&scene.meta.cameras[..], &scene.gaussians);
    let parts = SemanticsInput { photos, cameras, gaussians };
    let watch = Watch { progress: &|_, _| (), cancel: &NO_CANCEL };
    let semantics = understand(engine, &parts, &scene.meta.report.method, watch).unwrap();
    Arc::new(scene.with_semantics(Arc::new(semantics)).unwrap())
}

/// The mask cut out of its photo: its box as a square, black outside of the mask.
fn crop(photo: &Photo, map: &IndexMap, runs: &[[u32; 2]]) -> Crop {
    let inside = |x: u32, y: u32| {
        let cell = |at: u32, pixels: u32, cells: u32| (2 * at + 1) * cells / (2 * pixels);
        let cell = cell(y, photo.height, map.height) * map.width + cell(x, photo.width, map.width);
        runs.iter().any(|[first, count]| (*first..*first + *count).contains(&cell))
    };
    let all = (0..photo.height).flat_map(|y| (0..photo.width).map(move |x| (x, y)));
    let mine: Vec<(u32, u32)> = all.filter(|&(x, y)| inside(x, y)).collect();
    let (x0, x1) =
        (mine.iter().map(|p| p.0).min().unwrap(), mine.iter().map(|p| p.0).max().unwrap());
    let (y0, y1) = (mine[0].1, mine[mine.len() - 1].1);
    let side = (x1 - x0).max(y1 - y0) + 1;
    let corner = [x0, y0].map(i64::from);
    let corner = [
        corner[0] - i64::from(side - (x1 - x0 + 1)) / 2,
        corner[1] - i64::from(side - (y1 - y0 + 1)) / 2,
    ];
    let mut rgb = vec![0; (side * side * 3) as usize];
    for (x, y) in mine {
        let (u, v) = ((i64::from(x) - corner[0]) as usize, (i64::from(y) - corner[1]) as usize);
        let (to, from) = ((v * side as usize + u) * 3, ((y * photo.width + x) * 3) as usize);
        rgb[to..to + 3].copy_from_slice(&photo.rgb[from..from + 3]);
    }
    Crop { width: side, height: side, rgb }
}

fn distance(a: &[f32], b: &[f32]) -> f64 {
    a.iter().zip(b).map(|(a, b)| (f64::from(*a) - f64::from(*b)).powi(2)).sum()
}

/// The entry of the pixel that made a Gaussian, by the two lenses.
fn entry(map: &IndexMap, camera: &SceneCamera, [x, y]: [u16; 2]) -> u16 {
    let (n, p) = (camera.network.unwrap(), camera.camera.intrinsics);
    let u = (f64::from(x) + 0.5 - n.cx) / n.fx * p.fx + p.cx;
    let v = (f64::from(y) + 0.5 - n.cy) / n.fy * p.fy + p.cy;
    let column = (u / f64::from(p.width) * f64::from(map.width)) as usize;
    let row = (v / f64::from(p.height) * f64::from(map.height)) as usize;
    let (column, row) = (column.min(map.width as usize - 1), row.min(map.height as usize - 1));
    map.index[row * map.width as usize + column]
}

/// `E^T B` at length 1, and its length.
fn feature(weights: &[f64], bank: &Bank) -> (Vec<f64>, f64) {
    let mut sum = vec![0.0; bank.dim];
    for (m, weight) in weights.iter().enumerate() {
        sum.iter_mut().zip(bank.row(m)).for_each(|(s, v)| *s += weight * f64::from(*v));
    }
    let length = sum.iter().map(|v| v * v).sum::<f64>().sqrt();
    if length > 0.0 {
        sum.iter_mut().for_each(|v| *v /= length);
    }
    (sum, length)
}

/// LERF: the least softmax of the text against one canonical text.
fn relevancy(feature: &[f64], text: &[f32], canon: &[Vec<f32>]) -> f64 {
    let dot = |with: &[f32]| feature.iter().zip(with).map(|(a, b)| a * f64::from(*b)).sum::<f64>();
    let pair = |c: &Vec<f32>| {
        let (q, c) = ((10.0 * dot(text)).exp(), (10.0 * dot(c)).exp());
        q / (q + c)
    };
    canon.iter().map(pair).fold(f64::INFINITY, f64::min)
}

/// The numbers of an array of an npz file, as bytes.
fn member(npz: &[u8], name: &str) -> Vec<u8> {
    let mut zip = zip::ZipArchive::new(Cursor::new(npz)).unwrap();
    let mut bytes = Vec::new();
    zip.by_name(&format!("{name}.npy")).unwrap().read_to_end(&mut bytes).unwrap();
    let header = usize::from(u16::from_le_bytes([bytes[8], bytes[9]]));
    bytes.split_off(10 + header)
}

fn numbers<T: bytemuck::Pod>(npz: &[u8], name: &str) -> Vec<T> {
    bytemuck::pod_collect_to_vec(&member(npz, name))
}

#[test]
fn a_scene_of_the_paper_has_a_gaussian_for_each_pixel_and_the_bank_of_its_masks() {
    let Some(engine) = engine() else { return };
    let photos = photos();
    let scene = made(&engine, &photos, &paper());
    let method = Method::of(Preset::Paper);
    assert_eq!(scene.meta.report.method, method);
    let lenses: Vec<_> = scene.meta.cameras.iter().filter_map(|c| c.network).collect();
    let pixels: u32 = lenses.iter().map(|lens| lens.width * lens.height).sum();
    assert_eq!((lenses.len(), scene.gaussians.len()), (2, pixels as usize), "H * W * K");
    let default = made(&engine, &photos, &SceneOptions::default());
    assert!(default.gaussians.len() < scene.gaussians.len(), "the default leaves some out");
    assert!(scene.backdrop.cells().iter().all(|cell| *cell == [0; 3]), "no backdrop");

    // Masks, each cut out whole; no skipped prompt.
    let network = engine.masks().unwrap();
    let settings = masks::settings(network.manifest(), &method);
    let found =
        masks::photo_masks(&network, &photos, None, &settings, &|_| (), &NO_CANCEL).unwrap();
    let crops = photos.iter().zip(&found).flat_map(|(posed, masks)| {
        let whole = |runs: &Vec<[u32; 2]>| crop(&posed.photo, &masks.map, runs);
        assert_eq!(masks.wholes.len(), masks.masks.len());
        masks.wholes.iter().map(whole).collect::<Vec<_>>()
    });
    let crops: Vec<Crop> = crops.collect();
    let towers = engine.image_text().unwrap();
    let embeddings = towers.embed_images(&crops).unwrap();
    let dim = towers.manifest().dim;
    let embeddings: Vec<&[f32]> = embeddings.chunks_exact(dim).collect();

    // M, centroids, the nearest one.
    let semantics: &Semantics = scene.semantics.as_ref().unwrap();
    assert_eq!(semantics.masks.len(), embeddings.len(), "every mask is in the list");
    let embedded = semantics.masks.iter().filter(|mask| mask.entry > 0).count();
    let mut distinct: Vec<Vec<u32>> =
        embeddings.iter().map(|row| row.iter().map(|v| v.to_bits()).collect()).collect();
    distinct.sort();
    distinct.dedup();
    let rows = ((1.2 * embedded as f64 / 2.0).ceil() as usize).min(distinct.len());
    assert_eq!(semantics.bank.len(), rows, "M = 1.2 N / K of {embedded} masks");
    assert!(rows >= 2, "{rows} rows test little");
    for m in 0..rows {
        let own = || {
            semantics
                .masks
                .iter()
                .zip(&embeddings)
                .filter(move |(k, _)| usize::from(k.entry) == m + 1)
        };
        let count = own().count();
        assert_eq!(count as u32, semantics.row_sizes()[m]);
        for d in 0..dim {
            let mean = own().map(|(_, row)| f64::from(row[d])).sum::<f64>() / count as f64;
            let row = f64::from(semantics.bank.row(m)[d]);
            assert!((mean - row).abs() < 1e-5, "row {m}, {d}: {row} for {mean}");
        }
    }
    for (mask, row) in semantics.masks.iter().zip(&embeddings).filter(|(mask, _)| mask.entry > 0) {
        let own = distance(row, semantics.bank.row(usize::from(mask.entry) - 1));
        let least = (0..rows).map(|m| distance(row, semantics.bank.row(m)));
        assert!(own <= least.fold(f64::INFINITY, f64::min) + 1e-9, "{mask:?} has the nearest row");
    }

    // Index maps: the row of the one mask of a pixel. Gaussians: that of their pixel, 0 without.
    for (v, (masks, map)) in found.iter().zip(&semantics.photos).enumerate() {
        for (mask, entry) in masks.map.index.iter().zip(&map.index) {
            let of = |k: usize| {
                semantics.masks.iter().find(|m| (m.photo as usize, m.mask as usize) == (v, k))
            };
            let want = usize::from(*mask).checked_sub(1).map_or(0, |k| of(k).unwrap().entry);
            assert_eq!(*entry, want);
        }
    }
    for (m, source) in scene.gaussians.semantic_index().iter().zip(scene.gaussians.source()) {
        let v = usize::from(source.view);
        let want = entry(&semantics.photos[v], &scene.meta.cameras[v], [source.x, source.y]);
        assert_eq!(*m, want, "{source:?}");
    }
}

#[test]
fn views_and_texts_of_a_scene_of_the_paper_are_its_formulas() {
    let Some(engine) = engine() else { return };
    let scene = made(&engine, &photos(), &paper());
    let semantics = scene.semantics.clone().unwrap();
    let bank = &semantics.bank;
    let towers = engine.image_text().unwrap();
    let embed = |texts: &[&str]| -> Vec<Vec<f32>> {
        let texts: Vec<String> = texts.iter().map(|text| (*text).to_owned()).collect();
        towers.embed_texts(&texts).unwrap().into_iter().map(|text| text.row).collect()
    };

    let lens = scene.meta.cameras[0].camera.intrinsics.resized(36, 24);
    let pose = scene.meta.cameras[0].camera.camera_to_world;
    let camera = Camera { intrinsics: lens, camera_to_world: pose };
    let near = default_near(scene.meta.report.median_depth);
    // No blur, no layers, no backdrop: a request that knows no photo.
    let request = RenderRequest {
        background: Background::BLACK,
        ..RenderRequest::plain(camera, Kinds::COLOR, near)
    };
    let dense = literal(&scene.gaussians, &request, bank.len() as u16, |gaussians, request| {
        oracle::render(gaussians, request).unwrap().into_iter().map(|pixel| pixel.color).collect()
    });

    let networks = Arc::new(PipelineNetworks(Arc::new(self::engine().unwrap().into())));
    let renderer = Arc::new(CpuRenderer::new(2).unwrap());
    let service = OfflineService::new(networks, renderer, &[], Config::default().limits);
    let focal =
        LensSpec::Focal { fx: lens.fx, fy: Some(lens.fy), cx: Some(lens.cx), cy: Some(lens.cy) };
    let camera = CameraSpec { pose: PoseSpec::CameraToWorld(pose.to_row_major()), lens: focal };
    let options = ViewOptions { width: Some(36), height: Some(24), ..ViewOptions::default() };
    let arrays = |kind| {
        let scoring = ScoringOptions::default();
        let spec = FeaturesSpec { camera, options: options.clone(), kind, scoring, wait: None };
        let mut file = Vec::new();
        service.arrays(&scene, Some(&spec), &mut file).unwrap();
        file
    };

    // E.
    let file = arrays(FeatureKind::Weights);
    assert_eq!(numbers::<u32>(&file, "size"), [24, 36]);
    let offsets: Vec<u32> = numbers(&file, "offsets");
    let (entries, weights): (Vec<u16>, Vec<f32>) =
        (numbers(&file, "entries"), numbers(&file, "weights"));
    let (mut seen, mut exact) = (0.0, Vec::new());
    for (p, dense) in dense.iter().enumerate() {
        let mut rest = dense.clone();
        for i in offsets[p] as usize..offsets[p + 1] as usize {
            rest[usize::from(entries[i]) - 1] -= f64::from(weights[i]);
        }
        seen += dense.iter().sum::<f64>();
        // A Gaussian at the cliff of 1/255 is there or not there.
        let apart = rest.iter().fold(0.0_f64, |worst, v| worst.max(v.abs()));
        assert!(apart < 8e-3, "pixel {p}: {rest:?}");
        exact.push(apart < 1e-4);
    }
    assert!(seen > 100.0, "the view shows {seen:.1} pixels of masks");

    assert!(exact.iter().filter(|exact| !**exact).count() < 10, "cliffs are few");

    // F = E^T B at length 1.
    let features: Vec<f32> = numbers(&arrays(FeatureKind::Features), "features");
    assert_eq!(features.len(), 36 * 24 * bank.dim);
    for (p, row) in features.chunks_exact(bank.dim).enumerate() {
        let (want, length) = feature(&dense[p], bank);
        if exact[p] && length > 0.05 {
            let apart = want.iter().zip(row).map(|(a, b)| (a - f64::from(*b)).abs());
            let apart = apart.fold(0.0, f64::max);
            assert!(apart < 1e-2, "pixel {p}: {apart}");
        }
    }

    // Relevancy and mask of texts: with the paper's canonical texts, and with words of which one is
    // the nearest to every pixel.
    let (words, mut selected) = (["red", "green", "blue", "grey"], 0);
    let others = |word: &str| words.iter().copied().filter(|w| *w != word).collect::<Vec<_>>();
    for (word, own) in words.into_iter().flat_map(|word| [(word, false), (word, true)]) {
        let canon = if own { others(word) } else { vec!["object", "things", "stuff"] };
        let named: Vec<String> = canon.iter().map(|text| (*text).to_owned()).collect();
        let changed = if own { named.clone() } else { Vec::new() };
        let spec = QuerySpec {
            texts: vec![word.to_owned()],
            camera: Some(camera),
            options: options.clone(),
            mask: MaskFormat::Png,
            scoring: ScoringOptions { canon: changed, ..ScoringOptions::default() },
            ..QuerySpec::default()
        };
        let answer = service.query(&scene, &spec).unwrap();
        assert_eq!(answer.scoring.canon, named);
        assert_eq!((answer.scoring.tau, answer.scoring.unit_rows), (10.0, false));
        let (text, canon) = (embed(&[word]).remove(0), embed(&canon));
        let view = answer.results[0].view.as_ref().unwrap();
        let mask = image::load_from_memory(view.mask_png.as_ref().unwrap()).unwrap().into_luma8();
        for (p, inside) in mask.pixels().enumerate() {
            let (f, length) = feature(&dense[p], bank);
            let score = relevancy(&f, &text, &canon);
            if exact[p] && length > 0.05 && (score - 0.5).abs() > TIE {
                assert_eq!(inside.0[0] > 0, score >= 0.5, "{word}, pixel {p}: {score}");
                selected += usize::from(score >= 0.5);
            }
        }
        for (m, score) in answer.results[0].scores.iter().enumerate() {
            let mut alone = vec![0.0; bank.len()];
            alone[m] = 1.0;
            let want = relevancy(&feature(&alone, bank).0, &text, &canon);
            assert!((f64::from(*score) - want).abs() < 1e-4, "{word}, row {m}: {score} for {want}");
        }
    }
    assert!(selected > 20, "the words select {selected} pixels: too few to test");

    // The bank as a file.
    let mut file = Vec::new();
    service.arrays(&scene, None, &mut file).unwrap();
    assert_eq!(numbers::<f32>(&file, "bank"), bank.rows);
    assert_eq!(numbers::<u32>(&file, "sizes"), semantics.row_sizes());
    assert_eq!(numbers::<u16>(&file, "index"), semantics.index);
    assert_eq!(numbers::<u16>(&file, "photo_001"), semantics.photos[1].index);
    assert_eq!(numbers::<u32>(&file, "masks").len(), 3 * semantics.masks.len());
}
