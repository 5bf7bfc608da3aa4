// Backward pass of stage 6: what the pixels of a tile say of its Gaussians, ten sums for each pair.
// CPU: crates/render/src/cpu/backward.rs (whose cells are 4 x 4 pixels)
//
// crates/render/src/backward/mod.rs has the formulas. The picture is drawn whole, not in bands.
// A batch of Gaussians takes two turns. First each pixel goes through those that its part meets,
// front to back, with the statements of the blend: all that differs from pixel to pixel is the
// weight of a Gaussian and dL/dpower. Then each Gaussian adds up the pixels that it meets, in
// registers. Both turns walk (Gaussian, part) cells, so what meets nothing costs nothing. No number
// is shared and every sum has its order: the same bits each time.

// The frame, and what the loss says of it in the same places.
@group(0) @binding(4) var<storage, read> pictures: array<f32>;
@group(0) @binding(6) var<storage, read> by_pictures: array<f32>;
// [capacity, PAIR_SUMS], in the order of `pairs`; 0 before: of dL/dpower times 1, u, v, u², uv, v²,
// of the weight times dL/dcolour and dL/d(sum of depths).
@group(0) @binding(7) var<storage, read_write> sums: array<f32>;

// Gaussians staged at once.
const BATCH: u32 = 32u;
// Cells at once: each has eight numbers of either kind.
const CELLS: u32 = 160u;
const CELL_NUMBERS: u32 = 16u;

// Pictures that the loss depends on.
override BY_COLOR: bool = true;
override BY_DEPTH: bool = true;
override BY_ALPHA: bool = true;

// mean - tile corner, conic_shear, conic_x
var<workgroup> shapes: array<vec4<f32>, BATCH>;
// conic_y, opacity, power_max
var<workgroup> weights: array<vec4<f32>, BATCH>;
// colour, depth
var<workgroup> paints: array<vec4<f32>, BATCH>;
// Parts met by each staged Gaussian, and the cells before it.
var<workgroup> met: array<u32, BATCH>;
var<workgroup> firsts: array<u32, 33>;
// dL/dcolour and dL/d(sum of depths) of each pixel, in the order of the parts.
var<workgroup> seeds: array<vec4<f32>, 256>;
// dL/dpower of a cell's pixels, then their weights. After the turns: the sums of each invocation.
var<workgroup> numbers: array<f32, 2560>;
// Pixels of each part whose rays have ended, and the parts with others.
var<workgroup> ended: array<atomic<u32>, PARTS>;
var<workgroup> open: atomic<u32>;
var<workgroup> goes_on: u32;
var<workgroup> range_end: u32;

struct Pixel {
    // Its centre relative to the tile.
    center: vec2<f32>,
    // Light that reaches the next Gaussian; 0 after the ray has ended.
    transmittance: f32,
    // What the Gaussians from here on are worth.
    rest: f32,
    // The worth of a weight without colour and depth of its own.
    base: f32,
    // dL/dcolour and dL/d(sum of depths).
    by: vec4<f32>,
}

var<private> pixels: array<Pixel, PIXELS_MAX>;

// Ends the ray of a pixel of `part`.
fn end_ray(q: u32, part: u32) {
    pixels[q].transmittance = 0.0;
    if atomicAdd(&ended[part], 1u) == PIXELS_MAX - 1u {
        atomicAnd(&open, ~(1u << part));
    }
}

