//! What the solver works on: keypoints from the photos' middles, lenses, and pairs of photos with
//! their geometry.

use nalgebra::Vector2;
use rayon::prelude::*;

use crate::{
    adjust::LensPrior,
    lens::Lens,
    pose::Pose,
    rng::Rng,
    two_view::{self, Directions, TwoView},
};

/// Distance at which a keypoint still agrees, as a share of the photo's longer side.
const AGREE_SHARE: f64 = 0.003;

/// The share of the score of a link's own geometry with which another is as good.
const AS_GOOD: f64 = 0.85;

/// A photo as the solver sees it.
#[derive(Clone, Debug)]
pub(crate) struct View {
    pub(crate) lens: usize,
    /// Keypoints, pixels from the middle.
    pub(crate) pixels: Vec<Vector2<f64>>,
    /// Distance at which a keypoint still agrees, pixels.
    pub(crate) agree_px: f64,
    pub(crate) side: f64,
    /// Width and height, pixels.
    pub(crate) size: [f64; 2],
}

/// A pair of photos and its matches, the most trusted first.
#[derive(Clone, Debug)]
pub(crate) struct Pair {
    pub(crate) photos: [usize; 2],
    pub(crate) matches: Vec<[u32; 2]>,
}

/// All that was given.
#[derive(Clone, Debug)]
pub(crate) struct Survey {
    pub(crate) views: Vec<View>,
    pub(crate) pairs: Vec<Pair>,
    pub(crate) priors: Vec<LensPrior>,
    /// Where at least two photos have one.
    pub(crate) guess: Option<Guess>,
    pub(crate) seed: u64,
}

/// What a network says of the photos, in a world of its own.
#[derive(Clone, Debug)]
pub(crate) struct Guess {
    pub(crate) poses: Vec<Option<Pose>>,
    pub(crate) lenses: Vec<Lens>,
}

/// A pair whose geometry was found.
#[derive(Clone, Debug)]
pub(crate) struct Link {
    /// Index of the pair.
    pub(crate) pair: usize,
    pub(crate) photos: [usize; 2],
    pub(crate) geometry: TwoView,
    /// Share of the matches that agree.
    pub(crate) share: f64,
}

impl Link {
    /// How far the pair is trusted. Photos of different sides of a thing give many matches that
    /// agree by its outline, but never most of them.
    pub(crate) fn strength(&self) -> f64 {
        strength(self.geometry.inliers.len(), self.share)
    }
}

/// [`Link::strength`] of so many matches that agree, and their share of all.
pub(crate) fn strength(agreeing: usize, share: f64) -> f64 {
    agreeing as f64 * share.powi(3)
}

impl View {
    pub(crate) fn agree_px(side: f64) -> f64 {
        AGREE_SHARE * side
    }
}

impl Survey {
    /// The same with keypoints that agree from so many times as far.
    pub(crate) fn loosened(&self, times: f64) -> Self {
        let mut loose = self.clone();
        loose.views.iter_mut().for_each(|view| view.agree_px *= times);
        loose
    }

    /// Directions of the matches of a pair under lenses.
    pub(crate) fn directions(&self, pair: &Pair, lenses: &[Lens]) -> Directions {
        let [a, b] = pair.photos.map(|photo| &self.views[photo]);
        let side = |view: &View, keypoint: u32| {
            lenses[view.lens].direction(&view.pixels[keypoint as usize])
        };
        Directions {
            first: pair.matches.iter().map(|m| side(a, m[0])).collect(),
            second: pair.matches.iter().map(|m| side(b, m[1])).collect(),
        }
    }

    /// The agreement threshold of a pair on the planes z = 1.
    pub(crate) fn threshold(&self, pair: &Pair, lenses: &[Lens]) -> f64 {
        let each = pair.photos.map(|photo| {
            let view = &self.views[photo];
            view.agree_px / lenses[view.lens].focal
        });
        0.5 * (each[0] + each[1])
    }

