// How far a picture is from its photo, and what that says of each pixel: L1 and SSIM.
// CPU: crates/render/src/train/photo_loss.rs
//
// A workgroup has a channel of a tile. `windows` takes SSIM in the windows whose first pixel is in
// the tile, `main` goes back to the pixels of the tile. Windows are separable: rows first.

@group(0) @binding(1) var<uniform> training: Training;
@group(0) @binding(2) var<storage, read> pictures: array<f32>;
// RGBA, 8 bits each, A = 0: the pixel does not count.
@group(0) @binding(3) var<storage, read> photos: array<u32>;
// [photos, EXPOSURE_WORDS]
@group(0) @binding(4) var<storage, read> exposures: array<f32>;
// [3, 3, rows, columns]: derivatives of SSIM by the means of x, x² and x y of the windows of each
// channel.
@group(0) @binding(5) var<storage, read_write> by_windows: array<f32>;
// [workgroups]: the sums of a workgroup by gain, by bias, of |x - y|, and of SSIM.
@group(0) @binding(6) var<storage, read_write> partials: array<vec4<f32>>;
// In the places of `pictures`.
@group(0) @binding(7) var<storage, read_write> by_pictures: array<f32>;

const WINDOW: u32 = 11u;
// Pixels that a tile's windows reach beyond it, and side of all of them.
const REACH: u32 = 10u;
const SIDE: u32 = 26u;
const C1: f32 = 0.0001;
const C2: f32 = 0.0009;

// Weights of a row of the window, sigma 1.5.
var<private> weights: array<f32, WINDOW> = array<f32, WINDOW>(
    0.00102838012, 0.00759875831, 0.0360007733, 0.109360687, 0.213005543, 0.266011715,
    0.213005543, 0.109360687, 0.0360007733, 0.00759875831, 0.00102838012,
);

// [SIDE, SIDE] numbers of the tile and what is beside it.
var<workgroup> first: array<f32, 676>;
var<workgroup> second: array<f32, 676>;
var<workgroup> third: array<f32, 676>;
// [maps, SIDE, TILE_SIZE] weighted sums of rows.
var<workgroup> across: array<f32, 2080>;
var<workgroup> spread: array<f32, 1248>;

fn size() -> vec2<u32> {
    return vec2(views[which].width, views[which].height);
}

// Columns and rows of windows.
fn window_grid() -> vec2<u32> {
    let fits = all(size() >= vec2(WINDOW)) && training.ssim_share > 0.0;
    return select(vec2(0u), size() - REACH, fits);
}

fn photo_of(at: vec2<u32>) -> vec4<f32> {
    return unpack4x8unorm(photos[training.photo_start + at.y * views[which].width + at.x]);
}

fn place_of(at: vec2<u32>, channel: u32) -> u32 {
    return views[which].color_start + (at.y * views[which].width + at.x) * 3u + channel;
}

fn window_place(map: u32, channel: u32, at: vec2<u32>) -> u32 {
    let grid = window_grid();
    return ((map * 3u + channel) * grid.y + at.y) * grid.x + at.x;
}

// The picture as its photo was exposed; a pixel that does not count is that of the photo.
fn exposed(at: vec2<u32>, channel: u32, photo: vec4<f32>) -> f32 {
    let row = training.photo * EXPOSURE_WORDS + channel;
    let shown = exposures[row] * pictures[place_of(at, channel)] + exposures[row + 3u];
    return select(photo[channel], shown, photo.w > 0.0);
}

// Sum of a number of each invocation, for all of them.
fn sum_of(local: u32, number: f32) -> f32 {
    workgroupBarrier();
    first[local] = number;
    workgroupBarrier();
    for (var half = WORKGROUP_SIZE / 2u; half > 0u; half /= 2u) {
        if local < half {
            first[local] += first[local + half];
        }
        workgroupBarrier();
    }
    return first[0];
}

