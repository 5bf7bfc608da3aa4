//! The queue of views of one device: who draws next, and which views are drawn together.
//!
//! A caller puts its request into the queue and waits. The scheduler of the service bounds the
//! number of callers. The caller whose request is first draws it. It draws with it all waiting
//! requests that fit the same submission: those of the same scene and the same kernels. A request
//! that is equal to one that waits or is being drawn is not drawn again; its caller gets a copy.
//! The threads of the callers do the work, so the queue can borrow what they pass.

use std::{
    collections::VecDeque,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::{Duration, Instant},
};

use parking_lot::{Condvar, Mutex};

use super::pipelines::RasterKinds;
use crate::{
    Frame, RenderRequest,
    error::{Error, Result},
};

/// Submissions at once: while the device draws one, the pictures of another are copied and the
/// next is recorded. Three were slower on one NVIDIA H200, because each was too small.
pub(super) const SUBMISSIONS_MAX: usize = 2;
/// How long a submission waits for more views: much less than the cost of a submission.
const GATHER: Duration = Duration::from_micros(150);

/// One request in the queue.
#[derive(Debug)]
pub(super) struct QueuedView {
    /// [`crate::scene::Gaussians::identity`] of the scene.
    scene: u64,
    pub(super) request: RenderRequest,
    answer: Mutex<Option<Result<Frame>>>,
    /// Notified when there is an answer, or when its caller may draw.
    changed: Condvar,
    /// Whether its caller may draw now.
    leads: AtomicBool,
    /// Callers that have not taken the answer yet.
    takers: AtomicUsize,
    answered: AtomicBool,
}

impl QueuedView {
    /// Whether both have the same answer.
    fn equals(&self, scene: u64, request: &RenderRequest) -> bool {
        self.scene == scene && self.request == *request
    }

    /// Whether both can be in one submission. The kernels must be the same, so that a view has the
    /// same bits alone and together with others.
    fn joins(&self, other: &Self) -> bool {
        let kinds = |view: &Self| RasterKinds::from(&view.request);
        self.scene == other.scene && kinds(self) == kinds(other)
    }

    pub(super) fn answer(&self, answer: Result<Frame>) {
        *self.answer.lock() = Some(answer);
        self.answered.store(true, Ordering::Release);
        self.changed.notify_all();
    }

    /// Adds a caller, unless the last one has taken the answer.
    fn share(&self) -> bool {
        let more = |takers| (takers > 0).then_some(takers + 1);
        self.takers.fetch_update(Ordering::AcqRel, Ordering::Acquire, more).is_ok()
    }

    fn lead(&self) {
        // Under the lock, so that no caller misses the notification.
        let _answer = self.answer.lock();
        self.leads.store(true, Ordering::Release);
        self.changed.notify_all();
    }

    /// Waits for the answer. Returns true if the caller must draw instead (only if `mine`).
    fn wait(&self, mine: bool) -> bool {
        let mut answer = self.answer.lock();
        while answer.is_none() {
            if mine && self.leads.load(Ordering::Acquire) {
                return true;
            }
            self.changed.wait(&mut answer);
        }
        false
    }

    /// The answer. The last caller gets it, the others a copy.
    fn take(&self) -> Result<Frame> {
        let mut answer = self.answer.lock();
        if self.takers.fetch_sub(1, Ordering::AcqRel) == 1 {
            return answer.take().unwrap_or_else(|| Err(Error::internal("no answer was given")));
        }
        match &*answer {
            Some(Ok(frame)) => Ok(frame.clone()),
            Some(Err(error)) => Err(Error::new(error.code(), error.message())),
            None => Err(Error::internal("no answer was given")),
        }
    }
}

#[derive(Debug, Default)]
struct ViewsWaiting {
    /// In the order of arrival.
    views: VecDeque<Arc<QueuedView>>,
    /// Being drawn.
    at_work: Vec<Arc<QueuedView>>,
    /// Submissions at work, at most [`SUBMISSIONS_MAX`].
    submissions: usize,
    /// Largest recent number of requests at once. It falls by one with each submission.
    crowd: usize,
}

impl ViewsWaiting {
    fn len(&self) -> usize {
        self.views.len() + self.at_work.len()
    }

    /// Lets the callers that have waited longest draw, while submissions are free. Views that join
    /// a submission that is about to start are left out.
    fn start_next(&mut self) {
        while self.submissions < SUBMISSIONS_MAX {
            let leads = |view: &&Arc<QueuedView>| view.leads.load(Ordering::Acquire);
            let joins =
                |view: &Arc<QueuedView>| self.views.iter().filter(leads).any(|led| led.joins(view));
            let next = self.views.iter().find(|view| !leads(view) && !joins(view));
            let Some(view) = next else { break };
            self.submissions += 1;
            view.lead();
        }
    }
}

