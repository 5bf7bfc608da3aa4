// Stages 2 and 6: one digit (8 bits) of a stable radix sort of (key, value) pairs.
// Twin: src/render/cpu/radix_sort.rs
//
// histogram counts the digits of each block; prefix_sum turns the counts (digit by digit, in each
// digit block by block) into first places; scatter moves the pairs. No subgroups: the rank of a
// pair among equals of its round is a count of bits in a mask of 256.

@group(0) @binding(0) var<uniform> params: SortParams;
@group(0) @binding(1) var<storage, read> plan: PlanRead;
@group(0) @binding(2) var<storage, read> keys_in: array<u32>;
@group(0) @binding(3) var<storage, read> values_in: array<u32>;
@group(0) @binding(4) var<storage, read_write> keys_out: array<u32>;
@group(0) @binding(5) var<storage, read_write> values_out: array<u32>;
@group(0) @binding(6) var<storage, read_write> digit_counts: array<u32>;

// Words of a mask of WORKGROUP_SIZE bits.
const MASK_WORDS: u32 = 8u;

var<workgroup> counts: array<atomic<u32>, 256>;
// Word w of digit d's mask is masks[w * 256 + d].
var<workgroup> masks: array<atomic<u32>, 2048>;
var<workgroup> places: array<u32, 256>;

fn pair_count() -> u32 {
    return select(params.count, plan.isects, params.count == COUNT_FROM_PLAN);
}

fn digit_of(key: u32) -> u32 {
    return (key >> params.shift) & 255u;
}

@compute @workgroup_size(256)
fn histogram(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let count = pair_count();
    let blocks = (count + SORT_BLOCK - 1u) / SORT_BLOCK;
    let block = group.y * groups.x + group.x;
    atomicStore(&counts[local], 0u);
    workgroupBarrier();
    if block < blocks {
        let end = min(count, (block + 1u) * SORT_BLOCK);
        for (var i = block * SORT_BLOCK + local; i < end; i += WORKGROUP_SIZE) {
            atomicAdd(&counts[digit_of(keys_in[i])], 1u);
        }
    }
    workgroupBarrier();
    if block < blocks {
        digit_counts[local * blocks + block] = atomicLoad(&counts[local]);
    }
}

@compute @workgroup_size(256)
fn scatter(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let count = pair_count();
    let blocks = (count + SORT_BLOCK - 1u) / SORT_BLOCK;
    let block = group.y * groups.x + group.x;
    if block < blocks {
        places[local] = digit_counts[local * blocks + block];
    }
    for (var word = 0u; word < MASK_WORDS; word++) {
        atomicStore(&masks[word * 256u + local], 0u);
    }
    workgroupBarrier();
    // Every invocation takes every round: barriers stand in uniform control flow.
    for (var round = 0u; round < SORT_BLOCK / WORKGROUP_SIZE; round++) {
        let i = block * SORT_BLOCK + round * WORKGROUP_SIZE + local;
        let valid = block < blocks && i < count;
        let my_word = local / 32u;
        let my_bit = 1u << (local % 32u);
        var key = 0u;
        if valid {
            key = keys_in[i];
            atomicOr(&masks[my_word * 256u + digit_of(key)], my_bit);
        }
        workgroupBarrier();
        if valid {
            let digit = digit_of(key);
            var rank = countOneBits(atomicLoad(&masks[my_word * 256u + digit]) & (my_bit - 1u));
            for (var word = 0u; word < my_word; word++) {
                rank += countOneBits(atomicLoad(&masks[word * 256u + digit]));
            }
            let place = places[digit] + rank;
            keys_out[place] = key;
            values_out[place] = values_in[i];
        }
        workgroupBarrier();
        // Here an invocation looks after the digit of its own number.
        var taken = 0u;
        for (var word = 0u; word < MASK_WORDS; word++) {
            let at = word * 256u + local;
            taken += countOneBits(atomicLoad(&masks[at]));
            atomicStore(&masks[at], 0u);
        }
        places[local] += taken;
        workgroupBarrier();
    }
}
