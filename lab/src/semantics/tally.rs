//! From what a text selects and what the labels say to IoU and accuracy.
//!
//! Three readings of one set of scores. *Threshold*: each text's own mask, over all pixels: what
//! the product answers. *Closed*: every labelled pixel takes its best text, whatever its score, as
//! the 3D-OVS benchmark does. *Open*: every pixel takes the best of the texts that select it, or
//! none; a pixel of the surroundings is right where nothing is selected.

use serde::Serialize;

use super::labels::{Class, NOT_SEEN};
use crate::rows::mean;

/// What one text says of each pixel of a view.
#[derive(Clone, Debug)]
pub(super) struct TextMap {
    /// `[P]` the larger, the better the text fits beside the others; -inf where nothing is known.
    pub(super) score: Vec<f64>,
    /// `[P]` whether the text selects the pixel.
    pub(super) mask: Vec<bool>,
}

/// Pixels in both, selected, and true.
#[derive(Clone, Copy, Debug, Default)]
struct Overlap {
    both: u64,
    selected: u64,
    truth: u64,
}

impl Overlap {
    fn add(&mut self, selected: bool, truth: bool) {
        self.both += u64::from(selected && truth);
        self.selected += u64::from(selected);
        self.truth += u64::from(truth);
    }

    /// Intersection over union; `None` where the class is nowhere.
    fn iou(self) -> Option<f64> {
        let union = self.selected + self.truth - self.both;
        (self.truth > 0).then(|| self.both as f64 / union as f64)
    }
}

/// Counts over the views of a scene.
#[derive(Clone, Debug)]
pub(super) struct Tally {
    /// Places in the scene's classes of those that are asked.
    asked: Vec<usize>,
    names: Vec<String>,
    threshold: Vec<Overlap>,
    closed: Vec<Overlap>,
    open: Vec<Overlap>,
    closed_right: [u64; 2],
    open_right: [u64; 2],
    absent: Vec<(String, [u64; 2])>,
}

/// One class's IoU in the three readings.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct ClassScore {
    /// The class name that was asked.
    pub name: String,
    /// IoU of the text's own mask.
    pub iou: f64,
    /// IoU where each labelled pixel takes its best text.
    pub iou_closed: f64,
    /// IoU where each pixel takes the best text that selects it.
    pub iou_open: f64,
    /// Share of the judged pixels that are of the class.
    pub share: f64,
}

/// A word for what is not in the scene.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct AbsentScore {
    /// The word.
    pub word: String,
    /// Share of the pixels that it selects.
    pub selected: f64,
}

/// Figures of a scene, or means over scenes (then without classes and words).
#[derive(Clone, Debug, Default, PartialEq, Serialize)]
pub struct Scores {
    /// Mean IoU of the texts' own masks.
    pub miou: f64,
    /// Mean IoU where each labelled pixel takes its best text.
    pub miou_closed: f64,
    /// Share of labelled pixels whose best text is theirs.
    pub accuracy_closed: f64,
    /// Mean IoU where each pixel takes the best text that selects it.
    pub miou_open: f64,
    /// Share of all pixels that are right so, none included.
    pub accuracy_open: f64,
    /// Mean share of the pixels that an absent word selects.
    pub absent: f64,
    /// Each class.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub classes: Vec<ClassScore>,
    /// Each absent word.
    #[serde(skip_serializing_if = "Vec::is_empty")]
    pub absent_words: Vec<AbsentScore>,
}

impl Tally {
    pub(super) fn new(classes: &[Class], absent: &[String]) -> Self {
        let asked: Vec<usize> = (0..classes.len()).filter(|c| classes[*c].asked).collect();
        let none = vec![Overlap::default(); asked.len()];
        Self {
            names: asked.iter().map(|c| classes[*c].name.clone()).collect(),
            asked,
            threshold: none.clone(),
            closed: none.clone(),
            open: none,
            closed_right: [0; 2],
            open_right: [0; 2],
            absent: absent.iter().map(|word| (word.clone(), [0; 2])).collect(),
        }
    }

    /// Texts to ask: the classes, then the absent words; [`Self::add`] takes maps in this order.
    pub(super) fn texts(&self) -> Vec<String> {
        self.names.iter().chain(self.absent.iter().map(|(word, _)| word)).cloned().collect()
    }

    /// Adds a view: labels as in [`super::labels::LabelledFrame`], and a map of each text.
    pub(super) fn add(&mut self, label: &[u16], maps: &[TextMap]) {
        let (classes, absent) = maps.split_at(self.asked.len());
        for (p, &label) in label.iter().enumerate() {
            if label == NOT_SEEN {
                continue;
            }
            // Place among the asked classes of what the pixel is.
            let truth = usize::from(label)
                .checked_sub(1)
                .and_then(|class| self.asked.iter().position(|asked| *asked == class));
            let best = best(classes, p, |_| true);
            let chosen = best_selected(classes, p);
            for (c, map) in classes.iter().enumerate() {
                self.threshold[c].add(map.mask[p], truth == Some(c));
                self.open[c].add(chosen == Some(c), truth == Some(c));
                if truth.is_some() {
                    self.closed[c].add(best == Some(c), truth == Some(c));
                }
            }
            if truth.is_some() {
                count(&mut self.closed_right, best == truth);
            }
            count(&mut self.open_right, chosen == truth);
            for ((_, counted), map) in self.absent.iter_mut().zip(absent) {
                count(counted, map.mask[p]);
            }
        }
    }

