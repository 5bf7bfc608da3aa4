//! Votes of the photos: each Gaussian is looked up in every photo that sees it. The Gaussians
//! themselves give the depths.
//!
//! In: Gaussians with their source pixels, the cameras, and the photos' index maps. Out: votes for
//! an entry of each Gaussian, and entries that are one object seen from two sides.

use glam::DVec3;
use rayon::prelude::*;
use rustc_hash::FxHashMap;

use super::rows::{dot, norm};
use crate::{
    center_of,
    scene::{Bank, Camera, Gaussians, IndexMap, Intrinsics, SceneCamera, SourcePixel},
    seen_at,
};

/// A photo shows a Gaussian under this relative difference of depth.
const SAME_SURFACE: f64 = 0.03;
/// Gaussians that one thread takes at a time.
const PART: usize = 1 << 12;

/// A photo with the depths of its Gaussians.
#[derive(Debug)]
struct View {
    /// Of the network's picture.
    camera: Camera,
    photo: Intrinsics,
    /// `[H * W]` depth of the Gaussian of each pixel of the network's picture; 0 without one.
    depth: Vec<f32>,
}

/// The surfaces that the photos of a scene show.
#[derive(Debug)]
pub struct Views<'a> {
    gaussians: &'a Gaussians,
    /// One for each photo; `None` if it was not used.
    views: Vec<Option<View>>,
}

impl View {
    /// Place of a world point on the photo, shares of its sides; `None` if the photo lacks it.
    fn shows(&self, world: DVec3) -> Option<[f64; 2]> {
        let (seen, x, y) = seen_at(&self.camera, world)?;
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "inside")]
        let at = y as usize * self.camera.intrinsics.width as usize + x as usize;
        let depth = f64::from(self.depth[at]);
        if depth <= 0.0 || (seen.z - depth).abs() > SAME_SURFACE * depth {
            return None;
        }
        let (u, v) = self.photo.project(seen);
        Some([u / f64::from(self.photo.width), v / f64::from(self.photo.height)])
    }

    /// Gives pixels without a Gaussian the depth of a neighbour. After thinning a Gaussian stands
    /// for up to 4 x 4 pixels; its own pixel is one pixel from the corner of the block.
    fn fill(&mut self) {
        let lens = &self.camera.intrinsics;
        let (width, height) = (lens.width as usize, lens.height as usize);
        for _ in 0..2 {
            let known = self.depth.clone();
            for (at, depth) in self.depth.iter_mut().enumerate().filter(|(_, depth)| **depth == 0.0)
            {
                let (x, y) = (at % width, at / width);
                let rows = y.saturating_sub(1)..(y + 2).min(height);
                let around = rows.flat_map(|y| {
                    (x.saturating_sub(1)..(x + 2).min(width)).map(move |x| y * width + x)
                });
                *depth = around.map(|at| known[at]).find(|depth| *depth > 0.0).unwrap_or(0.0);
            }
        }
    }
}

impl<'a> Views<'a> {
    /// Writes the depth of every Gaussian to its source pixel.
    #[must_use]
    pub fn new(gaussians: &'a Gaussians, cameras: &[SceneCamera]) -> Self {
        let view = |input: &SceneCamera| {
            let intrinsics = input.network?;
            let depth = vec![0.0; intrinsics.width as usize * intrinsics.height as usize];
            let camera = Camera { intrinsics, ..input.camera };
            Some(View { camera, photo: input.camera.intrinsics, depth })
        };
        let mut views: Vec<Option<View>> = cameras.iter().map(view).collect();
        let depth = |(i, source): (usize, &SourcePixel)| {
            let pose = &views.get(usize::from(source.view))?.as_ref()?.camera.camera_to_world;
            #[expect(clippy::cast_possible_truncation, reason = "compared to per cents")]
            let depth = (center_of(gaussians, i) - pose.center()).dot(pose.axis()) as f32;
            Some(depth)
        };
        let all = gaussians.source().par_iter().enumerate().with_min_len(PART);
        let depths: Vec<Option<f32>> = all.map(depth).collect();
        for (source, depth) in gaussians.source().iter().zip(depths) {
            let Some(Some(view)) = views.get_mut(usize::from(source.view)) else { continue };
            let lens = &view.camera.intrinsics;
            if u32::from(source.x) < lens.width && u32::from(source.y) < lens.height {
                let at = usize::from(source.y) * lens.width as usize + usize::from(source.x);
                view.depth[at] = depth.unwrap_or_default();
            }
        }
        views.par_iter_mut().flatten().for_each(View::fill);
        Self { gaussians, views }
    }

