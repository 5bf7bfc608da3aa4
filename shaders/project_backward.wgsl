// Backward pass of stage 1: each Gaussian adds up what the tiles say of it, and goes back through
// the projection: Σ = M Mᵀ + blur, M = J W R diag(scales).
// CPU: crates/render/src/cpu/backward.rs (in f64)
//
// A Gaussian finds its pairs again as they were emitted: in the list of each tile that it touches,
// which is sorted, in the order of the tiles.

@group(0) @binding(1) var<storage, read> gaussians: array<Gaussian>;
@group(0) @binding(2) var<storage, read> footprints: array<FootprintRows>;
// What each touches.
@group(0) @binding(3) var<storage, read> tiles: array<u32>;
@group(0) @binding(4) var<storage, read> lists: array<vec2<u32>>;
// (depth key, Gaussian)
@group(0) @binding(5) var<storage, read> pairs: array<vec2<u32>>;
// [capacity, PAIR_SUMS] of rasterize_backward.
@group(0) @binding(6) var<storage, read> sums: array<f32>;
@group(0) @binding(7) var<storage, read> sources: array<Source>;
// [N, GRADIENT_WORDS] by mean, opacity, quaternion, scales, and whether it is seen; then [N, K, 3]
// by the harmonics. Here the first three of K * 3 are by the colour: shade_backward goes on with
// them.
@group(0) @binding(8) var<storage, read_write> gradients: array<f32>;

var<private> found: array<f32, PAIR_SUMS>;
// Sums of each invocation, and of 16 each.
var<workgroup> shares: array<f32, 2560>;
var<workgroup> shares_of_16: array<f32, 160>;

fn visit(tile: vec2<u32>, footprint: Footprint, id: u32) {
    let list = lists[number_of(tile)];
    let key = bitcast<u32>(footprint.depth);
    var low = list.x;
    var high = list.y;
    while low < high {
        let middle = low + (high - low) / 2u;
        let pair = pairs[middle];
        if pair.x < key || (pair.x == key && pair.y < id) {
            low = middle + 1u;
        } else {
            high = middle;
        }
    }
    if low < list.y && pairs[low].y == id {
        let at = low % views[which].isect_capacity * PAIR_SUMS;
        for (var k = 0u; k < PAIR_SUMS; k++) {
            found[k] += sums[at + k];
        }
    }
}

// What one number of a Gaussian says: 0 where f32 does not hold it.
fn put(at: u32, value: f32) {
    gradients[at] = select(0.0, value, is_finite(value));
}

