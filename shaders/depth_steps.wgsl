// Stage 7, where depth is asked for in levels: depths in 65,535 steps up to the farthest one.
// CPU: crates/render/src/levels.rs

@group(0) @binding(1) var<storage, read_write> plans: array<Plan>;
@group(0) @binding(2) var<storage, read_write> pictures: array<u32>;

var<workgroup> farthest_here: atomic<u32>;

// Depths are 0 and over: their bits are in their order.
@compute @workgroup_size(256)
fn farthest(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    if local == 0u {
        atomicStore(&farthest_here, 0u);
    }
    workgroupBarrier();
    let start = views[which].depth_start;
    let count = views[which].width * views[which].height;
    let step = groups.x * WORKGROUP_SIZE;
    if views[which].steps_start != NO_PICTURE {
        for (var i = group.x * WORKGROUP_SIZE + local; i < count; i += step) {
            atomicMax(&farthest_here, pictures[start + i]);
        }
    }
    workgroupBarrier();
    if local == 0u {
        atomicMax(&plans[which].farthest, atomicLoad(&farthest_here));
    }
}

fn step_of(depth: f32) -> u32 {
    let share = depth / bitcast<f32>(atomicLoad(&plans[which].farthest));
    return select(0u, u32(clamp(floor(share * 65535.0 + 0.5), 1.0, 65535.0)), depth > 0.0);
}

// Two pixels of a row share a word.
@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = enter_row(group, groups, local);
    let width = views[which].width;
    let words = (width + 1u) / 2u;
    if i >= words * views[which].height || views[which].steps_start == NO_PICTURE {
        return;
    }
    let x = i % words * 2u;
    let from_start = views[which].depth_start + i / words * width + x;
    var word = step_of(bitcast<f32>(pictures[from_start]));
    if x + 1u < width {
        word |= step_of(bitcast<f32>(pictures[from_start + 1u])) << 16u;
    }
    pictures[views[which].steps_start + i] = word;
}
