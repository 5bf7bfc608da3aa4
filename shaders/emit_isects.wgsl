// Stage 4: each Gaussian into the list of each tile that it touches, in no order.
// CPU: crates/render/src/cpu/bin.rs (in the order of the scene)

@group(0) @binding(1) var<storage, read_write> plans: array<Plan>;
@group(0) @binding(2) var<storage, read> footprints: array<FootprintRows>;
@group(0) @binding(3) var<storage, read> tiles: array<u32>;
// Where the list of each tile starts; one more number ends the last one.
@group(0) @binding(4) var<storage, read> starts: array<u32>;
// Where the list of each tile ends so far.
@group(0) @binding(5) var<storage, read_write> ends: array<atomic<u32>>;
// [2][views][capacity] of (depth key, Gaussian).
@group(0) @binding(6) var<storage, read_write> pairs: array<vec2<u32>>;
@group(0) @binding(7) var<storage, read> rows: array<u32>;

// Whether pairs get their places, or are counted in bins for that.
var<private> placing: bool;

fn visit(tile: vec2<u32>, footprint: Footprint, id: u32) {
    let bin = bin_of(tile);
    var place = 0u;
    if bin < BINS {
        place = atomicAdd(&bins[bin], 1u);
    } else if placing {
        place = atomicAdd(&ends[number_of(tile)], 1u);
    }
    // Two compilations of one function may round differently: what was not counted has no room.
    if placing && place < starts[number_of(tile) + 1u] {
        pairs[views[which].pair_start + place] = vec2(bitcast<u32>(footprint.depth), id);
    }
}

@compute @workgroup_size(256)
fn main(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let i = enter_gaussian(group, groups, local);
    let total = views[which].gaussian_count;
    let first = which * total;
    begin_visits(local);
    var footprint: Footprint;
    var touched = 0u;
    var visits = false;
    // No pairs where there is no room for them.
    if i < total && plans[which].isects > 0u {
        touched = tiles[first + i];
        if touched >= SQUARE {
            footprint.depth = footprints[first + i][1].w;
        } else if touched > 0u {
            footprint = footprint_of(footprints[first + i]);
        }
        visits = touched > 0u && see(footprint, i, touched, local);
    }
    open_bins(local);
    // First all count, then all place: one body, so that it finds the same tiles both times.
    for (var turn = 0u; turn < 2u; turn++) {
        placing = turn == 1u;
        if visits && (placing || bin_sides.x > 0u) {
            visit_touched(touched, footprint, i);
        }
        workgroupBarrier();
        if !placing {
            for (var at = local; at < bin_sides.x * bin_sides.y; at += WORKGROUP_SIZE) {
                var sum = 0u;
                for (var k = 0u; k < bin_spread; k++) {
                    sum += atomicLoad(&bins[at * bin_spread + k]);
                }
                if sum > 0u {
                    var place = atomicAdd(&ends[number_of(tile_of(at))], sum);
                    for (var k = 0u; k < bin_spread; k++) {
                        let next = place + atomicLoad(&bins[at * bin_spread + k]);
                        atomicStore(&bins[at * bin_spread + k], place);
                        place = next;
                    }
                }
            }
        }
        workgroupBarrier();
    }
    if local == 0u {
        larges = atomicLoad(&large_count);
    }
    let count = workgroupUniformLoad(&larges);
    bin_sides = vec2(0u);
    for (var k = 0u; k < count; k++) {
        let id = large[k];
        visit_tiles(footprint_of(footprints[first + id]), id, local / 8u, 32u, local % 8u, 8u);
    }
}
