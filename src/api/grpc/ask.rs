//! Texts asked of a scene: messages to use cases and back.

use std::time::Duration;

use super::{
    convert::{camera, intrinsics, known, matrix, options, profile},
    pb,
};
use crate::{
    error::Result,
    scene::ScoringProfile,
    service::{
        Ask, Boxes, MaskFormat, Part3, PickSpec, Picked, QueryAnswer, QuerySpec, TextResult,
        TextView,
    },
};

fn scored(number: i32) -> Result<ScoringProfile> {
    match known::<pb::ScoringProfile>("profile", number)? {
        pb::ScoringProfile::Unspecified | pb::ScoringProfile::Default => {
            Ok(ScoringProfile::Default)
        }
        pb::ScoringProfile::Paper => Ok(ScoringProfile::Paper),
    }
}

/// What a view or an export asks by text; an empty text is none.
pub(super) fn ask(text: String, profile: i32, wait_ms: Option<u64>) -> Result<Ask> {
    Ok(Ask {
        text: Some(text).filter(|text| !text.is_empty()),
        profile: scored(profile)?,
        wait: wait_ms.map(Duration::from_millis),
    })
}

/// A query.
pub(super) fn query(request: pb::QueryRequest) -> Result<QuerySpec> {
    let boxes = match known::<pb::Boxes>("boxes", request.boxes)? {
        pb::Boxes::Unspecified | pb::Boxes::Oriented => Boxes::Oriented,
        pb::Boxes::Aligned => Boxes::Aligned,
        pb::Boxes::None => Boxes::None,
    };
    let mask = match known::<pb::MaskFormat>("mask", request.mask)? {
        pb::MaskFormat::Unspecified | pb::MaskFormat::Rle => MaskFormat::Rle,
        pb::MaskFormat::Png => MaskFormat::Png,
        pb::MaskFormat::None => MaskFormat::None,
    };
    let view = request.camera.map(|given| camera(Some(given), "camera")).transpose()?;
    Ok(QuerySpec {
        texts: request.texts,
        camera: view,
        options: options(request.options)?,
        boxes,
        mask,
        relevancy: request.relevancy,
        profile: scored(request.profile)?,
        wait: request.semantics_wait_ms.map(Duration::from_millis),
    })
}

/// What a query found.
pub(super) fn answer(answer: QueryAnswer) -> pb::QueryResponse {
    let camera = answer.camera;
    pb::QueryResponse {
        bank_size: answer.bank_size,
        profile: profile(answer.profile).into(),
        intrinsics: camera.map(|camera| intrinsics(camera.intrinsics)),
        camera_to_world: camera.map_or_else(Vec::new, |camera| matrix(&camera.camera_to_world)),
        render_ms: answer.render_ms,
        results: answer.results.into_iter().map(result).collect(),
    }
}

fn result(found: TextResult) -> pb::TextResult {
    let warning = |warning: crate::service::TextWarning| pb::TextWarning {
        code: warning.code,
        message: warning.message,
    };
    pb::TextResult {
        text: found.text,
        scores: found.scores,
        entries: found.entries.into_iter().map(u32::from).collect(),
        gaussians: found.gaussians,
        parts: found.parts.iter().map(part).collect(),
        warnings: found.warnings.into_iter().map(warning).collect(),
        view: found.view.map(view),
    }
}

fn point([x, y, z]: [f64; 3]) -> pb::Vec3 {
    pb::Vec3 { x, y, z }
}

fn part(part: &Part3) -> pb::Part {
    pb::Part {
        gaussians: part.gaussians,
        center: Some(point(part.center)),
        axes: part.axes.iter().copied().map(point).collect(),
        size: Some(point(part.size)),
    }
}

fn view(view: TextView) -> pb::TextView {
    let peak =
        |peak: crate::service::Peak| pb::Peak { x: peak.x, y: peak.y, relevancy: peak.relevancy };
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
        options: options(request.options)?,
        labels: request.labels,
        profile: scored(request.profile)?,
        wait: request.semantics_wait_ms.map(Duration::from_millis),
    })
}

/// What lies under it.
pub(super) fn picked(picked: Picked) -> pb::PickResponse {
    let label =
        |label: crate::service::Label| pb::Label { text: label.text, relevancy: label.relevancy };
    pb::PickResponse {
        alpha: picked.alpha,
        depth: picked.depth,
        point: picked.point.map(point),
        gaussian: picked.gaussian,
        entry: picked.entry.map(u32::from),
        labels: picked.labels.into_iter().map(label).collect(),
    }
}
