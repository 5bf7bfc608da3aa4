//! Other processes that share the store: scenes made elsewhere are seen here, and the scenes of a
//! dead replica are made here.
//!
//! Everything goes through the shared store. The records of this process tell the truth about its
//! own scenes; of any other scene they hold what was read within `limits.record_fresh_ms`.

use std::{
    collections::{HashMap, HashSet},
    hash::{BuildHasher, RandomState},
    sync::{Mutex, MutexGuard, PoisonError, atomic::Ordering},
    time::{Duration, Instant},
};

use super::{
    JobParts, Shared,
    job::{Kind, Reason},
    scene::requeue,
    semantics,
};
use crate::{
    error::Result,
    limits::Limits,
    scene::{SceneId, SceneState},
    store::{Record, Store},
};

/// Between two looks at scenes that are watched here and made elsewhere.
const WATCH_EVERY: Duration = Duration::from_millis(500);
/// Leases after which a replica that does not beat is removed.
const LEASES_TO_FORGET: u32 = 10;
/// Times of reading that are remembered before all are forgotten.
const FRESH_MAX: usize = 10_000;

/// How this process shares its scenes with others. Each default is that of a process on its own.
pub(super) trait Replicas: Send + Sync {
    /// Name of this process among those that share the store; `None` where it is alone.
    fn name(&self) -> Option<&str> {
        None
    }

    /// From now on this process works on the scene, and its record is the truth about it.
    fn hold(&self, _: &SceneId) {}

    /// This process writes nothing of the scene any more.
    fn release(&self, _: &SceneId) {}

    /// Whether the store may know more of this scene than the records.
    fn may_be_stale(&self, _: &SceneId) -> bool {
        false
    }

    /// Reads what the store has of a scene.
    fn refresh(&self, _: &Shared, _: &SceneId) -> Result<()> {
        Ok(())
    }

    /// Reads what the store has of all scenes.
    fn refresh_all(&self, _: &Shared) -> Result<()> {
        Ok(())
    }

    /// Whether the call that made this scene was acknowledged.
    fn is_acknowledged(&self, _: &Store, _: &SceneId) -> Result<bool> {
        Ok(true)
    }

    /// The life of the thread that watches the other replicas.
    fn watch(&self, _: &Shared) {}
}

/// The replicas of a store: none where this process alone uses it.
pub(super) fn of(parts: &JobParts) -> Box<dyn Replicas> {
    if !parts.store.is_shared() {
        return Box::new(Alone);
    }
    // The system's random numbers tell this process from every other.
    let random = || RandomState::new().hash_one(std::process::id());
    Box::new(Neighbours {
        name: format!("{:016x}{:016x}", random(), random()),
        limits: parts.limits.clone(),
        held: Mutex::default(),
        fresh: Mutex::default(),
        listed: Mutex::default(),
    })
}

struct Alone;

impl Replicas for Alone {}

/// Replicas that share the store with this one.
struct Neighbours {
    name: String,
    limits: Limits,
    /// Scenes that this process works on, or is to.
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
    makers: HashMap<SceneId, String>,
    count: u64,
}

impl Replicas for Neighbours {
    fn name(&self) -> Option<&str> {
        Some(&self.name)
    }

    fn hold(&self, id: &SceneId) {
        self.lock_held().insert(id.clone());
    }

    fn release(&self, id: &SceneId) {
        self.lock_held().remove(id);
    }

    fn may_be_stale(&self, id: &SceneId) -> bool {
        let fresh = Duration::from_millis(self.limits.record_fresh_ms);
        let read = || self.lock_fresh().get(id).copied();
        !self.holds(id) && read().is_none_or(|read| read.elapsed() >= fresh)
    }

    fn refresh(&self, shared: &Shared, id: &SceneId) -> Result<()> {
        self.learn(shared, id, shared.parts.store.record(id)?);
        Ok(())
    }

    fn refresh_all(&self, shared: &Shared) -> Result<()> {
        let mut listed = self.listed.lock().unwrap_or_else(PoisonError::into_inner);
        let fresh = Duration::from_millis(self.limits.record_fresh_ms);
        if listed.at.is_some_and(|at| at.elapsed() < fresh) {
            return Ok(());
        }
        let stamps: HashMap<_, _> = shared.parts.store.stamps()?.into_iter().collect();
        let changed = stamps.iter().filter(|(id, stamp)| listed.stamps.get(id) != Some(stamp));
        let mut ids: Vec<SceneId> = changed.map(|(id, _)| id.clone()).collect();
        ids.extend(shared.records.ids(|record| !stamps.contains_key(&record.status.id)));
        // One that was submitted here after the listing is held.
        ids.retain(|id| !self.holds(id));
        for (id, found) in ids.iter().zip(shared.parts.store.records(&ids)?) {
            self.learn(shared, id, found);
        }
        listed.stamps = stamps;
        listed.at = Some(Instant::now());
        Ok(())
    }

    fn is_acknowledged(&self, store: &Store, id: &SceneId) -> Result<bool> {
        store.was_acknowledged(id)
    }

    fn watch(&self, shared: &Shared) {
        let mut seen = Seen::default();
        let every = Duration::from_millis(self.limits.replica_beat_ms.max(1));
        let mut beaten: Option<Instant> = None;
        loop {
            if beaten.is_none_or(|at| at.elapsed() >= every) {
                beaten = Some(Instant::now());
                if let Err(error) = self.beat(shared, &mut seen) {
                    tracing::warn!(%error, "the neighbours cannot be seen");
                }
            }
            for id in shared.records.watched() {
                if !self.holds(&id)
                    && let Err(error) = self.refresh(shared, &id)
                {
                    tracing::warn!(scene = %id, %error, "a watched scene cannot be read");
                }
            }
            if shared.shutdown.pause(WATCH_EVERY.min(every)) {
                break;
            }
        }
        // At once, so that the others need not wait for a lease to make what was left.
        if let Err(error) = shared.parts.store.end_replica(&self.name) {
            tracing::warn!(%error, "the neighbours are not told of the end");
        }
    }
}

