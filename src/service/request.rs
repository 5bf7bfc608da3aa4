//! Requests: one set of types for the query string, JSON bodies, the command line and
//! `/openapi.json`. Their field names are the names of parameters and flags. gRPC has its own
//! messages, which `api/grpc/convert.rs` turns into these.

use std::{str::FromStr, time::Duration};

use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use utoipa::{IntoParams, ToSchema};

use crate::{
    error::{Error, Result},
    names::{display_names, named},
    render::budget::MaxError,
    scene::{Preset, Region, SceneOptions, ScoringMethod, Upload},
};

/// Everything needed to make a scene.
#[derive(Clone, Debug, Default)]
pub struct CreateScene {
    /// Photos and cameras.
    pub upload: Upload,
    /// How to make it.
    pub options: SceneOptions,
    /// Two calls with one key and the same content make one scene; other content is refused.
    pub idempotency_key: Option<String>,
    /// How long to wait for the scene before answering, capped by `limits.wait_ms_max`.
    pub wait: Option<Duration>,
    /// Id of the request, for the log and the trace of the scene's job.
    pub request_id: Option<String>,
}

/// Photos that are to join a finished scene.
#[derive(Clone, Debug, Default)]
pub struct AddPhotos {
    /// The photos and their cameras, in the scene's own frame.
    pub upload: Upload,
    /// Two calls with one key and the same photos add them once; other photos are refused.
    pub idempotency_key: Option<String>,
    /// How long to wait for the version that has them, capped by `limits.wait_ms_max`.
    pub wait: Option<Duration>,
}

/// Which page of the list.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize, IntoParams)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct PageRequest {
    /// Scenes on the page; as many as a page may have by default.
    pub limit: Option<usize>,
    /// `next` of the page before.
    pub after: Option<String>,
}

/// Which picture.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
#[schema(as = Kind)]
pub enum PictureKind {
    /// sRGB colour over the background.
    #[default]
    Color,
    /// Expected depth, world units, 0 where nothing is.
    Depth,
    /// Accumulated opacity, 0..1.
    Alpha,
    /// What edits uncovered and nothing fills, 0..1: the alpha without the edits that is not there
    /// with them. 0 where there are none.
    Holes,
    /// A fixed colour for each entry of the semantic bank, black where there is none.
    Semantics,
    /// How well each pixel fits a text, 0..1.
    Relevancy,
    /// Where the relevancy is at least 0.5.
    Mask,
}

impl PictureKind {
    /// Whether it answers a text.
    pub fn takes_text(self) -> bool {
        matches!(self, Self::Relevancy | Self::Mask)
    }

    /// Whether it needs the scene's semantics.
    pub fn needs_semantics(self) -> bool {
        self == Self::Semantics || self.takes_text()
    }
}

/// How a picture is encoded.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Format {
    /// 8-bit RGB or grey; 16-bit grey for depth.
    #[default]
    Png,
    /// 8-bit, quality 90; not for depth. Over 512 x 512 pixels colour is halved each way (4:2:0).
    #[serde(alias = "jpg")]
    Jpeg,
    /// 8-bit, lossless; not for depth.
    Webp,
    /// `NumPy` array of little-endian f32, `[H, W, 3]` or `[H, W]`, not clamped.
    Npy,
    /// Bytes without a header, `[H, W, 3]`: red, green and blue of `color`, over its background, or
    /// of `semantics`. Equal to the samples of the PNG.
    Rgb8,
    /// Bytes without a header, `[H, W, 4]`: those of `rgb8`, then alpha. For `color` alone. Colour
    /// is over its background and not divided by alpha, so over `black` it is premultiplied.
    Rgba8,
    /// Bytes without a header, `[H, W]`: `alpha`, `relevancy` or `mask`. Equal to the samples of
    /// the PNG.
    Grey8,
}

impl Format {
    /// Samples of a pixel, one byte each, of a format without a codec.
    pub fn samples(self) -> Option<u32> {
        match self {
            Self::Grey8 => Some(1),
            Self::Rgb8 => Some(3),
            Self::Rgba8 => Some(4),
            Self::Png | Self::Jpeg | Self::Webp | Self::Npy => None,
        }
    }
}