    /// The figures. A class that no judged view shows has no IoU and is left out.
    pub(super) fn scores(&self) -> Scores {
        let share = |[part, whole]: [u64; 2]| part as f64 / whole.max(1) as f64;
        let class = |c: usize| -> Option<ClassScore> {
            Some(ClassScore {
                name: self.names[c].clone(),
                iou: self.threshold[c].iou()?,
                iou_closed: self.closed[c].iou()?,
                iou_open: self.open[c].iou()?,
                share: share([self.threshold[c].truth, self.open_right[1]]),
            })
        };
        let classes: Vec<ClassScore> = (0..self.asked.len()).filter_map(class).collect();
        let word = |(word, counted): &(String, [u64; 2])| AbsentScore {
            word: word.clone(),
            selected: share(*counted),
        };
        let absent_words: Vec<AbsentScore> = self.absent.iter().map(word).collect();
        Scores {
            miou: mean(classes.iter().map(|c| c.iou)),
            miou_closed: mean(classes.iter().map(|c| c.iou_closed)),
            accuracy_closed: share(self.closed_right),
            miou_open: mean(classes.iter().map(|c| c.iou_open)),
            accuracy_open: share(self.open_right),
            absent: mean(absent_words.iter().map(|w| w.selected)),
            classes,
            absent_words,
        }
    }
}

impl Scores {
    /// Means over scenes.
    pub(super) fn mean(of: &[&Self]) -> Self {
        let over = |figure: fn(&Self) -> f64| mean(of.iter().copied().map(figure));
        Self {
            miou: over(|s| s.miou),
            miou_closed: over(|s| s.miou_closed),
            accuracy_closed: over(|s| s.accuracy_closed),
            miou_open: over(|s| s.miou_open),
            accuracy_open: over(|s| s.accuracy_open),
            absent: over(|s| s.absent),
            classes: Vec::new(),
            absent_words: Vec::new(),
        }
    }
}

fn count([part, whole]: &mut [u64; 2], hit: bool) {
    *part += u64::from(hit);
    *whole += 1;
}

/// The text of the largest score among those that count, the first of equals; none at -inf.
fn best(maps: &[TextMap], p: usize, counts: impl Fn(&TextMap) -> bool) -> Option<usize> {
    let mut found: Option<usize> = None;
    for (c, map) in maps.iter().enumerate() {
        let higher = map.score[p] > found.map_or(f64::NEG_INFINITY, |best| maps[best].score[p]);
        if higher && counts(map) {
            found = Some(c);
        }
    }
    found
}

/// The text of the largest score among those that select the pixel.
pub(super) fn best_selected(maps: &[TextMap], p: usize) -> Option<usize> {
    best(maps, p, |map| map.mask[p])
}

#[cfg(test)]
mod tests {
    use super::*;

    fn class(name: &str, asked: bool) -> Class {
        Class { name: name.to_owned(), asked }
    }

    /// Four pixels: cup, cup, plate, wall; a fifth that nobody sees.
    const LABEL: [u16; 5] = [1, 1, 2, 3, NOT_SEEN];

    fn tally() -> Tally {
        let classes = [class("cup", true), class("plate", true), class("wall", false)];
        let mut tally = Tally::new(&classes, &["car".to_owned()]);
        assert_eq!(tally.texts(), ["cup", "plate", "car"]);
        let map = |score: [f64; 5], mask: [u8; 5]| TextMap {
            score: score.to_vec(),
            mask: mask.iter().map(|m| *m > 0).collect(),
        };
        let none = f64::NEG_INFINITY;
        tally.add(
            &LABEL,
            &[
                // Selects one cup pixel, the plate and the wall.
                map([0.5, none, 0.2, 0.1, 0.9], [1, 0, 1, 1, 1]),
                // Scores the plate higher than the cup does, but does not select it.
                map([0.4, none, 0.3, -0.2, 0.9], [1, 0, 0, 0, 1]),
                map([0.9, none, none, none, 0.9], [1, 0, 0, 0, 1]),
            ],
        );
        tally
    }

    #[test]
    fn three_readings_of_one_view() {
        let scores = tally().scores();
        let cup = &scores.classes[0];
        let plate = &scores.classes[1];
        // Own masks: cup 1 of 4 in the union, plate 0 of 2.
        assert_eq!((cup.iou, plate.iou), (0.25, 0.0));
        assert_eq!(scores.miou, 0.125);
        // Best text of each labelled pixel: cup, none, plate; 2 of 3 right.
        assert_eq!((cup.iou_closed, plate.iou_closed), (0.5, 1.0));
        assert!((scores.accuracy_closed - 2.0 / 3.0).abs() < 1e-12);
        // Best selecting text: cup, none, cup, cup; 1 of 4 right.
        assert_eq!((cup.iou_open, plate.iou_open), (0.25, 0.0));
        assert_eq!(scores.accuracy_open, 0.25);
        // "car" selects one of four.
        assert_eq!(scores.absent_words[0].selected, 0.25);
        assert_eq!((cup.share, plate.share), (0.5, 0.25));
    }

    #[test]
    fn a_class_that_no_view_shows_is_left_out() {
        let mut tally = Tally::new(&[class("cup", true), class("hat", true)], &[]);
        let map = |on: bool| TextMap { score: vec![f64::from(u8::from(on))], mask: vec![on] };
        tally.add(&[1], &[map(true), map(false)]);
        let scores = tally.scores();
        assert_eq!(scores.classes.len(), 1);
        assert_eq!((scores.miou, scores.accuracy_closed, scores.accuracy_open), (1.0, 1.0, 1.0));
    }

    #[test]
    fn means_are_over_scenes() {
        let [a, b] = [0.2, 0.6].map(|miou| Scores { miou, absent: 0.1, ..Scores::default() });
        let mean = Scores::mean(&[&a, &b]);
        assert!((mean.miou - 0.4).abs() < 1e-12 && (mean.absent - 0.1).abs() < 1e-12);
    }
}
