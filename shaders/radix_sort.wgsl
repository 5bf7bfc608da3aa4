// Stages 2 and 6: one digit (8 bits) of a stable radix sort of (key, value) pairs.
// CPU: crates/render/src/cpu/radix_sort.rs
//
// histogram counts the digits of each block. spine turns the counts of a digit into places, block
// by block. scatter moves the pairs. There are no subgroups: the rank of a pair among equal digits
// of its round is a count of bits in a mask of 128. On a software adapter a barrier costs more than
// a move; there spine_serial and scatter_serial are used, in which one invocation moves a block.
//
// The first digit of the depth sort drops Gaussians without tiles. Its pairs have no values yet:
// the values are the places in memory, so equal depths keep the order of the scene. Keys are
// relative to the smallest one, and digits that are then 0 for all keys are not sorted. Keys of a
// fast view are cut to two digits.

@group(0) @binding(1) var<uniform> params: SortParams;
@group(0) @binding(2) var<storage, read_write> plans: array<Plan>;
// [2][views][stride]: a digit is sorted from one half to the other.
@group(0) @binding(3) var<storage, read_write> keys: array<u32>;
@group(0) @binding(4) var<storage, read_write> values: array<u32>;
// [views][digit][block], then [views][digit] totals.
@group(0) @binding(5) var<storage, read_write> digit_counts: array<u32>;
@group(0) @binding(6) var<storage, read_write> groups_of: array<atomic<u32>>;

// Work that is left out because no pixel changes (crates/render/src/switches.rs).
override SKIP_UNSEEN: bool = true;
override SKIP_EQUAL_DIGITS: bool = true;

const DIGITS: u32 = 256u;
// Invocations of a serial workgroup: lanes of a software adapter.
const SERIAL_SIZE: u32 = 8u;
// Words of a mask of SORT_SIZE bits.
const MASK_WORDS: u32 = 4u;
const MASK: u32 = 1024u;

var<workgroup> counts: array<atomic<u32>, 256>;
// Word w of digit d's mask of round r is masks[(r % 3) * MASK + w * DIGITS + d].
var<workgroup> masks: array<atomic<u32>, 3072>;
// First place of each digit in rounds of even and odd number.
var<workgroup> places: array<u32, 512>;

fn stride() -> u32 {
    return select(views[which].gaussian_count, views[which].isect_capacity, params.by_tile != 0u);
}

fn is_first() -> bool {
    return params.by_tile == 0u && params.pass_at == 0u;
}

fn pair_count() -> u32 {
    if params.by_tile != 0u {
        return plans[which].isects;
    }
    if params.pass_at == 0u {
        return views[which].gaussian_count;
    }
    return atomicLoad(&plans[which].sorted);
}

fn least_key() -> u32 {
    return select(0u, atomicLoad(&plans[which].key_min), is_first());
}

// Lowest bits of a depth that a fast view leaves out.
fn blunt_bits() -> u32 {
    let range = atomicLoad(&plans[which].key_max) - atomicLoad(&plans[which].key_min);
    let bits = max(32u - countLeadingZeros(range), FAST_KEY_BITS);
    return select(0u, bits - FAST_KEY_BITS, is_first() && views[which].fast != 0u);
}

fn blocks_of(count: u32) -> u32 {
    return (count + SORT_BLOCK - 1u) / SORT_BLOCK;
}

fn counts_start() -> u32 {
    return which * DIGITS * blocks_of(stride());
}

fn totals_start(view_count: u32) -> u32 {
    return view_count * DIGITS * blocks_of(stride()) + which * DIGITS;
}

fn digit_of(key: u32) -> u32 {
    return (key >> params.shift) & (DIGITS - 1u);
}

@compute @workgroup_size(256)
fn histogram(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    let count = pair_count();
    let blocks = blocks_of(count);
    let block = group.y * groups.x + group.x;
    let first = ((params.pass_at & 1u) * groups.z + which) * stride();
    let least = least_key();
    let drops = is_first() && SKIP_UNSEEN;
    let blunt = blunt_bits();
    atomicStore(&counts[local], 0u);
    workgroupBarrier();
    if block < blocks {
        let end = min(count, (block + 1u) * SORT_BLOCK);
        for (var i = block * SORT_BLOCK + local; i < end; i += WORKGROUP_SIZE) {
            let key = keys[first + i];
            if !(drops && key == DROPPED_KEY) {
                atomicAdd(&counts[digit_of((key - least) >> blunt)], 1u);
            }
        }
    }
    workgroupBarrier();
    if block < blocks {
        digit_counts[counts_start() + local * blocks + block] = atomicLoad(&counts[local]);
    }
}

