//! `OpenSfM`'s `reconstruction.json`, as `OpenDroneMap` and Mapillary write it too.
//!
//! A list of reconstructions, of which that with most photos is read: `cameras` by their names,
//! `shots` by the names of photos, which lie in `images`. A shot's `rotation` is axis times angle,
//! and `translation` goes with it: world to camera, OpenCV axes. Focal lengths and the principal
//! point are shares of the longer side, the latter from the middle (`OpenSfM`'s documentation,
//! "Geometric Models").

use glam::{DMat3, DVec3};
use serde_json::Value;

use crate::{
    captures::layout::{
        CameraEntry, Described, Fields, Folder, Layout, Lens, PoseAxes, called, inverse, json,
        names, number, pinhole,
    },
    error::{Error, Result},
};

pub(super) struct OpenSfm;

/// Models whose radial terms are of the tangent of the angle, and of the angle.
const MODELS: [(&str, bool); 5] = [
    ("perspective", false),
    ("simple_radial", false),
    ("brown", false),
    ("fisheye", true),
    ("fisheye_opencv", true),
];

impl Layout for OpenSfm {
    fn name(&self) -> &'static str {
        "OpenSfM"
    }

    fn find(&self, folder: &Folder<'_>) -> Vec<String> {
        called(folder, "reconstruction.json")
    }

    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described> {
        let wrong = |what: &str| Error::invalid(format!("{at}: {what}"));
        let all = json(&folder.read_json(at)?, at)?;
        let shots_of = |one: &&Value| one.get("shots").and_then(Value::as_object).map(Fields::len);
        let largest = all.as_array().and_then(|all| all.iter().max_by_key(shots_of));
        let of = |key| largest.and_then(|one| one.get(key)).and_then(Value::as_object);
        let (Some(cameras), Some(shots)) = (of("cameras"), of("shots")) else {
            return Err(wrong("no list of reconstructions with `cameras` and `shots`"));
        };
        let mut entries = Vec::new();
        for (file, shot) in shots {
            let numbers = |key: &str| -> Result<DVec3> {
                let list = shot.get(key).and_then(Value::as_array);
                let list = list.and_then(|list| list.iter().map(Value::as_f64).collect());
                let three = list.and_then(|list: Vec<f64>| <[f64; 3]>::try_from(list).ok());
                three
                    .map(DVec3::from)
                    .ok_or_else(|| wrong(&format!("{key} of {file:?} must be 3 numbers")))
            };
            let camera = shot.get("camera").and_then(Value::as_str).unwrap_or_default();
            let fields = cameras.get(camera).and_then(Value::as_object);
            let fields = fields.ok_or_else(|| {
                wrong(&format!("{file:?} has camera {camera:?}, which is not there"))
            })?;
            let turn = numbers("rotation")?;
            let rotation = match turn.length() {
                0.0 => DMat3::IDENTITY,
                angle => DMat3::from_axis_angle(turn / angle, angle),
            };
            let pose = inverse(rotation, numbers("translation")?);
            let lens = lens(fields, &format!("{at}: camera {camera:?}"))?;
            entries.push(CameraEntry::new(file.clone(), lens, PoseAxes::OpenCv, pose));
        }
        Ok(Described::new(names::folder(at), entries))
    }
}

fn lens(camera: &Fields, what: &str) -> Result<Lens> {
    let get = |key: &str| number(camera, key, what);
    let model = camera.get("projection_type").and_then(Value::as_str).unwrap_or("perspective");
    let known = MODELS.iter().find(|(name, _)| *name == model);
    let Some((_, is_fisheye)) = known else {
        let shown: String = model.chars().take(40).collect();
        return Err(Error::invalid(format!("{what} has projection_type {shown:?}, not known")));
    };
    let missing = |key: &str| Error::invalid(format!("{what}: {key} is missing"));
    let needed = |key: &str| get(key)?.ok_or_else(|| missing(key));
    let (width, height) = (needed("width")?, needed("height")?);
    let side = width.max(height);
    let focal = |key: &str| Ok::<_, Error>(get(key)?.or(get("focal")?));
    let fx = focal("focal_x")?.ok_or_else(|| missing("focal"))?;
    let fy = focal("focal_y")?.unwrap_or(fx);
    let centre =
        |key: &str, sides: f64| Ok::<_, Error>(0.5 * sides + side * get(key)?.unwrap_or(0.0));
    let (cx, cy) = (centre("c_x", width)?, centre("c_y", height)?);
    Ok(Lens {
        is_fisheye: Some(*is_fisheye),
        k: [get("k1")?, get("k2")?, get("k3")?, get("k4")?],
        p: [get("p1")?, get("p2")?],
        ..pinhole([fx * side, fy * side, cx, cy], Some([width, height]))
    })
}
