//! Gaussians as files of other programs, a module for each format.
//!
//! All hold centres, rotations, scales, opacities and colours of every Gaussian. What they lose is
//! in the module of each. PLY and GLB hold the entries of the bank and the semantics too.
//!
//! Axes are those of each format's own specification: PLY and `.splat` are in the axes of the scene
//! (OpenCV: y down, z forward), SPZ and glTF have y up and z back. `TURN` turns between them.

mod glb;
mod packed_ply;
mod places;
mod ply;
mod scene;
mod sog;
mod splat;
mod spz;
mod streamed;

use std::io::{self, BufRead, Write};

use self::places::{Coarse, world};
pub use self::{
    glb::GLB,
    ply::{COMPRESSED_PLY, PLY},
    sog::SOG,
    splat::SPLAT,
    spz::{SPZ, SPZ4},
    streamed::write_streamed,
};
use crate::{
    container::write_semantics,
    error::{Error, Result},
    limits::Limits,
    scene::{Gaussians, RawGaussians, SanitizeReport, SceneId, Semantics, SourcePixel},
};

/// What a file holds.
#[derive(Clone, Debug)]
pub struct SplatsRead {
    /// Its format.
    pub format: &'static SplatFormat,
    /// The Gaussians.
    pub gaussians: Gaussians,
    /// Whether they were made for a renderer that compensates opacity for the blur of small
    /// Gaussians.
    pub antialiased: bool,
    /// How many were dropped or changed.
    pub dropped: SanitizeReport,
    /// Their semantics, where it has some.
    pub semantics: Option<Semantics>,
}

impl SplatsRead {
    /// What was read, checked. The Gaussians say which entry is whose, also where some are dropped.
    fn new(
        format: &'static SplatFormat,
        mut raw: RawGaussians,
        semantics: Option<Semantics>,
    ) -> Result<Self> {
        raw.scales.iter_mut().for_each(thickened);
        raw.quats.iter_mut().for_each(turnable);
        let (gaussians, dropped) = Gaussians::sanitize(raw)?;
        let index = || gaussians.semantic_index().to_vec();
        let semantics = semantics.map(|semantics| Semantics { index: index(), ..semantics });
        Ok(Self { format, gaussians, antialiased: false, dropped, semantics })
    }

    /// The same for that renderer, or not.
    fn antialiased(self, antialiased: bool) -> Self {
        Self { antialiased, ..self }
    }
}

/// A format of files.
#[derive(Debug)]
pub struct SplatFormat {
    /// Name in calls.
    pub name: &'static str,
    /// Ending of files, without the first dot.
    pub ending: &'static str,
    /// Media type.
    pub media_type: &'static str,
    /// Whether it holds entries of the bank and the semantics.
    pub semantics: bool,
    /// First bytes of a file; empty where only the ending of its name tells.
    pub(crate) begins: &'static [u8],
    /// Reads what begins so.
    pub(crate) read: fn(&mut dyn BufRead, &Limits) -> Result<SplatsRead>,
    /// Refuses what the format cannot hold.
    check: fn(&SplatFile) -> Result<()>,
    /// Size of the whole file, where it is known before the end.
    size_bytes: fn(&SplatFile) -> Option<u64>,
    write: fn(&SplatFile, &mut dyn Write) -> io::Result<()>,
}

/// Media type of files that have none of their own.
pub const OCTETS: &str = "application/octet-stream";

/// A file to be written.
#[derive(Debug)]
pub struct SplatFile {
    format: &'static SplatFormat,
    gaussians: Gaussians,
    /// Whether opacity is to be compensated for the blur of small Gaussians.
    antialiased: bool,
    /// The step of f32 positions, where it is too coarse for this scene.
    coarse: Option<Coarse>,
    /// The container of the semantics; empty where there are none.
    semantics: Vec<u8>,
}

impl SplatFile {
    /// Gaussians as a file, with their semantics where there are some and the format holds them.
    ///
    /// # Errors
    /// `invalid_request` and `limit_exceeded` for a scene that the format cannot hold; `internal`
    /// when the semantics cannot be packed.
    pub fn new(
        format: &'static SplatFormat,
        gaussians: Gaussians,
        semantics: Option<&Semantics>,
    ) -> Result<Self> {
        let mut packed = Vec::new();
        if let Some(semantics) = semantics.filter(|_| format.semantics) {
            write_semantics(&mut packed, &SceneId::from_bytes([0; 16]), semantics)
                .map_err(|e| Error::internal("the semantics cannot be packed").caused_by(e))?;
        }
        let coarse = Coarse::in_f32(&gaussians);
        let file = Self { format, gaussians, antialiased: false, coarse, semantics: packed };
        (format.check)(&file)?;
        Ok(file)
    }

    /// The same, marked for a renderer that compensates opacity for the blur of small Gaussians,
    /// or not. `.splat` has no place for the mark.
    #[must_use]
    pub fn antialiased(self, antialiased: bool) -> Self {
        Self { antialiased, ..self }
    }

    /// Its format.
    pub fn format(&self) -> &'static SplatFormat {
        self.format
    }

    /// Size of the whole file, where it is known before the end.
    pub fn size_bytes(&self) -> Option<u64> {
        (self.format.size_bytes)(self)
    }

    /// Writes the file from its start to its end, in small parts.
    ///
    /// # Errors
    /// Those of `to`.
    pub fn write(&self, to: &mut dyn Write) -> io::Result<()> {
        (self.format.write)(self, to)
    }
}