/// The queue of one device.
#[derive(Debug, Default)]
pub(super) struct ViewQueue {
    waiting: Mutex<ViewsWaiting>,
    /// Notified when a request arrives.
    arrived: Condvar,
}

/// The views of one submission. When it is dropped, also by a panic, every view has an answer.
struct ActiveBatch<'a> {
    queue: &'a ViewQueue,
    batch: Vec<Arc<QueuedView>>,
}

impl Drop for ActiveBatch<'_> {
    fn drop(&mut self) {
        let open = |view: &&Arc<QueuedView>| !view.answered.load(Ordering::Acquire);
        for view in self.batch.iter().filter(open) {
            view.answer(Err(Error::internal("a drawing was broken off")));
        }
        let mut waiting = self.queue.waiting.lock();
        let mine = |view: &Arc<QueuedView>| self.batch.iter().any(|other| Arc::ptr_eq(view, other));
        waiting.at_work.retain(|view| !mine(view));
        waiting.submissions -= 1;
        waiting.start_next();
    }
}

impl ViewQueue {
    /// Requests that wait or are being drawn.
    pub(super) fn len(&self) -> usize {
        self.waiting.lock().len()
    }

    /// Draws `request` of `scene`, alone or with others. `draw` must answer all its views; it gets
    /// at most `views_max`.
    /// Errors: what `draw` answers.
    pub(super) fn render(
        &self,
        scene: u64,
        request: &RenderRequest,
        views_max: usize,
        draw: impl FnOnce(&[Arc<QueuedView>]),
    ) -> Result<Frame> {
        let (view, mine) = self.enter(scene, request);
        if view.wait(mine) {
            let batch = self.gather(&view, views_max);
            draw(&batch.batch);
        }
        view.take()
    }

    /// The view of `request`, and whether it is new.
    fn enter(&self, scene: u64, request: &RenderRequest) -> (Arc<QueuedView>, bool) {
        let mut waiting = self.waiting.lock();
        let mut known = waiting.views.iter().chain(&waiting.at_work);
        if let Some(view) = known.find(|view| view.equals(scene, request) && view.share()) {
            return (Arc::clone(view), false);
        }
        let view = Arc::new(QueuedView {
            scene,
            request: request.clone(),
            answer: Mutex::default(),
            changed: Condvar::new(),
            leads: AtomicBool::new(false),
            takers: AtomicUsize::new(1),
            answered: AtomicBool::new(false),
        });
        waiting.views.push_back(Arc::clone(&view));
        waiting.crowd = waiting.crowd.max(waiting.len());
        waiting.start_next();
        self.arrived.notify_all();
        (view, true)
    }

