//! Every stage of the GPU renderer against its CPU twin, from the same input; then whole pictures.

use segsplat_core::{
    error::ErrorCode,
    scene::{Gaussians, RawGaussians},
};
use segsplat_render::{
    Frame, Kinds, RenderRequest, Renderer,
    cpu::{
        bin,
        cell::{Tile, TileScratch},
        footprint::Footprint,
        lanes::KernelOptions,
        paint::Paint,
        project,
        project::Projected,
        rasterize::rasterize_tile,
        shade,
        store::PictureRows,
        tiles::{Grid, TileSpans},
    },
    gpu::internals::FootprintRow,
    oracle,
    view::View,
};

use crate::common::{both_kernels, cpu, gpu, judge, open, same};
use crate::oracle::lens;
use crate::reference::{emit_isects, prefix_sum, radix_sort, tile_ranges};
use segsplat_testing::compare::{Tolerance, compare, oracle_samples, samples};
use segsplat_testing::scenes::{
    BACKGROUND, Random, camera, checked, cloud, look, push, request, two_views,
};

fn view_of(gaussians: &Gaussians, request: &RenderRequest) -> View {
    View::new(gaussians.origin(), request).expect("a test view")
}

fn whole(view: &View) -> Grid {
    Grid::whole(view, KernelOptions::default())
}

/// The CPU's footprints and tile counts.
fn projected(gaussians: &Gaussians, request: &RenderRequest) -> Projected {
    let mut projected = Projected::default();
    let view = view_of(gaussians, request);
    let options = KernelOptions::default();
    project::project(gaussians, request, &view, options, &mut projected);
    projected
}

fn to_row(footprint: &Footprint) -> FootprintRow {
    FootprintRow {
        mean: footprint.mean.map(|v| v as f32),
        conic_shear: footprint.conic_shear as f32,
        conic_x: footprint.conic_x,
        conic_y: footprint.conic_y,
        power_max: footprint.power_max,
        opacity: footprint.opacity,
        depth: footprint.depth,
    }
}

fn to_footprint(row: &FootprintRow) -> Footprint {
    Footprint {
        mean: row.mean.map(f64::from),
        conic_shear: f64::from(row.conic_shear),
        conic_x: row.conic_x,
        conic_y: row.conic_y,
        power_max: row.power_max,
        opacity: row.opacity,
        depth: row.depth,
        color: [0.0; 3],
    }
}

/// Depth order of the visible, as the CPU sorts.
fn depth_order(projected: &Projected) -> Vec<u64> {
    let Projected { footprints, tiles_per_gauss: tiles, .. } = projected;
    let visible = (0..footprints.len()).filter(|&i| tiles[i] > 0);
    let mut pairs: Vec<u64> =
        visible.map(|i| radix_sort::pack(footprints[i].depth.to_bits(), i as u32)).collect();
    radix_sort::radix_sort(&mut pairs, &mut Vec::new(), 32);
    pairs
}

#[test]
fn prefix_sum_twin() {
    let Some(gpu) = gpu() else { return };
    let mut random = Random(1);
    for (columns, rows) in [(1, 1), (7, 1), (16, 16), (257, 1), (120, 68), (600, 500)] {
        let counts: Vec<u32> = (0..columns * rows).map(|_| (random.bits() % 900) as u32).collect();
        let mut want = Vec::new();
        prefix_sum::prefix_sum(counts.iter().copied(), &mut want);
        let want: Vec<u32> = want.into_iter().map(|sum| sum as u32).collect();
        let got = gpu.internals().prefix_sum(&counts, columns).expect("sums");
        assert!(got == want, "{columns} x {rows} tiles: sums differ");
    }
    let mut huge = vec![0; 3 * 1_024];
    (huge[5], huge[1_500], huge[1_501], huge[3_000]) = (u32::MAX - 5, 3, 3, 9);
    let sums = gpu.internals().prefix_sum(&huge, 1_024).expect("sums");
    let near = u32::MAX - 5;
    assert_eq!((sums[5], sums[6], sums[1_501]), (0, near, near + 3), "sums");
    assert_eq!((sums[1_502], sums[3_072]), (u32::MAX, u32::MAX), "they stay at the largest number");
}

