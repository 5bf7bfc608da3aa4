// Numbers of the rendering model: the list of crates/render/src/constants.rs (a test compares
// them).
const TILE_SIZE: u32 = 16u;
const ALPHA_MIN: f32 = 0.003921569;
const ALPHA_MAX: f32 = 0.999;
const TRANSMITTANCE_MIN: f32 = 0.0001;
const BLUR_PX2: f32 = 0.3;
const OWN_SIZE: f32 = 1.25;
const PIXEL_PX2: f32 = 0.083333336;
const FRUSTUM_MARGIN: f32 = 0.3;
const FOOTPRINT_SLACK: f32 = 0.0001;
const SH_C0: f32 = 0.28209479;
const SH_C1: f32 = 0.48860251;
const SH_C2 = array<f32, 5>(1.0925484, -1.0925484, 0.31539157, -1.0925484, 0.5462742);
const SH_C3 = array<f32, 7>(
    -0.5900436, 2.8906114, -0.4570458, 0.37317633, -0.4570458, 1.4453057, -0.5900436,
);
const SH_OFFSET: f32 = 0.5;
const ATAN = array<f32, 7>(
    0.9999961, -0.3331737, 0.19807816, -0.13233343, 0.07962367, -0.03360422, 0.0068117934,
);

// Numbers of the kernels: the list of crates/render/src/gpu/pipelines.rs.
// Invocations of a workgroup, the portable floor; also the values of a radix digit.
const WORKGROUP_SIZE: u32 = 256u;
// Gaussians of a block.
const BLOCK: u32 = 256u;
// Views that one submission draws at most: the workgroup's z says which.
const VIEWS_MAX: u32 = 8u;
// Pairs of a tile that one workgroup sorts at once.
const SORT_RUN: u32 = 2048u;
// Tiles of a Gaussian above which a whole workgroup visits them.
const LARGE_TILES: u32 = 64u;
// Tiles in which a workgroup counts by itself.
const BINS: u32 = 1024u;
// Workgroups along x at most; more go to y.
const GROUPS_X_MAX: u32 = 32768u;
// Values of View::levels but 0.
const LEVELS_RGB: u32 = 1u;
const LEVELS_RGBA: u32 = 2u;
// Values of Source::layer but 0.
const BEHIND: u32 = 1u;
const LEFT_OUT: u32 = 2u;
// Sums that a tile gives for each of its pairs in the backward pass.
const PAIR_SUMS: u32 = 10u;
// Derivatives of a Gaussian but for its harmonics, and whether it is seen.
const GRADIENT_WORDS: u32 = 12u;
// Numbers of a photo's exposure, with its moments and the loss.
const EXPOSURE_WORDS: u32 = 20u;
// Workgroups that add up what the loss says of a camera.
const POSE_GROUPS: u32 = 64u;
// Cells of a backdrop.
const BACKDROP_WIDTH: u32 = 128u;
const BACKDROP_HEIGHT: u32 = 64u;
// Start of a picture that was not asked for.
const NO_PICTURE: u32 = 0xffffffffu;
