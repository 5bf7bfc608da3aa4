//! Bundle adjustment: poses, lenses and points that together fit the keypoints best. Levenberg and
//! Marquardt's steps on Cauchy's loss, with the points eliminated (Schur complement); the system of
//! cameras and lenses that is left is small and dense.

use nalgebra::{DMatrix, DVector, Matrix2x3, Matrix3, SMatrix, SVector, Vector2, Vector3};

use crate::{
    lens::Lens,
    pose::{Pose, cross},
};

/// A keypoint that a point is seen at.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sight {
    pub(crate) camera: usize,
    pub(crate) pixel: Vector2<f64>,
}

/// What is known of a lens before: it pulls softly.
#[derive(Clone, Copy, Debug)]
pub(crate) struct LensPrior {
    /// Focal length, pixels, and the spread of its logarithm.
    pub(crate) focal: f64,
    pub(crate) log_spread: f64,
    /// Whether the focal length is from EXIF.
    pub(crate) known: bool,
    /// Spread of k1 about 0.
    pub(crate) k1_spread: f64,
}

/// Which numbers may move, and how far the loss trusts a keypoint.
#[derive(Clone, Copy, Debug)]
pub(crate) struct AdjustOptions {
    pub(crate) steps: usize,
    pub(crate) free_focal: bool,
    pub(crate) free_k1: bool,
    /// Distance at which a keypoint has half of its weight, pixels.
    pub(crate) scale_px: f64,
}

/// The state that is adjusted. `poses` of cameras that no sight names stay.
#[derive(Clone, Debug)]
pub(crate) struct Bundle {
    pub(crate) poses: Vec<Pose>,
    /// Lens of each camera.
    pub(crate) lens_of: Vec<usize>,
    pub(crate) lenses: Vec<Lens>,
    pub(crate) priors: Vec<LensPrior>,
    pub(crate) points: Vec<Vector3<f64>>,
    /// Sights of each point, at most one a camera.
    pub(crate) sights: Vec<Vec<Sight>>,
}

type Block = SMatrix<f64, 6, 3>;
type LensBlock = SMatrix<f64, 2, 3>;

/// The normal equations of cameras and lenses.
struct Equations {
    /// The first number of each camera that moves.
    slot: Vec<Option<usize>>,
    /// The first number of the lenses.
    lens_at: usize,
    system: DMatrix<f64>,
    right: DVector<f64>,
    parts: Vec<Option<PointPart>>,
}

/// A point's part of the normal equations.
struct PointPart {
    inverse: Matrix3<f64>,
    gradient: Vector3<f64>,
    cameras: Vec<(usize, Block)>,
    lenses: Vec<(usize, LensBlock)>,
}

const LENS_PARAMS: usize = 2;
/// What holds the scale where nothing tells it, as a share of what holds the surest number.
const NO_SCALE: f64 = 1e-10;
/// Spreads from which on a lens is thought to be another than was said (Cauchy's loss), of its
/// focal length and of k1: EXIF may lie, and most lenses are plain, but not all.
const DOUBTS: [f64; 2] = [3.0, 1.0];

impl Bundle {
    /// Cauchy's loss of all sights and the priors.
    pub(crate) fn cost(&self, options: &AdjustOptions) -> f64 {
        let s2 = options.scale_px * options.scale_px;
        let mut sum = 0.0;
        for (point, sights) in self.points.iter().zip(&self.sights) {
            for sight in sights {
                let lens = self.lenses[self.lens_of[sight.camera]];
                let seen = lens.project(&self.poses[sight.camera].seen(point));
                // Behind the camera: as far off as 100 px.
                let e2 = seen.map_or(1e4, |p| (p - sight.pixel).norm_squared());
                sum += s2 * (e2 / s2).ln_1p();
            }
        }
        sum + self.prior_cost(options)
    }

