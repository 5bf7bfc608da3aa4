//! The comparer of pictures itself: what must fail does.

use segsplat_testing::compare::{Sample, Tolerance, compare};

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
    // A little everywhere is more than a little somewhere.
    let all = vec![grey(0.5 + 1e-4); 2_000];
    let told = compare(&all, &want, &none, Tolerance::ORACLE).expect_err("all are off");
    assert!(told.ends_with("in the mean, over 2e-5"), "{told}");
    // A scene of a millionth of the size is held as much.
    let tiny = |depth: f64| vec![Sample { depth, ..grey(0.5) }; 2];
    let (far, near) = (tiny(1.001e-6), tiny(1e-6));
    compare(&far, &near, &none[..2], Tolerance::ORACLE).expect_err("the depth of a tiny scene");
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
