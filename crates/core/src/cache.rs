//! A cache bounded by weight: the value that was used least recently leaves first.

use std::{collections::HashMap, hash::Hash};

use parking_lot::Mutex;

/// Values by key. It gives out clones, which must be cheap. Any thread may use it.
#[derive(Debug)]
pub struct Cache<K, V> {
    entries: Mutex<Entries<K, V>>,
}

#[derive(Debug)]
struct Entries<K, V> {
    values: HashMap<K, Kept<V>>,
    weight: u64,
    weight_max: u64,
    uses: u64,
}

#[derive(Debug)]
struct Kept<V> {
    value: V,
    weight: u64,
    /// [`Entries::uses`] at its last use.
    used: u64,
}

impl<K: Clone + Eq + Hash, V: Clone> Cache<K, V> {
    /// Keeps values of at most `weight_max` together, in the unit of [`Self::insert`].
    pub fn new(weight_max: u64) -> Self {
        let entries = Entries { values: HashMap::new(), weight: 0, weight_max, uses: 0 };
        Self { entries: Mutex::new(entries) }
    }

    /// Weight of all values.
    pub fn weight(&self) -> u64 {
        self.entries.lock().weight
    }

    /// The value of a key.
    pub fn find(&self, key: &K) -> Option<V> {
        let mut entries = self.entries.lock();
        entries.uses += 1;
        let now = entries.uses;
        let kept = entries.values.get_mut(key)?;
        kept.used = now;
        Some(kept.value.clone())
    }

    /// Keeps a value in place of the key's old one. A value heavier than the whole cache is not
    /// kept.
    pub fn insert(&self, key: K, value: V, weight: u64) {
        let mut entries = self.entries.lock();
        entries.remove(&key);
        if weight > entries.weight_max {
            return;
        }
        entries.make_room(weight);
        entries.uses += 1;
        entries.weight += weight;
        let used = entries.uses;
        entries.values.insert(key, Kept { value, weight, used });
    }

    /// Drops the value of a key.
    pub fn remove(&self, key: &K) {
        self.entries.lock().remove(key);
    }

    /// Drops every value for which `keep` is false.
    pub fn retain(&self, keep: impl Fn(&V) -> bool) {
        let mut entries = self.entries.lock();
        entries.values.retain(|_, kept| keep(&kept.value));
        entries.weight = entries.values.values().map(|kept| kept.weight).sum();
    }
}

impl<K: Clone + Eq + Hash, V> Entries<K, V> {
    fn remove(&mut self, key: &K) {
        self.weight -= self.values.remove(key).map_or(0, |kept| kept.weight);
    }

    /// Drops values until `weight` more fits.
    fn make_room(&mut self, weight: u64) {
        while self.weight.saturating_add(weight) > self.weight_max {
            let oldest = self.values.iter().min_by_key(|(_, kept)| kept.used);
            let Some(key) = oldest.map(|(key, _)| key.clone()) else { break };
            self.remove(&key);
        }
    }
}
