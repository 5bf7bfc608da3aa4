// Stage 0: the Gaussians of the blocks that the view may show, in no order.
// CPU: crates/render/src/cpu/cull.rs (in the order of the scene)

@group(0) @binding(1) var<storage, read> blocks: array<Block>;
// [N] Gaussians, block after block.
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
    if local < TESTED && block < count && may_show(blocks[block]) {
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
    let total = views[which].gaussian_count;
    let to = which * count * BLOCK + first.x + local;
    for (var k = 0u; k < first.y; k++) {
        let at = shown[k] * BLOCK + local;
        // The last block may be shorter: what is past the last Gaussian is none.
        var row = total;
        if at < total {
            row = order[at];
        }
        rows[to + k * BLOCK] = row;
    }
}
