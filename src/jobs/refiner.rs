//! What refines scenes: the device on which views are drawn, or threads of low priority.

use std::{sync::Arc, time::Duration};

use super::background::background_threads;
use crate::{
    error::Result,
    limits::Limits,
    refine::HOLDS_OUT_FROM,
    render::{DifferentiableRenderer, cpu::CpuRenderer},
    scene::Refine,
};

/// Processor time that `auto` takes, and the least and most milliseconds of it.
const AUTO_CPU_MS: u64 = 120_000;
const AUTO_MS: [u64; 2] = [10_000, 60_000];
/// Threads that it has on the processor at least, where there are so many.
const THREADS_MIN: usize = 2;

/// How a refinement lets views go first. A step takes a millisecond of a device, and a tenth of a
/// second of a processor, which a view then has to share.
#[derive(Clone, Copy, Debug)]
pub(super) struct Manners {
    /// Time without views after which it goes on.
    quiet: Duration,
    /// Where views never end it goes on after so many times the time that it worked, or so long.
    waits: u32,
    patience: Duration,
}

const ON_A_DEVICE: Manners =
    Manners { quiet: Duration::from_millis(250), waits: 3, patience: Duration::from_secs(1) };
const ON_A_PROCESSOR: Manners =
    Manners { quiet: Duration::from_secs(1), waits: 20, patience: Duration::from_secs(3) };

impl Manners {
    /// How much longer views go first: the last was drawn some time ago, and the refinement waits
    /// since it `worked` so long.
    pub(super) fn views_go_first(
        &self,
        last_view: Option<Duration>,
        worked: Duration,
        waited: Duration,
    ) -> Duration {
        let quiet = last_view.map_or(Duration::ZERO, |ago| self.quiet.saturating_sub(ago));
        quiet.min((worked * self.waits).min(self.patience).saturating_sub(waited))
    }
}

/// What refines scenes, and where.
pub(crate) struct Refiner {
    renderer: Arc<dyn DifferentiableRenderer>,
    /// Its threads where no device does the work: others always go first.
    threads: Option<Arc<rayon::ThreadPool>>,
    /// Those of the whole process.
    cores: usize,
}

impl Refiner {
    /// On the device where views are drawn on one that can; else on a share of so many `threads`
    /// ([`Limits::refine_threads_percent`]).
    ///
    /// # Errors
    /// `internal` when threads cannot be started.
    pub(crate) fn new(
        device: Option<Arc<dyn DifferentiableRenderer>>,
        threads: usize,
        limits: &Limits,
    ) -> Result<Self> {
        if let Some(renderer) = device {
            return Ok(Self { renderer, threads: None, cores: threads });
        }
        let cores = threads.max(1);
        let share = (cores * limits.refine_threads_percent as usize).div_ceil(100);
        let threads = background_threads(share.clamp(THREADS_MIN.min(cores), cores))?;
        let renderer = CpuRenderer::on(Arc::clone(&threads));
        Ok(Self { renderer: Arc::new(renderer), threads: Some(threads), cores })
    }

    /// Does `work` where it is to be done, with what draws there.
    pub(crate) fn run<T: Send>(
        &self,
        work: impl FnOnce(&dyn DifferentiableRenderer) -> T + Send,
    ) -> T {
        let work = || work(&*self.renderer);
        match &self.threads {
            Some(threads) => {
                let span = tracing::Span::current();
                threads.install(|| span.in_scope(work))
            }
            None => work(),
        }
    }

    /// How it lets views go first.
    pub(super) fn manners(&self) -> Manners {
        if self.threads.is_some() { ON_A_PROCESSOR } else { ON_A_DEVICE }
    }

    /// Milliseconds that a scene of so many photos is to be refined for; `None`: not at all.
    pub(crate) fn budget_ms(&self, refine: Refine, photos: usize) -> Option<u64> {
        let own = self.threads.as_ref().map(|threads| threads.current_num_threads());
        budget_ms(refine, photos, own.unwrap_or(self.cores))
    }
}

/// [`Refiner::budget_ms`] on so many threads.
fn budget_ms(refine: Refine, photos: usize, threads: usize) -> Option<u64> {
    match refine {
        Refine::Off => None,
        Refine::Ms(ms) => Some(ms),
        // With fewer photos none is held out, and nothing tells whether it helps.
        Refine::Auto if photos < HOLDS_OUT_FROM => None,
        Refine::Auto => Some((AUTO_CPU_MS / threads.max(1) as u64).clamp(AUTO_MS[0], AUTO_MS[1])),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn auto_takes_what_the_machine_has_and_leaves_few_photos_alone() {
        let auto = |photos, threads| budget_ms(Refine::Auto, photos, threads);
        assert_eq!([auto(4, 2), auto(5, 2), auto(5, 1)], [None, Some(60_000), Some(60_000)]);
        assert_eq!([auto(64, 8), auto(64, 64)], [Some(15_000), Some(10_000)]);
        assert_eq!(budget_ms(Refine::Off, 9, 2), None);
        assert_eq!(budget_ms(Refine::Ms(7), 2, 2), Some(7));
    }

    #[test]
    fn it_has_a_share_of_the_threads_and_two_where_there_are_two() {
        let threads = |all: usize, refine_threads_percent: u32| {
            let limits = Limits { refine_threads_percent, ..Limits::default() };
            let refiner = Refiner::new(None, all, &limits).expect("threads");
            refiner.run(|_| rayon::current_num_threads())
        };
        assert_eq!([threads(1, 50), threads(2, 50), threads(7, 50)], [1, 2, 4]);
        assert_eq!([threads(4, 0), threads(4, 100), threads(4, 900)], [2, 4, 4]);
    }

    #[test]
    fn views_without_end_leave_a_share_of_the_time() {
        let ms = Duration::from_millis;
        let left = |manners: Manners, last_view: Option<u64>, worked, waited| {
            manners.views_go_first(last_view.map(ms), ms(worked), ms(waited)).as_millis()
        };
        let gpu = |last_view, worked, waited| left(ON_A_DEVICE, last_view, worked, waited);
        assert_eq!(gpu(None, 100, 0), 0, "nobody looks");
        assert_eq!([gpu(Some(250), 100, 0), gpu(Some(240), 100, 0)], [0, 10], "a quiet moment");
        assert_eq!([gpu(Some(0), 1, 0), gpu(Some(0), 1, 2), gpu(Some(0), 1, 3)], [3, 1, 0]);
        assert_eq!([gpu(Some(0), 5_000, 900), gpu(Some(0), 5_000, 1_000)], [100, 0]);
        let cpu = |last_view, worked, waited| left(ON_A_PROCESSOR, last_view, worked, waited);
        assert_eq!([cpu(Some(900), 100, 0), cpu(Some(0), 10, 199)], [100, 1]);
        assert_eq!(cpu(Some(0), 900, 2_000), 1_000);
    }
}
