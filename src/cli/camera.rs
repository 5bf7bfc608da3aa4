//! A camera on the command line, the same for `render` and `query`.

use crate::{
    error::{Error, Result},
    service::{CameraFields, CameraSpec},
};

/// The camera of these flags, `None` where no pose is given. With `--from` and `--to`, `--t` is 0.5
/// by default.
pub(super) fn spec(fields: &CameraFields) -> Result<Option<CameraSpec>> {
    if !fields.has_pose() {
        return Ok(None);
    }
    let t = fields.t.or(fields.to.map(|_| 0.5));
    CameraFields { t, ..fields.clone() }.try_into().map(Some)
}

/// The error of a command line without a pose.
pub(super) fn no_camera() -> Error {
    Error::invalid(
        "no camera: give --from, --from and --to, --eye and --target, or --camera-to-world",
    )
}
