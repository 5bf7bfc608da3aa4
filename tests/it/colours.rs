//! Stand-in mask, image and text networks whose answers are known: masks by colour, words by
//! colour. What the adapters feed and read must make them right for any shape of photo.

use std::{path::Path, sync::Arc};

use segsplat::{
    config::Config,
    error::ErrorCode,
    models::{Bundle, ImageText, MaskNetwork, Runtime},
    scene::{Crop, Photo},
};

use crate::common::skipped;

const RED: [u8; 3] = [204, 26, 26];
const GREEN: [u8; 3] = [26, 178, 26];
const GREY: [u8; 3] = [128, 128, 128];

fn runtime() -> Option<Arc<Runtime>> {
    match Runtime::load(&Config::default()) {
        Err(e) if e.code() == ErrorCode::ModelUnavailable => {
            skipped(e.message());
            None
        }
        runtime => Some(runtime.unwrap()),
    }
}

fn bundle() -> Bundle {
    Bundle::open(Path::new("tests/fixtures/colours")).unwrap()
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
    let network = MaskNetwork::open(runtime, &bundle(), &Config::default()).unwrap().unwrap();
    for (width, height) in [(64, 64), (128, 64), (96, 192), (250, 130)] {
        let embedding = network.encode(&photo(width, height)).unwrap();
        let filled = embedding.resized().map(|v| f64::from(v) / 64.0);
        let points = [[0.25, 0.5], [0.75, 0.5], [0.5, 0.1]];
        let many: Vec<[f32; 2]> = points.iter().copied().cycle().take(150).collect();
        let masks = network.decode(&embedding, &many).unwrap();
        assert_eq!((masks.prompts, masks.levels, masks.grid), (150, 3, [32, 32]), "shape");
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

fn crop(colour: [u8; 3], side: u32) -> Crop {
    let pixel = |x: u32| if x < side / 4 { [0; 3] } else { colour };
    Crop { side, rgb: (0..side * side).flat_map(|at| pixel(at % side)).collect() }
}

fn cosine(a: &[f32], b: &[f32]) -> f32 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}

#[test]
fn words_find_their_colours() {
    let Some(runtime) = runtime() else { return };
    let towers = ImageText::open(runtime, &bundle(), &Config::default()).unwrap().unwrap();
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
    let towers = ImageText::open(runtime, &bundle(), &Config::default()).unwrap().unwrap();
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
        assert!(error.message().contains("texts[0]"), "{error}");
    }
}

#[test]
fn a_bundle_without_semantics_opens_without_them() {
    let Some(runtime) = runtime() else { return };
    let plane = Bundle::open(Path::new("tests/fixtures/plane")).unwrap();
    let config = Config::default();
    assert!(MaskNetwork::open(Arc::clone(&runtime), &plane, &config).unwrap().is_none(), "masks");
    assert!(ImageText::open(runtime, &plane, &config).unwrap().is_none(), "towers");
}
