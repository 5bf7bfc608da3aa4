//! The geometry of a pair of photos: an essential matrix by LO-RANSAC, what a homography and a pure
//! rotation explain of the same matches, and how surprising the agreement is.

use nalgebra::{Matrix3, Matrix5, Vector2, Vector3, Vector5};

use crate::{
    five_point::{essentials, poses_of},
    pose::{Pose, best_rotation, cross, project},
    rng::Rng,
};

/// Samples of five at most.
const SAMPLES_MAX: usize = 1200;
/// Samples after which a pair with few inliers is given up.
const SAMPLES_HOPELESS: usize = 400;
/// Chance to have missed a sample without outliers.
const MISS: f64 = 1e-4;

/// Directions of matched keypoints on the planes z = 1 of two cameras.
#[derive(Clone, Debug, Default)]
pub(crate) struct Directions {
    pub(crate) first: Vec<Vector2<f64>>,
    pub(crate) second: Vec<Vector2<f64>>,
}

impl Directions {
    pub(crate) fn len(&self) -> usize {
        self.first.len()
    }

    fn only(&self, matches: &[u32]) -> Self {
        let of = |side: &[Vector2<f64>]| matches.iter().map(|&i| side[i as usize]).collect();
        Self { first: of(&self.first), second: of(&self.second) }
    }
}

/// What was found of a pair.
#[derive(Clone, Debug)]
pub(crate) struct TwoView {
    /// The second camera from the first; the distance is 1.
    pub(crate) pose: Pose,
    /// Indices of matches that agree with it and are in front of both cameras.
    pub(crate) inliers: Vec<u32>,
    /// Sum of 1 - (error / threshold)² over the matches that agree.
    pub(crate) score: f64,
    /// Logarithm (base 10) of the number of such agreements that chance gives.
    pub(crate) log_chance: f64,
    /// Share of the inliers that a rotation alone explains.
    pub(crate) rotation_share: f64,
    /// Share of the inliers that one plane explains.
    pub(crate) plane_share: f64,
    /// Median angle between the rays of a match, degrees.
    pub(crate) angle_deg: f64,
}

/// Squared Sampson distance of a match to an essential matrix, on the planes z = 1.
pub(crate) fn sampson(e: &Matrix3<f64>, a: &Vector2<f64>, b: &Vector2<f64>) -> f64 {
    let line = Vector3::new(
        e[(0, 0)] * a.x + e[(0, 1)] * a.y + e[(0, 2)],
        e[(1, 0)] * a.x + e[(1, 1)] * a.y + e[(1, 2)],
        e[(2, 0)] * a.x + e[(2, 1)] * a.y + e[(2, 2)],
    );
    let back_x = e[(0, 0)] * b.x + e[(1, 0)] * b.y + e[(2, 0)];
    let back_y = e[(0, 1)] * b.x + e[(1, 1)] * b.y + e[(2, 1)];
    let value = b.x * line.x + b.y * line.y + line.z;
    let scale = line.x * line.x + line.y * line.y + back_x * back_x + back_y * back_y;
    value * value / scale.max(1e-18)
}

pub(crate) fn essential_of(pose: &Pose) -> Matrix3<f64> {
    cross(&pose.t) * pose.r
}

/// Sum of 1 - (error / threshold)² over the matches under the threshold. Stops where `best` cannot
/// be reached any more.
fn score_of(e: &Matrix3<f64>, matches: &Directions, t2: f64, best: f64) -> f64 {
    let mut score = 0.0;
    let mut left = matches.len() as f64;
    for (a, b) in matches.first.iter().zip(&matches.second) {
        score += (1.0 - sampson(e, a, b) / t2).max(0.0);
        left -= 1.0;
        if score + left < best {
            return 0.0;
        }
    }
    score
}

/// Depths along the two rays at which they are nearest to each other, in units of the distance.
fn depths(pose: &Pose, a: &Vector2<f64>, b: &Vector2<f64>) -> (f64, f64) {
    let (u, v) = ((pose.r * a.push(1.0)), b.push(1.0));
    // u da - v db = -t.
    let (uu, uv, vv) = (u.dot(&u), u.dot(&v), v.dot(&v));
    let (ut, vt) = (u.dot(&pose.t), v.dot(&pose.t));
    let det = uu * vv - uv * uv;
    if det < 1e-12 * uu * vv {
        return (f64::INFINITY, f64::INFINITY);
    }
    ((uv * vt - vv * ut) / det, (uu * vt - uv * ut) / det)
}