/// Which boxes hold the parts of a selection.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Boxes {
    /// Turned along the part's own axes.
    Oriented,
    /// Turned about the upright alone, as the photos tell it: the last axis is up.
    #[default]
    Upright,
    /// Along the axes of the world.
    Aligned,
    /// No parts and no boxes.
    None,
}

/// How a query's masks are given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum MaskFormat {
    /// COCO's compressed run lengths.
    #[default]
    Rle,
    /// 8-bit grey PNG, 0 or 255.
    Png,
    /// Area, box and peak alone.
    None,
}

/// What the pixels of a view are described by.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum FeatureKind {
    /// E: the entries of the bank that a pixel shows and their weights, sparse.
    #[default]
    Weights,
    /// F: `E^T B` at length 1, dense.
    Features,
}

display_names!(PictureKind, Format, Boxes, MaskFormat, FeatureKind);

/// A camera as its separate fields: one pose, at most one lens.
#[derive(
    Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema, IntoParams, clap::Args,
)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
#[command(next_help_heading = "Camera")]
pub struct CameraFields {
    /// Pose: 16 numbers, row-major, OpenCV camera to world.
    #[arg(long, value_name = "M00,...,M33", group = "pose", allow_hyphen_values = true)]
    #[arg(value_parser = numbers::<f64, 16>)]
    #[param(value_type = Option<String>)]
    pub camera_to_world: Option<[f64; 16]>,
    /// Pose: camera centre, three numbers.
    #[arg(long, value_name = "X,Y,Z", group = "pose", requires = "target")]
    #[arg(value_parser = numbers::<f64, 3>, allow_hyphen_values = true)]
    #[param(value_type = Option<String>)]
    pub eye: Option<[f64; 3]>,
    /// Pose: point looked at, three numbers; goes with `eye`.
    #[arg(long, value_name = "X,Y,Z", requires = "eye")]
    #[arg(value_parser = numbers::<f64, 3>, allow_hyphen_values = true)]
    #[param(value_type = Option<String>)]
    pub target: Option<[f64; 3]>,
    /// Pose: up in the picture, three numbers; goes with `eye`. By default as in the photos.
    #[arg(long, value_name = "X,Y,Z", requires = "eye")]
    #[arg(value_parser = numbers::<f64, 3>, allow_hyphen_values = true)]
    #[param(value_type = Option<String>)]
    pub up: Option<[f64; 3]>,
    /// Pose: index of an input camera.
    #[arg(long, visible_alias = "camera", value_name = "INDEX", group = "pose")]
    pub from: Option<usize>,
    /// Pose: index of another input camera; goes with `from`.
    #[arg(long, value_name = "INDEX", requires = "from")]
    pub to: Option<usize>,
    /// Pose: 0 at `from`, 1 at `to`.
    #[arg(long, requires = "from")]
    pub t: Option<f64>,
    /// Lens: focal length along x, pixels.
    #[arg(long)]
    pub fx: Option<f64>,
    /// Lens: focal length along y; `fx` by default.
    #[arg(long, requires = "fx")]
    pub fy: Option<f64>,
    /// Lens: principal point x; the centre by default.
    #[arg(long, requires = "fx")]
    pub cx: Option<f64>,
    /// Lens: principal point y; the centre by default.
    #[arg(long, requires = "fx")]
    pub cy: Option<f64>,
    /// Lens: vertical field of view, degrees. By default the photos' lens.
    #[arg(long, conflicts_with = "fx")]
    pub fov: Option<f64>,
}

/// Pose of a camera.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub enum PoseSpec {
    /// 16 numbers, row-major, OpenCV camera-to-world.
    CameraToWorld([f64; 16]),
    /// A camera at `eye` that looks at `target`.
    LookAt {
        /// Camera centre.
        eye: [f64; 3],
        /// Point in the middle of the picture (where the principal point is central).
        target: [f64; 3],
        /// Up in the picture; `None`: that of the input cameras, else (0, -1, 0).
        up: Option<[f64; 3]>,
    },
    /// Between two input cameras.
    Between {
        /// Index of one input camera.
        from: usize,
        /// Index of the other.
        to: usize,
        /// 0 at `from`, 1 at `to`; centre linear, rotation by slerp, lens linear.
        t: f64,
    },
}

