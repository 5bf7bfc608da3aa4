//! Which view is drawn next.
//!
//! The renderer says how many views it draws at the same time ([`Renderer::concurrency`]); each of
//! them holds a [`Slot`]. A view gives its slot back when it is drawn, so no slot waits for an
//! encoder. Its pixels count until the answer is encoded: they bound the memory of all pictures.
//!
//! Owners take turns: the next view is one of the owner who had least work done so far, and an
//! owner may fill half of the queue, so that others always find room. The order of one owner's
//! views is that of fair queuing: a view waits for about as much work as it is itself, so large
//! views do not keep small ones waiting, and small ones do not keep out a large one. While large
//! views hold every slot, one small view at a time is drawn beside them.
//!
//! [`Renderer::concurrency`]: crate::render::Renderer::concurrency

use std::{
    collections::{BTreeMap, HashMap},
    sync::Arc,
    time::{Duration, Instant},
};

use parking_lot::Mutex;
use tokio::sync::oneshot;

use crate::{
    error::{Error, ErrorCode, Result},
    keys::Caller,
    limits::Limits,
};

/// Most pixels of a small view.
const SMALL_PIXELS: u64 = 512 * 512;
/// A view is taken while its work is at most this share of the room in the queue. So a few large
/// views cannot fill the queue to the last pixel, and small ones still find room.
const ROOM_SHARE: u64 = 4;
/// Most views of one caller at the same time, and most pixels of more than one.
const CALLER_VIEWS: usize = 8;
const CALLER_PIXELS: u64 = 16 << 20;
/// Texts that are scored in the time in which their view is drawn.
const TEXTS_A_DRAWING: u64 = 8;

/// What a call asks of the renderer.
#[derive(Clone, Debug, Default)]
pub(super) struct Demand {
    /// Whose turn it takes.
    caller: Caller,
    /// Pixels of its pictures.
    pixels: u64,
    /// Its work, in pixels that are drawn in the same time.
    work: u64,
}

impl Demand {
    /// That of a view of so many pixels.
    pub(super) fn view(caller: &Caller, pixels: u64) -> Self {
        Self { caller: caller.clone(), pixels, work: pixels }
    }

    /// With so many texts, which are looked for in all pixels and all Gaussians.
    pub(super) fn with_texts(self, texts: usize, gaussians: usize) -> Self {
        let each = self.pixels.saturating_add(gaussians as u64);
        let scored = each.saturating_mul(texts as u64) / TEXTS_A_DRAWING;
        Self { work: self.work.saturating_add(scored), ..self }
    }
}

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
    /// Owners with views here, and those who had more work done than others.
    lanes: HashMap<Caller, Lane>,
    /// Views that are drawn or encoded.
    active: usize,
    active_pixels: u64,
    /// Views that are drawn, and the small ones of them.
    drawing: usize,
    drawing_small: usize,
    /// When the last view came or ended.
    used: Option<Instant>,
    /// [`Lane::served`] of the view that was started last, before it was started.
    served: u64,
    arrivals: u64,
}

/// The views of one owner.
#[derive(Debug, Default)]
struct Lane {
    /// Views that wait, in the order in which they are drawn: by [`Lane::clock`] at their arrival
    /// plus their own work, then by arrival.
    waiting: BTreeMap<(u64, u64), Waiting>,
    /// Place in the order of the view that was started last.
    clock: u64,
    /// Work that was started for this owner. One who comes after a pause is as far as the others.
    served: u64,
    /// Views that wait, are drawn or are encoded, and their work.
    views: usize,
    work: u64,
}

#[derive(Debug)]
struct Waiting {
    demand: Demand,
    start: oneshot::Sender<Slot>,
}

/// A permit to draw a view. Dropped when its picture is encoded.
#[derive(Debug)]
pub(super) struct Slot {
    scheduler: Arc<Scheduler>,
    demand: Demand,
    drawing: bool,
}

impl Slot {
    /// Says that the view is drawn: the next one is drawn while this one is encoded.
    pub(super) fn leave_renderer(&mut self) {
        if std::mem::take(&mut self.drawing) {
            let mut state = self.scheduler.state.lock();
            state.drawing -= 1;
            state.drawing_small -= usize::from(self.demand.pixels <= SMALL_PIXELS);
            self.scheduler.start_next(&mut state);
        }
    }
}

