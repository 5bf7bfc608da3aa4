//! Merged Gaussians: one that stands for up to four neighbours where a view shows them smaller
//! than a part of a pixel.
//!
//! **What it keeps.** With weights `w`, the mean and the covariance of the mixture of its members
//! (`Σ w (S + d dᵀ)`), the mean of their harmonics, and the entry with most opacity. Opacity times
//! covered area is kept in each view as that view blurs: with `b` the blur that they were learnt
//! with, and areas as roots of determinants on the picture,
//! `opacity · √det(S + b) = Σ o_i √det(S_i + b)`. Members that overlap may have more than an
//! opacity of 1 has room for: `S` is larger by that factor then. Two
//! numbers are kept for that: the opacity `o` for `b = 0`, and the sum `q` of the `o_i`
//! ([`Merged::sums`]). If members are smaller than it by one share and have its shape, that share
//! of its covariance is `o / q`, and the right side is `√(o² det S + o q b tr S + q² b²)`. Where
//! the blur makes more than 1 of it, its root is drawn: n Gaussians in one place cover
//! `1 - (1 - a)^n`, which is flat in the middle and no wider at its foot than one of them.
//!
//! Weights are `o (area + v)`: what a member adds to a picture that is blurred by the variance `v`
//! of their centres.
//!
//! **Its error** is a length. A member's is the distance of the two centres, and how much their
//! spreads differ along any axis, in standard deviations: at most `|S_i^½ - S^½|`. What the member
//! itself stands for is added to that. So no edge of the scene is drawn farther from its place than
//! by this length times the number of standard deviations. There is no bound of a pixel's colour:
//! which of two surfaces in one merged Gaussian was in front is lost.

use std::sync::Arc;

use glam::{DMat3, DQuat, DVec3};
use parking_lot::Mutex;

use crate::{
    error::{Error, Result},
    places::{Place, split},
    scene::{Gaussians, RawGaussians, SourcePixel, principal_axes},
};

/// Most Gaussians that one stands for.
pub const GROUP: usize = 4;
/// Largest [`crate::RenderRequest::detail`], pixels.
pub const DETAIL_MAX: f32 = 16.0;
/// A group whose error is so many times that of the median of its block is halved.
const ERROR_OVER_MEDIAN: f64 = 2.0;
/// Share by which errors are taken larger: over the rounding of f32.
const SLACK: f64 = 1e-4;

/// Refuses a detail out of range.
///
/// # Errors
/// `invalid_request` with the value and the bounds.
pub fn check_detail(detail: f32) -> Result<()> {
    if (0.0..=DETAIL_MAX).contains(&detail) {
        return Ok(());
    }
    Err(Error::invalid(format!("detail is {detail}; it must be 0 to {DETAIL_MAX} pixels")))
}

/// The merged Gaussians of a scene, layer after layer.
#[derive(Debug)]
pub struct Merged {
    /// `[M]`.
    pub gaussians: Gaussians,
    /// `[M]` opacities of the Gaussians of the scene that each stands for, in sum: the upper half
    /// of an f32.
    pub sums: Vec<f32>,
    /// Members of one after the other, and where those of each end.
    members: Vec<u32>,
    ends: Vec<u32>,
    /// Entries, with the [`Gaussians::identity`] that they are of.
    entries: Mutex<Option<(u64, Arc<[u16]>)>>,
}

impl Merged {
    /// The numbers of those that merged Gaussian `at` stands for, at most [`GROUP`]; merged ones
    /// count on after the scene's own. They are lower than its own.
    pub fn group(&self, at: usize) -> &[u32] {
        let first = at.checked_sub(1).map_or(0, |before| self.ends[before]);
        &self.members[first as usize..self.ends[at] as usize]
    }

