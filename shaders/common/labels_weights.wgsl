// Labels::Weights: each pixel has `weight_slots` slots of (entry, weight), filled as entries occur.
// An entry without a slot is counted too: the host sees the count, makes room and draws again.

// [pixels] counts, then for each slot [pixels] entries and [pixels] weights as bits.
@group(0) @binding(7) var<storage, read_write> slots: array<u32>;

// The entry of the last contributions and their sum: neighbours in depth are mostly of one thing.
// Of each pixel of the invocation.
var<private> run_entry: array<u32, PIXELS_MAX>;
var<private> run_weight: array<f32, PIXELS_MAX>;
var<private> used: array<u32, PIXELS_MAX>;

fn label_of(id: u32) -> u32 {
    return entry_of(id);
}

fn end_run(q: u32, pixel: u32) {
    if run_entry[q] == 0u {
        return;
    }
    let bottom = min(views[which].row_end * TILE_SIZE, views[which].height);
    let rows = bottom - views[which].row_start * TILE_SIZE;
    let pixels = rows * views[which].width;
    let held = min(used[q], views[which].weight_slots);
    for (var slot = 0u; slot < held; slot++) {
        let at = views[which].slot_start + pixels * (1u + 2u * slot) + pixel;
        if slots[at] == run_entry[q] {
            let sum = bitcast<f32>(slots[at + pixels]) + run_weight[q];
            slots[at + pixels] = bitcast<u32>(sum);
            return;
        }
    }
    if used[q] < views[which].weight_slots {
        let at = views[which].slot_start + pixels * (1u + 2u * used[q]) + pixel;
        slots[at] = run_entry[q];
        slots[at + pixels] = bitcast<u32>(run_weight[q]);
    }
    used[q]++;
}

fn label_row(label: u32) -> vec4<f32> {
    return vec4(0.0);
}

fn add_label(label: u32, row: vec4<f32>, share: f32, q: u32, pixel: u32) {
    if label == 0u {
        return;
    }
    if label != run_entry[q] {
        end_run(q, pixel);
        run_entry[q] = label;
        run_weight[q] = 0.0;
    }
    run_weight[q] += share;
}

fn store_labels(q: u32, pixel: u32) {
    end_run(q, pixel);
    slots[views[which].slot_start + pixel] = used[q];
}

fn mask_byte(q: u32) -> u32 {
    return 0u;
}
