//! Merged Gaussians: what one keeps of its members against f64, how far it is from what it stands
//! for, which are drawn, and how far pictures with them are from those without.

use std::sync::Arc;

use glam::{DMat3, DVec3};
use segsplat_core::scene::{Camera, Gaussians, SourcePixel, covariance};
use segsplat_render::{
    Frame, Kinds, Labels, Layer, RenderRequest, Renderer, Source, Switches,
    blocks::{BLOCK, BLOCKS_MIN, Blocks, Frustum},
    compare::psnr,
    cpu::{CpuRenderer, cull::Shown},
    merged::{DETAIL_MAX, GROUP, Merged},
    oracle::{self, OraclePixel},
    view::View,
};
use segsplat_testing::{
    compare::{Tolerance, compare, oracle_samples, samples},
    labels::labelled,
    scenes::{Random, camera, checked, cloud, look, needles, request, two_views},
};

use crate::common::{open, same_by};

/// A Gaussian of a scene, or a merged one, in f64.
struct One {
    mean: DVec3,
    covariance: DMat3,
    opacity: f64,
    sum: f64,
    sh: Vec<DVec3>,
}

fn one(gaussians: &Gaussians, merged: &Merged, id: usize) -> One {
    let (of, i, sum) = match id.checked_sub(gaussians.len()) {
        None => (gaussians, id, gaussians.opacities()[id]),
        Some(i) => (&merged.gaussians, i, merged.sums[i]),
    };
    let k = of.sh_count();
    One {
        mean: DVec3::from(of.means()[i].map(f64::from)),
        covariance: covariance(of.quats()[i], of.scales()[i]),
        opacity: f64::from(of.opacities()[i]),
        sum: f64::from(sum),
        sh: of.sh()[i * k..(i + 1) * k].iter().map(|c| DVec3::from(c.map(f64::from))).collect(),
    }
}

/// Root of the determinant of a covariance on a plane across `along`.
fn area(covariance: DMat3, along: DVec3) -> f64 {
    let u = along.any_orthonormal_vector();
    let v = along.cross(u);
    let at = |a: DVec3, b: DVec3| a.dot(covariance * b);
    (at(u, u) * at(v, v) - at(u, v).powi(2)).max(0.0).sqrt()
}

/// The mean square of the areas from all sides, by a sum over the sphere.
fn mean_area(covariance: DMat3) -> f64 {
    // Along three axes at right angles: the square is a quadratic form of the direction.
    let squares = [DVec3::X, DVec3::Y, DVec3::Z].map(|axis| area(covariance, axis).powi(2));
    (squares.into_iter().sum::<f64>() / 3.0).sqrt()
}

/// What stands for `members`, by raw moments: mean, covariance, harmonics.
fn moments(members: &[One]) -> (DVec3, DMat3, Vec<DVec3>) {
    let count = members.len() as f64;
    let middle = members.iter().map(|one| one.mean).sum::<DVec3>() / count;
    let between =
        members.iter().map(|one| (one.mean - middle).length_squared()).sum::<f64>() / count / 3.0;
    let (mut whole, mut first, mut second) = (0.0, DVec3::ZERO, DMat3::ZERO);
    let mut sh = vec![DVec3::ZERO; members[0].sh.len()];
    for one in members {
        let weight = one.opacity * mean_area(one.covariance) + one.sum * between;
        let at = one.mean - middle;
        let outer = DMat3::from_cols(at.x * at, at.y * at, at.z * at);
        whole += weight;
        first += weight * at;
        second += weight * (one.covariance + outer);
        sh.iter_mut().zip(&one.sh).for_each(|(sum, c)| *sum += weight * *c);
    }
    let at = first / whole;
    let outer = DMat3::from_cols(at.x * at, at.y * at, at.z * at);
    let sh = sh.into_iter().map(|c| c / whole).collect();
    (middle + at, second * (1.0 / whole) - outer, sh)
}

fn norm(matrix: DMat3) -> f64 {
    matrix.to_cols_array().iter().map(|v| v * v).sum::<f64>().sqrt()
}

