// Which tiles a Gaussian touches: one function for the count and for the emission. CPU:
// crates/render/src/cpu/tiles.rs. f32 may make a span one tile wider. No pixel changes, because the
// test of each pixel is exact.

struct Extent {
    // √power_max, and half-width and half-height of the box around the footprint, pixels.
    root: f32,
    wide: f32,
    tall: f32,
    // Rounding of f32, pixels.
    slack: vec2<f32>,
    // Pixel rows reached; none when top > bottom.
    top: i32,
    bottom: i32,
}

// Without it all tiles of the box around a footprint are touched.
override SKIP_ELLIPSE_TILES: bool = true;

// Pixels under this magnitude fit i32 and f32 alike.
const PIXEL_BOUND: f32 = 16777216.0;

fn to_pixel(x: f32) -> i32 {
    return i32(clamp(x, -PIXEL_BOUND, PIXEL_BOUND));
}

// Extent of a footprint within the tile rows row_start..row_end.
fn extent_of(footprint: Footprint, row_start: u32, row_end: u32) -> Extent {
    let root = sqrt(footprint.power_max);
    let tall = root / footprint.conic_y;
    let across = root / footprint.conic_x;
    let lean = abs(footprint.conic_shear) * tall;
    let large = max(across, lean);
    let wide = large * sqrt((across / large) * (across / large) + (lean / large) * (lean / large));
    let slack = vec2(0.01) + 4e-6 * (abs(footprint.mean) + vec2(wide, tall));
    let first_row = i32(row_start * TILE_SIZE);
    let last_row = i32(min(row_end * TILE_SIZE, views[which].height)) - 1;
    let top = max(to_pixel(ceil(footprint.mean.y - tall - 0.5 - slack.y)), first_row);
    let bottom = min(to_pixel(floor(footprint.mean.y + tall - 0.5 + slack.y)), last_row);
    return Extent(root, wide, tall, slack, top, bottom);
}

// First tile and one past the last tile touched in the row of tiles `tile_y` of the extent.
//
// The ellipse is convex, so a row of tiles sees one span: between its leftmost and its rightmost
// point inside the row's band.
fn tile_span(footprint: Footprint, extent: Extent, tile_y: i32) -> vec2<u32> {
    let size = i32(TILE_SIZE);
    let row_low = f32(max(tile_y * size, extent.top)) + 0.5 - footprint.mean.y;
    let row_high = f32(min(tile_y * size + size - 1, extent.bottom)) + 0.5 - footprint.mean.y;
    var low = -extent.tall;
    var high = extent.tall;
    if SKIP_ELLIPSE_TILES {
        low = clamp(row_low, low, high);
        high = clamp(row_high, -extent.tall, extent.tall);
    }
    let peak = footprint.conic_shear * extent.tall * (extent.tall / extent.wide);
    let at_right = clamp(peak, low, high);
    let at_left = clamp(-peak, low, high);
    let right = footprint.mean.x + footprint.conic_shear * at_right
        + half_width(footprint, extent, at_right) + extent.slack.x;
    let left = footprint.mean.x + footprint.conic_shear * at_left
        - half_width(footprint, extent, at_left) - extent.slack.x;
    let first = max(to_pixel(ceil(left - 0.5)), 0);
    let last = min(to_pixel(floor(right - 0.5)), i32(views[which].width) - 1);
    if first > last {
        return vec2(0u);
    }
    return vec2(u32(first / size), u32(last / size) + 1u);
}

fn half_width(footprint: Footprint, extent: Extent, dy: f32) -> f32 {
    let across = dy / extent.tall;
    return sqrt(max(0.0, 1.0 - across * across)) * (extent.root / footprint.conic_x);
}

// Number of tiles touched in the tile rows row_start..row_end.
fn count_tiles(footprint: Footprint, row_start: u32, row_end: u32) -> u32 {
    let extent = extent_of(footprint, row_start, row_end);
    var count = 0u;
    if extent.top <= extent.bottom {
        let size = i32(TILE_SIZE);
        for (var tile_y = extent.top / size; tile_y <= extent.bottom / size; tile_y++) {
            let span = tile_span(footprint, extent, tile_y);
            count += span.y - span.x;
        }
    }
    return count;
}

// Visits the tiles that a footprint touches in the band: of its rows of tiles every `lines`-th from
// `line`, of each row every `steps`-th tile from `step`. A shader says what a visit does.
fn visit_tiles(footprint: Footprint, id: u32, line: u32, lines: u32, step: u32, steps: u32) {
    let first_row = views[which].row_start;
    let extent = extent_of(footprint, first_row, views[which].row_end);
    if extent.top > extent.bottom {
        return;
    }
    let size = i32(TILE_SIZE);
    let last = extent.bottom / size;
    for (var tile_y = extent.top / size + i32(line); tile_y <= last; tile_y += i32(lines)) {
        let span = tile_span(footprint, extent, tile_y);
        let row = (u32(tile_y) - first_row) * views[which].tiles_x + views[which].range_start;
        for (var tile_x = span.x + step; tile_x < span.y; tile_x += steps) {
            visit(row + tile_x, footprint, id);
        }
    }
}

// Gaussians of this workgroup that touch many tiles: all its invocations visit those together.
var<workgroup> large: array<u32, WORKGROUP_SIZE>;
var<workgroup> large_count: atomic<u32>;
var<workgroup> larges: u32;

fn begin_visits(local: u32) {
    if local == 0u {
        atomicStore(&large_count, 0u);
    }
    workgroupBarrier();
}

fn visit_or_defer(footprint: Footprint, id: u32, touched: u32) {
    if touched > LARGE_TILES {
        large[atomicAdd(&large_count, 1u)] = id;
    } else if touched > 0u {
        visit_tiles(footprint, id, 0u, 1u, 0u, 1u);
    }
}
