//! Messages to use cases and back. What a message lacks or an enum does not know is named.

use std::time::Duration;

use super::pb;
use crate::{
    error::{Error, Result},
    scene::{CameraToWorld, HealthReport, Intrinsics, ScoringProfile, SemanticsReport, StageTime},
    service::{
        Background, Boxes, CameraSpec, Density, Event, ExportFormat, Format, InstanceBox, Kind,
        Label, LensSpec, MaskFormat, Peak, PickSpec, Picked, PictureOptions, PoseSpec, Quality,
        QueryAnswer, QuerySpec, RenderedView, SceneError, SceneState, SceneStatus, SemanticsMode,
        SemanticsState, SemanticsStatus, TextOptions, TextResult, TextView, TextWarning,
        ViewOptions,
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
        state: pb::SceneState::from(status.state).into(),
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
    let report = |report: SemanticsReport| pb::SemanticsReport {
        masks: report.masks,
        bank_size: report.bank_size,
        labelled: report.labelled,
        bundle_sha256: report.bundle_sha256,
        profile: pb::ScoringProfile::from(report.profile).into(),
        stages: report.stages.into_iter().map(stage_time).collect(),
        execution_provider: report.execution_provider,
    };
    pb::SemanticsStatus {
        available: status.available,
        reason: status.reason.unwrap_or_default(),
        state: pb::SemanticsState::from(status.state).into(),
        stage: status.stage.unwrap_or_default(),
        fraction: status.fraction,
        bank_size: status.bank_size,
        error: status.error.map(scene_error),
        report: status.report.map(report),
    }
}

fn stage_time(time: StageTime) -> pb::StageTime {
    pb::StageTime { stage: time.stage, ms: time.ms }
}

fn scene_error(error: SceneError) -> pb::SceneError {
    pb::SceneError { code: error.code, message: error.message }
}

fn report(report: HealthReport) -> pb::HealthReport {
    let [depth_near, depth_far] = report.depth_range;
    let warning = |warning: crate::scene::Warning| pb::Warning {
        code: warning.code.to_string(),
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

fn intrinsics(k: Intrinsics) -> pb::Intrinsics {
    pb::Intrinsics { fx: k.fx, fy: k.fy, cx: k.cx, cy: k.cy, width: k.width, height: k.height }
}

fn matrix(pose: &CameraToWorld) -> Vec<f64> {
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

fn vec3(v: &pb::Vec3) -> [f64; 3] {
    [v.x, v.y, v.z]
}

/// How a view is rendered.
pub(super) fn options(options: &pb::ViewOptions) -> Result<ViewOptions> {
    Ok(ViewOptions {
        width: options.width,
        height: options.height,
        antialiased: options.antialiased,
        near: options.near,
        quality: value("quality", options.quality)?,
        deadline: None,
    })
}

/// The same where no picture comes out: the encoding does not count, and there is no part of it.
fn options_alone(given: Option<pb::ViewOptions>, call: &str) -> Result<ViewOptions> {
    let given = given.unwrap_or_default();
    match given.crop {
        None => options(&given),
        Some(_) => Err(Error::invalid(format!("crop goes with views, not with {call}"))),
    }
}

/// How a view is encoded.
pub(super) fn picture(options: &pb::ViewOptions) -> Result<PictureOptions> {
    #[expect(clippy::cast_possible_truncation, reason = "a colour fits f32")]
    let color = |v: pb::Vec3| Background::Color([v.x as f32, v.y as f32, v.z as f32]);
    let crop = |crop: pb::Region| [crop.x, crop.y, crop.width, crop.height].into();
    Ok(PictureOptions {
        format: value("format", options.format)?,
        background: options.background.map(color).unwrap_or_default(),
        crop: options.crop.map(crop),
    })
}

/// One encoded picture.
pub(super) fn view(view: RenderedView) -> pb::View {
    pb::View {
        camera_index: u32::try_from(view.camera_index).unwrap_or(u32::MAX),
        kind: pb::Kind::from(view.kind).into(),
        format: pb::Format::from(view.format).into(),
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

/// What a view or an export asks by text; an empty text is none.
pub(super) fn text(text: String, profile: i32, wait_ms: Option<u64>) -> Result<TextOptions> {
    Ok(TextOptions {
        text: Some(text).filter(|text| !text.is_empty()),
        profile: value("profile", profile)?,
        wait: wait_ms.map(Duration::from_millis),
    })
}

/// A query.
pub(super) fn query(request: pb::QueryRequest) -> Result<QuerySpec> {
    let view = request.camera.map(|given| camera(Some(given), "camera")).transpose()?;
    Ok(QuerySpec {
        texts: request.texts,
        camera: view,
        options: options_alone(request.options, "query")?,
        boxes: value("boxes", request.boxes)?,
        mask: value("mask", request.mask)?,
        relevancy: request.relevancy,
        profile: value("profile", request.profile)?,
        wait: request.semantics_wait_ms.map(Duration::from_millis),
    })
}

/// What a query found.
pub(super) fn answer(answer: QueryAnswer) -> pb::QueryResponse {
    let camera = answer.camera;
    pb::QueryResponse {
        bank_size: answer.bank_size,
        profile: pb::ScoringProfile::from(answer.profile).into(),
        intrinsics: camera.map(|camera| intrinsics(camera.intrinsics)),
        camera_to_world: camera.map_or_else(Vec::new, |camera| matrix(&camera.camera_to_world)),
        render_ms: answer.render_ms,
        results: answer.results.into_iter().map(result).collect(),
    }
}

fn result(found: TextResult) -> pb::TextResult {
    let warning =
        |warning: TextWarning| pb::TextWarning { code: warning.code, message: warning.message };
    pb::TextResult {
        text: found.text,
        scores: found.scores,
        entries: found.entries.into_iter().map(u32::from).collect(),
        gaussians: found.gaussians,
        parts: found.parts.iter().map(part).collect(),
        warnings: found.warnings.into_iter().map(warning).collect(),
        view: found.view.map(text_view),
    }
}

fn point([x, y, z]: [f64; 3]) -> pb::Vec3 {
    pb::Vec3 { x, y, z }
}

fn part(part: &InstanceBox) -> pb::Part {
    pb::Part {
        gaussians: part.gaussians,
        center: Some(point(part.center)),
        axes: part.axes.iter().copied().map(point).collect(),
        size: Some(point(part.size)),
    }
}

fn text_view(view: TextView) -> pb::TextView {
    let peak = |peak: Peak| pb::Peak { x: peak.x, y: peak.y, relevancy: peak.relevancy };
    pb::TextView {
        mask_rle: view.mask_rle.map(|rle| rle.counts).unwrap_or_default(),
        mask_png: view.mask_png.unwrap_or_default().into(),
        relevancy_png: view.relevancy_png.unwrap_or_default().into(),
        area: view.area,
        bbox: view.bbox.map_or_else(Vec::new, |bbox| bbox.to_vec()),
        peak: view.peak.map(peak),
    }
}

/// A pixel of a view.
pub(super) fn pick(request: pb::PickRequest) -> Result<PickSpec> {
    Ok(PickSpec {
        camera: camera(request.camera, "pick")?,
        x: request.x,
        y: request.y,
        options: options_alone(request.options, "pick")?,
        labels: request.labels,
        profile: value("profile", request.profile)?,
        wait: request.semantics_wait_ms.map(Duration::from_millis),
    })
}

/// What lies under it.
pub(super) fn picked(picked: Picked) -> pb::PickResponse {
    let label = |label: Label| pb::Label { text: label.text, relevancy: label.relevancy };
    pb::PickResponse {
        alpha: picked.alpha,
        depth: picked.depth,
        point: picked.point.map(point),
        gaussian: picked.gaussian,
        entry: picked.entry.map(u32::from),
        labels: picked.labels.into_iter().map(label).collect(),
    }
}

/// An enum that a message carries as a number.
pub(super) trait OfNumber: Sized {
    /// The value of this number; proto3 lets any number through.
    fn of_number(number: i32) -> Option<Self>;
}

/// The value of a message's enum; `name` names it in messages.
pub(super) fn value<T: OfNumber>(name: &str, number: i32) -> Result<T> {
    T::of_number(number)
        .ok_or_else(|| Error::invalid(format!("{name} is {number}, which is none of its values")))
}

/// Enums that callers send; one that is not set is the default.
macro_rules! sent {
    ($($ours:ident = $theirs:ident { $($value:ident),+ })+) => {$(
        impl OfNumber for $ours {
            fn of_number(number: i32) -> Option<Self> {
                Some(match pb::$theirs::try_from(number).ok()? {
                    pb::$theirs::Unspecified => Self::default(),
                    $(pb::$theirs::$value => Self::$value,)+
                })
            }
        }
    )+};
}

/// Enums that callers get.
macro_rules! answered {
    ($($ours:ident = $theirs:ident { $($value:ident),+ })+) => {$(
        impl From<$ours> for pb::$theirs {
            fn from(value: $ours) -> Self {
                match value { $($ours::$value => Self::$value,)+ }
            }
        }
    )+};
}

sent! {
    SemanticsMode = Semantics { Lazy, Eager, Off }
    Density = Density { Thinned, Full }
    Kind = Kind { Color, Depth, Alpha, Semantics, Relevancy, Mask }
    Format = Format { Png, Jpeg, Webp, Npy }
    Quality = Quality { Exact, Fast }
    ScoringProfile = ScoringProfile { Default, Paper }
    Boxes = Boxes { Oriented, Aligned, None }
    MaskFormat = MaskFormat { Rle, Png, None }
    ExportFormat = ExportFormat { Ply }
}

answered! {
    SceneState = SceneState { Queued, Running, Done, Failed, Cancelled }
    SemanticsState = SemanticsState { Off, None, Running, Ready, Failed }
    Kind = Kind { Color, Depth, Alpha, Semantics, Relevancy, Mask }
    Format = Format { Png, Jpeg, Webp, Npy }
    ScoringProfile = ScoringProfile { Default, Paper }
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
        assert!(message(value::<Kind>("kind", 99).unwrap_err()).contains("kind is 99"));
        assert_eq!(value::<Kind>("kind", 6).unwrap(), Kind::Mask);
        let odd = pb::ViewOptions { format: -1, ..Default::default() };
        assert!(message(picture(&odd).unwrap_err()).contains("format is -1"));
    }
}
