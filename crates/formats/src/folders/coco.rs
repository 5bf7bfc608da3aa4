//! COCO's annotations: `annotations.json` with a category for each text and, for each photo and
//! each text that is in it, one annotation with its mask as compressed run lengths; `images`.
//!
//! An annotation is all that a text selects in a photo. It is no crowd (`iscrowd` 0), so that
//! programs train with it.

use serde::Serialize;
use serde_json::{Value, json};

use super::{FolderContents, FolderPhoto, FolderPixels, ZipFolder};
use crate::{error::Result, rle::Rle, scene::Intrinsics};

#[derive(Serialize)]
struct Annotation<'a> {
    id: usize,
    image_id: usize,
    category_id: usize,
    segmentation: &'a Rle,
    area: u64,
    bbox: [u32; 4],
    iscrowd: u8,
}

pub(crate) fn write(
    of: &FolderContents<'_>,
    photos: &[FolderPhoto],
    pixels: &mut dyn FolderPixels,
    zip: &mut ZipFolder<'_>,
) -> Result<()> {
    let category =
        |(i, text): (usize, &String)| json!({ "id": i + 1, "name": text, "supercategory": "" });
    let images: Vec<Value> = photos.iter().enumerate().map(|(i, photo)| image(i, photo)).collect();
    let head = json!({
        "info": info(of),
        "licenses": [],
        "categories": of.texts.iter().enumerate().map(category).collect::<Vec<Value>>(),
        "images": images,
    });
    zip.begin_text("annotations.json")?;
    let (mut id, mut list) = (0, zip.begin_list(&head, "annotations")?);
    for i in 0..photos.len() {
        for (text, found) in pixels.masks(i)?.iter().enumerate() {
            let (Some(segmentation), Some(bbox)) = (&found.mask, found.bbox) else { continue };
            id += 1;
            list.push(&Annotation {
                id,
                image_id: i + 1,
                category_id: text + 1,
                segmentation,
                area: found.area,
                bbox,
                iscrowd: 0,
            })?;
        }
    }
    list.end()
}

fn info(of: &FolderContents<'_>) -> Value {
    json!({
        "description": format!("What texts select in the photos of scene {}", of.scene.meta.id),
        "contributor": format!("SegSplat Server {}", env!("CARGO_PKG_VERSION")),
    })
}

fn image(i: usize, photo: &FolderPhoto) -> Value {
    let Intrinsics { width, height, .. } = photo.camera.intrinsics;
    json!({ "id": i + 1, "file_name": photo.file, "width": width, "height": height })
}
