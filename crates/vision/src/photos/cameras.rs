//! Camera JSON: nerfstudio / instant-ngp `transforms.json` and our own `cameras`.

use serde_json::{Map, Value};

use super::lens::Lens;
use crate::{
    error::{Error, Result},
    limits::Limits,
    photo_label as label,
    scene::UploadCameras,
};

/// Axes of the camera in an uploaded pose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum PoseAxes {
    /// x right, y up, z backwards.
    OpenGl,
    /// x right, y down, z forward.
    OpenCv,
}

/// One camera of the JSON; its numbers are checked only when its photo is there.
#[derive(Clone, Debug)]
pub(super) struct CameraEntry {
    /// Path of its photo as written.
    pub(super) file: String,
    /// Lens as written.
    pub(super) lens: Lens,
    /// Axes of `pose`.
    pub(super) axes: PoseAxes,
    pose: std::result::Result<[f64; 16], String>,
}

impl CameraEntry {
    /// Camera-to-world, row-major, as written.
    pub(super) fn pose(&self) -> Result<[f64; 16]> {
        self.pose.clone().map_err(Error::invalid)
    }
}

/// All cameras of the JSON, in its order.
pub(super) fn parse(cameras: &UploadCameras, limits: &Limits) -> Result<Vec<CameraEntry>> {
    let (part, bytes, list_key) = match cameras {
        UploadCameras::Transforms(bytes) => ("transforms", bytes, "frames"),
        UploadCameras::Cameras(bytes) => ("cameras", bytes, "cameras"),
    };
    limits.check_json(part, bytes)?;
    let top = object(bytes, part)?;
    let list = match top.get(list_key) {
        Some(Value::Array(list)) => list,
        Some(other) => {
            let kind = kind(other);
            return Err(Error::invalid(format!("{part}: `{list_key}` is {kind}, not a list")));
        }
        None => return Err(Error::invalid(format!("{part}: the list `{list_key}` is missing"))),
    };
    let transforms = matches!(cameras, UploadCameras::Transforms(_));
    let read = if transforms { transforms_frame } else { cameras_entry };
    let entry = |(i, value): (usize, &Value)| match value {
        Value::Object(fields) => read(i, fields, &top),
        other => {
            let kind = kind(other);
            Err(Error::invalid(format!("{part}: {list_key}[{i}] is {kind}, not an object")))
        }
    };
    list.iter().enumerate().map(entry).collect()
}

fn object(bytes: &[u8], part: &str) -> Result<Map<String, Value>> {
    let text = std::str::from_utf8(bytes)
        .map_err(|e| Error::invalid(format!("{part}: not UTF-8 text")).caused_by(e))?;
    let text = text.strip_prefix('\u{feff}').unwrap_or(text);
    let parsed = serde_json::from_str(text).or_else(|e| {
        // Python writes NaN and Infinity, which JSON has not: read them so that the message can
        // name the photo whose number it is.
        without_bare_nan(text).map_or(Err(e), |text| serde_json::from_str(&text))
    });
    match parsed {
        Ok(Value::Object(map)) => Ok(map),
        Ok(other) => Err(Error::invalid(format!("{part}: {}, not a JSON object", kind(&other)))),
        Err(e) => Err(Error::invalid(format!("{part}: not valid JSON ({e})"))),
    }
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

fn text(fields: &Map<String, Value>, key: &str, what: &str) -> Result<Option<String>> {
    match fields.get(key) {
        None | Some(Value::Null) => Ok(None),
        Some(Value::String(text)) => Ok(Some(text.clone())),
        Some(other) => Err(Error::invalid(format!("{what}: {key} is {}, not a text", kind(other)))),
    }
}

/// A number, NaN where it is written as such or as null; `None` where the key is absent.
fn number(fields: &Map<String, Value>, key: &str, what: &str) -> Result<Option<f64>> {
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
fn transforms_frame(
    i: usize,
    frame: &Map<String, Value>,
    top: &Map<String, Value>,
) -> Result<CameraEntry> {
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
    Ok(CameraEntry { file, lens, axes: PoseAxes::OpenGl, pose })
}

/// One entry of our own JSON.
fn cameras_entry(
    i: usize,
    entry: &Map<String, Value>,
    _top: &Map<String, Value>,
) -> Result<CameraEntry> {
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
    Ok(CameraEntry { file, lens, axes: PoseAxes::OpenCv, pose })
}

fn read_distortion(lens: &mut Lens, scope: &Map<String, Value>, what: &str) -> Result<()> {
    let terms = lens.k.iter_mut().chain(&mut lens.p);
    for (slot, key) in terms.zip(["k1", "k2", "k3", "k4", "p1", "p2"]) {
        *slot = slot.or(number(scope, key, what)?);
    }
    if lens.model.is_none() {
        lens.model = text(scope, "camera_model", what)?;
    }
    if let Some(Value::Bool(fisheye)) = scope.get("is_fisheye") {
        lens.is_fisheye = lens.is_fisheye.or(Some(*fisheye));
    }
    Ok(())
}
