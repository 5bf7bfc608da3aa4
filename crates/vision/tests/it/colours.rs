//! Stand-in mask, image and text networks whose answers are known: masks by colour, words by
//! colour. What the adapters feed and read must make them right for any shape of photo.

use std::sync::{
    Arc, Mutex,
    atomic::{AtomicBool, Ordering},
};

use segsplat_core::{
    error::{ErrorCode, Result},
    scene::{
        Camera, CameraToWorld, Crop, Gaussians, Intrinsics, JudgedMasks, MaskJudging, MaskLevel,
        MaskLogits, Method, Photo, PosedPhoto, Preset, RawGaussians, SourcePixel,
    },
};
use segsplat_vision::{
    models::{Bundle, ImageText, MaskNetwork, PhotoEmbedding, Runtime},
    pipeline::masks::{self, SeenPhoto},
    segment::{self, PromptDecoder, Seed},
};

use segsplat_testing::{opened, root};

use crate::network_options;

const RED: [u8; 3] = [204, 26, 26];
const GREEN: [u8; 3] = [26, 178, 26];
const GREY: [u8; 3] = [128, 128, 128];

fn runtime() -> Option<Arc<Runtime>> {
    opened(Runtime::load(&network_options()))
}

fn bundle() -> Bundle {
    Bundle::open(&root().join("tests/fixtures/colours")).unwrap()
}

/// A grey photo with a red box in its left and a green one in its right half.
fn photo(width: u32, height: u32) -> Photo {
    let colour = |x: u32, y: u32| {
        let (u, v) = (f64::from(x) / f64::from(width), f64::from(y) / f64::from(height));
        match (u, v) {
            _ if (0.125..0.375).contains(&u) && (0.25..0.75).contains(&v) => RED,
            _ if (0.625..0.875).contains(&u) && (0.25..0.75).contains(&v) => GREEN,
            _ => GREY,
        }
    };
    let rgb = (0..height).flat_map(|y| (0..width).flat_map(move |x| colour(x, y))).collect();
    Photo { width, height, rgb, valid: None }
}

#[test]
fn a_mask_lies_where_the_point_was_whatever_the_photos_shape() {
    let Some(runtime) = runtime() else { return };
    let network = MaskNetwork::open(&runtime, &bundle(), &network_options()).unwrap().unwrap();
    for (width, height) in [(64, 64), (128, 64), (96, 192), (250, 130)] {
        let embedding = network.encode(&photo(width, height)).unwrap();
        let filled = embedding.resized().map(|v| f64::from(v) / 64.0);
        let points = [[0.25, 0.5], [0.75, 0.5], [0.5, 0.1]];
        let many: Vec<[f32; 2]> = points.iter().copied().cycle().take(150).collect();
        let masks = network.decode(&embedding, &many).unwrap();
        assert_eq!((masks.levels, masks.grid), (3, [32, 32]), "shape");
        assert_eq!(masks.logits.len(), 150 * 3 * 32 * 32, "prompts");
        let [w, h] = [filled[0] * 32.0, filled[1] * 32.0];
        let whole = |prompt: usize, u: f64, v: f64| {
            let at = (v * h) as usize * 32 + (u * w) as usize;
            masks.logits[(prompt * 3 + 2) * 1024 + at] > 0.0
        };
        for (prompt, inside, outside) in [
            (0, [0.25, 0.5], [0.75, 0.5]),
            (1, [0.75, 0.5], [0.25, 0.5]),
            (2, [0.5, 0.9], [0.25, 0.5]),
            (147, [0.25, 0.6], [0.5, 0.5]),
        ] {
            let name = format!("prompt {prompt} of {width}x{height}");
            assert!(whole(prompt, inside[0], inside[1]), "{name}: {inside:?} is not in its mask");
            assert!(!whole(prompt, outside[0], outside[1]), "{name}: {outside:?} is in its mask");
        }
        let area = |at: usize| {
            masks.logits[at * 1024..(at + 1) * 1024].iter().filter(|v| **v > 0.0).count()
        };
        assert!(area(6) < area(7) && area(7) < area(8), "levels grow on the wall");
        assert!(masks.predicted_iou.iter().all(|v| (0.5..=1.0).contains(v)), "IoUs are fed labels");
    }
}

