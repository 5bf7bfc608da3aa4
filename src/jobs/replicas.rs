//! Other processes that share the store: this process shows the scenes of other replicas, and makes
//! those of a dead one.
//!
//! Everything goes through the shared store. The records of this process are right for its own
//! scenes; of other scenes they hold what was read within `limits.record_fresh_ms`.

use std::{
    collections::{HashMap, HashSet},
    sync::{Arc, atomic::Ordering},
    time::{Duration, Instant},
};

use parking_lot::Mutex;

use super::{
    change::{Attempt, Change, forget_refinement, forget_semantics_job},
    grow::GROW,
    job::Reason,
    scene::SCENE,
    shared::{JobParts, Jobs, Replicas},
};
use crate::{
    error::{Error, ErrorCode, Result},
    limits::LiveLimits,
    scene::SceneId,
    store::{self, Record, Store},
};

/// Time between two reads of scenes that are watched here and made elsewhere.
const WATCH_EVERY: Duration = Duration::from_millis(500);
/// Leases after which a replica that does not beat is removed.
const LEASES_TO_FORGET: u32 = 10;
/// Times of reading that are remembered before all are forgotten.
const FRESH_MAX: usize = 10_000;

/// The replicas of a store: none where this process alone uses it.
pub(super) fn of(parts: &JobParts) -> Result<Box<dyn Replicas>> {
    if !parts.store.is_shared() {
        return Ok(Box::new(Alone));
    }
    Ok(Box::new(OtherReplicas {
        name: store::new_id()?.to_string(),
        limits: Arc::clone(&parts.limits),
        held: Mutex::default(),
        fresh: Mutex::default(),
        listed: Mutex::default(),
    }))
}

/// The only process that uses the store.
struct Alone;

impl Replicas for Alone {}

/// Replicas that share the store with this one.
struct OtherReplicas {
    name: String,
    limits: Arc<LiveLimits>,
    /// Scenes that this process makes or has queued.
    held: Mutex<HashSet<SceneId>>,
    /// When scenes made elsewhere were last read.
    fresh: Mutex<HashMap<SceneId, Instant>>,
    listed: Mutex<Listed>,
}

/// What the store listed last, and when.
#[derive(Debug, Default)]
struct Listed {
    stamps: HashMap<SceneId, String>,
    at: Option<Instant>,
}

/// What is known of the other replicas.
#[derive(Debug, Default)]
struct Seen {
    /// The last heartbeat of each, and when it changed.
    beats: HashMap<String, (String, Instant)>,
    /// The replica that makes each unfinished scene.
    replica_of: HashMap<SceneId, String>,
    count: u64,
}

impl Replicas for OtherReplicas {
    fn name(&self) -> Option<&str> {
        Some(&self.name)
    }

    fn hold(&self, id: &SceneId) {
        self.held.lock().insert(id.clone());
    }

    fn release(&self, id: &SceneId) {
        self.held.lock().remove(id);
    }

    fn may_be_stale(&self, id: &SceneId) -> bool {
        let fresh = Duration::from_millis(self.limits.get().record_fresh_ms);
        let read = || self.fresh.lock().get(id).copied();
        !self.holds(id) && read().is_none_or(|read| read.elapsed() >= fresh)
    }

    fn refresh(&self, jobs: &Jobs, id: &SceneId) -> Result<()> {
        self.learn(jobs, id, jobs.parts.store.record(id)?);
        Ok(())
    }

    fn refresh_all(&self, jobs: &Jobs) -> Result<()> {
        let mut listed = self.listed.lock();
        let fresh = Duration::from_millis(self.limits.get().record_fresh_ms);
        if listed.at.is_some_and(|at| at.elapsed() < fresh) {
            return Ok(());
        }
        let stamps = jobs.parts.store.stamps()?;
        let changed = stamps.iter().filter(|(id, stamp)| listed.stamps.get(id) != Some(stamp));
        let mut ids: Vec<SceneId> = changed.map(|(id, _)| id.clone()).collect();
        ids.extend(jobs.records.ids(|record| !stamps.contains_key(&record.status.id)));
        // A scene that was submitted here after the listing is held.
        ids.retain(|id| !self.holds(id));
        for (id, found) in ids.iter().zip(jobs.parts.store.records(&ids)?) {
            self.learn(jobs, id, found);
        }
        listed.stamps = stamps;
        listed.at = Some(Instant::now());
        Ok(())
    }

    fn is_acknowledged(&self, store: &Store, id: &SceneId) -> Result<bool> {
        store.was_acknowledged(id)
    }

