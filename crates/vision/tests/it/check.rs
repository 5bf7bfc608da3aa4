//! Weights beside a network, f16, and `models check`: what does not fit is named, all of it.

use std::path::Path;

use segsplat_core::{
    error::ErrorCode,
    scene::{Crop, Photo},
};
use segsplat_testing::{opened, root};
use segsplat_vision::models::{
    Bundle, BundleCheck, Geometry, ImageText, Runtime, TextMaskNetwork, check,
};
use sha2::{Digest, Sha256};
use tempfile::TempDir;

use crate::network_options;

const MANIFEST: &str = "bundle.toml";
/// A dimension named V in an ONNX file, and in as many bytes one of size 2.
const V: &[u8] = b"\x0a\x03\x12\x01V";
const TWO: &[u8] = b"\x0a\x03\x08\x82\x00";
/// What a manifest says of `image_dense.onnx`.
const DENSE: &str = "[image_text.image.dense]
output = \"dense\"
side = 32
cell = 4
weights = [[0.1, 0.5], [0.5, 2.0]]
";
/// The colours, which `image_external.onnx` keeps in a file of their own.
const DATA: &str = "image_external.onnx.data";

fn sha256(path: &Path) -> String {
    Sha256::digest(std::fs::read(path).unwrap()).iter().map(|b| format!("{b:02x}")).collect()
}

/// The bundle of colours with another image tower in the first one's place.
fn with_image(file: &str) -> TempDir {
    let (from, dir) = (root().join("tests/fixtures/colours"), tempfile::tempdir().unwrap());
    for entry in std::fs::read_dir(&from).unwrap() {
        let entry = entry.unwrap();
        std::fs::copy(entry.path(), dir.path().join(entry.file_name())).unwrap();
    }
    replace(&dir, "\"image.onnx\"", &format!("\"{file}\""));
    rehash(&dir, "image.onnx", file);
    if file == "image_dense.onnx" {
        replace(&dir, "[image_text.text]", &format!("{DENSE}\n[image_text.text]"));
    }
    if file == "image_external.onnx" {
        let sha256 = sha256(&dir.path().join(DATA));
        let lines = format!("\"{file}\"\ndata = \"{DATA}\"\ndata_sha256 = \"{sha256}\"");
        replace(&dir, &format!("\"{file}\""), &lines);
    }
    dir
}

/// The bundle of colours with its network of text masks.
fn with_text_masks() -> TempDir {
    let dir = with_image("image.onnx");
    let section = std::fs::read_to_string(dir.path().join("text_masks.toml")).unwrap();
    let path = dir.path().join(MANIFEST);
    std::fs::write(&path, std::fs::read_to_string(&path).unwrap() + &section).unwrap();
    dir
}

fn replace(dir: &TempDir, old: &str, new: &str) {
    let path = dir.path().join(MANIFEST);
    let text = std::fs::read_to_string(&path).unwrap();
    assert!(text.contains(old), "no {old:?} in the manifest");
    std::fs::write(path, text.replace(old, new)).unwrap();
}

/// Puts the hash of `file` where the fixture has that of `old`.
fn rehash(dir: &TempDir, old: &str, file: &str) {
    let from = root().join("tests/fixtures/colours").join(old);
    replace(dir, &sha256(&from), &sha256(&dir.path().join(file)));
}

/// Replaces bytes of a file by as many others, and its hash in the manifest.
fn patch(dir: &TempDir, file: &str, old: &[u8], new: &[u8]) {
    let path = dir.path().join(file);
    let mut bytes = std::fs::read(&path).unwrap();
    let places: Vec<usize> =
        bytes.windows(old.len()).enumerate().filter(|(_, w)| *w == old).map(|(i, _)| i).collect();
    assert!(!places.is_empty() && old.len() == new.len(), "{file} has no {old:?}");
    for at in places {
        bytes[at..at + new.len()].copy_from_slice(new);
    }
    std::fs::write(&path, bytes).unwrap();
    rehash(dir, file, file);
}

fn refused(dir: &TempDir, wanted: &[&str]) {
    let error = Bundle::open(dir.path()).unwrap_err();
    assert_eq!(error.code(), ErrorCode::ModelUnavailable, "{error}");
    for part in wanted {
        assert!(error.message().contains(part), "{part:?} is not in: {error}");
    }
}

fn checked(dir: &TempDir) -> Option<BundleCheck> {
    opened(Runtime::load(&network_options()))?;
    Some(check(dir.path(), &network_options()).unwrap())
}

