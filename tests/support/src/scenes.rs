//! Seeded scenes for tests and benchmarks of the renderers.

use glam::{DVec3, Quat, Vec3};
use segsplat_core::scene::{
    Camera, CameraToWorld, Gaussians, Intrinsics, RawGaussians, SourcePixel,
};
use segsplat_render::{Background, Kinds, RenderRequest};

/// A small seeded generator (`SplitMix64`), so that scenes never change with a library.
#[derive(Clone, Debug)]
pub struct Random(pub u64);

impl Random {
    /// The next 64 bits.
    pub fn bits(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut z = self.0;
        z = (z ^ (z >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        z = (z ^ (z >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        z ^ (z >> 31)
    }

    /// Uniform in `low..high`.
    pub fn range(&mut self, low: f32, high: f32) -> f32 {
        low + (high - low) * ((self.bits() >> 40) as f32 / (1_u64 << 24) as f32)
    }

    /// A unit quaternion, wxyz.
    pub fn quat(&mut self) -> [f32; 4] {
        let axis = Vec3::from_array([(); 3].map(|()| self.range(-1.0, 1.0))).normalize_or(Vec3::Z);
        let [x, y, z, w] = Quat::from_axis_angle(axis, self.range(-3.1, 3.1)).to_array();
        [w, x, y, z]
    }
}

/// Adds a Gaussian of harmonics `sh` to `raw`.
pub fn push(
    raw: &mut RawGaussians,
    mean: [f32; 3],
    quat: [f32; 4],
    scale: [f32; 3],
    opacity: f32,
    sh: &[[f32; 3]],
) {
    raw.means.push(mean);
    raw.quats.push(quat);
    raw.scales.push(scale);
    raw.opacities.push(opacity);
    raw.sh.extend_from_slice(sh);
    raw.semantic_index.push(0);
    raw.source.push(SourcePixel::default());
}

/// `raw` checked; panics when a scene of this file loses a Gaussian.
pub fn checked(raw: RawGaussians) -> Gaussians {
    let count = raw.means.len();
    let (gaussians, _) = Gaussians::sanitize(raw).expect("arrays of equal length");
    assert_eq!(gaussians.len(), count, "a test scene lost Gaussians");
    gaussians
}

/// A camera of `width` x `height` with a 60 degree field of view, at the origin, looking along +z.
pub fn camera(width: u32, height: u32) -> Camera {
    let (w, h) = (f64::from(width), f64::from(height));
    let focal = 0.5 * w.max(h) / 30.0_f64.to_radians().tan();
    Camera {
        intrinsics: Intrinsics { fx: focal, fy: focal, cx: 0.5 * w, cy: 0.5 * h, width, height },
        camera_to_world: look(DVec3::ZERO, DVec3::Z),
    }
}

/// A pose at `eye` looking at `target`, the picture's up being world -y.
pub fn look(eye: DVec3, target: DVec3) -> CameraToWorld {
    CameraToWorld::look_at(eye, target, DVec3::NEG_Y, "test camera").expect("a test camera")
}

/// The background of [`request`].
pub const BACKGROUND: [f32; 3] = [0.1, 0.2, 0.3];

/// A request for everything.
pub fn request(camera: Camera) -> RenderRequest {
    let background = Background::Color(BACKGROUND);
    RenderRequest { background, ..RenderRequest::plain(camera, Kinds::ALL, 0.05) }
}

/// What two photos of `side` x `side` pixels give: a Gaussian a pixel on a smooth surface with
/// steps, seen by two cameras a fifth of the depth apart. 256 gives 131,072 Gaussians.
pub fn two_views(side: u32, seed: u64) -> (Gaussians, Camera) {
    let mut random = Random(seed);
    let mut raw = RawGaussians::default();
    let lens = camera(side, side).intrinsics;
    for view in 0..2 {
        let shift = 0.8 * f64::from(view) - 0.4;
        for y in 0..side {
            for x in 0..side {
                let (u, v) = (f64::from(x) + 0.5, f64::from(y) + 0.5);
                let (s, t) = (u / f64::from(side) + 0.1 * shift, v / f64::from(side));
                let step = if (s * 5.0).fract() + (t * 4.0).fract() < 0.7 { -1.2 } else { 0.0 };
                let z = 4.0 + 0.8 * (6.0 * s).sin() * (5.0 * t).cos() + step;
                let point = lens.unproject(u, v, z) + DVec3::X * shift;
                let pixel = (z / lens.fx) as f32;
                let scale = [0.5, 0.5, 0.15].map(|k| pixel * k * random.range(0.6, 1.8));
                let color = [s * 9.0, t * 7.0, (s + t) * 5.0]
                    .map(|phase| 1.2 * phase.sin() as f32 + random.range(-0.2, 0.2));
                let opacity = random.range(0.15, 0.98);
                push(&mut raw, point.as_vec3().into(), random.quat(), scale, opacity, &[color]);
            }
        }
    }
    let mut middle = camera(side, side);
    middle.camera_to_world = look(DVec3::new(0.07, -0.03, 0.0), DVec3::new(0.0, 0.0, 4.0));
    (checked(raw), middle)
}

/// `layers` sheets of `side` x `side` wide Gaussians in front of [`camera`], one behind the other,
/// black and white in turn. With a low `opacity` light passes many of them.
pub fn sheets(layers: u32, side: u32, opacity: f32, seed: u64) -> Gaussians {
    let mut random = Random(seed);
    let mut raw = RawGaussians::default();
    for layer in 0..layers {
        let z = 2.0 + 0.05 * layer as f32;
        let step = 1.4 * z / side as f32;
        let color = if layer % 2 == 0 { 1.7 } else { -1.7 };
        for (y, x) in (0..side).flat_map(|y| (0..side).map(move |x| (y, x))) {
            let place = |at: u32| (at as f32 - 0.5 * (side - 1) as f32) * step;
            let mean = [place(x), place(y), z + random.range(-0.01, 0.01)];
            let scale = [0.8 * step, 0.8 * step, 0.01];
            push(&mut raw, mean, [1.0, 0.0, 0.0, 0.0], scale, opacity, &[[color; 3]]);
        }
    }
    checked(raw)
}

/// `count` needles, a thousand times as long as thick, in front of [`camera`].
pub fn needles(count: usize, seed: u64) -> Gaussians {
    let mut raw = cloud(count, 0, seed).into_raw();
    let mut random = Random(seed + 1);
    for (mean, scale) in raw.means.iter().zip(&mut raw.scales) {
        let length = mean[2].abs() * random.range(0.02, 0.3);
        *scale = [length, 1e-3 * length, 1e-3 * length];
    }
    checked(raw)
}

/// `count` Gaussians of all shapes in a box in front of [`camera`], harmonics of `sh_degree`.
pub fn cloud(count: usize, sh_degree: u8, seed: u64) -> Gaussians {
    let mut random = Random(seed);
    let mut raw = RawGaussians {
        sh_degree,
        origin: DVec3::new(0.5, -0.25, 0.125),
        ..RawGaussians::default()
    };
    for _ in 0..count {
        let z = random.range(0.3, 9.0);
        let mean = [random.range(-0.8, 0.8) * z, random.range(-0.8, 0.8) * z, z];
        let size = z * random.range(-6.0, -2.0).exp();
        let scale = [(); 3].map(|()| size * random.range(-2.0, 1.0).exp());
        let sh: Vec<[f32; 3]> = (0..(usize::from(sh_degree) + 1).pow(2))
            .map(|k| [(); 3].map(|()| random.range(-1.0, 1.0) / (1.0 + k as f32).sqrt()))
            .collect();
        let opacity = random.range(0.01, 1.0);
        push(&mut raw, mean, random.quat(), scale, opacity, &sh);
    }
    checked(raw)
}
