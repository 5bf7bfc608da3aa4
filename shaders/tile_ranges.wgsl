// Stage 7: where the pairs of each tile start and end: ranges[tile]..ranges[tile + 1].
// CPU: crates/render/src/cpu/tile_ranges.rs

@group(0) @binding(1) var<storage, read_write> plans: array<Plan>;
// Tile of each pair, sorted.
@group(0) @binding(2) var<storage, read> tile_keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> ranges: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    let isects = plans[which].isects;
    let i = (group.y * groups.x + group.x) * WORKGROUP_SIZE + local;
    if i > isects {
        return;
    }
    // Pair i starts every tile after the pair before it, up to its own; one past the last pair
    // ends all that are left.
    let keys = views[which].pair_start;
    var first = 0u;
    if i > 0u {
        first = tile_keys[keys + i - 1u] + 1u;
    }
    var last = (views[which].row_end - views[which].row_start) * views[which].tiles_x;
    if i < isects {
        last = tile_keys[keys + i];
    }
    for (var tile = first; tile <= last; tile++) {
        ranges[views[which].range_start + tile] = i;
    }
}
