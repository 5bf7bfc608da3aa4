//! Cameras one after the other from a first pair: each next photo by the points that it sees, each
//! time with new points, an adjustment, and what does not fit taken out.

use std::sync::atomic::{AtomicBool, Ordering};

use nalgebra::{Matrix3, Vector2, Vector3};

use crate::{
    absolute::{self, Seen},
    adjust::{AdjustOptions, Bundle, Sight},
    lens::Lens,
    pose::{Pose, angle_deg},
    rng::Rng,
    survey::{Link, Survey},
    tracks::Sighting,
};

/// Points that a photo must agree with to be placed, and their share of those that it might see.
const PLACED_MIN: f64 = 12.0;
const PLACED_SHARE: f64 = 0.3;
/// The share where the strongest link to a placed photo says the same turn, within
/// [`TURN_MAX_DEG`].
const CONFIRMED_SHARE: f64 = 0.1;
const TURN_MAX_DEG: f64 = 10.0;
/// Links that place a photo by themselves: their share of matches, their matches; and the points
/// that must agree on the distance.
const SURE_SHARE: f64 = 0.5;
const SURE_INLIERS: usize = 60;
const BY_LINK_MIN: usize = 5;
/// Angle between two rays to a point, degrees, under which its depth is not known.
const ANGLE_MIN_DEG: f64 = 0.5;
/// Points of a photo that count where it is adjusted: those that most photos see.
const KEPT: usize = 200;
/// Cameras from which on the focal length and the radial term move.
const FREE_FOCAL: usize = 3;
const FREE_K1: usize = 4;

/// Cameras and points.
#[derive(Clone, Debug)]
pub(crate) struct Grown {
    pub(crate) poses: Vec<Option<Pose>>,
    pub(crate) lenses: Vec<Lens>,
    /// A place for each track, where it is known.
    pub(crate) points: Vec<Option<Vector3<f64>>>,
    /// Whether each sighting of each track agrees with its point.
    pub(crate) agrees: Vec<Vec<bool>>,
}

impl Grown {
    /// The points of tracks, each with the sightings that agree with it.
    pub(crate) fn seen<'a>(
        &'a self,
        tracks: &'a [Vec<Sighting>],
    ) -> impl Iterator<Item = (&'a Vector3<f64>, impl Iterator<Item = Sighting> + Clone)> {
        tracks.iter().zip(&self.agrees).zip(&self.points).filter_map(|((track, agrees), point)| {
            let near = track.iter().zip(agrees).filter(|(_, agrees)| **agrees);
            Some((point.as_ref()?, near.map(|(sighting, _)| *sighting)))
        })
    }
}

/// The growing state and what it grows on.
pub(crate) struct Grower<'a> {
    pub(crate) survey: &'a Survey,
    pub(crate) tracks: &'a [Vec<Sighting>],
    pub(crate) links: &'a [Link],
    pub(crate) cancel: &'a AtomicBool,
    pub(crate) state: Grown,
}

impl<'a> Grower<'a> {
    pub(crate) fn new(
        survey: &'a Survey,
        tracks: &'a [Vec<Sighting>],
        links: &'a [Link],
        lenses: &[Lens],
        cancel: &'a AtomicBool,
    ) -> Self {
        let state = Grown {
            poses: vec![None; survey.views.len()],
            lenses: lenses.to_vec(),
            points: vec![None; tracks.len()],
            agrees: tracks.iter().map(|track| vec![false; track.len()]).collect(),
        };
        Self { survey, tracks, links, cancel, state }
    }

    /// Grows from two photos and the pose of the second from the first.
    pub(crate) fn grow(&mut self, photos: [usize; 2], pose: Pose, seed: u64) {
        self.state.poses[photos[0]] = Some(Pose::identity());
        self.state.poses[photos[1]] = Some(pose);
        self.triangulate();
        self.adjust(6);
        self.filter();
        self.place_all(seed);
    }

