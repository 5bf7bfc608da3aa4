//! The order of the work: lenses, pairs, focal length, growing from several pairs, and the choice.

use std::sync::atomic::AtomicBool;

use nalgebra::Vector2;
use rayon::prelude::*;
use segsplat_core::{error::Result, scene::unless_cancelled};

use crate::{
    adjust::LensPrior,
    given::{PairMatches, PhotoKeypoints, SolveOptions},
    grow::{Grower, Grown},
    lens::Lens,
    pose::Pose,
    rotations,
    survey::{Guess, Link, Pair, Survey, View, strength},
    tracks::{self, Sighting},
    two_view,
};

/// Focal lengths that are tried, as shares of the longer side.
const FOCALS: [f64; 10] = [0.45, 0.55, 0.65, 0.75, 0.87, 1.0, 1.2, 1.45, 1.8, 2.4];
/// The focal length of most photos: that of telephones.
const FOCAL_USUAL: f64 = 0.8;
const FOCAL_USUAL_SPREAD: f64 = 0.5;
const FOCAL_EXIF_SPREAD: f64 = 0.03;
const K1_SPREAD: f64 = 0.03;
/// First pairs that are tried for each focal length, and for more than [`PHOTOS_MANY`] photos.
const SEEDS: usize = 4;
const SEEDS_OF_MANY: usize = 2;
const PHOTOS_MANY: usize = 32;
/// A pair is a link of the view graph where chance gives so many such agreements at most.
const LOG_CHANCE_MAX: f64 = -8.0;
const LINK_INLIERS_MIN: usize = 15;
/// Rounds in which a solution gathers the matches that agree with it, while its score grows so.
const FINISH_ROUNDS: usize = 4;
const FINISH_GAIN: f64 = 1.01;
/// How far a focal length may end from where its links were made, as a share, before these are made
/// again with it.
const LENS_OFF: f64 = 0.1;
const KEPT_SHARE: f64 = 0.95;
/// How far off the keypoints of a guess may be, turn by turn, in distances at which keypoints
/// agree: the first is some three degrees.
const GUESS_OFF: [f64; 4] = [16.0, 8.0, 4.0, 2.0];
const GUESS_STEPS: usize = 12;

/// A solution and what it was made from.
#[derive(Clone)]
pub(crate) struct Candidate {
    pub(crate) grown: Grown,
    pub(crate) links: Vec<Link>,
    pub(crate) tracks: Vec<Vec<Sighting>>,
    pub(crate) score: f64,
}

/// Keypoints from the photos' middles, lenses and pairs.
pub(crate) fn survey(
    photos: &[PhotoKeypoints],
    matches: &[PairMatches],
    options: &SolveOptions,
) -> Survey {
    let mut keys: Vec<([u32; 2], Option<u64>, usize)> = Vec::new();
    let mut priors: Vec<LensPrior> = Vec::new();
    let mut views = Vec::new();
    for (index, photo) in photos.iter().enumerate() {
        let side = f64::from(photo.size[0].max(photo.size[1]));
        // Photos of one size and one focal length (within 0.1 %) share a lens.
        let focal = photo.focal.map(|f| ((f / side).ln() * 1000.0).round().to_bits());
        let upright = [photo.size[0].min(photo.size[1]), photo.size[0].max(photo.size[1])];
        let key = (upright, focal, if options.one_lens { 0 } else { index });
        let lens = keys.iter().position(|k| *k == key).unwrap_or_else(|| {
            keys.push(key);
            priors.push(LensPrior {
                focal: photo.focal.unwrap_or(FOCAL_USUAL * side),
                log_spread: if focal.is_some() { FOCAL_EXIF_SPREAD } else { FOCAL_USUAL_SPREAD },
                known: focal.is_some(),
                k1_spread: K1_SPREAD,
            });
            keys.len() - 1
        });
        let middle = Vector2::new(f64::from(photo.size[0]), f64::from(photo.size[1])) * 0.5;
        let pixels =
            photo.keypoints.iter().map(|k| Vector2::new(k[0].into(), k[1].into()) - middle);
        views.push(View {
            lens,
            pixels: pixels.collect(),
            agree_px: View::agree_px(side),
            side,
            size: photo.size.map(f64::from),
        });
    }
    let pairs = matches.iter().map(|given| {
        let mut order: Vec<usize> = (0..given.pairs.len()).collect();
        if given.scores.len() == given.pairs.len() {
            order.sort_by(|&a, &b| given.scores[b].total_cmp(&given.scores[a]).then(a.cmp(&b)));
        }
        Pair { photos: given.photos, matches: order.iter().map(|&i| given.pairs[i]).collect() }
    });
    let pairs = pairs.collect();
    let guess = guess_of(photos, &views, &priors);
    Survey { views, pairs, priors, guess, seed: options.seed }
}

