//! Compares what texts select with labels: IoU and accuracy.
//!
//! Three readings of one set of scores. *Threshold*: each text's own mask, over all pixels: what
//! the product answers. *Closed*: every labelled pixel takes its best text, whatever its score, as
//! the 3D-OVS benchmark does. *Open*: every pixel takes the best of the texts that select it, or
//! none; a pixel of the surroundings is right where nothing is selected.
//!
//! An IoU is over all views of a scene. The *Jaccard* score of the first two readings is as 3D-OVS
//! averages scikit-learn's `jaccard_score`: over every class and view, 0 where a class is neither
//! there nor selected.
//!
//! The *top-k* mIoU is that of ScanNet++ (`semantic/eval` of its toolbox): a labelled pixel counts
//! as its own class where that is among its k best texts, else as its best text. The mean is over
//! the classes that are labelled or counted somewhere: one that is only wrongly counted has 0.

use serde_json::{Value, json};

use super::labels::{Class, NOT_SEEN};
use crate::rows::mean;

/// How many of the best texts may hold a pixel's class: as ScanNet++ reports it.
const TOP: [usize; 2] = [1, 3];

/// What one text says of each pixel of a view.
#[derive(Clone, Debug)]
pub struct TextMap {
    /// `[P]` the larger, the better the text fits beside the others; -inf where nothing is known.
    pub score: Vec<f64>,
    /// `[P]` whether the text selects the pixel.
    pub mask: Vec<bool>,
}

/// Counts of pixels: selected and labelled, selected, labelled.
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

    /// Intersection over union; `None` where nothing is labelled so.
    fn iou(self) -> Option<f64> {
        self.iou_of_all().filter(|_| self.truth > 0)
    }

    /// Intersection over union; `None` where nothing is labelled or selected.
    fn iou_of_all(self) -> Option<f64> {
        let union = self.selected + self.truth - self.both;
        (union > 0).then(|| self.both as f64 / union as f64)
    }

    fn merge(&mut self, other: Self) {
        self.both += other.both;
        self.selected += other.selected;
        self.truth += other.truth;
    }
}

/// Counts over the views of a scene.
#[derive(Clone, Debug)]
pub struct Tally {
    /// Places in the scene's classes of those that are asked.
    asked: Vec<usize>,
    names: Vec<String>,
    threshold: Vec<Overlap>,
    /// For each of [`TOP`]; the first is the closed reading.
    top: [Vec<Overlap>; TOP.len()],
    open: Vec<Overlap>,
    closed_right: [u64; 2],
    open_right: [u64; 2],
    absent: Vec<(String, [u64; 2])>,
    /// Of each view: the mean Jaccard score of the classes, by threshold and closed.
    jaccard: [Vec<f64>; 2],
}

impl Tally {
    /// Nothing counted yet of these classes and absent words.
    #[must_use]
    pub fn new(classes: &[Class], absent: &[String]) -> Self {
        let asked: Vec<usize> = (0..classes.len()).filter(|c| classes[*c].asked).collect();
        let none = vec![Overlap::default(); asked.len()];
        Self {
            names: asked.iter().map(|c| classes[*c].name.clone()).collect(),
            asked,
            threshold: none.clone(),
            top: TOP.map(|_| none.clone()),
            open: none,
            closed_right: [0; 2],
            open_right: [0; 2],
            absent: absent.iter().map(|word| (word.clone(), [0; 2])).collect(),
            jaccard: [Vec::new(), Vec::new()],
        }
    }

    /// Texts to ask: the classes, then the absent words; [`Self::add`] takes maps in this order.
    #[must_use]
    pub fn texts(&self) -> Vec<String> {
        self.names.iter().chain(self.absent.iter().map(|(word, _)| word)).cloned().collect()
    }

    /// Adds a view: labels as in [`super::labels::LabelledFrame`], and a map of each text.
    pub fn add(&mut self, label: &[u16], maps: &[TextMap]) {
        let (classes, absent) = maps.split_at(self.asked.len());
        let mut of_view = [(); 2].map(|()| vec![Overlap::default(); classes.len()]);
        for (p, &label) in label.iter().enumerate() {
            if label == NOT_SEEN {
                continue;
            }
            // Place among the asked classes of what the pixel is.
            let truth = usize::from(label)
                .checked_sub(1)
                .and_then(|class| self.asked.iter().position(|asked| *asked == class));
            let ranked = ranked(classes, p);
            let best = ranked.first().copied();
            let chosen = best_selected(classes, p);
            for (c, map) in classes.iter().enumerate() {
                self.threshold[c].add(map.mask[p], truth == Some(c));
                of_view[0][c].add(map.mask[p], truth == Some(c));
                of_view[1][c].add(best == Some(c), truth == Some(c));
                self.open[c].add(chosen == Some(c), truth == Some(c));
            }
            if truth.is_some() {
                for (top, k) in self.top.iter_mut().zip(TOP) {
                    let hit = truth.filter(|c| ranked.iter().take(k).any(|r| r == c));
                    let counted = hit.or(best);
                    for (c, class) in top.iter_mut().enumerate() {
                        class.add(counted == Some(c), truth == Some(c));
                    }
                }
                count(&mut self.closed_right, best == truth);
            }
            count(&mut self.open_right, chosen == truth);
            for ((_, counted), map) in self.absent.iter_mut().zip(absent) {
                count(counted, map.mask[p]);
            }
        }
        for (all, of_view) in self.jaccard.iter_mut().zip(of_view) {
            all.push(mean(of_view.into_iter().map(|class| class.iou().unwrap_or(0.0))));
        }
    }

