//! Replicas beside this one: scenes made elsewhere are seen here, and the dead ones' are made here.
//!
//! Everything goes through the store they share. This replica's own work is true on the board; of
//! any other scene the board holds what was read of it, for `limits.record_fresh_ms`.

use std::{
    collections::HashMap,
    sync::PoisonError,
    time::{Duration, Instant},
};

use super::{Jobs, Shared};
use crate::{
    error::Result,
    scene::{SceneId, SceneState},
    store::Record,
};

/// Between two looks at scenes that are watched here and made elsewhere.
const WATCH_EVERY: Duration = Duration::from_millis(500);
/// Leases after which a replica that does not beat is taken off.
const LEASES_TO_FORGET: u32 = 10;
/// What is remembered of freshness before it is thinned out.
const FRESH_MAX: usize = 10_000;

/// What is known of the neighbours: when each was last seen to change.
#[derive(Debug, Default)]
struct Seen {
    beats: HashMap<String, (String, Instant)>,
    makers: HashMap<SceneId, String>,
    count: u64,
}

impl Jobs {
    /// Whether the store may know more of this scene than the board.
    #[must_use]
    pub fn may_be_stale(&self, id: &SceneId) -> bool {
        self.shared.may_be_stale(id)
    }

    /// Reads what the store has of a scene that is not made here. Blocks on the store.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn refresh(&self, id: &SceneId) -> Result<()> {
        if self.shared.may_be_stale(id) { self.shared.refresh(id) } else { Ok(()) }
    }

    /// Reads what the store has of all scenes. Blocks on the store.
    ///
    /// # Errors
    /// `store_unavailable`.
    pub fn refresh_all(&self) -> Result<()> {
        if self.shared.store.is_shared() { self.shared.refresh_all() } else { Ok(()) }
    }
}

impl Shared {
    pub(super) fn is_mine(&self, id: &SceneId) -> bool {
        self.mine.lock().unwrap_or_else(PoisonError::into_inner).contains(id)
    }

    fn may_be_stale(&self, id: &SceneId) -> bool {
        let fresh = Duration::from_millis(self.limits.record_fresh_ms);
        let read = || self.fresh.lock().unwrap_or_else(PoisonError::into_inner).get(id).copied();
        self.store.is_shared()
            && !self.is_mine(id)
            && read().is_none_or(|read: Instant| read.elapsed() >= fresh)
    }

    fn refresh(&self, id: &SceneId) -> Result<()> {
        let found = self.store.record(id)?;
        self.learn(id, found);
        Ok(())
    }

    /// What the store has of a scene is what this replica knows, unless it works on it itself.
    fn learn(&self, id: &SceneId, found: Option<Record>) {
        if self.is_mine(id) {
            return;
        }
        match found {
            Some(record) => {
                let mut fresh = self.fresh.lock().unwrap_or_else(PoisonError::into_inner);
                if fresh.len() >= FRESH_MAX {
                    fresh.clear();
                }
                fresh.insert(id.clone(), Instant::now());
                drop(fresh);
                self.take(record);
            }
            None => self.lose(id),
        }
    }

    /// What another replica wrote of a scene becomes what this one knows.
    fn take(&self, mut record: Record) {
        let id = &record.status.id;
        let known = self.board.find(id);
        let files =
            |record: &Record| (record.scene_sha256.clone(), record.semantics_sha256.clone());
        if known.as_ref().is_some_and(|known| files(known) != files(&record)) {
            self.store.forget(id);
        }
        // What is being made, or was tried in vain, is told by the one who tries.
        super::semantics::at_start(&mut record);
        self.board.put(record);
    }

    fn lose(&self, id: &SceneId) {
        self.board.remove(id);
        self.store.forget(id);
        self.fresh.lock().unwrap_or_else(PoisonError::into_inner).remove(id);
    }

    fn refresh_all(&self) -> Result<()> {
        let mut listed = self.listed.lock().unwrap_or_else(PoisonError::into_inner);
        let fresh = Duration::from_millis(self.limits.record_fresh_ms);
        if listed.at.is_some_and(|at| at.elapsed() < fresh) {
            return Ok(());
        }
        let stamps: HashMap<_, _> = self.store.stamps()?.into_iter().collect();
        let changed = stamps.iter().filter(|(id, stamp)| listed.stamps.get(id) != Some(stamp));
        let mut ids: Vec<SceneId> = changed.map(|(id, _)| id.clone()).collect();
        ids.extend(self.board.ids(|record| !stamps.contains_key(&record.status.id)));
        // One that was submitted here after the listing is mine.
        ids.retain(|id| !self.is_mine(id));
        for (id, found) in ids.iter().zip(self.store.records(&ids)?) {
            self.learn(id, found);
        }
        listed.stamps = stamps;
        listed.at = Some(Instant::now());
        Ok(())
    }

