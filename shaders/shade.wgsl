// Stage 4: colour of each visible Gaussian as seen from the camera, where it is wanted; footprints
// gathered in depth order.
// Twin: src/render/cpu/shade.rs

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> gaussians: array<Gaussian>;
// [N, K, 3], flattened.
@group(0) @binding(2) var<storage, read> sh: array<f32>;
@group(0) @binding(3) var<storage, read> footprints: array<Footprint>;
// Gaussians in depth order, dropped ones last.
@group(0) @binding(4) var<storage, read> ids: array<u32>;
@group(0) @binding(5) var<storage, read_write> shaded: array<Footprint>;
// Tiles of each in depth order; prefix_sum makes offsets of them.
@group(0) @binding(6) var<storage, read_write> isect_offsets: array<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = (group.y * groups.x + group.x) * WORKGROUP_SIZE + local;
    if i >= view.gaussian_count {
        return;
    }
    let id = ids[i];
    var footprint = footprints[id];
    if footprint.tiles > 0u && view.color_start != NO_PICTURE {
        let toward = (gaussians[id].mean - view.center.xyz) - view.center_low.xyz;
        let direction = normalize(toward);
        var color = vec3(SH_OFFSET);
        for (var k = 0u; k < view.sh_count; k++) {
            let at = (id * view.sh_count + k) * 3u;
            color += sh_basis(k, direction) * vec3(sh[at], sh[at + 1u], sh[at + 2u]);
        }
        footprint.color = max(color, vec3(0.0));
    }
    shaded[i] = footprint;
    isect_offsets[i] = footprint.tiles;
}