/// A list of `count` pairs in no order, whose keys lie within `range`: equal ones too.
fn list(count: u32, range: u64, random: &mut Random) -> Vec<[u32; 2]> {
    let mut ids: Vec<u32> = (0..count).map(|i| 3 * i + 1).collect();
    for i in (1..ids.len()).rev() {
        ids.swap(i, (random.bits() % (i as u64 + 1)) as usize);
    }
    ids.into_iter().map(|id| [0x3f80_0000 + (random.bits() % range) as u32, id]).collect()
}

#[test]
fn tile_sort_twin() {
    for gpu in both_kernels() {
        let mut random = Random(2);
        let mut lists = Vec::new();
        // Around the powers of two, around a run, and of several runs: an even and an odd number
        // of rounds of merging.
        for count in [0, 1, 2, 3, 7, 8, 9, 31, 64, 255, 256, 257, 1_000, 2_047, 2_048, 2_049, 5_000]
        {
            for range in [1, 40, 1 << 22, 0xc000_0000] {
                lists.push(list(count, range, &mut random));
            }
        }
        lists.extend([10_000, 70_001].map(|count| list(count, 900, &mut random)));
        // One pair far behind the others: in 21 bits of that reach a few, many or all are equal.
        for (count, range) in [(1_000, 300_000), (2_048, 900_000), (5_000, 900_000), (500, 90)] {
            let mut near = list(count, range, &mut random);
            near.push([0xc000_0000, u32::MAX]);
            lists.push(near);
        }
        lists.push(Vec::new());
        let got = gpu.internals().tile_sort(&lists).expect("lists");
        for (got, mut want) in got.into_iter().zip(lists) {
            want.sort_unstable();
            assert!(got == want, "a list of {} pairs: order differs", want.len());
        }
    }
}

#[test]
fn project_twin() {
    let Some(gpu) = gpu() else { return };
    let mut turned = camera(320, 240);
    turned.camera_to_world =
        look(glam::DVec3::new(0.7, -0.9, -0.2), glam::DVec3::new(0.1, 0.2, 4.0));
    for antialiased in [false, true] {
        let gaussians = cloud(20_000, 0, 3);
        let request = RenderRequest { antialiased, ..request(turned) };
        let Projected { footprints, tiles_per_gauss: tiles, .. } = projected(&gaussians, &request);
        let got = gpu.internals().project(&gaussians, &request).expect("footprints");
        let (mut one_sided, mut keys_apart, mut both) = (0, 0, 0_u32);
        let (mut cpu_tiles, mut gpu_tiles) = (0_u64, 0_u64);
        for i in 0..gaussians.len() {
            let row = &got.footprints[i];
            let seen_tiles = got.touched[i];
            if tiles[i] == 0 || seen_tiles == 0 {
                one_sided += u32::from(tiles[i] != seen_tiles);
                continue;
            }
            both += 1;
            keys_apart += u32::from(row.depth.to_bits() != footprints[i].depth.to_bits());
            (cpu_tiles, gpu_tiles) =
                (cpu_tiles + u64::from(tiles[i]), gpu_tiles + u64::from(seen_tiles));
            assert!(seen_tiles >= tiles[i], "{i}: {} tiles, not {}", seen_tiles, tiles[i]);
            let want = to_row(&footprints[i]);
            let near = |name: &str, got: f32, want: f32, slack: f32| {
                let bound = slack + 2e-5 * want.abs();
                assert!((got - want).abs() <= bound, "{i}: {name} is {got}, not {want}");
            };
            for axis in 0..2 {
                near("mean", row.mean[axis], want.mean[axis], 1e-3);
            }
            near("conic_shear", row.conic_shear, want.conic_shear, 1e-4);
            near("conic_x", row.conic_x, want.conic_x, 0.0);
            near("conic_y", row.conic_y, want.conic_y, 0.0);
            near("power_max", row.power_max, want.power_max, 2e-5);
            near("opacity", row.opacity, want.opacity, 0.0);
        }
        println!("{both} visible, {one_sided} on one side only, {keys_apart} keys apart");
        println!("tiles: CPU {cpu_tiles}, GPU {gpu_tiles}");
        assert!(both > 5_000, "{both} Gaussians of a cloud seen");
        assert!(one_sided * 1_000 <= both, "{one_sided} of {both} seen by one renderer only");
        // Depth decides the picture: pairs of floats make the key exact but for double rounding.
        assert!(keys_apart * 10_000 <= both, "{keys_apart} of {both} depth keys differ");
        assert!(gpu_tiles * 100 <= cpu_tiles * 101, "{gpu_tiles} tiles against {cpu_tiles}");
        assert!(got.visible.abs_diff(both) <= one_sided, "{} visible, not {both}", got.visible);
        let sum = |counts: &[u32]| counts.iter().map(|&n| u64::from(n)).sum::<u64>();
        assert_eq!(sum(&got.tiles), sum(&got.touched), "counted in tiles");
    }
}

