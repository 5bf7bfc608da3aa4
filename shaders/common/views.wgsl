// Cameras of the batch, and the view that this workgroup works for.

@group(0) @binding(0) var<uniform> views: array<View, VIEWS_MAX>;

var<private> which: u32;

// Number of this invocation in its view, of workgroups in a row that the host has folded.
fn enter_row(group: vec3<u32>, groups: vec3<u32>, local: u32) -> u32 {
    which = group.z;
    return (group.y * groups.x + group.x) * WORKGROUP_SIZE + local;
}

// Adding stays at u32::MAX: that is associative, so the order does not matter.
fn add(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, a > 0xffffffffu - b);
}
