// Moves the Gaussians that a step has seen, each with a count of its own.
// CPU: crates/render/src/train/adam.rs

@group(0) @binding(1) var<uniform> training: Training;
@group(0) @binding(2) var<storage, read_write> plans: array<Plan>;
// As shade_backward leaves them.
@group(0) @binding(3) var<storage, read_write> gradients: array<f32>;
@group(0) @binding(4) var<storage, read_write> gaussians: array<Gaussian>;
// [N, K, 3], flattened.
@group(0) @binding(5) var<storage, read_write> sh: array<f32>;
// [1 + 2 * numbers, N]: steps taken, then two moments of each number: mean, quaternion, scales,
// opacity, harmonics. Under 0 steps: it is new, and what the moments hold is of another.
@group(0) @binding(6) var<storage, read_write> moments: array<f32>;
// Gradients of the photos before this one, of the same step.
@group(0) @binding(7) var<storage, read> earlier: array<f32>;

const COORDINATE_MAX: f32 = 1e9;
const SCALE_MIN: f32 = 1e-12;
const SCALE_MAX: f32 = 1e9;
const OPACITY_MIN: f32 = 0.003921569;
const OPACITY_MAX: f32 = 0.9999;
const SH_LEARNT_MAX: f32 = 64.0;

// The Gaussian of this invocation, and how many there are.
var<private> own: u32;
var<private> total: u32;
var<private> corrected: vec2<f32>;
var<private> is_new: bool;

// The step of number k, in units of its rate.
fn step_of(k: u32, gradient: f32) -> f32 {
    let at = (1u + 2u * k) * total + own;
    let before = select(vec2(moments[at], moments[at + total]), vec2(0.0), is_new);
    let after = moments_after(before, gradient);
    moments[at] = after.x;
    moments[at + total] = after.y;
    return step_by(after, corrected);
}

fn move_seen(gaussian: ptr<function, Gaussian>) {
    is_new = moments[own] < 0.0;
    let count = min(max(moments[own], 0.0) + 1.0, COUNT_MAX);
    moments[own] = count;
    corrected = corrections(count);
    let row = own * GRADIENT_WORDS;
    for (var c = 0u; c < 3u; c++) {
        let moved = (*gaussian).mean[c] - training.means * step_of(c, gradients[row + c]);
        (*gaussian).mean[c] = clamp(moved, -COORDINATE_MAX, COORDINATE_MAX);
        let scale = (*gaussian).scale[c];
        let by = gradients[row + 8u + c] * scale;
        let wider = scale * exp(-training.scales * step_of(7u + c, by));
        (*gaussian).scale[c] = clamp(wider, SCALE_MIN, SCALE_MAX);
    }
    var quat = (*gaussian).quat;
    for (var c = 0u; c < 4u; c++) {
        quat[c] -= training.quats * step_of(3u + c, gradients[row + 4u + c]);
    }
    let size = length(quat);
    if is_finite(size) && size > 1e-12 {
        (*gaussian).quat = quat / size;
    }
    let opacity = clamp((*gaussian).opacity, OPACITY_MIN, OPACITY_MAX);
    let by = gradients[row + 3u] * (opacity * (1.0 - opacity));
    let logit = log(opacity / (1.0 - opacity)) - training.opacities * step_of(10u, by);
    (*gaussian).opacity = clamp(1.0 / (1.0 + exp(-logit)), OPACITY_MIN, OPACITY_MAX);
    let width = views[which].sh_count * 3u;
    for (var k = 0u; k < width; k++) {
        let at = own * width + k;
        let rate = select(training.sh_rest, training.sh, k < 3u);
        let moved = sh[at] - rate * step_of(11u + k, gradients[total * GRADIENT_WORDS + at]);
        sh[at] = clamp(moved, -SH_LEARNT_MAX, SH_LEARNT_MAX);
    }
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    own = enter_row(group, groups, local);
    total = views[which].gaussian_count;
    // A frame that lacked room drew nothing.
    if own >= total || plans[0].needed > views[which].isect_capacity {
        return;
    }
    var gaussian = gaussians[own];
    if gradients[own * GRADIENT_WORDS + 11u] > 0.0 {
        move_seen(&gaussian);
    }
    // One that is dropped keeps its place: no view shows it, so no step moves it.
    if gaussian.opacity < training.opacity_min {
        gaussian.opacity = 0.0;
    }
    gaussians[own] = gaussian;
}

// Adds the gradients of earlier photos, and whether those saw a Gaussian.
@compute @workgroup_size(256)
fn add_earlier(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    own = enter_row(group, groups, local);
    total = views[which].gaussian_count;
    if own >= total {
        return;
    }
    for (var k = 0u; k < GRADIENT_WORDS; k++) {
        gradients[own * GRADIENT_WORDS + k] += earlier[own * GRADIENT_WORDS + k];
    }
    let width = views[which].sh_count * 3u;
    for (var k = 0u; k < width; k++) {
        let at = total * GRADIENT_WORDS + own * width + k;
        gradients[at] += earlier[at];
    }
}
