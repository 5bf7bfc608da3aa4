//! Labelled folders of each layout.

use std::path::Path;

use glam::DVec3;
use image::{DynamicImage, GrayImage, RgbImage};
use segsplat_core::limits::Limits;
use segsplat_lab::semantics::labels::{Class, NOT_SEEN, is_labelled, read};
use serde_json::{Value, json};

use crate::npy;

fn png(dir: &Path, name: &str, picture: impl Into<DynamicImage>) {
    let path = dir.join(name);
    std::fs::create_dir_all(path.parent().unwrap()).unwrap();
    picture.into().save(path).unwrap();
}

/// Two photos of 8 x 6, the second one pixel to the right of the first.
fn scene(k1: f64) -> tempfile::TempDir {
    let dir = tempfile::tempdir().unwrap();
    let mut frames = Vec::new();
    for i in 0..2_u32 {
        let name = format!("images/{i:02}.png");
        png(dir.path(), &name, RgbImage::from_pixel(8, 6, image::Rgb([40, 80, 120])));
        let pose = [[1, 0, 0, i], [0, 1, 0, 0], [0, 0, 1, 0], [0, 0, 0, 1]];
        frames.push(json!({ "file_path": name, "transform_matrix": pose }));
    }
    frames[1]["mask_file"] = json!("masks/01.png");
    let cameras = json!({
        "w": 8, "h": 6, "fl_x": 8.0, "fl_y": 8.0, "cx": 4.0, "cy": 3.0, "k1": k1,
        "frames": frames,
    });
    std::fs::write(dir.path().join("transforms.json"), cameras.to_string()).unwrap();
    dir
}

/// Left half one class, right half another, the last row none.
fn halves(x: u32, y: u32, [left, right]: [u8; 2]) -> image::Luma<u8> {
    image::Luma([if y == 5 {
        0
    } else if x < 4 {
        left
    } else {
        right
    }])
}

const HALVES: [u16; 8] = [1, 1, 1, 1, 2, 2, 2, 2];

