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

// What a Gaussian touches in the band, in a word: 0 for nothing. Most touch tiles of a square of
// 2 x 2 alone. Their word is SQUARE with the row of its first tile, its column, and a bit for each
// of its tiles. Other words are numbers of tiles.
const SQUARE: u32 = 0x80000000u;
const SQUARE_COLUMNS: u32 = 8192u;
const SQUARE_ROWS: u32 = 16384u;

// Bits of two tiles from `left` on that a span holds.
fn in_square(span: vec2<u32>, left: u32) -> u32 {
    return select(0u, (1u << (span.y - left)) - (1u << (span.x - left)), span.x < span.y);
}

fn touched_by(footprint: Footprint) -> u32 {
    let extent = extent_of(footprint, views[which].row_start, views[which].row_end);
    if extent.top > extent.bottom {
        return 0u;
    }
    let size = i32(TILE_SIZE);
    let first = extent.top / size;
    let last = extent.bottom / size;
    if last - first < 2 {
        let upper = tile_span(footprint, extent, first);
        var lower = vec2(0u);
        if last > first {
            lower = tile_span(footprint, extent, last);
        }
        let left = min(
            select(0xffffffffu, upper.x, upper.x < upper.y),
            select(0xffffffffu, lower.x, lower.x < lower.y),
        );
        let right = max(upper.y, lower.y);
        if right == 0u {
            return 0u;
        }
        if right - left <= 2u && left < SQUARE_COLUMNS && u32(first) < SQUARE_ROWS {
            let four = in_square(upper, left) | (in_square(lower, left) << 2u);
            return SQUARE | (u32(first) << 17u) | (left << 4u) | four;
        }
    }
    return count_tiles(footprint, views[which].row_start, views[which].row_end);
}

// Number of tiles of such a word.
fn count_of(touched: u32) -> u32 {
    return select(touched, countOneBits(touched & 15u), touched >= SQUARE);
}

fn square_corner(touched: u32) -> vec2<u32> {
    return vec2(touched >> 4u, touched >> 17u) & vec2(SQUARE_COLUMNS - 1u, SQUARE_ROWS - 1u);
}

// Visits the tiles of a word; the footprint is read where it is none of a square.
fn visit_touched(touched: u32, footprint: Footprint, id: u32) {
    if touched >= SQUARE {
        let corner = square_corner(touched);
        for (var k = 0u; k < 4u; k++) {
            if ((touched >> k) & 1u) != 0u {
                visit(corner + vec2(k & 1u, k >> 1u), footprint, id);
            }
        }
    } else if touched > 0u {
        visit_tiles(footprint, id, 0u, 1u, 0u, 1u);
    }
}

// Visits the tiles that a footprint touches in the band: of its rows of tiles every `lines`-th from
// `line`, of each row every `steps`-th tile from `step`. A shader says what a visit does.
fn visit_tiles(footprint: Footprint, id: u32, line: u32, lines: u32, step: u32, steps: u32) {
    let extent = extent_of(footprint, views[which].row_start, views[which].row_end);
    if extent.top > extent.bottom {
        return;
    }
    let size = i32(TILE_SIZE);
    let last = extent.bottom / size;
    for (var tile_y = extent.top / size + i32(line); tile_y <= last; tile_y += i32(lines)) {
        let span = tile_span(footprint, extent, tile_y);
        for (var tile_x = span.x + step; tile_x < span.y; tile_x += steps) {
            visit(vec2(tile_x, u32(tile_y)), footprint, id);
        }
    }
}

// Number of a tile (column, row of the picture) in the batch.
fn number_of(tile: vec2<u32>) -> u32 {
    let row = tile.y - views[which].row_start;
    return views[which].range_start + row * views[which].tiles_x + tile.x;
}

