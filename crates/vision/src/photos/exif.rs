//! The focal length in a photo's EXIF. What cannot be read of it says nothing.

/// Tags of EXIF, by their numbers in its standard (CIPA DC-008).
const EXIF_IFD: u16 = 0x8769;
const FOCAL_LENGTH: u16 = 0x920A;
const FOCAL_LENGTH_IN_35MM: u16 = 0xA405;
const PIXEL_X_DIMENSION: u16 = 0xA002;
const PIXEL_Y_DIMENSION: u16 = 0xA003;
const PLANE_X_RESOLUTION: u16 = 0xA20E;
const PLANE_RESOLUTION_UNIT: u16 = 0xA210;

/// Diagonal of a 35 mm film's picture, millimetres.
const FILM_DIAGONAL: f64 = 43.266_6;
/// Entries of a directory that are looked at.
const ENTRIES_MAX: u16 = 512;
/// Focal lengths over the longer side of a photo that are believed: 130 to 8 degrees.
const BELIEVED: [f64; 2] = [0.23, 7.0];

/// Focal length in pixels of a photo of this size, by its EXIF block (a TIFF file).
pub(super) fn focal(exif: &[u8], [width, height]: [u32; 2]) -> Option<f64> {
    let tiff = Tiff::new(exif)?;
    let first = tiff.directory(tiff.u32(4)?)?;
    let own = tiff.directory(tiff.whole(first, EXIF_IFD)?)?;
    let [width, height] = [width, height].map(f64::from);
    let film = tiff.number(own, FOCAL_LENGTH_IN_35MM).filter(|mm| *mm > 0.0);
    let of_film = film.map(|mm| mm / FILM_DIAGONAL * width.hypot(height));
    let of_sensor = || {
        let millimetres = match tiff.whole(own, PLANE_RESOLUTION_UNIT)? {
            2 => 25.4,
            3 => 10.0,
            4 => 1.0,
            5 => 1e-3,
            _ => return None,
        };
        let pixels = tiff.number(own, PLANE_X_RESOLUTION)?;
        // Programs that make a photo smaller keep its EXIF.
        let sides = [PIXEL_X_DIMENSION, PIXEL_Y_DIMENSION].map(|tag| tiff.whole(own, tag));
        let taken = sides.into_iter().flatten().max().filter(|side| *side > 0);
        let smaller = taken.map_or(1.0, |side| width.max(height) / f64::from(side));
        Some(tiff.number(own, FOCAL_LENGTH)? * pixels / millimetres * smaller)
    };
    let [least, most] = BELIEVED.map(|share| share * width.max(height));
    of_film.or_else(of_sensor).filter(|focal| (least..=most).contains(focal))
}

/// A TIFF file in memory; every read is within its bytes.
struct Tiff<'a> {
    bytes: &'a [u8],
    is_little: bool,
}

/// A directory: the place of its first entry, and how many there are.
#[derive(Clone, Copy)]
struct Directory {
    first: usize,
    entries: u16,
}

impl<'a> Tiff<'a> {
    fn new(bytes: &'a [u8]) -> Option<Self> {
        let bytes = bytes.strip_prefix(b"Exif\0\0").unwrap_or(bytes);
        let is_little = match bytes.get(..4)? {
            b"II*\0" => true,
            b"MM\0*" => false,
            _ => return None,
        };
        Some(Self { bytes, is_little })
    }

    fn u16(&self, at: usize) -> Option<u16> {
        let two = *self.bytes.get(at..)?.first_chunk()?;
        Some(if self.is_little { u16::from_le_bytes(two) } else { u16::from_be_bytes(two) })
    }

    fn u32(&self, at: usize) -> Option<u32> {
        let four = *self.bytes.get(at..)?.first_chunk()?;
        Some(if self.is_little { u32::from_le_bytes(four) } else { u32::from_be_bytes(four) })
    }

    fn directory(&self, at: u32) -> Option<Directory> {
        let at = usize::try_from(at).ok()?;
        Some(Directory { first: at.checked_add(2)?, entries: self.u16(at)?.min(ENTRIES_MAX) })
    }

