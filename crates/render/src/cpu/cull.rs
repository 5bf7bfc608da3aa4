//! Stage 0: which Gaussians are projected. Shader: `shaders/cull.wgsl`
//!
//! In: the blocks of the scene. Out: the Gaussians of the blocks that the view may show, in the
//! order of the scene. Every later stage counts in this list, so its numbers have the same order as
//! those of the scene: ties at equal depth stay.

use std::{
    borrow::Cow,
    sync::atomic::{AtomicU64, Ordering},
};

use rayon::prelude::*;

use crate::blocks::{Blocks, Frustum};

/// Words of the set of Gaussians that a thread reads at a time.
const WORDS: usize = 1 << 10;

/// The Gaussians of a view, in the order of the scene.
#[derive(Debug, Default)]
pub enum Shown {
    /// All of them.
    #[default]
    All,
    /// These.
    Some(Vec<u32>),
}

impl Shown {
    /// Those of the blocks that `frustum` may show.
    pub fn of(blocks: &Blocks, frustum: &Frustum) -> Self {
        let bounds = blocks.bounds.par_iter().with_min_len(1 << 9).enumerate();
        let seen = bounds.filter(|(_, bounds)| frustum.may_show(bounds)).map(|(at, _)| at);
        let seen: Vec<usize> = seen.collect();
        if seen.len() == blocks.bounds.len() {
            return Self::All;
        }
        if seen.is_empty() {
            return Self::Some(Vec::new());
        }
        // A bit for each Gaussian.
        let bits: Vec<AtomicU64> = (0..blocks.order.len().div_ceil(64))
            .into_par_iter()
            .with_min_len(1 << 14)
            .map(|_| AtomicU64::new(0))
            .collect();
        seen.par_iter().with_min_len(16).for_each(|&at| {
            // Neighbours share a word.
            for run in blocks.ids(at).chunk_by(|a, b| a / 64 == b / 64) {
                let word = run.iter().fold(0, |word, id| word | 1 << (id % 64));
                bits[run[0] as usize / 64].fetch_or(word, Ordering::Relaxed);
            }
        });
        let ids = bits.par_chunks(WORDS).enumerate().map(|(chunk, words)| {
            let mut ids = Vec::new();
            for (at, word) in (chunk * WORDS..).zip(words) {
                let mut word = word.load(Ordering::Relaxed);
                while word != 0 {
                    ids.push(at as u32 * 64 + word.trailing_zeros());
                    word &= word - 1;
                }
            }
            ids
        });
        let parts: Vec<Vec<u32>> = ids.collect();
        Self::Some(parts.concat())
    }

    /// Number of them, in a scene of `count`.
    pub(super) fn len(&self, count: usize) -> usize {
        match self {
            Self::All => count,
            Self::Some(ids) => ids.len(),
        }
    }

    /// The Gaussian at place `at`.
    #[inline(always)]
    pub(super) fn id(&self, at: usize) -> usize {
        match self {
            Self::All => at,
            Self::Some(ids) => ids[at] as usize,
        }
    }

    /// The numbers of these out of those of all.
    pub(super) fn only<'a, T: Copy + Send + Sync>(&self, all: &'a [T]) -> Cow<'a, [T]> {
        match self {
            Self::All => Cow::Borrowed(all),
            Self::Some(ids) => {
                ids.par_iter().map(|&id| all[id as usize]).collect::<Vec<_>>().into()
            }
        }
    }
}
