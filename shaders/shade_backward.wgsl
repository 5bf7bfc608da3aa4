// Backward pass of stage 2: from what is known by a Gaussian's colour to its harmonics and, through
// the direction that it is seen from, to its centre.
// CPU: crates/render/src/cpu/backward.rs (in f64)

@group(0) @binding(1) var<storage, read> gaussians: array<Gaussian>;
// [N, K, 3], flattened.
@group(0) @binding(2) var<storage, read> sh: array<f32>;
// As project_backward leaves them.
@group(0) @binding(3) var<storage, read_write> gradients: array<f32>;

// Derivative of basis function k by the unit direction d.
fn sh_slope(k: u32, d: vec3<f32>) -> vec3<f32> {
    let x = d.x;
    let y = d.y;
    let z = d.z;
    let xx = x * x;
    let yy = y * y;
    let zz = z * z;
    switch k {
        case 0u: { return vec3(0.0); }
        case 1u: { return vec3(0.0, -SH_C1, 0.0); }
        case 2u: { return vec3(0.0, 0.0, SH_C1); }
        case 3u: { return vec3(-SH_C1, 0.0, 0.0); }
        case 4u: { return SH_C2[0] * vec3(y, x, 0.0); }
        case 5u: { return SH_C2[1] * vec3(0.0, z, y); }
        case 6u: { return SH_C2[2] * vec3(-2.0 * x, -2.0 * y, 4.0 * z); }
        case 7u: { return SH_C2[3] * vec3(z, 0.0, x); }
        case 8u: { return SH_C2[4] * vec3(2.0 * x, -2.0 * y, 0.0); }
        case 9u: { return SH_C3[0] * vec3(6.0 * x * y, 3.0 * (xx - yy), 0.0); }
        case 10u: { return SH_C3[1] * vec3(y * z, x * z, x * y); }
        case 11u: { return SH_C3[2] * vec3(-2.0 * x * y, 4.0 * zz - xx - 3.0 * yy, 8.0 * y * z); }
        case 12u: {
            return SH_C3[3] * vec3(-6.0 * x * z, -6.0 * y * z, 6.0 * zz - 3.0 * xx - 3.0 * yy);
        }
        case 13u: { return SH_C3[4] * vec3(4.0 * zz - 3.0 * xx - yy, -2.0 * x * y, 8.0 * x * z); }
        case 14u: { return SH_C3[5] * vec3(2.0 * x * z, -2.0 * y * z, xx - yy); }
        default: { return SH_C3[6] * vec3(3.0 * (xx - yy), -6.0 * x * y, 0.0); }
    }
}

fn put(at: u32, value: f32) {
    gradients[at] = select(0.0, value, is_finite(value));
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = enter_row(group, groups, local);
    let total = views[which].gaussian_count;
    if i >= total {
        return;
    }
    let count = views[which].sh_count;
    let first = i * count * 3u;
    let to = total * GRADIENT_WORDS + first;
    let toward = (gaussians[i].mean - views[which].center.xyz) - views[which].center_low.xyz;
    let direction = normalize(toward);
    var color = vec3(SH_OFFSET);
    for (var k = 0u; k < count; k++) {
        let at = first + k * 3u;
        color += sh_basis(k, direction) * vec3(sh[at], sh[at + 1u], sh[at + 2u]);
    }
    // A colour at 0 has no derivative.
    let given = vec3(gradients[to], gradients[to + 1u], gradients[to + 2u]);
    let by = select(vec3(0.0), given, color > vec3(0.0));
    var by_direction = vec3(0.0);
    for (var k = 0u; k < count; k++) {
        let at = first + k * 3u;
        let worth = dot(by, vec3(sh[at], sh[at + 1u], sh[at + 2u]));
        by_direction += sh_slope(k, direction) * worth;
        let basis = sh_basis(k, direction);
        for (var c = 0u; c < 3u; c++) {
            put(to + k * 3u + c, by[c] * basis);
        }
    }
    if count > 1u && any(by != vec3(0.0)) {
        let across = by_direction - direction * dot(by_direction, direction);
        for (var c = 0u; c < 3u; c++) {
            let at = i * GRADIENT_WORDS + c;
            put(at, gradients[at] + across[c] / length(toward));
        }
    }
}
