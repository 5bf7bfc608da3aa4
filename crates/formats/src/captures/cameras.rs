//! Cameras as every reader gives them, and the camera JSONs: nerfstudio / instant-ngp
//! `transforms.json`, our own `cameras` and that of 3DGS.
//!
//! What `transforms.json` says beside its frames: `applied_transform` and `applied_scale` tell how
//! the file's world was made of another one. The poses have them already, and the scene keeps the
//! world of the poses, as nerfstudio's own reader does. Frames that are kept for tests make no part
//! of a scene: `test_frames`, those of `test_filenames` and `val_filenames` that are not in
//! `train_filenames`, and those of `ScanNet++` with `is_bad`.

use std::collections::{BTreeSet, HashSet};

use glam::DMat3;
use serde_json::{Map, Value};

use super::{keys, lens::Lens, numbers, once::Once};
use crate::{
    error::{Error, Result},
    scene::{CameraToWorld, ORTHONORMAL_TOLERANCE, photo_label as label},
};

/// Axes of the camera in an uploaded pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum PoseAxes {
    /// x right, y up, z backwards.
    OpenGl,
    /// x right, y down, z forward.
    OpenCv,
}

/// One camera as written; its numbers are checked only when its photo is there.
#[derive(Clone, Debug)]
pub(crate) struct CameraEntry {
    /// Path of its photo as written.
    pub(crate) file: String,
    /// Lens as written.
    pub(crate) lens: Lens,
    /// Path of its photo's mask as written.
    pub(crate) mask: Option<String>,
    axes: PoseAxes,
    /// Camera-to-world, row-major, as written.
    pose: std::result::Result<[f64; 16], String>,
}

impl CameraEntry {
    /// A camera of a photo; `pose` is camera-to-world, row-major.
    pub(crate) fn new(file: String, lens: Lens, axes: PoseAxes, pose: [f64; 16]) -> Self {
        Self { file, lens, mask: None, axes, pose: Ok(pose) }
    }

    /// The pose, checked; without the scale of its rotation, where it has one.
    pub(crate) fn pose(&self, what: &str) -> Result<CameraToWorld> {
        let mut pose = self.pose.clone().map_err(Error::invalid)?;
        if let Some(scale) = self.scale() {
            for row in 0..3 {
                pose[4 * row..4 * row + 3].iter_mut().for_each(|v| *v /= scale);
            }
        }
        match self.axes {
            PoseAxes::OpenGl => CameraToWorld::from_opengl_row_major(&pose, what),
            PoseAxes::OpenCv => CameraToWorld::from_row_major(&pose, what),
        }
    }

    /// The scale of a pose whose rotation is one times a number: a similarity. The rays of a camera
    /// go the same ways whatever that number is, from the same centre.
    pub(crate) fn scale(&self) -> Option<f64> {
        let m = self.pose.as_ref().ok()?;
        let r = DMat3::from_cols_array(&[m[0], m[1], m[2], m[4], m[5], m[6], m[8], m[9], m[10]]);
        let scale = r.determinant().abs().cbrt();
        let off = (r * r.transpose() * (1.0 / (scale * scale)) - DMat3::IDENTITY).to_cols_array();
        let is_similar = off.iter().all(|v| v.abs() <= ORTHONORMAL_TOLERANCE);
        let is_scaled = (scale * scale - 1.0).abs() > ORTHONORMAL_TOLERANCE;
        (is_scaled && is_similar).then_some(scale)
    }
}

/// What a camera file says.
#[derive(Clone, Debug, Default)]
pub(crate) struct Cameras {
    /// All cameras, in its order.
    pub(crate) entries: Vec<CameraEntry>,
    /// Photos that it keeps for tests.
    pub(crate) held_out: Vec<String>,
    /// Keys that change what is meant and are not read.
    pub(crate) unread: BTreeSet<String>,
}

