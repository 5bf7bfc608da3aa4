//! Messages to requests, and answers to messages. Errors name what a message lacks.

use std::time::Duration;

use super::pb;
use crate::{
    error::{Error, Result, short},
    scene::{
        CameraToWorld, CameraUse, CamerasMode, CamerasReport, CamerasSource, DropCount, Ground,
        GrowthState, HealthReport, Intrinsics, LeftOutPhoto, LengthUnit, MovedCamera, PlacedPhoto,
        Refine, RefineReport, RefineState, ScoringMethod, SemanticsReport, StageTime, Warning,
    },
    service::{
        BackgroundSpec, BoxSide, Boxes, CallerLimits, CameraSpec, Density, ERROR_FAST, Event,
        ExportFormat, FeatureKind, FeaturesSpec, Format, InstanceBox, KnownWord, Label, LensSpec,
        MaskFormat, MaskLevel, MaxError, Measured, Method, ModelInfo, ModelsInfo, Peak, PickSpec,
        Picked, PictureKind, PictureOptions, PoseSpec, Preset, QueryAnswer, QuerySpec,
        RenderedView, ScaleSource, ScaleSpec, ScaleThing, SceneCamera, SceneEdits, SceneError,
        SceneOptions, SceneScale, SceneState, SceneStatus, ScoringOptions, SemanticsMode,
        SemanticsState, SemanticsStatus, TextOptions, TextResult, TextView, TextWarning, Trust,
        ViewOptions,
    },
};

/// A message with some fields of the same names and types, and others.
macro_rules! message {
    ($message:ident from $from:ident { $($same:ident),+ } $($other:tt)*) => {
        pb::$message { $($same: $from.$same,)+ $($other)* }
    };
}

/// What a call says of how large a scene is.
pub(super) fn scale_spec(request: pb::SetScaleRequest) -> Result<ScaleSpec> {
    let pb::SetScaleRequest { metres, points, thing, metres_per_unit, .. } = request;
    let points = match &*places(&points)? {
        [] => None,
        [a, b] => Some([*a, *b]),
        more => {
            let what = format!("points has {} points; a length is between 2", more.len());
            return Err(Error::invalid(what));
        }
    };
    let thing = thing.map(|pb::ScaleThing { text, part, side }| {
        let side = value("thing.side", side)?;
        Ok::<_, Error>(ScaleThing { text, part, side })
    });
    Ok(ScaleSpec { metres, points, thing: thing.transpose()?, metres_per_unit })
}

/// Points of the world, three numbers each.
pub(super) fn places(numbers: &[f64]) -> Result<Vec<[f64; 3]>> {
    let (points, rest) = numbers.as_chunks();
    match rest {
        [] => Ok(points.to_vec()),
        _ => Err(Error::invalid(format!("points has {} numbers, not 3 each", numbers.len()))),
    }
}

/// What is known of how large a scene is.
pub(super) fn scale(found: SceneScale) -> pb::SceneScale {
    let ground = |Ground { normal, point, share }: Ground| pb::Ground {
        normal: normal.into(),
        point: point.into(),
        share,
    };
    message!(SceneScale from found { metres_per_unit }
        source: pb::ScaleSource::from(found.source).into(),
        up: found.up.into(),
        ground: found.ground.map(ground),
    )
}

/// Lengths between points.
pub(super) fn measured(found: Measured) -> pb::Measured {
    message!(Measured from found { length, legs, area, heights }
        unit: pb::LengthUnit::from(found.unit).into(),
    )
}

/// Edits and what they come to.
pub(super) fn edits(found: SceneEdits) -> Result<pb::SceneEdits> {
    let edits_json = serde_json::to_string(&found.edits)
        .map_err(|e| Error::internal("the edits cannot be written").caused_by(e))?;
    let SceneEdits { counts, gaussians, uncovered, .. } = found;
    Ok(pb::SceneEdits { edits_json, counts, gaussians, uncovered })
}

