//! Who may render now: a few at work, a bounded number waiting, the rest told to come back.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

use tokio::sync::{OwnedSemaphorePermit, Semaphore};

use crate::error::{Error, ErrorCode, Result};

/// Bounds renders at work and waiting.
#[derive(Debug)]
pub(super) struct Gate {
    at_work: Arc<Semaphore>,
    inside: Arc<AtomicUsize>,
    inside_max: usize,
}

/// Counts one caller, from the door to the end of its render.
#[derive(Debug)]
struct Counted(Arc<AtomicUsize>);

impl Drop for Counted {
    fn drop(&mut self) {
        self.0.fetch_sub(1, Ordering::AcqRel);
    }
}

/// Leave to render; ends when dropped.
#[derive(Debug)]
pub(super) struct Pass {
    _permit: OwnedSemaphorePermit,
    _counted: Counted,
}

impl Gate {
    pub(super) fn new(at_work_max: usize, inside_max: usize) -> Self {
        Self { at_work: Arc::new(Semaphore::new(at_work_max)), inside: Arc::default(), inside_max }
    }

    pub(super) fn inside(&self) -> usize {
        self.inside.load(Ordering::Acquire)
    }

    /// Waits for a turn. A caller who goes away gives its place back.
    pub(super) async fn enter(&self) -> Result<Pass> {
        let before = self.inside.fetch_add(1, Ordering::AcqRel);
        let counted = Counted(Arc::clone(&self.inside));
        if before >= self.inside_max {
            return Err(Error::new(
                ErrorCode::Overloaded,
                format!("{} renders wait already, the most that may", self.inside_max),
            )
            .retry_after_s(1));
        }
        let permit = Arc::clone(&self.at_work)
            .acquire_owned()
            .await
            .map_err(|closed| Error::internal("the render gate is closed").caused_by(closed))?;
        Ok(Pass { _permit: permit, _counted: counted })
    }
}

#[cfg(test)]
mod tests {
    use futures_util::FutureExt;

    use super::*;

    #[tokio::test]
    async fn the_one_too_many_is_told_to_come_back_and_places_return() {
        let gate = Gate::new(1, 2);
        let first = gate.enter().await.unwrap();
        let mut second = Box::pin(gate.enter());
        assert!(second.as_mut().now_or_never().is_none(), "one at a time");
        let third = gate.enter().await.unwrap_err();
        assert_eq!((third.code(), third.retry_after()), (ErrorCode::Overloaded, Some(1)));
        assert_eq!(gate.inside(), 2, "the refused one is not counted");
        drop(second);
        assert_eq!(gate.inside(), 1, "who goes away while waiting gives the place back");
        drop(first);
        let _again = gate.enter().await.unwrap();
        assert_eq!(gate.inside(), 1);
    }
}
