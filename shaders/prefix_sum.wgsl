// Stage 3: where the list of each tile starts. Sums stay at u32::MAX.
// CPU: crates/render/src/cpu/bin.rs

@group(0) @binding(1) var<storage, read_write> plans: array<Plan>;
@group(0) @binding(2) var<storage, read_write> starts: array<u32>;
// Before: Gaussians of each tile. After: the start of its list.
@group(0) @binding(3) var<storage, read_write> ends: array<u32>;

// Tiles of an invocation at a time.
const EACH: u32 = 4u;

var<workgroup> total: u32;

// The counts of the tiles from `first` on; 0 from `end` on.
fn counts_from(first: u32, end: u32) -> vec4<u32> {
    var counts = vec4(0u);
    for (var k = 0u; k < EACH; k++) {
        if first + k < end {
            counts[k] = ends[first + k];
        }
    }
    return counts;
}

// One workgroup a view.
@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    let start = views[which].range_start;
    let end = start + (views[which].row_end - views[which].row_start) * views[which].tiles_x;
    var needed = 0u;
    var counts = counts_from(start + local * EACH, end);
    for (var first = start; first < end; first += WORKGROUP_SIZE * EACH) {
        let mine = first + local * EACH;
        // On their way while these are summed up.
        let next = counts_from(mine + WORKGROUP_SIZE * EACH, end);
        let sum = add(add(counts.x, counts.y), add(counts.z, counts.w));
        var place = add(needed, sum_before(local, sum));
        for (var k = 0u; k < EACH; k++) {
            if mine + k < end {
                starts[mine + k] = place;
                ends[mine + k] = place;
            }
            place = add(place, counts[k]);
        }
        if local == WORKGROUP_SIZE - 1u {
            total = place;
        }
        needed = workgroupUniformLoad(&total);
        counts = next;
    }
    if local == 0u {
        starts[end] = needed;
        plans[which].needed = needed;
        plans[which].isects = select(needed, 0u, needed > views[which].isect_capacity);
    }
}