/// Lens of a camera.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub enum LensSpec {
    /// Pixels of the requested picture. Without `cx`, `cy` the principal point is central.
    Focal {
        /// Focal length along x, pixels.
        fx: f64,
        /// Focal length along y, pixels; `None`: `fx`.
        fy: Option<f64>,
        /// Principal point x, pixels; `None`: half the width.
        cx: Option<f64>,
        /// Principal point y, pixels; `None`: half the height.
        cy: Option<f64>,
    },
    /// Vertical field of view in degrees, square pixels, central principal point.
    Fov(f64),
    /// That of the input camera (of the first one, or of `from` and `to`), fitted to the size.
    #[default]
    OfScene,
}

/// A camera of a request: [`CameraFields`] whose fields go together.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct CameraSpec {
    /// Pose.
    pub pose: PoseSpec,
    /// Lens.
    pub lens: LensSpec,
}

impl TryFrom<CameraFields> for CameraSpec {
    type Error = Error;

    fn try_from(fields: CameraFields) -> Result<Self> {
        Ok(Self { pose: fields.pose()?, lens: fields.lens()? })
    }
}

impl CameraFields {
    /// Whether any field of a pose is given.
    pub fn has_pose(&self) -> bool {
        self.camera_to_world.is_some() || self.has_look() || self.has_between()
    }

    fn has_look(&self) -> bool {
        self.eye.is_some() || self.target.is_some() || self.up.is_some()
    }

    fn has_between(&self) -> bool {
        self.from.is_some() || self.to.is_some() || self.t.is_some()
    }

    fn pose(&self) -> Result<PoseSpec> {
        let wrong = |why: &str| Err(Error::invalid(why));
        match (self.camera_to_world, self.has_look(), self.has_between()) {
            (None, false, false) => {
                wrong("no pose given; give camera_to_world, or eye and target, or from")
            }
            (Some(matrix), false, false) => Ok(PoseSpec::CameraToWorld(matrix)),
            (None, true, false) => match (self.eye, self.target) {
                (Some(eye), Some(target)) => Ok(PoseSpec::LookAt { eye, target, up: self.up }),
                _ => wrong("eye and target go together"),
            },
            (None, false, true) => {
                let Some(from) = self.from else { return wrong("to and t need from") };
                let (to, t) = (self.to.unwrap_or(from), self.t.unwrap_or(0.0));
                Ok(PoseSpec::Between { from, to, t })
            }
            _ => wrong("give one of camera_to_world, eye and target, from and to; not several"),
        }
    }

    fn lens(&self) -> Result<LensSpec> {
        match (self.fx, self.fov) {
            (Some(_), Some(_)) => Err(Error::invalid("give fx or fov, not both")),
            (Some(fx), None) => Ok(LensSpec::Focal { fx, fy: self.fy, cx: self.cx, cy: self.cy }),
            (None, _) if self.fy.is_some() || self.cx.is_some() || self.cy.is_some() => {
                Err(Error::invalid("fy, cx and cy need fx"))
            }
            (None, Some(fov)) => Ok(LensSpec::Fov(fov)),
            (None, None) => Ok(LensSpec::OfScene),
        }
    }
}

/// How a camera's view is rendered; the same for all views of one request.
#[derive(
    Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema, IntoParams, clap::Args,
)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ViewOptions {
    /// Width, pixels. By default from the height and the photos' shape, else at most 384.
    #[arg(long)]
    pub width: Option<u32>,
    /// Height, pixels. By default as the width.
    #[arg(long)]
    pub height: Option<u32>,
    /// Antialiased: opacity compensated for the blur of small Gaussians (gsplat's mode). By default
    /// as the scene's file of Gaussians says, else not.
    #[arg(long, num_args = 0..=1, require_equals = true, default_missing_value = "true")]
    pub antialiased: Option<bool>,
    /// Near plane, world units. By default 0.01 of the scene's median depth.
    #[arg(long)]
    pub near: Option<f32>,
    /// Largest difference to the exact picture, levels of 255, that is accepted for less time: 0 to
    /// 32, `exact` (0, default) or `fast` (2). Views with depth are exact. Its old name is
    /// `quality`.
    #[arg(long, alias = "quality", default_value = "exact", value_name = "LEVELS")]
    #[serde(alias = "quality")]
    #[param(value_type = String)]
    #[schema(value_type = serde_json::Value)]
    pub error: MaxError,
    /// Permission to draw one merged Gaussian for many that are far away, pixels: how far one may
    /// be from the one that stands for it, 0 (default: none is merged) to 16. `error` does not
    /// count what they change. Scenes of 262,144 Gaussians and more have some.
    #[arg(long, default_value_t = 0.0, value_name = "PIXELS")]
    pub detail: f32,
    /// How it is drawn and texts are scored: `default` or `paper`. By default as the scene was
    /// made.
    #[arg(long, value_parser = named::<Preset>)]
    #[param(inline)]
    pub preset: Option<Preset>,
    /// Photos whose Gaussians are in front, the nearest ones; 0: those of all. By default that of
    /// the preset.
    #[arg(long)]
    pub front_photos: Option<u32>,
    /// Whether magnified Gaussians are blurred as the network learnt them. By default that of the
    /// preset.
    #[arg(long)]
    pub magnify: Option<bool>,
    /// The caller's own deadline; never over `limits.render_timeout_ms`.
    #[arg(skip)]
    #[serde(skip)]
    pub deadline: Option<Duration>,
}