/// What a network says of the photos; of a lens that EXIF knows it says nothing.
fn guess_of(photos: &[PhotoKeypoints], views: &[View], priors: &[LensPrior]) -> Option<Guess> {
    let poses: Vec<Option<Pose>> =
        photos.iter().map(|photo| Some(Pose::of(&photo.guess?.camera_to_world))).collect();
    let lens = |(lens, prior): (usize, &LensPrior)| {
        let own = photos.iter().zip(views).filter(|(_, view)| view.lens == lens && !prior.known);
        let focal = |photo: &PhotoKeypoints| {
            photo.guess.map(|guess| (guess.intrinsics.fx * guess.intrinsics.fy).sqrt())
        };
        let mut focals: Vec<f64> = own.filter_map(|(photo, _)| focal(photo)).collect();
        focals.sort_by(f64::total_cmp);
        Lens { focal: focals.get(focals.len() / 2).copied().unwrap_or(prior.focal), k1: 0.0 }
    };
    let lenses = priors.iter().enumerate().map(lens).collect();
    (poses.iter().flatten().count() >= 2).then_some(Guess { poses, lenses })
}

fn is_link(link: &Link) -> bool {
    is_more_than_chance(link.geometry.inliers.len(), link.geometry.log_chance)
}

fn is_more_than_chance(inliers: usize, log_chance: f64) -> bool {
    log_chance < LOG_CHANCE_MAX && inliers >= LINK_INLIERS_MIN
}

/// Whether all focal lengths are near those of other lenses.
fn is_near(lenses: &[Lens], others: &[Lens]) -> bool {
    let near = |(lens, other): (&Lens, &Lens)| (lens.focal / other.focal - 1.0).abs() < LENS_OFF;
    lenses.iter().zip(others).all(near)
}

/// All candidates, the best first.
///
/// # Errors
/// `cancelled`.
pub(crate) fn candidates(
    survey: &Survey,
    cancel: &AtomicBool,
    progress: &(dyn Fn(f64) + Sync),
) -> Result<Vec<Candidate>> {
    let known: Vec<Lens> = survey.priors.iter().map(|p| Lens { focal: p.focal, k1: 0.0 }).collect();
    let first = survey.links(&known, usize::MAX, None);
    unless_cancelled(cancel)?;
    progress(0.4);
    let grown_with = |lenses: &[Lens]| {
        let links = survey.links(lenses, 60, Some(&first));
        let links: Vec<Link> = links.into_iter().flatten().filter(is_link).collect();
        let links = rotations::consistent(survey.views.len(), &links);
        grow_from_pairs(survey, lenses, &links, cancel)
    };
    let (tried, mut all) = (lenses_to_try(survey, &known, &first), Vec::new());
    for lenses in &tried {
        unless_cancelled(cancel)?;
        progress(0.6);
        all.extend(grown_with(lenses));
    }
    // Links made with a focal length that is wrong contradict cameras that have the right one.
    let best = all.iter().max_by(|a, b| a.score.total_cmp(&b.score));
    let found = best.map(|best| best.grown.lenses.clone());
    if let Some(found) = found.filter(|found| tried.iter().all(|lenses| !is_near(found, lenses))) {
        unless_cancelled(cancel)?;
        all.extend(grown_with(&found));
    }
    all.extend(survey.guess.as_ref().and_then(|guess| from_guess(survey, guess, &first, cancel)));
    all.sort_by(|a, b| b.score.total_cmp(&a.score));
    unless_cancelled(cancel)?;
    progress(0.9);
    Ok(all)
}