// What pixel q of this invocation says.
fn seed(local: u32, q: u32, tile: vec2<u32>) {
    let place = place_of(local, q);
    let part = local * PIXELS / PIXELS_MAX;
    let x = tile.x * TILE_SIZE + place.x;
    let y = tile.y * TILE_SIZE + place.y;
    pixels[q] = Pixel(vec2<f32>(place) + 0.5, 1.0, 0.0, 0.0, vec4(0.0));
    if x >= views[which].width || y >= views[which].height {
        end_ray(q, part);
    } else {
        let at = y * views[which].width + x;
        let alpha = pictures[views[which].alpha_start + at];
        if BY_COLOR {
            let from_start = views[which].color_start + at * 3u;
            let by = vec3(
                by_pictures[from_start], by_pictures[from_start + 1u], by_pictures[from_start + 2u],
            );
            let shown = vec3(
                pictures[from_start], pictures[from_start + 1u], pictures[from_start + 2u],
            );
            var behind = views[which].background.xyz;
            if views[which].backdrop_start != NO_PICTURE {
                behind = backdrop_behind(vec2(f32(x), f32(y)));
            }
            pixels[q].rest = dot(by, shown - behind);
            pixels[q].base = -dot(by, behind);
            pixels[q].by = vec4(by, 0.0);
        }
        if BY_ALPHA {
            let by = by_pictures[views[which].alpha_start + at];
            pixels[q].rest += by * alpha;
            pixels[q].base += by;
        }
        if BY_DEPTH && alpha > 0.0 {
            let by = by_pictures[views[which].depth_start + at] / alpha;
            pixels[q].base -= by * pictures[views[which].depth_start + at];
            pixels[q].by.w = by;
        }
    }
    seeds[local * PIXELS + q] = pixels[q].by;
}

// A Gaussian on its way from the scene to the workgroup.
struct Staged {
    some: bool,
    footprint: Footprint,
    paint: vec4<f32>,
}

fn fetch(local: u32, at: u32, end: u32) -> Staged {
    var staged: Staged;
    if local >= BATCH || at >= end {
        return staged;
    }
    let id = pairs[at].y;
    staged.some = true;
    staged.footprint = footprint_of(footprints[which * views[which].gaussian_count + id]);
    staged.paint.w = abs(staged.footprint.depth);
    if BY_COLOR {
        staged.paint = vec4(color_of(id), staged.paint.w);
    }
    return staged;
}

// Takes pixel q past staged Gaussian k: dL/dpower and the weight.
fn pass_one(q: u32, k: u32, part: u32) -> vec2<f32> {
    let weight = weights[k];
    let at = along_axes(pixels[q].center, shapes[k], weight.x);
    let power = at.x * at.x + at.y * at.y;
    let full = weight.y * exp(-power);
    let alpha = min(ALPHA_MAX, full);
    let transmittance = pixels[q].transmittance;
    let hit = power <= weight.z && alpha >= ALPHA_MIN && transmittance > 0.0;
    if !hit {
        return vec2(0.0);
    }
    let passes = 1.0 - alpha;
    let left = transmittance * passes;
    if left <= TRANSMITTANCE_MIN {
        end_ray(q, part);
        return vec2(0.0);
    }
    let share = alpha * transmittance;
    let worth = pixels[q].base + dot(pixels[q].by, paints[k]);
    let rest = pixels[q].rest - share * worth;
    pixels[q].rest = rest;
    pixels[q].transmittance = left;
    let by_alpha = transmittance * worth - rest / passes;
    return vec2(select(0.0, -alpha * by_alpha, full < ALPHA_MAX), share);
}

// One past the last Gaussian from `first` on whose cells fit together. Those of one do.
fn end_of_range(first: u32) -> u32 {
    if firsts[BATCH] - firsts[first] <= CELLS {
        return BATCH;
    }
    var end = first + 1u;
    while firsts[end + 1u] - firsts[first] <= CELLS {
        end++;
    }
    return end;
}

