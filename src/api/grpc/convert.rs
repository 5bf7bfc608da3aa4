//! Messages to use cases and back. What a message lacks or an enum does not know is named.

use super::pb;
use crate::{
    error::{Error, Result},
    scene::{
        CameraToWorld, HealthReport, Intrinsics, Region, ScoringProfile, SemanticsReport, StageTime,
    },
    service::{
        CameraSpec, Density, Event, ExportFormat, Format, Kind, LensSpec, PoseSpec, Quality,
        RenderedView, SceneError, SceneState, SceneStatus, SemanticsMode, SemanticsState,
        SemanticsStatus, ViewOptions,
    },
};

/// A scene with what can be asked of it by text.
pub(super) fn scene(status: SceneStatus) -> pb::Scene {
    let camera = |camera: crate::service::SceneCamera| pb::SceneCamera {
        file: camera.file,
        intrinsics: Some(intrinsics(camera.camera.intrinsics)),
        camera_to_world: matrix(&camera.camera.camera_to_world),
    };
    pb::Scene {
        id: status.id.to_string(),
        state: state(status.state).into(),
        stage: status.stage.unwrap_or_default(),
        fraction: status.fraction,
        created_ms: status.created_ms,
        updated_ms: status.updated_ms,
        error: status.error.map(scene_error),
        report: status.report.map(report),
        cameras: status.cameras.into_iter().map(camera).collect(),
        semantics: Some(semantics_status(status.semantics)),
    }
}

fn semantics_status(status: SemanticsStatus) -> pb::SemanticsStatus {
    let state = match status.state {
        SemanticsState::Off => pb::SemanticsState::Off,
        SemanticsState::None => pb::SemanticsState::None,
        SemanticsState::Running => pb::SemanticsState::Running,
        SemanticsState::Ready => pb::SemanticsState::Ready,
        SemanticsState::Failed => pb::SemanticsState::Failed,
    };
    let report = |report: SemanticsReport| pb::SemanticsReport {
        masks: report.masks,
        bank_size: report.bank_size,
        labelled: report.labelled,
        bundle_sha256: report.bundle_sha256,
        profile: profile(report.profile).into(),
        stages: report.stages.into_iter().map(stage_time).collect(),
        execution_provider: report.execution_provider,
    };
    pb::SemanticsStatus {
        available: status.available,
        reason: status.reason.unwrap_or_default(),
        state: state.into(),
        stage: status.stage.unwrap_or_default(),
        fraction: status.fraction,
        bank_size: status.bank_size,
        error: status.error.map(scene_error),
        report: status.report.map(report),
    }
}

pub(super) fn profile(profile: ScoringProfile) -> pb::ScoringProfile {
    match profile {
        ScoringProfile::Default => pb::ScoringProfile::Default,
        ScoringProfile::Paper => pb::ScoringProfile::Paper,
    }
}

fn stage_time(time: StageTime) -> pb::StageTime {
    pb::StageTime { stage: time.stage, ms: time.ms }
}

fn state(state: SceneState) -> pb::SceneState {
    match state {
        SceneState::Queued => pb::SceneState::Queued,
        SceneState::Running => pb::SceneState::Running,
        SceneState::Done => pb::SceneState::Done,
        SceneState::Failed => pb::SceneState::Failed,
        SceneState::Cancelled => pb::SceneState::Cancelled,
    }
}

fn scene_error(error: SceneError) -> pb::SceneError {
    pb::SceneError { code: error.code, message: error.message }
}

fn report(report: HealthReport) -> pb::HealthReport {
    let [depth_near, depth_far] = report.depth_range;
    let warning = |warning: crate::scene::Warning| pb::Warning {
        code: serde_json::to_value(warning.code)
            .ok()
            .and_then(|code| code.as_str().map(str::to_owned))
            .unwrap_or_default(),
        message: warning.message,
        value: warning.value,
    };
    let drop_count =
        |drop: crate::scene::DropCount| pb::DropCount { reason: drop.reason, count: drop.count };
    pb::HealthReport {
        photos: report.photos,
        views_used: report.views_used,
        gaussians: report.gaussians,
        dropped: report.dropped.into_iter().map(drop_count).collect(),
        depth_near,
        depth_far,
        median_depth: report.median_depth,
        overlap: report.overlap,
        network_focal_px: report.network_focal_px,
        stages: report.stages.into_iter().map(stage_time).collect(),
        execution_provider: report.execution_provider,
        warnings: report.warnings.into_iter().map(warning).collect(),
    }
}

