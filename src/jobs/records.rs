//! The keeper of all records: who reads one never waits for who changes it, nor for the store.
//!
//! Each scene has a channel with the newest record, and a lock that its writers take in turn. A
//! [`Change`] is made of a copy, kept by the store, and only then shown; so what a watcher sees is
//! stored, as far as the change says that it is kept at all. How far a job is, is shown and never
//! kept.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, HashMap},
    ops::Bound,
    sync::Arc,
};

use parking_lot::{Mutex, RwLock};
use tokio::sync::watch;

use super::{
    bell::Bell,
    change::{Change, Kept, cancel},
};
use crate::{
    error::Result,
    scene::{SceneId, SceneState, SceneStatus},
    store::{self, Record, Store, not_found},
};

/// Newest first: creation time descending, then id.
type Order = (Reverse<u64>, SceneId);

/// Records of all scenes.
#[derive(Debug)]
pub(crate) struct Records {
    store: Arc<Store>,
    /// Rung after each change but that of progress.
    bell: Arc<Bell>,
    scenes: RwLock<Scenes>,
}

#[derive(Debug, Default)]
struct Scenes {
    by_order: BTreeMap<Order, Held>,
    created: HashMap<SceneId, u64>,
}

/// The record of one scene.
#[derive(Debug)]
struct Held {
    newest: watch::Sender<Arc<Record>>,
    /// Held by a writer from its look at the record until its change is shown.
    writer: Arc<Mutex<()>>,
}

/// A record before and after a change; the same one where there was nothing to change.
#[derive(Clone, Debug)]
pub(super) struct Changed {
    pub(super) before: Arc<Record>,
    pub(super) after: Arc<Record>,
}

impl Changed {
    /// Whether there was something to change.
    pub(super) fn is_any(&self) -> bool {
        !Arc::ptr_eq(&self.before, &self.after)
    }
}

impl Scenes {
    fn held(&self, id: &SceneId) -> Option<&Held> {
        let created = *self.created.get(id)?;
        self.by_order.get(&(Reverse(created), id.clone()))
    }
}

impl Records {
    pub(super) fn new(store: Arc<Store>, bell: Arc<Bell>) -> Self {
        Self { store, bell, scenes: RwLock::default() }
    }

    /// Takes the record of a new scene, which is stored already.
    pub(super) fn insert(&self, record: Record) {
        let mut scenes = self.scenes.write();
        let (id, created) = (record.status.id.clone(), record.status.created_ms);
        scenes.created.insert(id.clone(), created);
        let newest = watch::Sender::new(Arc::new(record));
        scenes.by_order.insert((Reverse(created), id), Held { newest, writer: Arc::default() });
    }

    /// Takes a record that was read from the store, unless this process `holds` the scene or
    /// changes it just now; watchers of the scene see the difference.
    pub(super) fn learn(&self, record: Record, holds: impl Fn() -> bool) {
        let id = &record.status.id;
        let Ok(writer) = self.with(id, |held| Arc::clone(&held.writer)) else {
            return self.insert(record);
        };
        let Some(_turn) = writer.try_lock() else { return };
        if holds() {
            return;
        }
        // One that is deleted meanwhile stays so.
        let _ = self.show(&id.clone(), |known| {
            let changed = *known != record;
            *known = record;
            changed
        });
    }

    /// Makes a change, as [`Change::kept`] says.
    /// Fails with `scene_not_found` where the scene is deleted, and as the store does.
    pub(super) fn apply(&self, id: &SceneId, change: &Change<'_>) -> Result<Changed> {
        self.apply_with(id, change, |record| self.store.put_record(record))
    }

    /// Makes a change that `keep` puts into the store.
    /// Fails as [`Self::apply`] and as `keep`.
    pub(super) fn apply_with(
        &self,
        id: &SceneId,
        change: &Change<'_>,
        keep: impl FnOnce(&Record) -> Result<()>,
    ) -> Result<Changed> {
        let now_ms = store::now_ms();
        let writer = self.with(id, |held| Arc::clone(&held.writer))?;
        let _turn;
        if change.kept() != Kept::No {
            _turn = writer.lock();
            let before = self.find(id).ok_or_else(|| not_found(id))?;
            let mut next = (*before).clone();
            if !change.apply(&mut next, now_ms) {
                return Ok(Changed { after: Arc::clone(&before), before });
            }
            match (keep(&next), change.kept()) {
                (Err(error), Kept::Tried) => {
                    tracing::error!(scene = %id, %error, "its status is not kept");
                }
                (kept, _) => kept?,
            }
        }
        self.show(id, |record| change.apply(record, now_ms))
    }

