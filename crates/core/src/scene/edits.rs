//! Edits of a scene: delete, keep, move, copy and recolour some of its Gaussians.
//!
//! An [`Edit`] says what it takes by the entries of the bank and by places in the world, so a list
//! of edits fits every version of a scene. Only where a network found a text in the photos it is
//! numbers of Gaussians, which fit one version. Edits are applied one after the other: each takes
//! what those before it left, and entries and numbers move and are copied with their Gaussians.

use glam::{DMat3, DQuat, DVec3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use crate::{
    error::{Error, Result},
    scene::{Gaussians, RawGaussians, SH_C0, SceneCamera, ShRotation, floaters},
};

/// A part of space, world frame.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Place {
    /// A box of any rotation.
    Box {
        /// Middle, world units.
        center: [f64; 3],
        /// Full lengths along the axes, world units.
        size: [f64; 3],
        /// Unit axes, one a row.
        axes: [[f64; 3]; 3],
    },
    /// A ball.
    Sphere {
        /// Middle, world units.
        center: [f64; 3],
        /// Radius, world units.
        radius: f64,
    },
}

impl Place {
    /// Whether a point of the world is in it; its surface is.
    #[must_use]
    pub fn holds(&self, point: DVec3) -> bool {
        match *self {
            Self::Box { center, size, axes } => {
                let offset = point - DVec3::from(center);
                let mut sides = axes.iter().zip(size);
                sides.all(|(axis, size)| DVec3::from(*axis).dot(offset).abs() <= 0.5 * size)
            }
            Self::Sphere { center, radius } => point.distance(DVec3::from(center)) <= radius,
        }
    }
}

/// Which Gaussians an edit takes: those that fit all fields.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Selected {
    /// Entries of the bank, ascending; `None`: all Gaussians, with or without an entry.
    pub entries: Option<Vec<u16>>,
    /// Numbers that Gaussians have before all edits, runs `[first, count]`, ascending; `None`: all.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub numbers: Option<Vec<[u32; 2]>>,
    /// Places of their centres, one of which is enough; empty: everywhere.
    pub within: Vec<Place>,
    /// Whether those alone that no photo confirms, before all edits: [`floaters`].
    #[serde(default, skip_serializing_if = "std::ops::Not::not")]
    pub floaters: bool,
}

impl Selected {
    fn takes(&self, point: DVec3, entry: u16, number: u32) -> bool {
        let by_entry = self.entries.as_ref().is_none_or(|all| all.binary_search(&entry).is_ok());
        let by_number = self.numbers.as_ref().is_none_or(|runs| {
            let after = runs.partition_point(|[first, _]| *first <= number);
            after > 0 && number - runs[after - 1][0] < runs[after - 1][1]
        });
        by_entry
            && by_number
            && (self.within.is_empty() || self.within.iter().any(|place| place.holds(point)))
    }
}

/// A similarity: first the scale about a centre, then the rotation about it, then the translation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Placement {
    /// World units.
    pub translation: [f64; 3],
    /// Unit quaternion, wxyz.
    pub rotation: [f64; 4],
    /// Over 0.
    pub scale: f64,
    /// World units; `None`: the mean centre of what is moved.
    pub center: Option<[f64; 3]>,
}

impl Default for Placement {
    fn default() -> Self {
        Self { translation: [0.0; 3], rotation: [1.0, 0.0, 0.0, 0.0], scale: 1.0, center: None }
    }
}

/// What an edit does.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum EditAction {
    /// They go.
    Delete,
    /// All others go.
    Keep,
    /// They go to another place.
    Move(Placement),
    /// They stay, and a copy of them with their entries is at another place.
    Copy(Placement),
    /// Their colour comes closer to another one.
    Recolor {
        /// sRGB, 0..1.
        color: [f32; 3],
        /// 0 (no change) to 1 (this colour from all sides).
        amount: f32,
    },
}

/// One edit.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Edit {
    /// What it does.
    pub action: EditAction,
    /// To which Gaussians.
    pub of: Selected,
}

/// Gaussians after edits.
#[derive(Clone, Debug)]
pub struct Edited {
    /// The Gaussians with their entries.
    pub gaussians: Gaussians,
    /// Gaussians that each edit took.
    pub counts: Vec<u64>,
}

