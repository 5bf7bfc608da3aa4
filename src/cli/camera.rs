//! A camera on the command line, the same for `render` and `query`.

use crate::{
    error::{Error, Result},
    service::{CameraSpec, LensSpec, PoseSpec, Quality, ViewOptions},
};

#[derive(Clone, Debug, clap::Args)]
pub(super) struct CameraArgs {
    /// Stand where this input camera stood (its index)
    #[arg(long, value_name = "INDEX", group = "pose")]
    camera: Option<usize>,
    /// Stand between this input camera ...
    #[arg(long, value_name = "INDEX", group = "pose")]
    from: Option<usize>,
    /// ... and this one
    #[arg(long, value_name = "INDEX", requires = "from")]
    to: Option<usize>,
    /// 0 at `from`, 1 at `to`
    #[arg(long, default_value_t = 0.5)]
    t: f64,
    /// Stand here: x,y,z in the world of the photos
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', group = "pose", requires = "target")]
    eye: Option<Vec<f64>>,
    /// Look at this point
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', requires = "eye")]
    target: Option<Vec<f64>>,
    /// Up in the picture [default: as in the photos]
    #[arg(long, value_name = "X,Y,Z", value_delimiter = ',', requires = "eye")]
    up: Option<Vec<f64>>,
    /// 16 numbers, row-major, OpenCV camera-to-world
    #[arg(long, value_name = "M00,...,M33", value_delimiter = ',', group = "pose")]
    camera_to_world: Option<Vec<f64>>,
    /// Vertical field of view in degrees [default: the photos' lens]
    #[arg(long, conflicts_with = "fx")]
    fov: Option<f64>,
    /// Focal length along x in pixels of the picture
    #[arg(long)]
    fx: Option<f64>,
    /// Focal length along y [default: fx]
    #[arg(long, requires = "fx")]
    fy: Option<f64>,
    /// Principal point x [default: the middle]
    #[arg(long, requires = "fx")]
    cx: Option<f64>,
    /// Principal point y [default: the middle]
    #[arg(long, requires = "fx")]
    cy: Option<f64>,
    /// Width in pixels [default: the photos' shape, longer side at most 384]
    #[arg(long)]
    width: Option<u32>,
    /// Height in pixels [default: the photos' shape]
    #[arg(long)]
    height: Option<u32>,
    /// Antialiased: opacity compensated for the blur of small Gaussians
    #[arg(long)]
    antialiased: bool,
    /// Near plane in world units [default: 0.01 of the scene's median depth]
    #[arg(long)]
    near: Option<f32>,
    /// exact, or fast within a stated error
    #[arg(long, default_value = "exact", value_parser = quality)]
    quality: Quality,
}

/// A quality by its name.
pub(super) fn quality(name: &str) -> Result<Quality, String> {
    Quality::named(name).ok_or_else(|| Quality::ALL.map(Quality::name).join(", "))
}

impl CameraArgs {
    /// The camera, `None` where no pose was given.
    pub(super) fn spec(&self) -> Result<Option<CameraSpec>> {
        let pose = if let Some(index) = self.camera {
            PoseSpec::Between { from: index, to: index, t: 0.0 }
        } else if let Some(from) = self.from {
            PoseSpec::Between { from, to: self.to.unwrap_or(from), t: self.t }
        } else if let (Some(eye), Some(target)) = (&self.eye, &self.target) {
            PoseSpec::LookAt {
                eye: numbers(eye, "--eye")?,
                target: numbers(target, "--target")?,
                up: self.up.as_ref().map(|up| numbers(up, "--up")).transpose()?,
            }
        } else if let Some(matrix) = &self.camera_to_world {
            PoseSpec::CameraToWorld(numbers(matrix, "--camera-to-world")?)
        } else {
            return Ok(None);
        };
        let lens = match (self.fx, self.fov) {
            (Some(fx), _) => LensSpec::Focal { fx, fy: self.fy, cx: self.cx, cy: self.cy },
            (None, Some(fov)) => LensSpec::Fov(fov),
            (None, None) => LensSpec::OfScene,
        };
        Ok(Some(CameraSpec { pose, lens }))
    }

    /// Size and the rest of the view.
    pub(super) fn options(&self) -> ViewOptions {
        ViewOptions {
            width: self.width,
            height: self.height,
            antialiased: self.antialiased,
            near: self.near,
            quality: self.quality,
            ..ViewOptions::default()
        }
    }
}

/// Nothing says where to stand.
pub(super) fn no_camera() -> Error {
    Error::invalid(
        "no camera: give --camera, --from and --to, --eye and --target, or --camera-to-world",
    )
}

/// A list of exactly `N` numbers.
pub(super) fn numbers<T: Copy, const N: usize>(given: &[T], name: &str) -> Result<[T; N]> {
    <[T; N]>::try_from(given)
        .map_err(|_count| Error::invalid(format!("{name} has {} numbers, not {N}", given.len())))
}
