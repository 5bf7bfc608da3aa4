//! The status of a scene, as the store keeps it and as callers and watchers see it.

use glam::{DMat3, DVec3};
use serde::{Deserialize, Serialize};
use utoipa::ToSchema;

use crate::{
    names::display_names,
    scene::{
        Camera, GrowthState, GrowthStatus, HealthReport, Intrinsics, RefineState, RefineStatus,
        SceneError, SceneId, SemanticsReport, principal_axes,
    },
};

/// How far photos are rolled, radians squared: some two degrees.
const ROLL_VARIANCE: f64 = 1e-3;

/// Where a scene stands.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SceneState {
    /// Waits for a worker.
    Queued,
    /// A worker makes it.
    Running,
    /// Made; views can be asked for.
    Done,
    /// Not made; `error` says why.
    Failed,
    /// Stopped by the caller.
    Cancelled,
}

impl SceneState {
    /// Whether nothing more will happen.
    pub fn is_final(self) -> bool {
        matches!(self, Self::Done | Self::Failed | Self::Cancelled)
    }
}

display_names!(SceneState, SemanticsState);

/// An input camera of a scene and the photo it belongs to.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
pub struct SceneCamera {
    /// File name of the photo.
    pub file: String,
    /// Camera of the undistorted photo, world frame of the upload.
    #[serde(flatten)]
    pub camera: Camera,
    /// Lens of the network's picture of the photo, same pose: what `SourcePixel` counts pixels of.
    /// None where the photo was not used.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub network: Option<Intrinsics>,
}

impl SceneCamera {
    /// Up in the pictures of all cameras, a unit vector of the world; -y where there are none.
    #[must_use]
    pub fn mean_up(cameras: &[Self]) -> DVec3 {
        let sum: DVec3 = cameras.iter().map(|c| -c.camera.camera_to_world.rotation().y_axis).sum();
        sum.try_normalize().unwrap_or(DVec3::NEG_Y)
    }

    /// Up of the world as the photos tell it, a unit vector: the direction that is most across to
    /// the right of all pictures. So photos that look down or up count as those that look ahead,
    /// as long as they are not rolled. Photos that all look the same way say less: then it is
    /// [`Self::mean_up`] without its roll.
    #[must_use]
    pub fn level_up(cameras: &[Self]) -> DVec3 {
        let mean = Self::mean_up(cameras);
        let square = |v: DVec3| DMat3::from_cols(v * v.x, v * v.y, v * v.z);
        let mut right = (DMat3::IDENTITY - square(mean)) * ROLL_VARIANCE * cameras.len() as f64;
        for camera in cameras {
            right += square(camera.camera.camera_to_world.rotation().x_axis);
        }
        let spread = |axis: &DVec3| axis.dot(right * *axis);
        let least = principal_axes(right).into_iter();
        let least = least.min_by(|a, b| spread(a).total_cmp(&spread(b))).unwrap_or(mean);
        if cameras.is_empty() { mean } else { least * least.dot(mean).signum() }
    }
}

/// Where the semantics of a scene stand.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash, Serialize, Deserialize, ToSchema)]
#[serde(rename_all = "snake_case")]
pub enum SemanticsState {
    /// Never made: the scene was asked to have none.
    Off,
    /// Not made yet.
    #[default]
    None,
    /// Waiting for their turn, or being made.
    Running,
    /// Made; texts are answered at once.
    Ready,
    /// Not made; `error` says why. The next text tries again.
    Failed,
}

/// What can be asked of a scene by text, and how far that is.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(default)]
pub struct SemanticsStatus {
    /// Whether a text can be asked: at once where `ready`, else after they are made.
    #[schema(required = true)]
    pub available: bool,
    /// Why not.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub reason: Option<String>,
    /// Where they stand.
    #[schema(required = true)]
    pub state: SemanticsState,
    /// Stage at work while running: `masks`, `embed`, `bank`, `assign`.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub stage: Option<String>,
    /// Share of their making that is done, 0..1.
    #[schema(required = true)]
    pub fraction: f32,
    /// Entries of the bank (M), once ready.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub bank_size: Option<u32>,
    /// Why they failed.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub error: Option<SceneError>,
    /// Counts and times, once ready.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub report: Option<SemanticsReport>,
}

impl SemanticsStatus {
    /// Nothing but a state.
    pub fn new(state: SemanticsState) -> Self {
        Self { state, ..Self::default() }
    }

