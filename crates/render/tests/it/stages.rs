//! Single stages of the CPU renderer.

use segsplat_core::scene::{Gaussians, RawGaussians};
use segsplat_render::{
    Layer, Source,
    constants::TILE_SIZE,
    cpu::{
        bin::{DepthKeys, bin, pack},
        footprint::Footprint,
        lanes::KernelOptions,
        project::{Projected, project},
        tiles::{Grid, TileSpans, touched_tiles},
    },
    switches::Width,
    view::View,
};
use segsplat_testing::scenes::{Random, camera, checked, cloud, push, request};

#[test]
fn each_tile_gets_the_gaussians_that_touch_it_those_of_photos_behind_last() {
    // More than one chunk.
    let gaussians = cloud(5_000, 0, 3);
    let request = request(camera(203, 150));
    let view = View::new(gaussians.origin(), &request).expect("a view");
    let grid = Grid::whole(&view, KernelOptions::default());
    let mut projected = Projected::default();
    project(&gaussians, &request, &view, KernelOptions::default(), &mut projected);
    let mut want = vec![Vec::new(); grid.tile_count() as usize];
    let seen = |id: &usize| projected.tiles_per_gauss[*id] > 0;
    for id in (0..gaussians.len()).filter(seen) {
        let footprint = &projected.footprints[id];
        touched_tiles(footprint, &grid, |tile_y, tiles| {
            for tile_x in tiles {
                let pair = pack(footprint.depth.to_bits(), id as u32);
                want[(tile_y * grid.tiles_x() + tile_x) as usize].push(pair);
            }
        });
    }
    let total: usize = want.iter().map(Vec::len).sum();
    let source = |behind| {
        let layer = Layer::behind_if(behind);
        Source { center: [0.0; 3], axis: [0.0; 3], scale: 0.0, layer }
    };
    for behind in [false, true] {
        let sources = [source(behind)];
        let mut bins = Vec::new();
        let keys = DepthKeys::new(&gaussians, &sources);
        let all = total as u64;
        assert_eq!(bin(&projected, keys, &grid, all, &mut bins), all, "pairs");
        assert!(bins.len() > 1, "one chunk");
        for (tile, want) in want.iter().enumerate() {
            let got: Vec<u64> = bins.iter().flat_map(|bins| bins.of(tile)).copied().collect();
            let bit = u64::from(behind) << 63;
            let want: Vec<u64> = want.iter().map(|pair| pair | bit).collect();
            assert_eq!(got, want, "tile {tile}, behind: {behind}");
        }
        assert_eq!(bin(&projected, keys, &grid, all - 1, &mut bins), all, "the count is right");
    }
}

