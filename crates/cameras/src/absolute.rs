//! The pose of a photo from points of the scene: three points (Grunert's quartic), LO-RANSAC.

use nalgebra::{Matrix3, Matrix6, SMatrix, Vector2, Vector3, Vector6};

use crate::{
    lens::Lens,
    pose::{Pose, cross},
    rng::Rng,
    roots::real_roots,
};

const SAMPLES_MAX: usize = 800;
const MISS: f64 = 1e-4;

/// A point of the scene and the pixel from the photo's middle at which it is seen.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Seen {
    pub(crate) point: Vector3<f64>,
    pub(crate) pixel: Vector2<f64>,
}

/// Orthonormal axes of three points.
fn triad(p: &[Vector3<f64>; 3]) -> Option<Matrix3<f64>> {
    let x = (p[1] - p[0]).try_normalize(1e-12)?;
    let z = x.cross(&(p[2] - p[0])).try_normalize(1e-12)?;
    Some(Matrix3::from_columns(&[x, z.cross(&x), z]))
}

/// Poses that see three points along three unit rays.
pub(crate) fn three_points(points: [Vector3<f64>; 3], rays: [Vector3<f64>; 3]) -> Vec<Pose> {
    let a2 = (points[1] - points[2]).norm_squared();
    let b2 = (points[0] - points[2]).norm_squared();
    let c2 = (points[0] - points[1]).norm_squared();
    let (ca, cb, cg) = (rays[1].dot(&rays[2]), rays[0].dot(&rays[2]), rays[0].dot(&rays[1]));
    if b2 < 1e-18 {
        return Vec::new();
    }
    let (p, q) = ((a2 - c2) / b2, (a2 + c2) / b2);
    let (ab, cb2) = (a2 / b2, c2 / b2);
    let quartic = [
        (1.0 + p).powi(2) - 4.0 * ab * cg * cg,
        4.0 * (-p * (1.0 + p) * cb + 2.0 * ab * cg * cg * cb - (1.0 - q) * ca * cg),
        2.0 * (p * p - 1.0 + 2.0 * p * p * cb * cb + 2.0 * (1.0 - cb2) * ca * ca
            - 4.0 * q * ca * cb * cg
            + 2.0 * (1.0 - ab) * cg * cg),
        4.0 * (p * (1.0 - p) * cb - (1.0 - q) * ca * cg + 2.0 * cb2 * ca * ca * cb),
        (p - 1.0).powi(2) - 4.0 * cb2 * ca * ca,
    ];
    let Some(world) = triad(&points) else { return Vec::new() };
    let mut poses = Vec::new();
    for v in real_roots(&quartic).into_iter().filter(|v| *v > 0.0) {
        let below = 2.0 * (cg - v * ca);
        let u = ((p - 1.0) * v * v - 2.0 * p * cb * v + 1.0 + p) / below;
        let s2 = b2 / (1.0 + v * v - 2.0 * v * cb);
        if !u.is_finite() || u <= 0.0 || s2 <= 0.0 {
            continue;
        }
        let s = s2.sqrt();
        let seen = [rays[0] * s, rays[1] * (s * u), rays[2] * (s * v)];
        let Some(camera) = triad(&seen) else { continue };
        let r = camera * world.transpose();
        poses.push(Pose { r, t: seen[0] - r * points[0] });
    }
    poses
}

fn error2(pose: &Pose, lens: &Lens, seen: &Seen) -> f64 {
    let pixel = lens.project(&pose.seen(&seen.point));
    pixel.map_or(f64::INFINITY, |p| (p - seen.pixel).norm_squared())
}

fn score_of(pose: &Pose, lens: &Lens, all: &[Seen], t2: f64) -> f64 {
    all.iter().map(|seen| (1.0 - error2(pose, lens, seen) / t2).max(0.0)).sum()
}

