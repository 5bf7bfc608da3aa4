//! `semantics` from a labelled folder to its figures, with the fixture's small networks.

use std::path::Path;

use segsplat_core::error::Result;
use segsplat_lab::semantics::pca;
use segsplat_testing::root;
use serde_json::{Value, json};

use crate::measured;

const SIZE: [u32; 2] = [96, 64];
const FOCAL: f64 = 90.0;
const DEPTH: f64 = 4.0;

/// Class of a point of the wall: 1 a red box, 2 a green one, 3 the wall itself.
fn class(x: f64, y: f64) -> u8 {
    match (x, y) {
        _ if y.abs() > 0.6 => 3,
        _ if (-1.4..-0.4).contains(&x) => 1,
        _ if (0.4..1.4).contains(&x) => 2,
        _ => 3,
    }
}

/// Three photos of a wall at z = 4, side by side; every one is labelled.
fn folder() -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    for sub in ["images", "masks"] {
        std::fs::create_dir(dir.path().join(sub)).unwrap();
    }
    let mut frames = Vec::new();
    for v in 0..3_u32 {
        let eye = (f64::from(v) - 1.0) * 0.3;
        let at = |x: u32, y: u32| {
            let across = |p: u32, n: u32| (f64::from(p) + 0.5 - f64::from(n) / 2.0) / FOCAL * DEPTH;
            (across(x, SIZE[0]) + eye, across(y, SIZE[1]))
        };
        let photo = image::RgbImage::from_fn(SIZE[0], SIZE[1], |x, y| {
            let (x, y) = at(x, y);
            // Something to match by, too weak to be another colour.
            let shade = 1.0 + 0.05 * ((x * 9.0).sin() * (y * 11.0 + x).cos());
            let base = [[204.0, 26.0, 26.0], [26.0, 178.0, 26.0], [128.0; 3]];
            let rgb: [f64; 3] = base[usize::from(class(x, y)) - 1];
            image::Rgb(rgb.map(|v| (v * shade) as u8))
        });
        let labels = image::GrayImage::from_fn(SIZE[0], SIZE[1], |x, y| {
            let (x, y) = at(x, y);
            image::Luma([class(x, y)])
        });
        let [image, mask] = [format!("images/{v}.png"), format!("masks/{v}.png")];
        photo.save(dir.path().join(&image)).unwrap();
        labels.save(dir.path().join(&mask)).unwrap();
        // OpenGL: looks along its own -z.
        let pose = [[1., 0., 0., eye], [0., -1., 0., 0.], [0., 0., -1., 0.], [0., 0., 0., 1.]];
        frames.push(json!({ "file_path": image, "mask_file": mask, "transform_matrix": pose }));
    }
    let cameras = json!({
        "w": SIZE[0], "h": SIZE[1], "fl_x": FOCAL, "fl_y": FOCAL,
        "cx": SIZE[0] / 2, "cy": SIZE[1] / 2, "frames": frames,
    });
    let write = |name: &str, text: String| std::fs::write(dir.path().join(name), text).unwrap();
    write("transforms.json", cameras.to_string());
    write("masks/classes.json", json!({ "1": "red", "2": "green", "3": "wall" }).to_string());
    write("scene.json", json!({ "surroundings": ["wall"] }).to_string());
    dir
}

/// The rows of `semantics` for a folder; `None` without ONNX Runtime.
fn judged(folder: &Path, rest: &[&str]) -> Option<Result<Vec<Value>>> {
    let rest = [&["--absent", "blue,red"], rest].concat();
    measured("semantics", &root().join("tests/fixtures/colours"), folder, &rest)
}

