//! The one metric that stages below the server count: seconds of each stage.

use metrics::histogram;

/// Time of each stage, by `stage`.
pub const STAGE_SECONDS: &str = "segsplat_stage_seconds";

/// Stages of a scene, of its semantics, and of a view.
pub const STAGES: [&str; 14] = [
    "wait", "photos", "capture", "geometry", "lift", "store", "masks", "embed", "bank", "assign",
    "queue", "load", "render", "encode",
];

/// Records the seconds of a stage; a name that is not in [`STAGES`] is not recorded.
pub fn stage(name: &str, seconds: f64) {
    if let Some(stage) = STAGES.into_iter().find(|stage| *stage == name) {
        histogram!(STAGE_SECONDS, "stage" => stage).record(seconds);
    }
}
