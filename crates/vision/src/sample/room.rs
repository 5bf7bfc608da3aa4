//! A room with boxes, balls and a pillar, a corridor and a turntable, and the ray caster that gives
//! their true pictures.
//!
//! Room frame: OpenCV, +y down, the floor at y = 0. Area lamps give soft shadows on matt surfaces,
//! so a point has the same colour from everywhere; but what stands on a turntable turns under them.

use glam::{DVec2, DVec3};
use rayon::prelude::*;

use super::texture::{Material, hue, random};
use crate::scene::{Camera, Photo};

/// Rays a pixel, per side.
const SUPERSAMPLE: u32 = 3;
/// Shadow rays to a lamp for each ray of a pixel, per side; the rays of a pixel interleave theirs.
const LAMP_SAMPLES: u32 = 2;
/// Brightness of the pictures.
const EXPOSURE: f64 = 1.6;
/// Half extents of the room, x and z, and its height.
const ROOM: DVec3 = DVec3::new(2.7, 2.9, 5.2);
/// The back wall stands here; the room reaches `ROOM.z` behind the cameras.
const BACK_WALL: f64 = 2.0;
/// Corners of the corridor: least and largest.
const CORRIDOR: [DVec3; 2] = [DVec3::new(-1.1, -2.5, -1.5), DVec3::new(1.1, 0.0, 12.0)];
/// Factor on the square of the radius of the ball around a thing, for rounding.
const BALL_MARGIN: f64 = 1.0 + 1e-6;
/// Paper behind the turntable, linear light.
const PAPER: DVec3 = DVec3::new(0.36, 0.37, 0.39);

/// The true picture and depth at one camera.
#[derive(Clone, Debug)]
pub struct TrueView {
    /// 8-bit sRGB pixels.
    pub photo: Photo,
    /// `[H * W]` z-depth at the pixel centres, room units.
    pub depth: Vec<f32>,
    /// `[H * W]` number of the thing at the pixel centres; 0 is the room itself.
    pub things: Vec<u8>,
}

#[derive(Clone, Copy, Debug)]
enum Shape {
    /// Half extents; turned about y.
    Block(DVec3),
    /// Radius.
    Ball(f64),
    /// Radius and half height, standing.
    Pillar(f64, f64),
    /// The room itself, seen from inside: its least and largest corner.
    Walls(DVec3, DVec3),
}

#[derive(Clone, Copy, Debug)]
struct Thing {
    shape: Shape,
    at: DVec3,
    turn: DVec2,
    material: Material,
    seed: u64,
}

/// Distance, normal and face coordinates of a hit, in the thing's frame.
struct Hit {
    t: f64,
    normal: DVec3,
    uv: DVec2,
}

#[derive(Clone, Copy, Debug)]
struct Lamp {
    at: DVec3,
    side_a: DVec3,
    side_b: DVec3,
    power: DVec3,
}

/// A furnished room; the seed decides where things stand and what they are made of.
#[derive(Clone, Debug)]
pub struct Room {
    things: Vec<Thing>,
    lamps: Vec<Lamp>,
    /// Largest corner: where walls take light from what is near.
    high: DVec3,
    /// The lamps stay where the camera is, and paper is behind the things.
    turns: bool,
}

