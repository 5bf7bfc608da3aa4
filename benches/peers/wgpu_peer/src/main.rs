//! wgpu-3dgs-viewer and `segsplat-lab frames` on one adapter and one scene, in turn.
//!
//!     wgpu_peer OUT LAB ADAPTER [GAUSSIANS WIDTH HEIGHT FRAMES ROUNDS]
//!
//! LAB is the program segsplat-lab. OUT takes one row a round (wgpu_peer.jsonl). Both are timed by
//! the device's clock from before the first stage to after the last, and by the wall from the call
//! to the picture in memory. The viewer draws quads back to front: without the 0.3 px² blur, out to
//! four standard deviations, colours and opacities of 8 bits; at another extent than √8 its
//! Gaussians are not Gaussians. Its picture is compared with ours over the same background, drawn
//! into 16-bit floats so that the target adds little of its own.

use std::{error::Error, fs, io::Write as _, path::Path, process::Command, time::Instant};

use safetensors::SafeTensors;
use serde_json::{Value, json};
use wgpu_3dgs_viewer::{
    CameraPod, Viewer,
    core::{
        Gaussian, GaussianDisplayMode, GaussianMaxStdDev,
        GaussianPodWithShNoneCov3dSingleConfigs as Pod, GaussianShDegree, glam,
    },
};

type Result<T> = std::result::Result<T, Box<dyn Error>>;

const TARGET: wgpu::TextureFormat = wgpu::TextureFormat::Rgba16Float;
const PIXEL_BYTES: u32 = 8;

/// The scene, camera and picture that `segsplat-lab frames --dump` writes.
struct Dump {
    gaussians: Vec<Gaussian>,
    camera: Vec<f32>,
    color: Vec<f32>,
}

fn floats(file: &SafeTensors<'_>, name: &str) -> Result<Vec<f32>> {
    Ok(bytemuck::pod_collect_to_vec(file.tensor(name)?.data()))
}

fn read(path: &Path) -> Result<Dump> {
    let bytes = fs::read(path)?;
    let file = SafeTensors::deserialize(&bytes)?;
    let [means, quats, scales, opacities, sh] =
        ["means", "quats", "scales", "opacities", "sh"].map(|name| floats(&file, name));
    let (means, quats, scales, opacities, sh) = (means?, quats?, scales?, opacities?, sh?);
    let byte = |value: f32| (value * 255.0).round().clamp(0.0, 255.0) as u8;
    let gaussians = (0..opacities.len())
        .map(|i| {
            let three = |values: &[f32]| glam::Vec3::from_slice(&values[3 * i..]);
            let [w, x, y, z] = [0, 1, 2, 3].map(|k| quats[4 * i + k]);
            let c = (three(&sh) * Gaussian::SH0_TO_LINEAR_FACTOR + 0.5).to_array().map(byte);
            Gaussian {
                rot: glam::Quat::from_xyzw(x, y, z, w),
                pos: three(&means),
                color: glam::U8Vec4::new(c[0], c[1], c[2], byte(opacities[i])),
                sh: [glam::Vec3::ZERO; 15],
                scale: three(&scales),
            }
        })
        .collect();
    Ok(Dump { gaussians, camera: floats(&file, "camera")?, color: floats(&file, "color")? })
}

/// The viewer's camera looks along -z with y up; ours along z with y down.
fn camera_pod(camera: &[f32]) -> CameraPod {
    let rows = glam::Mat4::from_cols_slice(&camera[..16]).transpose();
    let turn = glam::Mat4::from_diagonal(glam::Vec4::new(1.0, -1.0, -1.0, 1.0));
    let [fx, fy, cx, cy, width, height, near] = [16, 17, 18, 19, 20, 21, 22].map(|i| camera[i]);
    let far = 1e3;
    let proj = glam::Mat4::from_cols(
        glam::Vec4::new(2.0 * fx / width, 0.0, 0.0, 0.0),
        glam::Vec4::new(0.0, 2.0 * fy / height, 0.0, 0.0),
        glam::Vec4::new(1.0 - 2.0 * cx / width, 2.0 * cy / height - 1.0, far / (near - far), -1.0),
        glam::Vec4::new(0.0, 0.0, near * far / (near - far), 0.0),
    );
    CameraPod { view: turn * rows, proj, size: glam::Vec2::new(width, height), _padding: [0; 2] }
}

fn half(bits: u16) -> f32 {
    let (sign, exponent, mantissa) = (bits >> 15, (bits >> 10) & 31, bits & 1023);
    let value = match exponent {
        0 => f32::from(mantissa) * 2.0_f32.powi(-24),
        _ => (1.0 + f32::from(mantissa) / 1024.0) * 2.0_f32.powi(i32::from(exponent) - 15),
    };
    if sign == 1 { -value } else { value }
}

