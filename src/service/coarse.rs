//! The coarser forms of the large scene that was read or changed last: who reads it does not wait
//! for them.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Weak},
    thread,
};

use parking_lot::{Condvar, Mutex};

use super::{memory::Memory, times::staged};
use crate::{
    error::{Error, ErrorCode, Result},
    formats::packed::CoarseForms,
    render::{blocks::BLOCKS_MIN, coarse::Coarse},
    scene::{Gaussians, Scene, SceneId},
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
        self.of_unless(scene, &|| Ok(()))
    }

    fn of_unless(
        &self,
        scene: &Scene,
        unless: &(dyn Fn() -> Result<()> + Sync),
    ) -> Result<Option<Arc<Coarse>>> {
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
        let (made, _ms) = staged("coarse", || Coarse::of_unless(gaussians, &first.camera, unless));
        let Some(coarse) = made?.map(Arc::new) else {
            return Ok(None);
        };
        let (life, coarse_held) = (gaussians.life(), Arc::clone(&coarse));
        *self.held.lock() = Some(Held { shape, life, coarse: coarse_held });
        Ok(Some(coarse))
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

/// The scene whose forms are made next, before anybody reads it: the one that changed last. One
/// thread makes them, those of one scene at a time. It leaves them where another scene, or the same
/// one, has changed meanwhile, and where the scene is gone.
#[derive(Debug, Default)]
pub(super) struct Foresight {
    next: Mutex<Next>,
    rung: Condvar,
}

#[derive(Debug, Default)]
struct Next {
    wanted: Option<SceneId>,
    making: Option<SceneId>,
    closed: bool,
}

impl Foresight {
    /// Starts the thread, which ends with [`Self::close`]. `load` gives a scene as it is served;
    /// `None` where it is gone, and where nobody serves it any more.
    ///
    /// # Errors
    /// `internal` when it cannot be started.
    pub(super) fn start(
        self: &Arc<Self>,
        coarse: Arc<LastCoarse>,
        memory: Arc<Memory>,
        load: impl Fn(&SceneId) -> Result<Option<Arc<Scene>>> + Send + 'static,
    ) -> Result<()> {
        let foresight = Arc::clone(self);
        let life = move || {
            while let Some(id) = foresight.take() {
                let made = AssertUnwindSafe(|| match load(&id)? {
                    Some(scene) => foresight.make(&coarse, &memory, &scene),
                    None => Ok(()),
                });
                let panicked = |_| Err(Error::internal("a panic"));
                match catch_unwind(made).unwrap_or_else(panicked) {
                    Err(error) if error.code() != ErrorCode::Cancelled => {
                        tracing::warn!(scene = %id, %error, "its first reader makes its forms");
                    }
                    _ => {}
                }
            }
        };
        let started = thread::Builder::new().name("forms".to_owned()).spawn(life);
        started.map(drop).map_err(|e| Error::internal("no thread can be started").caused_by(e))
    }

    /// A scene is done, or what is served of it is another one now.
    pub(super) fn want(&self, id: &SceneId) {
        self.next.lock().wanted = Some(id.clone());
        self.rung.notify_one();
    }

    /// A scene is gone.
    pub(super) fn forget(&self, id: &SceneId) {
        let Next { wanted, making, .. } = &mut *self.next.lock();
        for of in [wanted, making] {
            of.take_if(|of| of == id);
        }
    }

    pub(super) fn close(&self) {
        self.next.lock().closed = true;
        self.rung.notify_one();
    }

    /// Waits for the next scene.
    fn take(&self) -> Option<SceneId> {
        let mut next = self.next.lock();
        next.making = None;
        loop {
            if next.closed {
                return None;
            }
            if let Some(id) = next.wanted.take() {
                next.making = Some(id.clone());
                return Some(id);
            }
            self.rung.wait(&mut next);
        }
    }

    /// Fails with `cancelled` where the forms of this scene are not what is wanted now.
    fn unless_changed(&self, id: &SceneId) -> Result<()> {
        let next = self.next.lock();
        let goes_on = !next.closed && next.wanted.is_none() && next.making.as_ref() == Some(id);
        let why = || Error::new(ErrorCode::Cancelled, "another scene changed, or this one");
        if goes_on { Ok(()) } else { Err(why()) }
    }

    /// Makes the forms of a scene, where it is large and there is room.
    fn make(&self, coarse: &LastCoarse, memory: &Memory, scene: &Scene) -> Result<()> {
        if scene.gaussians.len() < BLOCKS_MIN {
            return Ok(());
        }
        let bytes = LastCoarse::bytes(&scene.gaussians);
        memory.admit(usize::try_from(bytes).unwrap_or(usize::MAX))?;
        coarse.of_unless(scene, &|| self.unless_changed(&scene.meta.id)).map(drop)
    }
}

/// The forms as a file takes them.
pub(super) fn forms_of<'a>(coarse: &'a Coarse, entries: &'a [u16]) -> CoarseForms<'a> {
    let Coarse { gaussians, ends, order } = coarse;
    CoarseForms { gaussians, entries, ends, order }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_ends_where_something_else_is_wanted_and_where_its_scene_goes() {
        let [one, other] = [1, 2].map(|byte| SceneId::from_bytes([byte; 16]));
        let foresight = Foresight::default();
        let begin = |id: &SceneId| {
            foresight.want(id);
            assert_eq!(foresight.take().as_ref(), Some(id));
            foresight.unless_changed(id).expect("it goes on");
        };
        begin(&one);
        foresight.forget(&other);
        foresight.unless_changed(&one).expect("another scene went");
        foresight.want(&one);
        foresight.unless_changed(&one).expect_err("it changed again");
        foresight.want(&other);
        assert_eq!(foresight.take().as_ref(), Some(&other), "the last alone waits");
        foresight.forget(&other);
        foresight.unless_changed(&other).expect_err("it is gone");
        foresight.want(&one);
        foresight.forget(&one);
        begin(&other);
        foresight.close();
        foresight.unless_changed(&other).expect_err("nobody wants it");
        assert_eq!(foresight.take(), None);
    }
}
