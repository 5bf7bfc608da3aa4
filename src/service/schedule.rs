//! Which view is drawn next.
//!
//! The renderer says how many views it draws at the same time ([`Renderer::concurrency`]); each of
//! them holds a [`Slot`]. A view gives its slot back when it is drawn, so no slot waits for an
//! encoder. Its pixels count until the answer is encoded: they bound the memory of all pictures.
//!
//! The order is that of fair queuing: a view waits for about as many pixels as it has itself, so
//! large views do not keep small ones waiting, and small ones do not keep out a large one. While
//! large views hold every slot, one small view at a time is drawn beside them.
//!
//! [`Renderer::concurrency`]: crate::render::Renderer::concurrency

use std::{
    collections::BTreeMap,
    sync::Arc,
    time::{Duration, Instant},
};

use parking_lot::Mutex;
use tokio::sync::oneshot;

use crate::{
    error::{Error, ErrorCode, Result},
    limits::Limits,
};

/// Most pixels of a small view.
const SMALL_PIXELS: u64 = 512 * 512;
/// A view is taken while its pixels are at most this share of the room in the queue. So a few
/// large views cannot fill the queue to the last pixel, and small ones still find room.
const ROOM_SHARE: u64 = 4;
/// Most views of one caller at the same time, and most pixels of more than one.
const CALLER_VIEWS: usize = 8;
const CALLER_PIXELS: u64 = 16 << 20;

/// Gives slots to views, in order.
#[derive(Debug)]
pub(super) struct Scheduler {
    concurrency: usize,
    /// Pixels of the views that are drawn or encoded at the same time.
    active_pixels_max: u64,
    state: Mutex<State>,
}

#[derive(Debug, Default)]
struct State {
    /// Views that wait, in the order in which they are drawn: by [`State::clock`] at their arrival
    /// plus their own pixels, then by arrival.
    waiting: BTreeMap<(u64, u64), Waiting>,
    waiting_pixels: u64,
    /// Views that are drawn or encoded.
    active: usize,
    active_pixels: u64,
    /// Views that are drawn, and the small ones of them.
    drawing: usize,
    drawing_small: usize,
    /// When the last view came or ended.
    used: Option<Instant>,
    /// Place in the order of the view that was started last.
    clock: u64,
    arrivals: u64,
}

#[derive(Debug)]
struct Waiting {
    pixels: u64,
    start: oneshot::Sender<Slot>,
}

/// A permit to draw a view. Dropped when its picture is encoded.
#[derive(Debug)]
pub(super) struct Slot {
    scheduler: Arc<Scheduler>,
    pixels: u64,
    drawing: bool,
    /// Milliseconds until the view had the slot and a thread.
    pub(super) queue_ms: f64,
}

impl Slot {
    /// Says that the view is drawn: the next one is drawn while this one is encoded.
    pub(super) fn drawn(&mut self) {
        if std::mem::take(&mut self.drawing) {
            let mut state = self.scheduler.state.lock();
            state.drawing -= 1;
            state.drawing_small -= usize::from(self.pixels <= SMALL_PIXELS);
            self.scheduler.start_next(&mut state);
        }
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        self.drawn();
        let mut state = self.scheduler.state.lock();
        state.used = Some(Instant::now());
        state.active -= 1;
        state.active_pixels -= self.pixels;
        self.scheduler.start_next(&mut state);
    }
}

/// Takes a view out of the queue when its caller stops to wait.
struct Place<'a> {
    scheduler: &'a Scheduler,
    key: (u64, u64),
    /// Closed after the view has left the queue, so that no slot is lost.
    started: oneshot::Receiver<Slot>,
}

impl Drop for Place<'_> {
    fn drop(&mut self) {
        let mut state = self.scheduler.state.lock();
        if let Some(gone) = state.waiting.remove(&self.key) {
            state.waiting_pixels -= gone.pixels;
        }
    }
}

impl Scheduler {
    pub(super) fn new(concurrency: usize, limits: &Limits) -> Arc<Self> {
        let state = Mutex::default();
        Arc::new(Self { concurrency, active_pixels_max: limits.active_pixels_max, state })
    }

