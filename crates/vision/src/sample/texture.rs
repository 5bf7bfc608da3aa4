//! Solid textures that do not repeat: band-limited value noise.
//!
//! In: a point in the object's own frame and the size of a pixel there. Out: linear albedo. Octaves
//! finer than a pixel fade out, so pictures do not alias.

use glam::{DVec2, DVec3};

/// What a surface is made of.
#[derive(Clone, Copy, Debug)]
pub(super) enum Material {
    /// Boards along z with grain, each board of its own tone.
    Boards,
    /// Rough paint with stains.
    Plaster(DVec3),
    /// Printed paper: leaves of two colours strewn on a ground.
    Leaves(DVec3, DVec3),
    /// Veined stone.
    Marble(DVec3, DVec3),
    /// A box of cardboard with a printed label.
    Carton(DVec3, DVec3),
    /// Stripes of uneven width along y, as a pile of books.
    Stack,
    /// A painting: warped patches of many colours.
    Painting,
    /// A knotted rug: small cells of five colours.
    Rug,
}

/// Value of the lattice point, 0..1.
fn lattice(x: i64, y: i64, z: i64, seed: u64) -> f64 {
    let mut h = seed
        ^ (x as u64).wrapping_mul(0x9E37_79B9_7F4A_7C15)
        ^ (y as u64).wrapping_mul(0xC2B2_AE3D_27D4_EB4F)
        ^ (z as u64).wrapping_mul(0x1656_67B1_9E37_79F9);
    h = (h ^ (h >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    h = (h ^ (h >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    ((h ^ (h >> 31)) >> 11) as f64 / (1_u64 << 53) as f64
}

/// A number 0..1 for each `index`, by `seed`.
pub(super) fn random(index: u64, seed: u64) -> f64 {
    lattice(index as i64, 17, -5, seed)
}

/// Smooth value noise of wavelength 1, 0..1.
fn noise(p: DVec3, seed: u64) -> f64 {
    let cell = p.floor();
    let f = p - cell;
    let w = f * f * f * (f * (f * 6.0 - 15.0) + 10.0);
    let (x, y, z) = (cell.x as i64, cell.y as i64, cell.z as i64);
    let edge = |dy: i64, dz: i64| {
        let a = lattice(x, y + dy, z + dz, seed);
        a + (lattice(x + 1, y + dy, z + dz, seed) - a) * w.x
    };
    let face = |dz: i64| edge(0, dz) + (edge(1, dz) - edge(0, dz)) * w.y;
    face(0) + (face(1) - face(0)) * w.z
}

/// Fractal noise about 0 (within about ±1): octaves from `wavelength` down to twice the pixel.
fn fractal(p: DVec3, mut wavelength: f64, gain: f64, pixel: f64, seed: u64) -> f64 {
    let (mut sum, mut amplitude, mut octave) = (0.0, 1.0, 0);
    while octave < 9 && wavelength > pixel {
        let fade = (wavelength / pixel - 1.0).min(1.0);
        sum += amplitude * fade * (noise(p / wavelength, seed + octave) * 2.0 - 1.0);
        amplitude *= gain;
        wavelength *= 0.47;
        octave += 1;
    }
    sum * (1.0 - gain)
}

/// Distances to the nearest and second nearest strewn point of wavelength 1, and its number.
fn cells(p: DVec2, seed: u64) -> (f64, f64, f64) {
    let base = p.floor();
    let (mut first, mut second, mut id) = (f64::MAX, f64::MAX, 0.0);
    for dy in -1..=1 {
        for dx in -1..=1 {
            let (x, y) = (base.x as i64 + dx, base.y as i64 + dy);
            let jitter = DVec2::new(lattice(x, y, 1, seed), lattice(x, y, 2, seed));
            let d = (DVec2::new(x as f64, y as f64) + jitter).distance(p);
            if d < first {
                (second, first, id) = (first, d, lattice(x, y, 3, seed));
            } else if d < second {
                second = d;
            }
        }
    }
    (first, second, id)
}

/// 0 below `low`, 1 above `high`, smooth between; `pixel` widens the step against aliasing.
fn step(low: f64, high: f64, pixel: f64, value: f64) -> f64 {
    let middle = (low + high) / 2.0;
    let half = ((high - low) / 2.0).max(pixel / 2.0);
    let t = ((value - middle) / half * 0.5 + 0.5).clamp(0.0, 1.0);
    t * t * (3.0 - 2.0 * t)
}

fn mix(a: DVec3, b: DVec3, t: f64) -> DVec3 {
    a + (b - a) * t
}

/// A pleasant colour for a number 0..1.
pub(super) fn hue(t: f64) -> DVec3 {
    const PALETTE: [DVec3; 7] = [
        DVec3::new(0.52, 0.10, 0.07),
        DVec3::new(0.68, 0.42, 0.10),
        DVec3::new(0.12, 0.26, 0.13),
        DVec3::new(0.07, 0.17, 0.36),
        DVec3::new(0.62, 0.57, 0.46),
        DVec3::new(0.28, 0.12, 0.22),
        DVec3::new(0.10, 0.33, 0.36),
    ];
    PALETTE[((t * 7.0) as usize).min(6)]
}

impl Material {
    /// Linear albedo at `p` (the object's frame), on the face with coordinates `uv`.
    pub(super) fn albedo(self, p: DVec3, uv: DVec2, pixel: f64, seed: u64) -> DVec3 {
        let grain = |wavelength: f64, gain: f64, salt: u64| {
            fractal(p, wavelength, gain, pixel, seed ^ (salt << 32))
        };
        let colour = match self {
            Self::Boards => {
                let board = (p.x / 0.23).floor();
                let tone = lattice(board as i64, 0, 9, seed);
                let along = DVec3::new(p.x * 9.0, 0.0, p.z * 0.8 + tone * 40.0);
                let rings = fractal(along, 0.9, 0.62, pixel * 3.0, seed);
                let gap = ((p.x / 0.23 - board) - 0.5).abs() * 0.23;
                let wood = mix(
                    DVec3::new(0.17, 0.085, 0.04),
                    DVec3::new(0.46, 0.29, 0.15),
                    (0.45 + 0.5 * (tone - 0.5) + 0.75 * rings).clamp(0.0, 1.0),
                );
                wood * (1.0 - 0.7 * step(0.109, 0.113, pixel, gap))
            }
            Self::Plaster(base) => base * (1.0 + 0.22 * grain(1.3, 0.5, 1)),
            Self::Leaves(ground, leaf) => {
                let bend = DVec2::new(grain(0.5, 0.5, 2), grain(0.5, 0.5, 3)) * 0.5;
                let (first, second, id) = cells(uv / 0.19 + bend, seed);
                let cover = step(0.06, 0.11, pixel / 0.19, second - first)
                    * (1.0 - step(0.36, 0.42, pixel / 0.19, first));
                let tint = mix(leaf, hue(id), 0.55) * (0.7 + 0.6 * id);
                mix(ground * (1.0 + 0.15 * grain(0.6, 0.55, 4)), tint, cover * 0.85)
            }
            Self::Marble(light, vein) => {
                let bent = 2.6 * p.dot(DVec3::new(1.0, 0.8, 0.6)) + 2.2 * grain(0.45, 0.55, 5);
                let wave = (2.0 * (bent - bent.floor()) - 1.0).abs();
                mix(vein, light, wave.powf(0.6)) * (1.0 + 0.2 * grain(0.12, 0.6, 6))
            }
            Self::Carton(paper, ink) => {
                let label = uv - DVec2::splat(0.02);
                let inside = step(0.13, 0.135, pixel, 0.27 - label.abs().max_element());
                let row = (label.y / 0.035).floor();
                let word = fractal(DVec3::new(label.x, row, 0.0), 0.03, 0.4, pixel, seed);
                let line = step(0.2, 0.3, pixel / 0.035, (label.y / 0.035 - row) - 0.25);
                let text = step(-0.05, 0.05, 0.0, word) * line;
                let print = mix(DVec3::splat(0.72), ink, 0.85 * text);
                mix(paper * (1.0 + 0.35 * grain(0.3, 0.6, 7)), print, inside)
            }
            Self::Stack => {
                let mut top = 0.0;
                let mut book = 0;
                while top < p.y + 2.0 && book < 80 {
                    top += 0.045 + 0.05 * random(book, seed);
                    book += 1;
                }
                let pages = 0.06 * grain(0.02, 0.6, 8);
                let edge = step(0.0, 0.006, pixel, top - (p.y + 2.0));
                let cover = hue(random(book + 100, seed)) * (0.8 + 0.5 * grain(0.1, 0.65, 9));
                (cover + DVec3::splat(pages)) * (0.35 + 0.65 * edge)
            }
            Self::Painting => {
                let bend = DVec2::new(grain(0.4, 0.5, 10), grain(0.4, 0.5, 11)) * 0.35;
                let (_, _, id) = cells((uv + bend) / 0.21, seed);
                hue(id) * (1.0 + 0.55 * grain(0.15, 0.65, 12)) * 1.15
            }
            Self::Rug => {
                let (first, second, id) = cells(uv / 0.085, seed);
                let band = hue((grain(0.9, 0.4, 13) * 0.5 + 0.5).clamp(0.0, 0.999));
                let knot = mix(band, hue(id), 0.4) * (1.05 + 0.4 * grain(0.05, 0.6, 14));
                knot * (0.6 + 0.4 * step(0.0, 0.25, pixel / 0.085, second - first))
            }
        };
        let dust = 1.0 + 0.16 * grain(0.035, 0.7, 15);
        (colour * dust).clamp(DVec3::splat(0.012), DVec3::splat(0.92))
    }
}