@compute @workgroup_size(256)
fn windows(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let channel = group.x % 3u;
    let corner = vec2(group.x / 3u, group.y) * TILE_SIZE;
    for (var k = local; k < SIDE * SIDE; k += WORKGROUP_SIZE) {
        let at = corner + vec2(k % SIDE, k / SIDE);
        var numbers = vec2(0.0);
        if all(at < size()) {
            let photo = photo_of(at);
            numbers = vec2(exposed(at, channel, photo), photo[channel]);
        }
        first[k] = numbers.x;
        second[k] = numbers.y;
    }
    workgroupBarrier();
    for (var k = local; k < SIDE * TILE_SIZE; k += WORKGROUP_SIZE) {
        let row = k / TILE_SIZE * SIDE + k % TILE_SIZE;
        var sums = array<f32, 5>();
        for (var j = 0u; j < WINDOW; j++) {
            let x = first[row + j];
            let y = second[row + j];
            sums[0] += weights[j] * x;
            sums[1] += weights[j] * y;
            sums[2] += weights[j] * (x * x);
            sums[3] += weights[j] * (y * y);
            sums[4] += weights[j] * (x * y);
        }
        for (var map = 0u; map < 5u; map++) {
            across[map * SIDE * TILE_SIZE + k] = sums[map];
        }
    }
    workgroupBarrier();
    let at = corner + vec2(local % TILE_SIZE, local / TILE_SIZE);
    let grid = window_grid();
    var ssim = 0.0;
    if all(at < grid) {
        var means = array<f32, 5>();
        for (var map = 0u; map < 5u; map++) {
            for (var j = 0u; j < WINDOW; j++) {
                means[map] += weights[j] * across[map * SIDE * TILE_SIZE + local + j * TILE_SIZE];
            }
        }
        let mx = means[0];
        let my = means[1];
        let per = 1.0 / f32(grid.x * grid.y * 3u);
        let a1 = 2.0 * mx * my + C1;
        let b1 = mx * mx + my * my + C1;
        let a2 = 2.0 * (means[4] - mx * my) + C2;
        let b2 = (means[2] - mx * mx) + (means[3] - my * my) + C2;
        let per_b = per / (b1 * b2);
        let value = a1 * a2 * per_b;
        let by_square = -value / b2;
        let by_product = 2.0 * a1 * per_b;
        by_windows[window_place(0u, channel, at)] = 2.0 * my * a2 * per_b
            - value * 2.0 * mx / b1 - 2.0 * mx * by_square - my * by_product;
        by_windows[window_place(1u, channel, at)] = by_square;
        by_windows[window_place(2u, channel, at)] = by_product;
        ssim = value;
    }
    let sum = sum_of(local, ssim);
    if local == 0u {
        partials[group.y * groups.x + group.x].w = sum;
    }
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let channel = group.x % 3u;
    let corner = vec2(group.x / 3u, group.y) * TILE_SIZE;
    let grid = window_grid();
    // Windows that hold pixels of the tile.
    for (var k = local; k < SIDE * SIDE; k += WORKGROUP_SIZE) {
        let beyond = corner + vec2(k % SIDE, k / SIDE);
        let at = beyond - REACH;
        var numbers = vec3(0.0);
        if all(beyond >= vec2(REACH)) && all(at < grid) {
            numbers.x = by_windows[window_place(0u, channel, at)];
            numbers.y = by_windows[window_place(1u, channel, at)];
            numbers.z = by_windows[window_place(2u, channel, at)];
        }
        first[k] = numbers.x;
        second[k] = numbers.y;
        third[k] = numbers.z;
    }
    workgroupBarrier();
    for (var k = local; k < SIDE * TILE_SIZE; k += WORKGROUP_SIZE) {
        let row = k / TILE_SIZE * SIDE + k % TILE_SIZE;
        var sums = vec3(0.0);
        for (var j = 0u; j < WINDOW; j++) {
            sums += weights[j] * vec3(first[row + j], second[row + j], third[row + j]);
        }
        for (var map = 0u; map < 3u; map++) {
            spread[map * SIDE * TILE_SIZE + k] = sums[map];
        }
    }
    workgroupBarrier();
    let at = corner + vec2(local % TILE_SIZE, local / TILE_SIZE);
    var numbers = vec3(0.0);
    if all(at < size()) {
        var by = vec3(0.0);
        for (var map = 0u; map < 3u; map++) {
            for (var j = 0u; j < WINDOW; j++) {
                by[map] += weights[j] * spread[map * SIDE * TILE_SIZE + local + j * TILE_SIZE];
            }
        }
        let photo = photo_of(at);
        let x = exposed(at, channel, photo);
        let y = photo[channel];
        let share = select(0.0, training.ssim_share, grid.x > 0u);
        let each = (1.0 - share) / f32(size().x * size().y * 3u);
        var by_x = -share * (by.x + 2.0 * x * by.y + y * by.z) + each * sign(x - y);
        by_x = select(0.0, by_x, photo.w > 0.0);
        let place = place_of(at, channel);
        let by_shown = by_x * exposures[training.photo * EXPOSURE_WORDS + channel];
        by_pictures[place] = select(by_shown, abs(x - y), training.blames != 0u);
        numbers = vec3(pictures[place] * by_x, by_x, abs(x - y));
    }
    let by_gain = sum_of(local, numbers.x);
    let by_bias = sum_of(local, numbers.y);
    let away = sum_of(local, numbers.z);
    if local == 0u {
        let place = group.y * groups.x + group.x;
        partials[place] = vec4(by_gain, by_bias, away, partials[place].w);
    }
}
