// Stage 5: one (tile, Gaussian) pair per touched tile, in depth order.
// Twin: src/render/cpu/emit_isects.rs
//
// plan runs first: it holds the total against the capacity and sizes the stages that follow.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> shaded: array<Footprint>;
@group(0) @binding(2) var<storage, read> isect_offsets: array<u32>;
@group(0) @binding(3) var<storage, read_write> plan: Plan;
@group(0) @binding(4) var<storage, read_write> tile_keys: array<u32>;
@group(0) @binding(5) var<storage, read_write> isect_ids: array<u32>;

fn groups_for(blocks: u32) -> vec4<u32> {
    let x = min(blocks, GROUPS_X_MAX);
    if x == 0u {
        return vec4(0u, 1u, 1u, 0u);
    }
    return vec4(x, (blocks + x - 1u) / x, 1u, 0u);
}

@compute @workgroup_size(1)
fn make_plan() {
    var needed = 0u;
    if view.gaussian_count > 0u {
        let last = view.gaussian_count - 1u;
        let before = isect_offsets[last];
        let tiles = shaded[last].tiles;
        needed = select(before + tiles, 0xffffffffu, before > 0xffffffffu - tiles);
    }
    let isects = select(needed, 0u, needed > view.isect_capacity);
    plan.needed = needed;
    plan.isects = isects;
    plan.sort_groups = groups_for((isects + SORT_BLOCK - 1u) / SORT_BLOCK);
    plan.range_groups = groups_for((isects + WORKGROUP_SIZE) / WORKGROUP_SIZE);
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = (group.y * groups.x + group.x) * WORKGROUP_SIZE + local;
    if i >= view.gaussian_count || plan.isects == 0u {
        return;
    }
    let footprint = shaded[i];
    if footprint.tiles == 0u {
        return;
    }
    var slot = isect_offsets[i];
    let end = slot + footprint.tiles;
    let extent = extent_of(footprint, view.row_start, view.row_end);
    if extent.top <= extent.bottom {
        let size = i32(TILE_SIZE);
        for (var tile_y = extent.top / size; tile_y <= extent.bottom / size; tile_y++) {
            let span = tile_span(footprint, extent, tile_y);
            let row = (u32(tile_y) - view.row_start) * view.tiles_x;
            for (var tile_x = span.x; tile_x < span.y && slot < end; tile_x++) {
                tile_keys[slot] = row + tile_x;
                isect_ids[slot] = i;
                slot++;
            }
        }
    }
    // Two compilations of one function may round differently; no slot stays unwritten.
    for (; slot < end; slot++) {
        tile_keys[slot] = 0u;
        isect_ids[slot] = NO_GAUSSIAN;
    }
}