// One workgroup a digit.
@compute @workgroup_size(256)
fn spine(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    let digit = group.x;
    let blocks = blocks_of(pair_count());
    let each = (blocks + WORKGROUP_SIZE - 1u) / WORKGROUP_SIZE;
    let row = counts_start() + digit * blocks;
    let first = min(local * each, blocks);
    let end = min(first + each, blocks);
    let sum = sum_of(row, first, end);
    let before = sum_before(local, sum);
    if local == WORKGROUP_SIZE - 1u {
        let total = before + sum;
        digit_counts[totals_start(groups.z) + digit] = total;
        if is_first() && total > 0u {
            atomicAdd(&plans[which].sorted, total);
        }
    }
    place_blocks(row, first, end, before);
    if digit == 0u && local == 0u {
        plan_digits(blocks, DIGITS, groups.z);
    }
}

fn sum_of(row: u32, first: u32, end: u32) -> u32 {
    var sum = 0u;
    for (var block = first; block < end; block++) {
        sum += digit_counts[row + block];
    }
    return sum;
}

// Makes first places of the counts of a digit's blocks.
fn place_blocks(row: u32, first: u32, end: u32, start: u32) {
    var before = start;
    for (var block = first; block < end; block++) {
        let count = digit_counts[row + block];
        digit_counts[row + block] = before;
        before += count;
    }
}

// The digits that are left: as many as the view with the widest range of depths needs.
fn plan_digits(blocks: u32, spines: u32, view_count: u32) {
    if !is_first() {
        return;
    }
    let low = atomicLoad(&plans[which].key_min);
    let high = atomicLoad(&plans[which].key_max);
    let bits = select(0u, 32u - countLeadingZeros(high - low), low < high) - blunt_bits();
    let passes = select(4u, max(1u, (bits + 7u) / 8u), SKIP_EQUAL_DIGITS);
    atomicMax(&plans[0].passes, passes);
    let x = min(blocks, GROUPS_X_MAX);
    for (var at = 1u; at < 4u; at++) {
        let by_block = (GROUPS_DEPTH + at - 1u) * 4u;
        let by_digit = (GROUPS_DIGITS + at - 1u) * 4u;
        atomicMax(&groups_of[by_block], x);
        atomicMax(&groups_of[by_block + 1u], (blocks + x - 1u) / x);
        atomicMax(&groups_of[by_digit], spines);
        atomicMax(&groups_of[by_digit + 1u], 1u);
        if at < passes {
            atomicMax(&groups_of[by_block + 2u], view_count);
            atomicMax(&groups_of[by_digit + 2u], view_count);
        }
    }
}

// The same for a software adapter, in one workgroup: the places are those among all pairs.
@compute @workgroup_size(256)
fn spine_serial(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) digit: u32,
) {
    which = group.z;
    let blocks = blocks_of(pair_count());
    let row = counts_start() + digit * blocks;
    let sum = sum_of(row, 0u, blocks);
    let before = sum_before(digit, sum);
    place_blocks(row, 0u, blocks, before);
    if digit == DIGITS - 1u {
        plan_digits(blocks, 1u, groups.z);
        if is_first() {
            atomicStore(&plans[which].sorted, before + sum);
        }
    }
}