    /// Places photos until none fits, then adjusts everything.
    pub(crate) fn place_all(&mut self, seed: u64) {
        let mut adjusted = self.placed();
        while !self.cancel.load(Ordering::Relaxed)
            && let Some((photo, pose)) = self.next_photo(seed).or_else(|| self.next_by_link())
        {
            self.state.poses[photo] = Some(pose);
            self.triangulate();
            // Among many photos one more changes little.
            if self.placed() > adjusted + adjusted / 16 {
                self.adjust(4);
                self.filter();
                adjusted = self.placed();
            }
        }
        self.settle();
    }

    /// Adjusts everything to the end and takes out what does not fit.
    pub(crate) fn settle(&mut self) {
        self.filter();
        for _ in 0..2 {
            self.triangulate();
            self.adjust(12);
            self.filter();
        }
        self.drop_loose();
    }

    pub(crate) fn placed(&self) -> usize {
        self.state.poses.iter().flatten().count()
    }

    fn pixel(&self, (photo, keypoint): Sighting) -> Vector2<f64> {
        self.survey.views[photo as usize].pixels[keypoint as usize]
    }

    fn lens(&self, photo: u32) -> Lens {
        self.state.lenses[self.survey.views[photo as usize].lens]
    }

    /// Squared distance of a sighting to a point, in units of the photo's agreement distance.
    fn error2(&self, sighting: Sighting, point: &Vector3<f64>) -> f64 {
        let photo = sighting.0 as usize;
        let Some(pose) = &self.state.poses[photo] else { return f64::INFINITY };
        let Some(pixel) = self.lens(sighting.0).project(&pose.seen(point)) else {
            return f64::INFINITY;
        };
        let agree = self.survey.views[photo].agree_px;
        (pixel - self.pixel(sighting)).norm_squared() / (agree * agree)
    }

    /// Sightings, of those that agreed before, that still do.
    pub(crate) fn agreeing(&self) -> usize {
        let seen = self.state.seen(self.tracks);
        seen.map(|(point, near)| near.filter(|s| self.error2(*s, point) < 1.0).count()).sum()
    }

    /// Known points that each unplaced photo may see.
    fn seen(&self) -> Vec<Vec<Seen>> {
        let mut seen: Vec<Vec<Seen>> = vec![Vec::new(); self.state.poses.len()];
        for (track, point) in self.tracks.iter().zip(&self.state.points) {
            let Some(point) = point else { continue };
            for sighting in track {
                let photo = sighting.0 as usize;
                if self.state.poses[photo].is_none() {
                    seen[photo].push(Seen { point: *point, pixel: self.pixel(*sighting) });
                }
            }
        }
        seen
    }

    /// How many known points a photo may see, those near each other counted less.
    fn coverage(&self, photo: usize, seen: &[Seen]) -> usize {
        let side = self.survey.views[photo].side;
        let mut covered = 0;
        for level in 1..=4_u32 {
            let cells = 1_usize << level;
            let mut hit = vec![false; cells * cells];
            for s in seen {
                let cell =
                    |v: f64| (((v / side + 0.5) * cells as f64).max(0.0) as usize).min(cells - 1);
                hit[cell(s.pixel.y) * cells + cell(s.pixel.x)] = true;
            }
            covered += hit.iter().filter(|h| **h).count() << level;
        }
        covered
    }

    /// The photo that sees the known points best, and its pose.
    fn next_photo(&self, seed: u64) -> Option<(usize, Pose)> {
        let mut waiting: Vec<(usize, usize, Vec<Seen>)> = self
            .seen()
            .into_iter()
            .enumerate()
            .filter(|(_, seen)| seen.len() as f64 >= PLACED_MIN)
            .map(|(photo, seen)| (self.coverage(photo, &seen), photo, seen))
            .collect();
        waiting.sort_by(|a, b| b.0.cmp(&a.0).then(a.1.cmp(&b.1)));
        for (_, photo, seen) in waiting {
            let lens = self.lens(photo as u32);
            let threshold = 1.5 * self.survey.views[photo].agree_px;
            let mut rng = Rng::new(seed, photo as u64 + 1000 * self.placed() as u64);
            let Some((pose, score)) = absolute::find(&seen, &lens, threshold, &mut rng) else {
                continue;
            };
            let confirmed = self.confirmed(photo, &pose);
            let share = match confirmed {
                Some(true) => CONFIRMED_SHARE,
                None => PLACED_SHARE,
                Some(false) => continue,
            };
            if score >= PLACED_MIN.max(share * seen.len() as f64) {
                return Some((photo, pose));
            }
        }
        None
    }