#[test]
fn our_layout_is_read_with_its_surroundings() {
    let dir = scene(0.0);
    let at = |name: &str| dir.path().join(name);
    png(dir.path(), "masks/01.png", GrayImage::from_fn(8, 6, |x, y| halves(x, y, [7, 9])));
    std::fs::write(at("masks/classes.json"), r#"{"7": "cup", "9": "wall"}"#).unwrap();
    std::fs::write(at("scene.json"), r#"{"surroundings": ["wall"]}"#).unwrap();
    assert!(is_labelled(dir.path()));
    let scene = read(dir.path(), &Limits::default()).unwrap();
    let class = |name: &str, asked| Class { name: name.to_owned(), asked };
    assert_eq!(scene.classes, [class("cup", true), class("wall", false)]);
    assert_eq!((scene.photos.len(), scene.frames.len()), (2, 1));
    assert_eq!(scene.frames[0].photo, 1);
    assert_eq!(scene.frames[0].label[..8], HALVES);
    assert_eq!(scene.frames[0].label[40..], [0; 8]);
}

#[test]
fn the_layout_of_3d_ovs_is_read_and_the_first_class_keeps_a_pixel() {
    let dir = scene(0.0);
    let ours = |x: u32, y: u32, values| halves(x, y, values);
    png(
        dir.path(),
        "segmentations/01/red cup.png",
        GrayImage::from_fn(8, 6, |x, y| ours(x, y, [255, 0])),
    );
    // Twice the photo's size is resized; its overlap with the cup is the cup's.
    png(dir.path(), "segmentations/00/wall.png", GrayImage::from_pixel(16, 12, image::Luma([255])));
    png(
        dir.path(),
        "segmentations/01/wall.png",
        GrayImage::from_fn(8, 6, |x, y| ours(x, y, [255, 255])),
    );
    let classes = dir.path().join("segmentations/classes.txt");
    std::fs::write(classes, "red cup\nwall\n").unwrap();
    let scene = read(dir.path(), &Limits::default()).unwrap();
    assert!(scene.classes.iter().all(|class| class.asked));
    assert_eq!(scene.frames.len(), 2);
    assert_eq!(scene.frames[0].label, [2; 48]);
    assert_eq!(scene.frames[1].label[..8], HALVES);
}

#[test]
fn labels_bend_with_their_photo() {
    // A strong pincushion: the corners look past the photo, and are not judged.
    let dir = scene(0.9);
    png(dir.path(), "masks/01.png", GrayImage::from_fn(8, 6, |x, y| halves(x, y, [1, 2])));
    std::fs::write(dir.path().join("masks/classes.json"), r#"{"1": "a", "2": "b"}"#).unwrap();
    let scene = read(dir.path(), &Limits::default()).unwrap();
    let label = &scene.frames[0].label;
    assert_eq!([label[0], label[7], label[40], label[47]], [NOT_SEEN; 4]);
    assert_eq!(label[2 * 8 + 2..2 * 8 + 6], [1, 1, 2, 2]);
    let valid = scene.photos[1].photo.valid.as_ref().unwrap();
    assert!(label.iter().zip(valid).all(|(label, valid)| (*label == NOT_SEEN) != *valid));
}

#[test]
fn labels_outside_the_folder_or_of_no_photo_are_refused() {
    for (mask, file, named) in [
        ("../x.png", "images/01.png", "../x.png"),
        ("masks/01.png", "images/77.png", "images/77.png"),
    ] {
        let dir = scene(0.0);
        png(dir.path(), "masks/01.png", GrayImage::new(8, 6));
        std::fs::write(dir.path().join("masks/classes.json"), r#"{"1": "a"}"#).unwrap();
        let path = dir.path().join("transforms.json");
        let text = std::fs::read_to_string(&path).unwrap().replace("masks/01.png", mask);
        let mut cameras: Value = serde_json::from_str(&text).unwrap();
        let mut frame = cameras["frames"][1].clone();
        if frame["file_path"] != file {
            frame["file_path"] = json!(file);
            cameras["frames"].as_array_mut().unwrap().push(frame);
        }
        std::fs::write(&path, cameras.to_string()).unwrap();
        let fault = read(dir.path(), &Limits::default()).unwrap_err().to_string();
        assert!(fault.contains(named), "{mask} of {file}: {fault}");
    }
}

#[test]
fn axes_and_focal_length_are_turned_to_ours() {
    let dir = tempfile::tempdir().unwrap();
    std::fs::create_dir(dir.path().join("images")).unwrap();
    png(dir.path(), "segmentations/0/cup.png", GrayImage::from_pixel(8, 6, image::Luma([255])));
    std::fs::write(dir.path().join("segmentations/classes.txt"), "cup\n").unwrap();
    let mut data = Vec::new();
    for i in 0..2_u32 {
        let picture = image::RgbImage::from_pixel(8, 6, image::Rgb([1, 2, 3]));
        picture.save(dir.path().join(format!("images/{i}.png"))).unwrap();
        // Looks along world +z: right = +x, down = +y, backwards = -z; written for 16 x 12.
        let row: [f64; 17] =
            [0., 1., 0., f64::from(i), 12., 1., 0., 0., 2., 16., 0., 0., -1., 3., 20., 0.1, 9.];
        data.extend(row.iter().flat_map(|v| v.to_le_bytes()));
    }
    let bytes = npy("<f8", "2, 17", &data);
    let path = dir.path().join("poses_bounds.npy");
    std::fs::write(&path, &bytes).unwrap();
    let limits = Limits::default();
    let camera = read(dir.path(), &limits).unwrap().photos[1].camera;
    assert_eq!(camera.camera_to_world.center(), DVec3::new(1.0, 2.0, 3.0));
    assert_eq!(camera.camera_to_world.axis(), DVec3::Z);
    let lens = camera.intrinsics;
    assert_eq!((lens.fx, lens.fy, lens.cx, lens.cy), (10.0, 10.0, 4.0, 3.0));
    std::fs::write(&path, npy("<f8", "1, 17", &data[..17 * 8])).unwrap();
    let fault = read(dir.path(), &limits).unwrap_err().to_string();
    assert!(fault.contains("1 rows for 2 photos"), "{fault}");
}