@compute @workgroup_size(128)
fn scatter(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    let count = pair_count();
    let blocks = blocks_of(count);
    let block = group.y * groups.x + group.x;
    let from_half = params.pass_at & 1u;
    let from_start = (from_half * groups.z + which) * stride();
    let to_start = ((1u - from_half) * groups.z + which) * stride();
    let least = least_key();
    let drops = is_first() && SKIP_UNSEEN;
    let blunt = blunt_bits();

    let totals = totals_start(groups.z);
    sums[local] = digit_counts[totals + local];
    sums[local + SORT_SIZE] = digit_counts[totals + local + SORT_SIZE];
    for (var k = local; k < 3u * MASK; k += SORT_SIZE) {
        atomicStore(&masks[k], 0u);
    }
    workgroupBarrier();
    if local < 16u {
        var sum = 0u;
        for (var k = 0u; k < 16u; k++) {
            sum += sums[local * 16u + k];
        }
        places[256u + local] = sum;
    }
    workgroupBarrier();
    for (var digit = local; digit < DIGITS; digit += SORT_SIZE) {
        var before = 0u;
        for (var k = 0u; k < digit / 16u; k++) {
            before += places[256u + k];
        }
        for (var k = digit & 0xf0u; k < digit; k++) {
            before += sums[k];
        }
        if block < blocks {
            before += digit_counts[counts_start() + digit * blocks + block];
        }
        places[digit] = before;
    }
    // Sums of sixteen stand where the odd rounds' places will: all must have read them.
    workgroupBarrier();

    let word = (local / 32u) * DIGITS;
    let bit = 1u << (local % 32u);
    let first = block * SORT_BLOCK + local;
    let end = select(0u, min(count, (block + 1u) * SORT_BLOCK), block < blocks);
    var next_key = DROPPED_KEY;
    if first < end {
        next_key = keys[from_start + first];
    }
    var cleared = 0u;
    var clears = false;
    // Every invocation takes every round: barriers stand in uniform control flow.
    for (var round = 0u; round < SORT_BLOCK / SORT_SIZE; round++) {
        let i = first + round * SORT_SIZE;
        let key = (next_key - least) >> blunt;
        let valid = i < end && !(drops && next_key == DROPPED_KEY);
        let digit = digit_of(key);
        let mask = (round % 3u) * MASK;
        var value = i;
        if valid {
            atomicOr(&masks[mask + word + digit], bit);
            if !is_first() {
                value = values[from_start + i];
            }
        }
        // On its way while the others arrive.
        if i + SORT_SIZE < end {
            next_key = keys[from_start + i + SORT_SIZE];
        }
        workgroupBarrier();
        // One barrier a round: masks of three rounds and places of two take turns.
        let now = (round & 1u) * 256u;
        if valid {
            var rank = countOneBits(atomicLoad(&masks[mask + word + digit]) & (bit - 1u));
            for (var w = 0u; w < word; w += DIGITS) {
                rank += countOneBits(atomicLoad(&masks[mask + w + digit]));
            }
            let place = to_start + places[now + digit] + rank;
            keys[place] = key;
            values[place] = value;
        }
        for (var owned = local; owned < DIGITS; owned += SORT_SIZE) {
            var taken = places[now + owned];
            for (var w = 0u; w < MASK; w += DIGITS) {
                taken += countOneBits(atomicLoad(&masks[mask + w + owned]));
            }
            places[256u - now + owned] = taken;
        }
        if clears {
            atomicStore(&masks[cleared], 0u);
        }
        clears = valid;
        cleared = mask + word + digit;
    }
}

@compute @workgroup_size(SERIAL_SIZE)
fn scatter_serial(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    let count = pair_count();
    let blocks = blocks_of(count);
    // As many workgroups come as there are blocks: the last ones find none left.
    let block = (group.y * groups.x + group.x) * SERIAL_SIZE + local;
    if block >= blocks {
        return;
    }
    let from_half = params.pass_at & 1u;
    let from_start = (from_half * groups.z + which) * stride();
    let to_start = ((1u - from_half) * groups.z + which) * stride();
    let least = least_key();
    let drops = is_first() && SKIP_UNSEEN;
    let blunt = blunt_bits();
    let places = counts_start() + block;
    let end = min(count, (block + 1u) * SORT_BLOCK);
    for (var i = block * SORT_BLOCK; i < end; i++) {
        let given = keys[from_start + i];
        if drops && given == DROPPED_KEY {
            continue;
        }
        let key = (given - least) >> blunt;
        let at = places + digit_of(key) * blocks;
        let place = digit_counts[at];
        digit_counts[at] = place + 1u;
        keys[to_start + place] = key;
        if is_first() {
            values[to_start + place] = i;
        } else {
            values[to_start + place] = values[from_start + i];
        }
    }
}