    fn prior_cost(&self, options: &AdjustOptions) -> f64 {
        let s2 = options.scale_px * options.scale_px;
        let each = self.lenses.iter().zip(&self.priors).map(|(lens, prior)| {
            let focal = (lens.focal / prior.focal).ln() / prior.log_spread;
            let k1 = lens.k1 / prior.k1_spread;
            let soft = |of: f64, doubt: f64| doubt * doubt * (of / doubt).powi(2).ln_1p();
            soft(focal, DOUBTS[0]) + soft(k1, DOUBTS[1])
        });
        s2 * each.sum::<f64>()
    }

    /// Takes steps until they gain nothing. `fixed` is the camera that stays; its frame is the
    /// world's. Returns the cost.
    pub(crate) fn adjust(&mut self, fixed: usize, options: &AdjustOptions) -> f64 {
        let mut cost = self.cost(options);
        let mut damping = 1e-4;
        for _ in 0..options.steps {
            let mut gained = 0.0;
            for _ in 0..6 {
                let next = self.step(fixed, options, damping);
                let next_cost = next.as_ref().map_or(f64::INFINITY, |n| n.cost(options));
                if let Some(next) = next
                    && next_cost < cost
                {
                    gained = (cost - next_cost) / cost.max(1e-12);
                    cost = next_cost;
                    *self = next;
                    damping = (damping * 0.2_f64).max(1e-9);
                    break;
                }
                damping *= 8.0;
            }
            if gained < 1e-5 {
                break;
            }
        }
        cost
    }

    /// The equations of cameras and lenses, the points eliminated.
    fn equations(&self, fixed: usize, options: &AdjustOptions, damping: f64) -> Equations {
        let mut slot = vec![None; self.poses.len()];
        let mut cameras = 0;
        for sight in self.sights.iter().flatten() {
            if sight.camera != fixed && slot[sight.camera].is_none() {
                slot[sight.camera] = Some(0);
            }
        }
        for place in slot.iter_mut().flatten() {
            *place = 6 * cameras;
            cameras += 1;
        }
        let lens_at = 6 * cameras;
        let size = lens_at + LENS_PARAMS * self.lenses.len();
        let mut system = DMatrix::<f64>::zeros(size, size);
        let mut right = DVector::<f64>::zeros(size);
        let mut parts = Vec::with_capacity(self.points.len());
        for (point, sights) in self.points.iter().zip(&self.sights) {
            parts.push(self.add_point(
                point,
                sights,
                &slot,
                lens_at,
                options,
                damping,
                &mut system,
                &mut right,
            ));
        }
        self.add_priors(lens_at, options, &mut system, &mut right);
        for i in 0..size {
            system[(i, i)] += 1e-12;
        }
        Equations { slot, lens_at, system, right, parts }
    }

    /// How surely the photos' turns are known: the covariance of each camera's turn, about the mean
    /// of all and in the world, for keypoints that are off by a pixel along x and along y; zero of
    /// cameras that no sight names. `None` where the equations do not tell.
    pub(crate) fn turns(&self, fixed: usize, options: &AdjustOptions) -> Option<Vec<Matrix3<f64>>> {
        let Equations { slot, mut system, .. } = self.equations(fixed, options, 0.0);
        // Nothing tells the scale.
        let least = NO_SCALE * system.diagonal().max();
        for i in 0..system.nrows() {
            system[(i, i)] += least;
        }
        let inverse = system.cholesky()?.inverse();
        let cameras: Vec<usize> =
            (0..slot.len()).filter(|&i| i == fixed || slot[i].is_some()).collect();
        let both = |i: usize, j: usize| match (slot[i], slot[j]) {
            (Some(row), Some(column)) => {
                let own = inverse.fixed_view::<3, 3>(row, column);
                self.poses[i].r.transpose() * own * self.poses[j].r
            }
            // The fixed camera does not turn.
            _ => Matrix3::zeros(),
        };
        let count = cameras.len() as f64;
        let with_mean: Vec<Matrix3<f64>> = (0..slot.len())
            .map(|i| cameras.iter().map(|&j| both(i, j)).sum::<Matrix3<f64>>() / count)
            .collect();
        let of_mean = cameras.iter().map(|&i| with_mean[i]).sum::<Matrix3<f64>>() / count;
        let about_mean = |i: usize| match cameras.contains(&i) {
            true => both(i, i) - with_mean[i] - with_mean[i].transpose() + of_mean,
            false => Matrix3::zeros(),
        };
        Some((0..slot.len()).map(about_mean).collect())
    }

