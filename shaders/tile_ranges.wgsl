// Stage 7: where each tile's pairs start and end: ranges[tile]..ranges[tile + 1].
// Twin: src/render/cpu/tile_ranges.rs

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> plan: PlanRead;
// Tile of each pair, sorted.
@group(0) @binding(2) var<storage, read> tile_keys: array<u32>;
@group(0) @binding(3) var<storage, read_write> ranges: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = (group.y * groups.x + group.x) * WORKGROUP_SIZE + local;
    if i > plan.isects {
        return;
    }
    // Pair i starts every tile after the pair before it, up to its own; one past the last pair
    // ends all that are left.
    var first = 0u;
    if i > 0u {
        first = tile_keys[i - 1u] + 1u;
    }
    var last = (view.row_end - view.row_start) * view.tiles_x;
    if i < plan.isects {
        last = tile_keys[i];
    }
    for (var tile = first; tile <= last; tile++) {
        ranges[tile] = i;
    }
}