/// Scenes of about 3,000 Gaussians.
fn scenes() -> [(&'static str, Gaussians); 3] {
    [
        ("cloud", cloud(3_000, 2, 5)),
        ("needles", needles(2_600, 2)),
        ("two photos", two_views(40, 3).0),
    ]
}

#[test]
fn a_merged_gaussian_has_the_moments_of_its_members() {
    for (name, gaussians) in scenes() {
        let blocks = Blocks::detailed(&gaussians).expect("merged");
        let merged = blocks.merged.as_ref().expect("merged");
        assert!(merged.gaussians.len() >= gaussians.len() / GROUP, "{name}: all are merged");
        for at in 0..merged.gaussians.len() {
            let group = merged.group(at);
            assert!((1..=GROUP).contains(&group.len()), "{name}: {group:?}");
            let members: Vec<One> =
                group.iter().map(|&id| one(&gaussians, merged, id as usize)).collect();
            let got = one(&gaussians, merged, gaussians.len() + at);
            let (mean, covariance, sh) = moments(&members);
            let size = norm(covariance).sqrt();
            let apart = got.mean.distance(mean);
            assert!(apart <= 1e-5 * size + 1e-6 * mean.length(), "{name} {at}: mean by {apart}");
            for (got, want) in got.sh.iter().zip(sh) {
                assert!(got.distance(want) < 1e-5, "{name} {at}: harmonics");
            }
            let sum = members.iter().map(|one| one.sum).sum::<f64>();
            assert!((got.sum / sum - 1.0).abs() < 4e-3, "{name} {at}: {} not {sum}", got.sum);
            // Opacity times area from in front of it; over an opacity of 1 it is larger.
            let thin = thinnest(merged, at);
            let covered =
                members.iter().map(|one| one.opacity * area(one.covariance, thin)).sum::<f64>();
            let opacity = covered / area(covariance, thin);
            let want = opacity.clamp(1.0 / 255.0, 1.0);
            assert!((got.opacity - want).abs() < 1e-3, "{name} {at}: {} not {want}", got.opacity);
            let apart = norm(got.covariance - covariance * opacity.max(1.0)) / norm(got.covariance);
            assert!(apart < 1e-3, "{name} {at}: covariance by {apart}");
        }
    }
}

/// The axis along which merged Gaussian `at` is thinnest.
fn thinnest(merged: &Merged, at: usize) -> DVec3 {
    let [w, x, y, z] = merged.gaussians.quats()[at].map(f64::from);
    let scales = merged.gaussians.scales()[at];
    let axis = (0..3).min_by(|&a, &b| scales[a].total_cmp(&scales[b])).expect("three");
    DMat3::from_quat(glam::DQuat::from_xyzw(x, y, z, w)).col(axis)
}

/// The block of each Gaussian, merged or not.
fn block_of(blocks: &Blocks, count: usize) -> Vec<usize> {
    let mut of = vec![usize::MAX; count];
    for at in 0..blocks.bounds.len() {
        blocks.ids(at).iter().for_each(|&id| of[id as usize] = at);
    }
    of
}

/// Calls `each` with a Gaussian of the scene and one that stands for it.
fn stand_ins(gaussians: &Gaussians, merged: &Merged, mut each: impl FnMut(usize, usize)) {
    // Of each Gaussian the one that stands for it.
    let count = gaussians.len() + merged.gaussians.len();
    let mut above = vec![usize::MAX; count];
    for at in 0..merged.gaussians.len() {
        merged.group(at).iter().for_each(|&id| above[id as usize] = gaussians.len() + at);
    }
    for id in 0..gaussians.len() {
        let mut at = above[id];
        assert_ne!(at, usize::MAX, "{id} is in no group");
        while at != usize::MAX {
            each(id, at);
            at = above[at];
        }
    }
}

#[test]
fn what_stands_for_a_gaussian_is_no_farther_from_it_than_its_block_says() {
    let mut random = Random(4);
    for (name, gaussians) in scenes() {
        let blocks = Blocks::detailed(&gaussians).expect("merged");
        let merged = blocks.merged.as_ref().expect("merged");
        let of = block_of(&blocks, gaussians.len() + merged.gaussians.len());
        let mut nearest = 0.0_f64;
        stand_ins(&gaussians, merged, |id, at| {
            let [own, other] = [id, at].map(|id| one(&gaussians, merged, id));
            let error = f64::from(blocks.bounds[of[at]].error);
            let distance = own.mean.distance(other.mean);
            for _ in 0..4 {
                let place = [(); 3].map(|()| f64::from(random.range(-1.0, 1.0)));
                let u = DVec3::from(place).normalize_or(DVec3::X);
                let [a, b] = [&own, &other].map(|one| u.dot(one.covariance * u).sqrt());
                let apart = distance + (a - b).abs();
                assert!(apart <= error * 1.000_01, "{name}: {id} by {at}: {apart} of {error}");
                nearest = nearest.max(apart / error);
            }
        });
        assert!(nearest > 0.3, "{name}: the bound is {nearest} of what it may be");
        for bounds in &blocks.bounds {
            let Some(parent) = blocks.bounds.get(bounds.parent as usize) else { continue };
            assert!(parent.error >= bounds.error, "{name}: errors grow");
            for axis in 0..3 {
                let apart = (bounds.center[axis] - parent.center[axis]).abs();
                assert!(apart + bounds.half[axis] <= parent.half[axis] * 1.000_001, "{name}: box");
            }
        }
    }
}

/// Of each Gaussian one block is fine enough whose parent is not, and what is drawn for it is no
/// farther from its place on the picture than the view permits.
#[test]
fn each_gaussian_is_drawn_once_and_within_the_detail() {
    let mut random = Random(9);
    let (mut coarse, mut worst) = (0_usize, 0.0_f64);
    for (name, gaussians) in scenes() {
        let blocks = Blocks::detailed(&gaussians).expect("merged");
        let merged = blocks.merged.as_ref().expect("merged");
        let of = block_of(&blocks, gaussians.len() + merged.gaussians.len());
        for _ in 0..12 {
            let eye = [(); 3].map(|()| f64::from(random.range(-90.0, 30.0)));
            let camera_to_world = look(DVec3::from(eye), DVec3::new(0.1, 0.2, 4.0));
            let detail = random.range(0.1, 4.0);
            let request =
                RenderRequest { detail, ..request(Camera { camera_to_world, ..camera(200, 150) }) };
            let view = View::new(gaussians.origin(), &request).expect("a view");
            let frustum = Frustum::new(&view, &request);
            let fine: Vec<bool> =
                blocks.bounds.iter().map(|bounds| frustum.is_fine(bounds)).collect();
            let drawn = |id: usize| {
                let bounds = &blocks.bounds[of[id]];
                fine[of[id]] && !fine.get(bounds.parent as usize).copied().unwrap_or(false)
            };
            let mut times: Vec<u32> = (0..gaussians.len()).map(|id| u32::from(drawn(id))).collect();
            stand_ins(&gaussians, merged, |id, at| {
                if !drawn(at) {
                    return;
                }
                times[id] += 1;
                coarse += 1;
                let place = |id: usize| {
                    let mean = one(&gaussians, merged, id).mean;
                    let t = view.rotation * mean + view.translation;
                    let at = |k: usize| view.focal[k] * t[k] / t.z;
                    (glam::DVec2::new(at(0), at(1)), t.z)
                };
                let ((own, depth), (other, _)) = (place(id), place(at));
                assert!(depth >= view.near, "{name}: {id} is before the near plane");
                let apart = own.distance(other) / f64::from(detail);
                // The bound is of the picture, and of its frame.
                let inside = own.abs().max_element() <= 100.0;
                assert!(apart <= 1.0 || !inside, "{name}: {id} by {at}: {apart} of the detail");
                worst = if inside { worst.max(apart) } else { worst };
            });
            assert!(times.iter().all(|&times| times == 1), "{name}: each once");
        }
    }
    assert!(coarse > 5_000 && worst > 0.2, "{coarse} were merged, by {worst} of the detail");
}

/// A scene seen from `times` as far away as it was made for, with its photo or without.
fn afar(side: u32, pixels: u32, times: f64, photo: bool) -> (Gaussians, RenderRequest) {
    let (gaussians, _) = two_views(side, 1);
    let eye = DVec3::new(0.07, -0.03, -4.0 * (times - 1.0));
    let view = Camera { camera_to_world: look(eye, eye + DVec3::Z), ..camera(pixels, pixels) };
    let scale = camera(side, side).intrinsics.fx.recip() as f32;
    let source = Source { center: [0.0; 3], axis: [0.0, 0.0, 1.0], scale, layer: Layer::Front };
    let sources: Arc<[Source]> = if photo { [source].into() } else { Arc::default() };
    (gaussians, RenderRequest { sources, ..request(view) })
}

/// Scenes, views and details of which merged ones are drawn.
fn cases() -> Vec<(String, Gaussians, RenderRequest)> {
    let mut cases = Vec::new();
    for (photo, detail) in [(false, 2.0), (true, 2.0), (true, 5.0)] {
        let (gaussians, request) = afar(96, 60, 6.0, photo);
        let name = format!("two photos, {photo}, {detail}");
        cases.push((name, gaussians, RenderRequest { detail, ..request }));
    }
    // From close to it: near ones are drawn as they are, and far ones merged.
    let (photos, _) = two_views(96, 2);
    let mut raw = photos.into_raw();
    for (i, source) in raw.source.iter_mut().enumerate() {
        *source = SourcePixel { view: (i % 3) as u16, x: 0, y: 0 };
    }
    let photos = checked(raw);
    let close = look(DVec3::new(-2.0, 0.3, 2.0), DVec3::new(1.5, 0.0, 4.4));
    let within = RenderRequest {
        detail: 8.0,
        ..request(Camera { camera_to_world: close, ..camera(90, 70) })
    };
    let source = |k: u32| Source {
        center: [0.2 * k as f32, 0.0, -1.0],
        axis: [0.0, 0.0, 1.0],
        scale: 0.004 * k as f32,
        layer: Layer::behind_if(k == 1),
    };
    let layered = RenderRequest { sources: (0..3).map(source).collect(), ..within.clone() };
    let antialiased = RenderRequest { antialiased: true, ..within.clone() };
    cases.push(("close".to_owned(), photos.clone(), within));
    cases.push(("layers".to_owned(), photos.clone(), layered));
    cases.push(("antialiased".to_owned(), photos, antialiased));
    // Harmonics.
    let far = look(DVec3::NEG_Z * 40.0, DVec3::Z);
    let far = request(Camera { camera_to_world: far, ..camera(90, 70) });
    let harmonics = RenderRequest { detail: 8.0, ..far };
    cases.push(("harmonics".to_owned(), cloud(9_000, 2, 8), harmonics));
    cases
}

fn detailed(from: usize) -> Switches {
    Switches { blocks_min: Some(from), ..Switches::default() }
}

fn cpu() -> CpuRenderer {
    CpuRenderer::with_switches(2, &detailed(1)).expect("two threads")
}

/// What the oracle sees of the Gaussians that a view shows; also how many of those are merged.
fn truth(
    gaussians: &Gaussians,
    request: &RenderRequest,
    pixels: &[[u32; 2]],
) -> (Vec<OraclePixel>, usize) {
    let blocks = Blocks::detailed(gaussians).expect("merged");
    let view = View::new(gaussians.origin(), request).expect("a view");
    let ids: Vec<usize> = match Shown::of(&blocks, &Frustum::new(&view, request)) {
        Shown::All => (0..gaussians.len()).collect(),
        Shown::Some { ids, .. } => ids.into_iter().map(|id| id as usize).collect(),
    };
    let merged = blocks.merged.expect("merged");
    let coarse = ids.iter().filter(|&&id| id >= gaussians.len()).count();
    let pixels = oracle::render_merged(gaussians, &merged, &ids, request, pixels);
    (pixels.expect("the truth"), coarse)
}

#[test]
fn pictures_of_merged_gaussians_agree_with_the_oracle() {
    for (name, gaussians, request) in cases() {
        let frame = cpu().render(&gaussians, &request).expect("a picture");
        let lens = request.lens();
        let pixels: Vec<[u32; 2]> =
            (0..lens.height).flat_map(|y| (0..lens.width).map(move |x| [x, y])).collect();
        let (truth, coarse) = truth(&gaussians, &request, &pixels);
        assert!(coarse > 0, "{name}: none are merged");
        let cliff: Vec<bool> = truth.iter().map(|p| p.cliff.same_order()).collect();
        let flips = Tolerance { flips: 4e-3, ..Tolerance::ORACLE };
        compare(&samples(&frame), &oracle_samples(&truth), &cliff, flips)
            .unwrap_or_else(|told| panic!("{name}: {told}"));
    }
}

#[test]
fn a_gpu_draws_the_merged_gaussians_of_the_cpu() {
    for serial in [false, true] {
        let gpu = open(|options| {
            options.switches.serial = Some(serial);
            options.switches.blocks_min = Some(1);
        });
        let Some(gpu) = gpu else { return };
        for (name, gaussians, request) in cases() {
            let got = gpu.render(&gaussians, &request).expect("a picture of the GPU");
            let want = cpu().render(&gaussians, &request).expect("a picture of the CPU");
            let judge = |pixels: &[[u32; 2]]| truth(&gaussians, &request, pixels).0;
            same_by(&name, &got, &want, &request, judge);
            let (a, b) = (got.stats.visible, want.stats.visible);
            assert!(a.abs_diff(b) * 500 <= b, "{name}: {a} visible, not {b}");
            // The same scene, which has merged ones now, without a permission.
            let exact = RenderRequest { detail: 0.0, ..request };
            let exact_of = |renderer: &dyn Renderer| renderer.render(&gaussians, &exact).unwrap();
            let without = open(|options| {
                options.switches.serial = Some(serial);
                options.switches.blocks_min = Some(usize::MAX);
            });
            assert!(exact_of(&gpu) == exact_of(&without.unwrap()), "{name}: merged ones show");
        }
    }
}

#[test]
fn nothing_is_merged_without_a_permission() {
    for (name, gaussians, request) in cases() {
        let exact = RenderRequest { detail: 0.0, ..request.clone() };
        let draw = |from: usize, request: &RenderRequest| -> Frame {
            let cpu = CpuRenderer::with_switches(2, &detailed(from)).expect("two threads");
            // First with the permission, so that the scene has merged ones.
            cpu.render(&gaussians, &RenderRequest { detail: 1.0, ..request.clone() }).unwrap();
            cpu.render(&gaussians, request).expect("a frame")
        };
        assert!(draw(1, &exact) == draw(usize::MAX, &exact), "{name}: merged ones show");
        assert!(draw(1, &request) != draw(1, &exact), "{name}: the permission is used");
    }
}

#[test]
fn merged_gaussians_have_the_entry_with_most_opacity() {
    let gaussians = labelled(5_000, 8, 7);
    let blocks = Blocks::detailed(&gaussians).expect("merged");
    let merged = blocks.merged.as_ref().expect("merged");
    let entries = merged.entries(&gaussians);
    assert_eq!(entries.len(), merged.gaussians.len(), "one each");
    let of = |&id: &u32| match (id as usize).checked_sub(gaussians.len()) {
        None => (gaussians.semantic_index()[id as usize], gaussians.opacities()[id as usize]),
        Some(at) => (entries[at], merged.sums[at]),
    };
    for (at, &entry) in entries.iter().enumerate() {
        let mut sums = [0.0; 16];
        merged.group(at).iter().map(of).for_each(|(entry, sum)| sums[usize::from(entry)] += sum);
        let most = sums.iter().copied().fold(0.0, f32::max);
        assert!(sums[usize::from(entry)] >= most * 0.999_99, "{at}: {entry} of {sums:?}");
    }
    // Other entries of the same Gaussians.
    let other = gaussians.with_semantic_index(vec![3; gaussians.len()]).expect("as many");
    assert!(merged.entries(&other).iter().all(|&entry| entry == 3), "those of the other scene");
    let view = RenderRequest { detail: 16.0, labels: Labels::Weights, ..request(camera(60, 50)) };
    let far = Camera { camera_to_world: look(DVec3::NEG_Z * 60.0, DVec3::ZERO), ..camera(60, 50) };
    let frame = cpu().render(&other, &RenderRequest { camera: far, ..view }).expect("a frame");
    let weights = frame.weights.expect("weights");
    assert!(!weights.entries.is_empty(), "the scene is seen");
    assert!(weights.entries.iter().all(|&entry| entry == 3), "one entry");
}

/// The aim of ten million Gaussians with as many a pixel of a smaller picture: at least 45 dB with
/// much fewer Gaussians, with the photo (as a scene is served) and without (as a file is).
#[test]
fn views_from_afar_keep_their_pictures() {
    let (side, pixels) = (364, 83);
    for photo in [true, false] {
        let (gaussians, request) = afar(side, pixels, 10.0, photo);
        assert!(gaussians.len() >= BLOCKS_MIN, "it has blocks by itself");
        let cpu = CpuRenderer::new(2).expect("two threads");
        let draw = |detail: f32| {
            let request = RenderRequest { detail, kinds: Kinds::COLOR, ..request.clone() };
            cpu.render(&gaussians, &request).expect("a picture")
        };
        let exact = draw(0.0);
        let truth = exact.color.as_ref().expect("colour");
        for (detail, least, most) in [(0.25, 47.0, 0.3), (0.5, 45.0, 0.08)] {
            let frame = draw(detail);
            let db = psnr(frame.color.as_ref().expect("colour"), truth, None);
            let share = frame.stats.visible as f64 / gaussians.len() as f64;
            println!("photo {photo}, detail {detail}: {db:.1} dB with {:.2} %", 100.0 * share);
            assert!(db >= least && share <= most, "photo {photo}, {detail}: {db} dB, {share}");
        }
    }
}

#[test]
fn a_detail_out_of_range_is_refused() {
    let gaussians = cloud(BLOCK, 0, 1);
    for detail in [-0.1, DETAIL_MAX * 1.01, f32::NAN, f32::INFINITY] {
        let error = cpu()
            .render(&gaussians, &RenderRequest { detail, ..request(camera(8, 8)) })
            .expect_err("out of range");
        assert!(error.message().contains("detail is"), "{error}");
    }
}
