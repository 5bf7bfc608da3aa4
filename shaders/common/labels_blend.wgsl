// Labels::Blend and Labels::Mask: each Gaussian adds its weight times one row of a table.

@group(0) @binding(7) var<storage, read> table: array<vec4<f32>>;

// Of each pixel of the invocation.
var<private> blended: array<vec4<f32>, PIXELS_MAX>;

// An entry beyond the table counts as entry 0.
fn label_of(id: u32) -> u32 {
    let entry = entry_of(id);
    return select(0u, entry, entry < views[which].label_rows);
}

fn label_row(label: u32) -> vec4<f32> {
    return table[views[which].table_start + label];
}

fn add_label(label: u32, row: vec4<f32>, share: f32, q: u32, pixel: u32) {
    blended[q] += share * row;
}

fn store_labels(q: u32, pixel: u32) {
    if views[which].blend_start == NO_PICTURE {
        return;
    }
    let first = views[which].blend_start + pixel * 4u;
    let bits = bitcast<vec4<u32>>(blended[q]);
    pictures[first] = bits.x;
    pictures[first + 1u] = bits.y;
    pictures[first + 2u] = bits.z;
    pictures[first + 3u] = bits.w;
}

// CPU: selected in crates/render/src/labels.rs
fn mask_byte(q: u32) -> u32 {
    let row = blended[q];
    let all = min(row.y, min(row.z, row.w)) >= 0.0;
    let some = max(row.y, max(row.z, row.w)) > 0.0;
    return select(0u, 255u, row.x >= views[which].coverage_floor && all && some);
}
