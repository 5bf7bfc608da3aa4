//! How well the boxes of what texts select hold the things of rendered scenes.
//!
//! `scene.json` of such a scene has for each thing its name and its smallest upright box, from the
//! mesh: also what no photo shows. A scene is made of photos spread over its frames, the names are
//! asked in space, and of the parts of a name as many as there are things of it are judged, the
//! best first.

use std::path::Path;

use glam::DVec3;
use segsplat_vision::semantics::{Box3, Instance, InstanceOptions};
use serde::Deserialize;
use serde_json::{Value, json};

use super::{
    labels::LabelledScene,
    views::{Made, Tools, Way, scorer},
};
use crate::{
    error::{Error, Result},
    rows::{mean, median},
    scenes::spread,
};

/// Points along each side of a box by which its overlap with another is counted.
const GRID: u32 = 32;
/// Share of the pixels of all frames under which a thing is not judged.
const SHARE_MIN: f64 = 0.003;

/// A thing of a rendered scene.
#[derive(Debug, Deserialize)]
struct Thing {
    name: String,
    /// Mean share of a frame's pixels.
    share: f64,
    #[serde(rename = "box")]
    held: Held,
}

/// A box as `scene.json` has it.
#[derive(Debug, Deserialize)]
struct Held {
    center: [f64; 3],
    size: [f64; 3],
    axes: [[f64; 3]; 3],
}

#[derive(Debug, Deserialize)]
struct Things {
    objects: Vec<Thing>,
}

/// The figures of a scene: of all its things the mean of the best overlap (IoU, 0 where nothing of
/// the name is found), for each kind of box; of those that are found how the upright box compares
/// with the thing; and parts that hold no thing of their name.
pub(super) fn judge(
    tools: &Tools<'_>,
    way: &Way,
    dir: &Path,
    scene: &LabelledScene,
    photos: usize,
) -> Result<Value> {
    let wrong = || Error::invalid("scene.json: no `objects`, each with a `box`");
    let text = fs_err::read(dir.join("scene.json")).map_err(|e| wrong().caused_by(e))?;
    let things: Things = serde_json::from_slice(&text).map_err(|e| wrong().caused_by(e))?;
    let things: Vec<Thing> = things.objects.into_iter().filter(|t| t.share >= SHARE_MIN).collect();
    let given = spread(scene.photos.len(), &[], photos);
    let made = tools.make(&scene.photos, &given, way)?;

    let mut names: Vec<&str> = things.iter().map(|thing| &*thing.name).collect();
    names.sort_unstable();
    names.dedup();
    let (mut rows, mut more) = (Vec::new(), 0);
    for name in &names {
        let of: Vec<&Thing> = things.iter().filter(|thing| thing.name == **name).collect();
        let parts = parts(tools, &made, way, name)?;
        let judged = &parts[..parts.len().min(of.len())];
        more += parts.len() - judged.len();
        rows.extend(of.into_iter().map(|thing| compared(thing, judged)));
    }
    let of = |key: &str| rows.iter().filter_map(|row| row[key].as_f64()).collect::<Vec<f64>>();
    let long = of("height").iter().zip(of("length")).filter(|(h, l)| h.max(*l) > 1.5).count();
    Ok(json!({
        "things": rows,
        "upright_iou": mean(of("upright")),
        "oriented_iou": mean(of("oriented")),
        "aligned_iou": mean(of("aligned")),
        "height": median(of("height")),
        "length": median(of("length")),
        "over_half_too_long": long,
        "more_parts": more,
        "names": names.len(),
    }))
}

/// The parts that a text selects, as a query gives them: the best first.
fn parts(tools: &Tools<'_>, made: &Made, way: &Way, text: &str) -> Result<Vec<Instance>> {
    let touching = made.components.touching_entries();
    let scorer = scorer(&made.bank, &made.views, &touching, &way.scoring)?;
    let rows = tools.texts(&[text.to_owned()])?;
    let scores = scorer.text(rows.first().map_or(&[], Vec::as_slice))?;
    let rows = u16::try_from(made.bank.len()).unwrap_or(u16::MAX);
    let entries: Vec<u16> = (1..=rows).filter(|m| scores.selects(*m)).collect();
    let (gaussians, options) = (&made.scene.gaussians, InstanceOptions::default());
    let mut parts = made.components.instances(gaussians, &entries, &options);
    let score = |part: &Instance| part.score(scores.relevancies());
    parts.sort_by(|a, b| score(b).total_cmp(&score(a)));
    Ok(parts)
}

/// A thing beside the part that overlaps it most.
fn compared(thing: &Thing, parts: &[Instance]) -> Value {
    let Held { center, size, axes } = thing.held;
    let truth = Box3 { center, size, axes };
    let best = |held: &dyn Fn(&Instance) -> Box3| {
        let each = parts.iter().map(|part| (iou(&truth, &held(part)), held(part)));
        each.max_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or_default()
    };
    let (upright, held) = best(&Instance::upright);
    let mut row = json!({
        "name": thing.name,
        "upright": upright,
        "oriented": best(&Instance::oriented).0,
        "aligned": best(&Instance::aligned).0,
    });
    if upright > 0.0 {
        let longer = |size: [f64; 3]| size[0].max(size[1]);
        row["height"] = json!(held.size[2] / size[2]);
        row["length"] = json!(longer(held.size) / longer(size));
    }
    row
}

/// Volume that two boxes share, over that of both.
fn iou(a: &Box3, b: &Box3) -> f64 {
    let share = |at: u32| (f64::from(at) + 0.5) / f64::from(GRID) - 0.5;
    let inside = |x: u32, y: u32, z: u32| {
        let own = [x, y, z].map(share);
        let along = own.iter().zip(a.size).zip(a.axes);
        let at: DVec3 = along.map(|((own, size), axis)| DVec3::from(axis) * (own * size)).sum();
        let from = at + DVec3::from(a.center) - DVec3::from(b.center);
        b.axes
            .iter()
            .zip(b.size)
            .all(|(axis, size)| from.dot(DVec3::from(*axis)).abs() <= size / 2.0)
    };
    let all =
        (0..GRID).flat_map(|x| (0..GRID).flat_map(move |y| (0..GRID).map(move |z| (x, y, z))));
    let within = all.filter(|&(x, y, z)| inside(x, y, z)).count();
    let volume = |of: &Box3| of.size.iter().product::<f64>();
    let both = volume(a) * within as f64 / f64::from(GRID.pow(3));
    both / (volume(a) + volume(b) - both)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_overlap_of_boxes_is_that_of_their_volumes() {
        let axes = [[1.0, 0.0, 0.0], [0.0, 1.0, 0.0], [0.0, 0.0, 1.0]];
        let unit = Box3 { center: [0.0; 3], size: [1.0; 3], axes };
        let moved = Box3 { center: [0.5, 0.0, 0.0], ..unit };
        assert!((iou(&unit, &unit) - 1.0).abs() < 1e-12);
        assert!((iou(&unit, &moved) - 1.0 / 3.0).abs() < 1e-12);
        assert!(iou(&unit, &Box3 { center: [1.5, 0.0, 0.0], ..unit }).abs() < 1e-12);
        // The overlap of a square with itself turned by 45 degrees is a regular octagon.
        let h = 0.5_f64.sqrt();
        let turned = Box3 { axes: [[h, h, 0.0], [-h, h, 0.0], [0.0, 0.0, 1.0]], ..unit };
        let octagon = 2.0 * (2.0_f64.sqrt() - 1.0);
        assert!((iou(&unit, &turned) - octagon / (2.0 - octagon)).abs() < 0.02);
    }
}
