//! The heavy work of a call: on a blocking thread, when the renderer has a place for it, within its
//! deadline. Work whose caller has gone or whose deadline is over stops at its next step.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use tracing::Instrument;

use super::{
    request::ViewOptions,
    schedule::{Demand, Slot},
    shared::Shared,
    tasks::blocking,
    times::ms,
};
use crate::{
    error::{Error, ErrorCode, Result},
    scene::unless_cancelled,
    telemetry::meter,
};

/// What a piece of work knows of its call.
#[derive(Debug, Default)]
pub(super) struct Work {
    /// Its place at the renderer; none for scenes that lie in files, where nobody else draws.
    slot: Option<Slot>,
    stopped: Arc<AtomicBool>,
    /// Milliseconds until it had a place and a thread.
    pub(super) queue_ms: f64,
}

impl Work {
    /// Work whose caller has gone.
    #[cfg(test)]
    pub(super) fn stopped() -> Self {
        Self { stopped: Arc::new(true.into()), ..Self::default() }
    }

    /// Fails with `cancelled` where nobody waits for the work any more.
    pub(super) fn unless_stopped(&self) -> Result<()> {
        unless_cancelled(&self.stopped)
    }

    /// Says that the renderer is not needed any more: the next view is drawn while this one is
    /// scored and encoded.
    pub(super) fn leave_renderer(&mut self) {
        if let Some(slot) = &mut self.slot {
            slot.leave_renderer();
        }
    }
}

/// Stops the work when the call that waits for it ends.
struct StopOnDrop(Arc<AtomicBool>);

impl Drop for StopOnDrop {
    fn drop(&mut self) {
        self.0.store(true, Ordering::Relaxed);
    }
}

impl Shared {
    /// Runs `work` on a blocking thread within the deadline. `what` names it in the error.
    pub(super) async fn in_time<T: Send + 'static>(
        &self,
        deadline: Instant,
        what: &str,
        work: impl FnOnce(&mut Work) -> Result<T> + Send + 'static,
    ) -> Result<T> {
        in_time(deadline, what, run(None, Instant::now(), work)).await
    }

    /// Runs `work` as soon as the renderer has a place for what it demands.
    pub(super) async fn scheduled<T: Send + 'static>(
        &self,
        demand: Demand,
        deadline: Instant,
        what: &str,
        work: impl FnOnce(&mut Work) -> Result<T> + Send + 'static,
    ) -> Result<T> {
        let called = Instant::now();
        let limits = self.limits();
        let work = async {
            let span = tracing::info_span!("stage", stage = "queue");
            let slot = self.scheduler.enter(demand, &limits).instrument(span).await?;
            run(Some(slot), called, move |on: &mut Work| {
                meter::stage("queue", on.queue_ms / 1e3);
                work(on)
            })
            .await
        };
        in_time(deadline, what, work).await
    }

    /// When a view must be there.
    pub(super) fn deadline(&self, options: &ViewOptions) -> Instant {
        until(options.deadline, self.limits().render_timeout_ms)
    }
}

async fn run<T: Send + 'static>(
    slot: Option<Slot>,
    called: Instant,
    work: impl FnOnce(&mut Work) -> Result<T> + Send + 'static,
) -> Result<T> {
    let stopped = Arc::new(AtomicBool::new(false));
    let _stop = StopOnDrop(Arc::clone(&stopped));
    let mut on = Work { slot, stopped, queue_ms: 0.0 };
    let work = move || {
        on.queue_ms = ms(called);
        on.unless_stopped()?;
        work(&mut on)
    };
    blocking(work).await?
}

/// What `work` gives within the deadline; `what` names it in the error.
async fn in_time<T>(
    deadline: Instant,
    what: &str,
    work: impl Future<Output = Result<T>>,
) -> Result<T> {
    let started = Instant::now();
    let late = || {
        let ms = started.elapsed().as_millis();
        Error::new(ErrorCode::DeadlineExceeded, format!("{what} was not ready after {ms} ms"))
    };
    if deadline <= started {
        return Err(late());
    }
    tokio::time::timeout_at(deadline.into(), work).await.map_err(|_elapsed| late())?
}

/// The caller's deadline, at most `most_ms` from now.
pub(super) fn until(deadline: Option<Duration>, most_ms: u64) -> Instant {
    let most = Duration::from_millis(most_ms);
    Instant::now() + deadline.map_or(most, |deadline| deadline.min(most))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[tokio::test]
    async fn work_past_its_deadline_is_told_to_stop() {
        let (told, stopped) = std::sync::mpsc::channel();
        let work = run(None, Instant::now(), move |on: &mut Work| {
            let begun = Instant::now();
            while on.unless_stopped().is_ok() && begun.elapsed() < Duration::from_secs(60) {
                std::thread::sleep(Duration::from_millis(1));
            }
            told.send(on.unless_stopped().map_err(|e| e.code())).expect("somebody listens");
            Ok(())
        });
        let deadline = Instant::now() + Duration::from_millis(20);
        let late = in_time(deadline, "the work", work).await.unwrap_err();
        assert_eq!(late.code(), ErrorCode::DeadlineExceeded);
        assert_eq!(blocking(move || stopped.recv()).await.unwrap(), Ok(Err(ErrorCode::Cancelled)));
    }
}
