//! The coarser forms of the large scene that was read last: who reads it again does not wait for
//! them.

use std::sync::{Arc, Weak};

use parking_lot::Mutex;

use crate::{
    error::Result,
    formats::packed::CoarseForms,
    render::coarse::Coarse,
    scene::{Gaussians, Scene},
};

/// Bytes a Gaussian that the forms take while they are made, at most: of a scene of points 51.
const BYTES_EACH: u64 = 64;

/// The forms of one scene, as long as its Gaussians live.
#[derive(Debug, Default)]
pub(super) struct LastCoarse(Mutex<Option<Held>>);

#[derive(Debug)]
struct Held {
    /// [`Gaussians::shape_identity`].
    shape: u64,
    life: Weak<()>,
    coarse: Arc<Coarse>,
}

impl LastCoarse {
    /// Those of a scene, for who looks from its first camera; made now if it was not the last.
    /// `None` where it has none.
    ///
    /// # Errors
    /// As [`Coarse::of`].
    pub(super) fn of(&self, scene: &Scene) -> Result<Option<Arc<Coarse>>> {
        let (gaussians, shape) = (&scene.gaussians, scene.gaussians.shape_identity());
        let Some(first) = scene.meta.cameras.first() else { return Ok(None) };
        {
            let mut held = self.0.lock();
            held.take_if(|held| held.life.strong_count() == 0);
            if let Some(held) = held.as_mut().filter(|held| held.shape == shape) {
                held.life = gaussians.life();
                return Ok(Some(Arc::clone(&held.coarse)));
            }
        }
        let Some(coarse) = Coarse::of(gaussians, &first.camera)?.map(Arc::new) else {
            return Ok(None);
        };
        let (life, coarse_held) = (gaussians.life(), Arc::clone(&coarse));
        *self.0.lock() = Some(Held { shape, life, coarse: coarse_held });
        Ok(Some(coarse))
    }

    /// Bytes that [`Self::of`] takes, at most.
    pub(super) fn bytes(gaussians: &Gaussians) -> u64 {
        BYTES_EACH * gaussians.len() as u64
    }
}

/// The forms as a file takes them.
pub(super) fn forms<'a>(coarse: &'a Coarse, entries: &'a [u16]) -> CoarseForms<'a> {
    let Coarse { gaussians, ends, order } = coarse;
    CoarseForms { gaussians, entries, ends, order }
}
