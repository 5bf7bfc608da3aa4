//! The devices that callers share: views drawn together, devices lost, memory and limits met.

use std::{
    sync::{Arc, Barrier, atomic::Ordering},
    time::{Duration, Instant},
};

use segsplat_core::{error::ErrorCode, scene::Gaussians};
use segsplat_render::{
    Frame, Kinds, Labels, RenderRequest, Renderer, RendererChoice, RendererOptions, Switches,
    gpu::GpuRenderer, select::select, switches::FaultsToCome,
};

use crate::common::{cpu, open};
use segsplat_testing::labels::{labelled, table};
use segsplat_testing::scenes::{camera, cloud, request};

/// Views of one scene that differ in camera, size and kinds.
fn requests(count: u32, labels: &Labels) -> Vec<RenderRequest> {
    (0..count)
        .map(|i| {
            let mut one = request(camera(40 + 13 * (i % 5), 30 + 7 * (i % 4)));
            one.camera.intrinsics.fx += f64::from(i);
            one.antialiased = i % 3 == 1;
            one.kinds = Kinds { color: i % 4 != 3, depth: i % 2 == 0, alpha: true };
            one.labels = labels.clone();
            one
        })
        .collect()
}

/// Draws all at once, each on a thread of its own.
pub(crate) fn at_once(
    gpu: &GpuRenderer,
    scene: &Gaussians,
    wanted: &[RenderRequest],
) -> Vec<Frame> {
    let start = Barrier::new(wanted.len());
    std::thread::scope(|scope| {
        let threads: Vec<_> = wanted
            .iter()
            .map(|one| {
                scope.spawn(|| {
                    start.wait();
                    gpu.render(scene, one).expect("a view among others")
                })
            })
            .collect();
        threads.into_iter().map(|thread| thread.join().expect("a caller")).collect()
    })
}

#[test]
fn views_drawn_together_are_those_drawn_alone() {
    for serial in [false, true] {
        let Some(gpu) = open(|options| options.switches.serial = Some(serial)) else { return };
        for labels in [Labels::None, Labels::Blend(table(9, 3)), Labels::Weights] {
            let scene = labelled(2_000, 8, 61);
            let wanted = requests(16, &labels);
            let alone: Vec<_> =
                wanted.iter().map(|one| gpu.render(&scene, one).expect("a view alone")).collect();
            let before = gpu.internals().submissions();
            for (i, (got, want)) in at_once(&gpu, &scene, &wanted).iter().zip(&alone).enumerate() {
                assert!(got == want, "view {i} among others, {labels:?}");
            }
            let (submissions, views) = gpu.internals().submissions();
            let (submissions, views) = (submissions - before.0, views - before.1);
            println!("{views} views in {submissions} submissions");
            assert_eq!(views, 16, "no two views are equal");
            // Views of three sets of kernels. Two start at once; the others wait and share.
            assert!(submissions <= 8, "16 views in {submissions} submissions");
        }
        // Degree 2: colours of each camera are its own.
        let scene = cloud(1_500, 2, 62);
        let wanted = requests(12, &Labels::None);
        let alone: Vec<_> =
            wanted.iter().map(|one| gpu.render(&scene, one).expect("alone")).collect();
        assert!(at_once(&gpu, &scene, &wanted) == alone, "colours of higher degrees");
    }
}

#[test]
fn equal_requests_are_drawn_once() {
    let Some(gpu) = open(|_| {}) else { return };
    let scene = cloud(20_000, 0, 63);
    let one = request(camera(320, 240));
    let want = gpu.render(&scene, &one).expect("a view");
    let before = gpu.internals().submissions().1;
    let wanted = vec![one; 16];
    assert!(at_once(&gpu, &scene, &wanted).iter().all(|got| *got == want), "all got it");
    let drawn = gpu.internals().submissions().1 - before;
    println!("{drawn} of 16 drawn");
    // The first one is drawn while the others arrive.
    assert!(drawn <= 4, "equal views were drawn {drawn} times");
}

