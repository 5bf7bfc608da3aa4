//! What the solver works on: keypoints from the photos' middles, lenses, and pairs of photos with
//! their geometry.

use nalgebra::Vector2;
use rayon::prelude::*;

use crate::{
    adjust::LensPrior,
    lens::Lens,
    rng::Rng,
    two_view::{self, Directions, TwoView},
};

/// Distance at which a keypoint still agrees, as a share of the photo's longer side.
const AGREE_SHARE: f64 = 0.003;

/// A photo as the solver sees it.
#[derive(Debug)]
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
#[derive(Debug)]
pub(crate) struct Pair {
    pub(crate) photos: [usize; 2],
    pub(crate) matches: Vec<[u32; 2]>,
}

/// All that was given.
#[derive(Debug)]
pub(crate) struct Survey {
    pub(crate) views: Vec<View>,
    pub(crate) pairs: Vec<Pair>,
    pub(crate) priors: Vec<LensPrior>,
    pub(crate) seed: u64,
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
        self.geometry.inliers.len() as f64 * self.share.powi(3)
    }
}

impl View {
    pub(crate) fn agree_px(side: f64) -> f64 {
        AGREE_SHARE * side
    }
}

impl Survey {
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
