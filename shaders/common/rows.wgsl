// The Gaussians of a view: all, or those that cull has left.

// Gaussian of this invocation; `gaussian_count` or more for none.
fn enter_gaussian(group: vec3<u32>, groups: vec3<u32>, local: u32) -> u32 {
    let at = enter_row(group, groups, local);
    let blocks = views[which].block_count;
    if blocks == 0u {
        return at;
    }
    if at >= atomicLoad(&plans[which].rows) {
        return views[which].gaussian_count;
    }
    return rows[which * blocks * BLOCK + at];
}
