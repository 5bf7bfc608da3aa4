//! The short forms of semantics against the plain definition: dense E blended as one-hot colours,
//! decoded to D numbers a pixel, brought to unit length, compared with the text in f64.
//!
//! Masks must be equal on every pixel that is no tie, relevancy within 1e-5 where the feature is
//! at least 0.05 of the coverage long.

use std::sync::Arc;

use segsplat_core::scene::{Bank, Gaussians, PixelWeights, Preset, ScoringMethod};
use segsplat_render::{Labels, RenderRequest, Renderer, cpu::CpuRenderer};
use segsplat_vision::semantics::{Scorer, Scoring};

use segsplat_testing::labels::{alone, labelled, literal_of, mask_of_blends};
use segsplat_testing::scenes::{Random, camera, request};

const DIM: usize = 48;
const TAU: f64 = 10.0;
const FLOOR: f64 = 0.05;
/// Relevancy may differ by this.
const CLOSE: f64 = 1e-5;
/// A score or a coverage this near to its threshold, per unit of coverage, is a tie.
const TIE: f64 = 2e-6;

/// How the rows of a bank lie.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Rows {
    /// Around a few directions, of lengths that plain centroids have.
    Grouped,
    /// All the same.
    Equal,
    /// Each second row is the one before it, turned round.
    Opposite,
}

fn unit(random: &mut Random) -> Vec<f32> {
    let row: Vec<f32> = (0..DIM).map(|_| random.range(-1.0, 1.0)).collect();
    scaled(&row, 1.0)
}

fn scaled(row: &[f32], length: f64) -> Vec<f32> {
    let own = row.iter().map(|v| f64::from(*v).powi(2)).sum::<f64>().sqrt();
    row.iter().map(|v| (f64::from(*v) / own * length) as f32).collect()
}

fn mixed(a: &[f32], b: &[f32], share: f32) -> Vec<f32> {
    scaled(&a.iter().zip(b).map(|(x, y)| x * share + y * (1.0 - share)).collect::<Vec<_>>(), 1.0)
}

fn bank(m: u16, kind: Rows, random: &mut Random) -> Bank {
    let ways: Vec<Vec<f32>> = (0..1 + m / 4).map(|_| unit(random)).collect();
    let mut rows: Vec<Vec<f32>> = Vec::new();
    for i in 0..usize::from(m) {
        let row = match kind {
            Rows::Equal => ways[0].clone(),
            Rows::Opposite if i % 2 == 1 => rows[i - 1].iter().map(|v| -v).collect(),
            Rows::Grouped | Rows::Opposite => {
                let near = mixed(&ways[i % ways.len()], &unit(random), 0.6);
                scaled(&near, f64::from(random.range(0.6, 1.0)))
            }
        };
        rows.push(row);
    }
    Bank { dim: DIM, rows: rows.concat() }
}

fn scoring(preset: Preset, canon: &[Vec<f32>]) -> Scoring {
    let names: Vec<String> = (0..canon.len()).map(|c| c.to_string()).collect();
    let method = ScoringMethod::of(preset, names.clone(), TAU, FLOOR, 0.0, 1.0);
    Scoring::new(&ScoringMethod { canon: names, ..method }, canon.to_vec(), Arc::default())
        .expect("a scoring")
}

/// What the plain definition gives for a pixel.
struct Truth {
    coverage: f64,
    norm: f64,
    relevancy: f64,
    /// Least difference of the text's and a phrase's score, before division by the norm.
    least: f64,
}

/// Rows far under the best one of a text, and whether a rounding could decide about one of them.
fn left_out(bank: &Bank, text: &[f32], canon: &[Vec<f32>]) -> (Vec<bool>, bool) {
    let cosine = |m: usize, with: &[f32]| -> f64 {
        let of = |with: &[f32]| -> f64 {
            bank.row(m).iter().zip(with).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
        };
        of(with) / of(bank.row(m)).sqrt().max(1e-300)
    };
    let lead = |m: usize| {
        let differences = canon.iter().map(|c| cosine(m, text) - cosine(m, c));
        differences.fold(f64::INFINITY, f64::min)
    };
    let leads: Vec<f64> = (0..bank.len()).map(lead).collect();
    let edge = leads.iter().copied().fold(f64::NEG_INFINITY, f64::max) - ScoringMethod::NEAR_BEST;
    let doubt = |lead: &f64| edge > 0.0 && (lead.abs() < 1e-6 || (lead - edge).abs() < 1e-6);
    (leads.iter().map(|lead| (0.0..edge).contains(lead)).collect(), leads.iter().any(doubt))
}

