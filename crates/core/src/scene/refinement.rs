//! Refinement of a scene: what callers ask for, where it stands, and what it came to.

use std::{fmt, str::FromStr};

use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use utoipa::ToSchema;

use crate::{names::display_names, scene::SceneError};

/// Whether, and for how long, a finished scene is brought closer to its photos.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub enum Refine {
    /// Where it is known to help, for as long as the machine can spare.
    #[default]
    Auto,
    /// Not at all.
    Off,
    /// For so many milliseconds of work; waiting for others is not counted.
    Ms(u64),
}

/// What a text for [`Refine`] must be.
const REFINES: &str = "auto, off or a whole number of milliseconds";

impl FromStr for Refine {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text {
            "auto" => Ok(Self::Auto),
            "off" => Ok(Self::Off),
            number => number.parse().map(Self::Ms).map_err(|_| format!("it must be {REFINES}")),
        }
    }
}

impl fmt::Display for Refine {
    fn fmt(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Auto => to.write_str("auto"),
            Self::Off => to.write_str("off"),
            Self::Ms(ms) => ms.fmt(to),
        }
    }
}

impl Serialize for Refine {
    fn serialize<S: Serializer>(&self, to: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Ms(ms) => to.serialize_u64(*ms),
            word => to.collect_str(word),
        }
    }
}

impl<'de> Deserialize<'de> for Refine {
    fn deserialize<D: Deserializer<'de>>(from: D) -> Result<Self, D::Error> {
        struct Visitor;
        impl de::Visitor<'_> for Visitor {
            type Value = Refine;

            fn expecting(&self, to: &mut fmt::Formatter<'_>) -> fmt::Result {
                to.write_str(REFINES)
            }

            fn visit_str<E: de::Error>(self, text: &str) -> Result<Refine, E> {
                text.parse().map_err(E::custom)
            }

            fn visit_u64<E: de::Error>(self, ms: u64) -> Result<Refine, E> {
                Ok(Refine::Ms(ms))
            }

            fn visit_i64<E: de::Error>(self, ms: i64) -> Result<Refine, E> {
                ms.to_string().parse().map_err(E::custom)
            }
        }
        from.deserialize_any(Visitor)
    }
}

/// Where the refinement of a scene stands.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum RefineState {
    /// Not asked for.
    #[default]
    None,
    /// Waiting for its turn, or at work; the scene is served meanwhile.
    Running,
    /// Over. The report has its figures.
    Done,
    /// Broken off; `error` says why. The version that is served stays.
    Failed,
}

display_names!(RefineState);

/// How far the refinement of a scene is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default)]
pub struct RefineStatus {
    /// Where it stands.
    #[schema(required = true)]
    pub state: RefineState,
    /// Share of its time that is spent, 0..1.
    #[schema(required = true)]
    pub fraction: f32,
    /// Why it failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<SceneError>,
}

impl RefineStatus {
    /// Nothing but a state.
    pub fn new(state: RefineState) -> Self {
        Self { state, ..Self::default() }
    }
}

/// What refinement made of a scene. The held-out photos are in neither the Gaussians that were
/// refined nor in the steps.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct RefineReport {
    /// Steps behind the version that is served; 0: none was better than the scene as it was made.
    pub steps: u32,
    /// Seconds of work until that version.
    pub seconds: f64,
    /// Photos held out, counted from 0 in the order of the cameras.
    pub held_out: Vec<u32>,
    /// PSNR on the held-out photos before the first step, dB: of a scene of the other photos, as it
    /// is served. None where no photo is held out.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub psnr_before: Option<f64>,
    /// The same of the version that is served.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub psnr_after: Option<f64>,
    /// Gaussians before the first step.
    pub gaussians_before: u64,
    /// Gaussians of the version that is served.
    pub gaussians_after: u64,
    /// Photos that were learnt beside those of the scene: the networks did not see them.
    #[serde(default)]
    pub more_photos: u32,
    /// How far the camera of each photo moved, in the order of the cameras; empty where they stay
    /// as they were given.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub cameras: Vec<MovedCamera>,
    /// Photos that took no part, by file name: their cameras cannot be right.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub left_out: Vec<String>,
}

/// How far a camera is from where it was given.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct MovedCamera {
    /// Angle of its turn, degrees.
    pub degrees: f64,
    /// Way of its centre, as a share of the scene's median depth.
    pub share: f64,
}

#[cfg(test)]
mod tests {
    use super::Refine;

    #[test]
    fn words_and_numbers_are_read_and_written() {
        for (text, want) in [("auto", Refine::Auto), ("off", Refine::Off), ("250", Refine::Ms(250))]
        {
            assert_eq!((text.parse(), want.to_string()), (Ok(want), text.to_owned()));
            let json = serde_json::to_value(want).unwrap();
            assert_eq!(serde_json::from_value::<Refine>(json).unwrap(), want);
        }
        assert_eq!(serde_json::from_str::<Refine>("\"250\"").unwrap(), Refine::Ms(250));
        for bad in ["\"on\"", "-1", "1.5", "\"-1\"", "true"] {
            let error = serde_json::from_str::<Refine>(bad).unwrap_err().to_string();
            assert!(error.contains("auto, off or a whole number of milliseconds"), "{error}");
        }
    }
}