    /// The state after one step, or `None` where the equations cannot be solved.
    fn step(&self, fixed: usize, options: &AdjustOptions, damping: f64) -> Option<Self> {
        let Equations { slot, lens_at, system, right, parts } =
            self.equations(fixed, options, damping);
        let delta = system.cholesky()?.solve(&right);
        let mut next = self.clone();
        for (pose, place) in next.poses.iter_mut().zip(&slot) {
            if let Some(at) = *place {
                let turn = Vector3::new(delta[at], delta[at + 1], delta[at + 2]);
                let shift = Vector3::new(delta[at + 3], delta[at + 4], delta[at + 5]);
                *pose = pose.moved(&turn, &shift);
            }
        }
        for (i, lens) in next.lenses.iter_mut().enumerate() {
            let at = lens_at + LENS_PARAMS * i;
            lens.focal *= delta[at].clamp(-0.3, 0.3).exp();
            lens.k1 = (lens.k1 + delta[at + 1]).clamp(-0.5, 0.5);
        }
        for (point, part) in next.points.iter_mut().zip(&parts) {
            let Some(part) = part else { continue };
            let mut gradient = part.gradient;
            for (at, block) in &part.cameras {
                gradient -= block.transpose() * delta.fixed_rows::<6>(*at);
            }
            for (lens, block) in &part.lenses {
                let at = lens_at + LENS_PARAMS * lens;
                gradient -= block.transpose() * delta.fixed_rows::<2>(at);
            }
            *point += part.inverse * gradient;
        }
        Some(next)
    }

