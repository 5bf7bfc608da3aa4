// Stage 4: each Gaussian into the list of each tile that it touches, in no order.
// CPU: crates/render/src/cpu/bin.rs (in the order of the scene)

@group(0) @binding(1) var<storage, read_write> plans: array<Plan>;
@group(0) @binding(2) var<storage, read> footprints: array<Footprint>;
@group(0) @binding(3) var<storage, read> tiles: array<u32>;
// Where the list of each tile starts; one more number ends the last one.
@group(0) @binding(4) var<storage, read> starts: array<u32>;
// Where the list of each tile ends so far.
@group(0) @binding(5) var<storage, read_write> ends: array<atomic<u32>>;
// [2][views][capacity] of (depth key, Gaussian).
@group(0) @binding(6) var<storage, read_write> pairs: array<vec2<u32>>;

fn visit(tile: u32, footprint: Footprint, id: u32) {
    let place = atomicAdd(&ends[tile], 1u);
    // Two compilations of one function may round differently: what was not counted has no room.
    if place < starts[tile + 1u] {
        pairs[views[which].pair_start + place] = vec2(bitcast<u32>(footprint.depth), id);
    }
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    let total = views[which].gaussian_count;
    let i = (group.y * groups.x + group.x) * WORKGROUP_SIZE + local;
    let first = which * total;
    begin_visits(local);
    // No pairs where there is no room for them.
    if i < total && plans[which].isects > 0u {
        let touched = tiles[first + i];
        if touched > 0u {
            visit_or_defer(footprints[first + i], i, touched);
        }
    }
    workgroupBarrier();
    if local == 0u {
        larges = atomicLoad(&large_count);
    }
    let count = workgroupUniformLoad(&larges);
    for (var k = 0u; k < count; k++) {
        let id = large[k];
        visit_tiles(footprints[first + id], id, local / 8u, 32u, local % 8u, 8u);
    }
}