/// A scene and its semantics.
pub(super) fn scene(status: SceneStatus) -> pb::Scene {
    let camera = |SceneCamera { file, camera, .. }: SceneCamera| pb::SceneCamera {
        file,
        intrinsics: Some(intrinsics(camera.intrinsics)),
        camera_to_world: matrix(&camera.camera_to_world),
    };
    message!(Scene from status { fraction, created_ms, updated_ms }
        id: status.id.to_string(),
        state: pb::SceneState::from(status.state).into(),
        stage: status.stage.unwrap_or_default(),
        error: status.error.map(scene_error),
        report: status.report.map(report),
        cameras: status.cameras.into_iter().map(camera).collect(),
        semantics: Some(semantics_status(status.semantics)),
        version: status.version,
        refinement: Some(pb::RefineStatus {
            state: pb::RefineState::from(status.refinement.state).into(),
            fraction: status.refinement.fraction,
            error: status.refinement.error.map(scene_error),
        }),
        growth: Some(pb::GrowthStatus {
            state: pb::GrowthState::from(status.growth.state).into(),
            waiting: status.growth.waiting,
            stage: status.growth.stage.unwrap_or_default(),
            fraction: status.growth.fraction,
            error: status.growth.error.map(scene_error),
        }),
    )
}

/// `auto`, `off` or milliseconds; `None` where nothing is said.
pub(super) fn refine(text: &str) -> Result<Option<Refine>> {
    let wrong = |why: String| Error::invalid(format!("refine is {:?}; {why}", short(text)));
    if text.is_empty() { Ok(None) } else { text.parse().map(Some).map_err(wrong) }
}

fn semantics_status(status: SemanticsStatus) -> pb::SemanticsStatus {
    let report = |report: SemanticsReport| {
        message!(SemanticsReport from report
            { masks, bank_size, labelled, bundle_sha256, execution_provider }
            method: Some(method(&report.method)),
            stages: report.stages.into_iter().map(stage_time).collect(),
        )
    };
    message!(SemanticsStatus from status { available, fraction, bank_size }
        reason: status.reason.unwrap_or_default(),
        state: pb::SemanticsState::from(status.state).into(),
        stage: status.stage.unwrap_or_default(),
        error: status.error.map(scene_error),
        report: status.report.map(report),
    )
}

fn stage_time(StageTime { stage, ms }: StageTime) -> pb::StageTime {
    pb::StageTime { stage, ms }
}

fn scene_error(SceneError { code, message }: SceneError) -> pb::SceneError {
    pb::SceneError { code, message }
}

fn report(report: HealthReport) -> pb::HealthReport {
    let [depth_near, depth_far] = report.depth_range;
    let warning = |Warning { code, message, value }: Warning| pb::Warning {
        code: code.to_string(),
        message,
        value,
    };
    let drop_count = |DropCount { reason, count }: DropCount| pb::DropCount { reason, count };
    message!(HealthReport from report
        {
            photos, views_used, gaussians, median_depth, overlap, network_focal_px,
            execution_provider, antialiased
        }
        dropped: report.dropped.into_iter().map(drop_count).collect(),
        depth_near,
        depth_far,
        method: Some(method(&report.method)),
        stages: report.stages.into_iter().map(stage_time).collect(),
        warnings: report.warnings.into_iter().map(warning).collect(),
        refinement: report.refinement.map(refine_report),
        file_format: report.file_format.unwrap_or_default(),
        cameras: Some(cameras_report(report.cameras)),
    )
}

fn cameras_report(report: CamerasReport) -> pb::CamerasReport {
    let placed = |of: PlacedPhoto| message!(PlacedPhoto from of { file, inliers, error_px, k1 });
    let left_out = |LeftOutPhoto { file, reason }| pb::LeftOutPhoto { file, reason };
    message!(CamerasReport from report { confidence }
        source: pb::CamerasSource::from(report.source).into(),
        unit: pb::LengthUnit::from(report.unit).into(),
        placed: report.placed.into_iter().map(placed).collect(),
        left_out: report.left_out.into_iter().map(left_out).collect(),
    )
}

fn refine_report(report: RefineReport) -> pb::RefineReport {
    let moved = |MovedCamera { degrees, share }| pb::MovedCamera { degrees, share };
    message!(RefineReport from report
        {
            steps, seconds, held_out, psnr_before, psnr_after, gaussians_before, gaussians_after,
            left_out, more_photos
        }
        cameras: report.cameras.into_iter().map(moved).collect(),
    )
}