    /// `[M]` entries where the scene has those of `own`: of each group the one with the most
    /// opacity, the lower one of equals.
    pub fn entries(&self, own: &Gaussians) -> Arc<[u16]> {
        let mut held = self.entries.lock();
        if let Some((_, entries)) = held.as_ref().filter(|held| held.0 == own.identity()) {
            return Arc::clone(entries);
        }
        let mut entries = Vec::with_capacity(self.sums.len());
        for at in 0..self.sums.len() {
            let of = |&id: &u32| match (id as usize).checked_sub(own.len()) {
                None => (own.semantic_index()[id as usize], own.opacities()[id as usize]),
                Some(at) => (entries[at], self.sums[at]),
            };
            let entry = heaviest(self.group(at).iter().map(of).collect());
            entries.push(entry);
        }
        let entries: Arc<[u16]> = entries.into();
        *held = Some((own.identity(), Arc::clone(&entries)));
        entries
    }
}

/// The entry with the largest sum, the lower one of equals.
pub(crate) fn heaviest(mut rows: Vec<(u16, f32)>) -> u16 {
    rows.sort_by_key(|row| row.0);
    let sums = rows.chunk_by(|a, b| a.0 == b.0);
    let sums = sums.map(|one| (one[0].0, one.iter().map(|row| row.1).sum::<f32>()));
    let best = sums.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.cmp(&a.0)));
    best.map_or(0, |(entry, _)| entry)
}

/// Merges the Gaussians of a scene, and those that it has merged.
#[derive(Debug)]
pub(crate) struct Merger<'a> {
    own: &'a Gaussians,
    all: Part,
}

impl<'a> Merger<'a> {
    pub(crate) fn new(own: &'a Gaussians) -> Self {
        Self { own, all: Part::of(own) }
    }

    /// The number that the next merged Gaussian gets.
    pub(crate) fn next_id(&self) -> u32 {
        (self.own.len() + self.all.len()) as u32
    }

    /// Adds the merged Gaussians of a block.
    pub(crate) fn take(&mut self, part: &Part) {
        let Part { raw, sums, errors, members, ends } = &mut self.all;
        raw.means.extend_from_slice(&part.raw.means);
        raw.quats.extend_from_slice(&part.raw.quats);
        raw.scales.extend_from_slice(&part.raw.scales);
        raw.opacities.extend_from_slice(&part.raw.opacities);
        raw.sh.extend_from_slice(&part.raw.sh);
        raw.semantic_index.extend_from_slice(&part.raw.semantic_index);
        raw.source.extend_from_slice(&part.raw.source);
        sums.extend_from_slice(&part.sums);
        errors.extend_from_slice(&part.errors);
        let before = members.len() as u32;
        members.extend_from_slice(&part.members);
        ends.extend(part.ends.iter().map(|end| before + end));
    }

    /// All of them.
    ///
    /// # Errors
    /// `internal` where one is no Gaussian any more.
    pub(crate) fn finish(self) -> Result<Merged> {
        let Part { raw, sums, members, ends, .. } = self.all;
        let gaussians = Gaussians::restore(raw)?;
        Ok(Merged { gaussians, sums, members, ends, entries: Mutex::default() })
    }

    /// Merges the Gaussians of a block: groups of [`GROUP`] neighbours, halved while their error is
    /// much over that of most groups. So edges and what is larger than the rest stay.
    pub(crate) fn merge(&self, ids: &[u32]) -> Part {
        let mut places: Vec<Place> =
            ids.iter().map(|&id| Place { at: *self.row(id).mean, id }).collect();
        split(&mut places, GROUP);
        let mut groups: Vec<Group> =
            places.chunks(GROUP).map(|group| self.group(group.to_vec())).collect();
        let mut errors: Vec<f64> = groups.iter().map(|group| group.merged.error).collect();
        let middle = errors.len() / 2;
        let (_, median, _) = errors.select_nth_unstable_by(middle, f64::total_cmp);
        let error_max = ERROR_OVER_MEDIAN * *median;
        let mut part = Part::of(self.own);
        while let Some(group) = groups.pop() {
            if group.merged.error <= error_max || group.places.len() == 1 {
                self.put(&group, &mut part);
                continue;
            }
            let mut places = group.places;
            let half = places.len().div_ceil(2);
            split(&mut places, half);
            let rest = places.split_off(places.len() - half);
            groups.extend([self.group(rest), self.group(places)]);
        }
        part
    }

