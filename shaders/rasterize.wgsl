// Stage 6: front-to-back blend of a tile's Gaussians: colour, alpha, expected depth, labels.
// CPU: crates/render/src/cpu/rasterize.rs (which cuts tiles into cells of 4 x 4 pixels)
// common/parts.wgsl says which parts of a tile a Gaussian meets.
// common/labels_*.wgsl define label_of, label_row, add_label and store_labels.
//
// Gaussians are staged in batches, each with one bit for every part that it meets. The invocations
// of a part walk only its own bits. What a pixel reads of a Gaussian is as short as it can be: the
// blend waits for that.

// The pictures of the band one after another, each row-major: f32 as bits, or levels.
@group(0) @binding(4) var<storage, read_write> pictures: array<u32>;

// mean - tile corner, conic_shear, conic_x
var<workgroup> shapes: array<vec4<f32>, 256>;
// conic_y, opacity, and the first two of its paint: colour, depth; of labels alone a row of their
// table
var<workgroup> weights: array<vec4<f32>, 256>;
// The rest of its paint.
var<workgroup> paints: array<vec2<f32>, 256>;
var<workgroup> labels: array<u32, 256>;
// Parts met by each staged Gaussian, and the same bits the other way round: staged Gaussians that
// meet a part, words[part + PARTS * (Gaussian / 32)].
var<workgroup> met: array<u32, 256>;
var<workgroup> words: array<u32, 256>;
var<workgroup> done_count: atomic<u32>;
var<workgroup> all_done: u32;

const WORDS: u32 = 8u;

// A kernel is compiled for each set of pictures.
override WITH_COLOR: bool = true;
override WITH_DEPTH: bool = true;
// Pictures of bytes.
override WITH_BYTES: bool = false;
// Work that is left out because no pixel changes (crates/render/src/switches.rs).
override SKIP_ENDED_RAYS: bool = true;

// Part of the group-th eight pixels. Four in a row make a block of 8 x 4 pixels: where a surface
// leans, what is next in depth meets all of them or none.
fn part_of(group: u32) -> u32 {
    let at = vec2(group & 1u, (group >> 1u) & 1u) + 2u * vec2((group >> 2u) & 1u, group >> 3u);
    return at.y * 4u + at.x;
}

// Place of pixel q of this invocation in the tile.
fn pixel_of(local: u32, q: u32) -> vec2<u32> {
    return place_in_tile(part_of(local * PIXELS / PIXELS_MAX), local * PIXELS % PIXELS_MAX + q);
}

// A Gaussian on its way from the scene to the workgroup.
struct Staged {
    some: bool,
    footprint: Footprint,
    label: u32,
    paint: vec4<f32>,
}

// The row of a staged label: staged too where no colour or depth takes its place.
fn row_of(label: u32, paint: vec4<f32>) -> vec4<f32> {
    if WITH_COLOR || WITH_DEPTH {
        return label_row(label);
    }
    return paint;
}

fn fetch(at: u32, end: u32) -> Staged {
    var staged: Staged;
    if at >= end {
        return staged;
    }
    let id = pairs[at].y;
    staged.some = true;
    staged.footprint = footprint_of(footprints[which * views[which].gaussian_count + id]);
    staged.label = label_of(id);
    if WITH_COLOR || WITH_DEPTH {
        staged.paint.w = abs(staged.footprint.depth);
        if WITH_COLOR {
            staged.paint = vec4(color_of(id), staged.paint.w);
        }
    } else {
        staged.paint = label_row(staged.label);
    }
    return staged;
}

// A pixel and what it has blended.
struct Pixel {
    // Its centre relative to the tile.
    center: vec2<f32>,
    // Its number in the pictures of the band; NO_PICTURE outside of them.
    at: u32,
    // The least alpha that counts; ENDED after its ray's end.
    least: f32,
    color: vec3<f32>,
    depth: f32,
    alpha: f32,
    transmittance: f32,
}

// exp(-1000) is 0. The opacity of a merged Gaussian may be over 1, so power_max has no bound.
const POWER_BOUND: f32 = 1000.0;
// No alpha is so large.
const ENDED: f32 = 2.0;

// Transmittance at which a ray goes no farther: TRANSMITTANCE_MIN or more.
var<private> ray_end: f32;

