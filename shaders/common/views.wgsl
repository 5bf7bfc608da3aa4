// Cameras of the batch, and the view that this workgroup works for.

@group(0) @binding(0) var<uniform> views: array<View, VIEWS_MAX>;

var<private> which: u32;

// Adding stays at u32::MAX: that is associative, so the order does not matter.
fn add(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, a > 0xffffffffu - b);
}