/// A `transforms.json`, whose size was checked.
pub(crate) fn transforms(bytes: &[u8]) -> Result<Cameras> {
    let top = object(bytes, "transforms")?;
    let mut cameras = list(&top, "transforms", "frames", transforms_frame)?;
    let files = |key: &str| -> HashSet<String> {
        let names = top.get(key).and_then(Value::as_array).into_iter().flatten();
        names.filter_map(Value::as_str).map(str::to_owned).collect()
    };
    let [train, test, val] = ["train_filenames", "test_filenames", "val_filenames"].map(files);
    let bad = |i: usize| top["frames"][i].get("is_bad").and_then(Value::as_bool) == Some(true);
    let mut i = 0;
    cameras.entries.retain(|entry| {
        let for_tests = (test.contains(&entry.file) || val.contains(&entry.file))
            && !train.contains(&entry.file);
        let kept = !for_tests && !bad(i);
        if !kept {
            cameras.held_out.push(entry.file.clone());
        }
        i += 1;
        kept
    });
    let tests = top.get("test_frames").and_then(Value::as_array).into_iter().flatten();
    let tests = tests.filter_map(|frame| frame.get("file_path").and_then(Value::as_str));
    cameras.held_out.extend(tests.map(str::to_owned));
    Ok(cameras)
}

/// A `cameras.json`, whose size was checked: our own, or the list that a training of 3DGS leaves.
pub(crate) fn cameras(bytes: &[u8]) -> Result<Cameras> {
    match json(bytes, "cameras")? {
        Value::Object(top) => list(&top, "cameras", "cameras", cameras_entry),
        list @ Value::Array(_) => {
            let top = Fields::from_iter([("cameras".to_owned(), list)]);
            self::list(&top, "cameras", "cameras", gaussian_splatting_entry)
        }
        other => Err(Error::invalid(format!("cameras: {}, not a JSON object", kind(&other)))),
    }
}

/// A JSON object.
pub(crate) type Fields = Map<String, Value>;

fn list(
    top: &Fields,
    part: &str,
    list_key: &str,
    read: fn(usize, &Fields, &Fields) -> Result<CameraEntry>,
) -> Result<Cameras> {
    let list = match top.get(list_key) {
        Some(Value::Array(list)) => list,
        Some(other) => {
            let kind = kind(other);
            return Err(Error::invalid(format!("{part}: `{list_key}` is {kind}, not a list")));
        }
        None => return Err(Error::invalid(format!("{part}: the list `{list_key}` is missing"))),
    };
    keys::check(top, part)?;
    let mut unread: BTreeSet<String> = keys::unread(top).collect();
    let entry = |(i, value): (usize, &Value)| match value {
        Value::Object(fields) => {
            keys::check(fields, &format!("{part}: {list_key}[{i}]"))?;
            unread.extend(keys::unread(fields));
            read(i, fields, top)
        }
        other => {
            let kind = kind(other);
            Err(Error::invalid(format!("{part}: {list_key}[{i}] is {kind}, not an object")))
        }
    };
    let entries = list.iter().enumerate().map(entry).collect::<Result<_>>()?;
    Ok(Cameras { entries, held_out: Vec::new(), unread })
}

/// The object of a JSON text; `part` names it in messages.
pub(crate) fn object(bytes: &[u8], part: &str) -> Result<Fields> {
    match json(bytes, part)? {
        Value::Object(map) => Ok(map),
        other => Err(Error::invalid(format!("{part}: {}, not a JSON object", kind(&other)))),
    }
}

/// The value of a JSON text, in which no key has two values; `part` names it in messages.
pub(crate) fn json(bytes: &[u8], part: &str) -> Result<Value> {
    let text = numbers::text(bytes, part)?;
    let parsed = serde_json::from_str(&text).or_else(|e| {
        // Python writes NaN and Infinity, which JSON has not: read them so that the message can
        // name the photo whose number it is.
        without_bare_nan(&text).map_or(Err(e), |text| serde_json::from_str(&text))
    });
    let value = parsed.map(|Once(value)| value);
    value.map_err(|e| Error::invalid(format!("{part}: not valid JSON ({e})")))
}

/// The text with bare `NaN`, `Infinity`, `-Infinity` as `null`; `None` when there are none.
fn without_bare_nan(text: &str) -> Option<String> {
    let mut out = String::with_capacity(text.len());
    let (mut rest, mut changed) = (text, false);
    let (mut in_string, mut escaped) = (false, false);
    while let Some(c) = rest.chars().next() {
        if !in_string {
            let word = ["NaN", "-NaN", "Infinity", "-Infinity"];
            if let Some(word) = word.iter().find(|w| rest.starts_with(**w)) {
                out.push_str("null");
                rest = &rest[word.len()..];
                changed = true;
                continue;
            }
        }
        if escaped {
            escaped = false;
        } else if in_string && c == '\\' {
            escaped = true;
        } else if c == '"' {
            in_string = !in_string;
        }
        out.push(c);
        rest = &rest[c.len_utf8()..];
    }
    changed.then_some(out)
}

