// Stage 3: where the tile pairs of each Gaussian start, in depth order: sums of blocks here, the
// rest in emit_isects. CPU: crates/render/src/cpu/prefix_sum.rs (in 64 bits)
//
// sum_blocks adds up the tiles of each block. scan_sums turns the sums into start places, compares
// the total with the room, and sizes the stages that follow.

@group(0) @binding(1) var<storage, read_write> plans: array<Plan>;
// Gaussians in depth order: [2][views][N].
@group(0) @binding(2) var<storage, read> depth_ids: array<u32>;
@group(0) @binding(3) var<storage, read> tiles: array<u32>;
// [views][blocks]
@group(0) @binding(4) var<storage, read_write> block_sums: array<u32>;
@group(0) @binding(5) var<storage, read_write> groups_of: array<atomic<u32>>;

fn blocks_of(count: u32) -> u32 {
    return (count + SCAN_BLOCK - 1u) / SCAN_BLOCK;
}

@compute @workgroup_size(256)
fn sum_blocks(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    let total = views[which].gaussian_count;
    let count = atomicLoad(&plans[which].sorted);
    let block = group.y * groups.x + group.x;
    let half = atomicLoad(&plans[0].passes) & 1u;
    let first = (half * groups.z + which) * total;
    var sum = 0u;
    for (var k = local; k < SCAN_BLOCK; k += WORKGROUP_SIZE) {
        let i = block * SCAN_BLOCK + k;
        if i < count {
            sum = add(sum, tiles[which * total + depth_ids[first + i]]);
        }
    }
    let before = sum_before(local, sum);
    if local == WORKGROUP_SIZE - 1u && block < blocks_of(total) {
        block_sums[which * blocks_of(total) + block] = add(before, sum);
    }
}

fn ask_groups(row: u32, blocks: u32, view_count: u32) {
    let x = min(blocks, GROUPS_X_MAX);
    if x > 0u {
        atomicMax(&groups_of[row * 4u], x);
        atomicMax(&groups_of[row * 4u + 1u], (blocks + x - 1u) / x);
        atomicMax(&groups_of[row * 4u + 2u], view_count);
    }
}

// One workgroup a view.
@compute @workgroup_size(256)
fn scan_sums(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    let blocks = blocks_of(views[which].gaussian_count);
    let start = which * blocks;
    let each = (blocks + WORKGROUP_SIZE - 1u) / WORKGROUP_SIZE;
    let first = min(local * each, blocks);
    let end = min(first + each, blocks);
    var sum = 0u;
    for (var block = first; block < end; block++) {
        sum = add(sum, block_sums[start + block]);
    }
    var before = sum_before(local, sum);
    if local == WORKGROUP_SIZE - 1u {
        let needed = add(before, sum);
        let isects = select(needed, 0u, needed > views[which].isect_capacity);
        plans[which].needed = needed;
        plans[which].isects = isects;
        ask_groups(GROUPS_TILES, (isects + SORT_BLOCK - 1u) / SORT_BLOCK, groups.z);
        ask_groups(GROUPS_RANGES, (isects + WORKGROUP_SIZE) / WORKGROUP_SIZE, groups.z);
    }
    for (var block = first; block < end; block++) {
        let count = block_sums[start + block];
        block_sums[start + block] = before;
        before = add(before, count);
    }
}
