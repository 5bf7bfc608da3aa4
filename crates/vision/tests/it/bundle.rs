//! A bundle that is damaged is refused, and the message names what is wrong.

use std::path::Path;

use segsplat_core::error::ErrorCode;
use segsplat_vision::models::Bundle;
use sha2::{Digest, Sha256};

const MANIFEST: &str = "bundle.toml";

fn fixture(change: impl Fn(String) -> String) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let from = Path::new("../../tests/fixtures/plane");
    let text = std::fs::read_to_string(from.join(MANIFEST)).unwrap();
    std::fs::write(dir.path().join(MANIFEST), change(text)).unwrap();
    std::fs::copy(from.join("plane.onnx"), dir.path().join("plane.onnx")).unwrap();
    dir
}

#[test]
fn a_whole_bundle_opens() {
    let dir = fixture(|text| text);
    let bundle = Bundle::open(dir.path()).unwrap();
    assert_eq!(bundle.geometry().file, "plane.onnx", "the manifest's file");
    assert!(bundle.size_bytes("plane.onnx") > 100, "the file has a size");
}

#[test]
fn a_changed_file_is_refused_by_name_and_both_hashes() {
    let dir = fixture(|text| text);
    let path = dir.path().join("plane.onnx");
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[20] ^= 1;
    std::fs::write(&path, &bytes).unwrap();
    let error = Bundle::open(dir.path()).unwrap_err();
    assert_eq!(error.code(), ErrorCode::ModelUnavailable, "{error}");
    let whole = Bundle::open(Path::new("../../tests/fixtures/plane")).unwrap();
    let found: String = Sha256::digest(&bytes).iter().map(|b| format!("{b:02x}")).collect();
    for part in ["plane.onnx", whole.files()[0].sha256, &found] {
        assert!(error.message().contains(part), "{part} is not in: {error}");
    }
}

#[test]
fn a_missing_file_and_a_missing_manifest_say_which() {
    let dir = fixture(|text| text);
    std::fs::remove_file(dir.path().join("plane.onnx")).unwrap();
    let error = Bundle::open(dir.path()).unwrap_err();
    assert!(error.message().contains("plane.onnx cannot be read"), "{error}");
    std::fs::remove_file(dir.path().join(MANIFEST)).unwrap();
    let error = Bundle::open(dir.path()).unwrap_err();
    assert!(error.message().contains("bundle.toml cannot be read"), "{error}");
}

#[test]
fn every_file_of_semantics_is_checked_and_its_keys_too() {
    let from = Path::new("../../tests/fixtures/colours");
    let whole = Bundle::open(from).unwrap();
    assert_eq!(whole.files().len(), 7, "{:?}", whole.files());
    let dir = tempfile::tempdir().unwrap();
    for entry in whole.files() {
        std::fs::copy(from.join(entry.file), dir.path().join(entry.file)).unwrap();
    }
    let text = std::fs::read_to_string(from.join(MANIFEST)).unwrap();
    for (from, to, named) in [
        ("views_min = 5", "views_min = 2", "geometry.many.views_min is 2"),
        ("views_min = 5", "views_min = 9", "geometry.many.views_min is 9"),
        ("views_min = 5\nfile = \"", "views_min = 5\nfile = \"../", "plain file name"),
        ("adapter = \"sam\"", "adapter = \"other\"", "unknown variant"),
        ("size = 64", "size = 0", "masks.size is 0"),
        ("levels = [0, 1, 2]", "levels = []", "masks.levels is []"),
        ("points_per_side = 16", "points_per_side = 1000", "masks.points_per_side is 1000"),
        ("pred_iou_thresh = 0.7", "pred_iou_thresh = 7.0", "masks.pred_iou_thresh is 7.0"),
        ("min_area = 0.001", "min_area = 1.5", "masks.min_area is 1.5"),
        ("min_area = 0.001", "crop_n_layers = 4", "masks.crop_n_layers is 4"),
        ("min_area = 0.001", "crop_n_points_downscale_factor = 0", "downscale_factor is 0"),
        (
            "min_area = 0.001",
            "overlap_nms = { iou = 0.8, score = 1.7, inner = 0.5 }",
            "masks.overlap_nms.score is 1.7",
        ),
        ("min_area = 0.001", "overlap_nms = { iou = 0.8 }", "missing field `score`"),
        ("tau = 10.0", "tau = 0.0", "image_text.tau is 0.0"),
        ("canon = [\"object\", ", "canon = [\" \", ", "image_text.canon"),
        ("dim = 8", "dim = 0", "image_text.dim is 0"),
        ("batch = 16", "batch = 0", "image_text.image.batch is 0"),
        ("context = 16", "context = 0", "image_text.text.context is 0"),
        ("\"tokenizer.json\"", "\"../tokenizer.json\"", "plain file name"),
        ("tokenizer_sha256 = \"5", "tokenizer_sha256 = \"6", "tokenizer.json is not the file"),
        ("sha256 = \"cc519", "sha256 = \"dc519", "masks_decoder.onnx is not the file"),
    ] {
        assert!(text.contains(from), "the fixture has no {from:?}");
        std::fs::write(dir.path().join(MANIFEST), text.replace(from, to)).unwrap();
        let error = Bundle::open(dir.path()).unwrap_err();
        assert_eq!(error.code(), ErrorCode::ModelUnavailable, "{error}");
        assert!(error.message().contains(named), "{to}: {error}");
    }
}

#[test]
fn a_malformed_manifest_names_the_field() {
    for (from, to, named) in [
        ("sh_degree = 0", "sh_degree = 4", "geometry.sh_degree is 4"),
        ("file = \"plane.onnx\"", "file = \"../plane.onnx\"", "plain file name"),
        ("views_max = 8", "views_max = 1", "views_max"),
        ("std = [1.0, 1.0, 1.0]", "std = [1.0, 0.0, 1.0]", "std"),
        ("[32, 32]", "[32, 0]", "buckets"),
        ("sh_degree = 0", "colour = 1\nsh_degree = 0", "unknown field"),
    ] {
        let dir = fixture(|text| {
            assert!(text.contains(from), "the fixture has no {from:?}");
            text.replace(from, to)
        });
        let error = Bundle::open(dir.path()).unwrap_err();
        assert!(error.message().contains(named), "{to}: {error}");
    }
}
