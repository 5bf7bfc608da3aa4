//! The record of every scene; a late watcher gets the newest one first.

use std::{
    cmp::Reverse,
    collections::{BTreeMap, HashMap},
    ops::Bound,
    sync::Arc,
};

use parking_lot::RwLock;
use tokio::sync::watch;

use crate::{
    scene::{SceneId, SceneState},
    store::Record,
};

/// Newest first: creation time descending, then id.
type Order = (Reverse<u64>, SceneId);

/// Records of all scenes, each with a channel that keeps the newest.
#[derive(Debug, Default)]
pub(crate) struct Records(RwLock<Inner>);

#[derive(Debug, Default)]
struct Inner {
    by_order: BTreeMap<Order, watch::Sender<Arc<Record>>>,
    created: HashMap<SceneId, u64>,
}

impl Inner {
    fn sender(&self, id: &SceneId) -> Option<&watch::Sender<Arc<Record>>> {
        let created = *self.created.get(id)?;
        self.by_order.get(&(Reverse(created), id.clone()))
    }
}

impl Records {
    pub(super) fn insert(&self, record: Record) {
        let mut inner = self.0.write();
        let (id, created) = (record.status.id.clone(), record.status.created_ms);
        inner.created.insert(id.clone(), created);
        inner.by_order.insert((Reverse(created), id), watch::Sender::new(Arc::new(record)));
    }

    /// Takes a record that was read from the store; watchers of the scene see the change.
    pub(super) fn put(&self, record: Record) {
        // A block, so that the lock ends before `insert` takes it.
        {
            let inner = self.0.read();
            if let Some(sender) = inner.sender(&record.status.id) {
                sender.send_if_modified(|known| {
                    let changed = **known != record;
                    *known = Arc::new(record);
                    changed
                });
                return;
            }
        }
        self.insert(record);
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

    /// Watchers of a scene, callers who wait for it among them.
    pub(crate) fn watchers(&self, id: &SceneId) -> usize {
        self.0.read().sender(id).map_or(0, watch::Sender::receiver_count)
    }

    pub(super) fn find(&self, id: &SceneId) -> Option<Arc<Record>> {
        Some(Arc::clone(&self.0.read().sender(id)?.borrow()))
    }

    pub(super) fn watch(&self, id: &SceneId) -> Option<watch::Receiver<Arc<Record>>> {
        Some(self.0.read().sender(id)?.subscribe())
    }

    /// Changes a record and tells its watchers; gives the changed record, `None` when deleted.
    pub(super) fn update(
        &self,
        id: &SceneId,
        change: impl FnOnce(&mut Record),
    ) -> Option<Arc<Record>> {
        let inner = self.0.read();
        let sender = inner.sender(id)?;
        sender.send_modify(|record| change(Arc::make_mut(record)));
        let record = Arc::clone(&sender.borrow());
        Some(record)
    }

    /// Takes a scene off; its watchers see it cancelled unless it was final.
    pub(super) fn remove(&self, id: &SceneId) -> bool {
        let mut inner = self.0.write();
        let Some(created) = inner.created.remove(id) else { return false };
        if let Some(sender) = inner.by_order.remove(&(Reverse(created), id.clone())) {
            sender.send_modify(|record| cancel(Arc::make_mut(record)));
        }
        true
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
        let inner = self.0.read();
        let rest = inner.by_order.range((start, Bound::Unbounded));
        let mut rest = rest.map(|(_, sender)| sender.borrow()).filter(|record| show(record));
        let page = rest.by_ref().take(limit).map(|record| Arc::clone(&record)).collect();
        (page, rest.next().is_some())
    }
}

/// Marks an unfinished scene as cancelled.
pub(super) fn cancel(record: &mut Record) {
    if !record.status.state.is_final() {
        record.status.state = SceneState::Cancelled;
        record.status.stage = None;
    }
}