fn intrinsics(Intrinsics { fx, fy, cx, cy, width, height }: Intrinsics) -> pb::Intrinsics {
    pb::Intrinsics { fx, fy, cx, cy, width, height }
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
        Event::Version { version, fraction } => {
            let version = Some(version);
            pb::SceneEvent { version, fraction, ..of(pb::SceneState::Done) }
        }
        Event::Edited { edits } => {
            pb::SceneEvent { edits: Some(edits as u64), ..of(pb::SceneState::Done) }
        }
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
    let &pb::ViewOptions {
        width, height, antialiased, near, front_photos, magnify, detail, ..
    } = options;
    let error = match options.error {
        Some(levels) => MaxError(levels),
        None => value("quality", options.quality)?,
    };
    let preset = given("preset", options.preset)?;
    let of_view = ViewOptions { width, height, antialiased, near, error, ..Default::default() };
    Ok(ViewOptions { preset, front_photos, magnify, detail, ..of_view })
}

/// The same for a call that returns no picture.
fn options_alone(given: Option<pb::ViewOptions>, call: &str) -> Result<ViewOptions> {
    let given = given.unwrap_or_default();
    match given.crop {
        None => options(&given),
        Some(_) => Err(Error::invalid(format!("crop is for views, not for {call}"))),
    }
}

/// Fields of a method that both sides have under one name and type.
macro_rules! method_fields {
    ($same:ident) => {
        $same! {
            prune, fuse_layers, backdrop, skip_covered, seeds, full_resolution, mask_filters,
            crop_whole, crop_margin, context, tracks, lambda, bank_rows, votes, merge_cosine,
            front_photos, magnify
        }
    };
}

/// How a scene was made.
fn method(method: &Method) -> pb::Method {
    macro_rules! message {
        ($($name:ident),+) => {
            pb::Method {
                preset: pb::Preset::from(method.preset).into(),
                density: pb::Density::from(method.density).into(),
                mask_level: pb::MaskLevel::from(method.mask_level).into(),
                camera: pb::CameraUse::from(method.camera).into(),
                $($name: Some(method.$name),)+
            }
        };
    }
    method_fields!(message)
}

/// How a scene is to be made.
pub(super) fn scene_options(header: &pb::CreateSceneHeader) -> Result<SceneOptions> {
    let method = header.method.unwrap_or_default();
    macro_rules! options {
        ($($name:ident),+) => {
            SceneOptions {
                max_views: header.max_views.map(|views| views as usize),
                cameras: value("cameras_mode", header.cameras_mode)?,
                semantics: value("semantics", header.semantics)?,
                refine: refine(&header.refine)?,
                ignore: header.ignore.clone(),
                preset: value("preset", method.preset)?,
                density: given("density", method.density)?,
                mask_level: given("mask_level", method.mask_level)?,
                camera: given("camera", method.camera)?,
                $($name: method.$name,)+
            }
        };
    }
    Ok(method_fields!(options))
}

/// Changes of how texts are scored.
fn scoring(scoring: Option<pb::Scoring>) -> ScoringOptions {
    let pb::Scoring { canon, tau, cut, unit_rows, coverage_floor, near_best, margin, rivals } =
        scoring.unwrap_or_default();
    ScoringOptions { canon, tau, cut, unit_rows, coverage_floor, near_best, margin, rivals }
}

fn scored(method: ScoringMethod) -> pb::Scoring {
    pb::Scoring {
        canon: method.canon,
        tau: Some(method.tau),
        cut: Some(method.cut),
        unit_rows: Some(method.unit_rows),
        coverage_floor: Some(method.coverage_floor),
        near_best: Some(method.near_best),
        margin: Some(method.margin),
        rivals: Some(method.rivals),
    }
}

/// The features of a view.
pub(super) fn features(request: pb::FeaturesRequest) -> Result<FeaturesSpec> {
    Ok(FeaturesSpec {
        camera: camera(request.camera, "features")?,
        options: options_alone(request.options, "features")?,
        kind: value("kind", request.kind)?,
        scoring: scoring(request.scoring),
        wait: request.semantics_wait_ms.map(Duration::from_millis),
    })
}

/// How a view is encoded.
pub(super) fn picture(options: &pb::ViewOptions) -> Result<PictureOptions> {
    #[expect(clippy::cast_possible_truncation, reason = "a colour fits f32")]
    let color = |v: pb::Vec3| BackgroundSpec::Color([v.x as f32, v.y as f32, v.z as f32]);
    let crop = |crop: pb::Region| [crop.x, crop.y, crop.width, crop.height].into();
    Ok(PictureOptions {
        format: value("format", options.format)?,
        background: options.background.map(color).unwrap_or_default(),
        crop: options.crop.map(crop),
    })
}

