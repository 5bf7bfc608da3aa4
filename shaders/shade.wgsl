// Stage 2: colour of each Gaussian that touches the band, seen from the camera.
// CPU: crates/render/src/cpu/shade.rs
//
// A scene of degree 0 has one colour for all cameras. rasterize reads it directly.

@group(0) @binding(1) var<storage, read> gaussians: array<Gaussian>;
// [N, K, 3], flattened.
@group(0) @binding(2) var<storage, read> sh: array<f32>;
@group(0) @binding(3) var<storage, read> tiles: array<u32>;
// [views][N, 3], flattened.
@group(0) @binding(4) var<storage, read_write> colors: array<f32>;
@group(0) @binding(5) var<storage, read_write> plans: array<Plan>;
@group(0) @binding(6) var<storage, read> rows: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = enter_gaussian(group, groups, local);
    let total = views[which].gaussian_count;
    if i >= total || views[which].color_start == NO_PICTURE || tiles[which * total + i] == 0u {
        return;
    }
    let toward = (gaussians[i].mean - views[which].center.xyz) - views[which].center_low.xyz;
    let direction = normalize(toward);
    let count = views[which].sh_count;
    var color = vec3(SH_OFFSET);
    for (var k = 0u; k < count; k++) {
        let at = (i * count + k) * 3u;
        color += sh_basis(k, direction) * vec3(sh[at], sh[at + 1u], sh[at + 2u]);
    }
    color = max(color, vec3(0.0));
    let at = (which * total + i) * 3u;
    colors[at] = color.x;
    colors[at + 1u] = color.y;
    colors[at + 2u] = color.z;
}