    /// The life of the thread that watches the neighbours.
    pub(super) fn live_with_peers(&self) {
        let mut seen = Seen::default();
        let every = Duration::from_millis(self.limits.replica_beat_ms.max(1));
        let mut beaten: Option<Instant> = None;
        loop {
            if beaten.is_none_or(|at| at.elapsed() >= every) {
                beaten = Some(Instant::now());
                if let Err(error) = self.beat(&mut seen) {
                    tracing::warn!(%error, "the neighbours cannot be seen");
                }
            }
            for id in self.board.watched() {
                if !self.is_mine(&id)
                    && let Err(error) = self.refresh(&id)
                {
                    tracing::warn!(scene = %id, %error, "a watched scene cannot be read");
                }
            }
            if self.rest(WATCH_EVERY.min(every)) {
                break;
            }
        }
        // At once, so that the others need not wait for a lease to make what was left.
        if let Err(error) = self.store.end_replica(&self.replica) {
            tracing::warn!(%error, "the neighbours are not told of the end");
        }
    }

    /// One beat: tells that this replica lives, writes how far its scenes are, drops those that
    /// were deleted or taken over elsewhere, takes over those of the dead.
    fn beat(&self, seen: &mut Seen) -> Result<()> {
        seen.count += 1;
        self.store.beat(&self.replica, seen.count)?;
        let running: Vec<SceneId> = self.lock_running().keys().cloned().collect();
        for record in running.iter().filter_map(|id| self.board.find(id)) {
            if record.status.state == SceneState::Running && self.is_mine(&record.status.id) {
                // One deleted meanwhile is dropped below.
                let _ = self.store.put_record(&record);
            }
        }
        for id in self.store.tombstones()? {
            if self.is_mine(&id) {
                tracing::info!(scene = %id, "deleted by a neighbour");
                self.stop_here(&id);
            }
            self.lose(&id);
        }
        for id in self.store.claimed_from(&self.replica)? {
            if self.is_mine(&id) {
                tracing::warn!(scene = %id, "a neighbour took this scene over");
                self.stop_here(&id);
            }
        }
        let dead = self.look(seen)?;
        self.inherit(seen, &dead)
    }

    /// Takes a scene off this replica, whoever makes it now.
    fn stop_here(&self, id: &SceneId) {
        self.queue.remove(id);
        self.asked.remove(id);
        for at_work in [self.lock_running(), self.lock_thinking()] {
            if let Some(stop) = at_work.get(id) {
                stop.by_caller();
            }
        }
        self.done_with(id);
    }

    /// Looks at every heartbeat; gives a test of whether a replica is dead.
    fn look(&self, seen: &mut Seen) -> Result<impl Fn(&str) -> bool + use<>> {
        let lease = Duration::from_millis(self.limits.replica_lease_ms);
        let beats = self.store.beats()?;
        seen.beats.retain(|name, _| beats.iter().any(|beat| beat.replica == *name));
        for beat in beats {
            let known = seen.beats.get(&beat.replica);
            if known.is_none_or(|(stamp, _)| *stamp != beat.stamp) {
                seen.beats.insert(beat.replica, (beat.stamp, Instant::now()));
            } else if known.is_some_and(|(_, at)| at.elapsed() > lease * LEASES_TO_FORGET) {
                self.store.end_replica(&beat.replica)?;
            }
        }
        let alive: std::collections::HashSet<String> = seen
            .beats
            .iter()
            .filter(|(name, (_, at))| at.elapsed() <= lease || **name == self.replica)
            .map(|(name, _)| name.clone())
            .collect();
        Ok(move |replica: &str| !alive.contains(replica))
    }

    /// Takes over what the dead were to make, no more than there are hands for.
    fn inherit(&self, seen: &mut Seen, dead: &impl Fn(&str) -> bool) -> Result<()> {
        let unfinished = self.store.unfinished()?;
        seen.makers.retain(|id, _| unfinished.iter().any(|(other, _)| other == id));
        for (id, _) in unfinished {
            if self.is_mine(&id) {
                continue;
            }
            let maker = match seen.makers.get(&id) {
                Some(maker) => maker.clone(),
                None => {
                    let Some(record) = self.store.record(&id)? else { continue };
                    if record.status.state.is_final() {
                        self.store.drop_pending(&id)?;
                        continue;
                    }
                    let maker = record.replica.unwrap_or_default();
                    seen.makers.insert(id.clone(), maker.clone());
                    maker
                }
            };
            let idle = self.workers.load(std::sync::atomic::Ordering::Relaxed);
            if maker == self.replica || !dead(&maker) || self.queue.len() > idle {
                continue;
            }
            let heir = self.store.claim(&id, &maker, &self.replica)?;
            if heir == self.replica {
                self.take_over(&id, &maker)?;
            }
            seen.makers.insert(id, heir);
        }
        Ok(())
    }

    fn take_over(&self, id: &SceneId, from: &str) -> Result<()> {
        let Some(mut record) = self.store.record(id)? else { return Ok(()) };
        if record.status.state.is_final() || !self.store.was_acknowledged(id)? {
            return self.store.drop_pending(id);
        }
        tracing::info!(scene = %id, from, "taken over from a dead replica");
        record.replica = Some(self.replica.clone());
        super::requeued(&mut record);
        self.hold(id);
        self.store.put_record(&record).inspect_err(|_| self.done_with(id))?;
        let owner = record.owner.clone();
        self.board.put(record);
        self.queue.push(id.clone(), owner.as_deref());
        Ok(())
    }
}
