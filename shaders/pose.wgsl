// What the loss says of where a view's camera stands: sums over all that it sees.
// CPU: crates/render/src/train/pose.rs

@group(0) @binding(1) var<storage, read> gaussians: array<Gaussian>;
// As shade_backward leaves them.
@group(0) @binding(2) var<storage, read> gradients: array<f32>;
// [POSE_GROUPS, 2] by moves along the axes of the world, and by turns about the camera's centre.
@group(0) @binding(3) var<storage, read_write> pose_sums: array<vec4<f32>>;

var<workgroup> shifts: array<vec3<f32>, 256>;
var<workgroup> turns: array<vec3<f32>, 256>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let total = views[which].gaussian_count;
    let center = views[which].center.xyz + views[which].center_low.xyz;
    var shift = vec3(0.0);
    var turn = vec3(0.0);
    for (var i = group.x * 256u + local; i < total; i += POSE_GROUPS * 256u) {
        let row = i * GRADIENT_WORDS;
        if gradients[row + 11u] > 0.0 {
            let by_mean = vec3(gradients[row], gradients[row + 1u], gradients[row + 2u]);
            let by_w = gradients[row + 4u];
            let by_v = vec3(gradients[row + 5u], gradients[row + 6u], gradients[row + 7u]);
            let quat = gaussians[i].quat;
            let own = quat.x * by_v - by_w * quat.yzw + cross(quat.yzw, by_v);
            shift -= by_mean;
            turn -= cross(gaussians[i].mean - center, by_mean) + 0.5 * own;
        }
    }
    shifts[local] = shift;
    turns[local] = turn;
    for (var half = 128u; half > 0u; half /= 2u) {
        workgroupBarrier();
        if local < half {
            shifts[local] += shifts[local + half];
            turns[local] += turns[local + half];
        }
    }
    if local == 0u {
        pose_sums[2u * group.x] = vec4(shifts[0], 0.0);
        pose_sums[2u * group.x + 1u] = vec4(turns[0], 0.0);
    }
}
