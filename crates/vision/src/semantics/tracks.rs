//! Tracks: masks of different photos that lie on the same Gaussians are one thing, and one row of
//! the bank.
//!
//! Two masks are compared by the Gaussians that both of their photos show: how many lie in both
//! masks, over how many lie in either. Groups of masks by the sums over their pairs. The pair that
//! agrees most becomes one track, until none agrees by half. Two masks of one photo are never one
//! track. In: the surfaces that photos show, and their masks. Out: the masks of each row.

use std::{cmp::Reverse, collections::BinaryHeap};

use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::{Views, from_source};
use crate::{
    limits::BANK_ROWS_MAX,
    scene::{IndexMap, PhotoMasks, SceneCamera},
};

/// Share of the Gaussians in either of two tracks that must lie in both.
const SAME_THING: f64 = 0.5;
/// Share of the smaller track's Gaussians that must be compared.
const COMPARED: f64 = 0.1;
/// Gaussians that one thread takes at a time.
const PART: usize = 1 << 12;

/// Masks with an embedding, counted from 0 over all photos, that share a row.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Tracks {
    rows: Vec<Vec<usize>>,
    /// How many of them have Gaussians.
    on_gaussians: usize,
}

impl Tracks {
    /// `[M]` masks of each row, ascending; the row with the most Gaussians comes first.
    #[must_use]
    pub fn rows(&self) -> &[Vec<usize>] {
        &self.rows
    }

    /// How many rows lie on Gaussians of the scene; they are the first.
    #[must_use]
    pub fn on_gaussians(&self) -> usize {
        self.on_gaussians
    }

    /// The entry of each of `count` masks; 0 for one that has no row.
    #[must_use]
    pub fn entries(&self, count: usize) -> Vec<u16> {
        let mut entries = vec![0; count];
        for (entry, members) in (1..).zip(&self.rows) {
            members.iter().for_each(|&mask| entries[mask] = entry);
        }
        entries
    }
}

/// Groups the masks `of` (photo and number in it) that have an embedding, photo by photo. A mask
/// on no Gaussian is a row of its own. Of more rows than a bank may have, those with the fewest
/// Gaussians are left out.
#[must_use]
pub fn tracks(
    views: &Views<'_>,
    cameras: &[SceneCamera],
    masks: &[PhotoMasks],
    of: &[[usize; 2]],
) -> Tracks {
    let mut groups = Groups::new(views, cameras, masks, of);
    groups.join();
    let Groups { members, gaussians, .. } = groups;
    let mut rows: Vec<(Vec<usize>, u64)> = members.into_iter().zip(gaussians).collect();
    rows.retain(|(members, _)| !members.is_empty());
    rows.iter_mut().for_each(|(members, _)| members.sort_unstable());
    rows.sort_by_key(|(members, gaussians)| (Reverse(*gaussians), members[0]));
    rows.truncate(BANK_ROWS_MAX);
    let on_gaussians = rows.partition_point(|(_, gaussians)| *gaussians > 0);
    Tracks { rows: rows.into_iter().map(|(members, _)| members).collect(), on_gaussians }
}

/// Masks on their way to tracks. A group that became a part of another one has no members.
#[derive(Debug)]
struct Groups {
    members: Vec<Vec<usize>>,
    /// Photos of the members.
    photos: Vec<Vec<usize>>,
    /// Gaussians in the members' masks; one in two masks counts twice.
    gaussians: Vec<u64>,
    /// `[group][photo]` of these, how many the photo shows.
    shown: Vec<Vec<u64>>,
    /// `[group]` other groups, and how many Gaussians lie in a mask of both.
    both: Vec<FxHashMap<usize, u64>>,
}

/// What one part of the Gaussians adds.
#[derive(Debug, Default)]
struct Counts {
    gaussians: FxHashMap<usize, u64>,
    shown: FxHashMap<[usize; 2], u64>,
    both: FxHashMap<[usize; 2], u64>,
}

/// The photos that show a Gaussian, and the masks in which it lies there. Neighbours have the same.
#[derive(Debug, Default, PartialEq)]
struct Seen {
    shown: Vec<usize>,
    inside: Vec<usize>,
}

impl Counts {
    /// Adds so many Gaussians.
    fn add(&mut self, Seen { shown, inside }: &Seen, count: u64) {
        for (at, &a) in inside.iter().enumerate() {
            *self.gaussians.entry(a).or_default() += count;
            shown.iter().for_each(|&v| *self.shown.entry([a, v]).or_default() += count);
            for &b in &inside[at + 1..] {
                *self.both.entry([a, b]).or_default() += count;
            }
        }
    }
}

/// Two groups and how much they agree; of two that agree as much the first is the larger.
#[derive(Debug, PartialEq)]
struct Pair {
    agree: f64,
    groups: [usize; 2],
}

impl Eq for Pair {}

