//! Stage 0: which Gaussians are projected. Shader: `shaders/cull.wgsl`
//!
//! In: the blocks of the scene. Out: the Gaussians of the blocks that the view shows, in the order
//! of the scene; merged ones come after its own. Every later stage counts in this list, so its
//! numbers have the same order as those of the scene: ties at equal depth stay.

use std::{
    borrow::Cow,
    sync::{
        Arc,
        atomic::{AtomicU64, Ordering},
    },
};

use rayon::prelude::*;

use crate::{
    blocks::{Blocks, Frustum},
    merged::Merged,
    scene::Gaussians,
};

/// Words of the set of Gaussians that a thread reads at a time.
const WORDS: usize = 1 << 10;
/// Where fewer blocks than one in this many are left out, none is.
const NEARLY: usize = 8;

/// The Gaussians of a view, in the order of the scene.
#[derive(Debug, Default)]
pub enum Shown {
    /// All of the scene's own.
    #[default]
    All,
    /// These; merged ones count on after the scene's own.
    Some {
        /// Ascending.
        ids: Vec<u32>,
        /// The merged ones of the scene, where it has some.
        merged: Option<Arc<Merged>>,
    },
}

impl Shown {
    /// Those of the blocks that `frustum` shows.
    pub fn of(blocks: &Blocks, frustum: &Frustum) -> Self {
        let seen = blocks.shown(frustum);
        // Nearly all: to project the others costs less than a list.
        let nearly = seen.len() >= blocks.own - blocks.own / NEARLY;
        if nearly && seen.last().is_none_or(|&at| (at as usize) < blocks.own) {
            return Self::All;
        }
        Self::Some { ids: Self::ids_of(blocks, &seen), merged: blocks.merged.clone() }
    }

    /// The Gaussians of some blocks, ascending.
    pub(crate) fn ids_of(blocks: &Blocks, seen: &[u32]) -> Vec<u32> {
        if seen.is_empty() {
            return Vec::new();
        }
        // A bit for each Gaussian.
        let bits: Vec<AtomicU64> = (0..blocks.order.len().div_ceil(64))
            .into_par_iter()
            .with_min_len(1 << 14)
            .map(|_| AtomicU64::new(0))
            .collect();
        seen.par_iter().with_min_len(16).for_each(|&at| {
            // Neighbours share a word.
            for run in blocks.ids(at as usize).chunk_by(|a, b| a / 64 == b / 64) {
                let word = run.iter().fold(0, |word, id| word | 1 << (id % 64));
                bits[run[0] as usize / 64].fetch_or(word, Ordering::Relaxed);
            }
        });
        let count = |words: &[AtomicU64]| {
            words.iter().map(|word| word.load(Ordering::Relaxed).count_ones() as usize).sum()
        };
        let counts: Vec<usize> = bits.par_chunks(WORDS).map(count).collect();
        let mut ids = vec![0; counts.iter().sum()];
        let mut rest = &mut ids[..];
        let mut parts = Vec::with_capacity(counts.len());
        for count in counts {
            let (part, more) = rest.split_at_mut(count);
            parts.push(part);
            rest = more;
        }
        let chunks = parts.into_par_iter().zip(bits.par_chunks(WORDS)).enumerate();
        chunks.for_each(|(chunk, (part, words))| {
            let mut part = part.iter_mut();
            for (at, word) in (chunk * WORDS..).zip(words) {
                let mut word = word.load(Ordering::Relaxed);
                while word != 0 {
                    if let Some(id) = part.next() {
                        *id = at as u32 * 64 + word.trailing_zeros();
                    }
                    word &= word - 1;
                }
            }
        });
        ids
    }

    /// Number of them, in a scene of `count`.
    pub(super) fn len(&self, count: usize) -> usize {
        match self {
            Self::All => count,
            Self::Some { ids, .. } => ids.len(),
        }
    }

    /// The number of the one at place `at`.
    #[inline(always)]
    pub(super) fn id(&self, at: usize) -> usize {
        match self {
            Self::All => at,
            Self::Some { ids, .. } => ids[at] as usize,
        }
    }

    /// The merged ones, where one may be among these.
    #[inline(always)]
    pub(super) fn merged(&self) -> Option<&Merged> {
        match self {
            Self::All => None,
            Self::Some { merged, .. } => merged.as_deref(),
        }
    }

    /// The one at place `at`: the Gaussians of the scene or the merged ones, and its number there.
    #[inline(always)]
    pub(super) fn find<'a>(
        &'a self,
        gaussians: &'a Gaussians,
        at: usize,
    ) -> (&'a Gaussians, usize) {
        let id = self.id(at);
        match (self.merged(), id.checked_sub(gaussians.len())) {
            (Some(merged), Some(id)) => (&merged.gaussians, id),
            _ => (gaussians, id),
        }
    }

    /// Opacities that the one at place `at` stands for, in sum; 0 if it is of the scene.
    #[inline(always)]
    pub(super) fn sum(&self, gaussians: &Gaussians, at: usize) -> f64 {
        match (self.merged(), self.id(at).checked_sub(gaussians.len())) {
            (Some(merged), Some(id)) => f64::from(merged.sums[id]),
            _ => 0.0,
        }
    }

    /// Their entries of the bank.
    pub(crate) fn entries<'a>(&self, gaussians: &'a Gaussians) -> Cow<'a, [u16]> {
        let own = gaussians.semantic_index();
        let Self::Some { ids, merged } = self else { return Cow::Borrowed(own) };
        let merged = merged.as_ref().map(|merged| merged.entries(gaussians));
        let merged = merged.as_deref().unwrap_or_default();
        let entry = |&id: &u32| {
            let id = id as usize;
            own.get(id).copied().unwrap_or_else(|| merged[id - own.len()])
        };
        ids.par_iter().map(entry).collect::<Vec<_>>().into()
    }
}