    /// The Gaussians.
    pub(super) fn gaussians(&self) -> &Gaussians {
        self.gaussians
    }

    /// `[V]` whether each photo shows Gaussian `i`; its own does.
    pub(super) fn show(&self, i: usize) -> impl Iterator<Item = bool> + '_ {
        let at = center_of(self.gaussians, i);
        let source = usize::from(self.gaussians.source()[i].view);
        let shows = move |view: &View| view.shows(at).is_some();
        let look = move |(v, view): (usize, &Option<View>)| {
            v == source || view.as_ref().is_some_and(shows)
        };
        self.views.iter().enumerate().map(look)
    }

    /// `[V]` what each photo has at Gaussian `i`: an entry, 0 for none, or `None` if the photo does
    /// not show it. That of its own photo is `own`.
    pub(super) fn looks<'b>(
        &'b self,
        i: usize,
        own: &'b [u16],
        maps: &'b [IndexMap],
    ) -> impl Iterator<Item = Option<u16>> + 'b {
        let at = center_of(self.gaussians, i);
        let source = usize::from(self.gaussians.source()[i].view);
        let look = move |(v, view): (usize, &Option<View>)| {
            if v == source {
                return Some(own[i]);
            }
            let place = view.as_ref().and_then(|view| view.shows(at));
            place.zip(maps.get(v)).map(|([x, y], map)| map.at(x, y))
        };
        self.views.iter().enumerate().map(look)
    }

    /// `[V]` the vote of each photo for Gaussian `i`: an entry, or 0 if the photo does not show it
    /// or has no entry there. The vote of its own photo is `own`.
    fn said<'b>(
        &'b self,
        i: usize,
        own: &'b [u16],
        maps: &'b [IndexMap],
    ) -> impl Iterator<Item = u16> + 'b {
        self.looks(i, own, maps).map(Option::unwrap_or_default)
    }

    /// `[N]` the entry with the most votes for each Gaussian. A photo without an entry for it does
    /// not vote. In a tie its own photo's entry wins if it is among them, else the smallest entry.
    #[must_use]
    pub fn vote(&self, own: &[u16], maps: &[IndexMap]) -> Vec<u16> {
        let vote = |votes: &mut Vec<u16>, (i, of): (usize, &u16)| {
            votes.clear();
            votes.extend(self.said(i, own, maps).filter(|vote| *vote > 0));
            winner(*of, votes)
        };
        own.par_iter().enumerate().with_min_len(PART).map_init(Vec::new, vote).collect()
    }

    /// `[M + 1]` the smallest entry of each group of entries that are one object. Two entries are
    /// joined if at least half of what each one covers, and the photos of the other show, has the
    /// other entry there, and if their rows are similar.
    #[must_use]
    pub fn same_things(
        &self,
        own: &[u16],
        maps: &[IndexMap],
        bank: &Bank,
        cosine_min: f64,
    ) -> Vec<u16> {
        let rows = bank.len() + 1;
        let met = |part: usize| {
            let mut met: FxHashMap<[usize; 2], u32> = FxHashMap::default();
            for (i, of) in (part * PART..).zip(own[part * PART..].iter().take(PART)) {
                let source = usize::from(self.gaussians.source()[i].view);
                let others = self.said(i, own, maps).enumerate().filter(|(v, _)| *v != source);
                for pair in others.map(|(_, other)| [usize::from(*of), usize::from(other)]) {
                    if pair.iter().all(|entry| (1..rows).contains(entry)) {
                        *met.entry(pair).or_default() += 1;
                    }
                }
            }
            met
        };
        let parts = (0..own.len().div_ceil(PART)).into_par_iter();
        let parts: Vec<FxHashMap<[usize; 2], u32>> = parts.map(met).collect();
        let mut pairs = vec![0_u32; rows * rows];
        for ([a, b], count) in parts.into_iter().flatten() {
            pairs[a * rows + b] += count;
        }
        let met: Vec<u32> = pairs.chunks_exact(rows).map(|row| row.iter().sum()).collect();
        let mut group: Vec<usize> = (0..rows).collect();
        for a in 1..rows {
            for b in a + 1..rows {
                let half = |from: usize, to: usize| {
                    let both = pairs[from * rows + to];
                    both > 0 && 2 * both >= met[from]
                };
                if half(a, b) && half(b, a) && cosine(bank, a - 1, b - 1) >= cosine_min {
                    let (keep, gone) = (group[a].min(group[b]), group[a].max(group[b]));
                    group.iter_mut().filter(|g| **g == gone).for_each(|g| *g = keep);
                }
            }
        }
        group.into_iter().map(|g| u16::try_from(g).unwrap_or(u16::MAX)).collect()
    }
}

