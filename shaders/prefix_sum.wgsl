// Stage 3: where the list of each tile starts. Sums stay at u32::MAX.
// CPU: crates/render/src/cpu/bin.rs

@group(0) @binding(1) var<storage, read_write> plans: array<Plan>;
@group(0) @binding(2) var<storage, read_write> starts: array<u32>;
// Before: Gaussians of each tile. After: the start of its list.
@group(0) @binding(3) var<storage, read_write> ends: array<u32>;

// One workgroup a view.
@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    let count = (views[which].row_end - views[which].row_start) * views[which].tiles_x;
    let start = views[which].range_start;
    let each = (count + WORKGROUP_SIZE - 1u) / WORKGROUP_SIZE;
    let first = start + min(local * each, count);
    let end = start + min((local + 1u) * each, count);
    var sum = 0u;
    for (var tile = first; tile < end; tile++) {
        sum = add(sum, ends[tile]);
    }
    let before = sum_before(local, sum);
    var place = before;
    for (var tile = first; tile < end; tile++) {
        let next = add(place, ends[tile]);
        starts[tile] = place;
        ends[tile] = place;
        place = next;
    }
    if local == WORKGROUP_SIZE - 1u {
        let needed = add(before, sum);
        starts[start + count] = needed;
        plans[which].needed = needed;
        plans[which].isects = select(needed, 0u, needed > views[which].isect_capacity);
    }
}
