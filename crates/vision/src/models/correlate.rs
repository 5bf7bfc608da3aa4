//! The plane sweep's inner product as one operator of the CPU's geometry file,
//! `segsplat:Correlate`: what `GridSample`, `Mul` and `ReduceSum` do, without the samples ever
//! being in memory (100 MB for two views, written and read three times).
//!
//! | input | shape | |
//! |---|---|---|
//! | `source` | `[M, C, h, w]` | features that are sampled |
//! | `own` | `[B, C, P]` | features of the pixels; row m of `source` belongs to row m / (M / B) |
//! | `x`, `y` | `[M, D, P]` | where, -1 to 1 from edge to edge; outside all is 0 |
//!
//! The output is `[M, groups, D, P]`: the product over each of the `groups` equal parts of C.

use ort::{
    operator::{
        BoxedKernel, ComputeContext, KernelContext, Operator, OperatorDomain, OperatorInput,
        OperatorOutput,
    },
    value::TensorElementType,
};
use rayon::prelude::*;

/// Channels that are summed side by side.
const LANES: usize = 8;

/// The operators of this program's own files.
pub(super) fn domain() -> ort::Result<OperatorDomain> {
    OperatorDomain::new("segsplat")?.add(Correlate)
}

struct Correlate;

impl Operator for Correlate {
    type Kernel<'attr> = BoxedKernel<'attr>;

    fn name(&self) -> &'static str {
        "Correlate"
    }

    fn inputs(&self) -> impl IntoIterator<Item = OperatorInput> {
        (0..4).map(|_| OperatorInput::required(TensorElementType::Float32))
    }

    fn outputs(&self) -> impl IntoIterator<Item = OperatorOutput> {
        [OperatorOutput::required(TensorElementType::Float32)]
    }

    fn create_kernel<'attr>(
        &self,
        context: &KernelContext<'attr>,
    ) -> ort::Result<BoxedKernel<'attr>> {
        let groups = context.get::<i64>("groups").and_then(|n| usize::try_from(n).ok());
        let groups = groups.filter(|&n| n > 0).ok_or_else(|| ort::Error::new("groups"))?;
        Ok(Box::new(move |context: &ComputeContext| compute(context, groups)))
    }
}

fn compute(context: &ComputeContext, groups: usize) -> ort::Result<()> {
    let missing = || ort::Error::new("Correlate: an input is missing");
    let (source, own) =
        (context.input(0)?.ok_or_else(missing)?, context.input(1)?.ok_or_else(missing)?);
    let (x, y) = (context.input(2)?.ok_or_else(missing)?, context.input(3)?.ok_or_else(missing)?);
    let (shape, source) = source.try_extract_tensor::<f32>()?;
    let (own_shape, own) = own.try_extract_tensor::<f32>()?;
    let (at_shape, x) = x.try_extract_tensor::<f32>()?;
    let (_, y) = y.try_extract_tensor::<f32>()?;
    let sizes = |shape: &[i64]| -> Vec<usize> {
        shape.iter().map(|&n| usize::try_from(n).unwrap_or(0)).collect()
    };
    let (shape, own_shape, at_shape) = (sizes(shape), sizes(own_shape), sizes(at_shape));
    let (&[maps, channels, height, width], &[views, .., _], &[_, depths, pixels]) =
        (&shape[..], &own_shape[..], &at_shape[..])
    else {
        return Err(ort::Error::new("Correlate: wrong number of dimensions"));
    };
    let fits = source.len() == maps * channels * height * width
        && own.len() == views * channels * pixels
        && x.len() == maps * depths * pixels
        && y.len() == x.len()
        && views > 0
        && maps.is_multiple_of(views)
        && channels.is_multiple_of(groups * LANES)
        && height * width > 0;
    if !fits {
        return Err(ort::Error::new("Correlate: shapes do not fit"));
    }
    let shape = [maps, groups, depths, pixels].map(|n| i64::try_from(n).unwrap_or(0));
    let mut found = context.output(0, shape)?.ok_or_else(missing)?;
    let (_, found) = found.try_extract_tensor_mut::<f32>()?;
    let job =
        Job { source, own, x, y, maps, views, channels, groups, depths, pixels, height, width };
    job.run(found);
    Ok(())
}

struct Job<'a> {
    source: &'a [f32],
    own: &'a [f32],
    x: &'a [f32],
    y: &'a [f32],
    maps: usize,
    views: usize,
    channels: usize,
    groups: usize,
    depths: usize,
    pixels: usize,
    height: usize,
    width: usize,
}