/// Matches that agree with the pose and lie in front of both cameras.
pub(crate) fn inliers_of(pose: &Pose, matches: &Directions, t2: f64) -> Vec<u32> {
    let e = essential_of(pose);
    let agrees = |&i: &u32| {
        let (a, b) = (&matches.first[i as usize], &matches.second[i as usize]);
        sampson(&e, a, b) < t2 && {
            let (da, db) = depths(pose, a, b);
            da > 0.0 && db > 0.0
        }
    };
    (0..matches.len() as u32).filter(agrees).collect()
}

/// The score of a pose over the matches that lie in front of both cameras.
pub(crate) fn fit(pose: &Pose, matches: &Directions, threshold: f64) -> f64 {
    let (e, t2) = (essential_of(pose), threshold * threshold);
    let worth =
        |i: u32| 1.0 - sampson(&e, &matches.first[i as usize], &matches.second[i as usize]) / t2;
    inliers_of(pose, matches, t2).into_iter().map(worth).sum()
}

/// The pose of an essential matrix that has most matches in front of both cameras.
fn in_front(e: &Matrix3<f64>, matches: &Directions, t2: f64) -> Option<Pose> {
    let near: Vec<usize> = (0..matches.len())
        .filter(|&i| sampson(e, &matches.first[i], &matches.second[i]) < t2)
        .collect();
    let count = |pose: &Pose| {
        let front = |&&i: &&usize| {
            let (a, b) = depths(pose, &matches.first[i], &matches.second[i]);
            a > 0.0 && b > 0.0
        };
        near.iter().filter(front).count()
    };
    poses_of(e)?.into_iter().max_by_key(count)
}

/// Gauss and Newton's steps on the Sampson distances, Cauchy's weights.
pub(crate) fn refine(pose: &Pose, matches: &Directions, t2: f64, steps: usize) -> Pose {
    let mut pose = *pose;
    for _ in 0..steps {
        let t = pose.t;
        let side = if t.x.abs() < 0.6 { Vector3::x() } else { Vector3::y() };
        let (b1, b2) = (t.cross(&side).normalize(), t.cross(&t.cross(&side)).normalize());
        let e = essential_of(&pose);
        let turns = [Vector3::x(), Vector3::y(), Vector3::z()];
        let by: [Matrix3<f64>; 5] = [
            cross(&t) * cross(&turns[0]) * pose.r,
            cross(&t) * cross(&turns[1]) * pose.r,
            cross(&t) * cross(&turns[2]) * pose.r,
            cross(&b1) * pose.r,
            cross(&b2) * pose.r,
        ];
        let mut hessian = Matrix5::zeros();
        let mut gradient = Vector5::zeros();
        for (a, b) in matches.first.iter().zip(&matches.second) {
            let (a, b) = (a.push(1.0), b.push(1.0));
            let (line, back) = (e * a, e.transpose() * b);
            let scale = line.xy().norm_squared() + back.xy().norm_squared();
            let value = b.dot(&line);
            let error2 = value * value / scale.max(1e-18);
            if error2 > 4.0 * t2 {
                continue;
            }
            let weight = 1.0 / ((1.0 + 4.0 * error2 / t2) * scale.max(1e-18));
            let j = Vector5::from_fn(|k, _| b.dot(&(by[k] * a)));
            hessian += j * j.transpose() * weight;
            gradient -= j * (value * weight);
        }
        for i in 0..5 {
            hessian[(i, i)] = hessian[(i, i)] * (1.0 + 1e-9) + 1e-15;
        }
        let Some(delta) = hessian.cholesky().map(|c| c.solve(&gradient)) else { break };
        let turn = Vector3::new(delta[0], delta[1], delta[2]);
        if !delta.iter().all(|v| v.is_finite()) || delta.norm() > 1.0 {
            break;
        }
        let turned = pose.moved(&turn, &Vector3::zeros());
        pose = Pose { r: turned.r, t: (t + b1 * delta[3] + b2 * delta[4]).normalize() };
        if delta.norm() < 1e-9 {
            break;
        }
    }
    pose
}