#[test]
fn shade_twin() {
    let Some(gpu) = gpu() else { return };
    for degree in 0..=3 {
        let gaussians = cloud(3_000, degree, 4);
        let request = request(camera(200, 150));
        let mut projected = projected(&gaussians, &request);
        let view = view_of(&gaussians, &request);
        shade::shade(&gaussians, &view, KernelOptions::default(), false, &mut projected);
        let Projected { footprints, tiles_per_gauss: tiles, .. } = projected;
        let got = gpu.internals().shade(&gaussians, &request, &tiles).expect("colours");
        let mut seen = 0;
        for i in (0..gaussians.len()).filter(|&i| tiles[i] > 0) {
            seen += 1;
            for (got, want) in got[i].iter().zip(&footprints[i].color) {
                assert!((got - want).abs() < 2e-5, "degree {degree}, {i}: {got}, not {want}");
            }
        }
        assert!(seen > 500, "degree {degree}: {seen} Gaussians seen");
    }
}

/// Needles and walls over many tiles, which a whole workgroup visits, between specks.
fn large_and_small() -> Gaussians {
    let (mut raw, mut random) = (RawGaussians::default(), Random(77));
    for i in 0..3_000 {
        let z = random.range(1.0, 6.0);
        let mean = [random.range(-0.8, 0.8) * z, random.range(-0.7, 0.7) * z, z];
        let scale = match i % 50 {
            0 => [random.range(0.1, 3.0), 1e-3, 1e-4],
            1 => [random.range(0.2, 1.0); 3],
            _ => [random.range(0.001, 0.02), random.range(0.001, 0.02), 0.01],
        };
        push(&mut raw, mean, random.quat(), scale, random.range(0.005, 1.0), &[[0.5; 3]]);
    }
    checked(raw)
}

