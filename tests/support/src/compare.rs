//! Compares the pictures of two renderers. Pixels may differ only at cliffs of the oracle, and
//! those are counted and few. Also compares gradients.

use segsplat_render::{Frame, backward::Gradients, oracle::OraclePixel};

/// How far two pictures may be apart.
#[derive(Clone, Copy, Debug)]
pub struct Tolerance {
    /// Largest |difference| of colour and alpha, and of depth relative to the reference.
    pub interior: f64,
    /// Largest share of pixels that may differ by more, all of them at a cliff.
    pub flips: f64,
    /// Largest mean difference of the pixels that differ by no more.
    pub mean: f64,
}

impl Tolerance {
    /// CPU against the oracle: f32 accumulation of a few hundred contributions stays under 1e-5;
    /// the bar leaves room for the longest needles.
    pub const ORACLE: Self = Self { interior: 2e-4, flips: 1e-3, mean: 2e-5 };
    /// GPU against CPU: less than one level of an 8-bit picture, and far less in the mean: measured
    /// 1e-6.
    pub const GPU: Self = Self { interior: 1.0 / 255.0, flips: 1e-3, mean: 1e-4 };
}

/// What a comparison found.
#[derive(Clone, Copy, Debug, Default)]
pub struct Difference {
    /// Pixels compared.
    pub pixels: usize,
    /// Pixels apart by more than the tolerance, all at a cliff.
    pub flips: usize,
    /// Largest difference of the other pixels.
    pub max: f64,
    /// Mean difference of all pixels (the largest of each pixel's channels).
    pub mean: f64,
}

/// A pixel in comparable form.
#[derive(Clone, Copy, Debug)]
pub struct Sample {
    /// Colour, three channels.
    pub color: [f64; 3],
    /// Expected depth.
    pub depth: f64,
    /// Alpha.
    pub alpha: f64,
}

/// Largest difference over the channels; NaN counts as infinitely far.
fn apart(got: &Sample, want: &Sample) -> f64 {
    // Of the depth itself, so that it holds for scenes of any size.
    let scale = want.depth.abs().max(f64::MIN_POSITIVE);
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
pub fn compare(
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
    let mut inside = 0.0;
    for (i, (got, want)) in got.iter().zip(want).enumerate() {
        let difference = apart(got, want);
        found.mean += difference / want_len(found.pixels);
        if difference <= tolerance.interior {
            found.max = found.max.max(difference);
            inside += difference / want_len(found.pixels);
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
    if inside > tolerance.mean {
        return Err(format!("off by {inside:.3e} in the mean, over {:.0e}", tolerance.mean));
    }
    Ok(found)
}

fn want_len(pixels: usize) -> f64 {
    pixels.max(1) as f64
}

/// Samples of a frame with all kinds, row-major.
pub fn samples(frame: &Frame) -> Vec<Sample> {
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
pub fn oracle_samples(pixels: &[OraclePixel]) -> Vec<Sample> {
    pixels.iter().map(|p| Sample { color: p.color, depth: p.depth, alpha: p.alpha }).collect()
}

/// Relative errors of all derivatives that are over 1e-6 of the largest of their kind, sorted: of
/// numbers under that, sums in f32 hold few digits. Each axis is a kind: the long one of needles
/// has derivatives of another size than the short ones.
pub fn gradient_errors<T: Copy + Into<f64>>(got: &Gradients, want: &Gradients<T>) -> Vec<f64> {
    fn axes<T: Copy + Into<f64>, const N: usize>(
        got: &[[f32; N]],
        want: &[[T; N]],
        errors: &mut Vec<f64>,
    ) {
        for axis in 0..N {
            let most = want.iter().fold(0.0_f64, |most, want| most.max(want[axis].into().abs()));
            let both = got.iter().zip(want);
            let both = both.map(|(got, want)| (f64::from(got[axis]), want[axis].into()));
            let counted = both.filter(|(_, want)| want.abs() > 1e-6 * most);
            errors.extend(counted.map(|(got, want)| (got - want).abs() / want.abs()));
        }
    }
    let mut errors = Vec::new();
    axes(&got.means, &want.means, &mut errors);
    axes(&got.quats, &want.quats, &mut errors);
    axes(&got.scales, &want.scales, &mut errors);
    let (got_opacities, _) = got.opacities.as_chunks::<1>();
    let (want_opacities, _) = want.opacities.as_chunks::<1>();
    axes(got_opacities, want_opacities, &mut errors);
    axes(&got.sh, &want.sh, &mut errors);
    errors.sort_by(f64::total_cmp);
    errors
}