/// The viewer on a device of its own.
struct Peer {
    device: wgpu::Device,
    queue: wgpu::Queue,
    viewer: Viewer<Pod>,
    texture: wgpu::Texture,
    times: wgpu::QuerySet,
    resolved: wgpu::Buffer,
    staging: wgpu::Buffer,
    row_bytes: u32,
}

/// Bytes of the two time stamps, in front of the picture.
const STAMPS: u64 = 256;

impl Peer {
    fn open(adapter_name: &str, dump: &Dump) -> Result<Self> {
        let instance = wgpu::Instance::new(wgpu::InstanceDescriptor {
            backends: wgpu::Backends::VULKAN,
            ..wgpu::InstanceDescriptor::new_without_display_handle()
        });
        let named = |adapter: &wgpu::Adapter| adapter.get_info().name.contains(adapter_name);
        let adapter = pollster::block_on(instance.enumerate_adapters(wgpu::Backends::VULKAN))
            .into_iter()
            .find(named)
            .ok_or("no such adapter")?;
        let features =
            wgpu::Features::TIMESTAMP_QUERY | wgpu::Features::TIMESTAMP_QUERY_INSIDE_ENCODERS;
        let (device, queue) =
            pollster::block_on(adapter.request_device(&wgpu::DeviceDescriptor {
                required_features: features,
                required_limits: adapter.limits(),
                ..Default::default()
            }))?;
        let mut viewer = Viewer::<Pod>::new(&device, TARGET, &dump.gaussians)?;
        viewer.update_gaussian_transform(
            &queue,
            1.0,
            GaussianDisplayMode::Splat,
            GaussianShDegree::new(0).ok_or("degree")?,
            false,
            GaussianMaxStdDev::new(8.0_f32.sqrt()).ok_or("deviations")?,
        );
        viewer.update_camera_with_pod(&queue, &camera_pod(&dump.camera));
        let (width, height) = (dump.camera[20] as u32, dump.camera[21] as u32);
        let texture = device.create_texture(&wgpu::TextureDescriptor {
            label: None,
            size: wgpu::Extent3d { width, height, depth_or_array_layers: 1 },
            mip_level_count: 1,
            sample_count: 1,
            dimension: wgpu::TextureDimension::D2,
            format: TARGET,
            usage: wgpu::TextureUsages::RENDER_ATTACHMENT | wgpu::TextureUsages::COPY_SRC,
            view_formats: &[],
        });
        let row_bytes = (width * PIXEL_BYTES).next_multiple_of(256);
        let buffer = |size, usage| {
            device.create_buffer(&wgpu::BufferDescriptor {
                label: None,
                size,
                usage,
                mapped_at_creation: false,
            })
        };
        let resolved =
            buffer(STAMPS, wgpu::BufferUsages::QUERY_RESOLVE | wgpu::BufferUsages::COPY_SRC);
        let staging = buffer(
            STAMPS + u64::from(row_bytes * height),
            wgpu::BufferUsages::MAP_READ | wgpu::BufferUsages::COPY_DST,
        );
        let times = device.create_query_set(&wgpu::QuerySetDescriptor {
            label: None,
            ty: wgpu::QueryType::Timestamp,
            count: 2,
        });
        Ok(Self { device, queue, viewer, texture, times, resolved, staging, row_bytes })
    }

    /// One frame: milliseconds of the device, of the wall, and the picture as halves.
    fn frame(&self) -> Result<(f64, f64, Vec<u16>)> {
        let begun = Instant::now();
        let mut encoder = self.device.create_command_encoder(&Default::default());
        encoder.write_timestamp(&self.times, 0);
        let viewer = &self.viewer;
        viewer.preprocessor.preprocess(&mut encoder, viewer.gaussians_buffer.len() as u32);
        viewer.radix_sorter.sort(&mut encoder, &viewer.radix_sort_indirect_args_buffer);
        // As Viewer::render, but over nothing in place of opaque black.
        let view = self.texture.create_view(&Default::default());
        let mut pass = encoder.begin_render_pass(&wgpu::RenderPassDescriptor {
            color_attachments: &[Some(wgpu::RenderPassColorAttachment {
                view: &view,
                resolve_target: None,
                ops: wgpu::Operations {
                    load: wgpu::LoadOp::Clear(wgpu::Color::TRANSPARENT),
                    store: wgpu::StoreOp::Store,
                },
                depth_slice: None,
            })],
            ..Default::default()
        });
        viewer.renderer.render_with_pass(&mut pass, &viewer.indirect_args_buffer);
        drop(pass);
        encoder.write_timestamp(&self.times, 1);
        encoder.resolve_query_set(&self.times, 0..2, &self.resolved, 0);
        encoder.copy_buffer_to_buffer(&self.resolved, 0, &self.staging, 0, Some(16));
        let size = self.texture.size();
        encoder.copy_texture_to_buffer(
            self.texture.as_image_copy(),
            wgpu::TexelCopyBufferInfo {
                buffer: &self.staging,
                layout: wgpu::TexelCopyBufferLayout {
                    offset: STAMPS,
                    bytes_per_row: Some(self.row_bytes),
                    rows_per_image: None,
                },
            },
            size,
        );
        self.queue.submit([encoder.finish()]);
        self.staging.slice(..).map_async(wgpu::MapMode::Read, |_| {});
        self.device.poll(wgpu::PollType::wait_indefinitely())?;
        let bytes = self.staging.slice(..).get_mapped_range()?.to_vec();
        self.staging.unmap();
        let stamps: Vec<u64> = bytemuck::pod_collect_to_vec(&bytes[..16]);
        let ticks = stamps[1].saturating_sub(stamps[0]) as f64;
        let ms = ticks * f64::from(self.queue.get_timestamp_period()) / 1e6;
        let rows = bytes[STAMPS as usize..].chunks(self.row_bytes as usize);
        let picture = rows
            .flat_map(|row| {
                bytemuck::pod_collect_to_vec::<u8, u16>(&row[..(size.width * PIXEL_BYTES) as usize])
            })
            .collect();
        Ok((ms, begun.elapsed().as_secs_f64() * 1e3, picture))
    }
}

