// Stage 8: front-to-back blend of a tile's Gaussians: colour, alpha, expected depth, labels.
// Twin: src/render/cpu/rasterize.rs
// What label_of, add_label and store_labels do is one of common/labels_*.wgsl.

@group(0) @binding(0) var<uniform> view: View;
@group(0) @binding(1) var<storage, read> shaded: array<Footprint>;
@group(0) @binding(2) var<storage, read> isect_ids: array<u32>;
@group(0) @binding(3) var<storage, read> ranges: array<u32>;
// The pictures of the band one after another, each row-major.
@group(0) @binding(4) var<storage, read_write> pictures: array<f32>;

// mean - tile corner, slope, inv_sx
var<workgroup> shapes: array<vec4<f32>, 256>;
// inv_sy, opacity, depth, label
var<workgroup> weights: array<vec4<f32>, 256>;
var<workgroup> colors: array<vec4<f32>, 256>;
var<workgroup> done_count: atomic<u32>;
var<workgroup> all_done: u32;

@compute @workgroup_size(16, 16)
fn main(
    @builtin(workgroup_id) tile: vec3<u32>,
    @builtin(local_invocation_id) at: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let corner = vec2<f32>(vec2(tile.x, tile.y + view.row_start) * TILE_SIZE);
    let pixel = vec2<f32>(at.xy) + 0.5;
    let x = tile.x * TILE_SIZE + at.x;
    let y = tile.y * TILE_SIZE + at.y;
    let inside = x < view.width && y + view.row_start * TILE_SIZE < view.height;
    let at_pixel = y * view.width + x;
    let with_color = view.color_start != NO_PICTURE;
    let with_depth = view.depth_start != NO_PICTURE;
    let tile_id = tile.y * view.tiles_x + tile.x;
    let start = ranges[tile_id];
    let end = ranges[tile_id + 1u];

    if local == 0u {
        atomicStore(&done_count, 0u);
        all_done = 0u;
    }
    workgroupBarrier();
    var color = vec3(0.0);
    var depth = 0.0;
    var alpha_sum = 0.0;
    var transmittance = 1.0;
    var done = !inside;
    if done {
        atomicAdd(&done_count, 1u);
    }
    let batches = (end - start + WORKGROUP_SIZE - 1u) / WORKGROUP_SIZE;
    for (var batch = 0u; batch < batches; batch++) {
        workgroupBarrier();
        if local == 0u {
            all_done = atomicLoad(&done_count);
        }
        if workgroupUniformLoad(&all_done) == WORKGROUP_SIZE {
            break;
        }
        let first = start + batch * WORKGROUP_SIZE;
        let staged = min(WORKGROUP_SIZE, end - first);
        if local < staged {
            let id = isect_ids[first + local];
            if id == NO_GAUSSIAN {
                shapes[local] = vec4(0.0);
                weights[local] = vec4(0.0);
                colors[local] = vec4(0.0);
            } else {
                let one = shaded[id];
                shapes[local] = vec4(one.mean - corner, one.slope, one.inv_sx);
                // A label has 16 bits: exact as f32.
                weights[local] = vec4(one.inv_sy, one.opacity, one.depth, f32(label_of(id)));
                if with_color {
                    colors[local] = vec4(one.color, 0.0);
                }
            }
        }
        workgroupBarrier();
        if !done {
            for (var k = 0u; k < staged; k++) {
                let shape = shapes[k];
                let weight = weights[k];
                let d = pixel - shape.xy;
                let across = shape.w * (d.x - shape.z * d.y);
                let along = weight.x * d.y;
                let alpha = min(
                    ALPHA_MAX,
                    weight.y * exp(-(across * across + along * along)),
                );
                // Written so that a NaN is skipped too.
                if !(alpha >= ALPHA_MIN) {
                    continue;
                }
                let left = transmittance * (1.0 - alpha);
                if left <= TRANSMITTANCE_MIN {
                    done = true;
                    atomicAdd(&done_count, 1u);
                    break;
                }
                let share = alpha * transmittance;
                if with_color {
                    color += share * colors[k].xyz;
                }
                if with_depth {
                    depth += share * weight.z;
                }
                add_label(u32(weight.w), share, at_pixel);
                alpha_sum += share;
                transmittance = left;
            }
        }
    }
    if inside {
        let alpha = min(alpha_sum, 1.0);
        if with_color {
            let out = color + (1.0 - alpha) * view.background.xyz;
            let first = view.color_start + at_pixel * 3u;
            pictures[first] = out.x;
            pictures[first + 1u] = out.y;
            pictures[first + 2u] = out.z;
        }
        if with_depth {
            pictures[view.depth_start + at_pixel] = select(0.0, depth / alpha_sum, alpha_sum > 0.0);
        }
        if view.alpha_start != NO_PICTURE {
            pictures[view.alpha_start + at_pixel] = alpha;
        }
        store_labels(at_pixel);
    }
}