/// Every pixel centre inside the ellipse lies in a touched tile, and every tile touched comes
/// near the ellipse.
#[test]
fn touched_tiles_hold_every_pixel_of_the_ellipse() {
    let grid = Grid { width: 203, height: 150, tile_rows: 0..10, by_ellipse: true };
    let mut touched_total = 0;
    for i in 0..2_000_u32 {
        let random = |k: u32| f64::from((i.wrapping_mul(2_654_435_761) >> k) & 0xff) / 255.0;
        let footprint = Footprint {
            mean: [random(3) * 300.0 - 50.0, random(9) * 250.0 - 50.0],
            conic_shear: random(12) * 8.0 - 4.0,
            conic_x: (0.01 + random(17)) as f32,
            conic_y: (0.02 + random(21) * random(2)) as f32,
            power_max: (random(6) * 5.5) as f32,
            ..Footprint::default()
        };
        let mut touched = vec![false; grid.tile_count() as usize];
        touched_tiles(&footprint, &grid, |tile_y, tiles| {
            for tile_x in tiles {
                touched[(tile_y * grid.tiles_x() + tile_x) as usize] = true;
                touched_total += 1;
            }
        });
        let (spans, count) = TileSpans::of(&footprint, &grid);
        let mut replayed = vec![false; touched.len()];
        spans.replay(&footprint, &grid, |tile_y, tiles| {
            for tile_x in tiles {
                replayed[(tile_y * grid.tiles_x() + tile_x) as usize] = true;
            }
        });
        assert_eq!(replayed, touched, "count and emission of {footprint:?}");
        let told = touched.iter().filter(|&&t| t).count();
        assert_eq!(count as usize, told, "count of {footprint:?}");
        let band = Grid { tile_rows: 3..5, ..grid.clone() };
        let in_band = touched[3 * 13..5 * 13].iter().filter(|&&t| t).count();
        assert_eq!(spans.count(&footprint, &band) as usize, in_band, "band of {footprint:?}");
        let power = |x: f64, y: f64| {
            let (dx, dy) = (x - footprint.mean[0], y - footprint.mean[1]);
            (f64::from(footprint.conic_x) * (dx - footprint.conic_shear * dy)).powi(2)
                + (f64::from(footprint.conic_y) * dy).powi(2)
        };
        for y in 0..grid.height {
            for x in 0..grid.width {
                let inside =
                    power(f64::from(x) + 0.5, f64::from(y) + 0.5) < footprint.power_max.into();
                let tile = y / TILE_SIZE * grid.tiles_x() + x / TILE_SIZE;
                assert!(
                    !inside || touched[tile as usize],
                    "pixel {x},{y} of {footprint:?} is left out"
                );
            }
        }
        // No tile more than half a pixel away from the ellipse: a fine search over the tile.
        for (tile, _) in touched.iter().enumerate().filter(|(_, t)| **t) {
            let (tx, ty) = (tile as u32 % grid.tiles_x(), tile as u32 / grid.tiles_x());
            let near = (0..=32).any(|j| {
                (0..=32).any(|k| {
                    let x = f64::from(tx * TILE_SIZE) + f64::from(k) * 0.5;
                    let y = f64::from(ty * TILE_SIZE) + f64::from(j) * 0.5;
                    power(x, y) < f64::from(footprint.power_max) * 1.05 + 1.5
                })
            });
            assert!(near, "tile {tx},{ty} is far from {footprint:?}");
        }
    }
    assert!(touched_total > 1_000, "the test saw {touched_total} tiles only");
}

/// Gaussians of all shapes: needles, walls, specks, some at the edges and far beside the picture.
fn shapes() -> Gaussians {
    let (mut raw, mut random) = (RawGaussians::default(), Random(52));
    for i in 0..4_000 {
        let z = random.range(1.0, 6.0);
        let beside = if i % 97 == 0 { 1e6 } else { 1.0 };
        let mean = [random.range(-0.8, 0.8) * z * beside, random.range(-0.7, 0.7) * z, z];
        let scale = match i % 4 {
            0 => [random.range(0.1, 9.0), 1e-3, 1e-4],
            1 => [random.range(0.5, 3.0); 3],
            2 => [1e-6; 3],
            _ => [random.range(0.001, 0.1), random.range(0.001, 0.1), 0.01],
        };
        push(&mut raw, mean, random.quat(), scale, random.range(0.005, 1.0), &[[0.5; 3]]);
    }
    checked(raw)
}

#[test]
fn ellipses_in_lanes_touch_the_tiles_that_one_alone_touches() {
    let (gaussians, request) = (shapes(), request(camera(203, 150)));
    let view = View::new(gaussians.origin(), &request).expect("a view");
    for width in Width::ALL.into_iter().filter(|width| width.available()) {
        let options = KernelOptions { width, ..KernelOptions::default() };
        let grid = Grid::whole(&view, options);
        let mut projected = Projected::default();
        project(&gaussians, &request, &view, options, &mut projected);
        let (mut seen, mut tall) = (0, 0);
        for (i, footprint) in projected.footprints.iter().enumerate() {
            if footprint.opacity == 0.0 {
                continue;
            }
            // What a span says counts, not how an empty one is written.
            let tiles = |spans: &TileSpans| {
                let mut tiles = Vec::new();
                spans.replay(footprint, &grid, |y, xs| tiles.push((y, xs)));
                tiles
            };
            let (want, count) = TileSpans::of(footprint, &grid);
            assert_eq!(projected.tiles_per_gauss[i], count, "{width:?}, count of {footprint:?}");
            let got = tiles(&projected.tile_spans[i]);
            assert_eq!(got, tiles(&want), "{width:?}, {footprint:?}");
            seen += usize::from(count > 0);
            tall += usize::from(got.len() > 2);
        }
        assert!(seen > 2_000 && tall > 500, "{width:?}: {seen} seen, {tall} of them tall");
    }
}