    fn begin_growing(&self, store: &Store, id: &SceneId) -> Result<()> {
        if store.begin_growing(id, &self.name)? == self.name {
            return Ok(());
        }
        let why = format!("another replica changes the photos of scene {id}; ask again");
        Err(Error::new(ErrorCode::Overloaded, why).retry_after_s(1))
    }

    fn is_lost(&self, jobs: &Jobs, id: &SceneId) -> Result<bool> {
        let (store, known) = (&jobs.parts.store, jobs.records.find(id));
        let grows = self.grows_elsewhere(store, id)?;
        let stored = store.record(id)?;
        let grew = |stored: &Record, known: &Record| {
            stored.growth.joined != known.growth.joined
                || stored.status.version > known.status.version
        };
        let differs = stored.as_ref().zip(known.as_deref()).is_some_and(|(s, k)| grew(s, k));
        if grows || differs {
            tracing::info!(scene = %id, "another replica changes its photos");
            self.release(id);
            self.learn(jobs, id, stored);
        }
        Ok(grows || differs)
    }

    fn end_growing(&self, store: &Store, id: &SceneId) -> Result<()> {
        if self.grows_elsewhere(store, id)? { Ok(()) } else { store.end_growing(id) }
    }

    fn watch(&self, jobs: &Jobs) {
        let mut seen = Seen::default();
        let mut beaten: Option<Instant> = None;
        loop {
            let every = Duration::from_millis(self.limits.get().replica_beat_ms.max(1));
            if beaten.is_none_or(|at| at.elapsed() >= every) {
                beaten = Some(Instant::now());
                if let Err(error) = self.beat(jobs, &mut seen) {
                    tracing::warn!(%error, "the other replicas cannot be seen");
                }
            }
            for id in jobs.records.watched() {
                if !self.holds(&id)
                    && let Err(error) = self.refresh(jobs, &id)
                {
                    tracing::warn!(scene = %id, %error, "a watched scene cannot be read");
                }
            }
            if jobs.queue.pause(WATCH_EVERY.min(every)) {
                break;
            }
        }
        // At once, so that others take over without waiting for a lease.
        if let Err(error) = jobs.parts.store.end_replica(&self.name) {
            tracing::warn!(%error, "the heartbeat of this replica is not removed");
        }
    }
}

impl OtherReplicas {
    fn grows_elsewhere(&self, store: &Store, id: &SceneId) -> Result<bool> {
        Ok(store.grows_at(id)?.is_some_and(|replica| replica != self.name))
    }

    fn holds(&self, id: &SceneId) -> bool {
        self.held.lock().contains(id)
    }

    /// What the store has of a scene becomes the record here, unless this process holds it.
    fn learn(&self, jobs: &Jobs, id: &SceneId, found: Option<Record>) {
        if self.holds(id) {
            return;
        }
        let Some(mut record) = found else { return self.lose(jobs, id) };
        let mut fresh = self.fresh.lock();
        if fresh.len() >= FRESH_MAX {
            fresh.clear();
        }
        fresh.insert(id.clone(), Instant::now());
        drop(fresh);
        let files =
            |record: &Record| (record.scene_sha256.clone(), record.semantics_sha256.clone());
        if jobs.records.find(id).is_some_and(|known| files(&known) != files(&record)) {
            jobs.parts.store.forget(id);
        }
        forget_semantics_job(&mut record);
        forget_refinement(&mut record);
        jobs.records.learn(record, || self.holds(id));
    }

    fn lose(&self, jobs: &Jobs, id: &SceneId) {
        jobs.records.remove(id);
        jobs.parts.store.forget(id);
        jobs.uploads.forget(id);
        self.fresh.lock().remove(id);
    }

    /// One beat: writes the heartbeat and the progress of its scenes, drops scenes that were
    /// deleted or taken over elsewhere, and takes over those of dead replicas.
    fn beat(&self, jobs: &Jobs, seen: &mut Seen) -> Result<()> {
        let store = &jobs.parts.store;
        seen.count += 1;
        store.beat(&self.name, seen.count)?;
        for id in jobs.running.scenes(SCENE).iter().filter(|id| self.holds(id)) {
            jobs.records.keep_progress(id);
        }
        for id in store.tombstones()? {
            if self.holds(&id) {
                tracing::info!(scene = %id, "deleted by another replica");
                self.stop(jobs, &id);
            }
            self.lose(jobs, &id);
        }
        for id in store.claimed_from(&self.name)? {
            if self.holds(&id) {
                tracing::warn!(scene = %id, "another replica took this scene over");
                self.stop(jobs, &id);
            }
        }
        let alive = self.alive(jobs, seen)?;
        self.grow_for_dead(jobs, &alive)?;
        self.take_over_from_dead(jobs, seen, &alive)
    }

