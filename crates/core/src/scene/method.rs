//! How a scene is made, understood, looked at and asked: every choice as a field of its own.
//!
//! A [`Preset`] fills all fields, and options change single ones. A stage reads its own field and
//! knows no preset. `docs/method.md` lists the fields beside what the paper does.

use serde::{Deserialize, Serialize, de::DeserializeOwned};
use utoipa::{IntoParams, ToSchema};

use crate::{
    error::{Error, Result},
    limits::{BANK_ROWS_MAX, CANON_MAX, LAMBDA_RANGE, SCENE_PHOTOS_MAX, TAU_RANGE},
    names::display_names,
    scene::{CameraUse, CamerasMode, Refine},
};

/// When the semantics of a scene are made.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SemanticsMode {
    /// At the first call that needs them.
    #[default]
    Lazy,
    /// As soon as the scene can be viewed.
    Eager,
    /// Never.
    Off,
}

/// How many of a network's Gaussians a scene keeps.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Density {
    /// One for up to 16 neighbours where the pictures are flat: same views within a stated error.
    #[default]
    Thinned,
    /// One a pixel.
    Full,
}

/// A set of values for every choice.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum Preset {
    /// What measured best.
    #[default]
    Default,
    /// What the paper (arXiv 2511.18386) does.
    Paper,
}

/// Which of the masks that a network gives for a prompt is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum MaskLevel {
    /// The most whole one that passes the filters.
    #[default]
    Widest,
    /// The whole, or none.
    Whole,
    /// The part, or none.
    Part,
    /// The part of a part, or none.
    Subpart,
}

display_names!(SemanticsMode, Density, Preset, MaskLevel);

impl MaskLevel {
    /// Its place among `levels` masks, which go from parts to the whole; `None`: the most whole
    /// one that passes. A network with fewer levels gives the nearest that it has.
    pub fn place(self, levels: usize) -> Option<usize> {
        match self {
            Self::Widest => None,
            Self::Whole => Some(levels.saturating_sub(1)),
            Self::Part => Some(levels.saturating_sub(2)),
            Self::Subpart => Some(levels.saturating_sub(3)),
        }
    }
}

