// The backdrop as a view sees it: from a pixel to a cell of the map.
// CPU: crates/render/src/cpu/sky.rs

// Maps of the batch: [BACKDROP_HEIGHT, BACKDROP_WIDTH] colours each, three bytes of a word.
@group(0) @binding(8) var<storage, read> backdrops: array<u32>;

const TAU: f32 = 6.2831853;
const PI: f32 = 3.1415927;
const HALF_PI: f32 = 1.5707964;

// The angle of (x, y) from the x axis, to 4e-7. The built-in one may be off by far more.
fn angle_of(y: f32, x: f32) -> f32 {
    let wide = abs(x);
    let tall = abs(y);
    let share = min(wide, tall) / max(max(wide, tall), 1.1754944e-38);
    let square = share * share;
    var angle = ATAN[6];
    angle = angle * square + ATAN[5];
    angle = angle * square + ATAN[4];
    angle = angle * square + ATAN[3];
    angle = angle * square + ATAN[2];
    angle = angle * square + ATAN[1];
    angle = angle * square + ATAN[0];
    angle *= share;
    angle = select(angle, HALF_PI - angle, tall > wide);
    angle = select(angle, PI - angle, x < 0.0);
    return select(angle, -angle, y < 0.0);
}

fn backdrop_cell(x: u32, y: u32) -> vec3<f32> {
    let cell = backdrops[views[which].backdrop_start + y * BACKDROP_WIDTH + x];
    return vec3(f32(cell & 0xffu), f32((cell >> 8u) & 0xffu), f32((cell >> 16u) & 0xffu));
}

// The colour behind the pixel in column at.x and row at.y of the part drawn.
fn backdrop_behind(at: vec2<f32>) -> vec3<f32> {
    let ray = views[which].ray_first.xyz + at.x * views[which].ray_across.xyz
        + at.y * views[which].ray_down.xyz;
    let columns = f32(BACKDROP_WIDTH);
    let rows = f32(BACKDROP_HEIGHT);
    let longitude = angle_of(ray.x, ray.z);
    let latitude = angle_of(ray.y, sqrt(ray.x * ray.x + ray.z * ray.z));
    let u = clamp(longitude * (columns / TAU) + (0.5 * columns - 0.5), -1.0, columns - 1.0);
    let v = clamp(latitude * (rows / PI) + (0.5 * rows - 0.5), 0.0, rows - 1.0);
    let left = floor(u);
    let top = floor(v);
    let x0 = u32(i32(left) + i32(BACKDROP_WIDTH)) % BACKDROP_WIDTH;
    let x1 = (x0 + 1u) % BACKDROP_WIDTH;
    let y0 = u32(top);
    let y1 = min(y0 + 1u, BACKDROP_HEIGHT - 1u);
    let a = backdrop_cell(x0, y0);
    let c = backdrop_cell(x0, y1);
    let upper = a + (u - left) * (backdrop_cell(x1, y0) - a);
    let lower = c + (u - left) * (backdrop_cell(x1, y1) - c);
    return (upper + (v - top) * (lower - upper)) * (1.0 / 255.0);
}
