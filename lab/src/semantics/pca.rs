//! Rows of many numbers as colours: their three principal components, as figures of papers show
//! features.

use rayon::prelude::*;

/// Rows that the components are found from, evenly spread: more change no colour that one sees.
const SEEN_MAX: usize = 4_096;
/// Steps of the iteration; three components of a picture need some ten.
const STEPS: usize = 60;
/// Percentiles of a component that become 0 and 1.
const ENDS: [usize; 2] = [2, 98];

/// Colours of 0 to 1 of `count` rows; a row that is `None` is black. Red is the component in which
/// rows differ most, then green, then blue. The same rows get the same colours on every machine.
pub fn colours(count: usize, row: impl Fn(usize) -> Option<Vec<f32>> + Sync) -> Vec<[f32; 3]> {
    let seen: Vec<Vec<f32>> =
        (0..count).step_by(count.div_ceil(SEEN_MAX).max(1)).filter_map(&row).collect();
    let Some(dim) = seen.first().map(Vec::len) else { return vec![[0.0; 3]; count] };
    let mut mean = vec![0.0_f64; dim];
    for row in &seen {
        mean.iter_mut().zip(row).for_each(|(sum, v)| *sum += f64::from(*v) / seen.len() as f64);
    }
    let axes = components(&seen, &mean);
    let place = |row: Vec<f32>| axes.each_ref().map(|axis| dot(&centred(&row, &mean), axis));
    let places: Vec<Option<[f64; 3]>> =
        (0..count).into_par_iter().map(|i| row(i).map(place)).collect();
    let scales = [0, 1, 2].map(|c| {
        let mut all: Vec<f64> = places.iter().flatten().map(|place| place[c]).collect();
        all.sort_by(f64::total_cmp);
        let [low, high] = ENDS.map(|percent| all[(all.len() - 1) * percent / 100]);
        (low, high - low)
    });
    #[expect(clippy::cast_possible_truncation, reason = "0 to 1")]
    let shown = |place: [f64; 3]| {
        [0, 1, 2].map(|c| {
            let (low, range) = scales[c];
            // A component in which nothing differs is neither bright nor dark.
            if range > 1e-9 { ((place[c] - low) / range).clamp(0.0, 1.0) as f32 } else { 0.5 }
        })
    };
    places.into_iter().map(|place| place.map_or([0.0; 3], shown)).collect()
}

/// Three unit axes in which rows differ most, by orthogonal iteration. Their largest number is
/// positive.
fn components(rows: &[Vec<f32>], mean: &[f64]) -> [Vec<f64>; 3] {
    let dim = mean.len();
    // No axis is special: none is at a right angle to all of these.
    let first = |c: usize| -> Vec<f64> {
        (0..dim).map(|i| ((i * 3 + c + 1) as f64 * 0.754_877_666).fract() - 0.5).collect()
    };
    let mut axes = orthonormal([first(0), first(1), first(2)]);
    for _ in 0..STEPS {
        let sum = || [(); 3].map(|()| vec![0.0_f64; dim]);
        let next = rows
            .par_chunks(64)
            .map(|rows| {
                let mut next = sum();
                for row in rows {
                    let row = centred(row, mean);
                    for (next, axis) in next.iter_mut().zip(&axes) {
                        let along = dot(&row, axis);
                        next.iter_mut().zip(&row).for_each(|(sum, v)| *sum += along * v);
                    }
                }
                next
            })
            // In order, so that sums have the same bits on any number of threads.
            .collect::<Vec<_>>()
            .into_iter()
            .fold(sum(), |mut all, part| {
                for (all, part) in all.iter_mut().flatten().zip(part.iter().flatten()) {
                    *all += part;
                }
                all
            });
        axes = orthonormal(next);
    }
    axes.map(|axis| {
        let largest = axis.iter().copied().max_by(|a, b| a.abs().total_cmp(&b.abs()));
        let sign = largest.unwrap_or(1.0).signum();
        axis.into_iter().map(|v| v * sign).collect()
    })
}

/// Gram-Schmidt; an axis without length stays zero.
fn orthonormal(mut axes: [Vec<f64>; 3]) -> [Vec<f64>; 3] {
    for c in 0..3 {
        for other in 0..c {
            let along = dot(&axes[c], &axes[other]);
            let earlier = axes[other].clone();
            axes[c].iter_mut().zip(earlier).for_each(|(v, of)| *v -= along * of);
        }
        let length = dot(&axes[c], &axes[c]).sqrt();
        if length > 1e-12 {
            axes[c].iter_mut().for_each(|v| *v /= length);
        } else {
            axes[c].fill(0.0);
        }
    }
    axes
}

fn centred(row: &[f32], mean: &[f64]) -> Vec<f64> {
    row.iter().zip(mean).map(|(v, mean)| f64::from(*v) - mean).collect()
}

fn dot(a: &[f64], b: &[f64]) -> f64 {
    a.iter().zip(b).map(|(a, b)| a * b).sum()
}
