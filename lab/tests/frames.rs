//! Comparisons find what is wrong, and a run of `frames` makes a row.

use segsplat_core::scene::Gaussians;
use segsplat_render::{
    Kinds, Labels, RenderRequest, Renderer,
    compare::{compare, compare_oracle},
    cpu::CpuRenderer,
};
use segsplat_testing::scenes::{camera, request, two_views};

use crate::lab;

#[test]
fn frames_are_timed_with_labels_and_callers() {
    for (reference, labels, pixels) in [("cpu", "weights", 576), ("oracle", "blend", 4096)] {
        let line = format!(
            "frames --gaussians 800 --size 24 --frames 1 --compare {reference} --labels {labels} \
             --callers 2"
        );
        let rows = lab(&line.split(' ').collect::<Vec<_>>()).unwrap();
        let error = &rows[0]["error"];
        assert_eq!(error["picture"]["pixels"], pixels);
        assert_eq!(error["picture"]["faults"], 0, "{error}");
        assert_eq!(error["labels"]["faults"], 0, "{error}");
        assert_eq!(rows[0]["labels"]["labels"], labels);
        assert!(rows[0]["callers"]["all_per_s"].as_f64() > Some(0.0), "{}", rows[0]);
    }
    assert!(lab(&["frames", "--gaussians", "1", "--size", "24"]).is_err(), "one Gaussian");
    assert!(lab(&["frames", "--gaussians", "800", "--size", "0"]).is_err(), "no pixel");
}

#[test]
fn the_frontier_has_six_scenes_and_every_error_keeps_its_bound() {
    let rows = lab(&["frontier", "--gaussians", "800", "--size", "24", "--errors", "0,8,32"]);
    let rows = rows.unwrap();
    assert_eq!(rows.len(), 18, "six scenes at three errors");
    for row in &rows {
        let number = |name: &str| row["error"][name].as_f64().unwrap();
        let (asked, most) = (number("asked"), number("max"));
        assert!(most <= asked + 1e-3, "{row}");
        assert!(asked > 0.0 || number("psnr_db") > 150.0, "the first is exact: {row}");
    }
    let spent = rows.iter().filter(|row| row["error"]["max"].as_f64() > Some(1.0));
    assert!(spent.count() >= 6, "errors are spent");
    assert!(lab(&["frontier", "--gaussians", "800", "--errors", "33"]).is_err(), "33 levels");
}

#[test]
fn a_wrong_pixel_is_a_fault_and_nan_is_far() {
    let (gaussians, _) = two_views(20, 1);
    let entries = (0..gaussians.len()).map(|i| 1 + (i % 24) as u16).collect();
    let gaussians = gaussians.with_semantic_index(entries).unwrap();
    let request = request(camera(24, 24));
    let draw = |gaussians: &Gaussians, request: &RenderRequest| {
        CpuRenderer::new(1).and_then(|cpu| cpu.render(gaussians, request)).unwrap()
    };
    let want = draw(&gaussians, &request);
    let found = compare_oracle(&want, &gaussians, &request).unwrap();
    assert_eq!((found.pixels, found.flips, found.faults), (4096, 0, 0), "the oracle");
    assert!(found.max > 0.0 && found.max < 2e-5, "{found:?}");
    assert!(found.psnr_db.is_some_and(|db| db > 100.0), "{found:?}");
    for wrong in [0.5, f32::NAN] {
        let mut got = want.clone();
        got.color.as_mut().unwrap()[100][1] += wrong;
        let found = compare(&got, &want, &gaussians, &request).unwrap();
        assert_eq!(found.flips + found.faults, 1, "{wrong}: {found:?}");
        assert!(found.max >= 0.5, "the largest difference is of all pixels: {found:?}");
    }
    for labels in [Labels::Weights, Labels::Blend([[1.0; 4]; 25].into())] {
        let request = RenderRequest { labels, kinds: Kinds::NONE, ..request.clone() };
        let want = draw(&gaussians, &request);
        let mut got = want.clone();
        if let Some(blend) = &mut got.blend {
            blend[7][3] += 0.5;
        }
        if let Some(weights) = &mut got.weights {
            weights.entries[0] += 1;
        }
        let found = compare(&got, &want, &gaussians, &request).unwrap();
        assert_eq!(found.flips + found.faults, 1, "a wrong label: {found:?}");
    }
}
