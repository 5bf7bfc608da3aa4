// Stage 8: front-to-back blend of a tile's Gaussians: colour, alpha, expected depth, labels.
// Twin: src/render/cpu/rasterize.rs
// What label_of, add_label and store_labels do is one of common/labels_*.wgsl.
//
// A tile is 32 parts of 4 x 2 pixels. Gaussians are staged by the batch, each with a bit for every
// part that the box around its footprint meets; a part's eight invocations then walk their own
// bits, so that most of a batch costs them nothing. The box is never too small: no pixel changes.

@group(0) @binding(1) var<storage, read> footprints: array<Footprint>;
@group(0) @binding(2) var<storage, read> isect_ids: array<u32>;
@group(0) @binding(3) var<storage, read> ranges: array<u32>;
// The pictures of the band one after another, each row-major: f32 as bits. Of a fast view colour
// and alpha share a word of four levels.
@group(0) @binding(4) var<storage, read_write> pictures: array<u32>;
// [views][N, 3] as shade gives them; of a scene of degree 0 its harmonics, [N, 3].
@group(0) @binding(5) var<storage, read> colors: array<f32>;

// mean - tile corner, slope, inv_sx
var<workgroup> shapes: array<vec4<f32>, 256>;
// inv_sy, opacity, reach, label
var<workgroup> weights: array<vec4<f32>, 256>;
// colour, depth; of labels alone a row of their table
var<workgroup> paints: array<vec4<f32>, 256>;
// Parts met by each staged Gaussian, and the same bits the other way round: staged Gaussians that
// meet a part, words[part + PARTS * (Gaussian / 32)].
var<workgroup> met: array<u32, 256>;
var<workgroup> words: array<u32, 256>;
var<workgroup> done_count: atomic<u32>;
var<workgroup> all_done: u32;

const PARTS: u32 = 32u;
const WORDS: u32 = 8u;

// A kernel is made for each set of pictures.
override WITH_COLOR: bool = true;
override WITH_DEPTH: bool = true;

// Bits of the parts that meet the box around a footprint, whose mean is relative to the tile.
fn parts_of(footprint: Footprint, mean: vec2<f32>) -> u32 {
    let root = sqrt(footprint.reach);
    let tall = root / footprint.inv_sy;
    let across = root / footprint.inv_sx;
    let lean = abs(footprint.slope) * tall;
    // √(across² + lean²) without squares, which may overflow. The slack is far over f32's rounding.
    let large = max(across, lean);
    let ratio = min(across, lean) / large;
    let half = vec2(large * sqrt(1.0 + ratio * ratio), tall) * 1.0001 + 0.02;
    let low = mean - half;
    let high = mean + half;
    // Pixel centres of column c of the parts are 4 c + 0.5 to 4 c + 3.5, of row r 2 r + 0.5 and
    // 2 r + 1.5. Written so that a NaN meets everything.
    var columns = 0u;
    for (var c = 0u; c < 4u; c++) {
        let first = f32(c) * 4.0 + 0.5;
        columns |= select(0x11111111u << c, 0u, low.x > first + 3.0 || high.x < first);
    }
    var rows = 0u;
    for (var r = 0u; r < 8u; r++) {
        let first = f32(r) * 2.0 + 0.5;
        rows |= select(0xfu << (r * 4u), 0u, low.y > first + 1.0 || high.y < first);
    }
    return columns & rows;
}

fn color_of(id: u32) -> vec3<f32> {
    if views[which].sh_count == 1u {
        let at = id * 3u;
        let c = vec3(colors[at], colors[at + 1u], colors[at + 2u]);
        return max(vec3(SH_OFFSET) + SH_C0 * c, vec3(0.0));
    }
    let at = (which * views[which].gaussian_count + id) * 3u;
    return vec3(colors[at], colors[at + 1u], colors[at + 2u]);
}

// A Gaussian on its way from the scene to the workgroup.
struct Staged {
    some: bool,
    footprint: Footprint,
    label: u32,
    paint: vec4<f32>,
}