/// The Gaussians of a scene with these cameras after all edits, which may be at most `most`.
/// Gaussians that no edit took keep their numbers, bit for bit, and their order; copies come last.
///
/// # Errors
/// `limit_exceeded` where copies make too many.
pub fn edited(
    edits: &[Edit],
    gaussians: &Gaussians,
    cameras: &[SceneCamera],
    most: usize,
) -> Result<Edited> {
    let mut editing = Editing::new(gaussians, cameras, most);
    let counts = edits.iter().map(|edit| editing.apply(edit)).collect::<Result<_>>()?;
    Ok(Edited { gaussians: editing.gaussians()?, counts })
}

/// Gaussians that are being edited.
#[derive(Clone, Debug)]
pub struct Editing<'c> {
    whole: Gaussians,
    cameras: &'c [SceneCamera],
    /// Which of the whole float, once an edit asked for them.
    floaters: Option<Vec<bool>>,
    raw: RawGaussians,
    /// `[N]` number that each, or what it is a copy of, had before all edits.
    numbers: Vec<u32>,
    /// `[N]` whether each is still there.
    there: Vec<bool>,
    /// Whether any number of any Gaussian is another one.
    changed: bool,
    most: usize,
}

impl<'c> Editing<'c> {
    /// Begins with the Gaussians of a scene with these cameras; `most` bounds how many copies make
    /// of them.
    #[must_use]
    pub fn new(gaussians: &Gaussians, cameras: &'c [SceneCamera], most: usize) -> Self {
        let raw = gaussians.clone().into_raw();
        let there = vec![true; raw.means.len()];
        let numbers = (0..).take(raw.means.len()).collect();
        let (whole, floaters) = (gaussians.clone(), None);
        Self { whole, cameras, floaters, raw, numbers, there, changed: false, most }
    }

    /// Applies an edit; gives how many Gaussians it took.
    ///
    /// # Errors
    /// `limit_exceeded` where a copy makes too many.
    pub fn apply(&mut self, edit: &Edit) -> Result<u64> {
        let taken = self.taken(&edit.of);
        let count = taken.iter().filter(|taken| **taken).count();
        match edit.action {
            EditAction::Delete => self.drop_where(|i| taken[i]),
            EditAction::Keep => self.drop_where(|i| !taken[i]),
            EditAction::Move(placement) => {
                let numbers = (0..taken.len()).filter(|i| taken[*i]).collect::<Vec<_>>();
                self.place(&numbers, &placement);
            }
            EditAction::Copy(placement) => {
                let after = self.len() + count;
                if after > self.most {
                    let what = format!("a copy of {count} Gaussians makes {after} of the scene");
                    return Err(Error::limit("edits", what, self.most));
                }
                let numbers = self.numbers.iter().zip(&taken).filter(|(_, taken)| **taken);
                let numbers: Vec<u32> = numbers.map(|(number, _)| *number).collect();
                self.numbers.extend(numbers);
                let copies = self.raw.only(|i| taken[i]);
                let first = self.raw.means.len();
                self.raw.append(copies);
                self.there.resize(self.raw.means.len(), true);
                self.place(&(first..self.raw.means.len()).collect::<Vec<_>>(), &placement);
            }
            EditAction::Recolor { color, amount } => self.recolor(&taken, color, amount),
        }
        Ok(count as u64)
    }

    /// Gaussians that are there now.
    #[must_use]
    pub fn len(&self) -> usize {
        self.there.iter().filter(|there| **there).count()
    }

    /// Whether none is there.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// The Gaussians as they are now.
    ///
    /// # Errors
    /// `internal` where an edit broke what [`Gaussians`] promise.
    pub fn gaussians(&self) -> Result<Gaussians> {
        if !self.changed {
            // Clones of the whole: a renderer that has them has nothing to upload.
            let all = self.there.iter().all(|there| *there);
            return Ok(if all { self.whole.clone() } else { self.whole.only(|i| self.there[i]) });
        }
        Gaussians::restore(self.raw.only(|i| self.there[i]))
            .map_err(|e| Error::internal("the edits give bad Gaussians").caused_by(e))
    }