// A device adds slowly to one address, and Gaussians that are neighbours in memory touch the same
// tiles. So a workgroup first counts by itself in the box of the tiles that its Gaussians touch,
// where that box is small. Where it is smaller still, a tile has SPREAD bins, and neighbours among
// the invocations use different ones.
const SPREAD: u32 = 8u;
var<workgroup> bins: array<atomic<u32>, BINS>;
// Least columns and rows, largest columns and rows; each of every 32nd invocation, then of all.
var<workgroup> bin_boxes: array<atomic<u32>, 128>;
var<workgroup> bin_box: array<u32, 4>;
// Gaussians that touch many tiles: all invocations of the workgroup visit those together.
var<workgroup> large: array<u32, WORKGROUP_SIZE>;
var<workgroup> large_count: atomic<u32>;
var<workgroup> larges: u32;

// First tile and sides of the box, and bins of a tile, once all have seen their Gaussian.
var<private> bin_corner: vec2<u32>;
var<private> bin_sides: vec2<u32>;
var<private> bin_spread: u32;
// This invocation's bin of those of a tile.
var<private> own_bin: u32;

fn begin_visits(local: u32) {
    if local < 128u {
        atomicStore(&bin_boxes[local], select(0u, 0xffffffffu, local < 64u));
    }
    if local == 0u {
        atomicStore(&large_count, 0u);
    }
    for (var i = local; i < BINS; i += WORKGROUP_SIZE) {
        atomicStore(&bins[i], 0u);
    }
    workgroupBarrier();
}

// Whether this invocation visits the tiles of its Gaussian itself.
fn see(footprint: Footprint, id: u32, touched: u32, local: u32) -> bool {
    if count_of(touched) > LARGE_TILES {
        large[atomicAdd(&large_count, 1u)] = id;
        return false;
    }
    var low = square_corner(touched);
    var high = low + vec2(
        select(0u, 1u, (touched & 10u) != 0u), select(0u, 1u, (touched & 12u) != 0u),
    );
    if touched < SQUARE {
        let extent = extent_of(footprint, views[which].row_start, views[which].row_end);
        let size = i32(TILE_SIZE);
        let last = i32(views[which].tiles_x) - 1;
        let left = to_pixel(floor(footprint.mean.x - extent.wide)) / size;
        let right = to_pixel(ceil(footprint.mean.x + extent.wide)) / size;
        low = vec2<u32>(vec2(clamp(left, 0, last), extent.top / size));
        high = vec2<u32>(vec2(clamp(right, 0, last), extent.bottom / size));
    }
    let lane = local % 32u;
    atomicMin(&bin_boxes[lane], low.x);
    atomicMin(&bin_boxes[32u + lane], low.y);
    atomicMax(&bin_boxes[64u + lane], high.x);
    atomicMax(&bin_boxes[96u + lane], high.y);
    return true;
}

// After all have seen their Gaussian.
fn open_bins(local: u32) {
    workgroupBarrier();
    if local < 4u {
        var edge = atomicLoad(&bin_boxes[local * 32u]);
        for (var k = 1u; k < 32u; k++) {
            let other = atomicLoad(&bin_boxes[local * 32u + k]);
            edge = select(max(edge, other), min(edge, other), local < 2u);
        }
        bin_box[local] = edge;
    }
    workgroupBarrier();
    bin_corner = vec2(bin_box[0], bin_box[1]);
    let last = vec2(bin_box[2], bin_box[3]);
    bin_sides = vec2(0u);
    if all(last >= bin_corner) {
        let sides = last - bin_corner + vec2(1u);
        bin_sides = select(vec2(0u), sides, max(sides.x, sides.y) <= BINS
            && sides.x * sides.y <= BINS);
    }
    bin_spread = select(1u, SPREAD, bin_sides.x * bin_sides.y <= BINS / SPREAD);
    own_bin = local % bin_spread;
}

// Bin of a tile; BINS for those that have none.
fn bin_of(tile: vec2<u32>) -> u32 {
    let at = tile - bin_corner;
    let bin = (at.y * bin_sides.x + at.x) * bin_spread + own_bin;
    return select(BINS, bin, all(at < bin_sides));
}

// Tile of that number of the box.
fn tile_of(at: u32) -> vec2<u32> {
    return bin_corner + vec2(at % bin_sides.x, at / bin_sides.x);
}