impl Drop for Slot {
    fn drop(&mut self) {
        self.leave_renderer();
        let mut state = self.scheduler.state.lock();
        state.used = Some(Instant::now());
        state.active -= 1;
        state.active_pixels -= self.demand.pixels;
        state.remove(&self.demand);
        self.scheduler.start_next(&mut state);
    }
}

/// Takes a view out of the queue when its caller stops to wait.
struct WaitingView<'a> {
    scheduler: &'a Scheduler,
    caller: Caller,
    key: (u64, u64),
    /// Closed after the view has left the queue, so that no slot is lost.
    started: oneshot::Receiver<Slot>,
}

impl Drop for WaitingView<'_> {
    fn drop(&mut self) {
        let mut state = self.scheduler.state.lock();
        let lane = state.lanes.get_mut(&self.caller);
        if let Some(gone) = lane.and_then(|lane| lane.waiting.remove(&self.key)) {
            state.remove(&gone.demand);
        }
    }
}

impl State {
    /// Views that wait, are drawn or are encoded.
    fn views(&self) -> usize {
        self.lanes.values().map(|lane| lane.views).sum()
    }

    /// Takes a place in the queue, or says why there is none.
    fn add(&mut self, demand: &Demand, limits: &Limits) -> Result<(), String> {
        let work = demand.work;
        let (views, queued) = (self.views(), self.lanes.values().map(|lane| lane.work).sum());
        let (views_max, work_max) = (limits.queued_renders_max, limits.queued_pixels_max);
        let lane = self.lanes.entry(demand.caller.clone()).or_default();
        let mut room = work_max.saturating_sub(queued);
        // Without owners there is nobody to share with.
        if demand.caller != Caller::All {
            let share = views_max.div_ceil(2);
            if lane.views >= share {
                return Err(format!("{share} renders of this owner wait already"));
            }
            room = room.min((work_max / 2).saturating_sub(lane.work));
        }
        if views >= views_max {
            return Err(format!("{views} renders wait already, the most that may"));
        }
        if queued > 0 && work > room / ROOM_SHARE {
            let why = format!("renders of {queued} pixels wait already; {work} are too many more");
            return Err(why);
        }
        if lane.views == 0 {
            lane.served = lane.served.max(self.served);
        }
        lane.views += 1;
        lane.work += work;
        Ok(())
    }

    /// Gives the place of a view back.
    fn remove(&mut self, demand: &Demand) {
        if let Some(lane) = self.lanes.get_mut(&demand.caller) {
            lane.views -= 1;
            lane.work -= demand.work;
        }
        let served = self.served;
        self.lanes.retain(|_, lane| lane.views > 0 || lane.served > served);
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
        self.state.lock().views()
    }

    /// Time since the last view ended, 0 while there are views; `None` before the first.
    pub(super) fn idle(&self) -> Option<Duration> {
        let state = self.state.lock();
        match state.views() {
            0 => state.used.map(|used| used.elapsed()),
            _ => Some(Duration::ZERO),
        }
    }

    /// Waits until a view may be drawn. A caller who goes away gives its place back.
    /// Fails with `overloaded` when too many views, or too much work, wait already.
    pub(super) async fn enter(
        self: &Arc<Self>,
        mut demand: Demand,
        limits: &Limits,
    ) -> Result<Slot> {
        // The heaviest query leaves room for others.
        demand.work = demand.work.min(limits.queued_pixels_max / 2);
        let (start, started) = oneshot::channel();
        let mut place = {
            let mut state = self.state.lock();
            let full = |why| Error::new(ErrorCode::Overloaded, why).retry_after_s(1);
            state.add(&demand, limits).map_err(full)?;
            state.arrivals += 1;
            let (caller, arrival) = (demand.caller.clone(), state.arrivals);
            let lane = state.lanes.entry(caller.clone()).or_default();
            let key = (lane.clock.saturating_add(demand.work), arrival);
            lane.waiting.insert(key, Waiting { demand, start });
            self.start_next(&mut state);
            WaitingView { scheduler: self, caller, key, started }
        };
        let slot = (&mut place.started).await;
        slot.map_err(|closed| Error::internal("a view was never started").caused_by(closed))
    }

    /// Starts the views that may start.
    fn start_next(self: &Arc<Self>, state: &mut State) {
        while let Some((caller, key)) = self.next(state) {
            let Some(lane) = state.lanes.get_mut(&caller) else { break };
            let Some(Waiting { demand, start }) = lane.waiting.remove(&key) else { break };
            state.served = state.served.max(lane.served);
            lane.served = lane.served.saturating_add(demand.work.max(1));
            lane.clock = lane.clock.max(key.0);
            state.active += 1;
            state.active_pixels += demand.pixels;
            state.drawing += 1;
            state.drawing_small += usize::from(demand.pixels <= SMALL_PIXELS);
            // A caller that stops to wait leaves the queue before it closes the channel.
            let _ = start.send(Slot { scheduler: Arc::clone(self), demand, drawing: true });
        }
    }

