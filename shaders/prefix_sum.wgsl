// Stage 3, and inside the sorts: exclusive prefix sum, in place, that stays at u32::MAX instead of
// wrapping. Twin: src/render/cpu/prefix_sum.rs (there in 64 bits)
//
// scan_blocks sums each block and leaves its total in block_sums; the host scans those in turn;
// add_blocks adds them back. Adding that saturates is associative, so the order does not matter.

@group(0) @binding(0) var<uniform> params: ScanParams;
@group(0) @binding(1) var<storage, read> plan: PlanRead;
@group(0) @binding(2) var<storage, read_write> numbers: array<u32>;
@group(0) @binding(3) var<storage, read_write> block_sums: array<u32>;

const NUMBERS_EACH: u32 = 8u;

var<workgroup> sums: array<u32, 256>;

fn add(a: u32, b: u32) -> u32 {
    return select(a + b, 0xffffffffu, a > 0xffffffffu - b);
}

fn number_count() -> u32 {
    let digits = ((plan.isects + SORT_BLOCK - 1u) / SORT_BLOCK) * WORKGROUP_SIZE;
    return select(params.count, digits, params.count == COUNT_FROM_PLAN);
}

@compute @workgroup_size(256)
fn scan_blocks(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let count = number_count();
    let block = group.y * groups.x + group.x;
    let first = block * SCAN_BLOCK + local * NUMBERS_EACH;
    var mine: array<u32, NUMBERS_EACH>;
    var sum = 0u;
    for (var k = 0u; k < NUMBERS_EACH; k++) {
        mine[k] = sum;
        if first + k < count {
            sum = add(sum, numbers[first + k]);
        }
    }
    sums[local] = sum;
    workgroupBarrier();
    for (var step = 1u; step < WORKGROUP_SIZE; step *= 2u) {
        var before = 0u;
        if local >= step {
            before = sums[local - step];
        }
        workgroupBarrier();
        sums[local] = add(sums[local], before);
        workgroupBarrier();
    }
    var before = 0u;
    if local > 0u {
        before = sums[local - 1u];
    }
    for (var k = 0u; k < NUMBERS_EACH; k++) {
        if first + k < count {
            numbers[first + k] = add(before, mine[k]);
        }
    }
    if local == WORKGROUP_SIZE - 1u && block < arrayLength(&block_sums) {
        block_sums[block] = sums[local];
    }
}

@compute @workgroup_size(256)
fn add_blocks(
    @builtin(workgroup_id) group: vec3<u32>,
    @builtin(num_workgroups) groups: vec3<u32>,
    @builtin(local_invocation_index) local: u32,
) {
    let count = number_count();
    let block = group.y * groups.x + group.x;
    let first = block * SCAN_BLOCK;
    for (var i = first + local; i < min(count, first + SCAN_BLOCK); i += WORKGROUP_SIZE) {
        numbers[i] = add(numbers[i], block_sums[block]);
    }
}