/// Declares [`Method`], and [`SceneOptions`] with the same fields as options: name, type, value of
/// `default`, value of `paper`.
macro_rules! method {
    ($(
        $(#[doc = $doc:literal])+
        $([$param:meta])?
        $name:ident: $type:ty = $default:expr, $paper:expr;
    )+) => {
        /// How a scene is made, understood and shown, spelt out. It is stored with the scene.
        #[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
        #[serde(default)]
        pub struct Method {
            /// The preset that the other fields started from. Texts are scored by it, too.
            pub preset: Preset,
            $($(#[doc = $doc])+ pub $name: $type,)+
        }

        impl Method {
            /// The values of a preset.
            pub fn of(preset: Preset) -> Self {
                match preset {
                    Preset::Default => Self { preset, $($name: $default,)+ },
                    Preset::Paper => Self { preset, $($name: $paper,)+ },
                }
            }
        }

        /// Options of a scene, kept with it.
        #[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, IntoParams)]
        #[serde(default, deny_unknown_fields)]
        #[into_params(parameter_in = Query)]
        pub struct SceneOptions {
            /// Views the network takes at once, 4 by default where the bundle takes as many.
            pub max_views: Option<usize>,
            /// Whether the cameras of the upload are used: `auto` (default) those that it has,
            /// solved where it has none; `solve` computes them from the photos in any case.
            #[param(inline)]
            pub cameras: CamerasMode,
            /// When a scene's semantics are made: `lazy` (default) with the first text, `eager` as
            /// soon as it can be viewed, `off` never.
            #[param(inline)]
            pub semantics: SemanticsMode,
            /// Whether the finished scene is refined: `auto`, `off`, or so many milliseconds. By
            /// default as the server is set.
            #[serde(skip_serializing_if = "Option::is_none")]
            #[param(value_type = Option<String>)]
            pub refine: Option<Refine>,
            /// Words whose things take no part in the scene, as `person`; may be given several
            /// times. What is found of them in the photos is left out, as by a mask.
            #[serde(skip_serializing_if = "Vec::is_empty")]
            pub ignore: Vec<String>,
            /// `default`, or `paper`: the method of the paper. The options below change single
            /// fields of it.
            #[param(inline)]
            pub preset: Preset,
            $(
                $(#[doc = $doc])+
                #[serde(skip_serializing_if = "Option::is_none")]
                $(#[$param])?
                pub $name: Option<$type>,
            )+
        }

        impl SceneOptions {
            /// Names of all options.
            pub const NAMES: &[&str] =
                &["max_views", "cameras", "semantics", "refine", "ignore", "preset",
                    $(stringify!($name),)+];

            /// The method that these options spell.
            pub fn method(&self) -> Method {
                let of = Method::of(self.preset);
                Method { preset: of.preset, $($name: self.$name.unwrap_or(of.$name),)+ }
            }
        }
    };
}

method! {
    /// Whether Gaussians that add nothing are dropped: without a source pixel, nearly transparent,
    /// far out of reach.
    prune: bool = true, false;
    /// Photos that may keep Gaussians of one surface; 0 keeps those of all.
    fuse_layers: u32 = 4, 0;
    /// Gaussians kept: `thinned`, one for up to 16 neighbours where the photos are flat, or `full`,
    /// one a pixel.
    [param(inline)]
    density: Density = Density::Thinned, Density::Full;
    /// Whether views have the photos' colours by direction behind them; black otherwise.
    backdrop: bool = true, false;
    /// Masks of a prompt: `widest` that passes, or only the `whole`, the `part`, the `subpart`.
    [param(inline)]
    mask_level: MaskLevel = MaskLevel::Widest, MaskLevel::Whole;
    /// Whether prompts are skipped where a mask lies already.
    skip_covered: bool = true, false;
    /// Whether a photo is asked first where masks of earlier photos reappear.
    seeds: bool = true, false;
    /// Whether masks are judged at the photo's own pixels, and not on the decoder's grid.
    full_resolution: bool = false, true;
    /// Whether masks are also held to each other's pixels (NMS) and to bounds on their area, and
    /// the surest has a pixel, and not only to Segment Anything's own filters.
    mask_filters: bool = true, false;
    /// Whether the crop of a mask shows all of it, also where another mask lies on it.
    crop_whole: bool = false, true;
    /// Whether the crop of a mask has the bundle's margin.
    crop_margin: bool = true, false;
    /// Whether the embedding of a mask is also that of its place in the whole photo, where the
    /// bundle's image tower gives one.
    context: bool = true, false;
    /// Whether masks of different photos that lie on the same Gaussians share a row of the bank,
    /// and a text looks at each of them; else K-Means makes the rows.
    tracks: bool = true, false;
    /// Without tracks: rows of the bank over the mean number of masks of a photo.
    lambda: f64 = 1.2, 1.2;
    /// Without tracks: rows of the bank (M); 0: by `lambda`.
    bank_rows: u32 = 0, 0;
    /// Whether all photos that show a Gaussian vote for its entry.
    votes: bool = true, false;
    /// Without tracks: least cosine of two entries that become one, where two photos show them on
    /// one thing; 0: no two do.
    merge_cosine: f64 = 0.7, 0.0;
    /// Photos whose Gaussians are in front in a view, the nearest ones; 0: those of all.
    front_photos: u32 = 4, 0;
    /// Whether a view that magnifies the photos blurs the Gaussians as the network learnt them.
    magnify: bool = true, false;
    /// Whether refinement learns where the photos' cameras stand, where photos that are held out
    /// show that they are wrong: `mended`, or takes them as `given`.
    [param(inline)]
    camera: CameraUse = CameraUse::Mended, CameraUse::Given;
}

impl SceneOptions {
    /// These options with others set, each as `NAME=VALUE`: `lambda=0.8`, `votes=false`.
    ///
    /// # Errors
    /// `invalid_request` with the name or the value that does not fit.
    pub fn with(&self, pairs: &[String]) -> Result<Self> {
        with_pairs(self, pairs)
    }
}

/// Options of serde's with others set, each as `NAME=VALUE`; a value is JSON or a text.
///
/// # Errors
/// `invalid_request` with the name or the value that does not fit.
pub fn with_pairs<T: Serialize + DeserializeOwned>(options: &T, pairs: &[String]) -> Result<T> {
    let wrong = |why: &dyn std::fmt::Display| Error::invalid(format!("method: {why}"));
    let mut fields = serde_json::to_value(options).map_err(|e| wrong(&e))?;
    for pair in pairs {
        let (name, value) =
            pair.split_once('=').ok_or_else(|| wrong(&format!("{pair:?} is no NAME=VALUE")))?;
        let value = serde_json::from_str(value).unwrap_or_else(|_| value.into());
        fields[name] = value;
        let read = serde_json::from_value::<T>(fields.clone());
        read.map_err(|e| wrong(&format!("{pair:?}: {e}")))?;
    }
    serde_json::from_value(fields).map_err(|e| wrong(&e))
}

impl Default for Method {
    fn default() -> Self {
        Self::of(Preset::Default)
    }
}

impl Method {
    /// Checks the numbers.
    ///
    /// # Errors
    /// `invalid_request` with the field, the value and its bounds.
    pub fn check(&self) -> Result<()> {
        let photos = [0.0, f64::from(SCENE_PHOTOS_MAX)];
        within("lambda", self.lambda, LAMBDA_RANGE)?;
        within("merge_cosine", self.merge_cosine, [0.0, 1.0])?;
        within("bank_rows", f64::from(self.bank_rows), [0.0, BANK_ROWS_MAX as f64])?;
        within("fuse_layers", f64::from(self.fuse_layers), photos)?;
        within("front_photos", f64::from(self.front_photos), photos)
    }
}

/// How texts are scored, spelt out.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct ScoringMethod {
    /// Whether the bank's rows are brought to length 1 before they are blended.
    pub unit_rows: bool,
    /// Canonical texts that a text is compared with.
    pub canon: Vec<String>,
    /// Sharpness of the comparison (LERF's temperature).
    pub tau: f64,
    /// Coverage under which a pixel has no relevancy, 0..1.
    pub coverage_floor: f64,
    /// Difference of cosines to the canonical texts at which the relevancy is 0.5, -2 to 2.
    pub margin: f64,
    /// Relevancy from which a text selects, 0..1.
    pub cut: f64,
    /// An entry that fits a text by so much less than the best one (cosine, 0..2) is not selected.
    pub near_best: f64,
    /// Share of the bundle's list of words that may fit an entry better than the text, 0..1; 1: the
    /// list does not count.
    pub rivals: f64,
}

impl ScoringMethod {
    /// Canonical texts of LERF and of the paper, less its "texture".
    pub const CANON: [&str; 3] = ["object", "things", "stuff"];
    /// LERF's temperature.
    pub const TAU: f64 = 10.0;
    /// Where a text is nearer than every canonical text.
    pub const CUT: f64 = 0.5;
    /// Of `default`; chosen on rendered scenes and held-out photographs.
    pub const NEAR_BEST: f64 = 0.1;
    /// No entry is left out: cosines are apart by 2 at most.
    pub const NEAR_BEST_MAX: f64 = 2.0;

    /// The values of a preset; `default` takes those of the bundle.
    pub fn of(
        preset: Preset,
        canon: Vec<String>,
        tau: f64,
        coverage_floor: f64,
        margin: f64,
        rivals: f64,
    ) -> Self {
        match preset {
            Preset::Default => Self {
                unit_rows: true,
                canon,
                tau,
                coverage_floor,
                margin,
                cut: Self::CUT,
                near_best: Self::NEAR_BEST,
                rivals,
            },
            Preset::Paper => Self {
                unit_rows: false,
                canon: Self::CANON.map(str::to_owned).to_vec(),
                tau: Self::TAU,
                coverage_floor: 0.0,
                margin: 0.0,
                cut: Self::CUT,
                near_best: Self::NEAR_BEST_MAX,
                rivals: 1.0,
            },
        }
    }

    /// Checks the numbers, and that there is a canonical text.
    ///
    /// # Errors
    /// `invalid_request` with the field, the value and its bounds.
    pub fn check(&self) -> Result<()> {
        let (count, max) = (self.canon.len(), CANON_MAX);
        if !(1..=max).contains(&count) {
            return Err(Error::invalid(format!(
                "canon has {count} texts; it must have 1 to {max}"
            )));
        }
        within("tau", self.tau, TAU_RANGE)?;
        within("coverage_floor", self.coverage_floor, [0.0, 1.0])?;
        within("margin", self.margin, [-2.0, 2.0])?;
        within("cut", self.cut, [0.0, 1.0])?;
        within("rivals", self.rivals, [0.0, 1.0])?;
        within("near_best", self.near_best, [0.0, Self::NEAR_BEST_MAX])
    }
}

fn within(name: &str, value: f64, [least, most]: [f64; 2]) -> Result<()> {
    if (least..=most).contains(&value) {
        return Ok(());
    }
    let value = crate::names::shown(value);
    Err(Error::invalid(format!("{name} is {value}; it must be {least} to {most}")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn options_change_single_fields_of_their_preset() {
        let options = SceneOptions {
            preset: Preset::Paper,
            votes: Some(true),
            lambda: Some(0.8),
            ..SceneOptions::default()
        };
        let paper = Method::of(Preset::Paper);
        assert_eq!(options.method(), Method { votes: true, lambda: 0.8, ..paper });
        assert_eq!(SceneOptions::default().method(), Method::default());
        assert!(SceneOptions::NAMES.contains(&"front_photos"));
        let pairs = ["votes=true", "lambda=0.8"].map(str::to_owned);
        let paper = SceneOptions { preset: Preset::Paper, ..SceneOptions::default() };
        assert_eq!(paper.with(&pairs).unwrap(), options);
        for bad in ["votes", "votes=3", "beta=1", "mask_level=big"] {
            let error = paper.with(&[bad.to_owned()]).unwrap_err();
            assert!(error.message().contains(bad), "{error}");
        }
    }

    #[test]
    fn numbers_out_of_their_bounds_are_named() {
        let bad = |method: Method| method.check().unwrap_err().message().to_owned();
        let lambda = bad(Method { lambda: 0.0, ..Method::default() });
        assert_eq!(lambda, "lambda is 0; it must be 0.01 to 100");
        assert!(bad(Method { lambda: f64::NAN, ..Method::default() }).contains("lambda is NaN"));
        assert!(bad(Method { bank_rows: 5000, ..Method::default() }).contains("0 to 4096"));
        let scoring = ScoringMethod::of(Preset::Paper, Vec::new(), 0.0, 0.0, 0.0, 1.0);
        scoring.check().unwrap();
        assert!(ScoringMethod { cut: 1.5, ..scoring.clone() }.check().is_err());
        assert!(ScoringMethod { rivals: -0.1, ..scoring.clone() }.check().is_err());
        assert!(ScoringMethod { canon: Vec::new(), ..scoring }.check().is_err());
    }

    #[test]
    fn levels_count_from_the_whole() {
        let places = |levels| {
            [MaskLevel::Widest, MaskLevel::Whole, MaskLevel::Part, MaskLevel::Subpart]
                .map(|level| level.place(levels))
        };
        assert_eq!(places(3), [None, Some(2), Some(1), Some(0)]);
        assert_eq!(places(1), [None, Some(0), Some(0), Some(0)]);
    }
}