#[test]
fn emit_isects_twin() {
    for (name, gaussians) in [("cloud", cloud(8_000, 0, 5)), ("large", large_and_small())] {
        let Some(gpu) = gpu() else { return };
        let request = request(camera(333, 222));
        let view = view_of(&gaussians, &request);
        let all = gpu.internals().project(&gaussians, &request).expect("footprints");
        let lists = gpu.internals().lists(&view, &all).expect("lists");
        let most = all.touched.iter().max();

        let grid = whole(&view);
        let rows = all.footprints.iter().zip(&all.touched);
        let seen = |(row, touched): (&FootprintRow, &u32)| match touched {
            0 => (TileSpans::default(), 0),
            _ => TileSpans::of(&to_footprint(row), &grid),
        };
        let (tile_spans, tiles_per_gauss) = rows.clone().map(seen).unzip();
        let footprints = all.footprints.iter().map(to_footprint).collect();
        let projected =
            Projected { footprints, tile_spans, tiles_per_gauss, ..Projected::default() };
        let order = depth_order(&projected);
        let (mut offsets, mut want) = (Vec::new(), Vec::new());
        let counts =
            order.iter().map(|&p| projected.tiles_per_gauss[radix_sort::value(p) as usize]);
        prefix_sum::prefix_sum(counts, &mut offsets);
        emit_isects::emit_isects(&projected, &order, &grid, &offsets, &mut want);

        let tiles = lists.iter().enumerate();
        let got: Vec<u64> = tiles
            .flat_map(|(tile, list)| list.iter().map(move |&[_, id]| (tile as u32, id)))
            .map(|(tile, id)| radix_sort::pack(tile, id))
            .collect();
        let set: std::collections::HashSet<u64> = got.iter().copied().collect();
        println!("{name}: {} pairs, {} wanted, most of one {most:?}", got.len(), want.len());
        let counted = |(list, &count): (&Vec<_>, &u32)| list.len() == count as usize;
        assert!(lists.iter().zip(&all.tiles).all(counted), "{name}: counted and not emitted");
        assert_eq!(set.len(), got.len(), "{name}: a pair was emitted twice");
        let missing = want.iter().filter(|pair| !set.contains(pair)).count();
        assert_eq!(missing, 0, "{name}: tiles that the CPU touches and the GPU does not");
        assert!(got.len() * 100 <= want.len() * 101, "{} against {}", got.len(), want.len());
        assert!(lists.iter().all(|list| list.is_sorted()), "{name}: lists are in order");
        let key = |&[key, id]: &[u32; 2]| key == all.footprints[id as usize].depth.to_bits();
        assert!(lists.iter().flatten().all(key), "{name}: keys are depths");
        let many = all.touched.iter().filter(|&&n| n > 64).count();
        assert!(many > 20, "{name}: {many} over many tiles");
    }
}

#[test]
fn rasterize_twin() {
    for gpu in both_kernels() {
        let (gaussians, middle) = two_views(96, 7);
        let request = request(middle);
        let view = view_of(&gaussians, &request);
        let mut projected = projected(&gaussians, &request);
        let order = depth_order(&projected);
        let (mut offsets, mut isects, mut ranges) = (vec![], vec![], vec![]);
        shade::shade(&gaussians, &view, KernelOptions::default(), false, &mut projected);
        let grid = whole(&view);
        let counts =
            order.iter().map(|&p| projected.tiles_per_gauss[radix_sort::value(p) as usize]);
        prefix_sum::prefix_sum(counts, &mut offsets);
        emit_isects::emit_isects(&projected, &order, &grid, &offsets, &mut isects);
        radix_sort::radix_sort(&mut isects, &mut Vec::new(), 16);
        tile_ranges::tile_ranges(&isects, grid.tile_count(), &mut ranges);

        let entries = gaussians.semantic_index();
        let paint = Paint::new(&request, &view, entries, 0.0, KernelOptions::default());
        let pixels = 96 * 96;
        let (mut color, mut depth, mut alpha) =
            (vec![[0.0; 3]; pixels], vec![0.0; pixels], vec![0.0; pixels]);
        for tile_y in 0..view.tiles_y() {
            let first = (tile_y * 16 * 96) as usize;
            let mut out = PictureRows {
                color: Some(color[first..].chunks_mut(96).take(16).collect()),
                depth: Some(depth[first..].chunks_mut(96).take(16).collect()),
                alpha: Some(alpha[first..].chunks_mut(96).take(16).collect()),
                ..PictureRows::default()
            };
            for tile_x in 0..view.tiles_x() {
                let id = (tile_y * view.tiles_x() + tile_x) as usize;
                let tile = Tile { x: tile_x * 16, y: tile_y * 16, width: 16, height: 16 };
                let sorted = &isects[ranges[id] as usize..ranges[id + 1] as usize];
                let ids = sorted.iter().map(|&isect| radix_sort::value(isect));
                let mut pairs: Vec<u64> =
                    (0..).zip(ids).map(|(at, id)| bin::pack(at, id)).collect();
                let (column, scratch) = (tile_x as usize * 16, &mut TileScratch::default());
                let footprints = &projected.footprints;
                rasterize_tile(footprints, &mut pairs, tile, column, &paint, scratch, &mut out);
            }
        }
        let rows: Vec<_> = projected.footprints.iter().map(to_row).collect();
        let colors: Vec<_> = projected.footprints.iter().map(|f| f.color).collect();
        let ids: Vec<u32> = isects.iter().map(|&pair| radix_sort::value(pair)).collect();
        let got = gpu
            .internals()
            .rasterize(&view, BACKGROUND, &rows, &colors, &ids, &ranges)
            .expect("pictures");
        let want = Frame {
            width: 96,
            height: 96,
            color: Some(color),
            depth: Some(depth),
            alpha: Some(alpha),
            ..Frame::default()
        };
        let got = Frame {
            color: Some(bytemuck::cast_slice(&got[..pixels * 3]).to_vec()),
            depth: Some(got[pixels * 3..pixels * 4].to_vec()),
            alpha: Some(got[pixels * 4..].to_vec()),
            width: 96,
            height: 96,
            ..Frame::default()
        };
        same("rasterize alone", &got, &want, &gaussians, &request);
    }
}

