//! From what callers ask for to edits of Gaussians: texts become entries of the bank, or the
//! Gaussians that a network found in the photos; parts and picks become these and a box.

use std::sync::Arc;

use glam::{DVec3, Vec3};

use super::spec::{Asked, EditSpec};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
    scene::{Edit, Editing, FLOATERS_PHOTOS_MIN, Gaussians, Place, Scene, Selected},
    semantics::{Components, Instance, InstanceOptions},
    service::{
        pick,
        request::PickSpec,
        search::{Backend, FindWords, SceneTexts, ScoringChoice, SemanticScene},
        texts,
    },
};

/// How much larger than its Gaussians the box of a part is: what a version may move them by.
const PART_SLACK: f64 = 1e-3;
/// How far a point may be from the Gaussian that it takes: largest scales of the Gaussian, and
/// beside them median depths of the scene.
const POINT_REACH: [f32; 2] = [2.0, 0.01];

/// Edits that are ready to be applied, and the Gaussians that each took.
#[derive(Debug)]
pub(super) struct ResolvedEdits {
    pub(super) edits: Vec<Edit>,
    pub(super) counts: Vec<u64>,
    pub(super) gaussians: Gaussians,
}

/// Checks a list of edits; nothing is made for it.
pub(super) fn check(specs: &[EditSpec], limits: &Limits) -> Result<()> {
    if specs.len() > limits.edits_max {
        return Err(Error::limit("edits", specs.len(), limits.edits_max));
    }
    for (i, spec) in specs.iter().enumerate() {
        let at = format!("edits[{i}]");
        spec.action(&at)?;
        spec.asked(&at, limits)?;
    }
    Ok(())
}

/// Resolves checked edits on a scene that has none, one after the other. Texts take what a query
/// shows: with `find` they are found in the scene's photos, where that can be. Blocks.
pub(super) fn resolve(
    backend: &Arc<Backend>,
    find: Option<&FindWords<'_>>,
    limits: &Limits,
    base: &Arc<Scene>,
    specs: &[EditSpec],
) -> Result<ResolvedEdits> {
    let mut editing = Editing::new(&base.gaussians, &base.meta.cameras, limits.gaussians_max);
    let (mut edits, mut counts) = (Vec::new(), Vec::new());
    for (i, spec) in specs.iter().enumerate() {
        let at = format!("edits[{i}]");
        let of = match spec.asked(&at, limits)? {
            Asked::Floaters => {
                let photos = base.meta.cameras.len();
                if photos < FLOATERS_PHOTOS_MIN {
                    let needs =
                        format!("floaters are known of {FLOATERS_PHOTOS_MIN} photos and more");
                    let has = format!("{at}.select: the scene has {photos} photos");
                    return Err(Error::invalid(format!("{has}; {needs}")));
                }
                Selected { floaters: true, ..Selected::default() }
            }
            Asked::Place(place) => Selected { within: vec![place], ..Selected::default() },
            Asked::Text { text, parts, scoring } => {
                let how = ScoringChoice { preset: None, changes: scoring };
                let scored = SceneTexts::new(backend, semantic(base, &at)?, &how, &[text], find)?;
                of_text(&scored, base, &editing, parts.as_deref(), limits, &at)?
            }
            Asked::Point(point) => {
                let now = semantic(base, &at)?.scene;
                of_point(&now.after_edits(editing.gaussians()?, String::new()), point)
            }
            Asked::Pick(asked) => {
                let now = semantic(base, &at)?.scene;
                let now = now.after_edits(editing.gaussians()?, String::new());
                of_pick(&now, &asked, limits)
                    .map_err(|e| named(&e, &format!("{at}.select.pick")))?
            }
        };
        let edit = Edit { action: spec.action(&at)?, of };
        counts.push(editing.apply(&edit).map_err(|e| named(&e, &at))?);
        edits.push(edit);
        if editing.is_empty() {
            return Err(Error::invalid(format!("{at} leaves nothing of the scene")));
        }
    }
    Ok(ResolvedEdits { edits, counts, gaussians: editing.gaussians()? })
}

/// The error with what it is about.
fn named(error: &Error, at: &str) -> Error {
    Error::new(error.code(), format!("{at}: {}", error.message()))
}

/// What a text takes of the Gaussians as they are now: all that it selects, or these parts of it.
fn of_text(
    scored: &SceneTexts,
    base: &Scene,
    editing: &Editing<'_>,
    parts: Option<&[u32]>,
    limits: &Limits,
    at: &str,
) -> Result<Selected> {
    let entries = scored.texts.first().map_or_else(Vec::new, |text| text.selected());
    let index = scored.of.scene.gaussians.semantic_index();
    let of_photos = scored.is_of_photos();
    let within = match parts {
        None => Vec::new(),
        Some(parts) => {
            let mut now = editing.gaussians()?;
            if of_photos {
                let entry = |number: u32| index[number as usize];
                now =
                    now.with_semantic_index(editing.numbers().into_iter().map(entry).collect())?;
            }
            let now = base.after_edits(now, String::new());
            part_boxes(scored, &now, &entries, parts, limits, at)?
        }
    };
    if !of_photos {
        return Ok(Selected { entries: Some(entries), within, ..Selected::default() });
    }
    // Entries of such texts are of this call.
    let mut numbers: Vec<[u32; 2]> = Vec::new();
    for (number, _) in (0..).zip(index).filter(|(_, m)| entries.binary_search(m).is_ok()) {
        match numbers.last_mut() {
            Some([first, count]) if *first + *count == number => *count += 1,
            _ => numbers.push([number, 1]),
        }
    }
    Ok(Selected { numbers: Some(numbers), within, ..Selected::default() })
}