/// Goes on from a solution with all matches that agree with it, those that two views alone left out
/// among them, and looks again for the places of the photos that are left.
pub(crate) fn finish(survey: &Survey, best: &mut Candidate, cancel: &AtomicBool) {
    for _ in 0..FINISH_ROUNDS {
        let tracks = retracked(survey, &best.grown.poses, &best.grown.lenses);
        let mut grower = Grower::new(survey, &tracks, &best.links, &best.grown.lenses, cancel);
        grower.state.poses.clone_from(&best.grown.poses);
        let before = grower.placed();
        grower.triangulate();
        grower.place_all(survey.seed);
        let score = score_of(survey, &grower.state);
        let gained = score / best.score;
        if grower.placed() < before || gained < KEPT_SHARE {
            return;
        }
        let Grower { state, .. } = grower;
        (best.grown, best.score, best.tracks) = (state, score, tracks);
        if gained < FINISH_GAIN {
            return;
        }
    }
}

/// Tracks of the matches that agree with cameras.
fn retracked(survey: &Survey, poses: &[Option<Pose>], lenses: &[Lens]) -> Vec<Vec<Sighting>> {
    let mut agreeing: Vec<(f64, &Pair, Vec<u32>)> = Vec::new();
    for pair in &survey.pairs {
        let Some(pose) = between_placed(poses, pair.photos) else { continue };
        let directions = survey.directions(pair, lenses);
        let threshold = survey.threshold(pair, lenses);
        let near = two_view::inliers_of(&pose, &directions, threshold * threshold);
        let log_chance = two_view::log_chance_of(&directions, near.len(), threshold);
        if is_more_than_chance(near.len(), log_chance) {
            let share = near.len() as f64 / pair.matches.len() as f64;
            agreeing.push((strength(near.len(), share), pair, near));
        }
    }
    agreeing.sort_by(|a, b| b.0.total_cmp(&a.0));
    joined(survey, agreeing.iter().map(|(_, pair, near)| (*pair, &**near)))
}

/// Tracks of matches of pairs of photos, those of the first pairs before others.
fn joined<'a>(
    survey: &Survey,
    matches: impl Iterator<Item = (&'a Pair, &'a [u32])>,
) -> Vec<Vec<Sighting>> {
    let counts: Vec<usize> = survey.views.iter().map(|v| v.pixels.len()).collect();
    let sightings = matches.flat_map(|(pair, agreeing)| {
        let [a, b] = pair.photos.map(|p| p as u32);
        agreeing.iter().map(move |&i| {
            let [k, l] = pair.matches[i as usize];
            [(a, k), (b, l)]
        })
    });
    tracks::join(&counts, sightings)
}

/// The links under the lenses that a solution found: each with the geometry that its own matches
/// fit best, or with that of the solution, where they fit it nearly as well.
pub(crate) fn links_under(survey: &Survey, best: &Candidate) -> Vec<Link> {
    let mut before: Vec<Option<Link>> = vec![None; survey.pairs.len()];
    for link in &best.links {
        before[link.pair] = Some(link.clone());
    }
    let links = survey.links(&best.grown.lenses, 60, Some(&before));
    let mut links: Vec<Link> = links.into_iter().flatten().filter(is_link).collect();
    for link in &mut links {
        if let Some(pose) = between_placed(&best.grown.poses, link.photos) {
            survey.lean(link, &pose, &best.grown.lenses);
        }
    }
    links
}