/// The rows of three crops.
fn rows(dir: &TempDir) -> Option<Vec<f32>> {
    let runtime = opened(Runtime::load(&network_options()))?;
    let bundle = Bundle::open(dir.path()).unwrap();
    let towers = ImageText::open(&runtime, &bundle, &network_options()).unwrap().unwrap();
    let crop = |rgb: [u8; 3]| Crop { width: 20, height: 20, rgb: rgb.repeat(400) };
    let crops = [[204, 26, 26], [26, 178, 26], [90, 90, 120]].map(crop);
    Some(towers.embed_images(&crops).unwrap())
}

#[test]
fn weights_beside_a_network_and_f16_give_the_same_rows() {
    let Some(wanted) = rows(&with_image("image.onnx")) else { return };
    let external = rows(&with_image("image_external.onnx")).unwrap();
    assert_eq!(external, wanted, "weights in a second file");
    let half = rows(&with_image("image_half.onnx")).unwrap();
    for (a, b) in half.iter().zip(&wanted) {
        assert!((a - b).abs() < 2e-3, "f16: {a} for {b}");
    }
    assert_ne!(half, wanted, "f16 rounds");
}

#[test]
fn weights_beside_a_network_are_hashed_and_named() {
    let dir = with_image("image_external.onnx");
    let bundle = Bundle::open(dir.path()).unwrap();
    let files = bundle.files();
    let data = files.iter().find(|entry| entry.file == DATA).unwrap();
    assert_eq!(data.part, "image_text.image", "the part that it belongs to");

    let path = dir.path().join(DATA);
    let whole = std::fs::read(&path).unwrap();
    let mut changed = whole.clone();
    changed[3] ^= 1;
    std::fs::write(&path, &changed).unwrap();
    refused(&dir, &[DATA, "is not the file of bundle.toml", &sha256(&path)]);
    std::fs::remove_file(&path).unwrap();
    refused(&dir, &[DATA, "cannot be read"]);

    std::fs::write(&path, &whole).unwrap();
    let hash = sha256(&path);
    replace(&dir, &format!("data_sha256 = \"{hash}\"\n"), "");
    refused(&dir, &["image_text.image.data and data_sha256 go together"]);
    replace(&dir, &format!("data = \"{DATA}\"\n"), "");
    refused(&dir, &["image_external.onnx keeps weights in", DATA, "does not name"]);
}

#[test]
fn a_file_that_keeps_weights_elsewhere_is_refused() {
    let dir = with_image("image_external.onnx");
    // A path out of the bundle, of the same length.
    let path = "../../../../etc/passwdxxxxxx";
    let outside = &path[..DATA.len()];
    patch(&dir, "image_external.onnx", DATA.as_bytes(), outside.as_bytes());
    refused(&dir, &["keeps weights in", outside, "does not name"]);
}

#[test]
fn a_manifest_names_all_that_is_out_of_range() {
    let dir = with_image("image.onnx");
    replace(&dir, "sh_degree = 0", "near_far = [2.0, 1.0]\nsh_degree = 7");
    replace(&dir, "translation = \"largest_baseline\"", "translation = { near = -1.0 }");
    replace(&dir, "tau = 10.0", "tau = -1.0");
    refused(
        &dir,
        &[
            "geometry.sh_degree is 7",
            "geometry.near_far is [2.0, 1.0]; it must hold 0 < near < far",
            "geometry.translation is Near(-1.0); it must hold a number over 0",
            "image_text.tau is -1.0",
        ],
    );
    let dir = with_image("image.onnx");
    replace(&dir, "crop_margin = 0.0", "resize = \"nearest\"\ncrop_margin = 0.0");
    refused(&dir, &["unknown variant `nearest`", "lanczos"]);
}

#[test]
fn a_right_bundle_is_run_and_nothing_is_found() {
    let towers = ["image.onnx", "image_half.onnx", "image_external.onnx", "image_dense.onnx"];
    for dir in towers.map(with_image) {
        let Some(found) = checked(&dir) else { return };
        assert_eq!(found.faults, Vec::<String>::new(), "{found:?}");
        let ran: Vec<&str> = found.ran.iter().map(|(name, _)| *name).collect();
        assert_eq!(ran, ["geometry", "masks", "image_text"]);
        assert!(found.files.iter().all(|file| file.fits && file.bytes > 0), "{found:?}");
        assert_eq!(found.files[0].opset, Some(17));
    }
}