/// Changes of how texts are scored; what is left out is that of the preset.
#[derive(
    Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema, IntoParams, clap::Args,
)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct ScoringOptions {
    /// Canonical texts that a text is compared with; may be given many times.
    #[arg(long, value_name = "TEXT")]
    pub canon: Vec<String>,
    /// Sharpness of the comparison.
    #[arg(long)]
    pub tau: Option<f64>,
    /// Relevancy from which a text selects, 0 to 1.
    #[arg(long)]
    pub cut: Option<f64>,
    /// Whether the bank's rows are brought to length 1 before they are blended.
    #[arg(long)]
    pub unit_rows: Option<bool>,
    /// Coverage under which a pixel has no relevancy, 0 to 1.
    #[arg(long)]
    pub coverage_floor: Option<f64>,
    /// An entry that fits a text by so much less than the best one (cosine, 0 to 2) is not
    /// selected.
    #[arg(long)]
    pub near_best: Option<f64>,
    /// Difference of cosines to the canonical texts at which the relevancy is 0.5, -2 to 2.
    #[arg(long)]
    pub margin: Option<f64>,
    /// Share of the bundle's list of words that may fit an entry better than the text, 0 to 1; 1:
    /// the list does not count.
    #[arg(long)]
    pub rivals: Option<f64>,
}

impl ScoringOptions {
    /// The method `of` a preset with these changes.
    pub fn change(&self, of: ScoringMethod) -> ScoringMethod {
        ScoringMethod {
            canon: if self.canon.is_empty() { of.canon } else { self.canon.clone() },
            tau: self.tau.unwrap_or(of.tau),
            cut: self.cut.unwrap_or(of.cut),
            unit_rows: self.unit_rows.unwrap_or(of.unit_rows),
            coverage_floor: self.coverage_floor.unwrap_or(of.coverage_floor),
            near_best: self.near_best.unwrap_or(of.near_best),
            margin: self.margin.unwrap_or(of.margin),
            rivals: self.rivals.unwrap_or(of.rivals),
        }
    }
}

/// What a picture looks like as a file.
#[derive(
    Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema, IntoParams, clap::Args,
)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct PictureOptions {
    /// `png` (default), `jpeg`, `webp`, `npy`, or samples without a codec: `rgb8`, `rgba8` or
    /// `grey8`. For one view `Accept` decides where it is absent.
    #[arg(skip)]
    #[param(inline)]
    pub format: Format,
    /// `backdrop` (default: the photos' colours by direction), `black`, `white`, `#rrggbb` or
    /// three numbers of 0..1.
    #[arg(long, default_value = "backdrop", value_name = "COLOR", hide_default_value = true)]
    #[param(value_type = String)]
    #[schema(value_type = serde_json::Value)]
    pub background: BackgroundSpec,
    /// The part of the picture that is drawn: first column, first row, width and height in pixels
    /// of the whole, four whole numbers.
    #[arg(long, value_name = "X,Y,WIDTH,HEIGHT", value_parser = region)]
    #[param(value_type = Option<String>)]
    #[schema(value_type = Option<[u32; 4]>)]
    pub crop: Option<Region>,
}

