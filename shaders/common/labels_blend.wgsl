// Labels::Blend: each contribution adds its share of one row of a table.

@group(0) @binding(7) var<storage, read> table: array<vec4<f32>>;

var<private> blended: vec4<f32>;

// An index beyond the table counts as 0.
fn label_of(id: u32) -> u32 {
    let index = index_of(id);
    return select(0u, index, index < view.label_rows);
}

fn add_label(label: u32, share: f32, pixel: u32) {
    blended += share * table[label];
}

fn store_labels(pixel: u32) {
    let first = view.blend_start + pixel * 4u;
    pictures[first] = blended.x;
    pictures[first + 1u] = blended.y;
    pictures[first + 2u] = blended.z;
    pictures[first + 3u] = blended.w;
}