// The pixels of this invocation.
var<private> pixels: array<Pixel, PIXELS_MAX>;

// Half the squared distance of a pixel to a Gaussian, and its alpha there.
fn alpha_of(q: u32, shape: vec4<f32>, weight: vec4<f32>) -> vec2<f32> {
    let at = along_axes(pixels[q].center, shape, weight.x);
    let power = at.x * at.x + at.y * at.y;
    return vec2(power, min(ALPHA_MAX, weight.y * exp(-power)));
}

fn blend(q: u32, some: bool, one: vec2<f32>, paint: vec4<f32>, label: u32, row: vec4<f32>) {
    let alpha = one.y;
    let transmittance = pixels[q].transmittance;
    let left = transmittance * (1.0 - alpha);
    // Hardly a branch: invocations that part ways take as long as both ways together. Over
    // POWER_BOUND alpha is 0; a NaN is skipped too.
    let hit = some && one.x <= POWER_BOUND && alpha >= pixels[q].least;
    let adds = hit && left > TRANSMITTANCE_MIN;
    pixels[q].least = select(pixels[q].least, ENDED, hit && left <= ray_end);
    // Colours, depths and rows are finite: nothing of them adds 0.
    let share = select(0.0, alpha * transmittance, adds);
    if WITH_COLOR {
        pixels[q].color += share * paint.xyz;
    }
    if WITH_DEPTH {
        pixels[q].depth += share * paint.w;
    }
    if adds {
        add_label(label, row, share, q, pixels[q].at);
    }
    pixels[q].alpha += share;
    pixels[q].transmittance = select(transmittance, left, adds);
}

// A staged Gaussian and its alpha at a pixel.
struct Met {
    one: vec2<f32>,
    paint: vec4<f32>,
    label: u32,
    row: vec4<f32>,
}

fn meet(q: u32, k: u32) -> Met {
    let weight = weights[k];
    let paint = vec4(weight.zw, paints[k]);
    let label = labels[k];
    return Met(alpha_of(q, shapes[k], weight), paint, label, row_of(label, paint));
}

// Blends Gaussian k.x, and k.y behind it if `more`. Their alphas are on their way at once.
fn blend_two(q: u32, k: vec2<u32>, more: bool) {
    let a = meet(q, k.x);
    let b = meet(q, k.y);
    blend(q, true, a.one, a.paint, a.label, a.row);
    blend(q, more, b.one, b.paint, b.label, b.row);
}

// The same with four, as far as `more`: for one pixel an invocation.
fn blend_four(k: vec4<u32>, more: vec3<bool>) {
    let a = meet(0u, k.x);
    let b = meet(0u, k.y);
    let c = meet(0u, k.z);
    let d = meet(0u, k.w);
    blend(0u, true, a.one, a.paint, a.label, a.row);
    blend(0u, more.x, b.one, b.paint, b.label, b.row);
    blend(0u, more.y, c.one, c.paint, c.label, c.row);
    blend(0u, more.z, d.one, d.paint, d.label, d.row);
}

// Colours of the pixels of this invocation in 24 bits.
var<private> rgbs: array<u32, PIXELS_MAX>;

fn level(value: f32) -> u32 {
    return u32(clamp(value, 0.0, 1.0) * 255.0 + 0.5);
}

// The colour of a pixel, over what is behind it. `left` is the light of a ray that ended early.
fn composed(q: u32, left: f32, corner: vec2<f32>) -> vec3<f32> {
    let color = pixels[q].color + left * views[which].ray_end.y;
    let room = 1.0 - min(pixels[q].alpha + left, 1.0);
    if views[which].backdrop_start == NO_PICTURE {
        return color + room * views[which].background.xyz;
    }
    if room < views[which].room_min {
        return color;
    }
    return color + room * backdrop_behind(corner + pixels[q].center - 0.5);
}

