//! Streamed SOG, the levels of detail of `PlayCanvas`: a zip of a folder of `lod-meta.json` and SOG
//! bundles that are not packed, `LEVEL_FILE/meta.json` with its pictures beside it.
//!
//! Level 0 is the scene, and each further one a coarser form of it ([`CoarseForms`]); a scene
//! without forms has the one level. `lod-meta.json` has a tree of boxes by place. A leaf has of
//! each level the Gaussians that stand for the same part of the scene: `lods` says in which file,
//! from which one on, and how many. `bound` is the box of their ellipsoids of one standard
//! deviation. What a program looks at from near it takes in level 0, the rest in others.

use std::{collections::BTreeMap, io::Write, ops::Range};

use glam::DVec3;
use serde::Serialize;
use serde_json::json;

use super::{packed_ply::morton_order, sog, world};
use crate::{
    error::{Error, Result},
    folders::ZipFolder,
    packed::CoarseForms,
    scene::{Gaussians, covariance},
};

/// Most Gaussians of the scene in a leaf, but where one record of the coarsest form has more.
const LEAF: usize = 1 << 16;
/// A file is ended when it has so many Gaussians, about 2 MiB.
const FILE_MIN: usize = 1 << 17;

/// Writes the zip; `antialiased` as [`super::SplatFile::antialiased`].
///
/// # Errors
/// `invalid_request` where there are no Gaussians; `store_unavailable` and `deadline_exceeded` as
/// `to` fails.
pub fn write_streamed(
    own: &Gaussians,
    coarse: Option<CoarseForms<'_>>,
    antialiased: bool,
    to: &mut dyn Write,
) -> Result<()> {
    if own.is_empty() {
        let why = "sog_lod: there are no Gaussians to write; ply can be empty";
        return Err(Error::invalid(why));
    }
    let levels = 1 + coarse.map_or(0, |forms| forms.ends.len());
    let open = vec![Vec::new(); levels];
    let (zip, files, counts) = (ZipFolder::new(to), Vec::new(), vec![0; levels]);
    let file_of = vec![0; levels];
    let mut writer = Writer { own, coarse, antialiased, zip, files, file_of, open, counts };
    let first = coarse.map_or(own.len(), |forms| forms.ends[0].len());
    let mut records: Vec<u32> = (0..first as u32).collect();
    let tree = writer.node(&mut records)?;
    (0..levels).try_for_each(|level| writer.end(level))?;
    let Writer { mut zip, files, counts, .. } = writer;
    zip.begin_text("lod-meta.json")?;
    zip.put_json(&json!({
        "version": 1,
        "asset": { "generator": concat!("segsplat ", env!("CARGO_PKG_VERSION")) },
        "count": counts.iter().sum::<usize>(),
        "counts": counts,
        "lodLevels": levels,
        "filenames": files,
        "tree": tree,
    }))?;
    zip.finish()
}

/// A box of the world.
#[derive(Clone, Copy, Serialize)]
struct Bound {
    min: [f64; 3],
    max: [f64; 3],
}

impl Bound {
    const NONE: Self = Self { min: [f64::INFINITY; 3], max: [f64::NEG_INFINITY; 3] };

    fn around(self, other: Self) -> Self {
        Self {
            min: DVec3::from(self.min).min(other.min.into()).to_array(),
            max: DVec3::from(self.max).max(other.max.into()).to_array(),
        }
    }

    /// That of the ellipsoid of one standard deviation.
    fn of(gaussians: &Gaussians, i: usize) -> Self {
        let variances = covariance(gaussians.quats()[i], gaussians.scales()[i]);
        let half = DVec3::from_array([0, 1, 2].map(|k| variances.col(k)[k].max(0.0).sqrt()));
        let at = world(gaussians, i);
        Self { min: (at - half).to_array(), max: (at + half).to_array() }
    }
}

/// Where a leaf has its Gaussians of a level.
#[derive(Serialize)]
struct Place {
    file: usize,
    offset: usize,
    count: usize,
}

#[derive(Serialize)]
struct Node {
    bound: Bound,
    #[serde(flatten)]
    of: Content,
}

#[derive(Serialize)]
#[serde(rename_all = "lowercase")]
enum Content {
    Children([Box<Node>; 2]),
    Lods(BTreeMap<usize, Place>),
}

struct Writer<'a, 'w> {
    own: &'a Gaussians,
    coarse: Option<CoarseForms<'a>>,
    antialiased: bool,
    zip: ZipFolder<'w>,
    /// Their names; those of the open ones too.
    files: Vec<String>,
    /// Of each level the number of its last file, and the Gaussians of it while it is not written.
    file_of: Vec<usize>,
    open: Vec<Vec<u32>>,
    /// Gaussians of each level.
    counts: Vec<usize>,
}

