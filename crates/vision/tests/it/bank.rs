//! The bank: rows, ties, and the same bits on any number of threads.

use std::collections::HashSet;

use segsplat_core::error::Result;
use segsplat_core::limits::BANK_ROWS_MAX;
use segsplat_testing::scenes::Random;
use segsplat_vision::semantics::{Clusters, bank, rows_wanted};

/// 1.2 rows for a mask of a photo.
fn clusters(features: &[f32], dim: usize, views: usize) -> Result<Clusters> {
    bank(features, dim, rows_wanted(features.len() / dim.max(1), views, 1.2))
}

/// `count` unit features of `dim` numbers around `groups` directions.
fn features(count: usize, dim: usize, groups: usize, spread: f64, seed: u64) -> Vec<f32> {
    let mut random = Random(seed);
    let mut share = || (random.bits() >> 11) as f64 / (1_u64 << 53) as f64;
    let mut normal = || (0..6).map(|_| share() - 0.5).sum::<f64>();
    let ways: Vec<Vec<f64>> = (0..groups).map(|_| (0..dim).map(|_| normal()).collect()).collect();
    (0..count)
        .flat_map(|i| {
            let row: Vec<f64> = ways[i % groups].iter().map(|v| v + spread * normal()).collect();
            let length = row.iter().map(|v| v * v).sum::<f64>().sqrt();
            row.into_iter().map(move |v| (v / length) as f32)
        })
        .collect()
}

fn threads(count: usize) -> rayon::ThreadPool {
    rayon::ThreadPoolBuilder::new().num_threads(count).build().unwrap()
}

#[test]
fn rows_are_1_2_times_the_masks_of_a_photo_rounded_up() {
    let cases = [(0, 2, 0), (1, 2, 1), (10, 2, 6), (40, 2, 24), (41, 2, 25), (5, 1, 6)];
    for (features, views, rows) in cases {
        assert_eq!(rows_wanted(features, views, 1.2), rows, "{features} of {views}");
    }
    assert_eq!(rows_wanted(1_000_000, 1, 1.2), BANK_ROWS_MAX);
}

#[test]
fn no_features_one_feature_and_equal_features_are_legal() {
    assert_eq!(clusters(&[], 8, 2).unwrap().bank.len(), 0);
    let one = clusters(&[0.6, 0.8], 2, 2).unwrap();
    assert_eq!((one.bank.rows, one.entries), (vec![0.6, 0.8], vec![1]));
    let equal = clusters(&[0.6, 0.8, 0.6, 0.8, 0.6, 0.8], 2, 1).unwrap();
    assert_eq!((equal.bank.len(), equal.entries), (1, vec![1, 1, 1]));
    let two = clusters(&[0.0, 1.0, -0.0, 1.0, 1.0, 0.0], 2, 1).unwrap();
    assert_eq!(two.bank.len(), 2, "-0 is 0");
}

#[test]
fn what_is_no_feature_is_refused() {
    assert!(clusters(&[0.5; 7], 3, 2).is_err() && clusters(&[0.5], 0, 2).is_err());
    let error = clusters(&[0.0, 1.0, f32::NAN, 1.0], 2, 2).unwrap_err();
    assert!(error.message().contains("feature 1"), "{error}");
}

#[test]
fn the_bank_is_the_same_bit_for_bit_on_any_number_of_threads() {
    let data = features(240, 37, 50, 0.8, 3);
    let alone = threads(1).install(|| clusters(&data, 37, 3)).unwrap();
    assert_eq!(alone.bank.len(), 96);
    for count in [2, 3, 8] {
        let many = threads(count).install(|| clusters(&data, 37, 3)).unwrap();
        let same = many.bank.rows.iter().zip(&alone.bank.rows);
        assert!(same.into_iter().all(|(a, b)| a.to_bits() == b.to_bits()), "{count}");
        assert_eq!(many.entries, alone.entries, "{count} threads");
    }
}

#[test]
fn groups_that_lie_apart_are_found() {
    let data = features(60, 32, 12, 0.05, 11);
    let found = clusters(&data, 32, 6).unwrap();
    assert_eq!(found.bank.len(), 12);
    for (i, index) in found.entries.iter().enumerate() {
        assert_eq!(*index, found.entries[i % 12], "feature {i}");
    }
    let used: HashSet<u16> = found.entries.iter().copied().collect();
    assert_eq!(used.len(), 12, "no two groups share a row");
}

#[test]
fn each_row_is_the_mean_of_its_features_and_none_is_empty() {
    let data = features(90, 16, 7, 1.0, 5);
    let found = clusters(&data, 16, 2).unwrap();
    assert_eq!(found.bank.len(), 54);
    for m in 1..=54_u16 {
        let own: Vec<usize> = (0..90).filter(|&i| found.entries[i] == m).collect();
        assert!(!own.is_empty(), "row {m}");
        for d in 0..16 {
            let sum: f64 = own.iter().map(|i| f64::from(data[i * 16 + d])).sum();
            let row = f64::from(found.bank.row(usize::from(m) - 1)[d]);
            assert!((sum / own.len() as f64 - row).abs() < 1e-6, "row {m}, number {d}");
        }
    }
}