/// Lenses with the focal lengths under which the pairs agree best.
fn lenses_to_try(survey: &Survey, known: &[Lens], first: &[Option<Link>]) -> Vec<Vec<Lens>> {
    let searched: Vec<bool> = survey.priors.iter().map(|p| !p.known).collect();
    if !searched.contains(&true) {
        return vec![known.to_vec()];
    }
    let scaled = |share: f64| -> Vec<Lens> {
        let each = known.iter().zip(&searched).map(|(lens, &searched)| {
            let scale = if searched { share / FOCAL_USUAL } else { 1.0 };
            Lens { focal: lens.focal * scale, ..*lens }
        });
        each.collect()
    };
    let mut strong: Vec<&Link> = first.iter().flatten().filter(|l| is_link(l)).collect();
    strong.sort_by(|a, b| b.geometry.score.total_cmp(&a.geometry.score));
    strong.truncate(24);
    let score = |share: &f64| -> f64 {
        let lenses = scaled(*share);
        let each = strong.par_iter().map(|link| {
            let pair = &survey.pairs[link.pair];
            let directions = survey.directions(pair, &lenses);
            let threshold = survey.threshold(pair, &lenses);
            let mut rng = crate::rng::Rng::new(survey.seed, link.pair as u64);
            let start = Some(link.geometry.pose);
            two_view::find(&directions, threshold, 40, start, &mut rng).map_or(0.0, |f| f.1)
        });
        // A sum in a fixed order.
        each.collect::<Vec<f64>>().into_iter().sum()
    };
    let scores: Vec<f64> = FOCALS.iter().map(score).collect();
    let best = (0..FOCALS.len()).max_by(|&a, &b| scores[a].total_cmp(&scores[b])).unwrap_or(0);
    let mut shares = vec![FOCALS[best]];
    if (FOCALS[best] / FOCAL_USUAL).ln().abs() > 0.15 {
        shares.push(FOCAL_USUAL);
    }
    shares.into_iter().map(scaled).collect()
}

/// Solutions from several first pairs.
fn grow_from_pairs(
    survey: &Survey,
    lenses: &[Lens],
    links: &[Link],
    cancel: &AtomicBool,
) -> Vec<Candidate> {
    let mut order: Vec<&Link> = links.iter().collect();
    order.sort_by(|a, b| b.geometry.score.total_cmp(&a.geometry.score).then(a.pair.cmp(&b.pair)));
    let matches = order.iter().map(|link| (&survey.pairs[link.pair], &*link.geometry.inliers));
    let tracks = joined(survey, matches);
    let many = survey.views.len() > PHOTOS_MANY;
    let seeds = first_pairs(links, if many { SEEDS_OF_MANY } else { SEEDS });
    let grown: Vec<Candidate> = seeds
        .par_iter()
        .filter_map(|link| {
            let mut grower = Grower::new(survey, &tracks, links, lenses, cancel);
            grower.grow(link.photos, link.geometry.pose, survey.seed);
            (grower.placed() >= 2).then(|| Candidate {
                score: score_of(survey, &grower.state),
                grown: grower.state,
                links: links.to_vec(),
                tracks: tracks.clone(),
            })
        })
        .collect();
    grown
}