pub(super) fn intrinsics(k: Intrinsics) -> pb::Intrinsics {
    pb::Intrinsics { fx: k.fx, fy: k.fy, cx: k.cx, cy: k.cy, width: k.width, height: k.height }
}

pub(super) fn matrix(pose: &CameraToWorld) -> Vec<f64> {
    pose.to_row_major().to_vec()
}

/// What a watcher sees.
pub(super) fn event(event: Event) -> pb::SceneEvent {
    let of = |state: pb::SceneState| pb::SceneEvent { state: state.into(), ..Default::default() };
    match event {
        Event::Queued { ahead } => {
            pb::SceneEvent { ahead: ahead as u64, ..of(pb::SceneState::Queued) }
        }
        Event::Running { stage, fraction } => {
            pb::SceneEvent { stage, fraction, ..of(pb::SceneState::Running) }
        }
        Event::Done => of(pb::SceneState::Done),
        Event::Failed(error) => {
            pb::SceneEvent { error: Some(scene_error(error)), ..of(pb::SceneState::Failed) }
        }
        Event::Cancelled => of(pb::SceneState::Cancelled),
    }
}

/// When the semantic bank is made.
pub(super) fn semantics(number: i32) -> Result<SemanticsMode> {
    match known::<pb::Semantics>("semantics", number)? {
        pb::Semantics::Unspecified | pb::Semantics::Lazy => Ok(SemanticsMode::Lazy),
        pb::Semantics::Eager => Ok(SemanticsMode::Eager),
        pb::Semantics::Off => Ok(SemanticsMode::Off),
    }
}

pub(super) fn density(number: i32) -> Result<Density> {
    match known::<pb::Density>("density", number)? {
        pb::Density::Unspecified | pb::Density::Thinned => Ok(Density::Thinned),
        pb::Density::Full => Ok(Density::Full),
    }
}

/// A camera. `what` starts the messages.
pub(super) fn camera(camera: Option<pb::CameraSpec>, what: &str) -> Result<CameraSpec> {
    let camera = camera.ok_or_else(|| Error::invalid(format!("{what}: no camera given")))?;
    Ok(CameraSpec { pose: pose(camera.pose, what)?, lens: lens(camera.lens) })
}

fn pose(pose: Option<pb::camera_spec::Pose>, what: &str) -> Result<PoseSpec> {
    use pb::camera_spec::Pose;
    match pose {
        None => Err(Error::invalid(format!(
            "{what}: no pose given; give camera_to_world, or look_at, or between"
        ))),
        Some(Pose::CameraToWorld(matrix)) => {
            let count = matrix.values.len();
            let values = <[f64; 16]>::try_from(matrix.values).map_err(|_| {
                Error::invalid(format!(
                    "{what}: camera_to_world has {count} numbers; it must have 16"
                ))
            })?;
            Ok(PoseSpec::CameraToWorld(values))
        }
        Some(Pose::LookAt(look)) => {
            let (Some(eye), Some(target)) = (look.eye, look.target) else {
                return Err(Error::invalid(format!("{what}: eye and target go together")));
            };
            let up = look.up.as_ref().map(vec3);
            Ok(PoseSpec::LookAt { eye: vec3(&eye), target: vec3(&target), up })
        }
        Some(Pose::Between(between)) => Ok(PoseSpec::Between {
            from: between.from as usize,
            to: between.to as usize,
            t: between.t,
        }),
    }
}

fn lens(lens: Option<pb::camera_spec::Lens>) -> LensSpec {
    use pb::camera_spec::Lens;
    match lens {
        None => LensSpec::OfScene,
        Some(Lens::Fov(fov)) => LensSpec::Fov(fov),
        Some(Lens::Focal(f)) => LensSpec::Focal { fx: f.fx, fy: f.fy, cx: f.cx, cy: f.cy },
    }
}

pub(super) fn vec3(v: &pb::Vec3) -> [f64; 3] {
    [v.x, v.y, v.z]
}