/// Draws samples of `K` matches: every second one from the better half of the list.
fn draw<const K: usize>(rng: &mut Rng, round: usize, count: usize) -> [usize; K] {
    let half = (count / 2).max(K);
    rng.sample::<K>(if round.is_multiple_of(2) && half <= count { half } else { count })
}

/// The essential matrix that most matches agree with. `matches` is in order of trust,
/// `threshold` on the plane z = 1; `start` is a pose to begin with.
pub(crate) fn find(
    matches: &Directions,
    threshold: f64,
    samples_max: usize,
    start: Option<Pose>,
    rng: &mut Rng,
) -> Option<(Pose, f64)> {
    let count = matches.len();
    if count < 8 {
        return None;
    }
    let t2 = threshold * threshold;
    let mut best: Option<(Pose, f64)> = start.map(|pose| {
        let pose = refine(&pose, matches, t2, 5);
        (pose, score_of(&essential_of(&pose), matches, t2, 0.0))
    });
    let mut needed = samples_max.min(SAMPLES_MAX);
    let mut round = 0;
    while round < needed {
        let picked = draw::<5>(rng, round, count);
        round += 1;
        let (a, b) = (picked.map(|i| matches.first[i]), picked.map(|i| matches.second[i]));
        for e in essentials(a, b) {
            let so_far = best.map_or(0.0, |(_, score)| score);
            let score = score_of(&e, matches, t2, so_far);
            if score <= so_far {
                continue;
            }
            let Some(pose) = in_front(&e, matches, t2) else { continue };
            let better = refine(&pose, matches, t2, 5);
            let better_score = score_of(&essential_of(&better), matches, t2, 0.0);
            let (pose, score) =
                if better_score > score { (better, better_score) } else { (pose, score) };
            best = Some((pose, score));
            let share = (score * 1.3 / count as f64).clamp(1e-3, 0.999);
            let rounds = (MISS.ln() / (-share.powi(5)).ln_1p()).ceil();
            needed = needed.min((rounds as usize).max(20));
        }
        if round == SAMPLES_HOPELESS && best.is_none_or(|(_, score)| score < 0.12 * count as f64) {
            break;
        }
    }
    let settled = |pose: &Pose| {
        let e = essential_of(&refine(pose, matches, t2, 10));
        Some((in_front(&e, matches, t2)?, score_of(&e, matches, t2, 0.0)))
    };
    let found = settled(&best?.0)?;
    // Samples on a plane end at either of its two poses: the better one is not always met.
    let near = inliers_of(&found.0, matches, t2);
    let (plane, _) = plane_of(&matches.only(&near), t2, rng);
    let of_plane = plane.as_ref().and_then(poses_of_plane).into_iter().flatten();
    let all = of_plane.filter_map(|pose| settled(&pose));
    Some(all.fold(found, |best, other| if other.1 > best.1 { other } else { best }))
}

/// The pose next to one that the matches fit best, and its score.
pub(crate) fn next_to(pose: &Pose, matches: &Directions, threshold: f64) -> (Pose, f64) {
    let t2 = threshold * threshold;
    let pose = refine(pose, matches, t2, 10);
    (pose, score_of(&essential_of(&pose), matches, t2, 0.0))
}

/// Logarithm (base 10) of the expected number of sets of `inliers` of `count` matches that agree by
/// chance within a share `p` of the picture (Moisan and Stival's number of false alarms).
fn log_chance(count: usize, inliers: usize, p: f64) -> f64 {
    let log_factorial = |n: usize| (2..=n).map(|i| (i as f64).log10()).sum::<f64>();
    let choose = |n: usize, k: usize| log_factorial(n) - log_factorial(k) - log_factorial(n - k);
    if inliers <= 5 {
        return 0.0;
    }
    choose(count, inliers) + choose(inliers, 5) + (inliers - 5) as f64 * p.log10() + 1.0
}

/// [`TwoView::log_chance`] of a number of matches that agree.
pub(crate) fn log_chance_of(matches: &Directions, inliers: usize, threshold: f64) -> f64 {
    let p = (2.0 * threshold / spread_of(&matches.second)).min(0.5);
    log_chance(matches.len(), inliers, p)
}

