//! Every scene and where it stands; a late watcher gets the present state first.

use std::{
    collections::BTreeMap,
    sync::{PoisonError, RwLock, RwLockReadGuard},
};

use tokio::sync::watch;

use crate::{
    scene::{SceneId, SceneState},
    store::Record,
};

/// Newest first: creation time descending, then id.
type Order = (std::cmp::Reverse<u64>, SceneId);

/// Records of all scenes, each with a channel that keeps the newest.
#[derive(Debug, Default)]
pub(super) struct Records {
    inner: RwLock<Inner>,
}

#[derive(Debug, Default)]
struct Inner {
    by_order: BTreeMap<Order, watch::Sender<Record>>,
    created: std::collections::HashMap<SceneId, u64>,
}

impl Inner {
    fn sender(&self, id: &SceneId) -> Option<&watch::Sender<Record>> {
        let created = *self.created.get(id)?;
        self.by_order.get(&(std::cmp::Reverse(created), id.clone()))
    }
}

impl Records {
    pub(super) fn insert(&self, record: Record) {
        let mut inner = self.inner.write().unwrap_or_else(PoisonError::into_inner);
        let (id, created) = (record.status.id.clone(), record.status.created_ms);
        inner.created.insert(id.clone(), created);
        inner.by_order.insert((std::cmp::Reverse(created), id), watch::Sender::new(record));
    }

    /// Takes a record as it was found in the store; who watches the scene sees the change.
    pub(super) fn put(&self, record: Record) {
        let change = |sender: &watch::Sender<Record>| {
            sender.send_if_modified(|known| {
                let changed = *known != record;
                known.clone_from(&record);
                changed
            });
        };
        // In its own statement, so that the lock ends before `insert` takes it.
        let known = self.read().sender(&record.status.id).map(change).is_some();
        if !known {
            self.insert(record);
        }
    }

    /// Ids of all scenes for which `is` holds.
    pub(super) fn ids(&self, is: impl Fn(&Record) -> bool) -> Vec<SceneId> {
        let inner = self.read();
        let of = |sender: &watch::Sender<Record>| {
            let record = sender.borrow();
            is(&record).then(|| record.status.id.clone())
        };
        inner.by_order.values().filter_map(of).collect()
    }

    /// Unfinished scenes that somebody watches.
    pub(super) fn watched(&self) -> Vec<SceneId> {
        let inner = self.read();
        let watched = inner.by_order.values().filter(|sender| sender.receiver_count() > 0);
        let open = |sender: &watch::Sender<Record>| {
            let record = sender.borrow();
            (!record.status.state.is_final()).then(|| record.status.id.clone())
        };
        watched.filter_map(open).collect()
    }

    /// Watchers of a scene.
    pub(super) fn watchers(&self, id: &SceneId) -> usize {
        self.read().sender(id).map_or(0, watch::Sender::receiver_count)
    }

    pub(super) fn find(&self, id: &SceneId) -> Option<Record> {
        Some(self.read().sender(id)?.borrow().clone())
    }

    pub(super) fn watch(&self, id: &SceneId) -> Option<watch::Receiver<Record>> {
        Some(self.read().sender(id)?.subscribe())
    }

    /// Changes a record and tells its watchers; gives the changed record, `None` when deleted.
    pub(super) fn update(&self, id: &SceneId, change: impl FnOnce(&mut Record)) -> Option<Record> {
        let inner = self.read();
        let sender = inner.sender(id)?;
        sender.send_modify(change);
        let record = sender.borrow().clone();
        Some(record)
    }

    /// Takes a scene off; its watchers see it cancelled unless it was final.
    pub(super) fn remove(&self, id: &SceneId) -> bool {
        let mut inner = self.inner.write().unwrap_or_else(PoisonError::into_inner);
        let Some(created) = inner.created.remove(id) else { return false };
        let sender = inner.by_order.remove(&(std::cmp::Reverse(created), id.clone()));
        if let Some(sender) = sender {
            sender.send_modify(|record| {
                if !record.status.state.is_final() {
                    record.status.state = SceneState::Cancelled;
                    record.status.stage = None;
                }
            });
        }
        true
    }

    /// Up to `limit` records of those to `show`, after the scene with that creation time and id,
    /// newest first, and whether more follow.
    pub(super) fn page(
        &self,
        after: Option<(u64, SceneId)>,
        limit: usize,
        show: impl Fn(&Record) -> bool,
    ) -> (Vec<Record>, bool) {
        use std::ops::Bound;
        let start = after.map_or(Bound::Unbounded, |(created, id)| {
            Bound::Excluded((std::cmp::Reverse(created), id))
        });
        let inner = self.read();
        let mut rest = inner
            .by_order
            .range((start, Bound::Unbounded))
            .map(|(_, sender)| sender.borrow())
            .filter(|record| show(record));
        let page = rest.by_ref().take(limit).map(|record| record.clone()).collect();
        (page, rest.next().is_some())
    }

    fn read(&self) -> RwLockReadGuard<'_, Inner> {
        self.inner.read().unwrap_or_else(PoisonError::into_inner)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scene::SceneStatus;

    fn record(byte: u8, created_ms: u64) -> Record {
        let id = SceneId::from_bytes([byte; 16]);
        let status = SceneStatus::new(id, SceneState::Queued, created_ms);
        Record { owner: byte.is_multiple_of(2).then(|| "even".to_owned()), ..Record::new(status) }
    }

    #[test]
    fn pages_go_from_the_newest_and_miss_none_when_scenes_come_and_go() {
        let records = Records::default();
        for (byte, created) in [(1, 10), (2, 30), (3, 20), (4, 20)] {
            records.insert(record(byte, created));
        }
        let ids = |records: &[Record]| -> Vec<u8> {
            let digits = |r: &Record| r.status.id.as_str()[..2].to_owned();
            records.iter().map(|r| u8::from_str_radix(&digits(r), 16).unwrap()).collect()
        };
        let (first, more) = records.page(None, 2, |_| true);
        assert_eq!((ids(&first), more), (vec![2, 3], true));
        let last = &first[1].status;
        records.insert(record(9, 99));
        records.remove(&last.id);
        let (second, more) = records.page(Some((last.created_ms, last.id.clone())), 2, |_| true);
        assert_eq!((ids(&second), more), (vec![4, 1], false));
        let (own, more) = records.page(None, 1, |record| record.owner.is_some());
        assert_eq!((ids(&own), more), (vec![2], true), "more of one's own");
        let after = Some((own[0].status.created_ms, own[0].status.id.clone()));
        let (own, more) = records.page(after, 1, |record| record.owner.is_some());
        assert_eq!((ids(&own), more), (vec![4], false), "others' scenes are no more");
    }

    #[test]
    fn a_late_watcher_sees_the_present_state_and_a_deleted_scene_ends_as_cancelled() {
        let records = Records::default();
        records.insert(record(1, 0));
        let id = SceneId::from_bytes([1; 16]);
        records.update(&id, |record| record.status.fraction = 0.5).unwrap();
        let watcher = records.watch(&id).unwrap();
        assert!((watcher.borrow().status.fraction - 0.5).abs() < 1e-6);
        assert!(records.remove(&id));
        assert_eq!(watcher.borrow().status.state, SceneState::Cancelled);
        assert!(watcher.has_changed().is_err(), "no sender is left");
        assert!(records.find(&id).is_none() && !records.remove(&id));
    }
}