impl Job<'_> {
    fn run(&self, found: &mut [f32]) {
        let (area, each) = (self.height * self.width, self.groups * self.depths * self.pixels);
        if each == 0 {
            return;
        }
        // Channels last, so that a corner is one run of memory.
        let source = last(self.source, self.channels, area);
        let own = last(self.own, self.channels, self.pixels);
        let plane = self.depths * self.pixels;
        for (m, found) in found.chunks_exact_mut(each).enumerate().take(self.maps) {
            let view = m / (self.maps / self.views);
            let source = &source[m * area * self.channels..(m + 1) * area * self.channels];
            let own = &own[view * self.pixels * self.channels..];
            // One row of the output a depth and group; a task takes all groups of a depth.
            let mut rows: Vec<Vec<&mut [f32]>> = (0..self.depths).map(|_| Vec::new()).collect();
            for (at, row) in found.chunks_exact_mut(self.pixels).enumerate() {
                rows[at % self.depths].push(row);
            }
            rows.par_iter_mut().enumerate().for_each(|(depth, rows)| {
                let at = m * plane + depth * self.pixels;
                let places = self.x[at..].iter().zip(&self.y[at..]);
                let pixels = own.chunks_exact(self.channels).zip(places).take(self.pixels);
                for (pixel, (own, (&x, &y))) in pixels.enumerate() {
                    let corners = self.corners(x, y);
                    for (group, row) in rows.iter_mut().enumerate() {
                        row[pixel] = self.product(source, own, corners, group);
                    }
                }
            });
        }
    }

    /// Index of the pixel and weight of each corner around a place; weight 0 outside.
    fn corners(&self, x: f32, y: f32) -> [(usize, f32); 4] {
        let place = |at: f32, size: usize| ((at + 1.0) * size as f32 - 1.0) * 0.5;
        let (x, y) = (place(x, self.width), place(y, self.height));
        let (left, top) = (x.floor(), y.floor());
        let (right, low) = (x - left, y - top);
        #[expect(clippy::cast_possible_truncation, reason = "a cast to i32 saturates")]
        let (left, top) = (left as i32, top as i32);
        let corner = |dx: i32, dy: i32, weight: f32| {
            let (x, y) = (left.saturating_add(dx), top.saturating_add(dy));
            match (usize::try_from(x), usize::try_from(y)) {
                (Ok(x), Ok(y)) if x < self.width && y < self.height => (y * self.width + x, weight),
                _ => (0, 0.0),
            }
        };
        [
            corner(0, 0, (1.0 - right) * (1.0 - low)),
            corner(1, 0, right * (1.0 - low)),
            corner(0, 1, (1.0 - right) * low),
            corner(1, 1, right * low),
        ]
    }

    /// The sample at the corners times the own features, over the channels of one group.
    fn product(
        &self,
        source: &[f32],
        own: &[f32],
        corners: [(usize, f32); 4],
        group: usize,
    ) -> f32 {
        let size = self.channels / self.groups;
        let part = |pixel: usize| {
            let at = pixel * self.channels + group * size;
            source[at..at + size].as_chunks::<LANES>().0
        };
        let [a, b, c, d] = corners.map(|(pixel, _)| part(pixel));
        let [wa, wb, wc, wd] = corners.map(|(_, weight)| weight);
        let own = own[group * size..(group + 1) * size].as_chunks::<LANES>().0;
        let mut sums = [0.0_f32; LANES];
        for ((((own, a), b), c), d) in own.iter().zip(a).zip(b).zip(c).zip(d) {
            for l in 0..LANES {
                sums[l] += own[l] * (wa * a[l] + wb * b[l] + wc * c[l] + wd * d[l]);
            }
        }
        sums.iter().sum()
    }
}

/// `[N, channels, area]` to `[N, area, channels]`.
fn last(data: &[f32], channels: usize, area: usize) -> Vec<f32> {
    let mut turned = vec![0.0; data.len()];
    let pixels = turned.par_chunks_exact_mut(area * channels);
    pixels.zip(data.par_chunks_exact(area * channels)).for_each(|(turned, data)| {
        for (pixel, row) in turned.chunks_exact_mut(channels).enumerate() {
            for (value, plane) in row.iter_mut().zip(data.chunks_exact(area)) {
                *value = plane[pixel];
            }
        }
    });
    turned
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers without a pattern, -1 to 1.
    fn numbers(count: usize, seed: u32) -> Vec<f32> {
        let mut state = seed;
        let mut next = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            f64::from(state) / f64::from(u32::MAX) * 2.0 - 1.0
        };
        #[expect(clippy::cast_possible_truncation, reason = "a test's numbers")]
        (0..count).map(|_| next() as f32).collect()
    }

    #[test]
    fn it_is_the_product_with_the_bilinear_sample() {
        let (maps, views, channels, groups, depths, height, width) = (4, 2, 16, 2, 3, 5, 7);
        let pixels = 11;
        let (source, own) =
            (numbers(maps * channels * height * width, 1), numbers(views * channels * pixels, 2));
        // Some of the places lie outside.
        let wide = |seed| -> Vec<f32> {
            numbers(maps * depths * pixels, seed).iter().map(|v| v * 1.5).collect()
        };
        let (x, y) = (wide(3), wide(4));
        let job = Job {
            source: &source,
            own: &own,
            x: &x,
            y: &y,
            maps,
            views,
            channels,
            groups,
            depths,
            pixels,
            height,
            width,
        };
        let mut found = vec![f32::NAN; maps * groups * depths * pixels];
        job.run(&mut found);
        let sample = |m: usize, c: usize, x: f64, y: f64| {
            let (x, y) =
                (((x + 1.0) * width as f64 - 1.0) / 2.0, ((y + 1.0) * height as f64 - 1.0) / 2.0);
            let mut sum = 0.0;
            for (row, column) in (0..height).flat_map(|r| (0..width).map(move |c| (r, c))) {
                let weight = (1.0 - (x - column as f64).abs()).max(0.0)
                    * (1.0 - (y - row as f64).abs()).max(0.0);
                let at = ((m * channels + c) * height + row) * width + column;
                sum += weight * f64::from(source[at]);
            }
            sum
        };
        for (at, value) in found.iter().enumerate() {
            let (pixel, rest) = (at % pixels, at / pixels);
            let (depth, rest) = (rest % depths, rest / depths);
            let (group, m) = (rest % groups, rest / groups);
            let place = (m * depths + depth) * pixels + pixel;
            let size = channels / groups;
            let wanted: f64 = (group * size..(group + 1) * size)
                .map(|c| {
                    let own = own[((m / 2) * channels + c) * pixels + pixel];
                    f64::from(own) * sample(m, c, f64::from(x[place]), f64::from(y[place]))
                })
                .sum();
            assert!((f64::from(*value) - wanted).abs() < 1e-5, "{at}: {value}, not {wanted}");
        }
    }
}