    /// The kind of an entry, and where its value is.
    fn entry(&self, of: Directory, tag: u16) -> Option<(u16, usize)> {
        let places = (0..usize::from(of.entries)).map(|i| of.first + 12 * i);
        let at = places.into_iter().find(|at| self.u16(*at) == Some(tag))?;
        Some((self.u16(at + 2)?, at + 8))
    }

    /// A whole number: BYTE to LONG.
    fn whole(&self, of: Directory, tag: u16) -> Option<u32> {
        match self.entry(of, tag)? {
            (3, at) => self.u16(at).map(u32::from),
            (4, at) => self.u32(at),
            _ => None,
        }
    }

    /// A whole number or a fraction.
    fn number(&self, of: Directory, tag: u16) -> Option<f64> {
        match self.entry(of, tag)? {
            (5, at) => {
                let at = usize::try_from(self.u32(at)?).ok()?;
                let [above, below] = [self.u32(at)?, self.u32(at.checked_add(4)?)?];
                (below > 0).then(|| f64::from(above) / f64::from(below))
            }
            _ => self.whole(of, tag).map(f64::from),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// An EXIF block with these entries: tag, kind, value or fraction.
    fn exif(is_little: bool, entries: &[(u16, u16, [u32; 2])]) -> Vec<u8> {
        let two = |v: u16| if is_little { v.to_le_bytes() } else { v.to_be_bytes() };
        let four = |v: u32| if is_little { v.to_le_bytes() } else { v.to_be_bytes() };
        let mut bytes = if is_little { b"II*\0".to_vec() } else { b"MM\0*".to_vec() };
        bytes.extend(four(8));
        bytes.extend([two(1), two(EXIF_IFD), two(4)].concat());
        bytes.extend([four(1), four(26), four(0)].concat());
        bytes.extend(two(entries.len() as u16));
        let (mut rest, after) = (Vec::new(), 28 + 12 * entries.len());
        for &(tag, kind, [value, below]) in entries {
            bytes.extend([two(tag), two(kind)].concat());
            bytes.extend(four(1));
            match kind {
                3 => bytes.extend([two(value as u16), two(0)].concat()),
                5 => {
                    bytes.extend(four((after + rest.len()) as u32));
                    rest.extend([four(value), four(below)].concat());
                }
                _ => bytes.extend(four(value)),
            }
        }
        [bytes, rest].concat()
    }

    #[test]
    fn the_film_comes_before_the_sensor() {
        for is_little in [true, false] {
            // An iPhone: 4.25 mm, 26 mm of film, 4032 pixels of 1.4 micrometres.
            let film = exif(is_little, &[(FOCAL_LENGTH_IN_35MM, 3, [26, 0])]);
            let found = focal(&film, [4_032, 3_024]).unwrap();
            assert!((found / 4_032.0 - 0.751).abs() < 1e-3, "{found}");
            let sensor = [
                (FOCAL_LENGTH, 5, [425, 100]),
                (PLANE_X_RESOLUTION, 5, [7_143, 1]),
                (PLANE_RESOLUTION_UNIT, 3, [3, 0]),
            ];
            let found = focal(&exif(is_little, &sensor), [4_032, 3_024]).unwrap();
            assert!((found - 3_035.8).abs() < 1.0, "{found}");
            let whole = [&sensor[..], &[(PIXEL_X_DIMENSION, 4, [8_064, 0])]].concat();
            let found = focal(&exif(is_little, &whole), [4_032, 3_024]).unwrap();
            assert!((found - 0.5 * 3_035.8).abs() < 1.0, "{found}");
        }
    }

    #[test]
    fn nothing_is_said_by_what_cannot_be() {
        let film = |mm| exif(true, &[(FOCAL_LENGTH_IN_35MM, 3, [mm, 0])]);
        assert_eq!(focal(&film(0), [4_000, 3_000]), None);
        assert_eq!(focal(&film(9_999), [4_000, 3_000]), None, "a telescope");
        assert_eq!(focal(b"", [4_000, 3_000]), None);
        let whole = film(26);
        for cut in 0..whole.len() - 4 {
            assert_eq!(focal(&whole[..cut], [4_000, 3_000]), None, "{cut}");
        }
    }
}
