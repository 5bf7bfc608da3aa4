// The list of a tile, and the parts of it that a Gaussian meets: what the blend and its backward
// pass share.
//
// A tile is 32 parts of 4 x 2 pixels. A Gaussian meets those that the box around its footprint
// touches. The box is never too small, so no pixel changes.
//
// An invocation works for PIXELS pixels of a part: one on a GPU, all eight on a software adapter,
// where reading a staged Gaussian costs more than blending it.

@group(0) @binding(1) var<storage, read> footprints: array<FootprintRows>;
// (depth key, Gaussian)
@group(0) @binding(2) var<storage, read> pairs: array<vec2<u32>>;
// First pair of each tile, sorted, and one past its last.
@group(0) @binding(3) var<storage, read> lists: array<vec2<u32>>;
// [views][N, 3] as shade gives them; of a scene of degree 0 its harmonics, [N, 3].
@group(0) @binding(5) var<storage, read> colors: array<f32>;

const PARTS: u32 = 32u;
// Pixels of a part.
const PIXELS_MAX: u32 = 8u;

override PIXELS: u32 = 1u;
override LANES: u32 = WORKGROUP_SIZE / PIXELS;
// Work that is left out because no pixel changes (crates/render/src/switches.rs).
override SKIP_ELLIPSE_PARTS: bool = true;
override SKIP_FLAT_COLOR: bool = true;

// Place of pixel `lane` of a part in the tile.
fn place_in_tile(part: u32, lane: u32) -> vec2<u32> {
    return vec2((part & 3u) * 4u + (lane & 3u), (part >> 2u) * 2u + (lane >> 2u));
}

// Place of pixel q of this invocation in the tile.
fn place_of(local: u32, q: u32) -> vec2<u32> {
    return place_in_tile(local * PIXELS / 8u, local * PIXELS % 8u + q);
}

// A pixel along the axes of a Gaussian, of which `shape` is mean, conic_shear and conic_x: the sum
// of both squares is half the squared distance.
fn along_axes(center: vec2<f32>, shape: vec4<f32>, conic_y: f32) -> vec2<f32> {
    let d = center - shape.xy;
    return vec2(shape.w * (d.x - shape.z * d.y), conic_y * d.y);
}

// Bits of the parts that meet the box around a footprint, whose mean is relative to the tile.
fn parts_of(footprint: Footprint, mean: vec2<f32>) -> u32 {
    if !SKIP_ELLIPSE_PARTS {
        return 0xffffffffu;
    }
    let root = sqrt(footprint.power_max);
    let tall = root / footprint.conic_y;
    let across = root / footprint.conic_x;
    let lean = abs(footprint.conic_shear) * tall;
    // √(across² + lean²) without squares, which may overflow. The slack is far over f32's rounding.
    let large = max(across, lean);
    let ratio = min(across, lean) / large;
    let half = vec2(large * sqrt(1.0 + ratio * ratio), tall) * 1.0001 + 0.02;
    let low = mean - half;
    let high = mean + half;
    // Pixel centres of column c of the parts are 4 c + 0.5 to 4 c + 3.5, of row r 2 r + 0.5 and
    // 2 r + 1.5. Written so that a NaN meets everything.
    var columns = 0u;
    for (var c = 0u; c < 4u; c++) {
        let first = f32(c) * 4.0 + 0.5;
        columns |= select(0x11111111u << c, 0u, low.x > first + 3.0 || high.x < first);
    }
    var rows = 0u;
    for (var r = 0u; r < 8u; r++) {
        let first = f32(r) * 2.0 + 0.5;
        rows |= select(0xfu << (r * 4u), 0u, low.y > first + 1.0 || high.y < first);
    }
    return columns & rows;
}

fn color_of(id: u32) -> vec3<f32> {
    if SKIP_FLAT_COLOR && views[which].sh_count == 1u {
        let at = id * 3u;
        let c = vec3(colors[at], colors[at + 1u], colors[at + 2u]);
        return max(vec3(SH_OFFSET) + SH_C0 * c, vec3(0.0));
    }
    let at = (which * views[which].gaussian_count + id) * 3u;
    return vec3(colors[at], colors[at + 1u], colors[at + 2u]);
}
