//! Contexts of masks: the oracle counts points of a grid that both grids divide.

use segsplat_core::scene::{DenseFeatures, IndexMap, MaskInfo, PhotoMasks};
use segsplat_vision::semantics::{add_context, contexts};

const DIM: usize = 3;

/// 7 x 5 cells under three masks; the last has none.
fn masks() -> PhotoMasks {
    let index = (0..35_u16).map(|i| (i * 5 + i / 7) % 3).collect();
    PhotoMasks {
        map: IndexMap { width: 7, height: 5, index },
        masks: vec![MaskInfo::default(); 3],
        wholes: Vec::new(),
    }
}

/// 4 x 3 cells.
fn features() -> DenseFeatures {
    let data = (0..DIM * 12).map(|i| ((i * 7 % 11) as f32 - 4.0) * 0.3).collect();
    DenseFeatures { columns: 4, rows: 3, data }
}

/// Mean of the features at 28 x 15 points, length 1.
fn oracle(features: &DenseFeatures, inside: impl Fn(usize) -> bool) -> [f32; DIM] {
    let mut sum = [0.0_f64; DIM];
    for (x, y) in (0..15).flat_map(|y| (0..28).map(move |x| (x, y))) {
        if inside(y / 3 * 7 + x / 4) {
            let cell = y / 5 * 4 + x / 7;
            (0..DIM).for_each(|d| sum[d] += f64::from(features.data[d * 12 + cell]));
        }
    }
    let length = sum.iter().map(|v| v * v).sum::<f64>().sqrt();
    sum.map(|v| if length > 0.0 { (v / length) as f32 } else { 0.0 })
}

fn near(found: &[f32], wanted: [f32; DIM]) {
    let same = found.iter().zip(wanted).all(|(a, b)| (a - b).abs() < 1e-6);
    assert!(same && found.len() == DIM, "{found:?}, not {wanted:?}");
}

#[test]
fn a_context_is_the_mean_under_the_mask_by_the_share_of_each_cell() {
    let (features, masks) = (features(), masks());
    let found = contexts(&features, &masks);
    for (mask, found) in (1..).zip(found.chunks(DIM)) {
        near(found, oracle(&features, |cell| masks.map.index[cell] == mask));
    }
    assert_eq!(found[6..], [0.0; 3], "a mask without cells");
    assert_eq!(contexts(&features, &PhotoMasks::default()), Vec::<f32>::new());
}

#[test]
fn masks_that_come_whole_are_taken_whole() {
    let features = features();
    let wholes = vec![vec![[0, 3], [9, 2]], vec![[2, 30]], Vec::new()];
    let found = contexts(&features, &PhotoMasks { wholes, ..masks() });
    near(&found[..3], oracle(&features, |cell| cell < 3 || (9..11).contains(&cell)));
    near(&found[3..6], oracle(&features, |cell| (2..32).contains(&cell)));
}

#[test]
fn crop_and_context_are_summed_at_length_1() {
    let mut row = [1.0, 0.0, 0.0];
    add_context(&mut row, &[0.0, 1.0, 0.0], 0.75);
    near(&row, [0.8, 0.6, 0.0]);
    add_context(&mut row, &[0.0; 3], 2.0);
    near(&row, [0.8, 0.6, 0.0]);
    let mut opposite = [1.0, 0.0, 0.0];
    add_context(&mut opposite, &[-1.0, 0.0, 0.0], 1.0);
    assert_eq!(opposite, [1.0, 0.0, 0.0], "a sum of no length stays the crop's");
}