#[test]
fn every_harmonic_degree_and_camera_is_the_same() {
    for gpu in both_kernels() {
        for degree in 0..=3 {
            let gaussians = cloud(3_000, degree, 10 + u64::from(degree));
            judge(gpu, &format!("degree {degree}"), &gaussians, &request(camera(160, 120)));
        }
        let gaussians = cloud(4_000, 1, 21);
        for (fx, fy, cx, cy) in
            [(140.0, 90.0, 20.0, 100.0), (60.0, 200.0, 150.0, -10.0), (500.0, 480.0, 300.0, 60.0)]
        {
            let mut camera = camera(161, 119);
            let lens = &mut camera.intrinsics;
            (lens.fx, lens.fy, lens.cx, lens.cy) = (fx, fy, cx, cy);
            judge(gpu, &format!("principal point {cx} {cy}"), &gaussians, &request(camera));
        }
    }
}

#[test]
fn few_gaussians_are_the_same() {
    for gpu in both_kernels() {
        let none = checked(RawGaussians::default());
        let frame = judge(gpu, "none", &none, &request(camera(50, 30)));
        assert!(frame.color.expect("colour").iter().all(|c| *c == [0.1, 0.2, 0.3]), "background");

        let mut raw = RawGaussians::default();
        let quat = Random(8).quat();
        push(&mut raw, [0.1, 0.05, 2.0], quat, [0.2, 0.05, 0.01], 0.8, &[[1.0, -0.5, 0.3]]);
        let one = checked(raw);
        for side in [1, 15, 16, 17, 64] {
            judge(gpu, &format!("one at {side} px"), &one, &request(camera(side, side)));
        }
        let mut away = camera(40, 40);
        away.camera_to_world = look(glam::DVec3::ZERO, glam::DVec3::NEG_Z);
        let frame = judge(gpu, "looking away", &one, &request(away));
        assert_eq!(frame.stats.visible, 0, "nothing is behind the camera");
    }
}

#[test]
fn kinds_not_asked_for_are_not_given() {
    for gpu in both_kernels() {
        let gaussians = cloud(500, 0, 9);
        let all = gpu.render(&gaussians, &request(camera(70, 40))).expect("all kinds");
        for (color, depth, alpha) in
            [(true, false, false), (false, true, false), (false, false, true), (true, false, true)]
        {
            let kinds = Kinds { color, depth, alpha };
            let frame = gpu
                .render(&gaussians, &RenderRequest { kinds, ..request(camera(70, 40)) })
                .expect("some kinds");
            let colors = |frame: &Frame| frame.color.as_ref().map(|color| color.concat());
            for (name, wanted, got, want) in [
                ("colour", color, colors(&frame), colors(&all)),
                ("depth", depth, frame.depth.clone(), all.depth.clone()),
                ("alpha", alpha, frame.alpha.clone(), all.alpha.clone()),
            ] {
                assert_eq!(got.is_some(), wanted, "{kinds:?}: {name}");
                // Each set of kinds is a kernel of its own, which may round otherwise.
                for (got, want) in got.iter().flatten().zip(want.iter().flatten()) {
                    assert!((got - want).abs() <= 1e-5 * want.abs().max(1.0), "{kinds:?}: {name}");
                }
            }
        }
    }
}