    /// Adds a point's equations to the system of cameras, the point eliminated.
    #[expect(clippy::too_many_arguments, reason = "one loop body of `step`, with its state")]
    fn add_point(
        &self,
        point: &Vector3<f64>,
        sights: &[Sight],
        slot: &[Option<usize>],
        lens_at: usize,
        options: &AdjustOptions,
        damping: f64,
        system: &mut DMatrix<f64>,
        right: &mut DVector<f64>,
    ) -> Option<PointPart> {
        let s2 = options.scale_px * options.scale_px;
        let mut hessian = Matrix3::zeros();
        let mut gradient = Vector3::zeros();
        let mut cameras: Vec<(usize, Block)> = Vec::with_capacity(sights.len());
        let mut lenses: Vec<(usize, LensBlock)> = Vec::new();
        for sight in sights {
            let pose = &self.poses[sight.camera];
            let lens_index = self.lens_of[sight.camera];
            let seen = pose.seen(point);
            let Some((pixel, by_seen, mut by_lens)) = self.lenses[lens_index].derivatives(&seen)
            else {
                continue;
            };
            if !options.free_focal {
                by_lens.column_mut(0).fill(0.0);
            }
            if !options.free_k1 {
                by_lens.column_mut(1).fill(0.0);
            }
            let rest = sight.pixel - pixel;
            let weight = 1.0 / (1.0 + rest.norm_squared() / s2);
            let by_point: Matrix2x3<f64> = by_seen * pose.r;
            hessian += by_point.transpose() * by_point * weight;
            gradient += by_point.transpose() * rest * weight;
            let at = lens_at + LENS_PARAMS * lens_index;
            let lens_block: LensBlock = by_lens.transpose() * by_point * weight;
            match lenses.iter_mut().find(|(index, _)| *index == lens_index) {
                Some((_, block)) => *block += lens_block,
                None => lenses.push((lens_index, lens_block)),
            }
            let own = by_lens.transpose() * by_lens * weight;
            let mut view = system.fixed_view_mut::<2, 2>(at, at);
            view += own * (1.0 + damping);
            let mut rows = right.fixed_rows_mut::<2>(at);
            rows += by_lens.transpose() * rest * weight;
            let Some(camera_at) = slot[sight.camera] else { continue };
            let turn: Matrix2x3<f64> = -by_seen * cross(&seen);
            let mut by_pose = SMatrix::<f64, 2, 6>::zeros();
            by_pose.fixed_columns_mut::<3>(0).copy_from(&turn);
            by_pose.fixed_columns_mut::<3>(3).copy_from(&by_seen);
            let mut own: SMatrix<f64, 6, 6> = by_pose.transpose() * by_pose * weight;
            for i in 0..6 {
                own[(i, i)] *= 1.0 + damping;
            }
            let mut view = system.fixed_view_mut::<6, 6>(camera_at, camera_at);
            view += own;
            let mut view = system.fixed_view_mut::<2, 6>(at, camera_at);
            view += by_lens.transpose() * by_pose * weight;
            let mut rows = right.fixed_rows_mut::<6>(camera_at);
            rows += by_pose.transpose() * rest * weight;
            cameras.push((camera_at, by_pose.transpose() * by_point * weight));
        }
        for i in 0..3 {
            hessian[(i, i)] = hessian[(i, i)] * (1.0 + damping) + 1e-12;
        }
        let inverse = hessian.try_inverse()?;
        for (a, (row, left)) in cameras.iter().enumerate() {
            let scaled = left * inverse;
            let mut rows = right.fixed_rows_mut::<6>(*row);
            rows -= scaled * gradient;
            for (column, other) in &cameras[..=a] {
                // The lower triangle is what Cholesky's method reads.
                let block = scaled * other.transpose();
                if row >= column {
                    let mut view = system.fixed_view_mut::<6, 6>(*row, *column);
                    view -= block;
                } else {
                    let mut view = system.fixed_view_mut::<6, 6>(*column, *row);
                    view -= block.transpose();
                }
            }
        }
        for (a, (lens, left)) in lenses.iter().enumerate() {
            let row = lens_at + LENS_PARAMS * lens;
            let scaled = left * inverse;
            let mut rows = right.fixed_rows_mut::<2>(row);
            rows -= scaled * gradient;
            for (column, other) in &cameras {
                let mut view = system.fixed_view_mut::<2, 6>(row, *column);
                view -= scaled * other.transpose();
            }
            for (other_lens, other) in &lenses[..=a] {
                let column = lens_at + LENS_PARAMS * other_lens;
                let block = scaled * other.transpose();
                if row >= column {
                    let mut view = system.fixed_view_mut::<2, 2>(row, column);
                    view -= block;
                } else {
                    let mut view = system.fixed_view_mut::<2, 2>(column, row);
                    view -= block.transpose();
                }
            }
        }
        Some(PointPart { inverse, gradient, cameras, lenses })
    }

