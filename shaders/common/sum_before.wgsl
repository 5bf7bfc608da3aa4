// Sums over the invocations of a workgroup of 256.

var<workgroup> sums: array<u32, 256>;
var<workgroup> sums_of_16: array<u32, 16>;

// Sum of `value` over the invocations before this one. To be called by all of them together.
fn sum_before(local: u32, value: u32) -> u32 {
    sums[local] = value;
    workgroupBarrier();
    if local < 16u {
        var sum = 0u;
        for (var k = 0u; k < 16u; k++) {
            sum = add(sum, sums[local * 16u + k]);
        }
        sums_of_16[local] = sum;
    }
    workgroupBarrier();
    var before = 0u;
    for (var k = 0u; k < local / 16u; k++) {
        before = add(before, sums_of_16[k]);
    }
    for (var k = local & 0xf0u; k < local; k++) {
        before = add(before, sums[k]);
    }
    return before;
}