/// One encoded picture.
pub(super) fn view(view: RenderedView) -> pb::View {
    message!(View from view { width, height, depth_scale, error, detail, etag }
        render_ms: view.times.render_ms,
        camera_index: u32::try_from(view.camera_index).unwrap_or(u32::MAX),
        kind: pb::Kind::from(view.kind).into(),
        format: pb::Format::from(view.format).into(),
        data: view.bytes.into(),
        intrinsics: Some(intrinsics(view.camera.intrinsics)),
        camera_to_world: matrix(&view.camera.camera_to_world),
        visible: view.stats.visible,
    )
}

/// proto3 cannot tell an empty text from none.
pub(super) fn not_empty(text: String) -> Option<String> {
    Some(text).filter(|text| !text.is_empty())
}

/// The text of a view or an export, and how it is scored.
pub(super) fn text(text: String, how: Option<pb::Scoring>, wait_ms: Option<u64>) -> TextOptions {
    TextOptions {
        text: not_empty(text),
        scoring: scoring(how),
        wait: wait_ms.map(Duration::from_millis),
    }
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
        scoring: scoring(request.scoring),
        wait: request.semantics_wait_ms.map(Duration::from_millis),
    })
}

/// What a query found.
pub(super) fn answer(answer: QueryAnswer) -> pb::QueryResponse {
    let camera = answer.camera;
    message!(QueryResponse from answer { bank_size, render_ms }
        scoring: Some(scored(answer.scoring)),
        intrinsics: camera.map(|camera| intrinsics(camera.intrinsics)),
        camera_to_world: camera.map_or_else(Vec::new, |camera| matrix(&camera.camera_to_world)),
        results: answer.results.into_iter().map(result).collect(),
    )
}

fn result(found: TextResult) -> pb::TextResult {
    let warning = |TextWarning { code, message }: TextWarning| pb::TextWarning { code, message };
    message!(TextResult from found { text, scores, found, gaussians }
        word: found.word.unwrap_or_default(),
        trust: found.trust.map(|trust| trust.to_string()).unwrap_or_default(),
        entries: found.entries.into_iter().map(u32::from).collect(),
        parts: found.parts.into_iter().map(part).collect(),
        warnings: found.warnings.into_iter().map(warning).collect(),
        view: found.view.map(text_view),
    )
}

fn point([x, y, z]: [f64; 3]) -> pb::Vec3 {
    pb::Vec3 { x, y, z }
}

fn part(part: InstanceBox) -> pb::Part {
    pb::Part {
        gaussians: part.gaussians,
        score: part.score,
        center: Some(point(part.center)),
        axes: part.axes.iter().copied().map(point).collect(),
        size: Some(point(part.size)),
        centroid: Some(point(part.centroid)),
        covariance: part.covariance.concat(),
        visibility: part.visibility,
    }
}

fn text_view(view: TextView) -> pb::TextView {
    let peak = |Peak { x, y, relevancy }: Peak| pb::Peak { x, y, relevancy };
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
        scoring: scoring(request.scoring),
        wait: request.semantics_wait_ms.map(Duration::from_millis),
    })
}

/// What lies under it.
pub(super) fn picked(picked: Picked) -> pb::PickResponse {
    let label = |Label { text, relevancy }: Label| pb::Label { text, relevancy };
    message!(PickResponse from picked { alpha, depth, gaussian }
        point: picked.point.map(point),
        entry: picked.entry.map(u32::from),
        labels: picked.labels.into_iter().map(label).collect(),
    )
}

