// Gaussians that a view leaves out by chance.
// CPU: crates/render/src/dropout.rs

// lowbias32 of Wellons' hash prospector.
fn mixed(from_x: u32) -> u32 {
    var x = from_x ^ (from_x >> 16u);
    x *= 0x7feb352du;
    x ^= x >> 15u;
    x *= 0x846ca68bu;
    return x ^ (x >> 16u);
}

fn leaves_out(i: u32) -> bool {
    let dropout = views[which].dropout;
    return dropout != 0u && (mixed(i ^ mixed(dropout)) >> 24u) < (dropout >> 24u);
}