#[test]
fn bands_and_growth_change_nothing() {
    let Some(gpu) = gpu() else { return };
    let (gaussians, middle) = two_views(64, 11);
    let request = request(middle);
    let want = gpu.render(&gaussians, &request).expect("a picture");
    let total = want.stats.intersections as u32;
    // One row of tiles of four fits, two do not.
    let Some(small) = open(|options| options.switches.isects_max = Some(total / 3)) else { return };
    let got = small.render(&gaussians, &request).expect("a picture in bands");
    assert_eq!(got.color, want.color, "colour in bands");
    assert_eq!(got.depth, want.depth, "depth in bands");
    assert_eq!(got.stats, want.stats, "counts in bands");

    let Some(tiny) = open(|options| options.switches.isects_max = Some(16)) else { return };
    let error = tiny.render(&gaussians, &request).expect_err("a row has more than 16 pairs");
    assert_eq!(error.code(), ErrorCode::LimitExceeded, "{error}");
    assert!(error.message().ends_with("is over 16"), "{error}");

    // Large footprints: more pairs than the first guess of four a Gaussian.
    let mut raw = RawGaussians::default();
    let mut random = Random(12);
    for _ in 0..2_000 {
        let mean = [random.range(-1.0, 1.0), random.range(-1.0, 1.0), random.range(2.0, 4.0)];
        push(&mut raw, mean, random.quat(), [0.5; 3], 0.02, &[[0.5, 0.1, -0.2]]);
    }
    let wide = checked(raw);
    let frame = judge(&small, "growth", &wide, &self::request(camera(16, 16)));
    assert!(frame.stats.intersections > 0, "something was drawn");
    judge(gpu, "growth", &wide, &self::request(camera(200, 200)));
}

#[test]
fn scenes_are_uploaded_once() {
    let Some(gpu) = open(|_| {}) else { return };
    let (a, b) = (cloud(100, 0, 14), cloud(100, 0, 15));
    for scene in [&a, &b, &a.clone(), &b] {
        gpu.render(scene, &request(camera(32, 32))).expect("a picture");
    }
    assert_eq!(gpu.internals().scenes_held(), 2, "clones share their upload");
}

#[test]
fn lenses_of_all_widths_agree() {
    let gaussians = cloud(4_000, 1, 40);
    for gpu in both_kernels() {
        for degrees in [0.1, 1.0, 133.0, 160.0, 170.0, 175.0] {
            judge(gpu, &format!("{degrees} degrees"), &gaussians, &request(lens(degrees)));
        }
    }
}

/// Equal depths are no cliff: the order of the scene decides.
#[test]
fn equal_depths_are_drawn_in_the_order_of_the_scene() {
    let mut raw = cloud(600, 0, 44).into_raw();
    raw.means.iter_mut().for_each(|mean| mean[2] = 4.0);
    raw.scales.iter_mut().flatten().for_each(|scale| *scale = scale.clamp(0.05, 0.4));
    let gaussians = checked(raw);
    let request = request(camera(64, 48));
    let truth = oracle::render(&gaussians, &request).expect("the truth");
    let cliff: Vec<bool> = truth.iter().map(|pixel| pixel.cliff.same_order()).collect();
    let cpu = cpu();
    let renderers = both_kernels().map(|gpu| gpu as &dyn Renderer);
    for renderer in renderers.chain([&cpu as &dyn Renderer]) {
        let frame = samples(&renderer.render(&gaussians, &request).expect("a picture"));
        compare(&frame, &oracle_samples(&truth), &cliff, Tolerance::ORACLE)
            .unwrap_or_else(|told| panic!("{}: {told}", renderer.name()));
    }
}