fn literal_pixel(
    weights: &[f64],
    bank: &Bank,
    profile: Preset,
    text: &[f32],
    canon: &[Vec<f32>],
    left_out: &[bool],
) -> Truth {
    // What is left out has the score of another thing, by docs/adr/0062-near-the-best-entry.md.
    let (mut feature, mut near, mut under) = (vec![0.0_f64; DIM], vec![0.0_f64; DIM], 0.0);
    for (m, weight) in weights.iter().enumerate().filter(|(_, weight)| **weight != 0.0) {
        let row: Vec<f64> = bank.row(m).iter().map(|v| f64::from(*v)).collect();
        let length = match profile {
            Preset::Default => row.iter().map(|v| v * v).sum::<f64>().sqrt().max(1e-300),
            Preset::Paper => 1.0,
        };
        let add = |to: &mut [f64]| {
            to.iter_mut().zip(&row).for_each(|(sum, v)| *sum += weight * v / length);
        };
        add(&mut feature);
        match left_out[m] {
            true => under -= 0.05 * weight,
            false => add(&mut near),
        }
    }
    let coverage: f64 = weights.iter().sum();
    let norm = feature.iter().map(|v| v * v).sum::<f64>().sqrt();
    let score = |with: &[f32]| -> f64 {
        near.iter().zip(with).map(|(a, b)| a * f64::from(*b)).sum::<f64>()
    };
    let differences = canon.iter().map(|c| score(text) - score(c) + under);
    let least = differences.fold(f64::INFINITY, f64::min);
    let floor = if profile == Preset::Default { FLOOR } else { 0.0 };
    let mut relevancy = 0.0;
    if norm > 0.0 && coverage >= floor {
        // min over phrases of the sigmoid = sigmoid of the least difference of cosines.
        relevancy = canon
            .iter()
            .map(|c| (score(text) - score(c) + under) / norm)
            .map(|difference| 1.0 / (1.0 + (-TAU * difference).exp()))
            .fold(f64::INFINITY, f64::min);
    }
    if relevancy < 0.5 {
        relevancy = 0.0;
    }
    Truth { coverage, norm, relevancy, least }
}

/// What 50 cases found.
#[derive(Debug, Default)]
struct Tally {
    cases: usize,
    pixels: usize,
    ties: usize,
    selected: usize,
    compared: usize,
    worst: f64,
}

/// A view with its E in both forms.
struct View<'a> {
    renderer: &'a CpuRenderer,
    gaussians: &'a Gaussians,
    request: &'a RenderRequest,
    dense: Vec<Vec<f64>>,
    weights: PixelWeights,
}

impl View<'_> {
    /// One text in all forms.
    fn compare(
        &self,
        scorer: &Scorer,
        bank: &Bank,
        canon: &[Vec<f32>],
        text: &[f32],
        all: &mut Tally,
    ) {
        let unit = scorer.scoring().unit_rows();
        let profile = if unit { Preset::Default } else { Preset::Paper };
        let scores = scorer.text(text).expect("a text");
        let (left_out, doubtful) = match profile {
            Preset::Default => left_out(bank, text, canon),
            Preset::Paper => (vec![false; bank.len()], false),
        };
        if doubtful {
            return;
        }
        let pictures: Vec<Vec<[f32; 4]>> = scores
            .tables()
            .into_iter()
            .map(|table| {
                let request = alone(self.request, Labels::Blend(table));
                let frame = self.renderer.render(self.gaussians, &request).expect("a blend");
                frame.blend.expect("a blend was asked for")
            })
            .collect();
        let pictures: Vec<&[[f32; 4]]> = pictures.iter().map(Vec::as_slice).collect();
        let blended = mask_of_blends(&pictures, scorer.scoring().coverage_floor());
        let listed = scorer.mask(&scores, &self.weights).expect("a mask");
        let norms = scorer.norms(&self.weights).expect("norms");
        let map = scorer.relevancy(&scores, &self.weights, &norms).expect("a relevancy");
        assert_eq!(
            (blended.len(), listed.len(), map.len()),
            (self.dense.len(), self.dense.len(), self.dense.len())
        );
        all.cases += 1;
        let floor = scorer.scoring().coverage_floor();
        for (p, weights) in self.dense.iter().enumerate() {
            let truth = literal_pixel(weights, bank, profile, text, canon, &left_out);
            all.pixels += 1;
            assert!(
                map[p].is_finite() && (map[p] >= 0.5 || map[p] == 0.0),
                "pixel {p}: {}",
                map[p]
            );
            if truth.coverage <= 1e-9 {
                assert!(!blended[p] && !listed[p] && map[p] == 0.0, "pixel {p} shows nothing");
                continue;
            }
            let slack = TIE * truth.coverage + 1e-9;
            let tie =
                truth.least.abs() <= slack || (truth.coverage - floor).abs() <= TIE && floor > 0.0;
            if tie {
                all.ties += 1;
                continue;
            }
            let want = truth.relevancy >= 0.5;
            all.selected += usize::from(want);
            let case =
                format!("M = {}, {profile:?}, pixel {p}, least {:.2e}", bank.len(), truth.least);
            assert_eq!((blended[p], listed[p]), (want, want), "{case}: masks");
            if truth.norm >= 0.05 * truth.coverage {
                let apart = (f64::from(map[p]) - truth.relevancy).abs();
                all.compared += 1;
                all.worst = all.worst.max(apart);
                assert!(apart <= CLOSE, "{case}: relevancy {} for {}", map[p], truth.relevancy);
            }
        }
    }
}