fn kind(value: &Value) -> &'static str {
    match value {
        Value::Null => "null",
        Value::Bool(_) => "true or false",
        Value::Number(_) => "a number",
        Value::String(_) => "a text",
        Value::Array(_) => "a list",
        Value::Object(_) => "an object",
    }
}

fn text(fields: &Fields, key: &str, what: &str) -> Result<Option<String>> {
    match fields.get(key) {
        None | Some(Value::Null) => Ok(None),
        Some(Value::String(text)) => Ok(Some(text.clone())),
        Some(other) => Err(Error::invalid(format!("{what}: {key} is {}, not a text", kind(other)))),
    }
}

/// A number, NaN where it is written as such or as null; `None` where the key is absent.
pub(crate) fn number(fields: &Fields, key: &str, what: &str) -> Result<Option<f64>> {
    match fields.get(key) {
        None => Ok(None),
        Some(Value::Null) => Ok(Some(f64::NAN)),
        Some(Value::Number(n)) => Ok(Some(n.as_f64().unwrap_or(f64::NAN))),
        Some(other) => {
            Err(Error::invalid(format!("{what}: {key} is {}, not a number", kind(other))))
        }
    }
}

/// 16 numbers of a flat list, or of 3 or 4 rows of 4.
fn matrix(value: Option<&Value>, key: &str, what: &str) -> std::result::Result<[f64; 16], String> {
    let shape = || format!("{what}: {key} must be 4 rows of 4 numbers");
    let Some(value) = value else { return Err(format!("{what}: {key} is missing")) };
    let Value::Array(rows) = value else { return Err(shape()) };
    let nested = rows.iter().any(Value::is_array);
    let mut flat: Vec<&Value> = Vec::with_capacity(16);
    for row in rows {
        match row {
            Value::Array(row) if row.len() == 4 => flat.extend(row),
            Value::Number(_) | Value::Null if !nested => flat.push(row),
            _ => return Err(shape()),
        }
        if flat.len() > 16 {
            return Err(shape());
        }
    }
    let mut m = [0.0; 16];
    m[15] = 1.0;
    if flat.len() != 16 && flat.len() != 12 {
        return Err(format!("{} (it has {})", shape(), flat.len()));
    }
    for (at, value) in m.iter_mut().zip(flat) {
        *at = match value {
            Value::Number(n) => n.as_f64().unwrap_or(f64::NAN),
            Value::Null => f64::NAN,
            _ => return Err(shape()),
        };
    }
    Ok(m)
}

/// One frame of `transforms.json`; what the frame lacks is taken from the top level.
fn transforms_frame(i: usize, frame: &Fields, top: &Fields) -> Result<CameraEntry> {
    let unnamed = format!("transforms: frames[{i}]");
    let file = text(frame, "file_path", &unnamed)?
        .ok_or_else(|| Error::invalid(format!("{unnamed}: file_path is missing")))?;
    let what = label(i, &file);
    let mut lens = Lens::default();
    for scope in [frame, top] {
        let get = |key| number(scope, key, &what);
        // Within one scope a focal length wins over an angle, and the frame over the top level.
        for (focal, angle, [in_pixels, radians, degrees, also_degrees]) in [
            (&mut lens.fx, &mut lens.angle_x, ["fl_x", "camera_angle_x", "x_fov", "fov_x"]),
            (&mut lens.fy, &mut lens.angle_y, ["fl_y", "camera_angle_y", "y_fov", "fov_y"]),
        ] {
            if focal.is_none() && angle.is_none() {
                *focal = get(in_pixels)?;
                *angle = match get(radians)? {
                    Some(radians) => Some(radians),
                    None => get(degrees)?.or(get(also_degrees)?).map(f64::to_radians),
                };
            }
        }
        for (slot, key) in [
            (&mut lens.cx, "cx"),
            (&mut lens.cy, "cy"),
            (&mut lens.width, "w"),
            (&mut lens.height, "h"),
        ] {
            *slot = slot.or(get(key)?);
        }
        read_distortion(&mut lens, scope, &what)?;
    }
    let pose = matrix(frame.get("transform_matrix"), "transform_matrix", &what);
    let mask = text(frame, "mask_path", &what)?;
    Ok(CameraEntry { file, lens, mask, axes: PoseAxes::OpenGl, pose })
}