/// The solution that a guess leads to: its cameras go where the matches near them say, and what
/// they do not hold is placed as in any other.
fn from_guess(
    survey: &Survey,
    guess: &Guess,
    first: &[Option<Link>],
    cancel: &AtomicBool,
) -> Option<Candidate> {
    let (mut poses, mut lenses) = (guess.poses.clone(), guess.lenses.clone());
    for times in GUESS_OFF {
        let loose = survey.loosened(times);
        let tracks = retracked(&loose, &poses, &lenses);
        let mut grower = Grower::new(&loose, &tracks, &[], &lenses, cancel);
        grower.state.poses = poses;
        grower.triangulate();
        grower.adjust(GUESS_STEPS);
        Grown { poses, lenses, .. } = grower.state;
    }
    let links = survey.links(&lenses, 60, Some(first));
    let links: Vec<Link> = links.into_iter().flatten().filter(is_link).collect();
    let links = rotations::consistent(survey.views.len(), &links);
    let tracks = retracked(survey, &poses, &lenses);
    let mut grower = Grower::new(survey, &tracks, &links, &lenses, cancel);
    grower.state.poses = poses;
    grower.triangulate();
    grower.place_all(survey.seed);
    let Grower { state: grown, .. } = grower;
    let score = score_of(survey, &grown);
    (grown.poses.iter().flatten().count() >= 2).then_some(Candidate { grown, links, tracks, score })
}

/// Pairs to start from: many matches, rays that meet at a wide angle, and no two of the same photo
/// where it can be avoided.
fn first_pairs(links: &[Link], count: usize) -> Vec<Link> {
    let worth = |link: &Link| {
        let geometry = &link.geometry;
        let parallax = geometry.inliers.len() as f64 * (1.0 - geometry.rotation_share);
        let depth = 1.0 - 0.5 * geometry.plane_share;
        parallax * depth * (geometry.angle_deg / 8.0).min(1.0)
    };
    let mut order: Vec<&Link> = links.iter().collect();
    order.sort_by(|a, b| worth(b).total_cmp(&worth(a)).then(a.pair.cmp(&b.pair)));
    let mut picked: Vec<Link> = Vec::new();
    for link in &order {
        let new = picked.iter().all(|p| p.photos.iter().all(|x| !link.photos.contains(x)));
        if picked.len() < count && new {
            picked.push((*link).clone());
        }
    }
    for link in order {
        if picked.len() < count && picked.iter().all(|p| p.pair != link.pair) {
            picked.push(link.clone());
        }
    }
    picked
}

/// The pose of the second photo from the first; the distance is 1 where they are apart.
pub(crate) fn between(first: &Pose, second: &Pose) -> Pose {
    let r = second.r * first.r.transpose();
    let t = second.t - r * first.t;
    Pose { r, t: t.try_normalize(1e-12).unwrap_or_default() }
}

/// How well a solution explains the matches of all pairs of photos that it places.
pub(crate) fn score_of(survey: &Survey, grown: &Grown) -> f64 {
    let of = |pair: &Pair| {
        let pose = between_placed(&grown.poses, pair.photos)?;
        let directions = survey.directions(pair, &grown.lenses);
        Some(two_view::fit(&pose, &directions, survey.threshold(pair, &grown.lenses)))
    };
    survey.pairs.iter().filter_map(of).sum()
}

/// The pose of the second of two placed photos from the first.
pub(crate) fn between_placed(poses: &[Option<Pose>], photos: [usize; 2]) -> Option<Pose> {
    let [first, second] = photos.map(|photo| poses[photo].as_ref());
    Some(between(first?, second?))
}

