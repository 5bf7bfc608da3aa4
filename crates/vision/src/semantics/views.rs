//! Votes of the photos: each Gaussian is looked up in every photo that sees it. The Gaussians
//! themselves give the depths.
//!
//! In: Gaussians with their source pixels, the cameras, and the photos' index maps. Out: votes for
//! an entry of each Gaussian, and entries that are one object seen from two sides.

use glam::DVec3;
use rayon::prelude::*;

use super::assign::NetworkPicture;
use crate::scene::{Bank, CameraToWorld, Gaussians, IndexMap, SceneCamera};

/// A photo shows a Gaussian under this relative difference of depth.
const SAME_SURFACE: f64 = 0.03;
/// Gaussians of a task.
const PART: usize = 1 << 16;

/// A photo with the depths of its Gaussians.
struct View {
    pose: CameraToWorld,
    picture: NetworkPicture,
    /// `[H * W]` depth of the Gaussian of each pixel of the network's picture; 0 without one.
    depth: Vec<f32>,
}

/// The surfaces that the photos of a scene show.
pub struct Views<'a> {
    gaussians: &'a Gaussians,
    /// One for each photo; `None` if it was not used.
    views: Vec<Option<View>>,
}

impl std::fmt::Debug for Views<'_> {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Views").field("photos", &self.views.len()).finish_non_exhaustive()
    }
}

impl View {
    /// Place of a world point on the photo, shares of its sides; `None` if the photo lacks it.
    fn shows(&self, world: DVec3) -> Option<[f64; 2]> {
        let seen = self.pose.rotation().transpose() * (world - self.pose.center());
        if seen.z <= 0.0 {
            return None;
        }
        let lens = &self.picture.network;
        let (x, y) = lens.project(seen);
        let (width, height) = (f64::from(lens.width), f64::from(lens.height));
        if !((0.0..width).contains(&x) && (0.0..height).contains(&y)) {
            return None;
        }
        #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "inside")]
        let at = y as usize * lens.width as usize + x as usize;
        let depth = f64::from(self.depth[at]);
        if depth <= 0.0 || (seen.z - depth).abs() > SAME_SURFACE * depth {
            return None;
        }
        let photo = &self.picture.photo;
        let (u, v) = photo.project(seen);
        Some([u / f64::from(photo.width), v / f64::from(photo.height)])
    }