    /// Gives tracks without a point one, and sightings that now fit a point to it.
    pub(crate) fn triangulate(&mut self) {
        for index in 0..self.tracks.len() {
            let track = &self.tracks[index];
            if let Some(point) = self.state.points[index] {
                for (k, sighting) in track.iter().enumerate() {
                    self.state.agrees[index][k] = self.error2(*sighting, &point) < 1.0;
                }
                continue;
            }
            if let Some((point, agrees)) = self.point_of(track) {
                self.state.points[index] = Some(point);
                self.state.agrees[index] = agrees;
            }
        }
    }

    /// The point that most sightings of a track agree with.
    fn point_of(&self, track: &[Sighting]) -> Option<(Vector3<f64>, Vec<bool>)> {
        let placed: Vec<(Vector3<f64>, Vector3<f64>)> = track
            .iter()
            .filter_map(|s| {
                let pose = self.state.poses[s.0 as usize].as_ref()?;
                let ray = self.lens(s.0).direction(&self.pixel(*s)).push(1.0);
                Some((pose.center(), (pose.r.transpose() * ray).normalize()))
            })
            .take(8)
            .collect();
        let mut best: Option<(usize, f64, Vector3<f64>)> = None;
        for i in 0..placed.len() {
            for j in i + 1..placed.len() {
                let (angle, rays) =
                    (angle_between(&placed[i].1, &placed[j].1), [placed[i], placed[j]]);
                if angle < ANGLE_MIN_DEG {
                    continue;
                }
                let Some(point) = nearest_to(&rays) else { continue };
                let errors = track.iter().map(|s| self.error2(*s, &point));
                let near = errors.clone().filter(|e| *e < 1.0).count();
                let sum: f64 = errors.filter(|e| *e < 1.0).sum();
                if near >= 2 && best.is_none_or(|b| near > b.0 || (near == b.0 && sum < b.1)) {
                    best = Some((near, sum, point));
                }
            }
        }
        let (_, _, point) = best?;
        let agrees = track.iter().map(|s| self.error2(*s, &point) < 1.0).collect();
        Some((point, agrees))
    }