    /// The view that may start now: its owner and its place among theirs.
    fn next(&self, state: &State) -> Option<(Caller, (u64, u64))> {
        let is_small = |view: &Waiting| view.demand.pixels <= SMALL_PIXELS;
        let first = |may: &dyn Fn(&Waiting) -> bool| {
            let firsts = state.lanes.iter().filter_map(|(caller, lane)| {
                let (&key, view) = lane.waiting.iter().find(|(_, view)| may(view))?;
                Some((lane.served, key.1, caller, key, view))
            });
            firsts.min_by_key(|(served, arrival, ..)| (*served, *arrival))
        };
        let (.., caller, key, view) = first(&|_| true)?;
        let pixels = state.active_pixels.saturating_add(view.demand.pixels);
        let fits = state.active == 0 || pixels <= self.active_pixels_max;
        if state.drawing < self.concurrency && fits {
            return Some((caller.clone(), key));
        }
        let (.., caller, key, _) = first(&is_small).filter(|_| state.drawing_small == 0)?;
        Some((caller.clone(), key))
    }
}

#[cfg(test)]
mod tests {
    use futures_util::{FutureExt, future::BoxFuture};

    use super::*;

    const HUGE: u64 = 4096 * 4096;
    const MIDDLE: u64 = 1024 * 1024;

    fn view(pixels: u64) -> Demand {
        Demand::view(&Caller::All, pixels)
    }

