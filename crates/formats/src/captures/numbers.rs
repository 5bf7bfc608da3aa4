//! Numbers, poses and texts as programs write them.

use std::borrow::Cow;

use glam::{DMat3, DQuat, DVec3};

use super::lens::Lens;
use crate::{
    error::{Error, Result},
    scene::ORTHONORMAL_TOLERANCE,
};

/// Camera-to-world, row-major, of a rotation and a centre.
pub(crate) fn pose(rotation: DMat3, centre: DVec3) -> [f64; 16] {
    let [x, y, z] = rotation.transpose().to_cols_array_2d();
    let row = |r: [f64; 3], t: f64| [r[0], r[1], r[2], t];
    let rows = [row(x, centre.x), row(y, centre.y), row(z, centre.z), [0.0, 0.0, 0.0, 1.0]];
    let mut flat = [0.0; 16];
    flat.copy_from_slice(rows.as_flattened());
    flat
}

/// Camera-to-world, row-major, of a world-to-camera rotation and translation. A rotation times a
/// number gives one divided by it.
pub(crate) fn inverse(rotation: DMat3, translation: DVec3) -> [f64; 16] {
    let det = rotation.determinant().abs();
    let is_rotation = (det - 1.0).abs() <= ORTHONORMAL_TOLERANCE || det < 1e-6;
    let turned = rotation.transpose() * if is_rotation { 1.0 } else { det.powf(-2.0 / 3.0) };
    pose(turned, -(turned * translation))
}

/// Camera-to-world, row-major, of the first twelve numbers of a row-major world-to-camera matrix.
pub(crate) fn inverse_of_rows(m: &[f64]) -> [f64; 16] {
    let rotation = DMat3::from_cols_array(&[m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]]);
    inverse(rotation, DVec3::new(m[3], m[7], m[11]))
}

/// The rotation of a quaternion w x y z of any length but 0.
pub(crate) fn rotation([w, x, y, z]: [f64; 4]) -> DMat3 {
    DMat3::from_quat(DQuat::from_xyzw(x, y, z, w).normalize())
}

/// A pinhole lens; `size` is width and height where they are written.
pub(crate) fn pinhole([fx, fy, cx, cy]: [f64; 4], size: Option<[f64; 2]>) -> Lens {
    Lens {
        fx: Some(fx),
        fy: Some(fy),
        cx: Some(cx),
        cy: Some(cy),
        width: size.map(|[width, _]| width),
        height: size.map(|[_, height]| height),
        ..Lens::default()
    }
}

/// The text of a camera file: UTF-8, or UTF-16 with its mark.
pub(crate) fn text<'a>(bytes: &'a [u8], path: &str) -> Result<Cow<'a, str>> {
    let units = |of: fn([u8; 2]) -> u16| -> Vec<u16> {
        bytes[2..].as_chunks::<2>().0.iter().map(|pair| of(*pair)).collect()
    };
    let units = match bytes {
        [0xFF, 0xFE, ..] => units(u16::from_le_bytes),
        [0xFE, 0xFF, ..] => units(u16::from_be_bytes),
        _ => {
            let bytes = bytes.strip_prefix(b"\xEF\xBB\xBF").unwrap_or(bytes);
            return std::str::from_utf8(bytes)
                .map(Cow::Borrowed)
                .map_err(|e| Error::invalid(format!("{path}: not UTF-8 text")).caused_by(e));
        }
    };
    String::from_utf16(&units)
        .map(Cow::Owned)
        .map_err(|e| Error::invalid(format!("{path}: not UTF-16 text")).caused_by(e))
}

/// The numbers of a text between spaces; `None` where a word is none.
pub(crate) fn numbers(text: &str) -> Option<Vec<f64>> {
    text.split_whitespace().map(number_of).collect()
}

/// Which mark of decimals the lines of a file have. A file has one: where both are there, a comma
/// may as well stand between two numbers or between thousands.
#[derive(Default)]
pub(crate) struct Decimals {
    /// The first line with a comma, and that with a point.
    seen: [Option<usize>; 2],
}

impl Decimals {
    /// Looks at the numbers of a line.
    ///
    /// # Errors
    /// `invalid_request` where the file has commas and points.
    pub(crate) fn see(&mut self, words: &[&str], path: &str, line: usize) -> Result<()> {
        for (first, mark) in self.seen.iter_mut().zip([',', '.']) {
            if words.iter().any(|word| word.contains(mark)) {
                first.get_or_insert(line);
            }
        }
        match self.seen {
            [Some(comma), Some(point)] => Err(Error::invalid(format!(
                "{path}: line {comma} has commas in its numbers and line {point} has points: one \
                 of them may be no mark of decimals; write points in all"
            ))),
            _ => Ok(()),
        }
    }
}

/// A number as programs of any locale write it: a comma may stand for the point where there is no
/// point, and U+2212 for the minus.
pub(crate) fn number_of(word: &str) -> Option<f64> {
    word.parse().ok().or_else(|| {
        let has_one_comma = word.matches(',').count() == 1 && !word.contains('.');
        let plain = word.replace('\u{2212}', "-");
        if has_one_comma { plain.replace(',', ".") } else { plain }.parse().ok()
    })
}

/// The numbers of a line, exactly `N`.
pub(crate) fn numbers_of<const N: usize>(line: &str, path: &str, at: usize) -> Result<[f64; N]> {
    let wrong = || {
        let shown: String = line.chars().take(60).collect();
        Error::invalid(format!("{path}: line {at} must be {N} numbers, it is {shown:?}"))
    };
    numbers(line).and_then(|numbers| numbers.try_into().ok()).ok_or_else(wrong)
}