/// Matches of a link's pair that a solution explains, and those that the link's own geometry does.
pub(crate) fn explained(survey: &Survey, link: &Link, grown: &Grown) -> Option<(f64, f64)> {
    let pose = between_placed(&grown.poses, link.photos)?;
    let pair = &survey.pairs[link.pair];
    let directions = survey.directions(pair, &grown.lenses);
    let threshold = survey.threshold(pair, &grown.lenses);
    let near = two_view::inliers_of(&pose, &directions, threshold * threshold);
    Some((near.len() as f64, link.geometry.inliers.len() as f64))
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::AtomicBool;

    use nalgebra::Vector3;
    use segsplat_core::scene::{Camera, Intrinsics};

    use super::{between, from_guess, survey};
    use crate::{
        given::{PairMatches, PhotoKeypoints, SolveOptions},
        lens::Lens,
        pose::{Pose, angle_deg, camera_to_world, rotation},
        rng::Rng,
    };

    const SIZE: [u32; 2] = [640, 480];
    const FOCAL: f64 = 560.0;

    /// The largest turn from camera to camera between two lists, degrees.
    fn off(found: &[Option<Pose>], truth: &[Pose]) -> f64 {
        let first = found[0].expect("the first photo");
        let turn = |(found, own): (&Option<Pose>, &Pose)| {
            let found = between(&first, &found.expect("a camera"));
            angle_deg(&(found.r * between(&truth[0], own).r.transpose()))
        };
        found.iter().zip(truth).map(turn).fold(0.0, f64::max)
    }

    #[test]
    fn a_guess_that_is_nearly_right_is_led_to_the_truth() {
        let mut rng = Rng::new(9, 0);
        let mut draw = || rng.below(1 << 20) as f64 / f64::from(1 << 19) - 1.0;
        let mut point = |size: f64| Vector3::new(draw(), draw(), draw()) * size;
        let points: Vec<Vector3<f64>> = (0..200).map(|_| point(1.0)).collect();
        let truth: Vec<Pose> = (0..5)
            .map(|i| Pose {
                r: rotation(&Vector3::new(0.1, 0.2 * f64::from(i), 0.0)),
                t: Vector3::new(0.0, 0.0, 4.0),
            })
            .collect();
        let lens = Lens { focal: FOCAL, k1: 0.0 };
        let middle = SIZE.map(|side| side as f32 / 2.0);
        let photo = |pose: &Pose| {
            let pixel = |point: &Vector3<f64>| {
                let at = lens.project(&pose.seen(point)).expect("in front");
                [at.x as f32 + middle[0], at.y as f32 + middle[1]]
            };
            // Three degrees off, a twentieth of the distance, and a focal length that is too long.
            let wrong = pose.moved(
                &(point(1.0).normalize() * 3_f64.to_radians()),
                &(point(1.0).normalize() * 0.2),
            );
            let [cx, cy] = middle.map(f64::from);
            let (fx, fy) = (1.08 * FOCAL, 1.08 * FOCAL);
            let intrinsics = Intrinsics { fx, fy, cx, cy, width: SIZE[0], height: SIZE[1] };
            let guess = Some(Camera { intrinsics, camera_to_world: camera_to_world(&wrong) });
            let keypoints = points.iter().map(pixel).collect();
            PhotoKeypoints { size: SIZE, guess, keypoints, ..PhotoKeypoints::default() }
        };
        let photos: Vec<PhotoKeypoints> = truth.iter().map(photo).collect();
        // A third of the matches is wrong.
        let other = |i: u32| if i.is_multiple_of(3) { (i * 7 + 30) % 198 / 3 * 3 } else { i };
        let pairs: Vec<[u32; 2]> = (0..198).map(|i| [i, other(i)]).collect();
        let pair = |photos| PairMatches { photos, pairs: pairs.clone(), scores: Vec::new() };
        let all = (0..5).flat_map(|a| (a + 1..5).map(move |b| [a, b]));
        let matches: Vec<PairMatches> = all.map(pair).collect();
        let survey = survey(&photos, &matches, &SolveOptions::default());
        let guess = survey.guess.clone().expect("a guess");
        let before = off(&guess.poses, &truth);
        assert!(before > 2.0, "{before} degrees");
        let never = AtomicBool::new(false);
        let first = survey.links(&guess.lenses, usize::MAX, None);
        let led = from_guess(&survey, &guess, &first, &never).expect("a solution").grown;
        let after = off(&led.poses, &truth);
        assert!(after < 0.05, "{after} degrees of {before}");
        assert!((led.lenses[0].focal / FOCAL - 1.0).abs() < 0.01, "{:?}", led.lenses);
    }
}