    /// Gives pixels without a Gaussian the depth of a neighbour. After thinning a Gaussian stands
    /// for up to 4 x 4 pixels; its own pixel is one pixel from the corner of the block.
    fn fill(&mut self) {
        let (width, height) =
            (self.picture.network.width as usize, self.picture.network.height as usize);
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
            let network = input.network?;
            let picture = NetworkPicture { network, photo: input.camera.intrinsics };
            let depth = vec![0.0; network.width as usize * network.height as usize];
            Some(View { pose: input.camera.camera_to_world, picture, depth })
        };
        let mut views: Vec<Option<View>> = cameras.iter().map(view).collect();
        for (i, source) in gaussians.source().iter().enumerate() {
            let Some(Some(view)) = views.get_mut(usize::from(source.view)) else { continue };
            let lens = &view.picture.network;
            if u32::from(source.x) < lens.width && u32::from(source.y) < lens.height {
                let at = usize::from(source.y) * lens.width as usize + usize::from(source.x);
                let to = world(gaussians, i) - view.pose.center();
                #[expect(clippy::cast_possible_truncation, reason = "compared to per cents")]
                let depth = to.dot(view.pose.axis()) as f32;
                view.depth[at] = depth;
            }
        }
        views.iter_mut().flatten().for_each(View::fill);
        Self { gaussians, views }
    }

    /// `[V]` the vote of each photo for Gaussian `i`: an entry, or 0 if the photo does not show it
    /// or has no entry there. The vote of its own photo is `own`.
    fn said(&self, i: usize, own: &[u16], maps: &[IndexMap]) -> Vec<u16> {
        let at = world(self.gaussians, i);
        let source = usize::from(self.gaussians.source()[i].view);
        let look = |(v, view): (usize, &Option<View>)| {
            if v == source {
                return own[i];
            }
            let place = view.as_ref().and_then(|view| view.shows(at));
            place.zip(maps.get(v)).map_or(0, |([x, y], map)| map.at(x, y))
        };
        self.views.iter().enumerate().map(look).collect()
    }

    /// `[N]` the entry with the most votes for each Gaussian. A photo without an entry for it does
    /// not vote. In a tie its own photo's entry wins if it is among them, else the smallest entry.
    #[must_use]
    pub fn vote(&self, own: &[u16], maps: &[IndexMap]) -> Vec<u16> {
        let vote = |(i, of): (usize, &u16)| winner(*of, self.said(i, own, maps));
        own.par_iter().enumerate().with_min_len(1024).map(vote).collect()
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
        let mut pairs = vec![0_u32; rows * rows];
        for start in (0..own.len()).step_by(PART) {
            let part = start..own.len().min(start + PART);
            let said: Vec<Vec<u16>> =
                part.clone().into_par_iter().map(|i| self.said(i, own, maps)).collect();
            for (i, votes) in part.zip(said) {
                let source = usize::from(self.gaussians.source()[i].view);
                for (v, other) in votes.into_iter().enumerate() {
                    let (a, b) = (usize::from(own[i]), usize::from(other));
                    if v != source && a > 0 && b > 0 && a < rows && b < rows {
                        pairs[a * rows + b] += 1;
                    }
                }
            }
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

fn world(gaussians: &Gaussians, i: usize) -> DVec3 {
    DVec3::from_array(gaussians.means()[i].map(f64::from)) + gaussians.origin()
}

fn winner(own: u16, mut votes: Vec<u16>) -> u16 {
    votes.retain(|vote| *vote > 0);
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
    let lengths = super::norm(bank.row(a)) * super::norm(bank.row(b));
    if lengths > 0.0 { super::dot(bank.row(a), bank.row(b)) / lengths } else { 0.0 }
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
    use super::*;
    use crate::scene::{Camera, Intrinsics, RawGaussians, SourcePixel};

    const SIDE: u16 = 20;

    /// Cameras one unit apart that look along z at a wall 10 units away; a photo is twice as large
    /// as the network's picture of it.
    fn cameras(count: usize) -> Vec<SceneCamera> {
        let lens = |scale: f64, side: u32| Intrinsics {
            fx: 20.0 * scale,
            fy: 20.0 * scale,
            cx: 10.0 * scale,
            cy: 10.0 * scale,
            width: side,
            height: side,
        };
        let one = |v: usize| {
            let pose = [1., 0., 0., v as f64, 0., 1., 0., 0., 0., 0., 1., 0., 0., 0., 0., 1.];
            let camera_to_world = CameraToWorld::from_row_major(&pose, "test").unwrap();
            SceneCamera {
                file: String::new(),
                camera: Camera { intrinsics: lens(2.0, 40), camera_to_world },
                network: Some(lens(1.0, 20)),
            }
        };
        (0..count).map(one).collect()
    }

    /// A Gaussian for every pixel of every photo; `depth` says how far.
    fn wall(count: u16, depth: impl Fn(SourcePixel) -> f64) -> Gaussians {
        let mut raw = RawGaussians::default();
        for view in 0..count {
            for (x, y) in (0..SIDE).flat_map(|y| (0..SIDE).map(move |x| (x, y))) {
                let source = SourcePixel { view, x, y };
                let z = depth(source);
                let at = |v: u16| (f64::from(v) + 0.5 - 10.0) / 20.0 * z;
                let mean = [at(x) + f64::from(view), at(y), z];
                raw.means.push(mean.map(|v| v as f32));
                raw.source.push(source);
            }
        }
        let n = raw.means.len();
        raw.quats = vec![[1.0, 0.0, 0.0, 0.0]; n];
        raw.scales = vec![[0.1; 3]; n];
        raw.opacities = vec![0.9; n];
        raw.sh = vec![[0.0; 3]; n];
        raw.semantic_index = vec![0; n];
        Gaussians::sanitize(raw).unwrap().0
    }

    /// A map whose columns from `from` on (of 20) have index `m`.
    fn map(from: u32, m: u16) -> IndexMap {
        let index = (0..20 * 20).map(|i| if i % 20 >= from { m } else { 0 }).collect();
        IndexMap { width: 20, height: 20, index }
    }

    fn own(gaussians: &Gaussians, maps: &[IndexMap]) -> Vec<u16> {
        let pictures: Vec<Option<NetworkPicture>> = cameras(maps.len())
            .iter()
            .map(|c| {
                let network = c.network?;
                Some(NetworkPicture { network, photo: c.camera.intrinsics })
            })
            .collect();
        super::super::from_source(gaussians.source(), &pictures, maps)
    }

    #[test]
    fn photos_that_agree_overrule_the_one_that_made_it_and_fill_its_gaps() {
        let gaussians = wall(3, |_| 10.0);
        // The wall's place X is column 10 + 2 (X - v) of photo v. Thing 5 begins at X = 1.
        let mut maps = vec![map(12, 5), map(10, 5), map(8, 5)];
        // Photo 0 calls rows 0 to 4 of it another thing, and misses rows 5 to 9.
        for i in 0..200 {
            if maps[0].index[i] == 5 {
                maps[0].index[i] = if i < 100 { 6 } else { 0 };
            }
        }
        let own = own(&gaussians, &maps);
        let voted = Views::new(&gaussians, &cameras(3)).vote(&own, &maps);
        let at = |x: usize, y: usize| (own[y * 20 + x], voted[y * 20 + x]);
        assert_eq!(at(15, 2), (6, 5), "two of three photos say 5");
        assert_eq!(at(15, 7), (0, 5), "a gap");
        assert_eq!(at(15, 15), (5, 5));
        assert_eq!(at(5, 2), (0, 0), "nobody says anything");
    }

    #[test]
    fn of_two_photos_that_disagree_its_own_is_believed() {
        assert_eq!(winner(6, vec![6, 5]), 6);
        assert_eq!(winner(6, vec![5, 6, 5]), 5);
        assert_eq!(winner(0, vec![0, 9, 0, 4]), 4, "the smallest of others' tie");
        assert_eq!(winner(0, vec![0, 0]), 0);
    }

    #[test]
    fn a_photo_that_sees_something_else_there_has_no_vote() {
        // Photo 1 shows a screen at half the distance in front of the wall.
        let gaussians = wall(2, |s| if s.view == 1 { 5.0 } else { 10.0 });
        let maps = vec![map(20, 1), map(0, 7)];
        let own = own(&gaussians, &maps);
        let voted = Views::new(&gaussians, &cameras(2)).vote(&own, &maps);
        assert!(voted[..400].iter().all(|m| *m == 0), "the wall is hidden from photo 1");
        assert!(voted[400..].iter().all(|m| *m == 7), "the screen keeps its own");
    }

    fn rows(rows: &[[f32; 2]]) -> Bank {
        Bank { dim: 2, rows: rows.concat() }
    }

    #[test]
    fn one_thing_under_two_indices_is_found_and_two_things_are_not() {
        let gaussians = wall(2, |_| 10.0);
        let views = Views::new(&gaussians, &cameras(2));
        let maps = vec![map(12, 1), map(10, 2)];
        let own = own(&gaussians, &maps);
        let alike = rows(&[[1.0, 0.0], [0.9, 0.1]]);
        assert_eq!(views.same_things(&own, &maps, &alike, 0.5), [0, 1, 1]);
        let other = rows(&[[1.0, 0.0], [0.0, 1.0]]);
        assert_eq!(views.same_things(&own, &maps, &other, 0.5), [0, 1, 2], "rows differ");
        // A small thing inside a large one: most of the large one is not the small one.
        let mut inside = map(20, 2);
        (0..100).for_each(|i| inside.index[i * 4 % 400] = 1);
        (0..40).for_each(|i| inside.index[i] = 2);
        let maps = vec![map(0, 1), inside];
        let own = self::own(&gaussians, &maps);
        assert_eq!(views.same_things(&own, &maps, &alike, 0.5), [0, 1, 2], "a part of it");
    }

    #[test]
    fn merged_rows_are_the_mean_of_their_features_and_indices_close_up() {
        let bank = rows(&[[1.0, 0.0], [0.0, 1.0], [0.5, 0.5], [0.0, 0.2]]);
        let (merged, becomes) = merge(&bank, &[3, 1, 1, 1], &[0, 1, 2, 1, 2]);
        assert_eq!(becomes, [0, 1, 2, 1, 2]);
        assert_eq!(merged.rows, [0.875, 0.125, 0.0, 0.6]);
        let (same, becomes) = merge(&bank, &[3, 1, 1, 1], &[0, 1, 2, 3, 4]);
        assert_eq!((same.rows, becomes), (bank.rows, vec![0, 1, 2, 3, 4]));
    }
}
