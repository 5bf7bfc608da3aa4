//! The end of the server: which calls are open, whether it is ready, whether it takes new calls.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::Duration,
};

use tokio::sync::watch;

use crate::{
    error::{Error, ErrorCode, Result},
    telemetry::meter,
};

/// When a refused caller may call again, in seconds: another server will answer.
const RETRY_AFTER_S: u32 = 1;

/// The open calls, and how far the stop of the server is. Cloning shares everything.
#[derive(Clone, Debug, Default)]
pub(super) struct Drain(Arc<State>);

#[derive(Debug, Default)]
struct State {
    open_calls: watch::Sender<usize>,
    stopping: watch::Sender<bool>,
    refusing: AtomicBool,
    refused: AtomicUsize,
}

/// One call, until the last byte of its answer is sent.
#[derive(Debug)]
pub(super) struct OpenCall(Drain);

impl Drop for OpenCall {
    fn drop(&mut self) {
        self.0.0.open_calls.send_modify(|calls| *calls -= 1);
        meter::inflight(-1.0);
    }
}

impl Drain {
    /// Counts a call, unless the server refuses new calls.
    pub(super) fn open_call(&self) -> Result<OpenCall> {
        // Counted before the check, so that a drain that begins in between waits for this call.
        self.0.open_calls.send_modify(|calls| *calls += 1);
        meter::inflight(1.0);
        let call = OpenCall(self.clone());
        if self.0.refusing.load(Ordering::Acquire) {
            self.0.refused.fetch_add(1, Ordering::Relaxed);
            return Err(Error::new(ErrorCode::Stopping, "the server is stopping; call again")
                .retry_after_s(RETRY_AFTER_S));
        }
        Ok(call)
    }

    /// Calls that were refused.
    pub(super) fn refused(&self) -> usize {
        self.0.refused.load(Ordering::Relaxed)
    }

    pub(super) fn open_calls(&self) -> usize {
        *self.0.open_calls.borrow()
    }

    /// Whether the server has begun to stop; it may still take new calls.
    pub(super) fn is_stopping(&self) -> bool {
        *self.0.stopping.borrow()
    }

    /// Resolves when the server begins to stop.
    pub(super) async fn stopping(&self) {
        // The sender lives as long as `self`.
        let _ = self.0.stopping.subscribe().wait_for(|&stopping| stopping).await;
    }

    /// From now on the server says that it is not ready.
    pub(super) fn begin(&self) {
        self.0.stopping.send_replace(true);
    }

    /// From now on new calls are refused.
    pub(super) fn refuse_calls(&self) {
        self.0.refusing.store(true, Ordering::Release);
    }

    /// Waits until no call is open, but not longer than `max`; whether all calls have ended.
    pub(super) async fn wait_for_calls(&self, max: Duration) -> bool {
        let mut open_calls = self.0.open_calls.subscribe();
        tokio::time::timeout(max, open_calls.wait_for(|&calls| calls == 0)).await.is_ok()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn a_drain_waits_for_open_calls_and_refuses_new_ones() {
        let drain = Drain::default();
        let call = drain.open_call().unwrap();
        drain.refuse_calls();
        let refused = drain.open_call().unwrap_err();
        assert_eq!((refused.code(), refused.retry_after()), (ErrorCode::Stopping, Some(1)));
        assert_eq!(drain.open_calls(), 1, "the refused call is not counted");
        assert!(!drain.wait_for_calls(Duration::from_millis(5)).await, "one call is open");
        let other = drain.clone();
        let waiting =
            tokio::spawn(async move { other.wait_for_calls(Duration::from_secs(60)).await });
        tokio::task::yield_now().await;
        drop(call);
        assert!(waiting.await.unwrap());
    }
}
