//! `photos` with a refinement, with the fixture's small networks.

use segsplat_testing::root;
use segsplat_vision::sample::{self, SampleOptions};

use crate::measured;

#[test]
fn refined_scenes_have_both_figures_and_begin_with_what_is_named() {
    let dir = tempfile::tempdir().unwrap();
    let options = SampleOptions { photos: 7, width: 96, height: 96, seed: 1 };
    sample::run(dir.path(), &options).unwrap();
    let bundle = root().join("tests/fixtures/colours");
    let of = |refine: &str| {
        let rest = ["--photos", "5", "--most", "1", "--refine", refine];
        measured("photos", &bundle, dir.path(), &rest)
    };
    let Some(rows) = of("steps=20") else { return };
    let [plain, layers] = [rows, of("steps=20,layers=true").unwrap()].map(|rows| {
        let row = rows.unwrap().remove(0);
        ["psnr", "refined_psnr"].map(|name| row[name].as_f64().expect(name))
    });
    assert_eq!(plain[0], layers[0], "the same scene");
    assert!(plain[1] > plain[0] + 0.3, "{plain:?}");
    assert!((plain[1] - layers[1]).abs() > 1e-4, "both begin the same: {plain:?}");
    let fault = of("steps=20,networks_ms=9").unwrap().unwrap_err();
    assert!(fault.message().contains("unknown field `networks_ms`"), "{fault}");
}