    /// How many views of so many pixels one caller may have here at the same time: enough to keep
    /// the renderer busy while others are encoded, but few large ones.
    pub(super) fn views_at_once(&self, pixels: u64) -> usize {
        let few = usize::try_from(CALLER_PIXELS / pixels.max(1)).unwrap_or(usize::MAX);
        few.clamp(1, CALLER_VIEWS).min(self.concurrency + 1)
    }

    /// Views that wait, are drawn or are encoded.
    pub(super) fn len(&self) -> usize {
        let state = self.state.lock();
        state.waiting.len() + state.active
    }

    /// Time since the last view ended, 0 while there are views; `None` before the first.
    pub(super) fn idle(&self) -> Option<Duration> {
        let state = self.state.lock();
        match state.waiting.len() + state.active {
            0 => state.used.map(|used| used.elapsed()),
            _ => Some(Duration::ZERO),
        }
    }

    /// Waits until a view of so many pixels may be drawn. A caller who goes away gives its place
    /// back.
    /// Fails with `overloaded` when too many views, or too many pixels, wait already.
    pub(super) async fn enter(self: &Arc<Self>, pixels: u64, limits: &Limits) -> Result<Slot> {
        let (start, started) = oneshot::channel();
        let mut place = {
            let mut state = self.state.lock();
            let views = state.waiting.len() + state.active;
            let queued = state.waiting_pixels + state.active_pixels;
            let room = limits.queued_pixels_max.saturating_sub(queued);
            let full = if views >= limits.queued_renders_max {
                Some(format!("{views} renders wait already, the most that may"))
            } else if queued > 0 && pixels > room / ROOM_SHARE {
                Some(format!("renders of {queued} pixels wait already; {pixels} are too many more"))
            } else {
                None
            };
            if let Some(why) = full {
                return Err(Error::new(ErrorCode::Overloaded, why).retry_after_s(1));
            }
            state.arrivals += 1;
            let key = (state.clock.saturating_add(pixels), state.arrivals);
            state.waiting_pixels += pixels;
            state.waiting.insert(key, Waiting { pixels, start });
            self.start_next(&mut state);
            Place { scheduler: self, key, started }
        };
        let slot = (&mut place.started).await;
        slot.map_err(|closed| Error::internal("a view was never started").caused_by(closed))
    }

    /// Starts the views that may start.
    fn start_next(self: &Arc<Self>, state: &mut State) {
        while let Some(key) = self.next(state) {
            let Some(Waiting { pixels, start }) = state.waiting.remove(&key) else { break };
            state.waiting_pixels -= pixels;
            state.active += 1;
            state.active_pixels += pixels;
            state.drawing += 1;
            state.drawing_small += usize::from(pixels <= SMALL_PIXELS);
            state.clock = state.clock.max(key.0);
            // A caller that stops to wait leaves the queue before it closes the channel.
            let scheduler = Arc::clone(self);
            let _ = start.send(Slot { scheduler, pixels, drawing: true, queue_ms: 0.0 });
        }
    }

    /// The view that may start now.
    fn next(&self, state: &State) -> Option<(u64, u64)> {
        let (&first, view) = state.waiting.first_key_value()?;
        let pixels = state.active_pixels.saturating_add(view.pixels);
        let fits = state.active == 0 || pixels <= self.active_pixels_max;
        if state.drawing < self.concurrency && fits {
            return Some(first);
        }
        let small = |(_, view): &(_, &Waiting)| view.pixels <= SMALL_PIXELS;
        let (&key, _) = state.waiting.iter().find(small)?;
        (state.drawing_small == 0).then_some(key)
    }
}

#[cfg(test)]
mod tests {
    use futures_util::{FutureExt, future::BoxFuture};

    use super::*;

    const HUGE: u64 = 4096 * 4096;

