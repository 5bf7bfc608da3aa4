// Stage 1: Gaussians to footprints on the picture, and which to drop.
// Twin: src/render/cpu/project.rs (there in f64; here depth alone is exact).

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> gaussians: array<Gaussian>;
@group(0) @binding(2) var<storage, read_write> footprints: array<Footprint>;
@group(0) @binding(3) var<storage, read_write> depth_keys: array<u32>;
@group(0) @binding(4) var<storage, read_write> ids: array<u32>;
@group(0) @binding(5) var<storage, read_write> plan: Plan;

var<workgroup> visible: atomic<u32>;

// EWA projection of Gaussian i; opacity 0 when it cannot be seen.
fn project_one(i: u32) -> Footprint {
    let gaussian = gaussians[i];
    let t = camera_point(gaussian.mean);
    var footprint = Footprint(vec2(0.0), 0.0, 0.0, 0.0, 0.0, 0.0, t.z, vec3(0.0), 0u);
    if !(t.z >= view.near && is_finite(t.z)) {
        return footprint;
    }
    let slope = t.xy / t.z;
    let clamped = clamp(slope, view.slope_min, view.slope_max);
    let focal = view.focal / t.z;

    // Rows of M = J W R diag(scales), so that the 2D covariance is M Mᵀ.
    let rotation = rotation_of(gaussian.quat);
    let row_x = (view.rotation_x.xyz * rotation) * gaussian.scale;
    let row_y = (view.rotation_y.xyz * rotation) * gaussian.scale;
    let row_z = (view.rotation_z.xyz * rotation) * gaussian.scale;
    let m0 = (row_x - row_z * clamped.x) * focal.x;
    let m1 = (row_y - row_z * clamped.y) * focal.y;

    let xx = dot(m0, m0);
    let yy = dot(m1, m1);
    let var_y = yy + BLUR_PX2;
    // det(M Mᵀ) / var_y as a sum of squares (Cauchy-Binet): it cannot cancel or go negative, and
    // divided by var_y it stays in f32's range.
    let sharp = cross(m0, m1 * inverseSqrt(var_y));
    let sharp_x = dot(sharp, sharp);
    // Variance of x given y: det / var_y.
    let given_x = sharp_x + BLUR_PX2 * ((xx + BLUR_PX2) / var_y + yy / var_y);
    if !(is_finite(xx) && is_finite(yy) && is_finite(given_x) && given_x > 0.0) {
        return footprint;
    }
    var opacity = gaussian.opacity;
    if view.antialiased != 0u {
        opacity *= sqrt(sharp_x / given_x);
    }
    if !(opacity >= ALPHA_MIN) {
        return footprint;
    }
    footprint.mean = view.focal * slope + view.principal;
    footprint.slope = dot(m0, m1) / var_y;
    footprint.inv_sx = sqrt(0.5 / given_x);
    footprint.inv_sy = sqrt(0.5 / var_y);
    footprint.reach = log(opacity / ALPHA_MIN) + FOOTPRINT_SLACK;
    let finite = is_finite(footprint.mean.x) && is_finite(footprint.mean.y)
        && is_finite(footprint.slope);
    if finite && footprint.inv_sx > 0.0 && footprint.inv_sy > 0.0 {
        footprint.opacity = opacity;
    }
    return footprint;
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    if local == 0u {
        atomicStore(&visible, 0u);
    }
    workgroupBarrier();
    let i = (group.y * groups.x + group.x) * WORKGROUP_SIZE + local;
    if i < view.gaussian_count {
        var footprint = project_one(i);
        if footprint.opacity > 0.0 {
            footprint.tiles = count_tiles(footprint, view.row_start, view.row_end);
            var whole = footprint.tiles;
            if view.row_end - view.row_start < view.tiles_y {
                whole = count_tiles(footprint, 0u, view.tiles_y);
            }
            if whole > 0u {
                atomicAdd(&visible, 1u);
            }
        }
        footprints[i] = footprint;
        depth_keys[i] = select(DROPPED_KEY, bitcast<u32>(footprint.depth), footprint.tiles > 0u);
        ids[i] = i;
    }
    workgroupBarrier();
    if local == 0u {
        atomicAdd(&plan.visible, atomicLoad(&visible));
    }
}