    fn group(&self, places: Vec<Place>) -> Group {
        let member = |place: &Place| Member::from(&self.row(place.id));
        let members: Vec<Member> = places.iter().map(member).collect();
        let (merged, weights) = merge(&members);
        Group { places, merged, weights }
    }

    fn put(&self, group: &Group, to: &mut Part) {
        let Group { places, merged, weights } = group;
        let turn = DQuat::from_mat3(&merged.axes);
        let scale = |v: f64| (v as f32).clamp(Gaussians::SCALE_MIN, Gaussians::SCALE_MAX);
        let raw = &mut to.raw;
        raw.means.push(merged.mean.as_vec3().to_array());
        raw.quats.push([turn.w, turn.x, turn.y, turn.z].map(|v| v as f32));
        raw.scales.push(merged.scales.to_array().map(scale));
        raw.opacities.push((merged.opacity as f32).clamp(Gaussians::OPACITY_MIN, 1.0));
        raw.semantic_index.push(0);
        let heaviest = (0..places.len()).max_by(|&a, &b| weights[a].total_cmp(&weights[b]));
        raw.source.push(self.row(places[heaviest.unwrap_or(0)].id).source);
        for at in 0..self.own.sh_count() {
            let mut mean = DVec3::ZERO;
            for (place, &weight) in places.iter().zip(weights) {
                mean += weight * DVec3::from(self.row(place.id).sh[at].map(f64::from));
            }
            raw.sh.push(mean.as_vec3().to_array());
        }
        to.sums.push(upper_half(merged.sum as f32));
        to.errors.push((merged.error * (1.0 + SLACK)) as f32);
        to.members.extend(places.iter().map(|place| place.id));
        to.ends.push(to.members.len() as u32);
    }

    /// A Gaussian of the scene, or a merged one.
    fn row(&self, id: u32) -> Row<'_> {
        let (own, all, k) = (self.own, &self.all, self.own.sh_count());
        match (id as usize).checked_sub(own.len()) {
            None => {
                let i = id as usize;
                Row {
                    mean: &own.means()[i],
                    quat: &own.quats()[i],
                    scale: &own.scales()[i],
                    opacity: own.opacities()[i],
                    sh: &own.sh()[i * k..(i + 1) * k],
                    source: own.source()[i],
                    sum: own.opacities()[i],
                    error: 0.0,
                }
            }
            Some(i) => Row {
                mean: &all.raw.means[i],
                quat: &all.raw.quats[i],
                scale: &all.raw.scales[i],
                opacity: all.raw.opacities[i],
                sh: &all.raw.sh[i * k..(i + 1) * k],
                source: all.raw.source[i],
                sum: all.sums[i],
                error: all.errors[i],
            },
        }
    }
}

/// A Gaussian as it is stored.
struct Row<'a> {
    mean: &'a [f32; 3],
    quat: &'a [f32; 4],
    scale: &'a [f32; 3],
    opacity: f32,
    sh: &'a [[f32; 3]],
    source: SourcePixel,
    sum: f32,
    error: f32,
}

/// Gaussians that are merged, the one that stands for them, and their weights.
struct Group {
    places: Vec<Place>,
    merged: Member,
    weights: Vec<f64>,
}

/// Some merged Gaussians.
#[derive(Debug)]
pub(crate) struct Part {
    raw: RawGaussians,
    sums: Vec<f32>,
    errors: Vec<f32>,
    members: Vec<u32>,
    ends: Vec<u32>,
}