/// Texts near a row, between two rows, at random, and a phrase itself.
fn texts(bank: &Bank, canon: &[Vec<f32>], random: &mut Random) -> Vec<Vec<f32>> {
    let any = unit(random);
    if bank.is_empty() {
        return vec![any];
    }
    let row =
        |random: &mut Random| scaled(bank.row((random.bits() % bank.len() as u64) as usize), 1.0);
    let (a, b) = (row(random), row(random));
    vec![a.clone(), mixed(&a, &b, 0.55), any, canon[0].clone()]
}

#[test]
fn fifty_scene_view_text_cases_equal_the_plain_definition() {
    use Rows::{Equal, Grouped, Opposite};
    let renderer = CpuRenderer::new(2).expect("two threads");
    let views = [
        (1, 1, Grouped, 24, 18),
        (2, 2, Grouped, 33, 20),
        (5, 3, Grouped, 40, 30),
        (16, 4, Grouped, 32, 32),
        (24, 5, Grouped, 40, 24),
        (64, 6, Grouped, 24, 24),
        (128, 7, Grouped, 20, 16),
        (512, 8, Grouped, 16, 12),
        (7, 9, Equal, 30, 20),
        (12, 10, Opposite, 30, 24),
        (2, 11, Opposite, 24, 24),
    ];
    let (mut all, mut special) = (Tally::default(), Tally::default());
    for (m, seed, kind, width, height) in views {
        let mut random = Random(seed);
        let bank = bank(m, kind, &mut random);
        let gaussians = labelled(700, m, 300 + seed);
        let request = request(camera(width, height));
        let draw = renderer.render(&gaussians, &alone(&request, Labels::Weights)).expect("entries");
        let view = View {
            renderer: &renderer,
            gaussians: &gaussians,
            request: &request,
            dense: literal_of(&renderer, &gaussians, &request, m),
            weights: draw.weights.expect("weights were asked for"),
        };
        let of = if kind == Grouped { &mut all } else { &mut special };
        for profile in [Preset::Default, Preset::Paper] {
            let canon: Vec<Vec<f32>> =
                (0..if seed % 2 == 0 { 3 } else { 5 }).map(|_| unit(&mut random)).collect();
            let scoring = scoring(profile, &canon);
            let scorer = Scorer::new(&bank, Arc::new(scoring)).expect("a scorer");
            for text in texts(&bank, &canon, &mut random) {
                view.compare(&scorer, &bank, &canon, &text, of);
            }
        }
    }
    println!("{all:?}\n{special:?}");
    assert!(all.cases >= 50 && special.cases >= 16, "{all:?} {special:?}");
    let shown = all.selected as f64 / all.pixels as f64;
    assert!(shown > 0.1 && shown < 0.9, "cases that select {shown:.2} of all pixels test little");
    // The phrase itself as a text is a tie wherever another phrase scores less.
    assert!((all.ties as f64) < 0.2 * all.pixels as f64, "{all:?}");
    assert!(all.compared * 2 > all.pixels && special.compared > 0, "{all:?} {special:?}");
}

#[test]
fn a_scene_without_masks_is_legal_and_nothing_in_it_is_relevant() {
    let renderer = CpuRenderer::new(1).expect("a thread");
    let request = request(camera(20, 14));
    let mut random = Random(77);
    let canon = vec![unit(&mut random)];
    for bank in [Bank { dim: DIM, rows: Vec::new() }, bank(3, Rows::Grouped, &mut random)] {
        let gaussians = labelled(300, 0, 5);
        let scoring = scoring(Preset::Paper, &canon);
        let scorer = Scorer::new(&bank, Arc::new(scoring)).expect("a scorer");
        let scores = scorer.text(&unit(&mut random)).expect("a text");
        let labels = Labels::Blend(Arc::clone(&scores.tables()[0]));
        let blend = renderer.render(&gaussians, &alone(&request, labels)).expect("a blend");
        let mask = mask_of_blends(&[&blend.blend.expect("asked for")], FLOOR);
        let drawn = renderer.render(&gaussians, &alone(&request, Labels::Weights)).expect("E");
        let sparse = &drawn.weights.expect("asked for");
        let norms = scorer.norms(sparse).expect("norms");
        let map = scorer.relevancy(&scores, sparse, &norms).expect("a relevancy");
        assert_eq!((mask.len(), map.len()), (280, 280));
        assert!(mask.iter().all(|inside| !inside) && map.iter().all(|v| *v == 0.0));
    }
}
