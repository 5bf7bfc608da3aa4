// Numbers of the rendering model: the list of crates/render/src/constants.rs (a test compares
// them).
const TILE_SIZE: u32 = 16u;
const ALPHA_MIN: f32 = 0.003921569;
const ALPHA_MAX: f32 = 0.999;
const TRANSMITTANCE_MIN: f32 = 0.0001;
const BLUR_PX2: f32 = 0.3;
const FRUSTUM_MARGIN: f32 = 0.3;
const FOOTPRINT_SLACK: f32 = 0.0001;
const SH_C0: f32 = 0.28209479;
const SH_C1: f32 = 0.48860251;
const SH_C2 = array<f32, 5>(1.0925484, -1.0925484, 0.31539157, -1.0925484, 0.5462742);
const SH_C3 = array<f32, 7>(
    -0.5900436, 2.8906114, -0.4570458, 0.37317633, -0.4570458, 1.4453057, -0.5900436,
);
const SH_OFFSET: f32 = 0.5;

// Numbers of the kernels: the list of crates/render/src/gpu/pipelines.rs.
// Invocations of a workgroup, the portable floor; also the values of a radix digit.
const WORKGROUP_SIZE: u32 = 256u;
// Views that one submission draws at most: the workgroup's z says which.
const VIEWS_MAX: u32 = 8u;
// Invocations of a workgroup that moves pairs, and the pairs that it moves.
const SORT_SIZE: u32 = 128u;
const SORT_BLOCK: u32 = 2048u;
// Gaussians whose tile pairs one workgroup emits.
const SCAN_BLOCK: u32 = 1024u;
// Workgroups along x at most; more go to y.
const GROUPS_X_MAX: u32 = 32768u;
// Rows of four numbers in `groups_of`: digits 1 to 3 of the depth sort by blocks, then by digit
// values; the tile sort; tile_ranges.
const GROUPS_DEPTH: u32 = 0u;
const GROUPS_DIGITS: u32 = 3u;
const GROUPS_TILES: u32 = 6u;
const GROUPS_RANGES: u32 = 7u;
// Bits of a fast view's depth keys: two digits of the sort.
const FAST_KEY_BITS: u32 = 16u;
// Depth key of a dropped Gaussian: after every finite depth.
const DROPPED_KEY: u32 = 0xffffffffu;
// Value of a pair that was counted and not emitted: blends nothing.
const NO_GAUSSIAN: u32 = 0xffffffffu;
// Start of a picture that was not asked for.
const NO_PICTURE: u32 = 0xffffffffu;
