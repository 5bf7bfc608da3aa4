// Stage 5: the list of each tile in the order of depth, then of the scene.
// CPU: crates/render/src/cpu/rasterize.rs (in portions)
//
// Up to SORT_RUN pairs are sorted in workgroup memory, by a bitonic network of one word each: the
// depth between the least and the largest one of them in 21 bits, and which pair it is. An
// invocation takes eight words at a time through up to three stages of the network. The few pairs
// whose bits are equal are put in order when they are written. Longer lists are merged in the
// device's memory; where many bits are equal, from single pairs on. A software adapter, where a
// barrier costs more than a merge, does only that, with few invocations.

@group(0) @binding(1) var<storage, read> starts: array<u32>;
@group(0) @binding(2) var<storage, read> ends: array<u32>;
// [2][views][capacity] of (depth key, Gaussian).
@group(0) @binding(3) var<storage, read_write> pairs: array<vec2<u32>>;
// First pair of each tile, sorted, and one past its last.
@group(0) @binding(4) var<storage, read_write> lists: array<vec2<u32>>;

// Invocations of a workgroup on a software adapter. It leaves loops after 65,535 turns, so one
// alone could not merge a long list.
const SERIAL_SIZE: u32 = 64u;

// Bits of a word that say which pair it is.
const PLACE_BITS: u32 = 11u;
// More pairs of equal bits than this are merged.
const EQUAL_MAX: u32 = 32u;

var<workgroup> run: array<u32, SORT_RUN>;
// Whether too many pairs of a run have equal bits.
var<workgroup> crowded: atomic<u32>;
var<private> eight: array<u32, 8>;

fn is_after(a: vec2<u32>, b: vec2<u32>) -> bool {
    return a.x > b.x || (a.x == b.x && a.y > b.y);
}

// Orders two of the eight.
fn order(a: u32, b: u32) {
    let one = eight[a];
    let other = eight[b];
    eight[a] = min(one, other);
    eight[b] = max(one, other);
}

// Place of number i in `run`: those that an invocation and its neighbours take lie in different
// banks.
fn bank(i: u32) -> u32 {
    return i ^ ((i >> 5u) & 7u) ^ ((i >> 3u) & 24u);
}

// The least and the largest depth key of `count` pairs from `first` on.
fn reach_of(first: u32, count: u32, local: u32) -> vec2<u32> {
    var reach = vec2(0xffffffffu, 0u);
    for (var i = local; i < count; i += WORKGROUP_SIZE) {
        let key = pairs[first + i].x;
        reach = vec2(min(reach.x, key), max(reach.y, key));
    }
    run[local] = reach.x;
    run[WORKGROUP_SIZE + local] = reach.y;
    workgroupBarrier();
    if local < 16u {
        for (var k = 16u; k < WORKGROUP_SIZE; k += 16u) {
            reach.x = min(reach.x, run[local + k]);
            reach.y = max(reach.y, run[WORKGROUP_SIZE + local + k]);
        }
        run[2u * WORKGROUP_SIZE + local] = reach.x;
        run[2u * WORKGROUP_SIZE + 16u + local] = reach.y;
    }
    workgroupBarrier();
    for (var k = 0u; k < 16u; k++) {
        reach.x = min(reach.x, run[2u * WORKGROUP_SIZE + k]);
        reach.y = max(reach.y, run[2u * WORKGROUP_SIZE + 16u + k]);
    }
    workgroupBarrier();
    return reach;
}

// Sorts `count` pairs from `first` on, at most SORT_RUN, into those from `to` on.
fn sort_run(first: u32, to: u32, count: u32, local: u32) {
    let reach = reach_of(first, count, local);
    let shift = max(32u - countLeadingZeros(reach.y - reach.x), 32u - PLACE_BITS)
        - (32u - PLACE_BITS);
    // Of 2^size_bits numbers, at least 8; those after the last pair are the largest.
    let size_bits = max(32u - countLeadingZeros(max(count, 1u) - 1u), 3u);
    let works = local < (1u << (size_bits - 3u));
    for (var i = local; i < (1u << size_bits); i += WORKGROUP_SIZE) {
        var one = 0xffffffffu;
        if i < count {
            one = (((pairs[first + i].x - reach.x) >> shift) << PLACE_BITS) | i;
        }
        run[bank(i)] = one;
    }
    workgroupBarrier();
    for (var size = 1u; size <= size_bits; size++) {
        // Stages of distances 2^(high) down to 1, up to three at a time.
        var above = size;
        if size < 3u {
            above = 0u;
        }
        while above > 0u {
            let low = max(above, 3u) - 3u;
            if works {
                let base = (local & ((1u << low) - 1u)) | ((local >> low) << (low + 3u));
                for (var k = 0u; k < 8u; k++) {
                    eight[k] = run[bank(base + (k << low))];
                }
                if size == 3u {
                    // The first two sizes: those that are to descend are turned around.
                    eight[2] = ~eight[2];
                    eight[3] = ~eight[3];
                    eight[6] = ~eight[6];
                    eight[7] = ~eight[7];
                    order(0u, 1u);
                    order(2u, 3u);
                    order(4u, 5u);
                    order(6u, 7u);
                    eight[2] = ~eight[2];
                    eight[3] = ~eight[3];
                    eight[4] = ~eight[4];
                    eight[5] = ~eight[5];
                    order(0u, 2u);
                    order(1u, 3u);
                    order(4u, 6u);
                    order(5u, 7u);
                    order(0u, 1u);
                    order(2u, 3u);
                    order(4u, 5u);
                    order(6u, 7u);
                    eight[4] = ~eight[4];
                    eight[5] = ~eight[5];
                    eight[6] = ~eight[6];
                    eight[7] = ~eight[7];
                }
                let turned = select(0xffffffffu, 0u, (base & (1u << size)) == 0u);
                for (var k = 0u; k < 8u; k++) {
                    eight[k] ^= turned;
                }
                if above > low + 2u {
                    order(0u, 4u);
                    order(1u, 5u);
                    order(2u, 6u);
                    order(3u, 7u);
                }
                if above > low + 1u {
                    order(0u, 2u);
                    order(1u, 3u);
                    order(4u, 6u);
                    order(5u, 7u);
                }
                order(0u, 1u);
                order(2u, 3u);
                order(4u, 5u);
                order(6u, 7u);
                for (var k = 0u; k < 8u; k++) {
                    run[bank(base + (k << low))] = eight[k] ^ turned;
                }
            }
            workgroupBarrier();
            above = low;
        }
    }
    for (var i = local; i < count; i += WORKGROUP_SIZE) {
        let word = run[bank(i)];
        let pair = pairs[first + (word & (SORT_RUN - 1u))];
        // Those of equal bits around it.
        var begin = i;
        var place = i;
        while begin > 0u && i - begin < EQUAL_MAX
            && ((run[bank(begin - 1u)] ^ word) >> PLACE_BITS) == 0u {
            begin--;
            let other = pairs[first + (run[bank(begin)] & (SORT_RUN - 1u))];
            place -= u32(!is_after(pair, other));
        }
        var last = i + 1u;
        while last < count && last - begin <= EQUAL_MAX
            && ((run[bank(last)] ^ word) >> PLACE_BITS) == 0u {
            let other = pairs[first + (run[bank(last)] & (SORT_RUN - 1u))];
            place += u32(is_after(pair, other));
            last++;
        }
        if last - begin > EQUAL_MAX {
            atomicStore(&crowded, 1u);
        }
        pairs[to + place] = pair;
    }
}