fn store(q: u32, corner: vec2<f32>) {
    let at = pixels[q].at;
    let transmittance = pixels[q].transmittance;
    let left = select(0.0, transmittance, transmittance <= views[which].ray_end.x);
    // What is behind such a ray is between nothing and all.
    let alpha = min(pixels[q].alpha + 0.5 * left, 1.0);
    if WITH_COLOR && views[which].color_start != NO_PICTURE {
        let out = composed(q, left, corner);
        let rgb = level(out.x) | (level(out.y) << 8u) | (level(out.z) << 16u);
        if views[which].levels == LEVELS_RGB {
            rgbs[q] = rgb;
        } else if views[which].levels == LEVELS_RGBA {
            pictures[views[which].color_start + at] = rgb | (level(alpha) << 24u);
        } else {
            let to = views[which].color_start + at * 3u;
            pictures[to] = bitcast<u32>(out.x);
            pictures[to + 1u] = bitcast<u32>(out.y);
            pictures[to + 2u] = bitcast<u32>(out.z);
        }
    }
    if WITH_DEPTH && views[which].depth_start != NO_PICTURE {
        let sum = pixels[q].alpha;
        pictures[views[which].depth_start + at] =
            bitcast<u32>(select(0.0, pixels[q].depth / sum, sum > 0.0));
    }
    if views[which].alpha_start != NO_PICTURE {
        pictures[views[which].alpha_start + at] = bitcast<u32>(alpha);
    }
    pixels[q].alpha = alpha;
    store_labels(q, at);
}

// The lowest bytes of four numbers in a word.
fn pack_bytes(of_four: vec4<u32>) -> u32 {
    let bytes = of_four & vec4(0xffu);
    return bytes.x | (bytes.y << 8u) | (bytes.z << 16u) | (bytes.w << 24u);
}

// Writes the pictures whose pixels share words, by way of `met` and `words`.
fn store_bytes(local: u32, tile: vec2<u32>) {
    for (var q = 0u; q < PIXELS; q++) {
        let place = pixel_of(local, q);
        let to = place.y * TILE_SIZE + place.x;
        let inside = pixels[q].at != NO_PICTURE;
        let bytes = level(min(pixels[q].alpha, 1.0)) | (mask_byte(q) << 8u);
        met[to] = select(0u, bytes, inside);
        words[to] = select(0u, rgbs[q], inside);
    }
    workgroupBarrier();
    let bottom = min(views[which].row_end * TILE_SIZE, views[which].height);
    let rows = bottom - views[which].row_start * TILE_SIZE;
    // Four pixels are a word of alpha or mask and three of colour.
    let stride = (views[which].width + 3u) / 4u;
    let color_stride = (views[which].width * 3u + 3u) / 4u;
    for (var i = local; i < 64u; i += LANES) {
        let x = tile.x * 4u + i % 4u;
        let y = tile.y * TILE_SIZE + i / 4u;
        if x >= stride || y >= rows {
            continue;
        }
        var bytes: vec4<u32>;
        var rgb: vec4<u32>;
        for (var k = 0u; k < 4u; k++) {
            bytes[k] = met[i * 4u + k];
            rgb[k] = words[i * 4u + k];
        }
        if views[which].alpha_byte_start != NO_PICTURE {
            pictures[views[which].alpha_byte_start + y * stride + x] = pack_bytes(bytes);
        }
        if views[which].mask_start != NO_PICTURE {
            pictures[views[which].mask_start + y * stride + x] = pack_bytes(bytes >> vec4(8u));
        }
        if views[which].levels == LEVELS_RGB && views[which].color_start != NO_PICTURE {
            let to = views[which].color_start + y * color_stride + x * 3u;
            let left = color_stride - x * 3u;
            pictures[to] = rgb.x | (rgb.y << 24u);
            if left > 1u {
                pictures[to + 1u] = (rgb.y >> 8u) | (rgb.z << 16u);
            }
            if left > 2u {
                pictures[to + 2u] = (rgb.z >> 16u) | (rgb.w << 8u);
            }
        }
    }
}

