//! `Record3D`: the JSON file `metadata` and `rgb/0.jpg`, `rgb/1.jpg`, … in its "EXR + RGB" export,
//! `rgbd/0.jpg` beside `0.depth` and `0.conf` in its own `.r3d` file, which is a zip.
//!
//! `poses[i]` is camera-to-world of photo i: a quaternion x y z w and a translation, camera x
//! right, y up, z backwards. `K` is column by column, for `w` x `h` pixels;
//! `perFrameIntrinsicCoeffs[i]` of newer versions is fx, fy, cx, cy of photo i. Photo i has the
//! number i in its name. Source: nerfstudio's `process_data/record3d_utils.py`, which leaves cx and
//! cy out; here they count.

use serde_json::Value;

use crate::{
    captures::layout::{
        CameraEntry, Described, Folder, Layout, PoseAxes, names, number, object, pinhole, pose,
        rotation,
    },
    error::{Error, Result},
    scene::LengthUnit,
};

pub(super) struct Record3d;

/// Folders of photos beside the metadata.
const FOLDERS: [&str; 2] = ["rgb", "rgbd"];

/// The photos that belong to the metadata in `root`.
fn photos<'a>(folder: &'a Folder<'_>, root: &'a str) -> impl Iterator<Item = &'a str> {
    let dirs = FOLDERS.map(|name| names::join(root, name));
    folder
        .paths()
        .filter(move |path| names::is_photo(path) && dirs.iter().any(|d| names::folder(path) == *d))
}

/// The first `N` numbers of a list, NaN where one is no number.
fn list<const N: usize>(value: Option<&Value>) -> Option<[f64; N]> {
    let list = value?.as_array().filter(|list| list.len() >= N)?;
    Some(std::array::from_fn(|i| list[i].as_f64().unwrap_or(f64::NAN)))
}

impl Layout for Record3d {
    fn name(&self) -> &'static str {
        "Record3D"
    }

    fn unit(&self) -> LengthUnit {
        LengthUnit::Metre
    }

    fn find(&self, folder: &Folder<'_>) -> Vec<String> {
        let is_metadata = |path: &&str| {
            matches!(names::file_name(path), "metadata" | "metadata.json")
                && photos(folder, names::folder(path)).next().is_some()
        };
        folder.paths().filter(is_metadata).map(str::to_owned).collect()
    }

    fn read(&self, folder: &Folder<'_>, at: &str) -> Result<Described> {
        let json = object(&folder.read_json(at)?, at)?;
        let size = number(&json, "w", at)?.zip(number(&json, "h", at)?);
        let size = size.map(|(width, height)| [width, height]);
        let shared = list::<9>(json.get("K")).map(|k| [k[0], k[4], k[6], k[7]]);
        let missing = |what: &str| Error::invalid(format!("{at}: {what}"));
        let poses = json.get("poses").and_then(Value::as_array);
        let poses = poses.ok_or_else(|| missing("the list `poses` is missing"))?;
        let own = json.get("perFrameIntrinsicCoeffs");
        let root = names::folder(at);
        let mut photos: Vec<(usize, &str)> = photos(folder, root)
            .filter_map(|path| {
                let stem = names::stem(names::file_name(path))?;
                Some((stem.parse().ok()?, path))
            })
            .collect();
        photos.sort_unstable();
        let mut entries = Vec::new();
        for (i, path) in photos {
            let file = path.strip_prefix(root).unwrap_or(path).trim_start_matches('/').to_owned();
            let Some(written) = poses.get(i) else { continue };
            let [x, y, z, w, tx, ty, tz] = list::<7>(Some(written))
                .ok_or_else(|| missing(&format!("poses[{i}] must be 7 numbers")))?;
            let focal = list::<4>(own.and_then(|own| own.get(i))).or(shared);
            let focal = focal.ok_or_else(|| missing("`K` must be 9 numbers"))?;
            let pose = pose(rotation([w, x, y, z]), [tx, ty, tz].into());
            entries.push(CameraEntry::new(file, pinhole(focal, size), PoseAxes::OpenGl, pose));
        }
        Ok(Described::new(root, entries))
    }
}