/// Everything about a pair whose pose is known.
pub(crate) fn describe(
    pose: Pose,
    score: f64,
    matches: &Directions,
    threshold: f64,
    rng: &mut Rng,
) -> TwoView {
    let t2 = threshold * threshold;
    let inliers = inliers_of(&pose, matches, t2);
    let log_chance = log_chance_of(matches, inliers.len(), threshold);
    let near = matches.only(&inliers);
    let unit = |d: &Vector2<f64>| d.push(1.0).normalize();
    let mut angles: Vec<f64> = near
        .first
        .iter()
        .zip(&near.second)
        .map(|(a, b)| (pose.r * unit(a)).cross(&unit(b)).norm().asin().to_degrees())
        .collect();
    angles.sort_by(f64::total_cmp);
    TwoView {
        pose,
        score,
        log_chance,
        rotation_share: rotation_share(&near, t2),
        plane_share: plane_of(&near, t2, rng).1,
        angle_deg: angles.get(angles.len() / 2).copied().unwrap_or(0.0),
        inliers,
    }
}

/// Side of the square that the directions fill.
fn spread_of(directions: &[Vector2<f64>]) -> f64 {
    let n = directions.len().max(1) as f64;
    let mean = directions.iter().sum::<Vector2<f64>>() / n;
    let var =
        directions.iter().map(|d| (d - mean).component_mul(&(d - mean))).sum::<Vector2<f64>>();
    // A uniform square of side s has a variance of s² / 12.
    (12.0 * (var.x * var.y).sqrt() / n).sqrt().max(1e-6)
}

/// Share of matches that one rotation explains.
fn rotation_share(matches: &Directions, t2: f64) -> f64 {
    let unit = |d: &Vector2<f64>| d.push(1.0).normalize();
    let mut kept: Vec<usize> = (0..matches.len()).collect();
    let mut share = 0.0;
    for _ in 0..4 {
        let pairs = kept.iter().map(|&i| (unit(&matches.first[i]), unit(&matches.second[i])));
        let Some(r) = best_rotation(pairs) else { return 0.0 };
        let error2 = |i: usize| {
            let seen = r * matches.first[i].push(1.0);
            (seen.xy() / seen.z.max(1e-6) - matches.second[i]).norm_squared()
        };
        let near = (0..matches.len()).filter(|&i| error2(i) < 2.0 * t2).count();
        share = near as f64 / matches.len().max(1) as f64;
        let mut errors: Vec<f64> = (0..matches.len()).map(error2).collect();
        errors.sort_by(f64::total_cmp);
        let bound = errors.get(errors.len() / 2).copied().unwrap_or(0.0).max(2.0 * t2);
        kept = (0..matches.len()).filter(|&i| error2(i) <= bound).collect();
    }
    share
}

/// The homography that most matches agree with, and their share.
fn plane_of(matches: &Directions, t2: f64, rng: &mut Rng) -> (Option<Matrix3<f64>>, f64) {
    let count = matches.len();
    if count < 8 {
        return (None, 1.0);
    }
    let mut best = (None, 0);
    for _ in 0..60 {
        let picked = rng.sample::<4>(count);
        let Some(h) =
            homography(picked.map(|i| matches.first[i]), picked.map(|i| matches.second[i]))
        else {
            continue;
        };
        let near = (0..count).filter(|&i| {
            let seen = h * matches.first[i].push(1.0);
            (seen.xy() / seen.z - matches.second[i]).norm_squared() < 2.0 * t2
        });
        let near = near.count();
        if near > best.1 {
            best = (Some(h), near);
        }
    }
    (best.0, best.1 as f64 / count as f64)
}

