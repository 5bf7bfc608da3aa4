// Stage 1: Gaussians to footprints; some are dropped. The others are counted in their tiles.
// CPU: crates/render/src/cpu/project.rs (in f64; here only depth is exact).

@group(0) @binding(1) var<storage, read> gaussians: array<array<vec4<f32>, 3>>;
@group(0) @binding(2) var<storage, read_write> footprints: array<FootprintRows>;
// What each touches in the band.
@group(0) @binding(3) var<storage, read_write> tiles: array<u32>;
@group(0) @binding(4) var<storage, read_write> plans: array<Plan>;
// Gaussians that touch each tile of the band. 0 before.
@group(0) @binding(5) var<storage, read_write> ends: array<atomic<u32>>;
// Photos of the views.
@group(0) @binding(6) var<storage, read> sources: array<Source>;
@group(0) @binding(7) var<storage, read> rows: array<u32>;

// How a view blurs a Gaussian that it shows larger or smaller than its photo did
// (crates/render/src/plan.rs).
struct Blur {
    // Variance that is added to each axis, world units².
    lost: f32,
    // The blur that it was learnt with, as large as the view shows it, and the one that is drawn.
    learnt: f32,
    drawn: f32,
}

fn blur_of(gaussian: Gaussian, source: Source, depth: f32) -> Blur {
    let width = max(dot(gaussian.mean - source.center, source.axis), 0.0) * source.scale;
    let p = width * views[which].own_focal / depth;
    if p > 1.0 {
        return Blur(BLUR_PX2 * width * width * (1.0 - 1.0 / (p * p)), BLUR_PX2, BLUR_PX2);
    }
    let size = p * (OWN_SIZE * OWN_SIZE);
    if !(size < 1.0 && width > 0.0) || views[which].antialiased != 0u {
        return Blur(0.0, BLUR_PX2, BLUR_PX2);
    }
    let learnt = BLUR_PX2 * size * size;
    return Blur(0.0, learnt, learnt + PIXEL_PX2 * (1.0 - size * size));
}

fn gaussian_of(rows: array<vec4<f32>, 3>) -> Gaussian {
    let first = rows[0];
    let last = rows[2];
    return Gaussian(first.xyz, first.w, rows[1], last.xyz, bitcast<u32>(last.w));
}