impl Writer<'_, '_> {
    /// The Gaussians of a level, and what is before it among them.
    fn level(&self, level: usize) -> (&Gaussians, usize) {
        match self.coarse {
            Some(forms) if level > 0 => {
                let before = &forms.ends[..forms.ends.len() - level];
                (forms.gaussians, before.iter().map(Vec::len).sum())
            }
            _ => (self.own, 0),
        }
    }

    /// Where the Gaussians of a level are that record `at` of the coarsest one stands for, in the
    /// order of that level.
    fn under(&self, at: u32, level: usize) -> Range<usize> {
        let Some(forms) = self.coarse else { return at as usize..at as usize + 1 };
        let down =
            |end: usize, ends: &Vec<u32>| end.checked_sub(1).map_or(0, |last| ends[last] as usize);
        let above = &forms.ends[..forms.ends.len() - level];
        let end = |at: usize| above.iter().fold(at, down);
        end(at as usize)..end(at as usize + 1)
    }

    /// The tree over some records of the coarsest level, whose leaves go to the files.
    fn node(&mut self, records: &mut [u32]) -> Result<Node> {
        let own: usize = records.iter().map(|&at| self.under(at, 0).len()).sum();
        if own <= LEAF || records.len() == 1 {
            return self.leaf(records);
        }
        let (gaussians, _) = self.level(self.counts.len() - 1);
        let mean = |at: u32| gaussians.means()[at as usize];
        let start = [[f32::INFINITY; 3], [f32::NEG_INFINITY; 3]];
        let [low, high] = records.iter().fold(start, |[low, high], &at| {
            let mean = mean(at);
            let of = |f: fn(f32, f32) -> f32, to: [f32; 3]| [0, 1, 2].map(|k| f(to[k], mean[k]));
            [of(f32::min, low), of(f32::max, high)]
        });
        let side = |k: usize| high[k] - low[k];
        let axis = (0..3).fold(0, |best, k| if side(k) > side(best) { k } else { best });
        let (low, _, _) = records.select_nth_unstable_by(records.len() / 2, |&a, &b| {
            mean(a)[axis].total_cmp(&mean(b)[axis]).then(a.cmp(&b))
        });
        let middle = low.len();
        let (low, high) = records.split_at_mut(middle);
        let children = [Box::new(self.node(low)?), Box::new(self.node(high)?)];
        let bound = children[0].bound.around(children[1].bound);
        Ok(Node { bound, of: Content::Children(children) })
    }

    /// The Gaussians of all levels that these records stand for.
    fn leaf(&mut self, records: &[u32]) -> Result<Node> {
        let (mut bound, mut lods) = (Bound::NONE, BTreeMap::new());
        for level in 0..self.counts.len() {
            let (gaussians, first) = self.level(level);
            let places = records.iter().flat_map(|&at| self.under(at, level));
            let ids: Vec<u32> = match self.coarse {
                Some(forms) if level == 0 => places.map(|at| forms.order[at]).collect(),
                _ => places.map(|at| (first + at) as u32).collect(),
            };
            let near = morton_order(&ids.into_iter(), gaussians.means());
            let bounds = near.iter().map(|&i| Bound::of(gaussians, i as usize));
            bound = bounds.fold(bound, Bound::around);
            if self.open[level].is_empty() {
                let name = |name: &&String| name.starts_with(&format!("{level}_"));
                let number = self.files.iter().filter(name).count();
                self.files.push(format!("{level}_{number}/meta.json"));
                self.file_of[level] = self.files.len() - 1;
            }
            let (file, offset) = (self.file_of[level], self.open[level].len());
            lods.insert(level, Place { file, offset, count: near.len() });
            self.counts[level] += near.len();
            self.open[level].extend(near);
            if self.open[level].len() >= FILE_MIN {
                self.end(level)?;
            }
        }
        Ok(Node { bound, of: Content::Lods(lods) })
    }

    /// Writes the file of a level that is open, where one is.
    fn end(&mut self, level: usize) -> Result<()> {
        let ids = std::mem::take(&mut self.open[level]);
        if ids.is_empty() {
            return Ok(());
        }
        let some = self.level(level).0.picked(&ids);
        let order: Vec<u32> = (0..ids.len() as u32).collect();
        let whole = |cause| Error::internal("the pictures of a SOG are not whole").caused_by(cause);
        let name = &self.files[self.file_of[level]];
        let folder = name.strip_suffix("meta.json").unwrap_or(name);
        for (file, bytes) in sog::files(&some, &order, self.antialiased).map_err(whole)? {
            self.zip.file(&format!("{folder}{file}"), &bytes)?;
        }
        Ok(())
    }
}