impl Room {
    /// The room of this seed.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        let dice = |i: u64| random(i, seed);
        let between = |i: u64, low: f64, high: f64| low + (high - low) * dice(i);
        let thing = |shape, at, angle: f64, material, salt: u64| Thing {
            shape,
            at,
            turn: DVec2::new(angle.cos(), angle.sin()),
            material,
            seed: seed.wrapping_mul(1_000_003) ^ salt,
        };
        let block = |i: u64, x: f64, z: f64, half: DVec3, material| {
            let at = DVec3::new(x + between(i, -0.1, 0.1), -half.y, z + between(i + 1, -0.1, 0.1));
            thing(Shape::Block(half), at, between(i + 2, -0.6, 0.6), material, i)
        };
        let ball = |i: u64, x: f64, z: f64, base: f64, material| {
            let radius = base * between(i, 0.85, 1.15);
            let at = DVec3::new(x, -radius, z + between(i + 1, -0.1, 0.1));
            thing(Shape::Ball(radius), at, between(i + 2, 0.0, 3.0), material, i)
        };
        let carton = Material::Carton(DVec3::new(0.36, 0.24, 0.13), hue(dice(1)));
        let stone = Material::Marble(DVec3::new(0.66, 0.64, 0.60), hue(dice(2)) * 0.6);
        let green = Material::Marble(DVec3::new(0.20, 0.38, 0.26), DVec3::new(0.05, 0.10, 0.08));
        let leaves = Material::Leaves(DVec3::new(0.60, 0.55, 0.44), hue(dice(3)));
        let cloth = Material::Leaves(hue(dice(4)), DVec3::new(0.62, 0.54, 0.36));
        let clay = Material::Leaves(DVec3::new(0.50, 0.24, 0.14), DVec3::new(0.62, 0.50, 0.30));
        let low = DVec3::new(-ROOM.x, -ROOM.y, -ROOM.z);
        let high = DVec3::new(ROOM.x, 0.0, BACK_WALL);
        let mut things = vec![
            thing(Shape::Walls(low, high), DVec3::ZERO, 0.0, leaves, 50),
            block(60, 0.1, 0.55, DVec3::new(0.62, 0.36, 0.34), carton),
            block(63, -1.0, 0.9, DVec3::new(0.33, 0.62, 0.28), cloth),
            block(66, 1.35, 0.95, DVec3::new(0.36, 0.44, 0.3), Material::Stack),
            block(69, -0.75, -0.45, DVec3::new(0.27, 0.15, 0.2), Material::Painting),
            ball(72, 0.62, -0.42, 0.27, stone),
            ball(75, -0.12, -0.85, 0.18, green),
            ball(78, 1.25, -0.25, 0.22, Material::Rug),
            thing(
                Shape::Pillar(0.17, 0.3),
                DVec3::new(between(81, -0.25, 0.3), -1.02, between(82, 0.45, 0.65)),
                0.0,
                clay,
                81,
            ),
            thing(
                Shape::Block(DVec3::new(0.62, 0.46, 0.03)),
                DVec3::new(between(83, -0.5, 0.3), -1.75, BACK_WALL),
                0.0,
                Material::Painting,
                83,
            ),
        ];
        let rug = DVec3::new(1.25, 0.008, 0.8);
        things.push(block(84, 0.2, -0.45, rug, Material::Rug));
        let swing = random(40, seed) - 0.5;
        let lamps = vec![
            Lamp {
                at: DVec3::new(-1.1 + swing, -2.85, -1.0),
                side_a: DVec3::X * 1.1,
                side_b: DVec3::Z * 1.1,
                power: DVec3::new(8.6, 7.9, 6.9),
            },
            Lamp {
                at: DVec3::new(2.65, -1.9, -0.9),
                side_a: DVec3::Y * 1.3,
                side_b: DVec3::Z * 1.5,
                power: DVec3::new(3.4, 4.0, 4.9),
            },
        ];
        Self { things, lamps, high, turns: false }
    }

    /// A corridor along z with pictures, doors that are all alike, and boxes on the floor.
    #[must_use]
    pub fn corridor(seed: u64) -> Self {
        let between = |i: u64, low: f64, high: f64| low + (high - low) * random(i, seed);
        let own = |salt: u64| seed.wrapping_mul(1_000_003) ^ salt;
        let thing = |shape, at, turn, material, seed| Thing { shape, at, turn, material, seed };
        let [low, high] = CORRIDOR;
        let leaves = Material::Leaves(DVec3::new(0.60, 0.55, 0.44), hue(random(3, seed)));
        let mut things =
            vec![thing(Shape::Walls(low, high), DVec3::ZERO, DVec2::X, leaves, own(50))];
        let door = Material::Marble(hue(random(5, seed)), DVec3::new(0.20, 0.14, 0.10));
        let materials = [Material::Painting, Material::Rug, leaves, Material::Stack];
        for i in 0..12_u64 {
            let side = if i % 2 == 0 { 1.0 } else { -1.0 };
            let z = 1.0 + 0.85 * i as f64 + between(100 + i, -0.2, 0.2);
            let (half, y, material, seed) = match i % 3 {
                0 => (DVec3::new(0.03, 1.0, 0.42), -1.0, door, own(60)),
                _ => {
                    let half = DVec3::new(0.02, between(140 + i, 0.25, 0.5), 0.35);
                    let picture = materials[(i as usize / 3) % 2];
                    (half, between(120 + i, -1.7, -1.3), picture, own(160 + i))
                }
            };
            let at = DVec3::new(side * high.x, y, z);
            things.push(thing(Shape::Block(half), at, DVec2::X, material, seed));
        }
        for i in 0..4_u64 {
            let half = DVec3::from_array([200, 210, 220].map(|salt| between(salt + i, 0.12, 0.28)));
            let side = if random(230 + i, seed) < 0.5 { 0.75 } else { -0.75 };
            let at = DVec3::new(side, -half.y, 2.2 + 1.6 * i as f64 + between(240 + i, -0.3, 0.3));
            let angle = between(250 + i, -0.6, 0.6);
            let turn = DVec2::new(angle.cos(), angle.sin());
            let material = materials[i as usize];
            things.push(thing(Shape::Block(half), at, turn, material, own(260 + i)));
        }
        let lamp = |z: f64| Lamp {
            at: DVec3::new(0.0, low.y + 0.05, z),
            side_a: DVec3::X * 0.8,
            side_b: DVec3::Z * 2.0,
            power: DVec3::new(5.2, 5.0, 4.7),
        };
        Self { things, lamps: vec![lamp(1.5), lamp(6.0)], high, turns: false }
    }

    /// Things on a round plate, which turns with them before paper: the lamps go round with the
    /// camera.
    #[must_use]
    pub fn turntable(seed: u64) -> Self {
        let between = |i: u64, low: f64, high: f64| low + (high - low) * random(i, seed);
        let thing = |shape, x: f64, y: f64, z: f64, angle: f64, material, salt: u64| Thing {
            shape,
            at: DVec3::new(x, y, z),
            turn: DVec2::new(angle.cos(), angle.sin()),
            material,
            seed: seed.wrapping_mul(1_000_003) ^ salt,
        };
        let carton = Material::Carton(DVec3::new(0.36, 0.24, 0.13), hue(random(1, seed)));
        let stone = Material::Marble(DVec3::new(0.66, 0.64, 0.60), hue(random(2, seed)) * 0.6);
        let cloth = Material::Leaves(hue(random(4, seed)), DVec3::new(0.62, 0.54, 0.36));
        let plate = match seed % 3 {
            0 => Material::Rug,
            1 => Material::Boards,
            _ => cloth,
        };
        let tall = between(300, 0.25, 0.45);
        let half = DVec3::new(between(301, 0.16, 0.26), tall, between(302, 0.14, 0.24));
        let radius = between(303, 0.12, 0.18);
        let pillar = [between(304, 0.09, 0.13), between(305, 0.15, 0.28)];
        let things = vec![
            thing(Shape::Pillar(0.75, 0.03), 0.0, 0.03, 0.0, 0.0, plate, 50),
            thing(Shape::Block(half), -0.1, -half.y, 0.05, between(306, 0.0, 3.0), carton, 60),
            thing(Shape::Ball(radius), 0.38, -radius, -0.2, between(307, 0.0, 3.0), stone, 61),
            thing(
                Shape::Pillar(pillar[0], pillar[1]),
                0.2,
                -pillar[1],
                0.42,
                0.0,
                Material::Painting,
                62,
            ),
            thing(
                Shape::Block(DVec3::new(0.14, 0.08, 0.1)),
                -0.25,
                -0.08,
                -0.42,
                between(308, 0.0, 3.0),
                Material::Stack,
                63,
            ),
        ];
        let lamps = vec![
            Lamp {
                at: DVec3::new(-1.2, -2.4, -1.2),
                side_a: DVec3::X,
                side_b: DVec3::Z,
                power: DVec3::new(7.0, 6.8, 6.4),
            },
            Lamp {
                at: DVec3::new(1.8, -1.6, -1.0),
                side_a: DVec3::Y,
                side_b: DVec3::Z,
                power: DVec3::new(3.0, 3.2, 3.5),
            },
        ];
        Self { things, lamps, high: DVec3::new(9.0, 0.0, 9.0), turns: true }
    }

    /// The true picture and depth at `camera`.
    #[must_use]
    pub fn view(&self, camera: &Camera) -> TrueView {
        self.view_by(camera, SUPERSAMPLE)
    }

    /// As [`Self::view`], by `side` times `side` rays a pixel.
    #[must_use]
    pub fn view_by(&self, camera: &Camera, side: u32) -> TrueView {
        let k = camera.intrinsics;
        let (rotation, eye) = (camera.camera_to_world.rotation(), camera.camera_to_world.center());
        let (width, height) = (k.width as usize, k.height as usize);
        let lamps = self.lamps_by(eye);
        let pixels: Vec<([u8; 3], f32, u8)> = (0..width * height)
            .into_par_iter()
            .map(|i| {
                let (x, y) = ((i % width) as f64, (i / width) as f64);
                let ray = |dx: f64, dy: f64| rotation * k.unproject(x + dx, y + dy, 1.0);
                let mut light = DVec3::ZERO;
                for s in 0..side * side {
                    let offset = |v: u32| (f64::from(v) + 0.5) / f64::from(side);
                    let shift = DVec2::new(offset(s % side), offset(s / side));
                    let ray = ray(shift.x, shift.y);
                    light += self.radiance(&lamps, eye, ray, 1.0 / k.fx.min(k.fy), shift);
                }
                let mean = light * EXPOSURE / f64::from(side * side);
                let middle = self.nearest(eye, ray(0.5, 0.5));
                let (depth, thing) = middle.map_or((0.0, 0), |(i, hit)| (hit.t, i as u8));
                (mean.to_array().map(srgb), depth as f32, thing)
            })
            .collect();
        let rgb = pixels.iter().flat_map(|(rgb, ..)| *rgb).collect();
        let photo = Photo { width: k.width, height: k.height, rgb, valid: None };
        let (depth, things) = pixels.into_iter().map(|(_, depth, thing)| (depth, thing)).unzip();
        TrueView { photo, depth, things }
    }

    /// Linear light along a ray of z-depth speed 1; `pixel` is a pixel's size at depth 1 and
    /// `shift` (0..1, two axes) moves the shadow rays within their strata.
    fn radiance(&self, lamps: &[Lamp], eye: DVec3, ray: DVec3, pixel: f64, shift: DVec2) -> DVec3 {
        let Some((i, hit)) = self.nearest(eye, ray) else {
            return if self.turns { PAPER } else { DVec3::ZERO };
        };
        let thing = &self.things[i];
        let world = eye + ray * hit.t;
        let local = thing.to_local(world - thing.at);
        let normal = thing.to_world(hit.normal);
        let slant = (-normal.dot(ray.normalize())).max(0.15);
        let material = match thing.shape {
            Shape::Walls(..) if hit.normal.y < -0.5 => Material::Boards,
            Shape::Walls(..) if hit.normal.z > -0.5 => {
                Material::Plaster(DVec3::new(0.55, 0.52, 0.47))
            }
            _ => thing.material,
        };
        let albedo = material.albedo(local, hit.uv, pixel * hit.t / slant, thing.seed);
        albedo * self.irradiance(lamps, world + normal * 1e-6, normal, shift)
    }

    /// The lamps of a view from `eye`.
    fn lamps_by(&self, eye: DVec3) -> Vec<Lamp> {
        let side = DVec2::new(eye.x, -eye.z).normalize_or(DVec2::Y);
        let turned =
            |v: DVec3| DVec3::new(side.y * v.x - side.x * v.z, v.y, side.x * v.x + side.y * v.z);
        let by = |lamp: &Lamp| match self.turns {
            true => Lamp {
                at: turned(lamp.at),
                side_a: turned(lamp.side_a),
                side_b: turned(lamp.side_b),
                ..*lamp
            },
            false => *lamp,
        };
        self.lamps.iter().map(by).collect()
    }

    fn irradiance(&self, lamps: &[Lamp], at: DVec3, normal: DVec3, shift: DVec2) -> DVec3 {
        // The sky of the room: more from above than from the floor, less in the corners.
        let sides = (self.high.x - at.x.abs()).min(self.high.z - at.z);
        let corner = sides.min(-at.y + 0.25).clamp(0.0, 0.6);
        let ambient = (0.19 - 0.08 * normal.y) * (0.55 + 0.75 * corner);
        let mut sum = DVec3::new(0.98, 1.0, 1.03) * ambient;
        for lamp in lamps {
            let axis = lamp.side_a.cross(lamp.side_b).normalize();
            for s in 0..LAMP_SAMPLES * LAMP_SAMPLES {
                let part =
                    |v: u32, shift: f64| (f64::from(v) + shift) / f64::from(LAMP_SAMPLES) - 0.5;
                let from = lamp.at
                    + lamp.side_a * part(s % LAMP_SAMPLES, shift.x)
                    + lamp.side_b * part(s / LAMP_SAMPLES, shift.y);
                let to = from - at;
                let direction = to.normalize();
                let cosine = normal.dot(direction) * axis.dot(direction).abs();
                if normal.dot(direction) > 0.0 && !self.blocked(at, to) {
                    let share = f64::from(LAMP_SAMPLES * LAMP_SAMPLES);
                    sum +=
                        lamp.power * cosine / (std::f64::consts::PI * to.length_squared() * share);
                }
            }
        }
        sum
    }

    fn nearest(&self, from: DVec3, ray: DVec3) -> Option<(usize, Hit)> {
        let things = self.things.iter().enumerate();
        let hits = things.filter_map(|(i, thing)| Some((i, thing.hit(from, ray, f64::INFINITY)?)));
        hits.min_by(|a, b| a.1.t.total_cmp(&b.1.t))
    }

    fn blocked(&self, from: DVec3, to: DVec3) -> bool {
        let solid = |thing: &&Thing| !matches!(thing.shape, Shape::Walls(..));
        self.things.iter().filter(solid).any(|thing| thing.hit(from, to, 1.0).is_some())
    }
}

