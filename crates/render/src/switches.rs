//! Work that a renderer leaves out because no pixel changes, one kind each.
//!
//! The product leaves out all of it. Tests switch each kind off and expect the same pictures;
//! `segsplat-lab skips` measures the time of each.

/// One kind of work that no pixel needs.
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
    /// Sorting Gaussians that no tile of the picture sees.
    Unseen,
    /// Blending tiles that nothing falls on. On a GPU it is no step of its own.
    EmptyTiles,
    /// Directions to Gaussians, and on a GPU the stage that shades, of a scene whose colours are
    /// the same from everywhere.
    FlatColor,
    /// Digits of the depth sort that are the same for all. On the CPU it saved nothing and was
    /// dropped.
    EqualDigits,
}

impl Skip {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::EllipseTiles,
        Self::EllipseParts,
        Self::EndedRays,
        Self::Unseen,
        Self::FlatColor,
        Self::EmptyTiles,
        Self::EqualDigits,
    ];

    /// Name for people and in records.
    #[must_use]
    pub fn name(self) -> &'static str {
        match self {
            Self::EllipseTiles => "ellipse tiles",
            Self::EllipseParts => "ellipse parts",
            Self::EndedRays => "ended rays",
            Self::Unseen => "unseen",
            Self::FlatColor => "flat colour",
            Self::EmptyTiles => "empty tiles",
            Self::EqualDigits => "equal digits",
        }
    }

    /// The shaders' constant that is true while it is on, in those that know it.
    #[must_use]
    pub fn constant(self) -> &'static str {
        match self {
            Self::EllipseTiles => "SKIP_ELLIPSE_TILES",
            Self::EllipseParts => "SKIP_ELLIPSE_PARTS",
            Self::EndedRays => "SKIP_ENDED_RAYS",
            Self::Unseen => "SKIP_UNSEEN",
            Self::FlatColor => "SKIP_FLAT_COLOR",
            Self::EmptyTiles => "SKIP_EMPTY_TILES",
            Self::EqualDigits => "SKIP_EQUAL_DIGITS",
        }
    }
}
