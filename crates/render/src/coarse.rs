//! Coarser forms of a whole scene, each in the order of the next one: a file that begins with
//! them is a picture of all of the scene at once, and becomes finer place by place while it is
//! read.
//!
//! The forms are layers of merged Gaussians ([`crate::merged`]). The coarsest has at most
//! [`FIRST_MAX`], those with the largest picture in one view first. The members of each are
//! together in the next form, in the same order: as soon as the members of the first n have
//! come, these n are no longer drawn.

use std::ops::Range;

use glam::DVec3;
use rayon::prelude::*;

use crate::{
    blocks::{BLOCKS_MIN, Blocks},
    error::Result,
    merged::{Merged, heaviest},
    scene::{Camera, Gaussians},
};

/// Most Gaussians of the coarsest form: 2 MiB of 32 bytes each.
pub const FIRST_MAX: usize = 1 << 16;
/// A form that is not the coarsest has at most one of so many of the scene's Gaussians.
const SHARE: usize = 4;

/// The coarser forms of a scene: about 12 bytes for each of its Gaussians.
#[derive(Debug)]
pub struct Coarse {
    /// The Gaussians of one form after the other, the coarsest form first. They have no entries.
    pub gaussians: Gaussians,
    /// Of each form and each of its Gaussians, where its members in the next form end; they begin
    /// where those of the one before it end. The next form of the finest one is
    /// [`Coarse::order`].
    pub ends: Vec<Vec<u32>>,
    /// `[N]` the scene's own Gaussians, in the order of the finest form.
    pub order: Vec<u32>,
}

impl Coarse {
    /// The forms of a scene for a file that is looked at from `camera` first. `None` for scenes of
    /// fewer than [`BLOCKS_MIN`] Gaussians.
    ///
    /// # Errors
    /// As [`Blocks::detailed`].
    pub fn of(own: &Gaussians, camera: &Camera) -> Result<Option<Self>> {
        Self::of_unless(own, camera, &|| Ok(()))
    }

    /// As [`Self::of`], until `unless` fails.
    ///
    /// # Errors
    /// As [`Blocks::detailed_unless`].
    pub fn of_unless(
        own: &Gaussians,
        camera: &Camera,
        unless: &(dyn Fn() -> Result<()> + Sync),
    ) -> Result<Option<Self>> {
        if own.len() < BLOCKS_MIN {
            return Ok(None);
        }
        let blocks = Blocks::detailed_unless(own, unless)?;
        let Some(merged) = blocks.merged else { return Ok(None) };
        let layers = Layers::of(own.len(), &merged);
        let chosen = layers.chosen(own.len());
        let Some(&first) = chosen.first() else { return Ok(None) };
        let mut order = layers.ids(first);
        largest_first(&mut order, &merged, own.len(), camera);
        let (mut ids, mut all) = (Vec::new(), Vec::new());
        for (at, &layer) in chosen.iter().enumerate() {
            ids.extend(order.iter().map(|&id| id - own.len() as u32));
            let down = layer - chosen.get(at + 1).copied().unwrap_or(0);
            let (mut below, mut ends) = (Vec::new(), Vec::with_capacity(order.len()));
            for &id in &order {
                members(id, down, own.len(), &merged, &mut below);
                ends.push(below.len() as u32);
            }
            all.push(ends);
            order = below;
        }
        Ok(Some(Self { gaussians: merged.gaussians.picked(&ids), ends: all, order }))
    }

    /// Entries of the bank, one for each of [`Self::gaussians`], where the scene has those of
    /// `own`: of what each stands for the one with the most opacity, the lower one of equals.
    pub fn entries(&self, own: &Gaussians) -> Vec<u16> {
        let row = |&id: &u32| (own.semantic_index()[id as usize], own.opacities()[id as usize]);
        let of = |form: usize, at: usize| {
            let rows: Vec<(u16, f32)> = self.order[self.own_of(form, at)].iter().map(row).collect();
            heaviest(rows)
        };
        let mut entries = Vec::with_capacity(self.gaussians.len());
        for (form, ends) in self.ends.iter().enumerate() {
            entries.par_extend((0..ends.len()).into_par_iter().map(|at| of(form, at)));
        }
        entries
    }

    /// Where in [`Self::order`] those begin and end that Gaussian `at` of a form stands for.
    pub fn own_of(&self, form: usize, at: usize) -> Range<usize> {
        let down = |end: usize| {
            let below = |end: usize, ends: &Vec<u32>| {
                end.checked_sub(1).map_or(0, |last| ends[last] as usize)
            };
            self.ends[form..].iter().fold(end, below)
        };
        down(at)..down(at + 1)
    }
}

/// Appends those that `id` stands for, so many layers below it.
fn members(id: u32, down: usize, own: usize, merged: &Merged, to: &mut Vec<u32>) {
    if down == 0 {
        return to.push(id);
    }
    for &member in merged.group(id as usize - own) {
        members(member, down - 1, own, merged, to);
    }
}

/// By the area on the picture of `camera`, behind it by the distance alone.
fn largest_first(ids: &mut [u32], merged: &Merged, own: usize, camera: &Camera) {
    let gaussians = &merged.gaussians;
    let center = camera.camera_to_world.center() - gaussians.origin();
    let axis = camera.camera_to_world.rotation().z_axis;
    let area = |id: u32| {
        let i = id as usize - own;
        let from = DVec3::from(gaussians.means()[i].map(f64::from)) - center;
        let [a, b, c] = gaussians.scales()[i].map(f64::from);
        let faces = (a * b).max(b * c).max(a * c);
        let behind = if axis.dot(from) > 0.0 { 1.0 } else { 0.1 };
        behind * faces / from.length_squared().max(f64::MIN_POSITIVE)
    };
    let mut keyed: Vec<(f64, u32)> = ids.iter().map(|&id| (area(id), id)).collect();
    keyed.sort_by(|a, b| b.0.total_cmp(&a.0).then(a.1.cmp(&b.1)));
    ids.iter_mut().zip(keyed).for_each(|(id, key)| *id = key.1);
}

/// Where the layers of merged Gaussians begin: layer 1 stands for the scene's own.
struct Layers {
    /// The first number of layer 1, of layer 2, and so on; then the end.
    starts: Vec<u32>,
}

impl Layers {
    fn of(own: usize, merged: &Merged) -> Self {
        let mut starts = vec![own as u32];
        for at in 0..merged.sums.len() {
            // The first that stands for one of the layer which began last.
            if merged.group(at)[0] >= starts[starts.len() - 1] {
                starts.push((own + at) as u32);
            }
        }
        starts.push((own + merged.sums.len()) as u32);
        Self { starts }
    }

    fn len(&self, layer: usize) -> usize {
        (self.starts[layer] - self.starts[layer - 1]) as usize
    }

    fn ids(&self, layer: usize) -> Vec<u32> {
        (self.starts[layer - 1]..self.starts[layer]).collect()
    }

    /// The layers that are forms, the coarsest first.
    fn chosen(&self, own: usize) -> Vec<usize> {
        let count = self.starts.len() - 1;
        let first = (1..=count).find(|&layer| self.len(layer) <= FIRST_MAX.min(own / SHARE));
        let Some(first) = first else { return Vec::new() };
        (1..=first).rev().filter(|&layer| self.len(layer) <= own / SHARE).collect()
    }
}
