//! Which photos are turned as their EXIF orientation says.
//!
//! COLMAP takes pixels as stored; OpenCV, and programs that read photos with it, turn them first.
//! The cameras of a capture are of one kind or the other. The sizes of the cameras say of which,
//! where photos stand upright after a quarter turn. Where they do not, the pixels say: as stored
//! and turned, neighbouring photos are compared under the given cameras.

use std::sync::atomic::AtomicBool;

use image::metadata::Orientation;

use super::decode::Header;
use crate::{
    capture,
    error::{Result, short},
    formats::captures::{Lens, Sizes},
    scene::{PosedPhoto, Warning, WarningCode},
};

/// Longer side of photos that are compared, pixels.
pub(super) const SIDE_COMPARED: u32 = 256;
/// What agrees on this share at least, and on this many times as much as the other and this much
/// more, is right. Half a turn keeps the lines on which matches lie and agrees with much: of the
/// generated room 63 % where the upright photos agree on 87 %.
const AGREEMENT_MIN: f64 = 0.15;
const AGREEMENT_RATIO: f64 = 1.2;
const AGREEMENT_GAIN: f64 = 0.08;

/// Which way of reading a photo with an EXIF orientation the size of its camera speaks for.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Way {
    Stored,
    Turned,
    Either,
}

/// The way of a photo; none where its EXIF says nothing.
pub(super) fn way(header: &Header, lens: &Lens) -> Option<Way> {
    if header.orientation == Orientation::NoTransforms {
        return None;
    }
    let fits = |turn| lens.sizes(header.size_after(turn)) != Sizes::Contradict;
    Some(match [Orientation::NoTransforms, header.orientation].map(fits) {
        [false, true] => Way::Turned,
        // Where neither fits, the size as stored is named.
        [true, false] | [false, false] => Way::Stored,
        [true, true] => Way::Either,
    })
}

/// Whether photos that fit their cameras both ways are turned, and a warning of what was done or is
/// not known. `read` gives all photos at [`SIDE_COMPARED`] with those turned or not.
pub(super) fn settled(
    names: &[&str],
    ways: &[Option<Way>],
    read: impl Fn(bool) -> Result<Vec<PosedPhoto>>,
    cancel: &AtomicBool,
) -> Result<(bool, Option<Warning>)> {
    let count = |wanted: Way| ways.iter().filter(|way| **way == Some(wanted)).count();
    let [stored, turned, either] = [Way::Stored, Way::Turned, Way::Either].map(count);
    let (is_turned, why) = match (stored > 0, turned > 0) {
        _ if stored + turned + either == 0 => return Ok((false, None)),
        (true, false) => return Ok((false, None)),
        (false, true) => (true, "by their sizes the cameras are those of the upright photos"),
        _ if either == 0 => (false, "by their sizes the cameras are those of the upright photos"),
        _ => {
            let share = |turned| capture::agreement(&read(turned)?, cancel);
            let (stored, turned) = (share(false)?, share(true)?);
            if is_clear(stored, turned) {
                return Ok((false, None));
            }
            let is_turned = is_clear(turned, stored);
            let done = if is_turned { "were turned" } else { "were left as stored" };
            let why = format!(
                "{done}: neighbouring photos agree on {:.0} % of their matchable pixels turned \
                 and on {:.0} % as stored",
                100.0 * turned,
                100.0 * stored
            );
            return Ok((is_turned, warned(names, ways, true, &why)));
        }
    };
    Ok((is_turned, warned(names, ways, is_turned, &format!("were turned: {why}"))))
}

fn is_clear(share: f64, other: f64) -> bool {
    let gain = AGREEMENT_GAIN.max((AGREEMENT_RATIO - 1.0) * other);
    share >= AGREEMENT_MIN && share >= other + gain
}

/// Names the photos that are turned by their sizes, and the others with an orientation where `all`.
fn warned(names: &[&str], ways: &[Option<Way>], all: bool, why: &str) -> Option<Warning> {
    let is_meant =
        |way: &Option<Way>| *way == Some(Way::Turned) || all && *way == Some(Way::Either);
    let meant: Vec<&str> =
        names.iter().zip(ways).filter(|(_, w)| is_meant(w)).map(|(n, _)| *n).collect();
    let first = short(meant.first()?);
    let (count, of) = (meant.len(), names.len());
    let message =
        format!("{count} of {of} photos, as {first:?}, have an EXIF orientation and {why}");
    Some(Warning { code: WarningCode::PhotosTurned, message, value: count as f64 })
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    #[test]
    fn sizes_settle_it_before_pixels() {
        let settle = |ways: &[Option<Way>]| {
            let asked = Cell::new(false);
            let read = |_| {
                asked.set(true);
                Ok(Vec::new())
            };
            let names = vec!["a.jpg"; ways.len()];
            let found = settled(&names, ways, read, &AtomicBool::new(false));
            (found.map(|(turned, warning)| (turned, warning.map(|w| w.value))).ok(), asked.get())
        };
        let [stored, turned, either] = [Way::Stored, Way::Turned, Way::Either].map(Some);
        assert_eq!(settle(&[None, None]), (Some((false, None)), false));
        assert_eq!(settle(&[stored, either, None]), (Some((false, None)), false));
        assert_eq!(settle(&[turned, either, None]), (Some((true, Some(2.0))), false));
        assert_eq!(settle(&[turned, stored]), (Some((false, Some(1.0))), false));
        assert!(settle(&[either, None]).1, "pixels are asked where sizes say nothing");
        assert!(settle(&[either, stored, turned]).1);
    }

    #[test]
    fn one_way_wins_when_it_is_clearly_better() {
        assert!(is_clear(0.87, 0.63) && is_clear(0.2, 0.1));
        assert!(!is_clear(0.14, 0.0) && !is_clear(0.5, 0.43) && !is_clear(0.17, 0.1));
    }
}