#[test]
fn a_tower_with_a_dense_output_gives_features_of_a_whole_photo() {
    let dir = with_image("image_dense.onnx");
    let Some(runtime) = opened(Runtime::load(&network_options())) else { return };
    let open = |dir: &TempDir| {
        let bundle = Bundle::open(dir.path()).unwrap();
        ImageText::open(&runtime, &bundle, &network_options())
    };
    let towers = open(&dir).unwrap().unwrap();
    // Red to the left, blue to the right; 80 x 38 pixels become 32 x 16.
    let row = (0..80).flat_map(|x| if x < 40 { [255, 0, 0] } else { [0, 0, 255] });
    let rgb = row.collect::<Vec<u8>>().repeat(38);
    let photo = Photo { width: 80, height: 38, rgb, valid: None };
    let dense = towers.dense(&photo).unwrap().unwrap();
    assert_eq!((dense.columns, dense.rows, dense.data.len()), (8, 4, 8 * 32));
    let channel = |c: usize, column: usize| dense.data[c * 32 + 8 + column];
    assert!((channel(0, 1) - 1.0).abs() < 1e-6 && channel(2, 1).abs() < 1e-6, "red: {dense:?}");
    assert!((channel(2, 6) - 1.0).abs() < 1e-6 && channel(0, 6).abs() < 1e-6, "blue");
    let plain = rows(&with_image("image.onnx")).unwrap();
    assert_eq!(rows(&dir).unwrap(), plain, "crops are embedded as before");

    let of = &towers.manifest().image.dense.clone().unwrap();
    assert_eq!([0.0, 0.1, 0.4, 0.5, 1.0].map(|area| of.weight(area)), [0.0, 0.5, 0.5, 2.0, 2.0]);
    assert_eq!(of.fitted([1000, 3]), [32, 4], "no side is under a cell");
    let none = open(&with_image("image.onnx")).unwrap().unwrap();
    assert_eq!(none.dense(&photo).unwrap(), None, "a tower without it");

    // A file that takes crops alone, another output, and weights that do not ascend.
    let crops = with_image("image.onnx");
    replace(&crops, "[image_text.text]", &format!("{DENSE}\n[image_text.text]"));
    let error = open(&crops).unwrap_err();
    assert!(error.message().contains("[-1, 3, 16, 16], not f32 [any, 3, 4..32, 4..32]"), "{error}");
    assert!(error.message().contains("has no output \"dense\""), "{error}");
    replace(&dir, "cell = 4", "cell = 8");
    let towers = open(&dir).unwrap().unwrap();
    let error = towers.dense(&photo).unwrap_err();
    assert!(error.message().contains("is [1, 8, 4, 8], not [1, 8, 2, 4]"), "{error}");
    replace(&dir, "[[0.1, 0.5], [0.5, 2.0]]", "[[0.5, 0.5], [0.1, 2.0]]");
    replace(&dir, "side = 32", "side = 4");
    let named = ["image_text.image.dense.side is 4; it must be 8 to", "dense.weights is [[0.5"];
    refused(&dir, &named);
}

#[test]
fn a_network_of_text_masks_is_run_and_marks_what_a_text_says() {
    let dir = with_text_masks();
    let Some(found) = checked(&dir) else { return };
    assert_eq!(found.faults, Vec::<String>::new(), "{found:?}");
    let ran: Vec<&str> = found.ran.iter().map(|(name, _)| *name).collect();
    assert_eq!(ran, ["geometry", "masks", "image_text", "text_masks"]);

    let runtime = Runtime::load(&network_options()).unwrap();
    let open = |dir: &TempDir| {
        let bundle = Bundle::open(dir.path()).unwrap();
        TextMaskNetwork::open(&runtime, &bundle, &network_options())
    };
    let network = open(&dir).unwrap().unwrap();
    // Red to the left, green to the right, whatever its shape.
    for [width, height] in [[80_u32, 38], [40, 90]] {
        let row =
            (0..width).flat_map(|x| if x < width / 2 { [204, 26, 26] } else { [26, 178, 26] });
        let rgb = row.collect::<Vec<u8>>().repeat(height as usize);
        let seen = network.see(&Photo { width, height, rgb, valid: None }).unwrap();
        let scores = |text: &str| {
            let map = network.find(&seen, text).unwrap();
            [map.at(0.25, 0.5), map.at(0.75, 0.1)]
        };
        assert_eq!(scores("a red thing"), [900, 0], "the mask of all is not sure enough");
        assert_eq!(scores("grass"), [0, 900]);
        assert_eq!(scores("sky"), [0, 0]);
        // Over its last token a text is cut.
        assert_eq!(scores(&("the ".repeat(16) + "red")), [0, 0]);
        let error = network.find(&seen, " ").unwrap_err();
        assert_eq!(error.code(), ErrorCode::InvalidRequest, "{error}");
    }
    let plain = open(&with_image("image.onnx")).unwrap();
    assert!(plain.is_none(), "a bundle without one");

    replace(&dir, "masks = \"masks\"", "masks = \"outlines\"");
    let error = open(&dir).unwrap_err();
    assert!(error.message().contains("has no output \"outlines\""), "{error}");
    replace(&dir, "features = [\"cells\"]", "features = [\"cells\"]\nthreshold = 0.2");
    refused(&dir, &["unknown field `threshold`"]);
    let dir = with_text_masks();
    replace(&dir, "[text_masks]\n", "[text_masks]\nthreshold = 0.2\n");
    refused(&dir, &["text_masks.threshold is 0.2; it must be 0.5 to 1"]);
}