#[test]
fn scoring_is_changed_as_the_making_of_scenes_is() {
    let dir = folder();
    let selected = |rest: &[&str]| -> Option<f64> {
        let rows = judged(dir.path(), rest)?.unwrap();
        rows[0]["default"]["scene"]["miou"].as_f64()
    };
    let Some(plain) = selected(&[]) else { return };
    assert!(plain > 0.5, "{plain}");
    // With itself among the canonical texts no word is over a cut above a half.
    let none =
        ["--method", "cut=0.9", "--method", r#"canon=["red","green"]"#, "--method", "votes=true"];
    assert!(selected(&none).unwrap() < 0.01, "nothing is selected");
    for (bad, why) in [
        (["--overlap", "1.5"], "overlap is 1.5; it must be 0 to 1"),
        (["--photos", "3"], "no target has 3 photos beside it"),
    ] {
        let fault = judged(dir.path(), &bad).unwrap().unwrap_err();
        assert!(fault.message().contains(why), "{fault}");
    }
    for (bad, why) in [("cut=2", "cut is 2"), ("tau=x", "tau=x"), ("beta=1", "beta=1")] {
        let fault = judged(dir.path(), &["--method", bad]).unwrap().unwrap_err();
        assert!(fault.message().contains(why), "{fault}");
    }
}

#[test]
fn words_find_their_boxes_in_a_view_and_a_word_for_nothing_does_not() {
    let dir = folder();
    let grids = dir.path().join("grids");
    let rest = ["--pictures", grids.to_str().unwrap(), "--overlap", "0.6"];
    let Some(rows) = judged(dir.path(), &rest) else { return };
    let rows = rows.unwrap();
    let targets = rows[0]["targets"].as_array().unwrap();
    assert_eq!((rows.len(), targets.len()), (1, 3));
    // The middle photo is seen from the two beside it.
    assert_eq!(targets[1]["inputs"], json!(["images/0.png", "images/2.png"]));
    assert_eq!((&rows[0]["overlap"], &rows[0]["left_out"]), (&json!(0.6), &json!([])));
    assert!(rows[0]["networks"].as_str().unwrap().starts_with("../plane/make.py; "), "{rows:?}");
    let judged = &rows[0]["default"];
    let figure = |of: &Value, name: &str| of[name].as_f64().unwrap();
    for (of, least) in [("scene", 0.8), ("flat", 0.6)] {
        assert!(figure(&judged[of], "accuracy_closed") > least, "{judged}");
        assert!(figure(&judged[of], "absent") < 0.02, "{judged}");
    }
    // The boxes move by a tenth of the picture from photo to photo, and flat masks with them.
    let [scene, flat] = ["scene", "flat"].map(|of| figure(&judged[of], "miou"));
    assert!(scene > flat + 0.05, "{judged}");
    // "red" is in the scene, so it is no absent word.
    let words = judged["scene"]["absent_words"].as_array().unwrap();
    assert_eq!((words.len(), &words[0]["word"]), (1, &json!("blue")));
    let grid = std::fs::read_dir(grids).unwrap().map(|file| file.unwrap().path());
    let [grid] = &grid.collect::<Vec<_>>()[..] else { panic!("one grid") };
    grids_show_e_and_f(&image::open(grid).unwrap().to_rgb8());
}

#[test]
fn one_scene_of_spread_photos_is_asked_at_every_target() {
    let dir = folder();
    let Some(rows) = judged(dir.path(), &["--spread", "--targets", "1"]) else { return };
    let row = &rows.unwrap()[0];
    let [target] = &row["targets"].as_array().unwrap()[..] else { panic!("{row}") };
    assert_eq!(target["target"], json!("images/0.png"), "{row}");
    assert_eq!(target["inputs"], json!(["images/1.png", "images/2.png"]), "{row}");
    assert_eq!((&row["spread"], &row["default"]["flat"]["miou"]), (&json!(true), &Value::Null));
    assert!(row["default"]["scene"]["miou"].as_f64().unwrap() > 0.4, "{row}");
    let fault = judged(dir.path(), &["--spread"]).unwrap().unwrap_err();
    assert!(fault.message().contains("0 photos are no target"), "{fault}");
}

/// Of the middle photo: photo, view, E, F, labels, the scene's texts, the flat ones.
fn grids_show_e_and_f(grid: &image::RgbImage) {
    let (width, height) = (grid.width() / 7, grid.height() / 3);
    assert_eq!(grid.width() % 7, 0);
    // The red box, the green one, and the wall between and above them.
    let places = [(0.28, 0.5), (0.72, 0.5), (0.5, 0.08)];
    for column in [2, 3] {
        let at = |(x, y): (f64, f64)| {
            let x = f64::from(width * column) + x * f64::from(width);
            let pixel = grid.get_pixel(x as u32, height + (y * f64::from(height)) as u32);
            pixel.0.map(i32::from)
        };
        let apart = |a: [i32; 3], b: [i32; 3]| (0..3).map(|c| (a[c] - b[c]).abs()).max().unwrap();
        let [red, green, wall] = places.map(at);
        for (a, b) in [(red, green), (red, wall), (green, wall)] {
            assert!(apart(a, b) > 60, "column {column}: {red:?}, {green:?}, {wall:?}");
        }
        // One thing has one colour.
        assert!(apart(red, at((0.25, 0.55))) < 60, "column {column}");
    }
}

#[test]
fn components_are_ordered_by_how_far_rows_differ_in_them() {
    // Three groups: far apart along the first number, less along the fifth.
    let row = |i: usize| {
        let far = [0.0, 9.0, 4.0][i % 3] + 0.01 * (i as f32 * 0.7).sin();
        let less = [0.0, 0.0, 2.0][i % 3] + 0.01 * (i as f32 * 0.3).cos();
        (i != 5).then(|| vec![far, 1.0, 1.0, 1.0, less])
    };
    let found = pca::colours(300, row);
    assert_eq!(found[5], [0.0; 3], "it has no row");
    let of = |i: usize| found[i];
    for group in 0..3 {
        for same in (group..300).step_by(3).filter(|i| *i != 5) {
            let off = (0..2).map(|c| (of(same)[c] - of(group)[c]).abs()).fold(0.0, f32::max);
            assert!(off < 0.05, "{same}: {:?}, {:?}", of(same), of(group));
        }
    }
    assert!(of(0)[0] < 0.05 && of(1)[0] > 0.95 && (0.3..0.6).contains(&of(3 + 2 + 3)[0]));
    assert!((of(2)[1] - of(0)[1]).abs() > 0.8, "{:?}, {:?}", of(2), of(0));
    assert_eq!(found, pca::colours(300, row), "the same rows, the same colours");
    assert_eq!(pca::colours(2, |_| None), [[0.0; 3]; 2]);
}

#[test]
fn masks_of_a_file_that_judges_are_those_of_its_logits() {
    let (dir, bundle) = (folder(), tempfile::tempdir().unwrap());
    let fixture = root().join("tests/fixtures/colours");
    for entry in std::fs::read_dir(&fixture).unwrap().flatten() {
        std::fs::copy(entry.path(), bundle.path().join(entry.file_name())).unwrap();
    }
    let own = "cc51938787230013556d70ad0313e0d36d16aa75d2ac6e855eb3d8b06cb9ab39";
    let judging = "c586fac6a90b9af4c39ba92dac1778d712257f69d97ab73ec6c7135ff89a1b9a";
    let manifest = std::fs::read_to_string(fixture.join("bundle.toml")).unwrap();
    let manifest = manifest.replace(own, judging);
    let manifest = manifest.replace("masks_decoder.onnx", "masks_decoder_judging.onnx");
    std::fs::write(bundle.path().join("bundle.toml"), manifest).unwrap();
    let masks = |bundle: &Path, rest: &[&str]| {
        measured("masks", bundle, dir.path(), &[&["--short", "--photos", "1"], rest].concat())
    };
    let Some(plain) = masks(bundle.path(), &[]) else { return };
    let (plain, judged) = (plain.unwrap(), masks(bundle.path(), &["--judged"]).unwrap().unwrap());
    assert_eq!([&plain[0]["judged"], &judged[0]["judged"]], [&json!(0.0), &plain[0]["asked"]]);
    assert!(plain[0]["masks"].as_f64().unwrap() >= 2.0, "{plain:?}");
    for same in ["masks", "asked"] {
        assert_eq!(judged[0][same], plain[0][same], "{same}");
    }
    let fault = masks(&fixture, &["--judged"]).unwrap().unwrap_err();
    assert!(fault.message().contains("does not judge masks"), "{fault}");
}
