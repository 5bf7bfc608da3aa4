//! Numbers of the rendering model, each with its reason. A test compares the shaders' list with
//! this one.

/// Side of a square tile, pixels: 256 pixels share one list of Gaussians, one workgroup a tile.
pub const TILE_SIZE: u32 = 16;
/// Contributions under this are skipped: they change an 8-bit picture by less than one level.
pub const ALPHA_MIN: f32 = 1.0 / 255.0;
/// Largest alpha of one Gaussian, as gsplat: a ray never becomes exactly opaque in one step.
pub const ALPHA_MAX: f32 = 0.999;
/// A ray ends when its transmittance would fall to this or under; that Gaussian is not added.
pub const TRANSMITTANCE_MIN: f32 = 1e-4;
/// Added to both diagonal entries of the 2D covariance, px²: a Gaussian covers at least a pixel.
pub const BLUR_PX2: f32 = crate::scene::BLUR_PX2;
/// Share of the view's half-extent by which the frustum is widened before the Jacobian is taken:
/// beyond it the affine approximation of the perspective map explodes.
pub const FRUSTUM_MARGIN: f32 = 0.3;
/// Spherical harmonics of degree 0: 1 / (2 √π).
pub const SH_C0: f32 = crate::scene::SH_C0;
/// Degree 1: √(3 / 4π).
pub const SH_C1: f32 = 0.488_602_51;
/// Degree 2, 3DGS order: xy, yz, 3z²-1 form, xz, x²-y².
pub const SH_C2: [f32; 5] = [1.092_548_4, -1.092_548_4, 0.315_391_57, -1.092_548_4, 0.546_274_2];
/// Degree 3, 3DGS order.
pub const SH_C3: [f32; 7] = [
    -0.590_043_6,
    2.890_611_4,
    -0.457_045_8,
    0.373_176_33,
    -0.457_045_8,
    1.445_305_7,
    -0.590_043_6,
];
/// Added to every colour after the harmonics, as 3DGS: a coefficient of 0 is mid-grey.
pub const SH_OFFSET: f32 = 0.5;

/// Slack on the squared half-distance at which alpha reaches [`ALPHA_MIN`]: f32 rounding of alpha
/// (about 1e-6) never meets a pixel that the footprint left out. The pixel test stays exact.
pub const FOOTPRINT_SLACK: f32 = 1e-4;
/// Gaussian-tile pairs held at once (8 bytes each, twice for the sort): 512 MiB. A frame with more
/// is drawn in bands of tile rows.
pub const ISECTS_MAX: u64 = 1 << 25;
/// Entries of one view (6 bytes each): 768 MiB, what 64 a pixel come to at 1080p.
pub const PIXEL_WEIGHTS_MAX: u64 = 1 << 27;
/// Gaussians staged at once for a tile: their data stay in the level-1 cache.
pub const BATCH_SIZE: usize = 128;

/// The numbers that the shaders must share, by the name they have in WGSL.
pub const SHARED: [(&str, f32); 9] = [
    ("ALPHA_MIN", ALPHA_MIN),
    ("ALPHA_MAX", ALPHA_MAX),
    ("TRANSMITTANCE_MIN", TRANSMITTANCE_MIN),
    ("BLUR_PX2", BLUR_PX2),
    ("FRUSTUM_MARGIN", FRUSTUM_MARGIN),
    ("SH_C0", SH_C0),
    ("SH_C1", SH_C1),
    ("SH_OFFSET", SH_OFFSET),
    ("FOOTPRINT_SLACK", FOOTPRINT_SLACK),
];