#[test]
fn every_fault_of_a_bundle_is_found_at_once() {
    let dir = with_image("image_external.onnx");
    // Two views alone.
    patch(&dir, "plane.onnx", V, TWO);
    // An opset of the future.
    patch(&dir, "text.onnx", b"\x42\x04\x0a\x00\x10\x11", b"\x42\x04\x0a\x00\x10\x63");
    // The encoder's input under another name.
    replace(
        &dir,
        "input = \"images\"\noutput = \"image_embeddings\"",
        "input = \"picture\"\noutput = \"image_embeddings\"",
    );
    // A damaged decoder, and no weights for the image tower.
    let decoder = dir.path().join("masks_decoder.onnx");
    let mut bytes = std::fs::read(&decoder).unwrap();
    bytes[40] ^= 1;
    std::fs::write(&decoder, bytes).unwrap();
    std::fs::remove_file(dir.path().join(DATA)).unwrap();
    let Some(found) = checked(&dir) else { return };
    let all = found.faults.join("\n");
    for wanted in [
        "geometry network: plane.onnx input \"images\" is",
        "not f32 [2..8, 3, 32..48, 32..48]",
        "plane.onnx output \"means\" is",
        "text.onnx has opset 99; it must be 7 to 26",
        "mask encoder: masks_encoder.onnx has no input \"picture\"",
        "mask encoder: masks_encoder.onnx takes \"images\", which nothing gives it",
        "masks_decoder.onnx is not the file of bundle.toml: sha256",
        "image_external.onnx.data cannot be read",
    ] {
        assert!(all.contains(wanted), "{wanted:?} is not in:\n{all}");
    }
    assert_eq!(found.ran.len(), 0, "nothing that does not fit is run: {found:?}");
}

#[test]
fn a_network_of_another_shape_is_refused_when_it_is_opened() {
    let dir = with_image("image.onnx");
    replace(&dir, "size = 16\n", "size = 24\n");
    replace(&dir, "dim = 8", "dim = 9");
    let Some(runtime) = opened(Runtime::load(&network_options())) else { return };
    let bundle = Bundle::open(dir.path()).unwrap();
    let error = ImageText::open(&runtime, &bundle, &network_options()).unwrap_err();
    assert_eq!(error.code(), ErrorCode::ModelUnavailable, "{error}");
    let named = [
        "image tower: image.onnx input \"images\" is f32 [-1, 3, 16, 16], not f32 [any, 3, 24, \
         24]",
        "output \"embeddings\" is f32 [-1, 8], not f32 [any, 9]",
    ];
    for part in named {
        assert!(error.message().contains(part), "{part:?} is not in: {error}");
    }
    let dir = with_image("image.onnx");
    patch(&dir, "plane.onnx", V, TWO);
    let bundle = Bundle::open(dir.path()).unwrap();
    let error = Geometry::open(&runtime, &bundle, &network_options()).unwrap_err();
    assert!(error.message().contains("not f32 [2..8, 3, 32..48, 32..48]"), "{error}");
    // The manifest says so: then it opens.
    let text = std::fs::read_to_string(dir.path().join("bundle.toml")).unwrap();
    let (before, after) = text.split_once("[geometry.many]").unwrap();
    let (_, after) = after.split_once("\n\n").unwrap();
    std::fs::write(dir.path().join("bundle.toml"), format!("{before}{after}")).unwrap();
    replace(&dir, "views_max = 8", "views_max = 2");
    let bundle = Bundle::open(dir.path()).unwrap();
    Geometry::open(&runtime, &bundle, &network_options()).unwrap();
}
