//! `LabelMe`: beside each photo a JSON with the polygons of each text.
//!
//! All polygons of a text in a photo have one `group_id`, the number of the text from 0.

use serde::Serialize;
use serde_json::{Map, Value, json};

use super::{
    FolderContents, FolderPhoto, FolderPixels, ZipFolder,
    outline::{Polygon, polygons},
};
use crate::{error::Result, scene::Intrinsics};

/// The version of the format that is written.
const VERSION: &str = "5.5.0";

#[derive(Serialize)]
struct Shape<'a> {
    label: &'a str,
    points: Polygon,
    group_id: usize,
    description: &'static str,
    shape_type: &'static str,
    flags: Map<String, Value>,
    mask: Option<String>,
}

pub(crate) fn write(
    of: &FolderContents<'_>,
    photos: &[FolderPhoto],
    pixels: &mut dyn FolderPixels,
    zip: &mut ZipFolder<'_>,
) -> Result<()> {
    for (i, photo) in photos.iter().enumerate() {
        let found = pixels.masks(i)?;
        let Intrinsics { width, height, .. } = photo.camera.intrinsics;
        let name = photo.file.rsplit('/').next().unwrap_or(&photo.file);
        zip.begin_text(&format!("images/{}.json", photo.stem()))?;
        let head = json!({
            "version": VERSION, "flags": {}, "imagePath": name, "imageData": null,
            "imageHeight": height, "imageWidth": width,
        });
        let mut shapes = zip.begin_list(&head, "shapes")?;
        for (group_id, (label, found)) in of.texts.iter().zip(found).enumerate() {
            let Some(mask) = found.mask.filter(|_| found.area > 0) else { continue };
            for points in polygons(&mask.decode(), width as usize, height as usize) {
                shapes.push(&Shape {
                    label,
                    points,
                    group_id,
                    description: "",
                    shape_type: "polygon",
                    flags: Map::new(),
                    mask: None,
                })?;
            }
        }
        shapes.end()?;
    }
    Ok(())
}