/// Gauss and Newton's steps, Cauchy's weights, over what lies within twice the threshold.
fn refine(pose: &Pose, lens: &Lens, all: &[Seen], t2: f64, steps: usize) -> Pose {
    let mut pose = *pose;
    for _ in 0..steps {
        let mut hessian = Matrix6::zeros();
        let mut gradient = Vector6::zeros();
        for seen in all {
            let point = pose.seen(&seen.point);
            let Some((pixel, by_point, _)) = lens.derivatives(&point) else { continue };
            let rest = seen.pixel - pixel;
            let e2 = rest.norm_squared();
            if e2 > 4.0 * t2 {
                continue;
            }
            let weight = 1.0 / (1.0 + 4.0 * e2 / t2);
            let mut j = SMatrix::<f64, 2, 6>::zeros();
            j.fixed_columns_mut::<3>(0).copy_from(&(-by_point * cross(&point)));
            j.fixed_columns_mut::<3>(3).copy_from(&by_point);
            hessian += j.transpose() * j * weight;
            gradient += j.transpose() * rest * weight;
        }
        for i in 0..6 {
            hessian[(i, i)] = hessian[(i, i)] * (1.0 + 1e-9) + 1e-12;
        }
        let Some(delta) = hessian.cholesky().map(|c| c.solve(&gradient)) else { break };
        if !delta.iter().all(|v| v.is_finite()) {
            break;
        }
        pose = pose.moved(&delta.fixed_rows::<3>(0).into(), &delta.fixed_rows::<3>(3).into());
        if delta.norm() < 1e-10 {
            break;
        }
    }
    pose
}

/// The pose that most of the points agree with, and its score: the sum of 1 - (error / threshold)²
/// over those under the threshold.
pub(crate) fn find(
    all: &[Seen],
    lens: &Lens,
    threshold: f64,
    rng: &mut Rng,
) -> Option<(Pose, f64)> {
    if all.len() < 4 {
        return None;
    }
    let t2 = threshold * threshold;
    let rays: Vec<Vector3<f64>> =
        all.iter().map(|seen| lens.direction(&seen.pixel).push(1.0).normalize()).collect();
    let mut best: Option<(Pose, f64)> = None;
    let mut needed = SAMPLES_MAX;
    let mut round = 0;
    while round < needed {
        round += 1;
        let picked = rng.sample::<3>(all.len());
        for pose in three_points(picked.map(|i| all[i].point), picked.map(|i| rays[i])) {
            let score = score_of(&pose, lens, all, t2);
            if best.is_some_and(|(_, so_far)| score <= so_far) {
                continue;
            }
            let better = refine(&pose, lens, all, t2, 4);
            let better_score = score_of(&better, lens, all, t2);
            let found = if better_score > score { (better, better_score) } else { (pose, score) };
            best = Some(found);
            let share = (found.1 * 1.3 / all.len() as f64).clamp(1e-3, 0.999);
            let rounds = (MISS.ln() / (-share.powi(3)).ln_1p()).ceil();
            needed = needed.min((rounds as usize).max(10));
        }
    }
    let (pose, _) = best?;
    let pose = refine(&pose, lens, all, t2, 10);
    Some((pose, score_of(&pose, lens, all, t2)))
}

#[cfg(test)]
mod tests {
    use nalgebra::{Vector2, Vector3};

    use super::{Seen, find};
    use crate::{
        lens::Lens,
        pose::{Pose, angle_deg, rotation},
        rng::Rng,
    };

    #[test]
    fn a_photo_is_placed_among_two_thirds_of_wrong_points() {
        let mut rng = Rng::new(3, 0);
        let lens = Lens { focal: 500.0, k1: 0.05 };
        for round in 0..20 {
            let mut draw = || rng.below(1 << 20) as f64 / f64::from(1 << 20) * 2.0 - 1.0;
            let truth = Pose {
                r: rotation(&Vector3::new(draw(), draw(), draw())),
                t: Vector3::new(draw(), draw(), 5.0),
            };
            let seen: Vec<Seen> = (0..150)
                .map(|i| {
                    let point = Vector3::new(draw(), draw(), draw());
                    let mut pixel = lens.project(&truth.seen(&point)).expect("in front");
                    if i % 3 != 0 {
                        pixel = Vector2::new(300.0 * draw(), 200.0 * draw());
                    }
                    Seen { point, pixel }
                })
                .collect();
            let (pose, _) = find(&seen, &lens, 2.0, &mut Rng::new(1, round)).expect("a pose");
            let off = angle_deg(&(pose.r * truth.r.transpose()));
            // Wrong points that fall within the threshold pull a little.
            assert!(off < 0.05, "{off} degrees");
        }
    }
}