/// The bundle with another decoder in the first one's place, and other lines in its manifest.
fn with_decoder(file: &str, sha256: &str, changes: &[(&str, &str)]) -> (tempfile::TempDir, Bundle) {
    let from = root().join("tests/fixtures/colours");
    let dir = tempfile::tempdir().unwrap();
    let whole = bundle();
    for entry in whole.files() {
        std::fs::copy(from.join(entry.file), dir.path().join(entry.file)).unwrap();
    }
    std::fs::copy(from.join(file), dir.path().join(file)).unwrap();
    let mut text = std::fs::read_to_string(from.join("bundle.toml")).unwrap();
    let decoder = whole.files().into_iter().find(|file| file.part == "masks.decoder");
    let decoder = decoder.expect("the bundle has masks");
    let own = [(decoder.file, file), (decoder.sha256, sha256)];
    for (old, new) in own.iter().chain(changes) {
        assert!(text.contains(old), "no {old:?} in the manifest");
        text = text.replace(old, new);
    }
    std::fs::write(dir.path().join("bundle.toml"), text).unwrap();
    let opened = Bundle::open(dir.path()).unwrap();
    (dir, opened)
}

#[test]
fn every_signature_of_a_decoder_gives_the_same_masks() {
    let Some(runtime) = runtime() else { return };
    // Segment Anything's own export: one prompt a run, a former mask, four masks.
    let (_kept, export) = with_decoder(
        "masks_decoder_export.onnx",
        "c32cc07bb8cd0e52986983c3150501ecf0ed219bf6544cc11d5064cc74b92d6a",
        &[("levels = [0, 1, 2]", "levels = [1, 2, 3]")],
    );
    let (_kept2, efficient) = with_decoder(
        "masks_decoder_efficient.onnx",
        "6000b740b2ed30d6008540076d9b404e10fe3095558d49b90483435f38245d92",
        &[
            ("adapter = \"sam\"", "adapter = \"efficient_sam\""),
            ("point_coords = \"point_coords\"", "point_coords = \"batched_point_coords\""),
            ("point_labels = \"point_labels\"", "point_labels = \"batched_point_labels\""),
            ("low_res_masks = \"low_res_masks\"", "low_res_masks = \"output_masks\""),
        ],
    );
    let points = [[0.25_f32, 0.5], [0.76, 0.52], [0.5, 0.1]];
    let masks = |bundle: &Bundle, width, height| {
        let network = MaskNetwork::open(&runtime, bundle, &network_options()).unwrap().unwrap();
        let embedding = network.encode(&photo(width, height)).unwrap();
        (embedding.resized(), network.decode(&embedding, &points).unwrap())
    };
    let (_, own) = masks(&bundle(), 64, 64);
    for (name, bundle) in [("export", &export), ("efficient", &efficient)] {
        let (_, found) = masks(bundle, 64, 64);
        assert_eq!((found.levels, found.grid), (3, [32, 32]), "{name}");
        assert_eq!(found.logits.len(), own.logits.len(), "{name}");
        // EfficientSAM adds no half pixel: places differ by half a pixel, colours do not.
        let whole = |of: &MaskLogits| {
            let level = |p: usize| of.logits[(p * 3 + 2) * 1024..][..1024].to_vec();
            (0..3).flat_map(level).collect::<Vec<f32>>()
        };
        let pairs = whole(&own).into_iter().zip(whole(&found));
        let off = pairs.map(|(a, b)| (a - b).abs());
        assert!(off.fold(0.0, f32::max) < 1e-4, "{name}: logits of the wholes");
        for (a, b) in own.predicted_iou.iter().zip(&found.predicted_iou) {
            assert!((a - b).abs() < 0.02, "{name}: {:?}", found.predicted_iou);
        }
    }
    // A photo that is not square is padded by one adapter and stretched by the other.
    let (padded, _) = masks(&export, 128, 64);
    let (stretched, found) = masks(&efficient, 128, 64);
    assert_eq!((padded, stretched), ([64, 32], [64, 64]), "the part that the photo fills");
    let at =
        |u: f64, v: f64| found.logits[2 * 1024 + (v * 32.0) as usize * 32 + (u * 32.0) as usize];
    assert!(at(0.25, 0.7) > 0.0 && at(0.25, 0.8) < 0.0 && at(0.75, 0.5) < 0.0, "the red box");
}

