//! Switches that tests and the laboratory set, by the feature `testing`. The product is built
//! without it and has the defaults.

use std::{
    path::PathBuf,
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
};

#[cfg(target_arch = "x86_64")]
use pulp::x86::{V3, V4};

/// Declares [`Switches`], and how a renderer reads each.
macro_rules! switches {
    ($($(#[$doc:meta])+ $name:ident: $type:ty;)+) => {
        /// What tests and the laboratory change in a renderer, all at once. Without the feature
        /// `testing` there is nothing to change.
        #[derive(Clone, Debug, Default)]
        pub struct Switches {
            $($(#[$doc])+ #[cfg(feature = "testing")] pub $name: $type,)+
        }

        impl Switches {
            $(
                #[cfg(feature = "testing")]
                pub(crate) fn $name(&self) -> $type {
                    Clone::clone(&self.$name)
                }

                #[cfg(not(feature = "testing"))]
                pub(crate) fn $name(&self) -> $type {
                    Default::default()
                }
            )+
        }
    };
}

switches! {
    /// Needless work that is done all the same. All renderers.
    without: Option<Skip>;
    /// Gaussian-tile pairs held at once; more are drawn in bands. `None`: as many as
    /// [`crate::constants::ISECTS_MAX`]. All renderers.
    isects_max: Option<u32>;
    /// Gaussians from which a scene has blocks. `None`: [`crate::blocks::BLOCKS_MIN`]. All
    /// renderers.
    blocks_min: Option<usize>;
    /// Lanes of the CPU kernels. `None`: the widest of the processor.
    width: Option<Width>;
    /// Takes the smallest limits of WebGPU instead of those of the adapter: 128 MiB a binding,
    /// 8 storage buffers a stage, 16 KiB of workgroup storage.
    portable: bool;
    /// Folder whose files replace the built-in shaders: to try changes without a build.
    shaders: Option<PathBuf>;
    /// Lets the shaders check every index and loop.
    checked: bool;
    /// Whether the kernels for software adapters are used, where one invocation does what many
    /// share on a GPU. `None`: on software adapters alone.
    serial: Option<bool>;
    /// Faults to come on GPU devices.
    faults: Arc<FaultsToCome>;
}

/// Widths of the kernel, the widest first.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Width {
    /// 16 lanes: AVX-512.
    Sixteen,
    /// 8 lanes: AVX2 and FMA.
    Eight,
    /// 4 lanes, of whatever the target has.
    Four,
}

impl Width {
    /// All, the widest first.
    pub const ALL: [Self; 3] = [Self::Sixteen, Self::Eight, Self::Four];

    /// The widest one of this processor.
    pub fn widest() -> Self {
        Self::ALL.into_iter().find(|width| width.available()).unwrap_or(Self::Four)
    }

    /// Whether this processor has this width.
    pub fn available(self) -> bool {
        match self {
            #[cfg(target_arch = "x86_64")]
            Self::Sixteen => V4::is_available(),
            #[cfg(target_arch = "x86_64")]
            Self::Eight => V3::is_available(),
            #[cfg(not(target_arch = "x86_64"))]
            Self::Sixteen | Self::Eight => false,
            Self::Four => true,
        }
    }
}

/// How often something of a GPU device still fails.
#[derive(Debug, Default)]
pub struct FaultsToCome {
    /// Buffers for which there is no memory.
    pub memory: AtomicU32,
    /// Looks at the device that find it lost.
    pub lost: AtomicU32,
    /// Tries to open a device.
    pub open: AtomicU32,
}

impl FaultsToCome {
    /// Whether this one fails; then there is one less to come.
    pub(crate) fn comes(fault: &AtomicU32) -> bool {
        let less = |left: u32| left.checked_sub(1);
        cfg!(feature = "testing")
            && fault.load(Ordering::Relaxed) > 0
            && fault.fetch_update(Ordering::Relaxed, Ordering::Relaxed, less).is_ok()
    }
}

/// One kind of work that a renderer leaves out because no pixel changes. Tests switch each kind off
/// and expect the same pictures; `segsplat-lab skips` measures the time of each.
#[derive(Clone, Copy, Debug, PartialEq, Eq, serde::Serialize)]
#[serde(rename_all = "snake_case")]
pub enum Skip {
    /// Tiles of the box around a footprint that its ellipse misses, in the count and in the
    /// emission alike.
    EllipseTiles,
    /// Parts of a tile that the ellipse (on a GPU: the box around it) misses.
    EllipseParts,
    /// Gaussians behind the rest where all rays of a tile (on the CPU: of a part) have ended.
    EndedRays,
    /// Directions to Gaussians, and on a GPU the stage that shades, of a scene whose colours are
    /// the same from everywhere.
    FlatColor,
    /// Gaussians of blocks that are beside the picture or before the near plane.
    Blocks,
}

impl Skip {
    /// All of them.
    pub const ALL: [Self; 5] =
        [Self::EllipseTiles, Self::EllipseParts, Self::EndedRays, Self::FlatColor, Self::Blocks];

    /// Whether a renderer leaves it out that does `without` all the same.
    #[inline]
    pub(crate) fn applies(self, without: Option<Self>) -> bool {
        !cfg!(feature = "testing") || without != Some(self)
    }

    /// The constant of the shaders that is true while it is on, in those that know it.
    pub fn constant(self) -> String {
        format!("SKIP_{self}").to_uppercase()
    }
}

segsplat_core::names::display_names!(Skip);