/// One entry of our own JSON.
fn cameras_entry(i: usize, entry: &Fields, _top: &Fields) -> Result<CameraEntry> {
    let unnamed = format!("cameras: cameras[{i}]");
    let file = text(entry, "file", &unnamed)?
        .ok_or_else(|| Error::invalid(format!("{unnamed}: file is missing")))?;
    let what = label(i, &file);
    let Some(Value::Object(fields)) = entry.get("intrinsics") else {
        return Err(Error::invalid(format!("{what}: intrinsics are missing or not an object")));
    };
    let needed = |key: &str| {
        number(fields, key, &what)?
            .map(Some)
            .ok_or_else(|| Error::invalid(format!("{what}: intrinsics.{key} is missing")))
    };
    let mut lens = Lens {
        fx: needed("fx")?,
        fy: needed("fy")?,
        cx: needed("cx")?,
        cy: needed("cy")?,
        width: number(fields, "width", &what)?,
        height: number(fields, "height", &what)?,
        ..Lens::default()
    };
    read_distortion(&mut lens, fields, &what)?;
    let pose = matrix(entry.get("camera_to_world"), "camera_to_world", &what);
    let mask = text(entry, "mask_path", &what)?;
    Ok(CameraEntry { file, lens, mask, axes: PoseAxes::OpenCv, pose })
}

/// One entry of the list that 3DGS writes beside a training (`camera_to_JSON` in its
/// `utils/camera_utils.py`): camera-to-world in OpenCV axes, the principal point in the middle.
fn gaussian_splatting_entry(i: usize, entry: &Fields, _top: &Fields) -> Result<CameraEntry> {
    let unnamed = format!("cameras: [{i}]");
    let file = text(entry, "img_name", &unnamed)?
        .ok_or_else(|| Error::invalid(format!("{unnamed}: img_name is missing")))?;
    let what = label(i, &file);
    let needed = |key: &str| {
        number(entry, key, &what)?
            .ok_or_else(|| Error::invalid(format!("{what}: {key} is missing")))
    };
    let size = [needed("width")?, needed("height")?];
    let centre = [0.5 * size[0], 0.5 * size[1]];
    let lens = numbers::pinhole([needed("fx")?, needed("fy")?, centre[0], centre[1]], Some(size));
    let row = |value: Option<&Value>| -> Option<[f64; 3]> {
        let numbers: Vec<f64> =
            value?.as_array()?.iter().map(Value::as_f64).collect::<Option<_>>()?;
        numbers.try_into().ok()
    };
    let rotation = entry.get("rotation").and_then(Value::as_array);
    let rows = [0, 1, 2].map(|at| row(rotation.and_then(|rows| rows.get(at))));
    let pose = match (rows, row(entry.get("position"))) {
        ([Some(x), Some(y), Some(z)], Some(centre)) => {
            Ok(numbers::pose(DMat3::from_cols_array_2d(&[x, y, z]).transpose(), centre.into()))
        }
        _ => Err(format!("{what}: rotation must be 3 rows of 3 numbers, position 3 numbers")),
    };
    Ok(CameraEntry { file, lens, mask: None, axes: PoseAxes::OpenCv, pose })
}

fn read_distortion(lens: &mut Lens, scope: &Fields, what: &str) -> Result<()> {
    let terms = lens.k.iter_mut().chain(&mut lens.p);
    for (slot, key) in terms.zip(["k1", "k2", "k3", "k4", "p1", "p2"]) {
        *slot = slot.or(number(scope, key, what)?);
    }
    if lens.model.is_none() {
        lens.model = text(scope, "camera_model", what)?;
    }
    if let Some(fisheye) = scope.get("is_fisheye") {
        lens.is_fisheye = lens.is_fisheye.or(Some(keys::says_something(fisheye)));
    }
    Ok(())
}