/// A text and how it is scored.
#[derive(
    Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema, IntoParams, clap::Args,
)]
#[serde(default, deny_unknown_fields)]
#[into_params(parameter_in = Query)]
pub struct TextOptions {
    /// What to look for: for `relevancy`, `mask`, and an export of what the text selects.
    #[arg(long)]
    pub text: Option<String>,
    /// How it is scored.
    #[command(flatten)]
    #[serde(flatten, skip_deserializing)]
    #[param(ignore)]
    pub scoring: ScoringOptions,
    /// Milliseconds to wait for semantics that are being made; 0 answers `scene_not_ready` at once.
    #[arg(skip)]
    #[serde(rename = "wait_ms", with = "millis")]
    #[param(value_type = Option<u64>)]
    #[schema(value_type = Option<u64>)]
    pub wait: Option<Duration>,
}

/// One view.
#[derive(Clone, Debug, PartialEq)]
pub struct ViewSpec {
    /// Camera.
    pub camera: CameraSpec,
    /// Picture.
    pub kind: PictureKind,
    /// How it is rendered.
    pub options: ViewOptions,
    /// How it is encoded.
    pub picture: PictureOptions,
    /// Its text.
    pub text: TextOptions,
}

impl ViewSpec {
    /// A view without a text, as a PNG.
    #[must_use]
    pub fn new(camera: CameraSpec, kind: PictureKind, options: ViewOptions) -> Self {
        let (picture, text) = (PictureOptions::default(), TextOptions::default());
        Self { camera, kind, options, picture, text }
    }
}

impl From<ViewSpec> for ViewsSpec {
    fn from(ViewSpec { camera, kind, options, picture, text }: ViewSpec) -> Self {
        Self { cameras: vec![camera], kinds: vec![kind], options, picture, text }
    }
}

/// Many cameras and kinds; each camera is rendered once for all kinds.
#[derive(Clone, Debug, PartialEq, Serialize, ToSchema)]
pub struct ViewsSpec {
    /// Cameras.
    #[schema(value_type = Vec<CameraFields>)]
    pub cameras: Vec<CameraSpec>,
    /// Pictures of each camera; colour by default.
    #[serde(default)]
    pub kinds: Vec<PictureKind>,
    /// How they are rendered.
    #[serde(flatten)]
    pub options: ViewOptions,
    /// How they are encoded.
    #[serde(flatten)]
    pub picture: PictureOptions,
    /// Its text.
    #[serde(flatten)]
    pub text: TextOptions,
}

/// Many texts for a scene, in 3D and, with a camera, in one view.
#[derive(Clone, Debug, Default, PartialEq, Serialize, ToSchema)]
#[serde(default)]
#[schema(as = QueryBody)]
pub struct QuerySpec {
    /// 1 to 128 texts of 1 to 256 characters.
    #[schema(required = true)]
    pub texts: Vec<String>,
    /// View to answer in; without it the answer is 3D alone.
    #[schema(value_type = Option<CameraFields>)]
    pub camera: Option<CameraSpec>,
    /// How that view is rendered.
    #[serde(flatten)]
    pub options: ViewOptions,
    /// Boxes of the parts.
    pub boxes: Boxes,
    /// Masks of the view.
    pub mask: MaskFormat,
    /// Whether the view's relevancy is given too, as an 8-bit grey PNG.
    pub relevancy: bool,
    /// How texts are scored.
    #[serde(flatten)]
    pub scoring: ScoringOptions,
    /// Milliseconds to wait for semantics that are being made; 0 answers `scene_not_ready` at once.
    #[serde(rename = "wait_ms", with = "millis")]
    #[schema(value_type = Option<u64>)]
    pub wait: Option<Duration>,
}

/// What lies under a pixel of a view.
#[derive(Clone, Debug, PartialEq)]
pub struct PickSpec {
    /// Camera.
    pub camera: CameraSpec,
    /// Across, pixels of the picture; the first pixel is 0 to 1.
    pub x: f64,
    /// Down, pixels.
    pub y: f64,
    /// Size and the rest of the view.
    pub options: ViewOptions,
    /// Texts to name the entry with; without them it needs no semantics.
    pub labels: Vec<String>,
    /// How labels are scored.
    pub scoring: ScoringOptions,
    /// How long to wait for semantics that are being made; `None`: `limits.text_wait_ms`.
    pub wait: Option<Duration>,
}