    /// The views of the submission that `view` starts.
    fn gather(&self, view: &Arc<QueuedView>, views_max: usize) -> ActiveBatch<'_> {
        let fits = |other: &Arc<QueuedView>| {
            let led = other.leads.load(Ordering::Acquire);
            Arc::ptr_eq(other, view) || (!led && view.joins(other))
        };
        let mut waiting = self.waiting.lock();
        // Wait for this submission's share of the recent views, also while others are drawn: a
        // submission costs as much as several views.
        let expected = waiting.crowd.div_ceil(SUBMISSIONS_MAX).min(views_max);
        let until = Instant::now() + GATHER;
        while waiting.views.iter().filter(|other| fits(other)).count() < expected {
            let Some(left) = until.checked_duration_since(Instant::now()) else { break };
            self.arrived.wait_for(&mut waiting, left);
        }
        let mut batch = vec![Arc::clone(view)];
        waiting.views.retain(|other| {
            let taken = batch.len() < views_max && fits(other) && !Arc::ptr_eq(other, view);
            if taken {
                batch.push(Arc::clone(other));
            }
            !taken && !Arc::ptr_eq(other, view)
        });
        waiting.crowd = waiting.len().max(waiting.crowd.saturating_sub(1)).max(1);
        waiting.at_work.extend_from_slice(&batch);
        waiting.start_next();
        ActiveBatch { queue: self, batch }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::Barrier,
        thread::{Scope, ScopedJoinHandle},
    };

    use super::*;
    use crate::{
        Kinds,
        error::ErrorCode,
        scene::{Camera, CameraToWorld, Intrinsics},
    };

    fn request(near: f32) -> RenderRequest {
        let camera_to_world =
            CameraToWorld::look_at(glam::DVec3::ZERO, glam::DVec3::Z, glam::DVec3::NEG_Y, "test")
                .unwrap();
        let intrinsics = Intrinsics { fx: 9.0, fy: 9.0, cx: 4.0, cy: 4.0, width: 8, height: 8 };
        RenderRequest::plain(Camera { intrinsics, camera_to_world }, Kinds::COLOR, near)
    }

    /// Answers each view with its near plane.
    fn draw(views: &[Arc<QueuedView>]) {
        for view in views {
            let depth = Some(vec![view.request.near]);
            view.answer(Ok(Frame { depth, ..Frame::default() }));
        }
    }

    fn wait_for(queue: &ViewQueue, requests: usize) {
        while queue.len() < requests {
            std::thread::yield_now();
        }
    }

    /// Callers that take all submissions and hold them until `gate` is passed once more.
    fn hold<'scope>(
        scope: &'scope Scope<'scope, '_>,
        queue: &'scope ViewQueue,
        gate: &'scope Barrier,
        answer: fn(&[Arc<QueuedView>]),
    ) -> Vec<ScopedJoinHandle<'scope, Result<Frame>>> {
        let caller = |other| {
            scope.spawn(move || {
                queue.render(90 + other, &request(1.0), 8, |views| {
                    gate.wait();
                    gate.wait();
                    answer(views);
                })
            })
        };
        let callers = (0..SUBMISSIONS_MAX as u64).map(caller).collect();
        gate.wait();
        callers
    }

    #[test]
    fn waiting_requests_of_a_scene_are_drawn_together_and_equal_ones_once() {
        let (queue, gate) = (ViewQueue::default(), Barrier::new(1 + SUBMISSIONS_MAX));
        let batches = Mutex::new(Vec::new());
        std::thread::scope(|scope| {
            hold(scope, &queue, &gate, draw);
            let near = [2.0, 3.0, 2.0, 4.0, 5.0, 3.0];
            for (i, near) in near.into_iter().enumerate() {
                let (queue, batches) = (&queue, &batches);
                // The last two views are of another scene.
                let scene = if i < 4 { 7 } else { 8 };
                scope.spawn(move || {
                    let got = queue.render(scene, &request(near), 8, |views| {
                        batches.lock().push(views.len());
                        draw(views);
                    });
                    assert_eq!(got.unwrap().depth, Some(vec![near]), "view {i}");
                });
            }
            wait_for(&queue, SUBMISSIONS_MAX + 5);
            // The sixth caller joins a view that waits, or finds it drawn.
            std::thread::sleep(Duration::from_millis(50));
            gate.wait();
        });
        let mut batches = batches.lock().clone();
        batches.sort_unstable();
        assert_eq!(batches, [2, 3], "two scenes, one view of the first wanted twice");
    }

    #[test]
    fn a_request_that_was_answered_and_taken_is_drawn_again() {
        let (queue, gate) = (ViewQueue::default(), Barrier::new(1 + SUBMISSIONS_MAX));
        let again = AtomicBool::new(false);
        std::thread::scope(|scope| {
            hold(scope, &queue, &gate, draw);
            // Two views that are drawn together, by a caller who goes on after the answers.
            let [first, second] = [2.0, 3.0].map(|near| {
                let (queue, again) = (&queue, &again);
                let requests = queue.len() + 1;
                let caller = scope.spawn(move || {
                    queue.render(7, &request(near), 8, |views| {
                        draw(views);
                        let begun = Instant::now();
                        while views.len() == 2
                            && !again.load(Ordering::Acquire)
                            && begun.elapsed() < Duration::from_secs(5)
                        {
                            std::thread::yield_now();
                        }
                    })
                });
                wait_for(queue, requests);
                caller
            });
            gate.wait();
            assert!(second.join().unwrap().is_ok(), "answered while the first still draws");
            let got = queue.render(7, &request(3.0), 8, draw);
            again.store(true, Ordering::Release);
            assert_eq!(got.unwrap().depth, Some(vec![3.0]), "drawn again");
            assert!(first.join().unwrap().is_ok());
        });
    }

    #[test]
    fn a_broken_drawing_is_an_error_for_all_who_wait_and_the_next_is_drawn() {
        let (queue, gate) = (ViewQueue::default(), Barrier::new(1 + SUBMISSIONS_MAX));
        std::thread::scope(|scope| {
            let broken = hold(scope, &queue, &gate, |_| {});
            let next = scope.spawn(|| queue.render(1, &request(2.0), 8, draw));
            wait_for(&queue, SUBMISSIONS_MAX + 1);
            gate.wait();
            for broken in broken {
                let error = broken.join().unwrap().unwrap_err();
                assert_eq!(error.code(), ErrorCode::Internal, "nobody answered it");
            }
            assert!(next.join().unwrap().is_ok(), "the next one is drawn");
        });
    }
}