    /// Changes what readers and watchers see.
    fn show(&self, id: &SceneId, change: impl FnOnce(&mut Record) -> bool) -> Result<Changed> {
        let changed = self.with(id, |held| {
            let mut before = None;
            held.newest.send_if_modified(|record| {
                before = Some(Arc::clone(record));
                let mut next = (**record).clone();
                let changed = change(&mut next);
                if changed {
                    *record = Arc::new(next);
                }
                changed
            });
            let after = Arc::clone(&held.newest.borrow());
            Changed { before: before.unwrap_or_else(|| Arc::clone(&after)), after }
        })?;
        self.bell.ring();
        Ok(changed)
    }

    /// Shows how far a job is. The store does not hear of it.
    pub(super) fn show_progress(&self, id: &SceneId, progress: impl FnOnce(&mut SceneStatus)) {
        // A scene that is deleted has none.
        let _ = self.with(id, |held| {
            held.newest.send_modify(|record| progress(&mut Arc::make_mut(record).status));
        });
    }

    /// Keeps the progress of a scene that is being made, for other replicas; not where it is being
    /// changed: then they hear of it so.
    pub(super) fn keep_progress(&self, id: &SceneId) {
        let Ok(writer) = self.with(id, |held| Arc::clone(&held.writer)) else { return };
        let Some(_turn) = writer.try_lock() else { return };
        let record = self.find(id).filter(|record| record.status.state == SceneState::Running);
        // One deleted meanwhile is gone in the store too.
        let _ = record.map(|record| self.store.put_record(&record));
    }

    /// Takes a scene off; its watchers see it cancelled unless it was final.
    pub(super) fn remove(&self, id: &SceneId) -> bool {
        let mut scenes = self.scenes.write();
        let Some(created) = scenes.created.remove(id) else { return false };
        if let Some(held) = scenes.by_order.remove(&(Reverse(created), id.clone())) {
            held.newest.send_modify(|record| cancel(Arc::make_mut(record)));
        }
        drop(scenes);
        self.bell.ring();
        true
    }

    fn with<T>(&self, id: &SceneId, look: impl FnOnce(&Held) -> T) -> Result<T> {
        self.scenes.read().held(id).map(look).ok_or_else(|| not_found(id))
    }

    pub(super) fn find(&self, id: &SceneId) -> Option<Arc<Record>> {
        self.with(id, |held| Arc::clone(&held.newest.borrow())).ok()
    }

    pub(super) fn watch(&self, id: &SceneId) -> Option<watch::Receiver<Arc<Record>>> {
        self.with(id, |held| held.newest.subscribe()).ok()
    }

    /// Watchers of a scene, callers who wait for it among them.
    pub(crate) fn watchers(&self, id: &SceneId) -> usize {
        self.with(id, |held| held.newest.receiver_count()).unwrap_or(0)
    }

    /// Ids of all scenes for which `is` holds.
    pub(super) fn ids(&self, is: impl Fn(&Record) -> bool) -> Vec<SceneId> {
        let records = self.page(None, usize::MAX, is).0;
        records.iter().map(|record| record.status.id.clone()).collect()
    }

    /// Unfinished scenes that somebody watches.
    pub(super) fn watched(&self) -> Vec<SceneId> {
        let open = self.ids(|record| !record.status.state.is_final());
        open.into_iter().filter(|id| self.watchers(id) > 0).collect()
    }

    /// Up to `limit` records of those to `show`, after the scene with that creation time and id,
    /// newest first, and whether more follow.
    pub(crate) fn page(
        &self,
        after: Option<(u64, SceneId)>,
        limit: usize,
        show: impl Fn(&Record) -> bool,
    ) -> (Vec<Arc<Record>>, bool) {
        let start =
            after.map_or(Bound::Unbounded, |(created, id)| Bound::Excluded((Reverse(created), id)));
        let scenes = self.scenes.read();
        let rest = scenes.by_order.range((start, Bound::Unbounded));
        let mut rest = rest.map(|(_, held)| held.newest.borrow()).filter(|record| show(record));
        let page = rest.by_ref().take(limit).map(|record| Arc::clone(&record)).collect();
        (page, rest.next().is_some())
    }
}