@compute @workgroup_size(LANES)
fn main(
    @builtin(workgroup_id) tile: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    which = tile.z;
    let corner = vec2<f32>(tile.xy * TILE_SIZE);
    // Part of this invocation's pixels, and the Gaussian of a batch that it adds up for.
    let part = local * PIXELS / PIXELS_MAX;
    let mine = part;
    let list = lists[views[which].range_start + tile.y * views[which].tiles_x + tile.x];
    if local < PARTS {
        atomicStore(&ended[local], 0u);
    }
    if local == 0u {
        atomicStore(&open, 0xffffffffu);
    }
    workgroupBarrier();
    for (var q = 0u; q < PIXELS; q++) {
        seed(local, q, tile.xy);
    }
    workgroupBarrier();
    let batches = (list.y - list.x + BATCH - 1u) / BATCH;
    var staged = fetch(local, list.x + local, list.y);
    for (var batch = 0u; batch < batches; batch++) {
        let begin = list.x + batch * BATCH;
        if local < BATCH {
            var parts = 0u;
            if staged.some {
                let one = staged.footprint;
                let mean = one.mean - corner;
                parts = parts_of(one, mean) & atomicLoad(&open);
                shapes[local] = vec4(mean, one.conic_shear, one.conic_x);
                weights[local] = vec4(one.conic_y, one.opacity, one.power_max, 0.0);
                paints[local] = staged.paint;
            }
            met[local] = parts;
        }
        workgroupBarrier();
        // The next batch is on its way while this one is at work.
        staged = fetch(local, begin + BATCH + local, list.y);
        var word = 0u;
        var before = 0u;
        for (var k = 0u; k < BATCH; k++) {
            let one = met[k];
            word |= ((one >> part) & 1u) << k;
            before += select(0u, countOneBits(one), k <= local);
        }
        if local < BATCH {
            firsts[local + 1u] = before;
        }
        if local == 0u {
            firsts[0] = 0u;
        }
        workgroupBarrier();
        var powers = vec3(0.0);
        var squares = vec3(0.0);
        var shares = vec4(0.0);
        var first = 0u;
        while first < BATCH {
            if local == 0u {
                range_end = end_of_range(first);
            }
            let last = workgroupUniformLoad(&range_end);
            let first_cell = firsts[first];
            var bits = word & (0xffffffffu << first);
            if last < BATCH {
                bits &= (1u << last) - 1u;
            }
            while bits != 0u {
                let k = firstTrailingBit(bits);
                bits &= bits - 1u;
                let before_part = countOneBits(met[k] & ((1u << part) - 1u));
                let to = (firsts[k] - first_cell + before_part) * CELL_NUMBERS;
                for (var q = 0u; q < PIXELS; q++) {
                    let lane = (local * PIXELS + q) % PIXELS_MAX;
                    let said = pass_one(q, k, part);
                    numbers[to + lane] = said.x;
                    numbers[to + PIXELS_MAX + lane] = said.y;
                }
            }
            workgroupBarrier();
            if mine >= first && mine < last {
                let shape = shapes[mine];
                let conic_y = weights[mine].x;
                var parts = met[mine];
                var from_cell = (firsts[mine] - first_cell) * CELL_NUMBERS;
                while parts != 0u {
                    let met_part = firstTrailingBit(parts);
                    parts &= parts - 1u;
                    for (var q = 0u; q < PIXELS; q++) {
                        let lane = (local * PIXELS + q) % PIXELS_MAX;
                        let by_power = numbers[from_cell + lane];
                        let share = numbers[from_cell + PIXELS_MAX + lane];
                        let center = vec2<f32>(place_in_tile(met_part, lane)) + 0.5;
                        let at = along_axes(center, shape, conic_y);
                        let by_at = by_power * at;
                        powers += vec3(by_power, by_at);
                        squares += vec3(by_at.x * at, by_at.y * at.y);
                        shares += share * seeds[met_part * PIXELS_MAX + lane];
                    }
                    from_cell += CELL_NUMBERS;
                }
            }
            workgroupBarrier();
            first = last;
        }
        let to = local * PAIR_SUMS;
        numbers[to] = powers.x;
        numbers[to + 1u] = powers.y;
        numbers[to + 2u] = powers.z;
        numbers[to + 3u] = squares.x;
        numbers[to + 4u] = squares.y;
        numbers[to + 5u] = squares.z;
        numbers[to + 6u] = shares.x;
        numbers[to + 7u] = shares.y;
        numbers[to + 8u] = shares.z;
        numbers[to + 9u] = shares.w;
        if local == 0u {
            goes_on = atomicLoad(&open);
        }
        workgroupBarrier();
        let each = PIXELS_MAX / PIXELS;
        let count = min(list.y - begin, BATCH) * PAIR_SUMS;
        for (var i = local; i < count; i += LANES) {
            let lanes = i / PAIR_SUMS * each;
            var sum = 0.0;
            for (var lane = 0u; lane < each; lane++) {
                sum += numbers[(lanes + lane) * PAIR_SUMS + i % PAIR_SUMS];
            }
            // The two halves of `pairs` have the same places.
            sums[begin % views[which].isect_capacity * PAIR_SUMS + i] = sum;
        }
        if workgroupUniformLoad(&goes_on) == 0u {
            break;
        }
    }
}