impl Part {
    /// Without Gaussians, for some of `gaussians`.
    fn of(gaussians: &Gaussians) -> Self {
        let (origin, sh_degree) = (gaussians.origin(), gaussians.sh_degree());
        let raw = RawGaussians { origin, sh_degree, ..RawGaussians::default() };
        let [members, ends] = [const { Vec::new() }; 2];
        Self { raw, sums: Vec::new(), errors: Vec::new(), members, ends }
    }

    /// Number of them.
    pub(crate) fn len(&self) -> usize {
        self.sums.len()
    }

    /// The largest scale.
    pub(crate) fn reach(&self) -> f32 {
        self.raw.scales.iter().flatten().copied().fold(0.0, f32::max)
    }

    /// The largest error.
    pub(crate) fn error(&self) -> f32 {
        self.errors.iter().copied().fold(0.0, f32::max)
    }
}

/// The nearest number that has zeros in the lower half of its bits.
fn upper_half(number: f32) -> f32 {
    f32::from_bits(number.to_bits().saturating_add(1 << 15) & !0xffff)
}

impl From<&Row<'_>> for Member {
    fn from(row: &Row<'_>) -> Self {
        let [w, x, y, z] = row.quat.map(f64::from);
        Self {
            mean: DVec3::from(row.mean.map(f64::from)),
            axes: DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize()),
            scales: DVec3::from(row.scale.map(f64::from)),
            opacity: f64::from(row.opacity),
            sum: f64::from(row.sum),
            error: f64::from(row.error),
        }
    }
}

/// A Gaussian in f64.
#[derive(Clone, Copy, Debug)]
struct Member {
    mean: DVec3,
    /// Its axes are the columns.
    axes: DMat3,
    scales: DVec3,
    opacity: f64,
    sum: f64,
    error: f64,
}

impl Member {
    /// The root of its covariance.
    fn root(&self) -> DMat3 {
        self.axes * DMat3::from_diagonal(self.scales) * self.axes.transpose()
    }

    /// Products of two scales, for each axis those of the other two.
    fn faces(&self) -> DVec3 {
        let DVec3 { x, y, z } = self.scales;
        DVec3::new(y * z, z * x, x * y)
    }

    /// Root of the determinant of its covariance on a plane across `along`, which has length 1.
    fn area(&self, along: DVec3) -> f64 {
        (self.faces() * (self.axes.transpose() * along)).length()
    }

    /// Of its squared areas from all sides the root of the mean.
    fn mean_area(&self) -> f64 {
        (self.faces().length_squared() / 3.0).sqrt()
    }

    /// How far the one that stands for it is from it.
    fn apart(&self, other: &Self) -> f64 {
        let roots = self.root() - other.root();
        let squares = roots.to_cols_array().iter().map(|v| v * v).sum::<f64>();
        self.mean.distance(other.mean) + squares.sqrt() + self.error
    }
}