/// Which picture.
pub(super) fn kind(number: i32) -> Result<Kind> {
    match known::<pb::Kind>("kind", number)? {
        pb::Kind::Unspecified | pb::Kind::Color => Ok(Kind::Color),
        pb::Kind::Depth => Ok(Kind::Depth),
        pb::Kind::Alpha => Ok(Kind::Alpha),
        pb::Kind::Semantics => Ok(Kind::Semantics),
        pb::Kind::Relevancy => Ok(Kind::Relevancy),
        pb::Kind::Mask => Ok(Kind::Mask),
    }
}

/// Size, encoding and the rest.
pub(super) fn options(options: Option<pb::ViewOptions>) -> Result<ViewOptions> {
    let options = options.unwrap_or_default();
    let format = match known::<pb::Format>("format", options.format)? {
        pb::Format::Unspecified | pb::Format::Png => Format::Png,
        pb::Format::Jpeg => Format::Jpeg,
        pb::Format::Webp => Format::Webp,
        pb::Format::Npy => Format::Npy,
    };
    #[expect(clippy::cast_possible_truncation, reason = "a colour fits f32")]
    let background = options.background.map(|v| [v.x as f32, v.y as f32, v.z as f32]);
    Ok(ViewOptions {
        width: options.width,
        height: options.height,
        format,
        background,
        antialiased: options.antialiased,
        near: options.near,
        crop: options.crop.map(|crop| Region {
            x: crop.x,
            y: crop.y,
            width: crop.width,
            height: crop.height,
        }),
        quality: match known::<pb::Quality>("quality", options.quality)? {
            pb::Quality::Unspecified | pb::Quality::Exact => Quality::Exact,
            pb::Quality::Fast => Quality::Fast,
        },
        deadline: None,
    })
}

/// One encoded picture.
pub(super) fn view(view: RenderedView) -> pb::View {
    let kind = match view.kind {
        Kind::Color => pb::Kind::Color,
        Kind::Depth => pb::Kind::Depth,
        Kind::Alpha => pb::Kind::Alpha,
        Kind::Semantics => pb::Kind::Semantics,
        Kind::Relevancy => pb::Kind::Relevancy,
        Kind::Mask => pb::Kind::Mask,
    };
    let format = match view.format {
        Format::Png => pb::Format::Png,
        Format::Jpeg => pb::Format::Jpeg,
        Format::Webp => pb::Format::Webp,
        Format::Npy => pb::Format::Npy,
    };
    pb::View {
        camera_index: u32::try_from(view.camera_index).unwrap_or(u32::MAX),
        kind: kind.into(),
        format: format.into(),
        width: view.width,
        height: view.height,
        data: view.bytes.into(),
        depth_scale: view.depth_scale,
        etag: view.etag,
        intrinsics: Some(intrinsics(view.camera.intrinsics)),
        camera_to_world: matrix(&view.camera.camera_to_world),
        render_ms: view.render_ms,
        visible: view.stats.visible,
    }
}

/// File format of an export.
pub(super) fn export_format(number: i32) -> Result<ExportFormat> {
    match known::<pb::ExportFormat>("format", number)? {
        pb::ExportFormat::Unspecified | pb::ExportFormat::Ply => Ok(ExportFormat::Ply),
    }
}

/// The enum's value of this number; proto3 lets any number through.
pub(super) fn known<E: TryFrom<i32>>(name: &str, number: i32) -> Result<E> {
    E::try_from(number)
        .map_err(|_| Error::invalid(format!("{name} is {number}, which is none of its values")))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_a_message_lacks_is_named() {
        let message = |error: Error| error.message().to_owned();
        assert!(message(camera(None, "view").unwrap_err()).contains("no camera"));
        let empty = Some(pb::CameraSpec::default());
        assert!(message(camera(empty, "view").unwrap_err()).contains("no pose"));
        let short = pb::CameraSpec {
            pose: Some(pb::camera_spec::Pose::CameraToWorld(pb::Matrix { values: vec![1.0; 12] })),
            lens: None,
        };
        assert!(message(camera(Some(short), "view").unwrap_err()).contains("12 numbers"));
        assert!(message(kind(99).unwrap_err()).contains("kind is 99"));
        assert_eq!(kind(6).unwrap(), Kind::Mask);
        let odd = pb::ViewOptions { format: -1, ..Default::default() };
        assert!(message(options(Some(odd)).unwrap_err()).contains("format is -1"));
    }
}
