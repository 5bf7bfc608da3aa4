//! The coarser forms of the large scene that was read last: who reads it again does not wait for
//! them.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Weak},
};

use parking_lot::Mutex;

use super::{memory::Memory, times::staged};
use crate::{
    error::{Error, Result},
    formats::packed::CoarseForms,
    render::{blocks::BLOCKS_MIN, coarse::Coarse},
    scene::{Gaussians, Scene},
};

/// Bytes a Gaussian that the forms take while they are made, at most: of a scene of points 51.
const BYTES_EACH: u64 = 64;

/// The forms of one scene, as long as its Gaussians live.
#[derive(Debug, Default)]
pub(super) struct LastCoarse {
    held: Mutex<Option<Held>>,
    /// Held while forms are made: who wants the same waits for them.
    making: Mutex<()>,
}

#[derive(Debug)]
struct Held {
    /// [`Gaussians::shape_identity`].
    shape: u64,
    life: Weak<()>,
    coarse: Arc<Coarse>,
}

impl LastCoarse {
    /// Those of a scene, for who looks from its first camera; made now if it was not the last, and
    /// waited for while others make them. `None` where it has none.
    ///
    /// # Errors
    /// As [`Coarse::of`].
    pub(super) fn of(&self, scene: &Scene) -> Result<Option<Arc<Coarse>>> {
        let (gaussians, shape) = (&scene.gaussians, scene.gaussians.shape_identity());
        let Some(first) = scene.meta.cameras.first() else { return Ok(None) };
        if let Some(found) = self.found(gaussians) {
            return Ok(Some(found));
        }
        let _making = self.making.lock();
        if let Some(found) = self.found(gaussians) {
            return Ok(Some(found));
        }
        // Those of another scene go before there are two.
        *self.held.lock() = None;
        let (made, _ms) = staged("coarse", || Coarse::of(gaussians, &first.camera));
        let Some(coarse) = made?.map(Arc::new) else {
            return Ok(None);
        };
        let (life, coarse_held) = (gaussians.life(), Arc::clone(&coarse));
        *self.held.lock() = Some(Held { shape, life, coarse: coarse_held });
        Ok(Some(coarse))
    }

    /// Makes those of a scene that is done, before anybody reads it, where there is room.
    pub(super) fn foresee(&self, scene: &Scene, memory: &Memory) {
        if scene.gaussians.len() < BLOCKS_MIN {
            return;
        }
        let bytes = usize::try_from(Self::bytes(&scene.gaussians)).unwrap_or(usize::MAX);
        let made = AssertUnwindSafe(|| memory.admit(bytes).and_then(|()| self.of(scene)));
        let panicked = |_| Err(Error::internal("a panic"));
        if let Err(error) = catch_unwind(made).unwrap_or_else(panicked) {
            tracing::warn!(scene = %scene.meta.id, %error, "its first reader makes its forms");
        }
    }

    /// Those of the last scene, where these are its Gaussians.
    fn found(&self, gaussians: &Gaussians) -> Option<Arc<Coarse>> {
        let mut held = self.held.lock();
        held.take_if(|held| held.life.strong_count() == 0);
        let held = held.as_mut().filter(|held| held.shape == gaussians.shape_identity())?;
        held.life = gaussians.life();
        Some(Arc::clone(&held.coarse))
    }

    /// Bytes that [`Self::of`] takes, at most.
    pub(super) fn bytes(gaussians: &Gaussians) -> u64 {
        BYTES_EACH * gaussians.len() as u64
    }
}

/// The forms as a file takes them.
pub(super) fn forms_of<'a>(coarse: &'a Coarse, entries: &'a [u16]) -> CoarseForms<'a> {
    let Coarse { gaussians, ends, order } = coarse;
    CoarseForms { gaussians, entries, ends, order }
}