// The derivatives by Gaussian i, of `found`.
fn back(i: u32, footprint: Footprint) {
    let gaussian = gaussians[i];
    // dpower/dplace = a u + b v, for a step of the pixel against the centre.
    let a = vec2(2.0, -2.0 * footprint.conic_shear) * footprint.conic_x;
    let b = 2.0 * footprint.conic_y;
    let by_place = -(a * found[1] + vec2(0.0, b * found[2]));

    let t = camera_point(gaussian.mean);
    let per_z = 1.0 / t.z;
    let focal = views[which].focal * per_z;
    let slope = t.xy * per_z;
    let bounded = clamp(slope, views[which].slope_min, views[which].slope_max);
    // The variance that the blur lost, or the square of the size where it is under 1, with its
    // derivatives by the centre and by t.z.
    var lost = 0.0;
    var square = 1.0;
    var blur_by_mean = vec3(0.0);
    var blur_by_z = 0.0;
    if gaussian.source < views[which].source_count {
        let source = sources[views[which].source_start + gaussian.source];
        let width = max(dot(gaussian.mean - source.center, source.axis), 0.0) * source.scale;
        let least = t.z / views[which].own_focal;
        if width > least {
            lost = BLUR_PX2 * (width - least) * (width + least);
            blur_by_mean = source.axis * (2.0 * BLUR_PX2 * width * source.scale);
            blur_by_z = -2.0 * BLUR_PX2 * least / views[which].own_focal;
        }
        let size = width / least * (OWN_SIZE * OWN_SIZE);
        if size < 1.0 && width > 0.0 && views[which].antialiased == 0u {
            square = size * size;
            blur_by_mean = source.axis * (2.0 * square / width * source.scale);
            blur_by_z = -2.0 * square * per_z;
        }
    }
    let drawn = BLUR_PX2 * square + PIXEL_PX2 * (1.0 - square);
    let squares = gaussian.scale * gaussian.scale + lost;
    let rotation = rotation_of(gaussian.quat);
    let turned_x = views[which].rotation_x.xyz * rotation;
    let turned_y = views[which].rotation_y.xyz * rotation;
    let turned_z = views[which].rotation_z.xyz * rotation;
    // Rows of J W R: a column is what an axis of the Gaussian is on the picture.
    let sharp_x = (turned_x - turned_z * bounded.x) * focal.x;
    let sharp_y = (turned_y - turned_z * bounded.y) * focal.y;
    // a and b along each axis. a is (row x - shear · row y) of J W R: a difference of what is long
    // in needles. It is taken apart (Cauchy-Binet), with 1 / (variance of y) = b² / 2.
    let normal = cross(sharp_x, sharp_y);
    let beside = cross(squares * sharp_y, normal);
    let along_a = (a.x * 0.5 * b * b) * (drawn * sharp_x + beside);
    let along_b = b * sharp_y;
    // The derivative by the covariance is -(a u + b v)² / 2 as a matrix, summed: here times axes.
    var by_u = -(found[3] * along_a + found[4] * along_b);
    var by_v = -(found[4] * along_a + found[5] * along_b);
    // The opacity goes with √(det less blurred / det): by the covariance that is half the
    // difference of the inverses, that of the blurs · inverse less blurred · inverse / 2.
    var by_opacity = -found[0] / footprint.opacity;
    var by_size = 0.0;
    if views[which].antialiased != 0u || square < 1.0 {
        let inner = select(BLUR_PX2 * square, 0.0, views[which].antialiased != 0u);
        let least = select(ALPHA_MIN, 0.0, views[which].antialiased != 0u);
        let areas = squares.yzx * squares.zxy * normal * normal;
        let wide = dot(squares, sharp_x * sharp_x + sharp_y * sharp_y);
        let per_det = 1.0 / (areas.x + areas.y + areas.z + inner * (wide + inner));
        if is_finite(per_det) {
            let by_log = by_opacity * (footprint.opacity - least);
            let by_share = 0.5 * by_log * (drawn - inner) * per_det;
            let skewed = sharp_y + footprint.conic_shear * sharp_x;
            by_u += by_share * (inner * along_a + a.x * cross(squares * skewed, normal));
            by_v += by_share * (inner * along_b + b * cross(normal, squares * sharp_x));
            let by_drawn = dot(a, a) * (found[3] + 0.5 * by_log) + 2.0 * a.y * b * found[4]
                + b * b * (found[5] + 0.5 * by_log);
            by_size = 0.5 * (BLUR_PX2 * by_log * (wide + 2.0 * inner) * per_det
                - (BLUR_PX2 - PIXEL_PX2) * by_drawn);
            if gaussian.opacity > least {
                by_opacity *= (footprint.opacity - least) / (gaussian.opacity - least);
            }
        }
    }
    let by_square = 0.5 * (along_a * by_u + along_b * by_v);
    let by_sharp_x = a.x * squares * by_u;
    let by_sharp_y = squares * (a.y * by_u + b * by_v);
    // By two axes each: 1 and 2, 2 and 0, 0 and 1.
    let mixed = along_a.yzx * by_u.zxy + along_b.yzx * by_v.zxy;
    let by_x = by_sharp_x * focal.x;
    let by_y = by_sharp_y * focal.y;
    let by_slope = vec2(-dot(by_x, turned_z), -dot(by_y, turned_z));
    let by_blur = select(by_size, by_square.x + by_square.y + by_square.z, lost > 0.0);
    let free = select(vec2(0.0), by_slope * per_z, bounded == slope);
    let by_t = by_place * focal + free;
    let by_depth = found[9] + by_blur * blur_by_z - dot(by_t, slope)
        - (dot(by_sharp_x, sharp_x) + dot(by_sharp_y, sharp_y)) * per_z;
    let by_mean = by_t.x * views[which].rotation_x.xyz + by_t.y * views[which].rotation_y.xyz
        + by_depth * views[which].rotation_z.xyz + by_blur * blur_by_mean;

    // A turn about one axis moves variance between the other two: nothing where they are equal.
    let scale = gaussian.scale;
    let by_turn = mixed * ((scale.yzx - scale.zxy) * (scale.yzx + scale.zxy));
    let v = gaussian.quat.yzw;
    let by_quat = 2.0 * vec4(-dot(v, by_turn), gaussian.quat.x * by_turn + cross(v, by_turn));
    let by_own = 2.0 * scale * by_square;

    let to = i * GRADIENT_WORDS;
    for (var k = 0u; k < 3u; k++) {
        put(to + k, by_mean[k]);
        put(to + 8u + k, by_own[k]);
    }
    put(to + 3u, by_opacity);
    for (var k = 0u; k < 4u; k++) {
        put(to + 4u + k, by_quat[k]);
    }
    gradients[to + 11u] = 1.0;
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = enter_row(group, groups, local);
    let total = views[which].gaussian_count;
    if local == 0u {
        atomicStore(&large_count, 0u);
    }
    workgroupBarrier();
    var touched = 0u;
    var footprint: Footprint;
    if i < total {
        touched = count_of(tiles[i]);
        if touched > 0u {
            footprint = footprint_of(footprints[i]);
        }
        if touched > LARGE_TILES {
            large[atomicAdd(&large_count, 1u)] = i;
        } else if touched > 0u {
            visit_tiles(footprint, i, 0u, 1u, 0u, 1u);
        }
    }
    var own = found;
    workgroupBarrier();
    if local == 0u {
        larges = atomicLoad(&large_count);
    }
    let count = workgroupUniformLoad(&larges);
    for (var one = 0u; one < count; one++) {
        let id = large[one];
        found = array<f32, PAIR_SUMS>();
        visit_tiles(footprint_of(footprints[id]), id, local / 8u, 32u, local % 8u, 8u);
        for (var k = 0u; k < PAIR_SUMS; k++) {
            shares[local * PAIR_SUMS + k] = found[k];
        }
        workgroupBarrier();
        if local < 16u * PAIR_SUMS {
            var sum = 0.0;
            for (var k = 0u; k < 16u; k++) {
                sum += shares[(local / PAIR_SUMS * 16u + k) * PAIR_SUMS + local % PAIR_SUMS];
            }
            shares_of_16[local] = sum;
        }
        workgroupBarrier();
        if id == i {
            for (var k = 0u; k < 16u * PAIR_SUMS; k++) {
                own[k % PAIR_SUMS] += shares_of_16[k];
            }
        }
    }
    if i >= total {
        return;
    }
    found = own;
    let by_color = total * GRADIENT_WORDS + i * views[which].sh_count * 3u;
    for (var k = 0u; k < 3u; k++) {
        put(by_color + k, found[6u + k]);
    }
    if touched > 0u {
        back(i, footprint);
    } else {
        for (var k = 0u; k < GRADIENT_WORDS; k++) {
            gradients[i * GRADIENT_WORDS + k] = 0.0;
        }
    }
}
