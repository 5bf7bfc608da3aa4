// Stage 0: the Gaussians of the blocks that the view shows, in no order.
// CPU: crates/render/src/cpu/cull.rs (in the order of the scene)

@group(0) @binding(1) var<storage, read> blocks: array<Block>;
// Gaussians, block after block; u32::MAX: none.
@group(0) @binding(2) var<storage, read> order: array<u32>;
@group(0) @binding(3) var<storage, read_write> plans: array<Plan>;
// [views][blocks * BLOCK] Gaussians that are left.
@group(0) @binding(4) var<storage, read_write> rows: array<u32>;
// Workgroups of the stages that read them, for all views. 0 before.
@group(0) @binding(5) var<storage, read_write> dispatch: array<atomic<u32>, 3>;

// Blocks that a workgroup tests.
const TESTED: u32 = 8u;
// Rounding of the test, as a share of the numbers in it.
const ROUNDING: f32 = 1e-5;

var<workgroup> shown: array<u32, TESTED>;
var<workgroup> shown_count: atomic<u32>;
var<workgroup> held: vec2<u32>;

// CPU: Frustum::may_show in crates/render/src/blocks.rs
fn may_show(block: Block) -> bool {
    let d = (block.center - views[which].center.xyz) - views[which].center_low.xyz;
    let reached = block.half + ROUNDING * (abs(d) + block.half);
    let ball = views[which].photos;
    let away = distance(block.center, ball.xyz) + length(block.half) + ball.w;
    let reach = block.reach + away * views[which].photos_widen;
    let axis = views[which].rotation_z.xyz;
    if dot(axis, d) + dot(abs(axis), reached) < views[which].near {
        return false;
    }
    for (var k = 0u; k < 4u; k++) {
        let side = views[which].sides[k];
        if dot(side.xyz, d) + dot(abs(side.xyz), reached) + side.w * reach < 0.0 {
            return false;
        }
    }
    return true;
}

// CPU: Frustum::is_fine
fn is_fine(block: Block) -> bool {
    let d = (block.center - views[which].center.xyz) - views[which].center_low.xyz;
    let reached = block.half + ROUNDING * (abs(d) + block.half);
    let axis = views[which].rotation_z.xyz;
    let nearest = dot(axis, d) - dot(abs(axis), reached);
    return block.error < 0.0
        || (nearest >= views[which].near && block.error < views[which].detail * nearest);
}

// CPU: Blocks::is_shown
fn is_shown(at: u32) -> bool {
    let block = blocks[at];
    if block.parent < views[which].block_count && is_fine(blocks[block.parent]) {
        return false;
    }
    return is_fine(block) && may_show(block);
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    if local == 0u {
        atomicStore(&shown_count, 0u);
    }
    workgroupBarrier();
    let block = (group.y * groups.x + group.x) * TESTED + local;
    let count = views[which].block_count;
    if local < TESTED && block < count && is_shown(block) {
        shown[atomicAdd(&shown_count, 1u)] = block;
    }
    workgroupBarrier();
    if local == 0u {
        let found = atomicLoad(&shown_count);
        held = vec2(0u, found);
        if found > 0u {
            held.x = atomicAdd(&plans[which].rows, found * BLOCK);
            let needed = (held.x + found * BLOCK) / WORKGROUP_SIZE;
            atomicMax(&dispatch[0], min(needed, GROUPS_X_MAX));
            atomicMax(&dispatch[1], (needed + GROUPS_X_MAX - 1u) / GROUPS_X_MAX);
            atomicMax(&dispatch[2], which + 1u);
        }
    }
    let first = workgroupUniformLoad(&held);
    let to = which * count * BLOCK + first.x + local;
    for (var k = 0u; k < first.y; k++) {
        rows[to + k * BLOCK] = order[shown[k] * BLOCK + local];
    }
}
