//! How much memory photos take: the size at which they are kept, and how many are decoded together.

use std::ops::Range;

use crate::limits::Limits;

/// Photos of the largest size that are decoded at the same time, some 7 bytes a pixel each.
const DECODED_TOGETHER: u64 = 2;

/// Longer side at which the photos of a scene are kept, so that all of them fit the limits.
pub(super) fn side_kept(sizes: &[[u32; 2]], limits: &Limits) -> u32 {
    let side_max = f64::from(limits.photo_side_kept_max);
    let pixels = |side: f64| -> f64 {
        let of = |&[w, h]: &[u32; 2]| {
            let share = (side / f64::from(w.max(h))).min(1.0);
            f64::from(w) * f64::from(h) * share * share
        };
        sizes.iter().map(of).sum()
    };
    let most = limits.photos_pixels_kept_max as f64;
    let (mut fits, mut over) = (1.0, side_max);
    if pixels(side_max) <= most {
        return limits.photo_side_kept_max;
    }
    // Photos of one scene may differ in size, so no formula gives it.
    while over - fits >= 1.0 {
        let middle = 0.5 * (fits + over);
        if pixels(middle) <= most { fits = middle } else { over = middle }
    }
    #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "1 to a u32")]
    let side = fits as u32;
    side
}

/// Photos one after another in groups that are decoded side by side, by their pixels: those of a
/// group are at most [`DECODED_TOGETHER`] of the largest photos that may come.
pub(super) fn decoded_together(sizes: &[u64], photo_pixels_max: u64) -> Vec<Range<usize>> {
    let (mut groups, mut begun, mut pixels): (Vec<Range<usize>>, usize, u64) = (Vec::new(), 0, 0);
    for (i, own) in sizes.iter().enumerate() {
        if i > begun && pixels + own > DECODED_TOGETHER.saturating_mul(photo_pixels_max) {
            groups.push(begun..i);
            (begun, pixels) = (i, 0);
        }
        pixels += own;
    }
    groups.push(begun..sizes.len());
    groups
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn photos_of_a_scene_are_reduced_alike_until_they_fit() {
        let limits = Limits::default();
        let kept = |sizes: &[[u32; 2]]| side_kept(sizes, &limits);
        assert_eq!(kept(&[[6_000, 4_000]; 16]), 2_048, "sixteen fit");
        assert_eq!(kept(&[[640, 480]; 64]), 2_048, "and small ones stay as they are");
        for sizes in
            [vec![[6_000, 4_000]; 64], [vec![[4_000, 6_000]; 60], vec![[9, 9]; 4]].concat()]
        {
            let side = f64::from(kept(&sizes));
            let pixels = |side: f64| -> f64 {
                let share = |[w, h]: &[u32; 2]| (side / f64::from(*w.max(h))).min(1.0);
                sizes.iter().map(|s| f64::from(s[0] * s[1]) * share(s).powi(2)).sum()
            };
            let most = limits.photos_pixels_kept_max as f64;
            assert!(pixels(side) <= most && pixels(side + 2.0) > most, "{side}");
        }
        let tight = Limits { photos_pixels_kept_max: 0, ..limits };
        assert_eq!(side_kept(&[[600, 400]; 3], &tight), 1, "never 0");
    }

    #[test]
    fn no_more_than_two_of_the_largest_photos_are_decoded_together() {
        let groups = |sizes: &[u64]| decoded_together(sizes, 100);
        assert_eq!(groups(&[100; 5]), [0..2, 2..4, 4..5]);
        assert_eq!(groups(&[25; 9]), [0..8, 8..9], "small ones side by side");
        assert_eq!(groups(&[900, 1]), [0..1, 1..2], "one over the bound goes alone");
    }
}
