//! Numbers of the rendering model, each with its reason. A test compares the shaders' list with
//! this one.

/// Declares numbers that the shaders have too, and lists them as `SHARED`.
macro_rules! shared {
    ($to:vis $type:ty; $($(#[$doc:meta])+ $name:ident = $value:expr;)+) => {
        $(
            $(#[$doc])+
            #[cfg_attr(not(feature = "testing"), allow(dead_code, reason = "for shaders alone"))]
            $to const $name: $type = $value;
        )+

        #[cfg(feature = "testing")]
        /// These numbers by their names in WGSL.
        pub const SHARED: [(&str, $type); [$(stringify!($name)),+].len()] =
            [$((stringify!($name), $name)),+];
    };
}
pub(crate) use shared;

shared! { pub f32;
    /// Contributions under this are skipped: they change an 8-bit picture by less than one level.
    ALPHA_MIN = 1.0 / 255.0;
    /// Largest alpha of one Gaussian, as gsplat: a ray never becomes exactly opaque in one step.
    ALPHA_MAX = 0.999;
    /// A ray ends when its transmittance would fall to this or under; that Gaussian is not added.
    TRANSMITTANCE_MIN = 1e-4;
    /// Added to both numbers on the diagonal of the 2D covariance, px²: a Gaussian covers at least
    /// a pixel.
    BLUR_PX2 = crate::scene::BLUR_PX2;
    /// Magnification up to which a Gaussian counts as seen at the network's own size.
    OWN_SIZE = 1.25;
    /// Variance of a pixel along each axis, px²: its square is the filter of what a view shows
    /// smaller than it was learnt.
    PIXEL_PX2 = 1.0 / 12.0;
    /// Share of the view's half-extent by which the frustum is widened before the Jacobian is
    /// taken: beyond it the affine approximation of the perspective map explodes.
    FRUSTUM_MARGIN = 0.3;
    /// Spherical harmonics of degree 0: 1 / (2 √π).
    SH_C0 = crate::scene::SH_C0;
    /// Degree 1: √(3 / 4π).
    SH_C1 = 0.488_602_51;
    /// Added to every colour after the harmonics, as 3DGS: a coefficient of 0 is mid-grey.
    SH_OFFSET = 0.5;
    /// Slack on the squared half-distance at which alpha reaches [`ALPHA_MIN`]: f32 rounding of
    /// alpha (about 1e-6) never meets a pixel that the footprint left out. The pixel test stays
    /// exact.
    FOOTPRINT_SLACK = 1e-4;
}

/// Side of a square tile, pixels: 256 pixels share one list of Gaussians, one workgroup a tile.
pub const TILE_SIZE: u32 = 16;
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

/// Bit of a depth key that puts a Gaussian behind all those without it: depths are over 0, so the
/// sign of their f32 is free.
pub const BEHIND_BIT: u32 = 1 << 31;
/// Half a level of 255: what needs no background in [`crate::Samples::Levels`] leaves less light.
pub const HALF_LEVEL: f32 = 0.5 / 255.0;
/// atan(x) over 0..1 to 3e-7, as x times a polynomial of x² (least largest error, by Remez).
pub const ATAN: [f32; 7] = [
    0.999_996_1,
    -0.333_173_7,
    0.198_078_16,
    -0.132_333_43,
    0.079_623_67,
    -0.033_604_22,
    0.006_811_793_4,
];

/// Gaussian-tile pairs held at once (8 bytes each, twice for the sort): 512 MiB. A frame with more
/// is drawn in bands of tile rows.
pub const ISECTS_MAX: u32 = 1 << 25;
/// Weights of one view (6 bytes each): 768 MiB, what 64 a pixel come to at 1080p.
pub const PIXEL_WEIGHTS_MAX: u64 = 1 << 27;
/// Gaussians staged at once for a tile: their data stay in the level-1 cache.
pub const BATCH_SIZE: usize = 128;
