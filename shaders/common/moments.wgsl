// Adam (Kingma and Ba 2015) for one number. CPU: crates/render/src/train/adam.rs

// Decay of the first and the second moment, and its logarithms.
const DECAY: vec2<f32> = vec2(0.9, 0.999);
const DECAY_LOG: vec2<f32> = vec2(-0.10536054, -0.0010004874);
const ADAM_EPSILON: f32 = 1e-15;
// Most steps that are counted.
const COUNT_MAX: f32 = 65535.0;

// 1 - exp(x) of x under 0, to the last bits also where x is small.
fn one_less_exp(x: f32) -> f32 {
    let series = -x * (1.0 + x * (0.5 + x * (0.16666667 + x * 0.041666668)));
    return select(1.0 - exp(x), series, x > -0.05);
}

// What the moments have not seen yet after `count` gradients.
fn corrections(count: f32) -> vec2<f32> {
    return vec2(one_less_exp(count * DECAY_LOG.x), one_less_exp(count * DECAY_LOG.y));
}

fn moments_after(moments: vec2<f32>, gradient: f32) -> vec2<f32> {
    return DECAY * moments + (1.0 - DECAY) * vec2(gradient, gradient * gradient);
}

// The step, in units of the rate.
fn step_by(moments: vec2<f32>, corrections: vec2<f32>) -> f32 {
    let corrected = moments / corrections;
    let moved = corrected.x / (sqrt(corrected.y) + ADAM_EPSILON);
    return select(0.0, moved, is_finite(moved));
}