    /// A view that has to wait.
    fn waits<'a>(
        scheduler: &'a Arc<Scheduler>,
        pixels: u64,
        limits: &'a Limits,
    ) -> BoxFuture<'a, Result<Slot>> {
        let mut waiting = scheduler.enter(pixels, limits).boxed();
        assert!(waiting.as_mut().now_or_never().is_none(), "a view of {pixels} pixels waits");
        waiting
    }

    #[tokio::test]
    async fn one_too_many_is_refused_and_places_return() {
        let limits = Limits { queued_renders_max: 2, ..Limits::default() };
        let scheduler = Scheduler::new(1, &limits);
        let first = scheduler.enter(HUGE, &limits).await.unwrap();
        let second = waits(&scheduler, HUGE, &limits);
        let third = scheduler.enter(1, &limits).await.unwrap_err();
        assert_eq!((third.code(), third.retry_after()), (ErrorCode::Overloaded, Some(1)));
        assert_eq!(scheduler.len(), 2, "the refused one is not counted");
        drop(second);
        assert_eq!(scheduler.len(), 1, "a caller that goes away gives its place back");
        let second = waits(&scheduler, HUGE, &limits);
        drop(first);
        assert_eq!(scheduler.len(), 1, "the second one has a slot that it has not taken");
        drop(second);
        assert_eq!(scheduler.len(), 0, "and gives it back untaken");
        let _again = scheduler.enter(HUGE, &limits).await.unwrap();
    }

    #[tokio::test]
    async fn a_view_that_is_drawn_holds_no_slot_while_it_is_encoded() {
        let limits = Limits::default();
        let scheduler = Scheduler::new(1, &limits);
        let mut first = scheduler.enter(HUGE, &limits).await.unwrap();
        let second = waits(&scheduler, HUGE, &limits);
        first.drawn();
        let second = second.await.unwrap();
        assert_eq!(scheduler.len(), 2, "one is encoded, one is drawn");
        drop((first, second));
        let state = scheduler.state.lock();
        assert_eq!((state.active, state.active_pixels, state.drawing), (0, 0, 0), "all given back");
    }

    #[tokio::test]
    async fn pictures_in_memory_stay_within_their_pixels() {
        let limits = Limits { active_pixels_max: 2 * HUGE, ..Limits::default() };
        let scheduler = Scheduler::new(8, &limits);
        let mut first = scheduler.enter(HUGE, &limits).await.unwrap();
        let _second = scheduler.enter(HUGE, &limits).await.unwrap();
        first.drawn();
        // The first is still being encoded.
        let third = waits(&scheduler, HUGE, &limits);
        drop(first);
        assert!(third.await.is_ok());
        let alone = Scheduler::new(8, &limits);
        assert!(alone.enter(9 * HUGE, &limits).await.is_ok(), "one alone may be larger than all");
    }

    #[tokio::test]
    async fn large_views_neither_fill_the_queue_nor_keep_small_ones_waiting() {
        let limits = Limits::default();
        let scheduler = Scheduler::new(1, &limits);
        let drawn = scheduler.enter(HUGE, &limits).await.unwrap();
        let mut huge = Vec::new();
        for _ in 0..31 {
            let mut one = scheduler.enter(HUGE, &limits).boxed();
            match one.as_mut().now_or_never() {
                None => huge.push(one),
                Some(refused) => assert_eq!(refused.unwrap_err().code(), ErrorCode::Overloaded),
            }
        }
        assert!(!huge.is_empty() && huge.len() < 31, "{} huge views wait", huge.len());
        let small = scheduler.enter(64 * 64, &limits).await.expect("drawn beside the huge one");
        // One small view at a time is drawn beside it.
        let other = waits(&scheduler, 64 * 64, &limits);
        let middle = waits(&scheduler, 1024 * 1024, &limits);
        drop(small);
        drop(other.await.unwrap());
        drop(drawn);
        let middle = middle.now_or_never().expect("before the huge ones that came first");
        assert!(huge.iter_mut().all(|one| one.as_mut().now_or_never().is_none()));
        drop(middle);
        assert!(huge.remove(0).now_or_never().is_some(), "then those, in their order");
    }

    #[tokio::test]
    async fn a_large_view_waits_for_no_more_pixels_than_its_own() {
        let limits = Limits::default();
        let scheduler = Scheduler::new(1, &limits);
        let mut slot = scheduler.enter(HUGE, &limits).await.unwrap();
        let mut huge = waits(&scheduler, HUGE, &limits);
        let mut before = 0;
        loop {
            let mut next = waits(&scheduler, HUGE / 8, &limits);
            drop(slot);
            match next.as_mut().now_or_never() {
                Some(started) => slot = started.unwrap(),
                None => break,
            }
            before += 1;
            assert!(before < 20, "it starves");
        }
        assert!(huge.as_mut().now_or_never().is_some() && before >= 4, "after {before} small ones");
    }
}