    fn add_priors(
        &self,
        lens_at: usize,
        options: &AdjustOptions,
        system: &mut DMatrix<f64>,
        right: &mut DVector<f64>,
    ) {
        let s2 = options.scale_px * options.scale_px;
        for (i, (lens, prior)) in self.lenses.iter().zip(&self.priors).enumerate() {
            let at = lens_at + LENS_PARAMS * i;
            let rest = SVector::<f64, 2>::new((prior.focal / lens.focal).ln(), -lens.k1);
            let spreads = [prior.log_spread, prior.k1_spread];
            let weights: [f64; 2] = std::array::from_fn(|k| {
                let off = rest[k] / (spreads[k] * DOUBTS[k]);
                s2 / (spreads[k] * spreads[k] * (1.0 + off * off))
            });
            for (k, free) in [options.free_focal, options.free_k1].into_iter().enumerate() {
                // A number that is held has only this equation: it stays.
                let (weight, rest) = if free { (weights[k], rest[k]) } else { (1.0, 0.0) };
                system[(at + k, at + k)] += weight;
                right[at + k] += weight * rest;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector2, Vector3};

    use super::{AdjustOptions, Bundle, LensPrior, Sight};
    use crate::{
        lens::Lens,
        pose::{Pose, rotation},
        rng::Rng,
    };

    /// The turn of a rotation, axis times angle, where it is small.
    fn turn_of(r: &Matrix3<f64>) -> Vector3<f64> {
        Vector3::new(r[(2, 1)] - r[(1, 2)], r[(0, 2)] - r[(2, 0)], r[(1, 0)] - r[(0, 1)]) * 0.5
    }

    #[test]
    fn turns_are_known_as_well_as_trials_say() {
        const TRIALS: usize = 400;
        const NOISE: f64 = 0.4;
        let mut rng = Rng::new(3, 0);
        let mut draw = || rng.below(1 << 20) as f64 / f64::from(1 << 20) - 0.5;
        let lens = Lens { focal: 500.0, k1: 0.0 };
        let points: Vec<Vector3<f64>> =
            (0..40).map(|_| Vector3::new(3.0 * draw(), 2.0 * draw(), 5.0 + 2.0 * draw())).collect();
        let pose = |i: usize| {
            let along = i as f64 - 1.5;
            let r = rotation(&Vector3::new(0.05 * along, 0.12 * along, 0.6 * along));
            Pose { r, t: -(r * Vector3::new(0.6 * along, 0.1, 0.0)) }
        };
        let exact = |i: usize, point: &Vector3<f64>| lens.project(&pose(i).seen(point)).unwrap();
        // The last camera sees a quarter of the points.
        let sees = |i: usize, k: usize| i != 3 || k.is_multiple_of(4);
        let sights = |k: usize| {
            let own = (0..4).filter(|&i| sees(i, k));
            own.map(|i| Sight { camera: i, pixel: exact(i, &points[k]) }).collect()
        };
        let prior = LensPrior { focal: 500.0, log_spread: 1.0, known: true, k1_spread: 1.0 };
        let right = Bundle {
            // No sight names the fifth.
            poses: (0..5).map(pose).collect(),
            lens_of: vec![0; 5],
            lenses: vec![lens],
            priors: vec![prior],
            sights: (0..points.len()).map(sights).collect(),
            points,
        };
        let options =
            AdjustOptions { steps: 6, free_focal: false, free_k1: false, scale_px: 1000.0 };
        let said = right.turns(0, &options).unwrap();
        let mut seen = [0.0; 4];
        for _ in 0..TRIALS {
            let mut bundle = right.clone();
            for sight in bundle.sights.iter_mut().flatten() {
                // A sum of twelve is normal enough; its deviation is 1.
                let mut normal = || (0..12).map(|_| draw()).sum::<f64>();
                sight.pixel += Vector2::new(normal(), normal()) * NOISE;
            }
            bundle.adjust(0, &options);
            let turns: Vec<Vector3<f64>> = (0..4)
                .map(|i| turn_of(&(right.poses[i].r.transpose() * bundle.poses[i].r)))
                .collect();
            let mean = turns.iter().sum::<Vector3<f64>>() / 4.0;
            for (seen, turn) in seen.iter_mut().zip(&turns) {
                *seen += (turn - mean).norm_squared() / TRIALS as f64;
            }
        }
        assert_eq!(said[4], Matrix3::zeros());
        for (i, (said, seen)) in said.iter().zip(seen).enumerate() {
            let ratio = (seen / (said.trace() * NOISE * NOISE)).sqrt();
            assert!((ratio - 1.0).abs() < 0.1, "camera {i}: {ratio} times what is said");
        }
        assert!(said[3].trace() > 2.0 * said[2].trace(), "few points hold the last camera");
    }
}
