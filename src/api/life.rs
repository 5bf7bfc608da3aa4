//! The end of the server's life: who is still inside, and since when nobody new is let in.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::Duration,
};

use tokio::sync::{Notify, watch};

use crate::{
    error::{Error, ErrorCode, Result},
    telemetry::meter,
};

/// When a caller who was turned away may come back, seconds: to the next server, not this one.
const RETRY_AFTER_S: u32 = 1;

/// Calls inside, and whether the server is stopping. Cloning shares everything.
#[derive(Clone, Debug, Default)]
pub(super) struct Life(Arc<State>);

#[derive(Debug, Default)]
struct State {
    inside: AtomicUsize,
    unready: watch::Sender<bool>,
    draining: AtomicBool,
    left: Notify,
}

/// One call, from the door to the last byte of its answer.
#[derive(Debug)]
pub(super) struct Inside(Life);

impl Drop for Inside {
    fn drop(&mut self) {
        self.0.0.inside.fetch_sub(1, Ordering::AcqRel);
        meter::inflight(-1.0);
        self.0.0.left.notify_waiters();
    }
}

impl Life {
    /// Counts a call in, unless the server is stopping.
    pub(super) fn enter(&self) -> Result<Inside> {
        // Counted first, so that a drain that begins between the two lines waits for it.
        self.0.inside.fetch_add(1, Ordering::AcqRel);
        meter::inflight(1.0);
        let inside = Inside(self.clone());
        if self.is_draining() {
            return Err(Error::new(ErrorCode::Stopping, "the server is stopping; call again")
                .retry_after_s(RETRY_AFTER_S));
        }
        Ok(inside)
    }

    /// Calls inside.
    pub(super) fn inside(&self) -> usize {
        self.0.inside.load(Ordering::Acquire)
    }

    /// Whether the server is on its way out, be it that it still lets callers in.
    pub(super) fn is_ending(&self) -> bool {
        *self.0.unready.borrow()
    }

    /// Resolves when the server begins to end.
    pub(super) async fn ending(&self) {
        // The sender lives as long as `self`.
        let _ = self.0.unready.subscribe().wait_for(|&unready| unready).await;
    }

    /// Tells load balancers to look elsewhere from now on.
    pub(super) fn stop_being_ready(&self) {
        self.0.unready.send_replace(true);
    }

    /// Whether new calls are turned away.
    pub(super) fn is_draining(&self) -> bool {
        self.0.draining.load(Ordering::Acquire)
    }

    /// Turns new calls away from now on.
    pub(super) fn drain(&self) {
        self.0.draining.store(true, Ordering::Release);
    }

    /// Resolves when nobody is inside, `at_most` later in any case; whether all had left.
    pub(super) async fn empty(&self, at_most: Duration) -> bool {
        let all_left = async {
            loop {
                let left = self.0.left.notified();
                tokio::pin!(left);
                // Listens before it looks, so that nobody leaves unseen.
                left.as_mut().enable();
                if self.inside() == 0 {
                    return;
                }
                left.await;
            }
        };
        tokio::time::timeout(at_most, all_left).await.is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_drain_waits_for_those_inside_and_lets_nobody_in() {
        let life = Life::default();
        let inside = life.enter().unwrap();
        life.drain();
        let refused = life.enter().unwrap_err();
        assert_eq!((refused.code(), refused.retry_after()), (ErrorCode::Stopping, Some(1)));
        assert_eq!(life.inside(), 1, "the refused one is not counted");
        assert!(!life.empty(Duration::from_millis(5)).await, "one is inside");
        let other = life.clone();
        let waiting = tokio::spawn(async move { other.empty(Duration::from_secs(60)).await });
        tokio::task::yield_now().await;
        drop(inside);
        assert!(waiting.await.unwrap());
    }
}
