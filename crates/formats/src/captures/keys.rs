//! Keys of camera JSONs that change what the numbers beside them mean, and that no reader reads.
//!
//! Names are those of instant-ngp (`src/nerf_loader.cu`), nerfstudio and what is made after them; a
//! word in a name is enough, so that a key of a newer program is not passed over in silence.

use serde_json::{Map, Value};

use crate::error::{Error, Result};

/// Words of keys that say that the pictures are not those of a lens with one axis.
const NOT_FLAT: [&str; 12] = [
    "latlong",
    "equirect",
    "spheric",
    "panoram",
    "ftheta",
    "f_theta",
    "omni",
    "orthograph",
    "orthophoto",
    "cubemap",
    "cylind",
    "vr180",
];
/// Keys that turn the axes of poses.
const OTHER_AXES: [&str; 2] = ["from_mitsuba", "from_na"];
/// Words of other keys that change lens, pose or which pixels count.
const CHANGING: [&str; 17] = [
    "fisheye",
    "distort",
    "lens",
    "skew",
    "shutter",
    "crop",
    "transparent",
    "premult",
    "flip",
    "mirror",
    "convention",
    "coordinate",
    "axes",
    "axis",
    "transform_matrix_",
    "projection",
    "camera_type",
];
/// Whole names of such keys.
const CHANGING_NAMES: [&str; 9] = ["k5", "k6", "b1", "b2", "s1", "s2", "s3", "s4", "time"];
/// Keys with these words that are read or change nothing here.
const HARMLESS: [&str; 3] = ["is_fisheye", "mask_path", "transform_matrix"];
/// Values that say what is meant here anyway.
const USUAL: [&str; 4] = ["perspective", "pinhole", "opengl", "none"];

/// Whether a value is more than an absent one.
pub(super) fn says_something(value: &Value) -> bool {
    match value {
        Value::Null => false,
        Value::Bool(value) => *value,
        Value::Number(value) => value.as_f64() != Some(0.0),
        Value::String(value) => {
            let value = value.to_lowercase();
            !value.is_empty() && !USUAL.iter().any(|usual| value.starts_with(usual))
        }
        Value::Array(all) => all.iter().any(says_something),
        Value::Object(all) => all.values().any(says_something),
    }
}

/// Refuses pictures that are not flat, and poses in other axes.
///
/// # Errors
/// `invalid_request`, which names the key.
pub(super) fn check(fields: &Map<String, Value>, what: &str) -> Result<()> {
    for (key, value) in fields.iter().filter(|(_, value)| says_something(value)) {
        let name = key.to_lowercase();
        let text = value.as_str().unwrap_or_default().to_lowercase();
        let of_value = matches!(&*name, "camera_type" | "projection" | "projection_type");
        let is = |word: &&str| name.contains(*word) || of_value && text.contains(*word);
        if NOT_FLAT.iter().any(is) {
            let shown: String = value.to_string().chars().take(40).collect();
            return Err(Error::invalid(format!(
                "{what}: {key} is {shown}: such pictures are not flat, and only pictures of \
                 perspective and fisheye lenses are read; cut flat views out of them"
            )));
        }
        if OTHER_AXES.contains(&&*name) {
            return Err(Error::invalid(format!(
                "{what}: {key} says that poses have other axes than those of OpenGL, which is not \
                 read; write them as x right, y up, z backwards"
            )));
        }
    }
    Ok(())
}

/// The keys that change what is meant and are not read.
pub(super) fn unread(fields: &Map<String, Value>) -> impl Iterator<Item = String> {
    let changes = |name: &str| {
        CHANGING_NAMES.contains(&name) || CHANGING.iter().any(|word| name.contains(word))
    };
    let known = |name: &str| HARMLESS.contains(&name);
    let keys = fields.iter().filter(|(_, value)| says_something(value));
    let keys = keys.map(|(key, _)| key.chars().take(40).collect::<String>());
    keys.filter(move |key| {
        let name = key.to_lowercase();
        changes(&name) && !known(&name)
    })
}

#[cfg(test)]
mod tests {
    use serde_json::json;

    use super::*;

    #[test]
    fn keys_that_change_the_meaning_are_found_by_their_words() {
        let fields = |value: Value| value.as_object().cloned().unwrap_or_default();
        for refused in [
            json!({"latlong": true}),
            json!({"equirectangular": 1}),
            json!({"ftheta_p2": 0.7}),
            json!({"orthographic": true}),
            json!({"camera_type": "equirectangular"}),
            json!({"from_mitsuba": true}),
        ] {
            let key = refused.as_object().unwrap().keys().next().unwrap().clone();
            let error = check(&fields(refused), "here").unwrap_err();
            assert!(error.message().contains(&key), "{error}");
        }
        let harmless = json!({
            "latlong": false, "ftheta_p0": 0, "from_na": false, "is_fisheye": true, "sharpness": 9,
            "applied_transform": [[1, 0, 0, 0]], "mask_path": "a.png", "aabb_scale": 16, "scale": 1,
            "rolling_shutter": [0, 0, 0], "camera_type": "perspective", "orientation_override": 1,
            "ply_file_path": "a.ply", "colmap_im_id": 4, "time": 0.0, "offset": [1, 2, 3],
        });
        assert!(check(&fields(harmless.clone()), "here").is_ok());
        assert_eq!(unread(&fields(harmless)).collect::<Vec<_>>(), [""; 0]);
        let changing = json!({
            "fisheye_crop_radius": 90, "k5": 0.1, "rolling_shutter": [0, 0, 0.03],
            "white_transparent": true, "camera_convention": "opencv",
        });
        assert_eq!(unread(&fields(changing.clone())).count(), 5);
        assert!(check(&fields(changing), "here").is_ok());
    }
}