    /// Adds the counts of other views. `false`, and nothing is added, where other texts were asked.
    pub fn merge(&mut self, other: &Self) -> bool {
        if self.names != other.names || self.texts() != other.texts() {
            return false;
        }
        let all = [&mut self.threshold, &mut self.open].into_iter().chain(&mut self.top);
        let more = [&other.threshold, &other.open].into_iter().chain(&other.top);
        for (all, more) in all.flatten().zip(more.flatten()) {
            all.merge(*more);
        }
        let sum = |all: &mut [u64; 2], more: [u64; 2]| {
            all.iter_mut().zip(more).for_each(|(all, more)| *all += more);
        };
        sum(&mut self.closed_right, other.closed_right);
        sum(&mut self.open_right, other.open_right);
        for ((_, all), (_, more)) in self.absent.iter_mut().zip(&other.absent) {
            sum(all, *more);
        }
        for (all, more) in self.jaccard.iter_mut().zip(&other.jaccard) {
            all.extend(more);
        }
        true
    }

    /// The figures: IoU of each class in the three readings, with the share of the judged pixels
    /// that are of the class; the share of the pixels that each absent word selects; means of both;
    /// the share of labelled pixels whose best text is theirs, and of all pixels that are right,
    /// none included. A class that no judged view shows has no IoU and is left out.
    #[must_use]
    pub fn scores(&self) -> Value {
        let share = |[part, whole]: [u64; 2]| part as f64 / whole.max(1) as f64;
        let class = |c: usize| -> Option<Value> {
            Some(json!({
                "name": self.names[c],
                "iou": self.threshold[c].iou()?,
                "iou_closed": self.top[0][c].iou()?,
                "iou_open": self.open[c].iou()?,
                "share": share([self.threshold[c].truth, self.open_right[1]]),
            }))
        };
        let classes: Vec<Value> = (0..self.asked.len()).filter_map(class).collect();
        let absent = self.absent.iter();
        let absent_words: Vec<Value> = absent
            .map(|(word, counted)| json!({ "word": word, "selected": share(*counted) }))
            .collect();
        let [top1, top3] =
            self.top.each_ref().map(|of| mean(of.iter().filter_map(|class| class.iou_of_all())));
        let over = |all: &[Value], key: &str| mean(all.iter().filter_map(|one| one[key].as_f64()));
        json!({
            "miou": over(&classes, "iou"),
            "miou_closed": over(&classes, "iou_closed"),
            "accuracy_closed": share(self.closed_right),
            "jaccard": mean(self.jaccard[0].iter().copied()),
            "jaccard_closed": mean(self.jaccard[1].iter().copied()),
            "miou_top1": top1,
            "miou_top3": top3,
            "miou_open": over(&classes, "iou_open"),
            "accuracy_open": share(self.open_right),
            "absent": over(&absent_words, "selected"),
            "classes": classes,
            "absent_words": absent_words,
        })
    }
}

fn count([part, whole]: &mut [u64; 2], hit: bool) {
    *part += u64::from(hit);
    *whole += 1;
}

/// The texts of the largest scores at a pixel, the best first and the first of equals before the
/// others; as many as the largest of [`TOP`]. None at -inf.
fn ranked(maps: &[TextMap], p: usize) -> Vec<usize> {
    let score = |c: usize| maps[c].score[p];
    let mut found = Vec::with_capacity(TOP[TOP.len() - 1] + 1);
    for c in (0..maps.len()).filter(|c| score(*c) > f64::NEG_INFINITY) {
        let at = found.partition_point(|better| score(*better) >= score(c));
        found.insert(at, c);
        found.truncate(TOP[TOP.len() - 1]);
    }
    found
}

/// The text of the largest score among those that select the pixel, the first of equals.
pub(super) fn best_selected(maps: &[TextMap], p: usize) -> Option<usize> {
    let mut found: Option<usize> = None;
    for (c, map) in maps.iter().enumerate().filter(|(_, map)| map.mask[p]) {
        if map.score[p] > found.map_or(f64::NEG_INFINITY, |best| maps[best].score[p]) {
            found = Some(c);
        }
    }
    found
}