// Merges runs of `width` pairs of a list, two by two, from one half to the other: the share of one
// of `sharers` invocations.
fn merge(from_first: u32, to_first: u32, count: u32, width: u32, local: u32, sharers: u32) {
    let share = (count + sharers - 1u) / sharers;
    var at = min(local * share, count);
    let end = min(at + share, count);
    while at < end {
        let left = at / (2u * width) * (2u * width);
        let right = min(left + width, count);
        let last = min(right + width, count);
        // How many of the first `at - left` are of the left run: those not after the others.
        let before = at - left;
        var low = before - min(before, last - right);
        var high = min(before, right - left);
        while low < high {
            let middle = (low + high) / 2u;
            let one = pairs[from_first + left + middle];
            let other = pairs[from_first + right + before - 1u - middle];
            if is_after(one, other) {
                high = middle;
            } else {
                low = middle + 1u;
            }
        }
        var i = left + low;
        var j = right + before - low;
        let until = min(end, last);
        while at < until {
            var takes_left = j >= last;
            if i < right && j < last {
                takes_left = !is_after(pairs[from_first + i], pairs[from_first + j]);
            }
            let taken = select(j, i, takes_left);
            pairs[to_first + at] = pairs[from_first + taken];
            i += u32(takes_left);
            j += u32(!takes_left);
            at++;
        }
    }
}

// Merges the runs of `width` pairs of a tile's list, which are in the half `since` (0 or 1), until
// one is left.
fn merge_all(
    tile: u32, list: vec2<u32>, width: u32, half: u32, since: u32, local: u32, sharers: u32,
) {
    let count = list.y - list.x;
    let rounds = select(32u - countLeadingZeros((count - 1u) / width), 0u, count <= width);
    for (var round = 0u; round < rounds; round++) {
        storageBarrier();
        let from_first = list.x + ((round + since) & 1u) * half;
        let to_first = list.x + (1u - ((round + since) & 1u)) * half;
        merge(from_first, to_first, count, width << round, local, sharers);
    }
    if local == 0u {
        lists[tile] = list + ((rounds + since) & 1u) * half;
    }
}

// The list of a tile as emitted.
fn list_of(tile: u32) -> vec2<u32> {
    return views[which].pair_start + vec2(starts[tile], min(ends[tile], starts[tile + 1u]));
}

fn is_tile(group: vec3<u32>) -> bool {
    // Views of a batch may differ in size.
    return group.x < views[which].tiles_x
        && group.y < views[which].row_end - views[which].row_start;
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    if !is_tile(group) {
        return;
    }
    let tile = views[which].range_start + group.y * views[which].tiles_x + group.x;
    let list = list_of(tile);
    let half = groups.z * views[which].isect_capacity;
    if local == 0u {
        atomicStore(&crowded, 0u);
    }
    for (var start = list.x; start < list.y; start += SORT_RUN) {
        workgroupBarrier();
        sort_run(start, start + half, min(list.y - start, SORT_RUN), local);
    }
    workgroupBarrier();
    let again = atomicLoad(&crowded) > 0u;
    let width = select(SORT_RUN, 1u, again);
    merge_all(tile, list, width, half, select(1u, 0u, again), local, WORKGROUP_SIZE);
}

@compute @workgroup_size(SERIAL_SIZE)
fn serial(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    if !is_tile(group) {
        return;
    }
    let tile = views[which].range_start + group.y * views[which].tiles_x + group.x;
    let half = groups.z * views[which].isect_capacity;
    merge_all(tile, list_of(tile), 1u, half, 0u, local, SERIAL_SIZE);
}
