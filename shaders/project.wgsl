// Stage 1: Gaussians to footprints; some are dropped.
// CPU: crates/render/src/cpu/project.rs (in f64; here only depth is exact).

@group(0) @binding(1) var<storage, read> gaussians: array<Gaussian>;
@group(0) @binding(2) var<storage, read_write> footprints: array<Footprint>;
@group(0) @binding(3) var<storage, read_write> depth_keys: array<u32>;
// Tiles touched in the band.
@group(0) @binding(4) var<storage, read_write> tiles: array<u32>;
@group(0) @binding(5) var<storage, read_write> plans: array<Plan>;

// EWA projection of Gaussian i; opacity 0 when it cannot be seen.
fn project_one(i: u32) -> Footprint {
    let gaussian = gaussians[i];
    let t = camera_point(gaussian.mean);
    var footprint = Footprint(vec2(0.0), 0.0, 0.0, 0.0, 0.0, 0.0, t.z);
    if !(t.z >= views[which].near && is_finite(t.z)) {
        return footprint;
    }
    let slope = t.xy / t.z;
    let clamped = clamp(slope, views[which].slope_min, views[which].slope_max);
    let focal = views[which].focal / t.z;

    // Rows of M = J W R diag(scales), so that the 2D covariance is M Mᵀ.
    let rotation = rotation_of(gaussian.quat);
    let row_x = (views[which].rotation_x.xyz * rotation) * gaussian.scale;
    let row_y = (views[which].rotation_y.xyz * rotation) * gaussian.scale;
    let row_z = (views[which].rotation_z.xyz * rotation) * gaussian.scale;
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
    if views[which].antialiased != 0u {
        opacity *= sqrt(sharp_x / given_x);
    }
    if !(opacity >= ALPHA_MIN) {
        return footprint;
    }
    footprint.mean = views[which].focal * slope + views[which].principal;
    footprint.conic_shear = dot(m0, m1) / var_y;
    footprint.conic_x = sqrt(0.5 / given_x);
    footprint.conic_y = sqrt(0.5 / var_y);
    footprint.power_max = log(opacity / ALPHA_MIN) + FOOTPRINT_SLACK;
    let finite = is_finite(footprint.mean.x) && is_finite(footprint.mean.y)
        && is_finite(footprint.conic_shear);
    if finite && footprint.conic_x > 0.0 && footprint.conic_y > 0.0 {
        footprint.opacity = opacity;
    }
    return footprint;
}

var<workgroup> lows: array<u32, 256>;
var<workgroup> highs: array<u32, 256>;
var<workgroup> seen: array<u32, 256>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = group.z;
    let i = (group.y * groups.x + group.x) * WORKGROUP_SIZE + local;
    var key = DROPPED_KEY;
    var whole = 0u;
    if i < views[which].gaussian_count {
        let at = which * views[which].gaussian_count + i;
        let footprint = project_one(i);
        var touched = 0u;
        if footprint.opacity > 0.0 {
            touched = count_tiles(footprint, views[which].row_start, views[which].row_end);
            whole = touched;
            if views[which].row_end - views[which].row_start < views[which].tiles_y {
                whole = count_tiles(footprint, 0u, views[which].tiles_y);
            }
            if touched > 0u {
                footprints[at] = footprint;
                key = bitcast<u32>(footprint.depth);
            }
        }
        tiles[at] = touched;
        depth_keys[at] = key;
    }
    lows[local] = key;
    highs[local] = select(key, 0u, key == DROPPED_KEY);
    seen[local] = select(0u, 1u, whole > 0u);
    workgroupBarrier();
    // An invocation reads numbers of its own residue alone, so writing its own disturbs nobody.
    if local < 16u {
        for (var k = local + 16u; k < WORKGROUP_SIZE; k += 16u) {
            lows[local] = min(lows[local], lows[k]);
            highs[local] = max(highs[local], highs[k]);
            seen[local] += seen[k];
        }
    }
    workgroupBarrier();
    if local == 0u {
        for (var k = 1u; k < 16u; k++) {
            lows[0] = min(lows[0], lows[k]);
            highs[0] = max(highs[0], highs[k]);
            seen[0] += seen[k];
        }
        if seen[0] > 0u {
            atomicMin(&plans[which].key_min, lows[0]);
            atomicMax(&plans[which].key_max, highs[0]);
            atomicAdd(&plans[which].visible, seen[0]);
        }
    }
}