#[test]
fn a_device_lost_under_sixteen_requests_loses_none_of_them() {
    let Some(gpu) = open(|_| {}) else { return };
    let scene = cloud(30_000, 0, 64);
    let wanted = requests(16, &Labels::None);
    let alone: Vec<_> = wanted.iter().map(|one| gpu.render(&scene, one).expect("alone")).collect();
    let start = Barrier::new(wanted.len() + 1);
    let (gpu, scene, begin) = (&gpu, &scene, &start);
    for wait_ms in [0, 3, 10] {
        std::thread::scope(|scope| {
            let threads: Vec<_> = wanted
                .iter()
                .map(|one| {
                    scope.spawn(move || {
                        begin.wait();
                        gpu.render(scene, one)
                    })
                })
                .collect();
            begin.wait();
            std::thread::sleep(Duration::from_millis(wait_ms));
            gpu.internals().lose_devices();
            for (i, (thread, want)) in threads.into_iter().zip(&alone).enumerate() {
                let got = thread.join().expect("a caller").expect("an answer");
                assert!(got == *want, "view {i} after the loss");
            }
        });
    }
    gpu.internals().lose_devices();
    let begun = Instant::now();
    assert!(gpu.render(scene, &wanted[0]).expect("a view") == alone[0], "the next view");
    println!("served again after {:?}", begun.elapsed());
}

#[test]
fn scenes_leave_by_bytes_and_come_again() {
    let (a, b) = (cloud(1_000, 0, 65), cloud(1_000, 0, 66));
    // Room for one of them: 48 bytes a Gaussian and 12 of colour.
    let Some(gpu) = open(|options| options.scene_bytes_max = 100_000) else { return };
    let one = request(camera(48, 32));
    let want = gpu.render(&a, &one).expect("a view");
    gpu.render(&b, &one).expect("a view of the other");
    assert_eq!(gpu.internals().scenes_held(), 1, "the first has left");
    assert!(gpu.render(&a, &one).expect("a view again") == want, "it came again");
}

#[test]
fn a_scene_is_uploaded_before_its_first_view_within_the_same_bytes() {
    let scenes = [65, 66, 67].map(|seed| cloud(1_000, 0, seed));
    let one = request(camera(48, 32));
    let Some(gpu) = open(|options| options.scene_bytes_max = 130_000) else { return };
    let held = || gpu.internals().scenes_held();
    let want = gpu.render(&scenes[0], &one).expect("a view");
    gpu.prepare(&scenes[1]).expect("room");
    assert_eq!(held(), 2, "uploaded beside the first");
    gpu.prepare(&scenes[1].clone()).expect("room");
    assert_eq!(held(), 2, "and once");
    gpu.prepare(&scenes[2]).expect("room");
    assert_eq!(held(), 2, "the one that was drawn least recently has left");
    assert!(gpu.render(&scenes[0], &one).expect("a view again") == want, "it came again");
    let Some(fresh) = open(|_| {}) else { return };
    let prepared = gpu.render(&scenes[2], &one).expect("a view of what was prepared");
    assert!(fresh.render(&scenes[2], &one).expect("a view") == prepared, "the same picture");
    gpu.prepare(&cloud(3_000, 0, 68)).expect("it is left out");
    assert_eq!(held(), 2, "one that is larger than the room makes none leave");
    gpu.internals().lose_devices();
    assert!(gpu.prepare(&cloud(900, 0, 69)).is_err(), "a lost device is no fault of a view");
    assert!(gpu.render(&scenes[0], &one).expect("a view") == want, "the next view opens it again");
}

#[test]
fn what_no_buffer_holds_is_refused_with_the_figures() {
    let Some(gpu) = open(|options| options.switches.portable = true) else { return };
    // 2.8 million Gaussians of 48 bytes are over the portable 128 MiB of a binding, and one row of
    // tiles shows them all.
    let scene = cloud(2_800_000, 0, 67);
    let error = gpu.render(&scene, &request(camera(16, 16))).expect_err("too many");
    assert_eq!(error.code(), ErrorCode::LimitExceeded, "{error}");
    assert!(error.message().contains("2800000 is over 2796202"), "{error}");
    let small = cloud(100, 0, 68);
    gpu.render(&small, &request(camera(16, 16))).expect("others are drawn");
}

