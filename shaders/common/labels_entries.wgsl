// Labels::Entries: each pixel has `entry_slots` slots of (index, weight), filled as indices come
// up. One that finds no room is counted all the same: the host sees the count, makes room and draws
// again.

// [pixels] counts, then for each slot [pixels] indices and [pixels] weights as bits.
@group(0) @binding(7) var<storage, read_write> slots: array<u32>;

// The index of the last contributions and their sum: neighbours in depth are mostly of one thing.
var<private> run_index: u32;
var<private> run_weight: f32;
var<private> used: u32;

fn label_of(id: u32) -> u32 {
    return index_of(id);
}

fn end_run(pixel: u32) {
    if run_index == 0u {
        return;
    }
    let bottom = min(views[which].row_end * TILE_SIZE, views[which].height);
    let rows = bottom - views[which].row_start * TILE_SIZE;
    let pixels = rows * views[which].width;
    let held = min(used, views[which].entry_slots);
    for (var slot = 0u; slot < held; slot++) {
        let at = views[which].slot_start + pixels * (1u + 2u * slot) + pixel;
        if slots[at] == run_index {
            let sum = bitcast<f32>(slots[at + pixels]) + run_weight;
            slots[at + pixels] = bitcast<u32>(sum);
            return;
        }
    }
    if used < views[which].entry_slots {
        let at = views[which].slot_start + pixels * (1u + 2u * used) + pixel;
        slots[at] = run_index;
        slots[at + pixels] = bitcast<u32>(run_weight);
    }
    used++;
}

fn label_row(label: u32) -> vec4<f32> {
    return vec4(0.0);
}

fn add_label(label: u32, paint: vec4<f32>, painted: bool, share: f32, pixel: u32) {
    if label == 0u {
        return;
    }
    if label != run_index {
        end_run(pixel);
        run_index = label;
        run_weight = 0.0;
    }
    run_weight += share;
}

fn store_labels(pixel: u32) {
    end_run(pixel);
    slots[views[which].slot_start + pixel] = used;
}
