//! What a file is by its first bytes, and what to do where it is no photo that is read.

use image::ImageFormat;

/// Formats that are read.
const READ: [(ImageFormat, &str); 5] = [
    (ImageFormat::Jpeg, "JPEG"),
    (ImageFormat::Png, "PNG"),
    (ImageFormat::WebP, "WebP"),
    (ImageFormat::Tiff, "TIFF"),
    (ImageFormat::Bmp, "BMP"),
];

/// What other files begin with, from a byte on, and what they are.
const OTHERS: [(usize, &[u8], &str); 12] = [
    (0, b"GIF8", "a GIF"),
    (0, b"%PDF", "a PDF"),
    (0, b"8BPS", "a Photoshop file"),
    (0, b"\xFF\x0A", "a JPEG XL file"),
    (4, b"JXL ", "a JPEG XL file"),
    (4, b"jP  ", "a JPEG 2000 file"),
    (0, b"\xFF\x4F\xFF\x51", "a JPEG 2000 file"),
    (0, b"\x76\x2F\x31\x01", "an OpenEXR file"),
    (0, b"FUJIFILM", "a camera's raw file"),
    (8, b"CR\x02", "a camera's raw file"),
    (0, b"<svg", "an SVG"),
    (0, b"\x1A\x45\xDF\xA3", "a video"),
];

/// The name of a format that is read.
pub(super) fn name(format: ImageFormat) -> &'static str {
    READ.iter().find(|(known, _)| *known == format).map_or("image", |(_, name)| name)
}

/// The format of a file, or a sentence on what it is and what to do.
pub(super) fn of(bytes: &[u8]) -> Result<ImageFormat, String> {
    if let Some(what) = other(bytes) {
        return Err(match what {
            "a HEIC file" => format!(
                "{what}, which is not read; save it as JPEG (iPhone: Settings > Camera > Formats > \
                 Most Compatible)"
            ),
            "a video" => format!(
                "{what}, which is not read; save frames of it as JPEG: `segsplat reconstruct` and \
                 the Python client do that where ffmpeg is installed"
            ),
            _ => format!("{what}, which is not read; save it as JPEG"),
        });
    }
    let guessed = image::guess_format(bytes).ok();
    guessed.filter(|format| READ.iter().any(|(known, _)| known == format)).ok_or_else(|| {
        let names = READ.map(|(_, name)| name).join(", ");
        format!("not a photo of a format that is read ({names})")
    })
}

/// Whether the first picture of a TIFF is a preview of another, as in the raw files of cameras that
/// are TIFFs (DNG, NEF, ARW): bit 0 of the tag `NewSubfileType`.
fn is_preview(bytes: &[u8]) -> bool {
    let is_big = bytes.starts_with(b"MM");
    let number = |at: usize, length: usize| -> Option<usize> {
        let part = bytes.get(at..at.checked_add(length)?)?;
        let add = |sum: usize, byte: &u8| sum << 8 | usize::from(*byte);
        let (big, little) = (part.iter().fold(0, add), part.iter().rev().fold(0, add));
        Some(if is_big { big } else { little })
    };
    let tags = || {
        let at = number(4, 4)?;
        let entry = |i: usize| Some((number(at + 2 + 12 * i, 2)?, number(at + 10 + 12 * i, 4)?));
        (0..number(at, 2)?).map_while(entry).find(|(tag, _)| *tag == 254)
    };
    (bytes.starts_with(b"II*\0") || bytes.starts_with(b"MM\0*"))
        && tags().is_some_and(|(_, kind)| kind & 1 == 1)
}

/// What a file is that is not read, where it is known.
fn other(bytes: &[u8]) -> Option<&'static str> {
    if is_preview(bytes) {
        return Some("a camera's raw file");
    }
    let found = OTHERS
        .iter()
        .find(|(at, start, _)| bytes.get(*at..).is_some_and(|rest| rest.starts_with(start)));
    if let Some((_, _, what)) = found {
        return Some(what);
    }
    // ISO base media: a size, `ftyp`, a brand, a version, and the brands that it is readable as.
    if bytes.get(4..8) != Some(b"ftyp") {
        return None;
    }
    let length = bytes.first_chunk().map_or(0, |size| u32::from_be_bytes(*size) as usize);
    let brands = bytes.get(8..length.clamp(12, 128).min(bytes.len())).unwrap_or_default();
    let is =
        |wanted: &[&[u8; 4]]| brands.as_chunks::<4>().0.iter().any(|brand| wanted.contains(&brand));
    Some(if is(&[b"avif", b"avis"]) {
        "an AVIF file"
    } else if is(&[b"heic", b"heix", b"hevc", b"hevx", b"heim", b"heis", b"mif1", b"msf1"]) {
        "a HEIC file"
    } else if is(&[b"crx "]) {
        "a camera's raw file"
    } else {
        "a video"
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn files_are_known_by_their_first_bytes() {
        let heic = b"\0\0\0\x18ftypheic\0\0\0\0mif1heic";
        let avif = b"\0\0\0\x1Cftypmif1\0\0\0\0mif1avifmiaf";
        for (bytes, words) in [
            (&heic[..], ["HEIC", "Most Compatible"]),
            (avif, ["AVIF", "save it as JPEG"]),
            (b"\0\0\0\x14ftypqt  \0\0\0\0qt  ", ["video", "ffmpeg"]),
            (b"GIF89a", ["GIF", "JPEG"]),
            (b"II*\0\x10\0\0\0CR\x02\0", ["raw", "JPEG"]),
            (b"just text", ["not a photo", "TIFF"]),
            (b"\0\0\0\x18ftyp", ["video", "JPEG"]),
        ] {
            let why = of(bytes).unwrap_err();
            assert!(words.iter().all(|word| why.contains(word)), "{why}");
        }
        assert_eq!(of(b"II*\0\x08\0\0\0"), Ok(ImageFormat::Tiff));
        let tagged =
            |kind| [&b"MM\0*\0\0\0\x08\0\x01\0\xFE\0\x04\0\0\0\x01\0\0\0"[..], &[kind]].concat();
        assert_eq!(of(&tagged(0)), Ok(ImageFormat::Tiff));
        assert!(of(&tagged(1)).unwrap_err().contains("raw"));
        assert_eq!(of(b"BM\0\0"), Ok(ImageFormat::Bmp));
    }
}