/// A photo whose masks the network judges, also on a CPU.
struct Judged<'a> {
    network: &'a MaskNetwork,
    embedding: PhotoEmbedding,
}

impl PromptDecoder for Judged<'_> {
    fn batch(&self) -> usize {
        64
    }

    fn placed(&self) -> (u32, [u32; 2]) {
        (64, self.embedding.resized())
    }

    fn decode(&self, _: &[[f32; 2]]) -> Result<MaskLogits> {
        panic!("it judges");
    }

    fn judges(&self) -> Option<(usize, [usize; 2])> {
        Some((3, self.network.judges().unwrap()))
    }

    fn judge(&self, points: &[[f32; 2]], how: &MaskJudging) -> Result<JudgedMasks> {
        self.network.judge(&self.embedding, points, how)
    }

    fn on<'a>(&'a self, _: &'a Photo) -> Result<Box<dyn PromptDecoder + 'a>> {
        panic!("no crop layers are asked for");
    }
}

#[test]
fn a_decoder_that_judges_gives_the_masks_of_its_logits() {
    let Some(runtime) = runtime() else { return };
    let (_kept, judging) = with_decoder(
        "masks_decoder_judging.onnx",
        "c586fac6a90b9af4c39ba92dac1778d712257f69d97ab73ec6c7135ff89a1b9a",
        &[],
    );
    let open =
        |bundle: &Bundle| MaskNetwork::open(&runtime, bundle, &network_options()).unwrap().unwrap();
    let (plain, network) = (open(&bundle()), open(&judging));
    assert_eq!((plain.judges(), network.judges()), (None, Some([32, 32])), "read from the files");
    let cancel = AtomicBool::new(false);
    for (width, height) in [(64, 64), (128, 64), (90, 170), (250, 130)] {
        let photo = photo(width, height);
        for level in [MaskLevel::Widest, MaskLevel::Whole, MaskLevel::Subpart] {
            let method = Method { full_resolution: true, mask_level: level, ..Method::default() };
            let settings = masks::settings(network.manifest(), &method);
            let masks_of = |decoder: &dyn PromptDecoder| {
                segment::everything(decoder, &photo, &settings, &[], &cancel).unwrap()
            };
            let wanted = masks_of(&SeenPhoto::new(&plain, &photo).unwrap());
            let embedding = network.encode(&photo).unwrap();
            let found = masks_of(&Judged { network: &network, embedding });
            let name = format!("{level:?} of {width}x{height}");
            assert!(wanted.masks.len() >= 2, "{name}: {:?}", wanted.masks);
            assert_eq!(found.masks.len(), wanted.masks.len(), "{name}");
            // Sums in another order may move a pixel whose logit is next to 0.
            let pairs = found.map.index.iter().zip(&wanted.map.index);
            let off = pairs.filter(|(a, b)| a != b).count();
            assert!(off * 500 <= wanted.map.index.len(), "{name}: {off} pixels differ");
            for (a, b) in found.masks.iter().zip(&wanted.masks) {
                assert!((a.stability - b.stability).abs() < 0.01, "{name}: {a:?} {b:?}");
                assert!((a.predicted_iou - b.predicted_iou).abs() < 1e-4, "{name}: {a:?} {b:?}");
            }
        }
    }
    let nothing = MaskJudging { levels: vec![0], pixels: [1, 1], ..MaskJudging::default() };
    let embedding = plain.encode(&photo(64, 64)).unwrap();
    let error = plain.judge(&embedding, &[[0.5, 0.5]], &nothing).unwrap_err();
    assert_eq!(error.code(), ErrorCode::Internal, "{error}");
}

#[test]
fn a_decoder_of_another_signature_is_refused_by_name() {
    let Some(runtime) = runtime() else { return };
    let (_kept, wrong) = with_decoder(
        "masks_decoder_efficient.onnx",
        "6000b740b2ed30d6008540076d9b404e10fe3095558d49b90483435f38245d92",
        &[],
    );
    let error = MaskNetwork::open(&runtime, &wrong, &network_options()).unwrap_err();
    assert_eq!(error.code(), ErrorCode::ModelUnavailable, "{error}");
    assert!(error.message().contains("point_coords"), "{error}");
}