/// What makes the scenes.
pub(super) fn models(info: ModelsInfo) -> pb::ModelsResponse {
    let model = |model: ModelInfo| {
        let size = |[height, width]: [u32; 2]| pb::Size { height, width };
        message!(Model from model { name, file, sha256, size_bytes, licence }
            views_max: u32::try_from(model.views_max).unwrap_or(u32::MAX),
            sizes: model.sizes.into_iter().map(size).collect(),
        )
    };
    let word = |known: KnownWord| {
        message!(KnownWord from known
            { word, things, things_found, photographs, photographs_found, absent }
            trust: pb::Trust::from(known.trust).into(),
        )
    };
    let limits = |limits: CallerLimits| {
        message!(CallerLimits from limits
            { photo_pixels_max, photo_side_kept_max, photos_pixels_kept_max }
            photos_max: limits.photos_max as u64,
            network_photos_max: limits.network_photos_max as u64,
            upload_bytes_max: limits.upload_bytes_max as u64,
            cameras_max: limits.cameras_max as u64,
        )
    };
    message!(ModelsResponse from info
        { bundle, bundle_sha256, execution_provider, renderer, server_version }
        limits: Some(limits(info.limits)),
        models: info.models.into_iter().map(model).collect(),
        words: info.words.into_iter().map(word).collect(),
    )
}

/// The value of a message's enum; `name` names it in messages.
pub(super) fn value<T: FromNumber>(name: &str, number: i32) -> Result<T> {
    T::from_number(number)
        .ok_or_else(|| Error::invalid(format!("{name} is {number}; there is no such value")))
}

/// The same where 0 says nothing.
pub(super) fn given<T: FromNumber>(name: &str, number: i32) -> Result<Option<T>> {
    if number == 0 { Ok(None) } else { value(name, number).map(Some) }
}

/// An enum that a message has as a number. Any number may come; 0 is the default.
pub(super) trait FromNumber: Sized {
    fn from_number(number: i32) -> Option<Self>;
}

/// Enums of ours that become numbers of a message, with the values that both have.
macro_rules! to_number {
    ($($ours:ident = $theirs:ident { $($value:ident),+ })+) => {$(
        impl From<$ours> for pb::$theirs {
            fn from(value: $ours) -> Self {
                match value { $($ours::$value => Self::$value,)+ }
            }
        }
    )+};
}

/// The same in both directions.
macro_rules! both_ways {
    ($($ours:ident = $theirs:ident { $($value:ident),+ })+) => {$(
        to_number! { $ours = $theirs { $($value),+ } }

        impl FromNumber for $ours {
            fn from_number(number: i32) -> Option<Self> {
                Some(match pb::$theirs::try_from(number).ok()? {
                    pb::$theirs::Unspecified => Self::default(),
                    $(pb::$theirs::$value => Self::$value,)+
                })
            }
        }
    )+};
}

to_number! {
    SceneState = SceneState { Queued, Running, Done, Failed, Cancelled }
    GrowthState = GrowthState { None, Running, Done, Failed }
    RefineState = RefineState { None, Running, Done, Failed }
    SemanticsState = SemanticsState { Off, None, Running, Ready, Failed }
    CamerasSource = CamerasSource { Given, Solved }
    LengthUnit = LengthUnit { Unknown, Metre }
    ScaleSource = ScaleSource { None, Capture, Given }
    Trust = Trust { Good, Fair, Poor, Unmeasured }
}

both_ways! {
    CamerasMode = CamerasMode { Auto, Solve }
    CameraUse = CameraUse { Mended, Given }
    SemanticsMode = Semantics { Lazy, Eager, Off }
    Density = Density { Thinned, Full }
    PictureKind = Kind { Color, Depth, Alpha, Holes, Semantics, Relevancy, Mask }
    Format = Format { Png, Jpeg, Webp, Npy, Rgb8, Rgba8, Grey8 }
    Preset = Preset { Default, Paper }
    MaskLevel = MaskLevel { Widest, Whole, Part, Subpart }
    FeatureKind = FeatureKind { Weights, Features }
    BoxSide = BoxSide { Height, Width, Depth, Longest }
    Boxes = Boxes { Oriented, Upright, Aligned, None }
    MaskFormat = MaskFormat { Rle, Png, None }
}

/// Names of two errors.
impl FromNumber for MaxError {
    fn from_number(number: i32) -> Option<Self> {
        Some(match pb::Quality::try_from(number).ok()? {
            pb::Quality::Unspecified | pb::Quality::Exact => Self::default(),
            pb::Quality::Fast => Self(ERROR_FAST),
        })
    }
}

/// The table of formats has the numbers of the message.
impl FromNumber for ExportFormat {
    fn from_number(number: i32) -> Option<Self> {
        if number == 0 {
            Some(Self::default())
        } else {
            Self::all().find(|of| *of as i32 == number)
        }
    }
}
