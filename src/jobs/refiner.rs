//! What refines scenes: the device on which views are drawn, or threads of low priority.

use std::sync::Arc;

use super::background::background_threads;
use crate::{
    error::Result,
    limits::Limits,
    refine::HOLDS_OUT_FROM,
    render::{DifferentiableRenderer, Switches, cpu::CpuRenderer},
    scene::Refine,
};

/// Processor time that `auto` takes, and the least and most milliseconds of it.
const AUTO_CPU_MS: u64 = 120_000;
const AUTO_MS: [u64; 2] = [10_000, 60_000];
/// Threads that it has on the processor at least, where there are so many.
const THREADS_MIN: usize = 2;

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
        let renderer = CpuRenderer::on(Arc::clone(&threads), &Switches::default());
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
}
