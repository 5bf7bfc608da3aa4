// Bank index of each Gaussian.

// Gaussian of each place in depth order.
@group(0) @binding(5) var<storage, read> depth_ids: array<u32>;
// [N] of 16 bits, two a word, the lower first.
@group(0) @binding(6) var<storage, read> semantic_index: array<u32>;

fn index_of(id: u32) -> u32 {
    let gaussian = depth_ids[id];
    return (semantic_index[gaussian >> 1u] >> ((gaussian & 1u) * 16u)) & 0xffffu;
}

