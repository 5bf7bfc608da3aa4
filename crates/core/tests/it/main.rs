//! The types that all crates share.
#![allow(clippy::unwrap_used, reason = "tests")]

use std::collections::HashSet;

use glam::DVec3;
use segsplat_core::{
    cache::Cache,
    error::TABLE,
    limits::{Limits, LiveLimits},
    names::shown,
    scene::{Backdrop, Gaussians, RawGaussians, SourcePixel},
};

#[test]
fn the_least_recently_used_leaves_first_and_weights_are_given_back() {
    let cache = Cache::new(10);
    cache.insert("a", 1, 4);
    cache.insert("b", 2, 4);
    assert_eq!(cache.find(&"a"), Some(1), "a is now used last");
    cache.insert("c", 3, 4);
    let found = ["a", "b", "c"].map(|key| cache.find(&key));
    assert_eq!(found, [Some(1), None, Some(3)], "b was used first");
    cache.insert("a", 7, 6);
    assert_eq!((cache.find(&"a"), cache.find(&"c")), (Some(7), Some(3)), "6 + 4 fit");
    cache.insert("d", 4, 11);
    assert_eq!(cache.find(&"d"), None, "heavier than all");
    assert_eq!(cache.weight(), 10, "of a and c");
    for _ in 0..5 {
        cache.insert("c", 3, 4);
    }
    assert_eq!(cache.weight(), 10, "the same key again takes no more room");
    cache.remove(&"c");
    cache.retain(|value| *value != 7);
    assert_eq!((cache.weight(), cache.find(&"a")), (0, None), "all given back");
    assert_eq!(["a", "b", "c", "d"].map(|key| cache.find(&key)), [None; 4], "nothing is left");
}

#[test]
fn gaussians_with_other_entries_have_the_same_arrays() {
    let raw = RawGaussians {
        means: vec![[0.0; 3], [1.0; 3]],
        quats: vec![[1.0, 0.0, 0.0, 0.0]; 2],
        scales: vec![[0.1; 3]; 2],
        opacities: vec![0.5; 2],
        sh: vec![[0.0; 3]; 2],
        semantic_index: vec![3, 4],
        source: vec![SourcePixel::default(); 2],
        ..RawGaussians::default()
    };
    let old = Gaussians::restore(raw).unwrap();
    let new = old.with_semantic_index(vec![5, 6]).unwrap();
    assert!(std::ptr::eq(old.means(), new.means()), "not copied");
    assert!(std::ptr::eq(old.sh(), old.clone().sh()), "nor by a clone");
    assert_eq!((old.semantic_index(), new.semantic_index()), (&[3, 4][..], &[5, 6][..]));
    assert_eq!(old.shape_identity(), new.shape_identity());
    assert_ne!(old.identity(), new.identity());
    let second = new.only(|i| i == 1);
    assert_eq!((second.means(), second.semantic_index()), (&[[1.0; 3]][..], &[6][..]));
    let raw = new.clone().into_raw();
    assert_eq!((raw.means.len(), raw.semantic_index), (2, vec![5, 6]), "all arrays come out");
    assert!(new.with_semantic_index(vec![1]).is_err(), "one too few");
}

#[test]
fn joined_gaussians_stay_where_they_are_whatever_their_origins() {
    let one = |origin: DVec3, sh_degree: u8| {
        Gaussians::restore(RawGaussians {
            origin,
            means: vec![[1.0, 2.0, 3.0]],
            quats: vec![[1.0, 0.0, 0.0, 0.0]],
            scales: vec![[0.1; 3]],
            opacities: vec![0.5],
            sh_degree,
            sh: vec![[0.0; 3]; (usize::from(sh_degree) + 1).pow(2)],
            semantic_index: vec![4],
            source: vec![SourcePixel { view: 2, x: 0, y: 0 }],
        })
        .unwrap()
    };
    let (near, far) = (one(DVec3::ZERO, 0), one(DVec3::new(1e3, 0.0, -5.0), 0));
    let both = near.joined(&far).unwrap();
    assert_eq!(both.means(), [[1.0, 2.0, 3.0], [1001.0, 2.0, -2.0]]);
    assert_eq!((both.len(), both.origin(), both.sh().len()), (2, DVec3::ZERO, 2));
    assert_eq!((both.semantic_index()[1], both.source()[1].view), (4, 2));
    let told = near.joined(&one(DVec3::ZERO, 1)).unwrap_err();
    assert!(told.message().contains("degree 0 beside 1"), "{}", told.message());
}

#[test]
fn names_are_unique_and_every_row_finds_itself() {
    let names: HashSet<_> = TABLE.iter().map(|row| row.name).collect();
    assert_eq!(names.len(), TABLE.len(), "two codes share a name");
    for row in &TABLE {
        assert_eq!(row.code.row().name, row.name, "row of another code");
    }
}

#[test]
fn values_of_a_json_text_are_counted_outside_of_its_strings() {
    let limits = |json_values_max| Limits { json_values_max, ..Limits::default() };
    for (json, count) in [
        ("7", 1),
        ("[1,2,3]", 4),
        (r#"{"a":[{},{}],"b":"[,:{"}"#, 9),
        (r#""\",[\\""#, 1),
        (r#"["\\",2]"#, 3),
    ] {
        limits(count).check_json("x", json.as_bytes()).expect(json);
        let error = limits(count - 1).check_json("x", json.as_bytes()).unwrap_err();
        assert!(error.message().contains(&format!("{count} values")), "{json}: {error}");
    }
}

#[test]
fn limits_that_size_something_at_start_need_a_restart() {
    let (live, mut new) = (LiveLimits::new(Limits::default()), Limits::default());
    new.photos_max += 1;
    assert!(live.reload(new.clone()).is_empty(), "read for each call");
    assert_eq!(*live.get(), new);
    let before = new.clone();
    (new.cache_bytes_max, new.uploads_bytes_max, new.page_max) = (1, 1, 7);
    assert_eq!(live.reload(new), ["uploads_bytes_max", "cache_bytes_max"]);
    assert_eq!(*live.get(), Limits { page_max: 7, ..before }, "only what counts now has changed");
}

#[test]
fn numbers_are_short() {
    let numbers = [0.0, -5.0, 1.5, 0.000_002, 1e15, 1e308, -1e-300, f64::NAN];
    let want = ["0", "-5", "1.5", "0.000002", "1000000000000000", "1e308", "-1e-300", "NaN"];
    assert_eq!(numbers.map(shown), want);
}

fn quarters() -> Backdrop {
    let cell = |i: usize| {
        let (x, y) = (i % Backdrop::WIDTH, i / Backdrop::WIDTH);
        [(x * 2) as u8, (y * 4) as u8, 0]
    };
    Backdrop::from_cells((0..Backdrop::WIDTH * Backdrop::HEIGHT).map(cell).collect()).unwrap()
}

#[test]
fn forward_is_the_middle_and_down_is_the_last_row() {
    let (u, v) = Backdrop::position(DVec3::Z);
    assert_eq!((u, v), (64.0, 32.0));
    assert!(quarters().color(DVec3::Y)[1] > 0.98, "+y is the last row");
    assert!(quarters().color(-DVec3::Y)[1] < 0.02, "-y is the first row");
    assert!(quarters().color(DVec3::X)[0] > quarters().color(-DVec3::X)[0], "+x is east");
}