    /// Stops the jobs of a scene in this process.
    fn stop(&self, jobs: &Jobs, id: &SceneId) {
        jobs.queue.remove(id, None);
        jobs.running.stop(Reason::Cancelled, |job| job.scene == *id);
        jobs.bell.ring();
        jobs.release(id);
    }

    /// Looks at every heartbeat; gives the replicas that live.
    fn alive(&self, jobs: &Jobs, seen: &mut Seen) -> Result<HashSet<String>> {
        let lease = Duration::from_millis(self.limits.get().replica_lease_ms);
        let beats = jobs.parts.store.beats()?;
        seen.beats.retain(|name, _| beats.iter().any(|(replica, _)| replica == name));
        for (replica, stamp) in beats {
            match seen.beats.get(&replica) {
                Some((known, at)) if *known == stamp => {
                    if at.elapsed() > lease * LEASES_TO_FORGET {
                        jobs.parts.store.end_replica(&replica)?;
                    }
                }
                _ => drop(seen.beats.insert(replica, (stamp, Instant::now()))),
            }
        }
        let alive = |(name, (_, at)): &(&String, &(String, Instant))| {
            at.elapsed() <= lease || **name == self.name
        };
        Ok(seen.beats.iter().filter(alive).map(|(name, _)| name.clone()).collect())
    }

    /// Takes over the unfinished scenes of dead replicas, no more than there are workers for.
    fn take_over_from_dead(
        &self,
        jobs: &Jobs,
        seen: &mut Seen,
        alive: &HashSet<String>,
    ) -> Result<()> {
        let store = &jobs.parts.store;
        let unfinished = store.unfinished()?;
        seen.replica_of.retain(|id, _| unfinished.contains_key(id));
        for id in unfinished.into_keys() {
            if self.holds(&id) {
                continue;
            }
            let replica = match seen.replica_of.get(&id) {
                Some(replica) => replica.clone(),
                None => {
                    let Some(record) = store.record(&id)? else { continue };
                    if record.status.state.is_final() {
                        store.drop_pending(&id)?;
                        continue;
                    }
                    let replica = record.replica.unwrap_or_default();
                    seen.replica_of.insert(id.clone(), replica.clone());
                    replica
                }
            };
            let idle = jobs.workers.load(Ordering::Relaxed);
            let lives = replica == self.name || alive.contains(&replica);
            if lives || jobs.queue.len(SCENE) > idle {
                continue;
            }
            let heir = store.claim(&id, &replica, &self.name)?;
            if heir == self.name {
                self.take_over(jobs, &id, &replica)?;
            }
            seen.replica_of.insert(id, heir);
        }
        Ok(())
    }

    /// Goes on with changes of photos that dead replicas took.
    fn grow_for_dead(&self, jobs: &Jobs, alive: &HashSet<String>) -> Result<()> {
        let store = &jobs.parts.store;
        for id in store.growing()? {
            let Some(mut replica) = store.grows_at(&id)? else { continue };
            // From heir to heir: one that claimed it may be dead, too.
            let lives = loop {
                if replica == self.name || alive.contains(&replica) {
                    break true;
                }
                let heir = store.claim(&id, &replica, &self.name)?;
                if heir == self.name || heir == replica {
                    break heir == replica;
                }
                replica = heir;
            };
            if lives {
                continue;
            }
            let Some(record) = store.record(&id)? else { continue };
            if record.growth.waiting.is_empty() {
                store.end_growing(&id)?;
                continue;
            }
            tracing::info!(scene = %id, from = replica, "its photos change here now");
            store.go_on_growing(&id, &self.name)?;
            let owner = record.owner.clone();
            self.hold(&id);
            jobs.records.learn(record, || false);
            jobs.queue.push(GROW, id, owner.as_deref());
        }
        Ok(())
    }

    fn take_over(&self, jobs: &Jobs, id: &SceneId, from: &str) -> Result<()> {
        let store = &jobs.parts.store;
        let Some(mut record) = store.record(id)? else { return Ok(()) };
        if record.status.state.is_final() || !store.was_acknowledged(id)? {
            return store.drop_pending(id);
        }
        tracing::info!(scene = %id, from, "taken over from a dead replica");
        record.replica = Some(self.name.clone());
        let owner = record.owner.clone();
        self.hold(id);
        jobs.records.learn(record, || false);
        jobs.records.apply(id, &Change::Requeued(SCENE, Attempt::Counts))?;
        jobs.queue.push(SCENE, id.clone(), owner.as_deref());
        Ok(())
    }
}