/// A posed photo that sees the fixture's plane (z = 4 of the first camera) from `x`.
fn posed(photo: Photo, x: f64) -> PosedPhoto {
    let (w, h) = (f64::from(photo.width), f64::from(photo.height));
    let (width, height) = (photo.width, photo.height);
    let lens = Intrinsics { fx: w, fy: w, cx: w / 2.0, cy: h / 2.0, width, height };
    let mut pose = glam::DMat4::IDENTITY.to_cols_array();
    pose[3] = x;
    let camera_to_world = CameraToWorld::from_row_major(&pose, "test").unwrap();
    let camera = Camera { intrinsics: lens, camera_to_world };
    PosedPhoto { file: format!("{x}.png"), photo, camera, intrinsics_made_for: None }
}

#[test]
fn photos_give_masks_and_seeds_say_where_they_reappear() {
    let Some(runtime) = runtime() else { return };
    let network = MaskNetwork::open(&runtime, &bundle(), &network_options()).unwrap().unwrap();
    let settings = masks::settings(network.manifest(), &Method::default());
    assert!((settings.pred_iou_thresh - 0.7).abs() < 1e-6, "the bundle's thresholds");
    let photos = [posed(photo(64, 64), 0.0), posed(photo(64, 64), 0.25)];
    let cancel = AtomicBool::new(false);
    let found = masks::photo_masks(&network, &photos, None, &settings, &|_| (), &cancel).unwrap();
    for masks in &found {
        assert_eq!(masks.masks.len(), 3, "wall and two boxes: {:?}", masks.masks);
        let at = |u, v| masks.map.at(u, v);
        let (wall, red, green) = (at(0.5, 0.1), at(0.25, 0.5), at(0.75, 0.5));
        assert_eq!(wall, 1, "the wall is the largest");
        assert!(red > 1 && green > 1 && red != green, "{red} {green}");
    }
    // A Gaussian on the plane at every fourth pixel of the first photo.
    let mut raw = RawGaussians::default();
    for at in (0..64 * 64).step_by(4) {
        let (x, y) = (f64::from(at % 64) + 0.5, f64::from(at / 64) + 0.5);
        let place = photos[0].camera.intrinsics.unproject(x, y, 4.0);
        raw.means.push(place.as_vec3().to_array());
        raw.quats.push([1.0, 0.0, 0.0, 0.0]);
        raw.scales.push([0.1; 3]);
        raw.opacities.push(0.9);
        raw.sh.push([0.0; 3]);
        raw.semantic_index.push(0);
        raw.source.push(SourcePixel::default());
    }
    let (gaussians, _) = Gaussians::sanitize(raw).unwrap();
    let seeds = masks::seeds(&gaussians, &photos, &found[..1], 1);
    assert_eq!(seeds.len(), 3, "one a mask: {seeds:?}");
    // The second camera stands 0.25 to the right: all lies 0.25 / 4 of the width to the left.
    for (u, v) in [(0.25 - 0.0625, 0.5), (0.75 - 0.0625, 0.5)] {
        let near =
            |seed: &Seed| (seed.point[0] - u).abs() < 0.06 && (seed.point[1] - v).abs() < 0.06;
        assert!(seeds.iter().any(near), "no seed near ({u}, {v}): {seeds:?}");
    }
    assert!(masks::seeds(&gaussians, &photos, &[], 0).is_empty(), "the first photo has none");
    cancel.store(true, Ordering::Relaxed);
    let error = masks::photo_masks(&network, &photos, None, &settings, &|_| (), &cancel);
    assert_eq!(error.unwrap_err().code(), ErrorCode::Cancelled, "cancelled");
}