/// Refuses more Gaussians of this degree than a scene may have, or than may be in memory.
fn check_count(what: &str, count: usize, sh_degree: u8, limits: &Limits) -> Result<()> {
    let (max, bytes_max) = (limits.gaussians_max, limits.splats_bytes_max);
    if count > max {
        return Err(Error::limit(what, count, max));
    }
    let bytes = Gaussians::bytes_of(count, sh_degree);
    if bytes > bytes_max {
        let value = format!("{count} of degree {sh_degree}, {bytes} bytes in memory");
        return Err(Error::limit(what, value, format!("{bytes_max} bytes")));
    }
    Ok(())
}

/// Most formats hold one Gaussian or more.
fn some(file: &SplatFile) -> Result<()> {
    if file.gaussians.is_empty() {
        let name = file.format.name;
        return Err(Error::invalid(format!(
            "{name}: there are no Gaussians to write; ply can be empty"
        )));
    }
    Ok(())
}

/// The same for formats that have positions as f32 of the world: refuses what lies too far off.
fn some_near(file: &SplatFile) -> Result<()> {
    some(file)?;
    file.coarse.map_or(Ok(()), |coarse| Err(coarse.refused(file.format.name)))
}

pub(crate) fn unreadable(cause: io::Error) -> Error {
    Error::unavailable("read the file", cause)
}

/// What a scale of 0 becomes: so small a share of the smallest one of the same Gaussian.
const FLAT: f32 = 1e-3;

/// Flat Gaussians, as 2DGS makes them, and points are drawn: 0 gets a thickness that no view shows.
fn thickened(scales: &mut [f32; 3]) {
    let others = scales.iter().copied().filter(|scale| *scale > 0.0);
    let least = FLAT * others.fold(f32::INFINITY, f32::min);
    let thin =
        if least.is_finite() { least.max(Gaussians::SCALE_MIN) } else { Gaussians::SCALE_MIN };
    scales.iter_mut().filter(|scale| **scale == 0.0).for_each(|scale| *scale = thin);
}

/// A rotation of zeros turns nothing, as in 3DGS.
fn turnable(quat: &mut [f32; 4]) {
    if *quat == [0.0; 4] {
        quat[0] = 1.0;
    }
}

/// Signs that turn a position from the scene's axes (x right, y down, z forward) to y up and z
/// back, and back again: half a turn about x.
const TURN: [f32; 3] = [1.0, -1.0, -1.0];
/// The same for a quaternion w x y z. It turns the axes of the Gaussian as well, which its
/// covariance does not see.
const TURN_QUAT: [f32; 4] = [1.0, 1.0, -1.0, -1.0];
/// The same for the coefficients of spherical harmonics, degree 0 to 3: the sign that each basis
/// function gets when y and z change theirs.
const TURN_SH: [f32; 16] =
    [1.0, -1.0, -1.0, 1.0, -1.0, 1.0, 1.0, -1.0, 1.0, -1.0, 1.0, -1.0, -1.0, 1.0, -1.0, 1.0];

fn times<const N: usize>(a: [f32; N], b: [f32; N]) -> [f32; N] {
    std::array::from_fn(|i| a[i] * b[i])
}

/// Gaussians reserved for before any is read: a header may claim anything.
const RESERVED_MAX: usize = 65_536;

/// Arrays for `count` Gaussians of this degree, none of them read yet.
fn begun(count: usize, sh_degree: u8) -> RawGaussians {
    let mut raw = RawGaussians { sh_degree, ..RawGaussians::default() };
    raw.means.reserve(count.min(RESERVED_MAX));
    raw
}

/// The rows that no format but PLY and GLB has.
fn fill_rest(raw: &mut RawGaussians) {
    let n = raw.means.len();
    raw.semantic_index.resize(n, 0);
    raw.source.resize(n, SourcePixel::default());
}

/// The error of a read that ended too early, or failed.
fn cut_short(format: &str, cause: io::Error, read: usize, count: usize, of: &str) -> Error {
    match cause.kind() {
        io::ErrorKind::UnexpectedEof => {
            Error::invalid(format!("{format}: the file ends after {read} of {count} {of}"))
        }
        // What the inflater says of damaged bytes.
        io::ErrorKind::InvalidInput | io::ErrorKind::InvalidData => Error::invalid(format!(
            "{format}: the compressed bytes are damaged after {read} of {count} {of}"
        )),
        _ => unreadable(cause),
    }
}

/// `value` of 0..1 as a number of 0..`most`, to the nearest.
fn steps(value: f32, most: u32) -> u32 {
    (value.clamp(0.0, 1.0) * most as f32 + 0.5) as u32
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The basis as the appendix of `KHR_gaussian_splatting` has it, without its constants: a
    /// turned direction with turned coefficients has the colour of the direction and coefficients
    /// before.
    #[test]
    fn coefficients_turn_as_their_basis_does() {
        let basis = |[x, y, z]: [f32; 3]| {
            let (xx, yy, zz) = (x * x, y * y, z * z);
            [
                1.0,
                -y,
                z,
                -x,
                x * y,
                -y * z,
                2.0 * zz - xx - yy,
                -x * z,
                xx - yy,
                -y * (3.0 * xx - yy),
                x * y * z,
                -y * (4.0 * zz - xx - yy),
                z * (2.0 * zz - 3.0 * xx - 3.0 * yy),
                -x * (4.0 * zz - xx - yy),
                z * (xx - yy),
                -x * (xx - 3.0 * yy),
            ]
        };
        let direction = [0.3, -0.5, 0.8];
        assert_eq!(basis(times(direction, TURN)), times(basis(direction), TURN_SH));
    }
}