/// The thing at a pixel of a view of the scene as it is now.
fn of_pick(now: &Scene, asked: &PickSpec, limits: &Limits) -> Result<Selected> {
    let view = pick::pick_view(limits, now, asked)?;
    let picked = pick::pick(None, now, &view, [asked.x, asked.y])?;
    let (Some(number), Some(entry)) = (picked.gaussian, picked.entry) else {
        return Err(Error::invalid("nothing with a label is at this pixel"));
    };
    Ok(part_with(now, number, entry))
}

/// The thing at a point of the world, or nothing where nothing with a label is near.
fn of_point(now: &Scene, point: DVec3) -> Selected {
    let gaussians = &now.gaussians;
    let place = (point - gaussians.origin()).as_vec3();
    let away = |i: usize| Vec3::from(gaussians.means()[i]).distance(place);
    let labelled = gaussians.semantic_index().iter().enumerate().filter(|(_, entry)| **entry > 0);
    let nearest = labelled.min_by(|a, b| away(a.0).total_cmp(&away(b.0)));
    let reach = |i: usize| {
        let largest = gaussians.scales()[i].into_iter().fold(0.0, f32::max);
        POINT_REACH[0] * largest + POINT_REACH[1] * now.meta.report.median_depth as f32
    };
    match nearest {
        Some((i, &entry)) if away(i) <= reach(i) => part_with(now, i as u64, entry),
        _ => Selected { entries: Some(Vec::new()), ..Selected::default() },
    }
}

/// The connected part of an entry that a Gaussian is in.
fn part_with(now: &Scene, number: u64, entry: u16) -> Selected {
    let all = InstanceOptions { count_min: 1, share_min: 0.0, ..Default::default() };
    let found = instances(now, &[entry], &all);
    let holds = |part: &&Instance| part.gaussians.iter().any(|&i| u64::from(i) == number);
    let within = found.iter().find(holds).map(|part| box_of(part, &now.gaussians));
    let within = within.into_iter().collect();
    Selected { entries: Some(vec![entry]), within, ..Selected::default() }
}

fn semantic(base: &Arc<Scene>, at: &str) -> Result<SemanticScene> {
    SemanticScene::new(Arc::clone(base)).ok_or_else(|| {
        let why = format!("{at}.select needs the scene's semantics, which are not ready");
        Error::new(ErrorCode::SceneNotReady, why)
    })
}

fn instances(now: &Scene, entries: &[u16], options: &InstanceOptions) -> Vec<Instance> {
    let components = Components::new(&now.gaussians, &now.meta.cameras, options);
    components.instances(&now.gaussians, entries, options)
}

/// The boxes of these parts of what a text selects, in the order that a query gives them.
fn part_boxes(
    scored: &SceneTexts,
    now: &Scene,
    entries: &[u16],
    parts: &[u32],
    limits: &Limits,
    at: &str,
) -> Result<Vec<Place>> {
    texts::check_count("parts", parts.len(), limits.parts_max)?;
    let mut found = instances(now, entries, &InstanceOptions::default());
    found.truncate(limits.parts_max);
    let relevancies = scored.texts.first().map_or(&[][..], |text| text.scores.relevancies());
    found.sort_by(|a, b| b.score(relevancies).total_cmp(&a.score(relevancies)));
    let place = |part: &u32| match found.get(*part as usize) {
        Some(instance) => Ok(box_of(instance, &now.gaussians)),
        None => {
            let has = format!("the text has {} parts", found.len());
            Err(Error::invalid(format!("{at}.select.parts has {part}; {has}, counted from 0")))
        }
    };
    parts.iter().map(place).collect()
}

/// The box along the axes of a part that holds the centres of all its Gaussians.
fn box_of(part: &Instance, gaussians: &Gaussians) -> Place {
    let axes = part.oriented().axes;
    let mut bounds = axes.map(|_| [f64::INFINITY, f64::NEG_INFINITY]);
    for &i in &part.gaussians {
        let mean = gaussians.means()[i as usize].map(f64::from);
        let point = DVec3::from(mean) + gaussians.origin();
        for (axis, [least, most]) in axes.iter().zip(&mut bounds) {
            let along = DVec3::from(*axis).dot(point);
            (*least, *most) = (least.min(along), most.max(along));
        }
    }
    let sides = axes.iter().zip(&bounds);
    let center: DVec3 = sides.map(|(axis, [a, b])| DVec3::from(*axis) * (0.5 * (a + b))).sum();
    let longest = bounds.iter().map(|[a, b]| b - a).fold(0.0, f64::max);
    let size = bounds.map(|[a, b]| b - a + PART_SLACK * longest);
    Place::Box { center: center.to_array(), size, axes }
}
