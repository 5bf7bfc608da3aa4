//! Where what is labelled gets lost on its way to what a word selects.
//!
//! Four figures of a word in a view, each an IoU with its label: the best mask of a photo
//! (*outlined*), the best row of the bank as the view shows it (*lifted*), all rows that are mostly
//! of the word together (*named*: what perfect names would select), and what the text selects. A
//! pixel shows the row that weighs most in it.

use std::collections::BTreeMap;

use segsplat_vision::semantics::TextScores;
use serde_json::{Value, json};

use super::labels::{LabelledFrame, LabelledScene, NOT_SEEN};
use crate::{render::PixelWeights, rows::mean, scene::IndexMap};

/// Pixels of numbered regions and of labels, and of both.
#[derive(Debug, Default)]
struct Regions {
    both: BTreeMap<(u16, u16), u64>,
    regions: BTreeMap<u16, u64>,
    labels: BTreeMap<u16, u64>,
}

impl Regions {
    fn new(label: &[u16], region: impl Fn(usize) -> u16) -> Self {
        let mut all = Self::default();
        for (p, &label) in label.iter().enumerate().filter(|(_, label)| **label != NOT_SEEN) {
            let region = region(p);
            *all.both.entry((region, label)).or_default() += 1;
            *all.regions.entry(region).or_default() += 1;
            *all.labels.entry(label).or_default() += 1;
        }
        all
    }

    /// IoU of regions together with a label.
    fn iou(&self, regions: &[u16], label: u16) -> f64 {
        let sum = |of: &dyn Fn(u16) -> u64| regions.iter().map(|&region| of(region)).sum::<u64>();
        let both = sum(&|region| self.both.get(&(region, label)).copied().unwrap_or(0));
        let region = sum(&|region| self.regions.get(&region).copied().unwrap_or(0));
        let all = region + self.labels.get(&label).copied().unwrap_or(0) - both;
        if all == 0 { 0.0 } else { both as f64 / all as f64 }
    }

    /// The region that fits a label best; region 0 is none.
    fn best(&self, label: u16) -> (u16, f64) {
        let each = self.regions.keys().filter(|region| **region > 0);
        let each = each.map(|&region| (region, self.iou(&[region], label)));
        each.max_by(|a, b| a.1.total_cmp(&b.1)).unwrap_or_default()
    }

    /// The label of most pixels of a region.
    fn mostly(&self, region: u16) -> u16 {
        let of = self.both.iter().filter(|((of, _), _)| *of == region);
        of.max_by_key(|(_, count)| **count).map_or(0, |((_, label), _)| *label)
    }
}

/// The figures of each class that is asked and labelled in the view. `outlined` are the files of
/// the photos put in and what each has at its cells, `texts` and `selected` the scores and masks of
/// the asked classes in their order.
pub(super) fn of_view(
    scene: &LabelledScene,
    target: &LabelledFrame,
    outlined: &[(String, IndexMap)],
    weights: &PixelWeights,
    texts: &[(TextScores, Vec<bool>)],
) -> Vec<Value> {
    let shown = |p: usize| {
        let best = weights.pixel(p).max_by(|a, b| a.1.total_cmp(&b.1));
        best.map_or(0, |(row, _)| row)
    };
    let view = Regions::new(&target.label, shown);
    let labelled = outlined.iter().filter_map(|(file, map)| {
        let frame = scene.frames.iter().find(|frame| scene.photos[frame.photo].file == *file)?;
        let photo = &scene.photos[frame.photo].photo;
        let (width, height) = (photo.width as usize, photo.height as usize);
        let share = |at: usize, of: usize| (at as f64 + 0.5) / of as f64;
        let entry = |p: usize| map.at(share(p % width, width), share(p / width, height));
        Some(Regions::new(&frame.label, entry))
    });
    let photos: Vec<Regions> = labelled.collect();
    let name = |label: u16| match usize::from(label).checked_sub(1) {
        Some(class) => scene.classes[class].name.clone(),
        None => "no label".to_owned(),
    };
    let asked = scene.classes.iter().zip(1_u16..).filter(|(class, _)| class.asked);
    let figures = asked.zip(texts).filter_map(|((_, label), (text, mask))| {
        view.labels.get(&label)?;
        let (row, lifted) = view.best(label);
        let rows = || view.regions.keys().copied().filter(|row| *row > 0);
        let mostly: Vec<u16> = rows().filter(|&row| view.mostly(row) == label).collect();
        let fit = |row: u16| text.relevancies().get(usize::from(row)).copied().unwrap_or(0.0);
        let first = rows().max_by(|a, b| fit(*a).total_cmp(&fit(*b))).unwrap_or(0);
        let taken = Regions::new(&target.label, |p| u16::from(mask[p]));
        let outlined = photos.iter().filter(|photo| photo.labels.contains_key(&label));
        Some(json!({
            "name": name(label),
            "outlined": outlined.map(|photo| photo.best(label).1).collect::<Vec<f64>>(),
            "lifted": lifted,
            "named": view.iou(&mostly, label),
            "selected": taken.iou(&[1], label),
            "score": fit(row),
            "rank": 1 + rows().filter(|&other| fit(other) > fit(row)).count(),
            "first": name(view.mostly(first)),
            "first_score": fit(first),
        }))
    });
    figures.collect()
}

/// A line for each word: means over the views that show it.
pub(super) fn told(views: &[Value]) -> Vec<String> {
    let mut words: BTreeMap<&str, Vec<&Value>> = BTreeMap::new();
    for of in views {
        words.entry(of["name"].as_str().unwrap_or_default()).or_default().push(of);
    }
    let line = |(word, of): (&&str, &Vec<&Value>)| {
        let over = |key: &str| mean(of.iter().filter_map(|view| view[key].as_f64()));
        let outlines = |view: &&Value| view["outlined"].as_array().cloned().unwrap_or_default();
        let outlined = mean(of.iter().flat_map(outlines).filter_map(|iou| iou.as_f64()));
        let keys = ["lifted", "named", "selected", "score", "rank"].map(over);
        let first: Vec<&str> = of.iter().filter_map(|view| view["first"].as_str()).collect();
        format!(
            "  {word}: outlined {outlined:.2}, lifted {:.2}, named {:.2}, selected {:.2}; score \
             {:.2}, rank {:.1}, first {}",
            keys[0],
            keys[1],
            keys[2],
            keys[3],
            keys[4],
            first.join(", "),
        )
    };
    words.iter().map(line).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rows_are_judged_alone_and_together() {
        // Row 1 holds half of label 1, row 2 the other half and as many pixels of no label, less 1.
        let label = [1, 1, 1, 1, 1, 1, 0, 0, 0, NOT_SEEN];
        let row = [1, 1, 1, 2, 2, 2, 2, 2, 0, 1];
        let regions = Regions::new(&label, |p| row[p]);
        assert_eq!(regions.best(1), (1, 0.5), "the better row alone");
        assert_eq!([1, 2, 0].map(|row| regions.mostly(row)), [1, 1, 0]);
        assert!((regions.iou(&[1, 2], 1) - 0.75).abs() < 1e-12, "both");
        assert_eq!(regions.best(3), (2, 0.0), "a label that is not there");
    }
}