    /// A view that has to wait.
    fn waits<'a>(
        scheduler: &'a Arc<Scheduler>,
        pixels: u64,
        limits: &'a Limits,
    ) -> BoxFuture<'a, Result<Slot>> {
        waits_for(scheduler, &view(pixels), limits)
    }

    fn waits_for<'a>(
        scheduler: &'a Arc<Scheduler>,
        demand: &Demand,
        limits: &'a Limits,
    ) -> BoxFuture<'a, Result<Slot>> {
        let mut waiting = scheduler.enter(demand.clone(), limits).boxed();
        assert!(waiting.as_mut().now_or_never().is_none(), "{demand:?} waits");
        waiting
    }

    #[tokio::test]
    async fn one_too_many_is_refused_and_places_return() {
        let limits = Limits { queued_renders_max: 2, ..Limits::default() };
        let scheduler = Scheduler::new(1, &limits);
        let first = scheduler.enter(view(HUGE), &limits).await.unwrap();
        let second = waits(&scheduler, HUGE, &limits);
        let third = scheduler.enter(view(1), &limits).await.unwrap_err();
        assert_eq!((third.code(), third.retry_after()), (ErrorCode::Overloaded, Some(1)));
        assert_eq!(scheduler.len(), 2, "the refused one is not counted");
        drop(second);
        assert_eq!(scheduler.len(), 1, "a caller that goes away gives its place back");
        let second = waits(&scheduler, HUGE, &limits);
        drop(first);
        assert_eq!(scheduler.len(), 1, "the second one has a slot that it has not taken");
        drop(second);
        assert_eq!(scheduler.len(), 0, "and gives it back untaken");
        let _again = scheduler.enter(view(HUGE), &limits).await.unwrap();
    }

    #[tokio::test]
    async fn a_view_that_is_drawn_holds_no_slot_while_it_is_encoded() {
        let limits = Limits::default();
        let scheduler = Scheduler::new(1, &limits);
        let mut first = scheduler.enter(view(HUGE), &limits).await.unwrap();
        let second = waits(&scheduler, HUGE, &limits);
        first.leave_renderer();
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
        let mut first = scheduler.enter(view(HUGE), &limits).await.unwrap();
        let _second = scheduler.enter(view(HUGE), &limits).await.unwrap();
        first.leave_renderer();
        // The first is still being encoded.
        let third = waits(&scheduler, HUGE, &limits);
        drop(first);
        assert!(third.await.is_ok());
        let alone = Scheduler::new(8, &limits);
        assert!(
            alone.enter(view(9 * HUGE), &limits).await.is_ok(),
            "one alone may be larger than all"
        );
    }

    #[tokio::test]
    async fn large_views_neither_fill_the_queue_nor_keep_small_ones_waiting() {
        let limits = Limits::default();
        let scheduler = Scheduler::new(1, &limits);
        let drawn = scheduler.enter(view(HUGE), &limits).await.unwrap();
        let mut huge = Vec::new();
        for _ in 0..31 {
            let mut one = scheduler.enter(view(HUGE), &limits).boxed();
            match one.as_mut().now_or_never() {
                None => huge.push(one),
                Some(refused) => assert_eq!(refused.unwrap_err().code(), ErrorCode::Overloaded),
            }
        }
        assert!(!huge.is_empty() && huge.len() < 31, "{} huge views wait", huge.len());
        let small =
            scheduler.enter(view(64 * 64), &limits).await.expect("drawn beside the huge one");
        // One small view at a time is drawn beside it.
        let other = waits(&scheduler, 64 * 64, &limits);
        let middle = waits(&scheduler, MIDDLE, &limits);
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
        let mut slot = scheduler.enter(view(HUGE), &limits).await.unwrap();
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

    fn of(owner: &str, pixels: u64) -> Demand {
        Demand::view(&Caller::Owner(owner.into()), pixels)
    }

    /// Serves so many views, each of whose callers asks again at once; how many were of owner `b`.
    fn serve<'a>(
        turns: usize,
        slot: &mut Option<Slot>,
        waiting: &mut Vec<(&'static str, BoxFuture<'a, Result<Slot>>)>,
        again: impl Fn(&'static str) -> BoxFuture<'a, Result<Slot>>,
    ) -> usize {
        let mut of_b = 0;
        for _ in 0..turns {
            drop(slot.take());
            let mut all = waiting.iter_mut().enumerate();
            let started = all.find_map(|(i, (_, one))| Some((i, one.as_mut().now_or_never()?)));
            let (i, started) = started.expect("one has the slot");
            *slot = started.ok();
            let (owner, _) = waiting.remove(i);
            of_b += usize::from(owner == "b");
            waiting.push((owner, again(owner)));
        }
        of_b
    }

    #[tokio::test]
    async fn owners_take_turns() {
        let limits = Limits::default();
        let scheduler = Scheduler::new(1, &limits);
        let again = |owner| waits_for(&scheduler, &of(owner, MIDDLE), &limits);
        let mut slot = scheduler.enter(of("a", MIDDLE), &limits).await.ok();
        // Many callers of one owner, and two of another.
        let owners = ["a"; 20].into_iter().chain(["b"; 2]);
        let mut waiting: Vec<_> = owners.map(|owner| (owner, again(owner))).collect();
        assert_eq!(serve(20, &mut slot, &mut waiting, again), 10, "of 20");
        waiting.retain(|(owner, _)| *owner == "a");
        assert_eq!(serve(20, &mut slot, &mut waiting, again), 0);
        // Who was away has no turns saved up.
        waiting.extend(["b"; 4].map(|owner| (owner, again(owner))));
        assert_eq!(serve(6, &mut slot, &mut waiting, again), 3, "of 6");
    }

    #[tokio::test]
    async fn an_owner_fills_half_of_the_queue() {
        let limits = Limits { queued_renders_max: 4, ..Limits::default() };
        let scheduler = Scheduler::new(1, &limits);
        let _drawn = scheduler.enter(of("a", HUGE), &limits).await.unwrap();
        let _waits = waits_for(&scheduler, &of("a", MIDDLE), &limits);
        let refused = scheduler.enter(of("a", MIDDLE), &limits).now_or_never();
        let refused = refused.expect("it does not wait").unwrap_err();
        assert_eq!(refused.code(), ErrorCode::Overloaded, "{refused}");
        let _other = waits_for(&scheduler, &of("b", MIDDLE), &limits);
    }

    #[tokio::test]
    async fn the_work_of_a_query_counts_its_texts() {
        let limits = Limits::default();
        let scheduler = Scheduler::new(1, &limits);
        let heavy = || view(HUGE).with_texts(128, 1_000_000);
        assert_eq!(heavy().work, HUGE + 16 * (HUGE + 1_000_000));
        let _one = scheduler.enter(heavy(), &limits).await.expect("alone it is taken");
        let two = scheduler.enter(heavy(), &limits).await.unwrap_err();
        assert_eq!(two.code(), ErrorCode::Overloaded, "{two}");
        let small = scheduler.enter(view(64 * 64).with_texts(8, 100_000), &limits).await;
        assert!(small.is_ok(), "small views are drawn beside it");
    }
}
