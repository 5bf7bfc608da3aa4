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

// A device reads and writes rows of four numbers faster than the fields of a struct.
alias FootprintRows = array<vec4<f32>, 2>;

fn footprint_of(rows: FootprintRows) -> Footprint {
    let first = rows[0];
    let last = rows[1];
    return Footprint(first.xy, first.z, first.w, last.x, last.y, last.z, last.w);
}

fn rows_of(one: Footprint) -> FootprintRows {
    return FootprintRows(
        vec4(one.mean, one.conic_shear, one.conic_x),
        vec4(one.conic_y, one.power_max, one.opacity, one.depth),
    );
}
