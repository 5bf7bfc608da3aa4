// Moves a photo's exposure by what the loss says of it, and keeps the loss.
// CPU: crates/render/src/train/exposure.rs

@group(0) @binding(1) var<uniform> training: Training;
@group(0) @binding(2) var<storage, read_write> plans: array<Plan>;
// As photo_loss leaves them: [rows of tiles, columns of tiles, channels].
@group(0) @binding(3) var<storage, read> partials: array<vec4<f32>>;
// [photos, EXPOSURE_WORDS]: gain and bias of each channel, two moments of each gain and of each
// bias, steps taken, and the loss.
@group(0) @binding(4) var<storage, read_write> exposures: array<f32>;

const EXPOSURE_COST: f32 = 1.0;
const EXPOSURE_MAX: f32 = 0.5;
const WINDOW: u32 = 11u;
// Invocations at work: each has partial sums of one channel.
const WORKERS: u32 = 255u;

var<workgroup> shares: array<vec4<f32>, WORKERS>;
var<workgroup> channels: array<vec4<f32>, 3>;

// Moves number `at` of the exposure, whose moments are at `moments`, by `gradient`.
fn move_one(at: u32, moments: u32, gradient: f32, corrected: vec2<f32>, middle: f32) {
    let after = moments_after(vec2(exposures[moments], exposures[moments + 1u]), gradient);
    exposures[moments] = after.x;
    exposures[moments + 1u] = after.y;
    let moved = exposures[at] - training.exposure * step_by(after, corrected);
    exposures[at] = clamp(moved, middle - EXPOSURE_MAX, middle + EXPOSURE_MAX);
}

@compute @workgroup_size(256)
fn main(@builtin(local_invocation_index) local: u32) {
    let count = views[which].tiles_x * views[which].tiles_y * 3u;
    if local < WORKERS {
        var sum = vec4(0.0);
        for (var k = local; k < count; k += WORKERS) {
            sum += partials[k];
        }
        shares[local] = sum;
    }
    workgroupBarrier();
    if local < 3u {
        var sum = vec4(0.0);
        for (var k = local; k < WORKERS; k += 3u) {
            sum += shares[k];
        }
        channels[local] = sum;
    }
    workgroupBarrier();
    // A frame that lacked room drew nothing.
    if local > 0u || plans[0].needed > views[which].isect_capacity {
        return;
    }
    let row = training.photo * EXPOSURE_WORDS;
    let steps = min(exposures[row + 18u] + 1.0, COUNT_MAX);
    exposures[row + 18u] = steps;
    let corrected = corrections(steps);
    var sums = vec4(0.0);
    for (var c = 0u; c < 3u; c++) {
        let by_gain = channels[c].x + 2.0 * EXPOSURE_COST * (exposures[row + c] - 1.0);
        let by_bias = channels[c].y + 2.0 * EXPOSURE_COST * exposures[row + 3u + c];
        move_one(row + c, row + 6u + 2u * c, by_gain, corrected, 1.0);
        move_one(row + 3u + c, row + 12u + 2u * c, by_bias, corrected, 0.0);
        sums += channels[c];
    }
    let fits = views[which].width >= WINDOW && views[which].height >= WINDOW;
    let share = select(0.0, training.ssim_share, fits);
    let numbers = f32(views[which].width * views[which].height * 3u);
    exposures[row + 19u] = (1.0 - share) * sums.z / numbers + share * (1.0 - sums.w);
}