/// The Gaussian that stands for `members`, and their weights, whose sum is 1.
fn merge(members: &[Member]) -> (Member, Vec<f64>) {
    let count = members.len() as f64;
    let middle = members.iter().map(|one| one.mean).sum::<DVec3>() / count;
    let squares = members.iter().map(|one| one.mean.distance_squared(middle)).sum::<f64>();
    let between = squares / (3.0 * count);
    let weight = |one: &Member| one.opacity * one.mean_area() + one.sum * between;
    let mut weights: Vec<f64> = members.iter().map(weight).collect();
    let whole = weights.iter().sum::<f64>().max(f64::MIN_POSITIVE);
    weights.iter_mut().for_each(|weight| *weight /= whole);
    let weighted = || members.iter().zip(&weights);
    let mean =
        weighted().map(|(one, &weight)| weight * (one.mean - middle)).sum::<DVec3>() + middle;
    let covariance = weighted().fold(DMat3::ZERO, |sum, (one, &weight)| {
        let (root, from) = (one.root(), one.mean - mean);
        let outer = DMat3::from_cols(from * from.x, from * from.y, from * from.z);
        sum + (root * root + outer) * weight
    });
    let [x, y, z] = principal_axes(covariance);
    // A rotation: the third axis is that of a right hand.
    let z = z * x.cross(y).dot(z).signum();
    let along = |axis: DVec3| axis.dot(covariance * axis).max(0.0).sqrt();
    let least = f64::from(Gaussians::SCALE_MIN);
    let scales = DVec3::new(along(x), along(y), along(z)).max(DVec3::splat(least));
    let sum = members.iter().map(|one| one.sum).sum();
    let mut merged =
        Member { mean, axes: DMat3::from_cols(x, y, z), scales, opacity: 0.0, sum, error: 0.0 };
    // Areas are compared as seen along its thinnest axis: a surface from in front of it.
    let thinnest = match scales.min_position() {
        0 => x,
        1 => y,
        _ => z,
    };
    let covered = members.iter().map(|one| one.opacity * one.area(thinnest)).sum::<f64>();
    let opacity = covered / merged.area(thinnest);
    merged.opacity = opacity.min(1.0);
    merged.scales *= opacity.max(1.0).sqrt();
    merged.error = members.iter().map(|one| one.apart(&merged)).fold(0.0, f64::max);
    (merged, weights)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_error_is_that_of_the_members_and_what_merging_adds() {
        let sphere = |x: f64, error: f64| Member {
            mean: DVec3::X * x,
            axes: DMat3::IDENTITY,
            scales: DVec3::splat(0.5),
            opacity: 0.1,
            sum: 0.1,
            error,
        };
        let of = |a: f64, b: f64| merge(&[sphere(-1.0, a), sphere(1.0, b)]).0.error;
        // The centres move by 1, and the spread along x becomes the root of 0.5² + 1.
        let step = 1.0 + 1.25_f64.sqrt() - 0.5;
        assert!((of(0.0, 0.0) - step).abs() < 1e-12, "{} not {step}", of(0.0, 0.0));
        assert!((of(0.25, 3.0) - step - 3.0).abs() < 1e-12, "{} not {step} + 3", of(0.25, 3.0));
    }

    #[test]
    fn errors_add_up_from_layer_to_layer() {
        let mut raw = RawGaussians::default();
        for i in 0..1_000_u32 {
            let place = |k: u32| (i.wrapping_mul(2_654_435_761).rotate_left(9 * k) % 97) as f32;
            raw.means.push([place(0), place(1), place(2)]);
            raw.quats.push([1.0, 0.0, 0.0, 0.0]);
            raw.scales.push([0.5; 3]);
            raw.opacities.push(0.1);
            raw.sh.push([0.5; 3]);
            raw.semantic_index.push(0);
            raw.source.push(SourcePixel::default());
        }
        let own = Gaussians::restore(raw).expect("Gaussians");
        let mut merger = Merger::new(&own);
        let mut ids: Vec<u32> = (0..own.len() as u32).collect();
        for layer in 0..4 {
            let part = merger.merge(&ids);
            let mut first = 0;
            for (at, &end) in part.ends.iter().enumerate() {
                for &id in &part.members[first..end as usize] {
                    let of_member = match (id as usize).checked_sub(own.len()) {
                        None => 0.0,
                        Some(at) => merger.all.errors[at],
                    };
                    let [a, b] = [*merger.row(id).mean, part.raw.means[at]]
                        .map(|mean| DVec3::from(mean.map(f64::from)));
                    let least = f64::from(of_member) + a.distance(b);
                    let error = f64::from(part.errors[at]);
                    assert!(error >= least, "layer {layer}, {at}: {error} under {least}");
                }
                first = end as usize;
            }
            let next = merger.next_id();
            merger.take(&part);
            ids = (next..merger.next_id()).collect();
        }
        assert!(ids.len() < 200, "four layers: {}", ids.len());
    }
}