/// The pixels of a view over the bank.
#[derive(Clone, Debug, PartialEq)]
pub struct FeaturesSpec {
    /// Camera.
    pub camera: CameraSpec,
    /// Size and the rest of the view.
    pub options: ViewOptions,
    /// E or F.
    pub kind: FeatureKind,
    /// How the rows of F are blended; texts do not matter.
    pub scoring: ScoringOptions,
    /// How long to wait for semantics that are being made; `None`: `limits.text_wait_ms`.
    pub wait: Option<Duration>,
}

/// What is behind the Gaussians.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum BackgroundSpec {
    /// The photos' colours by direction.
    #[default]
    Backdrop,
    /// One colour, 0..1.
    Color([f32; 3]),
}

impl BackgroundSpec {
    /// The one colour, where it is one.
    pub fn color(self) -> Option<[f32; 3]> {
        match self {
            Self::Backdrop => None,
            Self::Color(color) => Some(color),
        }
    }
}

/// What a background must be, for messages.
const BACKGROUNDS: &str = "backdrop, black, white, #rrggbb or three numbers of 0..1";

impl FromStr for BackgroundSpec {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("it must be {BACKGROUNDS}");
        match text {
            "backdrop" => return Ok(Self::Backdrop),
            "black" => return Ok(Self::Color([0.0; 3])),
            "white" => return Ok(Self::Color([1.0; 3])),
            _ => {}
        }
        let Some(hex) = text.strip_prefix('#') else {
            return numbers(text).map(Self::Color).map_err(|_| wrong());
        };
        let digits = hex.len() == 6 && hex.bytes().all(|b| b.is_ascii_hexdigit());
        let value = u32::from_str_radix(hex, 16).ok().filter(|_| digits);
        let [_, bytes @ ..] = value.ok_or_else(wrong)?.to_be_bytes();
        Ok(Self::Color(bytes.map(|byte| f32::from(byte) / 255.0)))
    }
}

impl Serialize for BackgroundSpec {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Backdrop => to.serialize_str("backdrop"),
            Self::Color(color) => color.serialize(to),
        }
    }
}

impl<'de> Deserialize<'de> for BackgroundSpec {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Visitor;
        impl<'de> de::Visitor<'de> for Visitor {
            type Value = BackgroundSpec;

            fn expecting(&self, to: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
                to.write_str(BACKGROUNDS)
            }

            fn visit_str<E: de::Error>(self, text: &str) -> Result<BackgroundSpec, E> {
                text.parse().map_err(E::custom)
            }

            fn visit_seq<A: de::SeqAccess<'de>>(self, list: A) -> Result<BackgroundSpec, A::Error> {
                let color = <[f32; 3]>::deserialize(de::value::SeqAccessDeserializer::new(list))?;
                Ok(BackgroundSpec::Color(color))
            }
        }
        from.deserialize_any(Visitor)
    }
}

/// Exactly `N` numbers, separated by commas.
pub(crate) fn numbers<T: FromStr + Copy + Default, const N: usize>(
    text: &str,
) -> Result<[T; N], String> {
    let count = text.split(',').count();
    if count != N {
        return Err(format!("{count} numbers, not {N}"));
    }
    let mut all = [T::default(); N];
    for (number, part) in all.iter_mut().zip(text.split(',')) {
        *number = part.trim().parse().map_err(|_| format!("{part:?} is not a number"))?;
    }
    Ok(all)
}

fn region(text: &str) -> Result<Region, String> {
    numbers(text).map(Region::from)
}

/// A time as a whole number of milliseconds.
mod millis {
    use super::{Deserialize, Deserializer, Duration, Serialize, Serializer};

    #[expect(clippy::ref_option, reason = "serde calls it so")]
    pub(super) fn serialize<S: Serializer>(
        time: &Option<Duration>,
        to: S,
    ) -> Result<S::Ok, S::Error> {
        time.map(|time| u64::try_from(time.as_millis()).unwrap_or(u64::MAX)).serialize(to)
    }

    pub(super) fn deserialize<'de, D: Deserializer<'de>>(
        from: D,
    ) -> Result<Option<Duration>, D::Error> {
        Ok(Option::<u64>::deserialize(from)?.map(Duration::from_millis))
    }
}
