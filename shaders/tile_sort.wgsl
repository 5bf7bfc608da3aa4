// Stage 5: the list of each tile in the order of depth, then of the scene.
// CPU: crates/render/src/cpu/rasterize.rs (in portions)
//
// Up to SORT_RUN pairs are sorted in workgroup memory, by a bitonic network. An invocation takes
// eight numbers at a time through up to three stages of it. Longer lists are merged in the device's
// memory. On a software adapter, where a barrier costs more than a merge, few invocations merge a
// list from single pairs on.

@group(0) @binding(1) var<storage, read> starts: array<u32>;
@group(0) @binding(2) var<storage, read> ends: array<u32>;
// [2][views][capacity] of (depth key, Gaussian).
@group(0) @binding(3) var<storage, read_write> pairs: array<vec2<u32>>;
// First pair of each tile, sorted, and one past its last.
@group(0) @binding(4) var<storage, read_write> lists: array<vec2<u32>>;

// Invocations of a workgroup on a software adapter. It leaves loops after 65,535 turns, so one
// alone could not merge a long list.
const SERIAL_SIZE: u32 = 64u;

var<workgroup> run: array<vec2<u32>, SORT_RUN>;
var<private> eight: array<vec2<u32>, 8>;

fn is_after(a: vec2<u32>, b: vec2<u32>) -> bool {
    return a.x > b.x || (a.x == b.x && a.y > b.y);
}

// Orders two of the eight.
fn order(a: u32, b: u32, up: bool) {
    let one = eight[a];
    let other = eight[b];
    let swap = is_after(one, other) == up;
    eight[a] = select(one, other, swap);
    eight[b] = select(other, one, swap);
}

// Place of number i in `run`: neighbours of eight lie in different banks.
fn bank(i: u32) -> u32 {
    return i ^ ((i >> 4u) & 15u);
}

// Sorts `count` pairs from `first` on, at most SORT_RUN.
fn sort_run(first: u32, count: u32, local: u32) {
    // Of 2^bits numbers, at least 8; those after the last pair are the largest.
    let bits = max(32u - countLeadingZeros(max(count, 1u) - 1u), 3u);
    let works = local < (1u << (bits - 3u));
    for (var i = local; i < (1u << bits); i += WORKGROUP_SIZE) {
        var one = vec2(0xffffffffu);
        if i < count {
            one = pairs[first + i];
        }
        run[bank(i)] = one;
    }
    workgroupBarrier();
    for (var size = 1u; size <= bits; size++) {
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
                    // The first three sizes at once.
                    order(0u, 1u, true);
                    order(2u, 3u, false);
                    order(4u, 5u, true);
                    order(6u, 7u, false);
                    order(0u, 2u, true);
                    order(1u, 3u, true);
                    order(4u, 6u, false);
                    order(5u, 7u, false);
                    order(0u, 1u, true);
                    order(2u, 3u, true);
                    order(4u, 5u, false);
                    order(6u, 7u, false);
                }
                let up = (base & (1u << size)) == 0u;
                if above > low + 2u {
                    order(0u, 4u, up);
                    order(1u, 5u, up);
                    order(2u, 6u, up);
                    order(3u, 7u, up);
                }
                if above > low + 1u {
                    order(0u, 2u, up);
                    order(1u, 3u, up);
                    order(4u, 6u, up);
                    order(5u, 7u, up);
                }
                order(0u, 1u, up);
                order(2u, 3u, up);
                order(4u, 5u, up);
                order(6u, 7u, up);
                for (var k = 0u; k < 8u; k++) {
                    run[bank(base + (k << low))] = eight[k];
                }
            }
            workgroupBarrier();
            above = low;
        }
    }
    for (var i = local; i < count; i += WORKGROUP_SIZE) {
        pairs[first + i] = run[bank(i)];
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

// Merges the runs of `width` pairs of a tile's list until one is left.
fn merge_all(tile: u32, list: vec2<u32>, width: u32, half: u32, local: u32, sharers: u32) {
    let count = list.y - list.x;
    let rounds = select(32u - countLeadingZeros((count - 1u) / width), 0u, count <= width);
    for (var round = 0u; round < rounds; round++) {
        storageBarrier();
        let from_first = list.x + (round & 1u) * half;
        let to_first = list.x + (1u - (round & 1u)) * half;
        merge(from_first, to_first, count, width << round, local, sharers);
    }
    if local == 0u {
        lists[tile] = list + (rounds & 1u) * half;
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
    for (var start = list.x; start < list.y; start += SORT_RUN) {
        sort_run(start, min(list.y - start, SORT_RUN), local);
        workgroupBarrier();
    }
    let half = groups.z * views[which].isect_capacity;
    merge_all(tile, list, SORT_RUN, half, local, WORKGROUP_SIZE);
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
    merge_all(tile, list_of(tile), 1u, half, local, SERIAL_SIZE);
}
