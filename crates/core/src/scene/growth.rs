//! Where the photos stand that join a finished scene, or leave it.

use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::{names::display_names, scene::SceneError};

/// Where the changes of the photos of a scene stand.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum GrowthState {
    /// The scene has the photos that it was made of.
    #[default]
    None,
    /// Photos wait to join or leave, or do so now; the version before is served meanwhile.
    Running,
    /// The version that is served has all changes.
    Done,
    /// The last change was given up; `error` says why. The version that is served stays.
    Failed,
}

display_names!(GrowthState);

/// How far the changes of the photos of a scene are.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default)]
pub struct GrowthStatus {
    /// Where they stand.
    #[schema(required = true)]
    pub state: GrowthState,
    /// Calls whose photos are not in the served version yet.
    #[schema(required = true)]
    pub waiting: u32,
    /// Stage at work while running: `photos`, `capture`, `geometry`, `lift`, `store`; where the
    /// scene has semantics also `masks`, `embed`, `bank`, `assign`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stage: Option<String>,
    /// Share of that work that is done, 0..1.
    #[schema(required = true)]
    pub fraction: f32,
    /// Why the last one was given up.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<SceneError>,
}

impl GrowthStatus {
    /// So many changes wait.
    #[must_use]
    pub fn of(waiting: u32) -> Self {
        let state = if waiting == 0 { GrowthState::Done } else { GrowthState::Running };
        Self { state, waiting, ..Self::default() }
    }
}
