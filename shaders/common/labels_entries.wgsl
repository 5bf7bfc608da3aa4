// Entry of the bank of each Gaussian.

// [N] of 16 bits, two a word, the lower first.
@group(0) @binding(6) var<storage, read> semantic_index: array<u32>;

fn entry_of(id: u32) -> u32 {
    return (semantic_index[id >> 1u] >> ((id & 1u) * 16u)) & 0xffffu;
}