@compute @workgroup_size(LANES)
fn main(
    @builtin(workgroup_id) tile: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = tile.z;
    ray_end = views[which].ray_end.x;
    // Views of a batch may differ in size.
    let tiled = tile.x < views[which].tiles_x
        && tile.y + views[which].row_start < views[which].row_end;
    let corner = vec2<f32>(vec2(tile.x, tile.y + views[which].row_start) * TILE_SIZE);
    let part = part_of(local * PIXELS / PIXELS_MAX);
    var start = 0u;
    var end = 0u;
    if tiled {
        let list = lists[views[which].range_start + tile.y * views[which].tiles_x + tile.x];
        start = list.x;
        end = list.y;
    }

    if local == 0u {
        atomicStore(&done_count, 0u);
    }
    workgroupBarrier();
    var open = 0u;
    for (var q = 0u; q < PIXELS; q++) {
        let at = pixel_of(local, q);
        let x = tile.x * TILE_SIZE + at.x;
        let y = tile.y * TILE_SIZE + at.y;
        let inside = tiled && x < views[which].width
            && y + views[which].row_start * TILE_SIZE < views[which].height;
        let place = select(NO_PICTURE, y * views[which].width + x, inside);
        pixels[q] = Pixel(
            vec2<f32>(at) + 0.5, place, select(ENDED, ALPHA_MIN, inside), vec3(0.0), 0.0, 0.0, 1.0,
        );
        open += u32(inside);
    }
    var counted = open == 0u;
    if counted {
        atomicAdd(&done_count, 1u);
    }
    let batches = (end - start + WORKGROUP_SIZE - 1u) / WORKGROUP_SIZE;
    var staged: array<Staged, PIXELS_MAX>;
    for (var q = 0u; q < PIXELS; q++) {
        staged[q] = fetch(start + local + q * LANES, end);
    }
    for (var batch = 0u; batch < batches; batch++) {
        for (var q = 0u; q < PIXELS; q++) {
            let to = local + q * LANES;
            var parts = 0u;
            if staged[q].some {
                let one = staged[q].footprint;
                let mean = one.mean - corner;
                parts = parts_of(one, mean);
                shapes[to] = vec4(mean, one.conic_shear, one.conic_x);
                weights[to] = vec4(one.conic_y, one.opacity, staged[q].paint.xy);
                paints[to] = staged[q].paint.zw;
                labels[to] = staged[q].label;
            }
            met[to] = parts;
        }
        workgroupBarrier();
        for (var q = 0u; q < PIXELS; q++) {
            let to = local + q * LANES;
            var turned = 0u;
            for (var k = 0u; k < 32u; k++) {
                turned |= ((met[(to & 0xe0u) + k] >> (to & 31u)) & 1u) << k;
            }
            words[to] = turned;
        }
        if local == 0u {
            all_done = atomicLoad(&done_count);
        }
        if workgroupUniformLoad(&all_done) == LANES && SKIP_ENDED_RAYS {
            break;
        }
        // The next batch is on its way while this one is blended.
        for (var q = 0u; q < PIXELS; q++) {
            let at = start + (batch + 1u) * WORKGROUP_SIZE + local + q * LANES;
            staged[q] = fetch(at, end);
        }
        var w = 0u;
        var word = words[part];
        loop {
            while word == 0u && w < WORDS - 1u {
                w++;
                word = words[part + w * PARTS];
            }
            if word == 0u {
                break;
            }
            var four: vec4<u32>;
            var more: vec3<bool>;
            four.x = firstTrailingBit(word);
            word &= word - 1u;
            more.x = word != 0u;
            four.y = select(four.x, firstTrailingBit(word), more.x);
            word &= max(word, 1u) - 1u;
            // No loop where there is one pixel: GPUs' compilers make less of a loop within a loop.
            if PIXELS == 1u {
                more.y = word != 0u;
                four.z = select(four.x, firstTrailingBit(word), more.y);
                word &= max(word, 1u) - 1u;
                more.z = word != 0u;
                four.w = select(four.x, firstTrailingBit(word), more.z);
                word &= max(word, 1u) - 1u;
                blend_four(four + w * 32u, more);
            } else {
                for (var q = 0u; q < PIXELS; q++) {
                    blend_two(q, four.xy + w * 32u, more.x);
                }
            }
        }
        open = 0u;
        for (var q = 0u; q < PIXELS; q++) {
            open += u32(pixels[q].least < ENDED);
        }
        if open == 0u && !counted {
            counted = true;
            atomicAdd(&done_count, 1u);
        }
        workgroupBarrier();
    }
    for (var q = 0u; q < PIXELS; q++) {
        if pixels[q].at != NO_PICTURE {
            store(q, corner);
        }
    }
    if WITH_BYTES {
        // All have read what `met` and `words` held.
        workgroupBarrier();
        if tiled {
            store_bytes(local, tile.xy);
        }
    }
}