fn median(mut values: Vec<f64>) -> f64 {
    values.sort_by(f64::total_cmp);
    values[values.len() / 2]
}

/// Largest and mean difference of a channel, and PSNR in dB.
fn difference(picture: &[u16], dump: &Dump) -> Value {
    let (mut most, mut sum, mut squares) = (0.0_f64, 0.0, 0.0);
    for (pixel, want) in picture.chunks(4).zip(dump.color.chunks(3)) {
        for k in 0..3 {
            let got = half(pixel[k]) + (1.0 - half(pixel[3])) * dump.camera[23 + k];
            let apart = f64::from((got - want[k]).abs());
            (most, sum, squares) = (most.max(apart), sum + apart, squares + apart * apart);
        }
    }
    let count = dump.color.len() as f64;
    json!({ "max": most, "mean": sum / count, "psnr_db": -10.0 * (squares / count).log10() })
}

fn main() -> Result<()> {
    let args: Vec<String> = std::env::args().skip(1).collect();
    let [out, lab, adapter, numbers @ ..] = args.as_slice() else {
        return Err("wgpu_peer OUT LAB ADAPTER [GAUSSIANS WIDTH HEIGHT FRAMES ROUNDS]".into());
    };
    let number = |i: usize, default: u32| numbers.get(i).map_or(Ok(default), |text| text.parse());
    let (gaussians, width, height) = (number(0, 131_072)?, number(1, 256)?, number(2, 256)?);
    let (frames, rounds) = (number(3, 30)?, number(4, 3)?);
    let out = Path::new(out);
    fs::create_dir_all(out)?;
    let scene = out.join("scene.safetensors");
    let ours = |more: &[&str]| -> Result<Value> {
        let numbers = [gaussians, height, width, frames].map(|number| number.to_string());
        let done = Command::new(lab)
            .args(["frames", "--renderer", "gpu", "--adapter", adapter])
            .args(["--gaussians", &numbers[0], "--size", &numbers[1], "--width", &numbers[2]])
            .args(["--frames", &numbers[3]])
            .args(more)
            .output()?;
        match done.status.success() {
            true => Ok(serde_json::from_slice(&done.stdout)?),
            false => Err(String::from_utf8_lossy(&done.stderr).into_owned().into()),
        }
    };
    ours(&["--dump", &scene.to_string_lossy()])?;
    let dump = read(&scene)?;
    fs::remove_file(&scene)?;
    let peer = Peer::open(adapter, &dump)?;
    let mut rows =
        fs::OpenOptions::new().create(true).append(true).open(out.join("wgpu_peer.jsonl"))?;
    for round in 0..rounds {
        let mut picture = peer.frame()?.2;
        let (mut device, mut wall) = (Vec::new(), Vec::new());
        for _ in 0..frames {
            let (device_ms, wall_ms, drawn) = peer.frame()?;
            device.push(device_ms);
            wall.push(wall_ms);
            picture = drawn;
        }
        let report = ours(&[])?;
        let row = json!({
            "table": "wgpu",
            "command": format!(
                "wgpu_peer OUT LAB {adapter} {gaussians} {width} {height} {frames} {rounds}"
            ),
            "commit": report["commit"],
            "machine": report["machine"],
            "round": round,
            "gaussians": report["gaussians"],
            "width": width,
            "height": height,
            "wgpu_3dgs_viewer": { "device_ms": median(device), "call_ms": median(wall) },
            "segsplat": {
                "device_ms": report["device"]["total_ms"], "call_ms": report["median_ms"],
            },
            "error": difference(&picture, &dump),
        });
        println!("{row}");
        writeln!(rows, "{row}")?;
    }
    Ok(())
}