// EWA projection of Gaussian i; opacity 0 when it cannot be seen.
fn project_one(i: u32) -> Footprint {
    let gaussian = gaussian_of(gaussians[i]);
    let t = camera_point(gaussian.mean);
    var footprint = Footprint(vec2(0.0), 0.0, 0.0, 0.0, 0.0, 0.0, t.z);
    if !(t.z >= views[which].near && is_finite(t.z)) {
        return footprint;
    }
    var scale = gaussian.scale;
    var blur = Blur(0.0, BLUR_PX2, BLUR_PX2);
    let photo = gaussian.source & 0xffffu;
    if photo < views[which].source_count {
        let source = sources[views[which].source_start + photo];
        if source.layer == LEFT_OUT {
            return footprint;
        }
        blur = blur_of(gaussian, source, t.z);
        if blur.lost > 0.0 {
            scale = sqrt(scale * scale + blur.lost);
        }
        footprint.depth = select(t.z, -t.z, source.layer == BEHIND);
    }
    let slope = t.xy / t.z;
    let clamped = clamp(slope, views[which].slope_min, views[which].slope_max);
    let focal = views[which].focal / t.z;

    // Rows of M = J W R diag(scales), so that the 2D covariance is M Mᵀ.
    let rotation = rotation_of(gaussian.quat);
    let row_x = (views[which].rotation_x.xyz * rotation) * scale;
    let row_y = (views[which].rotation_y.xyz * rotation) * scale;
    let row_z = (views[which].rotation_z.xyz * rotation) * scale;
    let m0 = (row_x - row_z * clamped.x) * focal.x;
    let m1 = (row_y - row_z * clamped.y) * focal.y;

    let xx = dot(m0, m0);
    let yy = dot(m1, m1);
    let var_y = yy + blur.drawn;
    // det(M Mᵀ) / var_y as a sum of squares (Cauchy-Binet): it cannot cancel or go negative, and
    // divided by var_y it stays in f32's range.
    let sharp = cross(m0, m1 * inverseSqrt(var_y));
    let sharp_x = dot(sharp, sharp);
    // Variance of x given y: det / var_y.
    let given_x = sharp_x + blur.drawn * ((xx + blur.drawn) / var_y + yy / var_y);
    if !(is_finite(xx) && is_finite(yy) && is_finite(given_x) && given_x > 0.0) {
        return footprint;
    }
    var opacity = gaussian.opacity;
    let sum = bitcast<f32>(gaussian.source & 0xffff0000u);
    if sum > 0.0 && views[which].antialiased == 0u {
        // What its members cover with the blur that they were learnt with
        // (crates/render/src/merged.rs); all over var_y.
        let learnt_x = sharp_x + blur.learnt * ((xx + blur.learnt) / var_y + yy / var_y);
        let spread = sum * blur.learnt;
        let covers = opacity * opacity * sharp_x
            + spread * (opacity * (xx / var_y + yy / var_y) + spread / var_y);
        opacity = sqrt(covers / learnt_x);
    }
    if views[which].antialiased != 0u {
        opacity *= sqrt(sharp_x / given_x);
    } else if blur.learnt < BLUR_PX2 {
        // Its sum over the picture stays, less what is under the least alpha.
        let learnt_x = sharp_x + blur.learnt * ((xx + blur.learnt) / var_y + yy / var_y);
        opacity -= (1.0 - sqrt(learnt_x / given_x)) * (opacity - ALPHA_MIN);
    }
    if sum > 0.0 {
        opacity = min(opacity, sqrt(opacity));
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

fn visit(tile: vec2<u32>, footprint: Footprint, id: u32) {
    let bin = bin_of(tile);
    if bin < BINS {
        atomicAdd(&bins[bin], 1u);
    } else {
        atomicAdd(&ends[number_of(tile)], 1u);
    }
}

var<workgroup> seen: atomic<u32>;

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = enter_gaussian(group, groups, local);
    let first = which * views[which].gaussian_count;
    if local == 0u {
        atomicStore(&seen, 0u);
    }
    begin_visits(local);
    var footprint: Footprint;
    var touched = 0u;
    var visits = false;
    if i < views[which].gaussian_count {
        footprint = project_one(i);
        if footprint.opacity > 0.0 {
            touched = touched_by(footprint);
            var whole = touched;
            if views[which].row_end - views[which].row_start < views[which].tiles_y {
                whole = count_tiles(footprint, 0u, views[which].tiles_y);
            }
            if whole > 0u {
                atomicAdd(&seen, 1u);
            }
            if touched > 0u {
                footprints[first + i] = rows_of(footprint);
                visits = see(footprint, i, touched, local);
            }
        }
        tiles[first + i] = touched;
    }
    storageBarrier();
    open_bins(local);
    if visits {
        visit_touched(touched, footprint, i);
    }
    if local == 0u {
        larges = atomicLoad(&large_count);
        let visible = atomicLoad(&seen);
        if visible > 0u {
            atomicAdd(&plans[which].visible, visible);
        }
    }
    let count = workgroupUniformLoad(&larges);
    for (var at = local; at < bin_sides.x * bin_sides.y; at += WORKGROUP_SIZE) {
        var sum = 0u;
        for (var k = 0u; k < bin_spread; k++) {
            sum += atomicLoad(&bins[at * bin_spread + k]);
        }
        if sum > 0u {
            atomicAdd(&ends[number_of(tile_of(at))], sum);
        }
    }
    // Those are not counted in bins: their sums are out already.
    bin_sides = vec2(0u);
    for (var k = 0u; k < count; k++) {
        let id = large[k];
        visit_tiles(footprint_of(footprints[first + id]), id, local / 8u, 32u, local % 8u, 8u);
    }
}
