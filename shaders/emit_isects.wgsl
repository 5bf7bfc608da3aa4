// Stage 5: one (tile, Gaussian) pair for each tile that a Gaussian touches, in depth order.
// CPU: crates/render/src/cpu/emit_isects.rs

@group(0) @binding(1) var<storage, read_write> plans: array<Plan>;
@group(0) @binding(2) var<storage, read> footprints: array<Footprint>;
@group(0) @binding(3) var<storage, read> tiles: array<u32>;
// Gaussians in depth order: [2][views][N].
@group(0) @binding(4) var<storage, read> depth_ids: array<u32>;
// First place of each block: [views][blocks].
@group(0) @binding(5) var<storage, read> block_sums: array<u32>;
@group(0) @binding(6) var<storage, read_write> tile_keys: array<u32>;
@group(0) @binding(7) var<storage, read_write> isect_ids: array<u32>;

// First place of each Gaussian of the block, and one past the last.
var<workgroup> offsets: array<u32, 1025>;

fn emit_one(id: u32, start: u32, count: u32) {
    let total = views[which].gaussian_count;
    let footprint = footprints[which * total + id];
    var slot = start;
    let end = slot + count;
    let extent = extent_of(footprint, views[which].row_start, views[which].row_end);
    if extent.top <= extent.bottom {
        let size = i32(TILE_SIZE);
        for (var tile_y = extent.top / size; tile_y <= extent.bottom / size; tile_y++) {
            let span = tile_span(footprint, extent, tile_y);
            let row = (u32(tile_y) - views[which].row_start) * views[which].tiles_x;
            for (var tile_x = span.x; tile_x < span.y && slot < end; tile_x++) {
                tile_keys[slot] = row + tile_x;
                isect_ids[slot] = id;
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

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    let total = views[which].gaussian_count;
    let blocks = (total + SCAN_BLOCK - 1u) / SCAN_BLOCK;
    let block = group.y * groups.x + group.x;
    // No pairs where there is no room for them.
    let count = select(0u, atomicLoad(&plans[which].sorted), plans[which].isects > 0u);
    let half = atomicLoad(&plans[0].passes) & 1u;
    let ids = (half * groups.z + which) * total;
    for (var k = local; k < SCAN_BLOCK; k += WORKGROUP_SIZE) {
        let i = block * SCAN_BLOCK + k;
        var touched = 0u;
        if i < count {
            touched = tiles[which * total + depth_ids[ids + i]];
        }
        offsets[k] = touched;
    }
    workgroupBarrier();
    var sum = 0u;
    for (var k = 0u; k < 4u; k++) {
        sum += offsets[local * 4u + k];
    }
    var before = sum_before(local, sum);
    if block < blocks {
        before += block_sums[which * blocks + block];
    }
    for (var k = 0u; k < 4u; k++) {
        let touched = offsets[local * 4u + k];
        offsets[local * 4u + k] = before;
        before += touched;
    }
    if local == WORKGROUP_SIZE - 1u {
        offsets[SCAN_BLOCK] = before;
    }
    workgroupBarrier();
    for (var k = local; k < SCAN_BLOCK; k += WORKGROUP_SIZE) {
        let i = block * SCAN_BLOCK + k;
        if i < count {
            let id = depth_ids[ids + i];
            let start = which * views[which].isect_capacity + offsets[k];
            emit_one(id, start, offsets[k + 1u] - offsets[k]);
        }
    }
}