/// A renderer of which devices fail as `faults` says.
fn failing(renderer: RendererChoice) -> Option<(Arc<dyn Renderer>, Arc<FaultsToCome>)> {
    let name = open(|_| {})?.adapter().name.clone();
    let switches = Switches { portable: true, ..Switches::default() };
    let faults = Arc::clone(&switches.faults);
    let options =
        RendererOptions { renderer, adapter: Some(name), switches, ..RendererOptions::default() };
    Some((select(&options).expect("the same adapter").0, faults))
}

#[test]
fn a_device_lost_or_full_in_the_middle_is_answered_by_the_cpu_or_refused_by_name() {
    const ALWAYS: u32 = u32::MAX;
    let scene = labelled(3_000, 8, 69);
    let one = request(camera(61, 47));
    let larger = request(camera(500, 400));
    let of_cpu = |request: &RenderRequest| cpu().render(&scene, request).expect("a view");
    for (lost, open, memory) in [(1, ALWAYS, 0), (ALWAYS, 0, 0), (0, 0, ALWAYS)] {
        let Some((auto, faults)) = failing(RendererChoice::Auto) else { return };
        let of_gpu = auto.render(&scene, &one).expect("a view");
        assert!(of_gpu != of_cpu(&one), "the renderers round otherwise");
        let set = |faults: &FaultsToCome, [lost, open, memory]: [u32; 3]| {
            faults.lost.store(lost, Ordering::Relaxed);
            faults.open.store(open, Ordering::Relaxed);
            faults.memory.store(memory, Ordering::Relaxed);
        };
        set(&faults, [lost, open, memory]);
        let got = auto.render(&scene, &larger).expect("an answer");
        assert!(got == of_cpu(&larger), "lost {lost}, open {open}, memory {memory}: the CPU's");
        set(&faults, [0; 3]);
        assert!(auto.render(&scene, &one).expect("a view") == of_gpu, "the GPU is back");

        let Some((gpu, faults)) = failing(RendererChoice::Gpu) else { return };
        assert!(gpu.render(&scene, &one).expect("a view") == of_gpu);
        set(&faults, [lost, open, memory]);
        let error = gpu.render(&scene, &larger).expect_err("no device");
        let code = if memory > 0 { ErrorCode::LimitExceeded } else { ErrorCode::GpuUnavailable };
        assert_eq!(error.code(), code, "{error}");
        set(&faults, [0; 3]);
        assert!(gpu.render(&scene, &one).expect("a view") == of_gpu, "the GPU is back");
    }
}

#[test]
fn a_device_full_or_lost_once_draws_the_same_view() {
    let scene = labelled(3_000, 8, 70);
    let larger = request(camera(500, 400));
    let Some((gpu, _)) = failing(RendererChoice::Gpu) else { return };
    let want = gpu.render(&scene, &larger).expect("a view");
    for lost in [false, true] {
        let Some((gpu, faults)) = failing(RendererChoice::Gpu) else { return };
        let fault = if lost { &faults.lost } else { &faults.memory };
        fault.store(1, Ordering::Relaxed);
        assert!(gpu.render(&scene, &larger).expect("a view") == want, "lost: {lost}");
        assert_eq!(fault.load(Ordering::Relaxed), 0, "it came");
    }
}

#[test]
fn an_unknown_adapter_is_refused_with_what_there_is() {
    let adapter = Some("no such adapter".to_owned());
    let (_, opened) = GpuRenderer::open(&RendererOptions { adapter, ..Default::default() });
    let error = opened.expect_err("nothing is called so");
    assert_eq!(error.code(), ErrorCode::GpuUnavailable, "{error}");
    assert!(error.message().contains("no such adapter"), "{error}");
}

#[test]
fn software_is_never_taken_unasked() {
    let (reports, _) = GpuRenderer::open(&RendererOptions::default());
    for report in reports {
        assert!(!(report.software && report.chosen), "{report:?} was taken without being named");
    }
}