fn fetch(at: u32, end: u32) -> Staged {
    var staged: Staged;
    if at >= end {
        return staged;
    }
    let id = isect_ids[views[which].pair_start + at];
    if id == NO_GAUSSIAN {
        return staged;
    }
    staged.some = true;
    staged.footprint = footprints[which * views[which].gaussian_count + id];
    staged.label = label_of(id);
    if WITH_COLOR || WITH_DEPTH {
        staged.paint.w = staged.footprint.depth;
        if WITH_COLOR {
            staged.paint = vec4(color_of(id), staged.paint.w);
        }
    } else {
        staged.paint = label_row(staged.label);
    }
    return staged;
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) tile: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = tile.z;
    // Views of a batch may differ in size.
    let tiled = tile.x < views[which].tiles_x
        && tile.y + views[which].row_start < views[which].row_end;
    let corner = vec2<f32>(vec2(tile.x, tile.y + views[which].row_start) * TILE_SIZE);
    let part = local / 8u;
    let lane = local % 8u;
    let at = vec2((part & 3u) * 4u + (lane & 3u), (part >> 2u) * 2u + (lane >> 2u));
    let pixel = vec2<f32>(at) + 0.5;
    let x = tile.x * TILE_SIZE + at.x;
    let y = tile.y * TILE_SIZE + at.y;
    let inside = tiled && x < views[which].width
        && y + views[which].row_start * TILE_SIZE < views[which].height;
    let at_pixel = y * views[which].width + x;
    let painted = WITH_COLOR || WITH_DEPTH;
    var start = 0u;
    var end = 0u;
    if tiled {
        let range = views[which].range_start + tile.y * views[which].tiles_x + tile.x;
        start = ranges[range];
        end = ranges[range + 1u];
    }

    if local == 0u {
        atomicStore(&done_count, 0u);
    }
    workgroupBarrier();
    var color = vec3(0.0);
    var depth = 0.0;
    var alpha_sum = 0.0;
    var transmittance = 1.0;
    var done = !inside;
    var counted = done;
    if done {
        atomicAdd(&done_count, 1u);
    }
    let batches = (end - start + WORKGROUP_SIZE - 1u) / WORKGROUP_SIZE;
    var staged = fetch(start + local, end);
    for (var batch = 0u; batch < batches; batch++) {
        var parts = 0u;
        if staged.some {
            let one = staged.footprint;
            let mean = one.mean - corner;
            parts = parts_of(one, mean);
            shapes[local] = vec4(mean, one.slope, one.inv_sx);
            // A label has 16 bits: exact as f32.
            weights[local] = vec4(one.inv_sy, one.opacity, one.reach, f32(staged.label));
            paints[local] = staged.paint;
        }
        met[local] = parts;
        workgroupBarrier();
        var word = 0u;
        for (var k = 0u; k < 32u; k++) {
            word |= ((met[(local & 0xe0u) + k] >> (local & 31u)) & 1u) << k;
        }
        words[local] = word;
        if local == 0u {
            all_done = atomicLoad(&done_count);
        }
        if workgroupUniformLoad(&all_done) == WORKGROUP_SIZE {
            break;
        }
        // The next batch is on its way while this one is blended.
        staged = fetch(start + (batch + 1u) * WORKGROUP_SIZE + local, end);
        // Hardly a branch: invocations that part ways take as long as both ways together.
        var w = 0u;
        word = words[part];
        loop {
            while word == 0u && w < WORDS - 1u {
                w++;
                word = words[part + w * PARTS];
            }
            if word == 0u {
                break;
            }
            let k = w * 32u + firstTrailingBit(word);
            word &= word - 1u;
            let shape = shapes[k];
            let weight = weights[k];
            let paint = paints[k];
            let d = pixel - shape.xy;
            let across = shape.w * (d.x - shape.z * d.y);
            let along = weight.x * d.y;
            let power = across * across + along * along;
            let alpha = min(ALPHA_MAX, weight.y * exp(-power));
            let left = transmittance * (1.0 - alpha);
            // Over its reach alpha is under ALPHA_MIN for certain; a NaN is skipped too.
            let hit = power <= weight.z && alpha >= ALPHA_MIN && !done;
            let ends = hit && left <= TRANSMITTANCE_MIN;
            let adds = hit && !ends;
            done = done || ends;
            // Colours, depths and rows are finite: nothing of them adds 0.
            let share = select(0.0, alpha * transmittance, adds);
            if WITH_COLOR {
                color += share * paint.xyz;
            }
            if WITH_DEPTH {
                depth += share * paint.w;
            }
            if adds {
                add_label(u32(weight.w), paint, painted, share, at_pixel);
            }
            alpha_sum += share;
            transmittance = select(transmittance, left, adds);
        }
        if done && !counted {
            counted = true;
            atomicAdd(&done_count, 1u);
        }
        workgroupBarrier();
    }
    if inside {
        let alpha = min(alpha_sum, 1.0);
        if WITH_COLOR && views[which].color_start != NO_PICTURE {
            let out = color + (1.0 - alpha) * views[which].background.xyz;
            if views[which].fast != 0u {
                pictures[views[which].color_start + at_pixel] = pack4x8unorm(vec4(out, alpha));
            } else {
                let to = views[which].color_start + at_pixel * 3u;
                pictures[to] = bitcast<u32>(out.x);
                pictures[to + 1u] = bitcast<u32>(out.y);
                pictures[to + 2u] = bitcast<u32>(out.z);
            }
        }
        if WITH_DEPTH && views[which].depth_start != NO_PICTURE {
            pictures[views[which].depth_start + at_pixel] =
                bitcast<u32>(select(0.0, depth / alpha_sum, alpha_sum > 0.0));
        }
        if views[which].alpha_start != NO_PICTURE {
            pictures[views[which].alpha_start + at_pixel] = bitcast<u32>(alpha);
        }
        store_labels(at_pixel);
    }
}