/// The two poses, up to the sign of the step, under which a plane is seen as a homography says (Ma,
/// Soatto, Košecká and Sastry, "An invitation to 3-D vision", 2004, 5.3.3); `None` where it is
/// nearly a rotation.
fn poses_of_plane(h: &Matrix3<f64>) -> Option<[Pose; 2]> {
    let middle = h.try_svd(false, false, 1e-14, 100)?.singular_values[1];
    let h = h / (middle * h.determinant().signum());
    let eigen = (h.transpose() * h).try_symmetric_eigen(1e-14, 100)?;
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[b].total_cmp(&eigen.eigenvalues[a]));
    let [most, _, least] = order.map(|i| eigen.eigenvalues[i]);
    let [v1, v2, v3] = order.map(|i| eigen.eigenvectors.column(i).into_owned());
    let (along, across) = ((1.0 - least).max(0.0).sqrt(), (most - 1.0).max(0.0).sqrt());
    let pose = |sign: f64| {
        // Two directions of the plane that keep their lengths.
        let u = (v1 * along + v3 * (sign * across)).try_normalize(1e-6)?;
        let normal = v2.cross(&u);
        let (to_v, to_u) = (h * v2, h * u);
        let to = Matrix3::from_columns(&[to_v, to_u, to_v.cross(&to_u)]);
        let r = project(&(to * Matrix3::from_columns(&[v2, u, normal]).transpose()))?;
        Some(Pose { r, t: ((h - r) * normal).try_normalize(1e-9)? })
    };
    Some([pose(1.0)?, pose(-1.0)?])
}

/// The homography of four pairs.
fn homography(a: [Vector2<f64>; 4], b: [Vector2<f64>; 4]) -> Option<Matrix3<f64>> {
    let basis = |p: [Vector2<f64>; 4]| {
        let m = Matrix3::from_columns(&[p[0].push(1.0), p[1].push(1.0), p[2].push(1.0)]);
        let scale = m.try_inverse()? * p[3].push(1.0);
        let well = scale.iter().all(|v| v.abs() > 1e-6 && v.is_finite());
        well.then(|| m * Matrix3::from_diagonal(&scale))
    };
    Some(basis(b)? * basis(a)?.try_inverse()?)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Vector2, Vector3};

    use super::{Directions, find, poses_of_plane};
    use crate::{
        pose::{Pose, angle_deg, rotation},
        rng::Rng,
    };

    const NORMAL: Vector3<f64> = Vector3::new(0.1, -0.5, 0.86);
    const FAR: f64 = 4.0;

    fn truth() -> Pose {
        let t = Vector3::new(-1.2, 0.3, 0.9);
        Pose { r: rotation(&Vector3::new(0.1, 0.5, -0.2)), t: t.normalize() }
    }

    /// The poses of the plane that is [`FAR`] along [`NORMAL`].
    fn of_plane() -> [Pose; 2] {
        let Pose { r, t } = truth();
        poses_of_plane(&((r + t * NORMAL.normalize().transpose() / FAR) * -3.0)).expect("two poses")
    }

    fn off(pose: &Pose) -> f64 {
        let Pose { r, t } = truth();
        angle_deg(&(pose.r * r.transpose())).max(pose.t.cross(&t).norm().asin().to_degrees())
    }

    #[test]
    fn one_of_the_two_poses_of_a_plane_is_the_right_one() {
        let off = of_plane().map(|pose| off(&pose));
        assert!(off[0].min(off[1]) < 1e-6 && off[0].max(off[1]) > 5.0, "{off:?}");
    }

    #[test]
    fn a_pair_that_begins_with_the_other_pose_of_a_plane_ends_with_the_right_one() {
        let mut rng = Rng::new(3, 0);
        let mut draw = || rng.below(1 << 20) as f64 / f64::from(1 << 20) - 0.5;
        let mut matches = Directions::default();
        for i in 0..300 {
            let ray = Vector2::new(draw(), draw()).push(1.0);
            // Every eighth point stands before the plane.
            let depth = if i % 8 == 0 { 0.6 + 0.3 * draw() } else { 1.0 };
            let point = ray * (depth * FAR / NORMAL.normalize().dot(&ray));
            let seen = truth().seen(&point);
            matches.first.push(ray.xy());
            matches.second.push(seen.xy() / seen.z + Vector2::new(draw(), draw()) * 1e-3);
        }
        let wrong = of_plane().into_iter().max_by(|a, b| off(a).total_cmp(&off(b)));
        let (pose, _) = find(&matches, 4e-3, 0, wrong, &mut Rng::new(1, 0)).expect("a pose");
        assert!(off(&pose) < 0.5, "{} degrees", off(&pose));
    }
}