#[test]
fn photos_side_by_side_give_the_masks_of_one_after_the_other() {
    let Some(runtime) = runtime() else { return };
    let network = MaskNetwork::open(&runtime, &bundle(), &network_options()).unwrap().unwrap();
    let settings = masks::settings(network.manifest(), &Method::of(Preset::Paper));
    let sizes = [(64, 64), (48, 64), (64, 40), (32, 64), (64, 56)];
    let photos = sizes.map(|(width, height)| posed(photo(width, height), 0.0));
    let cancel = AtomicBool::new(false);
    let none = |_: f32| {};
    let want = masks::photo_masks(&network, &photos, None, &settings, &none, &cancel).unwrap();
    assert!(want.iter().all(|of| of.masks.len() > 1), "{want:?}");
    let told = Mutex::new(Vec::new());
    let tell = |fraction| told.lock().unwrap().push(fraction);
    let got = masks::side_by_side(&network, &photos, &settings, &tell, &cancel).unwrap();
    assert_eq!(got, want, "in the order of the photos");
    assert_eq!(told.into_inner().unwrap(), [0.2, 0.4, 0.6, 0.8, 1.0]);
    assert!(masks::side_by_side(&network, &[], &settings, &none, &cancel).unwrap().is_empty());
    // After the first photo it is cancelled: the answer is no list that lacks some.
    let stop = |_: f32| cancel.store(true, Ordering::Relaxed);
    let error = masks::side_by_side(&network, &photos, &settings, &stop, &cancel);
    assert_eq!(error.unwrap_err().code(), ErrorCode::Cancelled, "cancelled");
}

fn crop(colour: [u8; 3], side: u32) -> Crop {
    let pixel = |x: u32| if x < side / 4 { [0; 3] } else { colour };
    Crop {
        width: side,
        height: side,
        rgb: (0..side * side).flat_map(|at| pixel(at % side)).collect(),
    }
}

fn cosine(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[test]
fn words_find_their_colours() {
    let Some(runtime) = runtime() else { return };
    let towers = ImageText::open(&runtime, &bundle(), &network_options()).unwrap().unwrap();
    // More crops than a batch, of several sizes.
    let crops: Vec<Crop> =
        (0..40).map(|i| crop([RED, GREEN, GREY][i as usize % 3], 16 + i)).collect();
    let rows = towers.embed_images(&crops).unwrap();
    let dim = towers.manifest().dim;
    assert_eq!(rows.len(), 40 * dim, "one row a crop");
    let texts = ["red", "a GREEN thing", "wall", "object"].map(str::to_owned);
    let words = towers.embed_texts(&texts).unwrap();
    for (i, row) in rows.chunks(dim).enumerate() {
        let length = cosine(row, row);
        assert!((length - 1.0).abs() < 1e-5, "row {i} has length {length}");
        let fit: Vec<f32> = words.iter().map(|word| cosine(row, &word.row)).collect();
        for (word, text) in texts.iter().enumerate().take(3) {
            let beats = fit[word] > fit[3];
            assert_eq!(beats, word == i % 3, "crop {i} and {text:?}: {fit:?}");
        }
    }
}

#[test]
fn a_text_says_what_was_not_understood() {
    let Some(runtime) = runtime() else { return };
    let towers = ImageText::open(&runtime, &bundle(), &network_options()).unwrap().unwrap();
    let embed = |text: &str| towers.embed_texts(&[text.to_owned()]).map(|mut rows| rows.remove(0));
    let known = embed("the red apple").unwrap();
    assert_eq!((known.tokens, known.unknown, known.cut), (3, 0, false), "known words");
    let foreign = embed("zzyzx 狐狸").unwrap();
    assert_eq!((foreign.tokens, foreign.unknown), (2, 2), "unknown words");
    let long = embed(&"red ".repeat(40)).unwrap();
    assert!(long.cut && long.tokens == 40, "{} tokens, cut {}", long.tokens, long.cut);
    let red = embed("red").unwrap();
    assert!(cosine(&long.row, &red.row) > 0.999, "what is left of it still means red");
    // The same row whatever stands beside it.
    let texts = ["sky", "the red apple", "blue"].map(str::to_owned);
    assert_eq!(towers.embed_texts(&texts).unwrap()[1].row, known.row, "in a batch");
    for nothing in ["", "   \n"] {
        let error = embed(nothing).unwrap_err();
        assert_eq!(error.code(), ErrorCode::InvalidRequest, "{error}");
        assert!(error.message().contains(&format!("text {nothing:?}")), "{error}");
    }
}

#[test]
fn a_bundle_without_semantics_opens_without_them() {
    let Some(runtime) = runtime() else { return };
    let plane = Bundle::open(&root().join("tests/fixtures/plane")).unwrap();
    assert!(MaskNetwork::open(&runtime, &plane, &network_options()).unwrap().is_none(), "masks");
    assert!(ImageText::open(&runtime, &plane, &network_options()).unwrap().is_none(), "towers");
}
