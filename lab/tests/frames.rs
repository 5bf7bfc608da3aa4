//! Comparisons find what is wrong, and a run of `frames` makes a row.

use segsplat_core::scene::Gaussians;
use segsplat_lab::{
    frames::{self, Args, LabelKind, Reference, scene},
    rows::Rows,
};
use segsplat_render::{
    Kinds, Labels, RenderRequest, Renderer,
    compare::{compare, compare_oracle},
    cpu::CpuRenderer,
};

#[test]
fn frames_are_timed_with_labels_and_callers() {
    for compare in [Reference::Cpu, Reference::Oracle] {
        let args =
            Args { compare, labels: Some(LabelKind::Entries), callers: 2, ..Args::small(800, 24) };
        frames::run(&args, &mut Rows::default()).unwrap();
    }
    assert!(frames::run(&Args::small(1, 24), &mut Rows::default()).is_err(), "one Gaussian");
    assert!(frames::run(&Args::small(800, 0), &mut Rows::default()).is_err(), "no pixel");
}

#[test]
fn a_wrong_pixel_is_a_fault_and_nan_is_far() {
    let (gaussians, camera) = scene(&Args::small(800, 24)).unwrap();
    let request = RenderRequest::plain(camera, Kinds::ALL, 0.05);
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