impl Thing {
    fn to_local(self, v: DVec3) -> DVec3 {
        let (c, s) = (self.turn.x, self.turn.y);
        DVec3::new(c * v.x - s * v.z, v.y, s * v.x + c * v.z)
    }

    fn to_world(self, v: DVec3) -> DVec3 {
        let (c, s) = (self.turn.x, self.turn.y);
        DVec3::new(c * v.x + s * v.z, v.y, c * v.z - s * v.x)
    }

    /// Whether a ray comes within the ball around a thing before `end`, in lengths of the ray: what
    /// it does not come near it does not hit.
    fn is_near(&self, from: DVec3, ray: DVec3, end: f64) -> bool {
        let reach = match self.shape {
            Shape::Block(half) => half.length_squared(),
            Shape::Ball(radius) => radius * radius,
            Shape::Pillar(radius, half) => radius * radius + half * half,
            Shape::Walls(..) => return true,
        };
        let middle = self.at - from;
        let nearest = (middle.dot(ray) / ray.length_squared()).clamp(0.0, end);
        (middle - ray * nearest).length_squared() <= reach * BALL_MARGIN
    }

    /// Where a ray first meets the thing before `end`, in lengths of the ray.
    fn hit(&self, from: DVec3, ray: DVec3, end: f64) -> Option<Hit> {
        if !self.is_near(from, ray, end) {
            return None;
        }
        let (o, d) = (self.to_local(from - self.at), self.to_local(ray));
        let hit = match self.shape {
            Shape::Ball(radius) => {
                let (a, b) = (d.length_squared(), o.dot(d));
                let root = b * b - a * (o.length_squared() - radius * radius);
                let t = (-b - (root >= 0.0).then(|| root.sqrt())?) / a;
                let normal = (o + d * t) / radius;
                (t > 1e-6).then_some(Hit { t, normal, uv: DVec2::new(normal.x, normal.y) })
            }
            Shape::Block(half) => {
                let (low, high) = slabs(o, d, -half, half)?;
                (low > 1e-6 && low < high).then(|| faced(low, o + d * low, half))
            }
            Shape::Pillar(radius, half) => pillar(o, d, radius, half),
            Shape::Walls(low, high) => {
                let (_, t) = slabs(o, d, low, high)?;
                let (middle, half) = ((low + high) / 2.0, (high - low) / 2.0);
                let mut hit = faced(t, o + d * t - middle, half);
                hit.normal = -hit.normal;
                (t > 1e-6).then_some(hit)
            }
        };
        hit.filter(|hit| hit.t < end)
    }
}

