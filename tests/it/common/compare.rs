//! One comparer for all renderers: strict inside, flips at a cliff counted, no flip without one.
#![allow(dead_code, reason = "shared by tests and benchmarks, each of which uses a part")]

use segsplat::render::{Frame, oracle::OraclePixel};

/// How far two pictures may be apart.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Tolerance {
    /// Largest |difference| of colour and alpha, and of depth relative to the reference.
    pub(crate) interior: f64,
    /// Largest share of pixels that may differ by more, all of them at a cliff.
    pub(crate) flips: f64,
}

impl Tolerance {
    /// CPU against the oracle: f32 accumulation of a few hundred contributions stays under 1e-5;
    /// the bar leaves room for the longest needles.
    pub(crate) const ORACLE: Self = Self { interior: 2e-4, flips: 1e-3 };
    /// GPU against CPU: less than one level of an 8-bit picture.
    pub(crate) const GPU: Self = Self { interior: 1.0 / 255.0, flips: 1e-3 };
}

/// What a comparison found.
#[derive(Clone, Copy, Debug, Default)]
pub(crate) struct Difference {
    /// Pixels compared.
    pub(crate) pixels: usize,
    /// Pixels apart by more than the tolerance, all at a cliff.
    pub(crate) flips: usize,
    /// Largest difference of the other pixels.
    pub(crate) max: f64,
    /// Mean difference of all pixels (the largest of each pixel's channels).
    pub(crate) mean: f64,
}

/// A pixel in comparable form.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Sample {
    /// Colour, three channels.
    pub(crate) color: [f64; 3],
    /// Expected depth.
    pub(crate) depth: f64,
    /// Alpha.
    pub(crate) alpha: f64,
}

/// Largest difference over the channels; NaN counts as infinitely far.
fn apart(got: &Sample, want: &Sample) -> f64 {
    let scale = want.depth.abs().max(1.0);
    let channels = [
        got.color[0] - want.color[0],
        got.color[1] - want.color[1],
        got.color[2] - want.color[2],
        got.alpha - want.alpha,
        (got.depth - want.depth) / scale,
    ];
    channels.iter().fold(0.0, |worst, difference| {
        if difference.is_nan() { f64::INFINITY } else { worst.max(difference.abs()) }
    })
}

/// Compares pixel by pixel; `cliff[i]` says that pixel i may flip.
///
/// # Errors
/// A sentence that names the first pixel at fault, or the share of flips.
pub(crate) fn compare(
    got: &[Sample],
    want: &[Sample],
    cliff: &[bool],
    tolerance: Tolerance,
) -> Result<Difference, String> {
    if got.len() != want.len() || cliff.len() != want.len() {
        return Err(format!("{} pixels against {}", got.len(), want.len()));
    }
    let mut found = Difference { pixels: got.len(), ..Difference::default() };
    let mut worst = None;
    for (i, (got, want)) in got.iter().zip(want).enumerate() {
        let difference = apart(got, want);
        found.mean += difference / want_len(found.pixels);
        if difference <= tolerance.interior {
            found.max = found.max.max(difference);
        } else if cliff[i] && difference.is_finite() {
            found.flips += 1;
        } else if worst.is_none_or(|(_, before)| difference > before) {
            worst = Some((i, difference));
        }
    }
    if let Some((i, difference)) = worst {
        return Err(format!(
            "pixel {i} is off by {difference:.3e} and not at a cliff: {:?}, not {:?}",
            got[i], want[i]
        ));
    }
    let share = found.flips as f64 / want_len(found.pixels);
    if share > tolerance.flips {
        return Err(format!("{} of {} pixels flipped", found.flips, found.pixels));
    }
    Ok(found)
}

fn want_len(pixels: usize) -> f64 {
    pixels.max(1) as f64
}

/// Samples of a frame with all kinds, row-major.
pub(crate) fn samples(frame: &Frame) -> Vec<Sample> {
    let (color, depth, alpha) = (
        frame.color.as_ref().expect("a frame with colour"),
        frame.depth.as_ref().expect("a frame with depth"),
        frame.alpha.as_ref().expect("a frame with alpha"),
    );
    (0..color.len())
        .map(|i| Sample {
            color: color[i].map(f64::from),
            depth: f64::from(depth[i]),
            alpha: f64::from(alpha[i]),
        })
        .collect()
}

/// Samples of the oracle's pixels.
pub(crate) fn oracle_samples(pixels: &[OraclePixel]) -> Vec<Sample> {
    pixels.iter().map(|p| Sample { color: p.color, depth: p.depth, alpha: p.alpha }).collect()
}

#[test]
fn two_different_images_must_fail() {
    let grey = |v: f64| Sample { color: [v; 3], depth: 1.0, alpha: 1.0 };
    let want = vec![grey(0.5); 2_000];
    let none = vec![false; 2_000];
    let ok = compare(&want, &want, &none, Tolerance::ORACLE).expect("the same picture");
    assert_eq!((ok.flips, ok.max), (0, 0.0), "the same picture");

    for (name, bad) in [
        ("colour", Sample { color: [0.5, 0.5, 0.501], ..grey(0.5) }),
        ("depth", Sample { depth: 1.001, ..grey(0.5) }),
        ("alpha", Sample { alpha: 0.99, ..grey(0.5) }),
        ("NaN", Sample { depth: f64::NAN, ..grey(0.5) }),
    ] {
        let mut got = want.clone();
        got[77] = bad;
        let told = compare(&got, &want, &none, Tolerance::ORACLE).expect_err(name);
        assert!(told.starts_with("pixel 77"), "{name}: {told}");
    }
    compare(&want[1..], &want, &none, Tolerance::ORACLE).expect_err("another size");
}

#[test]
fn flips_are_counted_at_cliffs_only_and_few() {
    let pixel = Sample { color: [0.5; 3], depth: 1.0, alpha: 1.0 };
    let want = vec![pixel; 2_000];
    let mut got = want.clone();
    let mut cliff = vec![false; 2_000];
    for i in [3, 4] {
        got[i].alpha = 0.9;
        cliff[i] = true;
    }
    let found = compare(&got, &want, &cliff, Tolerance::ORACLE).expect("two of 2,000 may flip");
    assert_eq!(found.flips, 2, "flips");
    got[5].alpha = 0.9;
    cliff[5] = true;
    compare(&got, &want, &cliff, Tolerance::ORACLE).expect_err("three of 2,000 are too many");
    got[5] = pixel;
    got[4].alpha = f64::NAN;
    compare(&got, &want, &cliff, Tolerance::ORACLE).expect_err("a NaN is never a flip");
}