    /// The photo with the strongest link to a placed one, where too few points for three at a time
    /// are known: turn and direction by the link, the distance by the points.
    fn next_by_link(&self) -> Option<(usize, Pose)> {
        let ends = |link: &'a Link| {
            let [a, b] = link.photos;
            match (&self.state.poses[a], &self.state.poses[b]) {
                (Some(from), None) => Some((link, b, from, link.geometry.pose)),
                (None, Some(from)) => Some((link, a, from, link.geometry.pose.inverse())),
                _ => None,
            }
        };
        let sure = |link: &&Link| {
            link.share >= SURE_SHARE
                && link.geometry.inliers.len() >= SURE_INLIERS
                && link.geometry.rotation_share < 0.5
        };
        let mut open: Vec<_> = self.links.iter().filter(sure).filter_map(ends).collect();
        open.sort_by(|a, b| b.0.strength().total_cmp(&a.0.strength()));
        let seen = if open.is_empty() { Vec::new() } else { self.seen() };
        open.into_iter().find_map(|(_, photo, from, step)| {
            Some((photo, self.at_distance(photo, &seen[photo], from, &step)?))
        })
    }

    /// The pose `step` away from a placed one, at the distance that most known points agree with.
    fn at_distance(&self, photo: usize, seen: &[Seen], from: &Pose, step: &Pose) -> Option<Pose> {
        let lens = self.lens(photo as u32);
        let at =
            |distance: f64| Pose { r: step.r * from.r, t: step.r * from.t + step.t * distance };
        let turned = at(0.0);
        let threshold = 1.5 * self.survey.views[photo].agree_px;
        let agree = |pose: &Pose| {
            let near = |s: &&Seen| {
                let pixel = lens.project(&pose.seen(&s.point));
                pixel.is_some_and(|p| (p - s.pixel).norm() < threshold)
            };
            seen.iter().filter(near).count()
        };
        let by_point = |s: &Seen| {
            let ray = lens.direction(&s.pixel).push(1.0).normalize();
            let (still, moving) = (ray.cross(&turned.seen(&s.point)), ray.cross(&step.t));
            -still.dot(&moving) / moving.norm_squared().max(1e-12)
        };
        let (count, pose) = seen
            .iter()
            .map(by_point)
            .filter(|distance| *distance > 0.0)
            .map(|distance| (agree(&at(distance)), at(distance)))
            .max_by_key(|(count, _)| *count)?;
        (count >= BY_LINK_MIN && 4 * count >= seen.len()).then_some(pose)
    }

    /// Whether the strongest links to placed photos say the same turn; `None` where there is none.
    fn confirmed(&self, photo: usize, pose: &Pose) -> Option<bool> {
        let turned = |link: &&Link| {
            let [a, b] = link.photos;
            let other = if a == photo { b } else { a };
            let placed = self.state.poses[other].as_ref()?;
            let (first, second) = if a == photo { (pose, placed) } else { (placed, pose) };
            let off = link.geometry.pose.r.transpose() * second.r * first.r.transpose();
            Some((link.strength(), angle_deg(&off)))
        };
        let own = self.links.iter().filter(|link| link.photos.contains(&photo));
        let mut turns: Vec<(f64, f64)> = own.filter_map(|link| turned(&link)).collect();
        turns.sort_by(|a, b| b.0.total_cmp(&a.0));
        let strongest = turns.first()?.0;
        // One of those that are nearly as strong is enough: a plane has two turns that fit.
        Some(turns.iter().any(|(strength, off)| *strength > 0.3 * strongest && *off < TURN_MAX_DEG))
    }

    pub(crate) fn options(&self, steps: usize) -> AdjustOptions {
        let placed = self.placed();
        let scale_px = self.survey.views.iter().map(|v| v.agree_px).fold(0.0, f64::max) * 0.5;
        AdjustOptions {
            steps,
            free_focal: placed >= FREE_FOCAL,
            free_k1: placed >= FREE_K1,
            scale_px,
        }
    }

    /// In how many photos a point of each photo must be seen so that [`KEPT`] of them count.
    fn lengths(&self) -> Vec<usize> {
        let mut of = vec![Vec::new(); self.state.poses.len()];
        for (track, agrees) in self.tracks.iter().zip(&self.state.agrees) {
            let length = agrees.iter().filter(|agrees| **agrees).count();
            for (sighting, _) in track.iter().zip(agrees).filter(|(_, agrees)| **agrees) {
                of[sighting.0 as usize].push(length);
            }
        }
        let least = |mut lengths: Vec<usize>| {
            lengths.sort_unstable_by(|a, b| b.cmp(a));
            lengths.get(KEPT).copied().unwrap_or(2)
        };
        of.into_iter().map(least).collect()
    }

    /// The state as a bundle, and the track of each of its points. Of each photo only the points
    /// that most others see count: those that few see carry the drift of keypoints.
    pub(crate) fn bundle(&self) -> (Bundle, Vec<usize>) {
        let mut tracks = Vec::new();
        let mut points = Vec::new();
        let mut sights = Vec::new();
        let lengths = self.lengths();
        for (index, point) in self.state.points.iter().enumerate() {
            let Some(point) = point else { continue };
            let of_track = self.tracks[index].iter().zip(&self.state.agrees[index]);
            let own: Vec<Sight> = of_track
                .filter(|(_, agrees)| **agrees)
                .map(|(s, _)| Sight { camera: s.0 as usize, pixel: self.pixel(*s) })
                .collect();
            if own.len() >= 2 && own.iter().any(|sight| own.len() >= lengths[sight.camera]) {
                tracks.push(index);
                points.push(*point);
                sights.push(own);
            }
        }
        let poses = self.state.poses.iter().map(|p| p.unwrap_or_else(Pose::identity)).collect();
        let bundle = Bundle {
            poses,
            lens_of: self.survey.views.iter().map(|v| v.lens).collect(),
            lenses: self.state.lenses.clone(),
            priors: self.survey.priors.clone(),
            points,
            sights,
        };
        (bundle, tracks)
    }

    /// Adjusts everything that is placed. Returns the cost.
    pub(crate) fn adjust(&mut self, steps: usize) -> f64 {
        let Some(fixed) = self.state.poses.iter().position(Option::is_some) else { return 0.0 };
        let (mut bundle, tracks) = self.bundle();
        let cost = bundle.adjust(fixed, &self.options(steps));
        for (pose, moved) in self.state.poses.iter_mut().zip(bundle.poses) {
            if let Some(pose) = pose {
                *pose = moved;
            }
        }
        self.state.lenses = bundle.lenses;
        let mut moved = vec![false; self.tracks.len()];
        for (track, point) in tracks.into_iter().zip(bundle.points) {
            (self.state.points[track], moved[track]) = (Some(point), true);
        }
        // The others go where the cameras say now.
        for (track, moved) in moved.into_iter().enumerate() {
            if !moved && self.state.points[track].is_some() {
                let found = self.point_of(&self.tracks[track]);
                let none = || vec![false; self.tracks[track].len()];
                let (point, agrees) = found.map_or((None, none()), |(p, a)| (Some(p), a));
                (self.state.points[track], self.state.agrees[track]) = (point, agrees);
            }
        }
        cost
    }

    /// Takes out sightings that do not fit and points that too few or too parallel rays see.
    pub(crate) fn filter(&mut self) {
        for index in 0..self.tracks.len() {
            let Some(point) = self.state.points[index] else { continue };
            let mut rays: Vec<Vector3<f64>> = Vec::new();
            for (k, sighting) in self.tracks[index].iter().enumerate() {
                let agrees = self.error2(*sighting, &point) < 1.0;
                self.state.agrees[index][k] = agrees;
                if let (true, Some(pose)) = (agrees, &self.state.poses[sighting.0 as usize]) {
                    rays.push((point - pose.center()).normalize());
                }
            }
            let wide = rays
                .iter()
                .enumerate()
                .any(|(i, a)| rays[i + 1..].iter().any(|b| angle_between(a, b) >= ANGLE_MIN_DEG));
            if !wide {
                self.state.points[index] = None;
                self.state.agrees[index].fill(false);
            }
        }
    }

    /// Takes out photos that too few points hold.
    fn drop_loose(&mut self) {
        loop {
            let mut held = vec![0; self.state.poses.len()];
            for (track, agrees) in self.tracks.iter().zip(&self.state.agrees) {
                for (sighting, _) in track.iter().zip(agrees).filter(|(_, agrees)| **agrees) {
                    held[sighting.0 as usize] += 1;
                }
            }
            let loose: Vec<usize> = (0..held.len())
                .filter(|&i| self.state.poses[i].is_some() && (held[i] as f64) < PLACED_MIN)
                .collect();
            if loose.is_empty() {
                return;
            }
            for photo in loose {
                self.state.poses[photo] = None;
            }
            self.filter();
        }
    }
}

pub(crate) fn angle_between(a: &Vector3<f64>, b: &Vector3<f64>) -> f64 {
    a.cross(b).norm().atan2(a.dot(b)).to_degrees()
}

/// The point nearest to rays (centre and unit direction).
pub(crate) fn nearest_to(rays: &[(Vector3<f64>, Vector3<f64>)]) -> Option<Vector3<f64>> {
    let mut sum = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for (center, ray) in rays {
        let across = Matrix3::identity() - ray * ray.transpose();
        sum += across;
        right += across * center;
    }
    Some(sum.try_inverse()? * right).filter(|p| p.iter().all(|v| v.is_finite()))
}