/// Entry and exit of a ray through a box.
fn slabs(o: DVec3, d: DVec3, low: DVec3, high: DVec3) -> Option<(f64, f64)> {
    let (a, b) = ((low - o) / d, (high - o) / d);
    let (near, far) = (a.min(b).max_element(), a.max(b).min_element());
    (near <= far).then_some((near, far))
}

/// The hit on the face of a box that `p` lies on.
fn faced(t: f64, p: DVec3, half: DVec3) -> Hit {
    let r = p / half;
    let (x, y, z) = (r.x.abs(), r.y.abs(), r.z.abs());
    let (normal, uv) = if x >= y && x >= z {
        (DVec3::X * r.x.signum(), DVec2::new(p.z, p.y))
    } else if y >= z {
        (DVec3::Y * r.y.signum(), DVec2::new(p.x, p.z))
    } else {
        (DVec3::Z * r.z.signum(), DVec2::new(p.x, p.y))
    };
    Hit { t, normal, uv }
}

/// A standing cylinder with caps, seen from outside.
fn pillar(o: DVec3, d: DVec3, radius: f64, half: f64) -> Option<Hit> {
    let (flat_o, flat_d) = (DVec2::new(o.x, o.z), DVec2::new(d.x, d.z));
    let (a, b) = (flat_d.length_squared(), flat_o.dot(flat_d));
    let root = b * b - a * (flat_o.length_squared() - radius * radius);
    let side = (-b - (root >= 0.0).then(|| root.sqrt())?) / a;
    let p = o + d * side;
    if side > 1e-6 && p.y.abs() <= half {
        let normal = DVec3::new(p.x, 0.0, p.z) / radius;
        return Some(Hit {
            t: side,
            normal,
            uv: DVec2::new(radius * normal.x.atan2(-normal.z), p.y),
        });
    }
    let cap = (-half * d.y.signum() - o.y) / d.y;
    let p = o + d * cap;
    let inside = DVec2::new(p.x, p.z).length_squared() <= radius * radius;
    let normal = DVec3::Y * -d.y.signum();
    (cap > 1e-6 && inside).then_some(Hit { t: cap, normal, uv: DVec2::new(p.x, p.z) })
}

/// Linear light, 0..1 and above, to 8-bit sRGB with a soft shoulder.
fn srgb(linear: f64) -> u8 {
    let tone =
        if linear > 0.7 { 0.7 + 0.3 * (1.0 - (-(linear - 0.7) / 0.3).exp()) } else { linear };
    let v = tone.clamp(0.0, 1.0);
    let coded = if v <= 0.003_130_8 { 12.92 * v } else { 1.055 * v.powf(1.0 / 2.4) - 0.055 };
    (coded * 255.0).round() as u8
}
