//! The housekeeper: sweeps the store at the start and now and then.

use std::{sync::PoisonError, time::Duration};

use super::Shared;

impl Shared {
    /// The life of the housekeeper's thread.
    pub(super) fn keep_house(&self) {
        // By then no job of a deleted scene can still be at work, on any replica.
        let buried = Duration::from_millis(self.limits.scene_timeout_ms.saturating_mul(2))
            + Duration::from_millis(self.limits.replica_lease_ms);
        loop {
            match self.store.sweep(buried) {
                Ok(0) => {}
                Ok(removed) => tracing::info!(removed, "left-overs removed from the store"),
                Err(error) => tracing::warn!(%error, "the store cannot be swept"),
            }
            if self.rest(Duration::from_millis(self.limits.sweep_every_ms.max(1_000))) {
                return;
            }
        }
    }

    /// Waits; whether the program stops.
    pub(super) fn rest(&self, time: Duration) -> bool {
        let stopping = self.stopping.lock().unwrap_or_else(PoisonError::into_inner);
        let (stopping, _) = self
            .stopped
            .wait_timeout_while(stopping, time, |stopping| !*stopping)
            .unwrap_or_else(PoisonError::into_inner);
        *stopping
    }

    pub(super) fn end_rest(&self) {
        *self.stopping.lock().unwrap_or_else(PoisonError::into_inner) = true;
        self.stopped.notify_all();
    }
}
