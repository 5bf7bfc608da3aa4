// Camera space. Depth is the sort key, so it is computed in pairs of floats (value and rounding
// error): the key is the f32 nearest to the true depth, as on the CPU.

// x, in a form that no compiler can fuse or reorder with its neighbours.
fn opaque(x: f32) -> f32 {
    return bitcast<f32>(bitcast<u32>(x) ^ views[which].zero);
}

// a + b and its rounding error (Knuth).
fn two_sum(a: f32, b: f32) -> vec2<f32> {
    let sum = opaque(a + b);
    let b_part = opaque(sum - a);
    let a_part = opaque(sum - b_part);
    return vec2(sum, opaque(a - a_part) + opaque(b - b_part));
}

// a * b and its rounding error (Dekker; the halves have 12 bits, so their products are exact).
fn two_product(a: f32, b: f32) -> vec2<f32> {
    let product = opaque(a * b);
    let a_high = bitcast<f32>(bitcast<u32>(a) & 0xfffff000u);
    let b_high = bitcast<f32>(bitcast<u32>(b) & 0xfffff000u);
    let a_low = opaque(a - a_high);
    let b_low = opaque(b - b_high);
    let cross = opaque(opaque(a_high * b_high) - product) + opaque(a_high * b_low);
    return vec2(product, opaque(cross + opaque(a_low * b_high)) + a_low * b_low);
}

// A point in camera space; z is exact to the last bit of f32 but for double rounding.
fn camera_point(mean: vec3<f32>) -> vec3<f32> {
    let dx = two_sum(mean.x, -views[which].center.x);
    let dy = two_sum(mean.y, -views[which].center.y);
    let dz = two_sum(mean.z, -views[which].center.z);
    let d = vec3(dx.x, dy.x, dz.x);
    let d_low = vec3(dx.y, dy.y, dz.y) - views[which].center_low.xyz;
    let rz = views[which].rotation_z;
    let px = two_product(rz.x, d.x);
    let py = two_product(rz.y, d.y);
    let pz = two_product(rz.z, d.z);
    let xy = two_sum(px.x, py.x);
    let xyz = two_sum(xy.x, pz.x);
    let low = px.y + py.y + pz.y + xy.y + xyz.y
        + dot(rz.xyz, d_low) + dot(views[which].rotation_z_low.xyz, d);
    return vec3(
        dot(views[which].rotation_x.xyz, d) + dot(views[which].rotation_x.xyz, d_low),
        dot(views[which].rotation_y.xyz, d) + dot(views[which].rotation_y.xyz, d_low),
        opaque(xyz.x + low),
    );
}

// Rotation of a unit quaternion, wxyz.
fn rotation_of(q: vec4<f32>) -> mat3x3<f32> {
    let w = q.x;
    let x = q.y;
    let y = q.z;
    let z = q.w;
    return mat3x3(
        vec3(1.0 - 2.0 * (y * y + z * z), 2.0 * (x * y + w * z), 2.0 * (x * z - w * y)),
        vec3(2.0 * (x * y - w * z), 1.0 - 2.0 * (x * x + z * z), 2.0 * (y * z + w * x)),
        vec3(2.0 * (x * z + w * y), 2.0 * (y * z - w * x), 1.0 - 2.0 * (x * x + y * y)),
    );
}

fn is_finite(x: f32) -> bool {
    return (bitcast<u32>(x) & 0x7f800000u) != 0x7f800000u;
}