impl PartialOrd for Pair {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Pair {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        self.agree.total_cmp(&other.agree).then_with(|| other.groups.cmp(&self.groups))
    }
}

impl Groups {
    /// Each mask alone.
    fn new(
        views: &Views<'_>,
        cameras: &[SceneCamera],
        masks: &[PhotoMasks],
        of: &[[usize; 2]],
    ) -> Self {
        let mut group: Vec<Vec<Option<usize>>> =
            masks.iter().map(|of| vec![None; of.masks.len()]).collect();
        of.iter().enumerate().for_each(|(i, &[photo, mask])| group[photo][mask] = Some(i));
        let maps: Vec<IndexMap> = masks.iter().map(|of| of.map.clone()).collect();
        let own = from_source(views.gaussians().source(), cameras, &maps);
        let count = |part: usize| {
            let mut counts = Counts::default();
            let (mut last, mut run) = (Seen::default(), 0);
            for i in part * PART..own.len().min((part + 1) * PART) {
                let mut seen = Seen::default();
                for (photo, at) in views.looks(i, &own, &maps).enumerate() {
                    let Some(number) = at else { continue };
                    seen.shown.push(photo);
                    let mask = usize::from(number).checked_sub(1);
                    seen.inside.extend(mask.and_then(|k| group[photo].get(k).copied().flatten()));
                }
                if seen != last {
                    counts.add(&last, run);
                    (last, run) = (seen, 0);
                }
                run += 1;
            }
            counts.add(&last, run);
            counts
        };
        let parts: Vec<Counts> = (0..own.len().div_ceil(PART)).into_par_iter().map(count).collect();
        let mut groups = Self {
            members: (0..of.len()).map(|i| vec![i]).collect(),
            photos: of.iter().map(|[photo, _]| vec![*photo]).collect(),
            gaussians: vec![0; of.len()],
            shown: vec![vec![0; masks.len()]; of.len()],
            both: vec![FxHashMap::default(); of.len()],
        };
        for counts in parts {
            counts.gaussians.into_iter().for_each(|(a, n)| groups.gaussians[a] += n);
            counts.shown.into_iter().for_each(|([a, v], n)| groups.shown[a][v] += n);
            for ([a, b], n) in counts.both {
                *groups.both[a].entry(b).or_default() += n;
                *groups.both[b].entry(a).or_default() += n;
            }
        }
        groups
    }

    /// Joins groups until no two agree.
    fn join(&mut self) {
        let mut pairs: BinaryHeap<Pair> =
            (0..self.members.len()).flat_map(|a| self.pairs(a, |b| a < b)).collect();
        while let Some(Pair { agree, groups: [a, b] }) = pairs.pop() {
            // A pair of which one has changed since is on the heap again, or gone.
            if self.agreement(a, b) != Some(agree) {
                continue;
            }
            self.add(a, b);
            pairs.extend(self.pairs(a, |_| true));
        }
    }

    /// The pairs of a group that agree enough, of those that are wanted.
    fn pairs(&self, a: usize, wanted: impl Fn(usize) -> bool) -> Vec<Pair> {
        let others = self.both[a].keys().copied().filter(|b| wanted(*b));
        let pair = |b: usize| {
            let groups = [a.min(b), a.max(b)];
            Some(Pair { agree: self.agreement(groups[0], groups[1])?, groups })
        };
        others.filter_map(pair).collect()
    }

    /// How much two groups agree, where that is enough; `None` also for two of one photo.
    fn agreement(&self, a: usize, b: usize) -> Option<f64> {
        let both = *self.both[a].get(&b)? as f64;
        let seen = |of: usize, by: usize| -> u64 {
            self.photos[by].iter().map(|&photo| self.shown[of][photo]).sum()
        };
        let either = (seen(a, b) + seen(b, a)) as f64 - both;
        let least = self.gaussians[a].min(self.gaussians[b]) as f64;
        let apart = self.photos[a].iter().all(|photo| !self.photos[b].contains(photo));
        let agree = both / either;
        (apart && agree >= SAME_THING && either >= COMPARED * least).then_some(agree)
    }

    /// Group `b` becomes a part of `a`.
    fn add(&mut self, a: usize, b: usize) {
        let members = std::mem::take(&mut self.members[b]);
        self.members[a].extend(members);
        let photos = std::mem::take(&mut self.photos[b]);
        self.photos[a].extend(photos);
        self.gaussians[a] += std::mem::take(&mut self.gaussians[b]);
        let shown = std::mem::take(&mut self.shown[b]);
        self.shown[a].iter_mut().zip(shown).for_each(|(sum, more)| *sum += more);
        for (c, count) in std::mem::take(&mut self.both[b]) {
            self.both[c].remove(&b);
            if c != a {
                *self.both[a].entry(c).or_default() += count;
                *self.both[c].entry(a).or_default() += count;
            }
        }
    }
}