/// `votes` without 0; they are sorted.
fn winner(own: u16, votes: &mut [u16]) -> u16 {
    votes.sort_unstable();
    let (mut best, mut most) = (own, votes.iter().filter(|vote| **vote == own).count());
    for run in votes.chunk_by(|a, b| a == b) {
        if run.len() > most {
            (best, most) = (run[0], run.len());
        }
    }
    best
}

fn cosine(bank: &Bank, a: usize, b: usize) -> f64 {
    let lengths = norm(bank.row(a)) * norm(bank.row(b));
    if lengths > 0.0 { dot(bank.row(a), bank.row(b)) / lengths } else { 0.0 }
}

/// Joins groups of rows to one row each: the mean over their embeddings, of which row m had
/// `counts[m]`. Entries keep their order.
#[must_use]
pub fn merge(bank: &Bank, counts: &[u32], group: &[u16]) -> (Bank, Vec<u16>) {
    let mut becomes = vec![0_u16; bank.len() + 1];
    let mut rows: Vec<f32> = Vec::new();
    let mut next = 0_u16;
    for keep in 1..=bank.len() {
        let members: Vec<usize> =
            (1..=bank.len()).filter(|m| usize::from(group[*m]) == keep).collect();
        if members.is_empty() {
            continue;
        }
        next += 1;
        let total: f64 = members.iter().map(|m| f64::from(counts[m - 1])).sum();
        #[expect(clippy::cast_possible_truncation, reason = "rows are f32")]
        rows.extend((0..bank.dim).map(|d| {
            let sum: f64 = members
                .iter()
                .map(|m| f64::from(counts[m - 1]) * f64::from(bank.row(m - 1)[d]))
                .sum();
            (sum / total.max(1.0)) as f32
        }));
        members.into_iter().for_each(|m| becomes[m] = next);
    }
    (Bank { dim: bank.dim, rows }, becomes)
}

#[cfg(test)]
mod tests {
    use super::winner;

    #[test]
    fn of_two_photos_that_disagree_its_own_is_believed() {
        assert_eq!(winner(6, &mut [6, 5]), 6);
        assert_eq!(winner(6, &mut [5, 6, 5]), 5);
        assert_eq!(winner(0, &mut [9, 4]), 4, "the smallest of others' tie");
        assert_eq!(winner(0, &mut []), 0);
    }
}