    /// Takes the geometry next to a pose as that of a link, where the matches fit it nearly as well
    /// as the link's own: a plane has two poses, and two photos from one place have many.
    pub(crate) fn lean(&self, link: &mut Link, pose: &Pose, lenses: &[Lens]) {
        let pair = &self.pairs[link.pair];
        let (directions, threshold) = (self.directions(pair, lenses), self.threshold(pair, lenses));
        let (pose, score) = two_view::next_to(pose, &directions, threshold);
        if score >= AS_GOOD * link.geometry.score {
            let mut rng = Rng::new(self.seed, link.pair as u64);
            link.geometry = two_view::describe(pose, score, &directions, threshold, &mut rng);
            link.share = link.geometry.inliers.len() as f64 / pair.matches.len() as f64;
        }
    }

    /// The geometry of each pair under lenses; `before` has what was found under others.
    pub(crate) fn links(
        &self,
        lenses: &[Lens],
        samples_max: usize,
        before: Option<&[Option<Link>]>,
    ) -> Vec<Option<Link>> {
        let of = |(index, pair): (usize, &Pair)| {
            let start = match before {
                Some(before) => Some(before[index].as_ref()?.geometry.pose),
                None => None,
            };
            let mut rng = Rng::new(self.seed, index as u64);
            let directions = self.directions(pair, lenses);
            let threshold = self.threshold(pair, lenses);
            let (pose, score) =
                two_view::find(&directions, threshold, samples_max, start, &mut rng)?;
            let geometry = two_view::describe(pose, score, &directions, threshold, &mut rng);
            let share = geometry.inliers.len() as f64 / pair.matches.len() as f64;
            Some(Link { pair: index, photos: pair.photos, geometry, share })
        };
        self.pairs.par_iter().enumerate().map(of).collect()
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Vector2, Vector3};

    use super::{Link, Pair, Survey, View};
    use crate::{
        adjust::LensPrior,
        lens::Lens,
        pose::{Pose, angle_deg, rotation},
        rng::Rng,
        two_view,
    };

    #[test]
    fn a_link_of_photos_from_one_place_leans_on_a_solution_and_one_of_others_does_not() {
        let turn = rotation(&Vector3::new(0.05, 0.1, 0.0));
        let right = Pose { r: turn, t: Vector3::x() };
        // From one place any step fits.
        for (step, leans) in [(0.0, true), (1.0, false)] {
            let mut rng = Rng::new(5, 0);
            let mut draw = || rng.below(1 << 20) as f64 / f64::from(1 << 20) - 0.5;
            let lens = Lens { focal: 500.0, k1: 0.0 };
            let mut pixels = [Vec::new(), Vec::new()];
            for _ in 0..200 {
                let point = Vector3::new(4.0 * draw(), 3.0 * draw(), 6.0 + 4.0 * draw());
                let seen = turn * point + right.t * step;
                for (pixels, seen) in pixels.iter_mut().zip([point, seen]) {
                    pixels.push(lens.pixel(&(seen.xy() / seen.z)) + Vector2::new(draw(), draw()));
                }
            }
            let view =
                |pixels| View { lens: 0, pixels, agree_px: 2.0, side: 640.0, size: [640.0, 480.0] };
            let prior = LensPrior { focal: 500.0, log_spread: 0.1, known: true, k1_spread: 0.1 };
            let survey = Survey {
                views: pixels.map(view).into(),
                pairs: vec![Pair { photos: [0, 1], matches: (0..200).map(|i| [i, i]).collect() }],
                priors: vec![prior],
                guess: None,
                seed: 0,
            };
            let pair = &survey.pairs[0];
            let (directions, threshold) =
                (survey.directions(pair, &[lens]), survey.threshold(pair, &[lens]));
            let (pose, score) = two_view::next_to(&right, &directions, threshold);
            let geometry = two_view::describe(pose, score, &directions, threshold, &mut rng);
            let mut link = Link { pair: 0, photos: [0, 1], geometry, share: 1.0 };
            let other = Pose { r: turn, t: Vector3::y() };
            survey.lean(&mut link, &other, &[lens]);
            let off = link.geometry.pose.t.cross(&Vector3::y()).norm().asin().to_degrees();
            assert_eq!(off < 45.0, leans, "{off} degrees from the step of the solution");
            assert!(angle_deg(&(link.geometry.pose.r * turn.transpose())) < 1.0 || leans);
        }
    }
}
