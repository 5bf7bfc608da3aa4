//! Labelled photographs of each kind of file.

use std::io::{Cursor, Write as _};

use segsplat_core::scene::CropShape;
use segsplat_lab::words::{npz::Labelled, segments::Segmented};

use crate::npy;

fn file(labels: &[i32], offsets: &[i64]) -> tempfile::NamedTempFile {
    let mut zip = zip::ZipWriter::new(Cursor::new(Vec::new()));
    let options =
        zip::write::SimpleFileOptions::default().compression_method(zip::CompressionMethod::Stored);
    let names: Vec<u8> = ["cat\0", "tree"]
        .iter()
        .flat_map(|name| name.chars().flat_map(|c| u32::from(c).to_le_bytes()))
        .collect();
    let arrays = [
        ("blob", npy("|u1", "5,", b"abcde")),
        (
            "offsets",
            npy("<i8", "3,", &offsets.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()),
        ),
        (
            "label",
            npy("<i4", "2,", &labels.iter().flat_map(|v| v.to_le_bytes()).collect::<Vec<u8>>()),
        ),
        ("class_names", npy("<U4", "2,", &names)),
    ];
    for (name, bytes) in arrays {
        zip.start_file(format!("{name}.npy"), options).unwrap();
        zip.write_all(&bytes).unwrap();
    }
    let set = tempfile::Builder::new().suffix(".npz").tempfile().unwrap();
    set.as_file().write_all(&zip.finish().unwrap().into_inner()).unwrap();
    set
}

#[test]
fn images_labels_and_names_are_read() {
    let set = Labelled::open(file(&[1, 0], &[0, 2, 5]).path(), 1 << 20).unwrap();
    assert_eq!(set.names, ["cat", "tree"]);
    assert_eq!(set.labels, [1, 0]);
    assert_eq!((set.image(0), set.image(1)), (&b"ab"[..], &b"cde"[..]));
}

#[test]
fn what_does_not_fit_together_is_refused() {
    for (labels, offsets) in [([2, 0], [0, 2, 5]), ([-1, 0], [0, 2, 5]), ([0, 1], [0, 3, 4])] {
        assert!(Labelled::open(file(&labels, &offsets).path(), 1 << 20).is_err());
    }
    assert!(Labelled::open(file(&[1, 0], &[0, 2, 5]).path(), 40).is_err(), "over the limit");
}

fn png(picture: impl Into<image::DynamicImage>) -> Vec<u8> {
    let mut bytes = Cursor::new(Vec::new());
    picture.into().write_to(&mut bytes, image::ImageFormat::Png).unwrap();
    bytes.into_inner()
}

#[test]
fn things_are_cut_out_with_their_names_and_crowds_are_not() {
    let photo = png(image::RgbImage::from_fn(4, 4, |x, _| image::Rgb([x as u8 + 1, 7, 7])));
    let mask = png(image::GrayImage::from_fn(4, 4, |x, y| {
        image::Luma([if y > 1 {
            3
        } else if x < 2 {
            5
        } else {
            0
        }])
    }));
    let json = br#"{"a.jpg": {"split": "x", "segments": [
        {"index": 3, "name": "people", "isthing": 1, "iscrowd": 1},
        {"index": 5, "name": "cup", "isthing": 1, "iscrowd": 0}]}}"#;
    let mut tar = tar::Builder::new(Vec::new());
    let files = [
        ("set/images/a.jpg", photo.as_slice()),
        ("set/masks/a.png", mask.as_slice()),
        ("set/segments.json", json.as_slice()),
    ];
    for (name, bytes) in files {
        let mut header = tar::Header::new_gnu();
        header.set_size(bytes.len() as u64);
        tar.append_data(&mut header, name, bytes).unwrap();
    }
    let file = tempfile::NamedTempFile::new().unwrap();
    file.as_file().write_all(&tar.into_inner().unwrap()).unwrap();
    let set = Segmented::open(file.path(), 1 << 20).unwrap();
    assert_eq!(set.class_names().into_iter().collect::<Vec<_>>(), ["cup", "people"]);
    let cut = set.images[0].cut(0.0, CropShape::Square).unwrap();
    assert_eq!(cut.len(), 1);
    let (crop, name) = &cut[0];
    assert_eq!((name.as_str(), crop.width), ("cup", 2));
    assert_eq!(crop.rgb, [1, 7, 7, 2, 7, 7, 1, 7, 7, 2, 7, 7]);
}