    /// Made, with this report.
    pub fn ready(report: SemanticsReport) -> Self {
        Self {
            fraction: 1.0,
            bank_size: Some(report.bank_size),
            report: Some(report),
            ..Self::new(SemanticsState::Ready)
        }
    }
}

/// A scene as `GET /v1/scenes/{id}` shows it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[schema(as = Scene)]
pub struct SceneStatus {
    /// Id: 32 lower-case hex digits.
    #[schema(value_type = String)]
    pub id: SceneId,
    /// State.
    pub state: SceneState,
    /// Stage at work while running: `photos`, `cameras` where they are solved, `capture`,
    /// `geometry`, `lift`, `store`.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub stage: Option<String>,
    /// Share of the whole work that is done, 0..1.
    pub fraction: f32,
    /// Time of the create call, milliseconds since 1970.
    pub created_ms: u64,
    /// Time of the last change of state, milliseconds since 1970.
    pub updated_ms: u64,
    /// Why it failed.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub error: Option<SceneError>,
    /// Health report, once done.
    #[serde(skip_serializing_if = "Option::is_none", default)]
    pub report: Option<HealthReport>,
    /// Input cameras, once done.
    #[serde(skip_serializing_if = "Vec::is_empty", default)]
    pub cameras: Vec<SceneCamera>,
    /// What can be asked of it by text.
    #[serde(default)]
    #[schema(required = true)]
    pub semantics: SemanticsStatus,
    /// Counts what was served under this id: 0 until it is done, then 1, and one more with each
    /// better version that refinement publishes, and with each change of its photos. Tags of views
    /// change with it.
    #[serde(default)]
    #[schema(required = true)]
    pub version: u32,
    /// How far its refinement is.
    #[serde(default)]
    #[schema(required = true)]
    pub refinement: RefineStatus,
    /// How far photos are that joined it or left it after it was made.
    #[serde(default)]
    #[schema(required = true)]
    pub growth: GrowthStatus,
}

impl SceneStatus {
    /// A scene in `state`, nothing more known.
    pub fn new(id: SceneId, state: SceneState, created_ms: u64) -> Self {
        Self {
            id,
            state,
            stage: None,
            fraction: 0.0,
            created_ms,
            updated_ms: created_ms,
            error: None,
            report: None,
            cameras: Vec::new(),
            semantics: SemanticsStatus::default(),
            version: 0,
            refinement: RefineStatus::default(),
            growth: GrowthStatus::default(),
        }
    }

    /// Whether it waits for a refinement, or one is at work.
    pub fn is_refined_now(&self) -> bool {
        self.refinement.state == RefineState::Running
    }

    /// Whether photos wait to join it or to leave it, or do so now.
    pub fn is_growing(&self) -> bool {
        self.growth.state == GrowthState::Running
    }

    /// Whether nothing happens to it now: neither it nor its semantics are being made, and its
    /// photos stay as they are. It may be refined.
    pub fn is_settled(&self) -> bool {
        self.state.is_final()
            && self.semantics.state != SemanticsState::Running
            && !self.is_growing()
    }
}

/// What a watcher sees. The newest event is always delivered; those between may be skipped.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize, ToSchema)]
#[serde(tag = "event", rename_all = "snake_case")]
pub enum Event {
    /// Waits; `ahead` jobs go first.
    Queued {
        /// Jobs that go first.
        ahead: usize,
    },
    /// At work: on the scene, or on the semantics of one that can be viewed already.
    Running {
        /// Stage at work: of the scene, or `masks`, `embed`, `bank`, `assign` of its semantics.
        stage: String,
        /// Share of that work that is done, 0..1.
        fraction: f32,
    },
    /// Made, and its semantics are not at work. Last event, unless it is being refined.
    Done,
    /// It is done and being refined: another version is served, or the refinement is over. Last
    /// event when it is over.
    Version {
        /// The version that is served.
        version: u32,
        /// Share of the refinement's time that is spent, 0..1.
        fraction: f32,
    },
    /// The edits of a scene that is done, told to those who ask for them alone: the list as it is,
    /// first, and each time that it is another one. Whose change it was, is not said.
    Edited {
        /// How many edits the list has.
        edits: usize,
    },
    /// Failed. Last event.
    Failed(SceneError),
    /// Stopped by the caller, or deleted. Last event.
    Cancelled,
}

impl Event {
    /// Whether it is the end of making a scene. Only versions and edits follow.
    pub fn is_last(&self) -> bool {
        matches!(self, Self::Done | Self::Failed(_) | Self::Cancelled)
    }
}