    /// The number that each Gaussian which is there now had before all edits.
    #[must_use]
    pub fn numbers(&self) -> Vec<u32> {
        let there = self.numbers.iter().zip(&self.there).filter(|(_, there)| **there);
        there.map(|(number, _)| *number).collect()
    }

    fn taken(&mut self, of: &Selected) -> Vec<bool> {
        if of.floaters && self.floaters.is_none() {
            self.floaters = Some(floaters(&self.whole, self.cameras));
        }
        let (raw, there) = (&self.raw, &self.there);
        let floaters = self.floaters.as_deref().filter(|_| of.floaters);
        let takes = |(i, mean): (usize, &[f32; 3])| {
            let point = world(raw.origin, *mean);
            let number = self.numbers[i];
            there[i]
                && floaters.is_none_or(|floats| floats[number as usize])
                && of.takes(point, raw.semantic_index[i], number)
        };
        raw.means.par_iter().enumerate().with_min_len(1 << 12).map(takes).collect()
    }

    fn drop_where(&mut self, goes: impl Fn(usize) -> bool) {
        self.there.iter_mut().enumerate().for_each(|(i, there)| *there &= !goes(i));
    }

    /// Moves Gaussians. One that would be where none can be is dropped.
    fn place(&mut self, numbers: &[usize], placement: &Placement) {
        if numbers.is_empty() {
            return;
        }
        self.changed = true;
        let raw = &mut self.raw;
        let mean = |sum: DVec3| sum / numbers.len() as f64;
        let own = || mean(numbers.iter().map(|&i| world(raw.origin, raw.means[i])).sum());
        let center = placement.center.map_or_else(own, DVec3::from);
        let [w, x, y, z] = placement.rotation;
        let turn = DQuat::from_xyzw(x, y, z, w).normalize();
        let sh = ShRotation::new(DMat3::from_quat(turn), raw.sh_degree);
        let k = raw.sh_count();
        let translation = DVec3::from(placement.translation);
        for &i in numbers {
            let offset = world(raw.origin, raw.means[i]) - center;
            let at = center + translation + turn * (placement.scale * offset) - raw.origin;
            let [w, x, y, z] = raw.quats[i].map(f64::from);
            let turned = (turn * DQuat::from_xyzw(x, y, z, w)).normalize();
            raw.means[i] = at.as_vec3().to_array();
            raw.quats[i] = [turned.w, turned.x, turned.y, turned.z].map(|v| v as f32);
            raw.scales[i] = raw.scales[i].map(|scale| {
                let scale = (f64::from(scale) * placement.scale) as f32;
                scale.clamp(Gaussians::SCALE_MIN, Gaussians::SCALE_MAX)
            });
            sh.apply(&mut raw.sh[i * k..(i + 1) * k]);
            let inside = |v: &f32| v.abs() <= Gaussians::COORDINATE_MAX;
            self.there[i] &= raw.means[i].iter().all(inside);
        }
    }

    fn recolor(&mut self, taken: &[bool], color: [f32; 3], amount: f32) {
        self.changed |= taken.contains(&true);
        let (k, left) = (self.raw.sh_count(), 1.0 - amount);
        let towards = color.map(|channel| amount * (channel - 0.5) / SH_C0);
        for (sh, _) in self.raw.sh.chunks_exact_mut(k).zip(taken).filter(|(_, taken)| **taken) {
            sh.iter_mut().flatten().for_each(|coefficient| *coefficient *= left);
            sh[0].iter_mut().zip(towards).for_each(|(channel, towards)| *channel += towards);
        }
    }
}

