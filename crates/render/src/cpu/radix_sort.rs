//! Stages 2 and 6: stable radix sort of (key, value) pairs. Shader: `shaders/radix_sort.wgsl`

/// Bits of a digit: 2,048 counters stay in the level-1 cache.
const DIGIT_BITS: u32 = 11;
const DIGITS: usize = 1 << DIGIT_BITS;

/// Packs a key and a value; sorting looks at the key only.
#[inline]
pub fn pack(key: u32, value: u32) -> u64 {
    u64::from(key) << 32 | u64::from(value)
}

/// The value of a packed pair.
#[inline]
pub fn value(pair: u64) -> u32 {
    pair as u32
}

/// The key of a packed pair.
#[inline]
pub fn key(pair: u64) -> u32 {
    (pair >> 32) as u32
}

/// Sorts `pairs` by key, stable, in time linear in their number; `spare` is scratch. Only the
/// lowest `key_bits` bits of a key are compared. Other bits must be 0.
pub fn radix_sort(pairs: &mut Vec<u64>, spare: &mut Vec<u64>, key_bits: u32) {
    spare.resize(pairs.len(), 0);
    let mut shift = 32;
    while shift < 32 + key_bits {
        let digit = |pair: u64| (pair >> shift) as usize & (DIGITS - 1);
        let mut next = [0_usize; DIGITS];
        for &pair in pairs.iter() {
            next[digit(pair)] += 1;
        }
        let mut start = 0;
        for slot in &mut next {
            start += std::mem::replace(slot, start);
        }
        for &pair in pairs.iter() {
            let slot = &mut next[digit(pair)];
            spare[*slot] = pair;
            *slot += 1;
        }
        std::mem::swap(pairs, spare);
        shift += DIGIT_BITS;
    }
}