impl Neighbours {
    fn holds(&self, id: &SceneId) -> bool {
        self.lock_held().contains(id)
    }

    fn lock_held(&self) -> MutexGuard<'_, HashSet<SceneId>> {
        self.held.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn lock_fresh(&self) -> MutexGuard<'_, HashMap<SceneId, Instant>> {
        self.fresh.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What the store has of a scene becomes the record here, unless this process holds it.
    fn learn(&self, shared: &Shared, id: &SceneId, found: Option<Record>) {
        if self.holds(id) {
            return;
        }
        let Some(mut record) = found else { return self.lose(shared, id) };
        let mut fresh = self.lock_fresh();
        if fresh.len() >= FRESH_MAX {
            fresh.clear();
        }
        fresh.insert(id.clone(), Instant::now());
        drop(fresh);
        let files =
            |record: &Record| (record.scene_sha256.clone(), record.semantics_sha256.clone());
        if shared.records.find(id).is_some_and(|known| files(&known) != files(&record)) {
            shared.parts.store.forget(id);
        }
        semantics::reset(&mut record);
        shared.records.put(record);
    }

    fn lose(&self, shared: &Shared, id: &SceneId) {
        shared.records.remove(id);
        shared.parts.store.forget(id);
        self.lock_fresh().remove(id);
    }

    /// One beat: tells that this replica lives, writes how far its scenes are, drops those that
    /// were deleted or taken over elsewhere, takes over those of the dead.
    fn beat(&self, shared: &Shared, seen: &mut Seen) -> Result<()> {
        let store = &shared.parts.store;
        seen.count += 1;
        store.beat(&self.name, seen.count)?;
        let running = shared.running.scenes(Kind::Scene);
        for record in running.iter().filter_map(|id| shared.records.find(id)) {
            if record.status.state == SceneState::Running && self.holds(&record.status.id) {
                // One deleted meanwhile is dropped below.
                let _ = store.put_record(&record);
            }
        }
        for id in store.tombstones()? {
            if self.holds(&id) {
                tracing::info!(scene = %id, "deleted by a neighbour");
                self.stop(shared, &id);
            }
            self.lose(shared, &id);
        }
        for id in store.claimed_from(&self.name)? {
            if self.holds(&id) {
                tracing::warn!(scene = %id, "a neighbour took this scene over");
                self.stop(shared, &id);
            }
        }
        let alive = self.alive(shared, seen)?;
        self.take_over_from_dead(shared, seen, &alive)
    }

    /// Stops the jobs of a scene here, whoever makes it now.
    fn stop(&self, shared: &Shared, id: &SceneId) {
        shared.queue.remove(id);
        shared.running.stop(Some(id), Reason::Cancelled);
        shared.release(id);
    }

    /// Looks at every heartbeat; gives the replicas that live.
    fn alive(&self, shared: &Shared, seen: &mut Seen) -> Result<HashSet<String>> {
        let lease = Duration::from_millis(self.limits.replica_lease_ms);
        let beats = shared.parts.store.beats()?;
        seen.beats.retain(|name, _| beats.iter().any(|beat| beat.replica == *name));
        for beat in beats {
            let known = seen.beats.get(&beat.replica);
            if known.is_none_or(|(stamp, _)| *stamp != beat.stamp) {
                seen.beats.insert(beat.replica, (beat.stamp, Instant::now()));
            } else if known.is_some_and(|(_, at)| at.elapsed() > lease * LEASES_TO_FORGET) {
                shared.parts.store.end_replica(&beat.replica)?;
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
        shared: &Shared,
        seen: &mut Seen,
        alive: &HashSet<String>,
    ) -> Result<()> {
        let store = &shared.parts.store;
        let unfinished = store.unfinished()?;
        seen.makers.retain(|id, _| unfinished.iter().any(|(other, _)| other == id));
        for (id, _) in unfinished {
            if self.holds(&id) {
                continue;
            }
            let maker = match seen.makers.get(&id) {
                Some(maker) => maker.clone(),
                None => {
                    let Some(record) = store.record(&id)? else { continue };
                    if record.status.state.is_final() {
                        store.drop_pending(&id)?;
                        continue;
                    }
                    let maker = record.replica.unwrap_or_default();
                    seen.makers.insert(id.clone(), maker.clone());
                    maker
                }
            };
            let idle = shared.workers.load(Ordering::Relaxed);
            if maker == self.name || alive.contains(&maker) || shared.queue.len(Kind::Scene) > idle
            {
                continue;
            }
            let heir = store.claim(&id, &maker, &self.name)?;
            if heir == self.name {
                self.take_over(shared, &id, &maker)?;
            }
            seen.makers.insert(id, heir);
        }
        Ok(())
    }

    fn take_over(&self, shared: &Shared, id: &SceneId, from: &str) -> Result<()> {
        let store = &shared.parts.store;
        let Some(mut record) = store.record(id)? else { return Ok(()) };
        if record.status.state.is_final() || !store.was_acknowledged(id)? {
            return store.drop_pending(id);
        }
        tracing::info!(scene = %id, from, "taken over from a dead replica");
        record.replica = Some(self.name.clone());
        requeue(&mut record);
        self.hold(id);
        store.put_record(&record).inspect_err(|_| shared.release(id))?;
        let owner = record.owner.clone();
        shared.records.put(record);
        shared.queue.push(Kind::Scene, id.clone(), owner.as_deref());
        Ok(())
    }
}