fn world(origin: DVec3, mean: [f32; 3]) -> DVec3 {
    DVec3::from(mean.map(f64::from)) + origin
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::{SourcePixel, covariance, sh_basis};

    /// So many Gaussians along x, of alternating entries 1 and 2, with all coefficients.
    fn row(count: usize) -> Gaussians {
        let number = |i: usize, k: usize| ((i * 31 + k * 17) % 23) as f32 / 23.0;
        let raw = RawGaussians {
            origin: DVec3::new(10.0, -3.0, 0.5),
            means: (0..count).map(|i| [i as f32, 0.25, -0.5]).collect(),
            quats: (0..count).map(|i| [1.0, number(i, 1), -0.3, number(i, 2)]).collect(),
            scales: (0..count).map(|i| [0.1, 0.2 + number(i, 3), 0.4]).collect(),
            opacities: vec![0.8; count],
            sh_degree: 3,
            sh: (0..16 * count).map(|i| [0, 1, 2].map(|c| number(i, c) - 0.4)).collect(),
            semantic_index: (0..count).map(|i| 1 + (i % 2) as u16).collect(),
            source: vec![SourcePixel::default(); count],
        };
        Gaussians::sanitize(raw).unwrap().0
    }

    fn of_entry(entry: u16) -> Selected {
        Selected { entries: Some(vec![entry]), ..Selected::default() }
    }

    fn within(place: Place) -> Selected {
        Selected { within: vec![place], ..Selected::default() }
    }

    fn one(action: EditAction, of: Selected, gaussians: &Gaussians) -> Edited {
        edited(&[Edit { action, of }], gaussians, &[], 1000).unwrap()
    }

    #[test]
    fn what_is_deleted_goes_and_the_rest_keeps_every_bit() {
        let whole = row(9);
        let edited = one(EditAction::Delete, of_entry(2), &whole);
        assert_eq!(edited.counts, [4]);
        let left = whole.only(|i| i % 2 == 0);
        assert_eq!(edited.gaussians.means(), left.means());
        assert_eq!(edited.gaussians.quats(), left.quats());
        assert_eq!(edited.gaussians.sh(), left.sh());
        assert_eq!(edited.gaussians.semantic_index(), [1; 5]);
        let kept = one(EditAction::Keep, of_entry(2), &whole).gaussians;
        assert_eq!((kept.len(), kept.semantic_index()), (4, &[2; 4][..]));
        let none = one(EditAction::Delete, of_entry(7), &whole).gaussians;
        assert_eq!(none.identity(), whole.identity(), "nothing to upload again");
    }

    #[test]
    fn places_are_in_the_frame_of_the_world() {
        let whole = row(9);
        let (c, s) = (0.6, 0.8);
        let turned = Place::Box {
            center: [13.0, -2.75, 0.0],
            size: [2.4, 10.0, 1.0],
            axes: [[c, s, 0.0], [-s, c, 0.0], [0.0, 0.0, 1.0]],
        };
        // Along x it reaches 1.2 / 0.6 = 2 to each side, its surface too.
        assert_eq!(one(EditAction::Delete, within(turned), &whole).counts, [5]);
        let ball = Place::Sphere { center: [14.0, -2.75, 0.0], radius: 1.5 };
        assert_eq!(one(EditAction::Keep, within(ball), &whole).gaussians.len(), 3);
    }

    /// The covariance and the colour seen along a direction that turns with the thing, in f64.
    #[test]
    fn a_moved_gaussian_is_the_same_one_elsewhere() {
        let (whole, scale) = (row(5), 1.7);
        let turn = DQuat::from_xyzw(0.3, -0.5, 0.1, 0.8).normalize();
        let center = DVec3::new(11.0, 2.0, -1.0);
        let placement = Placement {
            translation: [0.5, -4.0, 2.0],
            rotation: [turn.w, turn.x, turn.y, turn.z],
            scale,
            center: Some(center.to_array()),
        };
        let moved = one(EditAction::Move(placement), of_entry(1), &whole).gaussians;
        let rotation = DMat3::from_quat(turn);
        for i in 0..5 {
            let is_moved = i % 2 == 0;
            let [before, after] = [&whole, &moved].map(|g| {
                let sh = g.sh()[16 * i..16 * (i + 1)].to_vec();
                (world(g.origin(), g.means()[i]), covariance(g.quats()[i], g.scales()[i]), sh)
            });
            if !is_moved {
                assert_eq!(before, after, "Gaussian {i} was not taken");
                continue;
            }
            let to = center + DVec3::new(0.5, -4.0, 2.0) + rotation * ((before.0 - center) * scale);
            assert!(to.distance(after.0) < 1e-5, "{i}: {to} is not {}", after.0);
            let wanted = rotation * before.1 * rotation.transpose() * scale.powi(2);
            let off = (wanted - after.1).to_cols_array().map(f64::abs);
            assert!(off.iter().all(|off| *off < 1e-5), "{i}: {off:?}");
            let seen = |sh: &[[f32; 3]], d: DVec3| -> f64 {
                sh_basis(d).iter().zip(sh).map(|(y, c)| y * f64::from(c[1])).sum()
            };
            for d in [DVec3::X, DVec3::new(1.0, 2.0, -0.5), DVec3::new(-0.2, 0.4, 3.0)] {
                let d = d.normalize();
                let (a, b) = (seen(&before.2, d), seen(&after.2, rotation * d));
                assert!((a - b).abs() < 1e-5, "{i}: {a} is not {b}");
            }
        }
    }

    #[test]
    fn copies_have_the_entries_of_what_they_copy_and_a_bound() {
        let whole = row(5);
        let placement = Placement { translation: [0.0, 7.0, 0.0], ..Placement::default() };
        let copy = Edit { action: EditAction::Copy(placement), of: of_entry(2) };
        let delete = Edit { action: EditAction::Delete, of: of_entry(2) };
        let copied = edited(std::slice::from_ref(&copy), &whole, &[], 7).unwrap();
        assert_eq!((copied.gaussians.len(), &*copied.counts), (7, &[2][..]));
        assert_eq!(copied.gaussians.semantic_index()[5..], [2, 2]);
        assert_eq!(copied.gaussians.means()[..5], *whole.means(), "the first ones stay");
        assert_eq!(copied.gaussians.means()[5], [1.0, 7.25, -0.5]);
        let both = edited(&[copy.clone(), delete], &whole, &[], 7).unwrap();
        assert_eq!((both.gaussians.len(), &*both.counts), (3, &[2, 4][..]), "the copy goes too");
        let refused = edited(&[copy], &whole, &[], 6).unwrap_err();
        assert!(refused.message().contains('7') && refused.message().contains('6'), "{refused}");
    }

    #[test]
    fn numbers_are_those_before_all_edits_and_copies_keep_them() {
        let whole = row(9);
        let numbers =
            |runs: &[[u32; 2]]| Selected { numbers: Some(runs.to_vec()), ..Selected::default() };
        let one = |action, of| Edit { action, of };
        let placement = Placement { translation: [0.0, 7.0, 0.0], ..Placement::default() };
        let edits = [
            one(EditAction::Delete, numbers(&[[0, 2], [5, 1]])),
            one(EditAction::Copy(placement), numbers(&[[1, 2], [8, 1]])),
            one(EditAction::Delete, numbers(&[[4, 2], [8, 3]])),
        ];
        let edited = edited(&edits, &whole, &[], 20).unwrap();
        assert_eq!(edited.counts, [3, 2, 3], "1 is gone; 4, 8 and the copy of 8");
        let left: Vec<f32> = edited.gaussians.means().iter().map(|mean| mean[0]).collect();
        assert_eq!(left, [2.0, 3.0, 6.0, 7.0, 2.0]);
    }

    #[test]
    fn a_colour_is_mixed_in_or_takes_the_place_of_the_old_one() {
        let whole = row(4);
        let red = [1.0, 0.0, 0.0];
        let action = EditAction::Recolor { color: red, amount: 1.0 };
        let painted = one(action, of_entry(1), &whole).gaussians;
        for (coefficient, channel) in painted.sh()[0].iter().zip(red) {
            assert!((coefficient * SH_C0 + 0.5 - channel).abs() < 1e-6);
        }
        assert!(painted.sh()[1..16].as_flattened().iter().all(|v| *v == 0.0), "from all sides");
        assert_eq!(painted.sh()[16..32], whole.sh()[16..32]);
        let action = EditAction::Recolor { color: red, amount: 0.25 };
        let mixed = one(action, of_entry(1), &whole).gaussians;
        let wanted = 0.75 * whole.sh()[0][1] - 0.25 * 0.5 / SH_C0;
        assert!((mixed.sh()[0][1] - wanted).abs() < 1e-6);
    }
}
