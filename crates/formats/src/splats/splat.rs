//! `.splat`: 32 bytes a Gaussian, no header.
//!
//! Position (three f32), scales (three f32, linear), colour and opacity (four u8), rotation w x y z
//! (four u8, `128 q + 128`). Axes are those of the scene. The layout is that of antimatter15/splat,
//! which every viewer of it follows. Lost: harmonics over degree 0, colours outside of 0..1, the
//! entries of the bank.

use std::io::{self, BufRead, Write};

use super::{
    OCTETS, SplatFile, SplatFormat, SplatsRead, begun, check_count, cut_short, fill_rest,
    some_near, steps, world,
};
use crate::{
    error::{Error, Result},
    limits::Limits,
    scene::SH_C0,
};

/// 32 bytes a Gaussian.
pub static SPLAT: SplatFormat = SplatFormat {
    name: "splat",
    ending: "splat",
    media_type: OCTETS,
    semantics: false,
    begins: b"",
    read,
    check: some_near,
    size_bytes: |file| Some(size_bytes(file)),
    write,
};

const BYTES: usize = 32;

fn size_bytes(file: &SplatFile) -> u64 {
    (file.gaussians.len() * BYTES) as u64
}

fn write(file: &SplatFile, to: &mut dyn Write) -> io::Result<()> {
    let gaussians = &file.gaussians;
    for i in 0..gaussians.len() {
        let mut row = [0; BYTES];
        let numbers =
            world(gaussians, i).as_vec3().to_array().into_iter().chain(gaussians.scales()[i]);
        for (slot, number) in row.chunks_exact_mut(4).zip(numbers) {
            slot.copy_from_slice(&number.to_le_bytes());
        }
        let color = gaussians.sh()[i * gaussians.sh_count()].map(|c| SH_C0 * c + 0.5);
        let levels = color.into_iter().chain([gaussians.opacities()[i]]);
        row[24..28].iter_mut().zip(levels).for_each(|(to, level)| *to = steps(level, 255) as u8);
        for (to, q) in row[28..].iter_mut().zip(gaussians.quats()[i]) {
            *to = (q * 128.0 + 128.0).round().clamp(0.0, 255.0) as u8;
        }
        to.write_all(&row)?;
    }
    Ok(())
}

fn read(from: &mut dyn BufRead, limits: &Limits) -> Result<SplatsRead> {
    let mut raw = begun(0, 0);
    let mut row = [0; BYTES];
    while !from.fill_buf().map_err(super::unreadable)?.is_empty() {
        let n = raw.means.len();
        check_count("splat: Gaussians", n + 1, 0, limits)?;
        from.read_exact(&mut row).map_err(|e| cut_short("splat", e, n, n + 1, "Gaussians"))?;
        let number = |k: usize| f32::from_le_bytes([row[k], row[k + 1], row[k + 2], row[k + 3]]);
        raw.means.push([number(0), number(4), number(8)]);
        raw.scales.push([number(12), number(16), number(20)]);
        raw.sh.push([24, 25, 26].map(|k| (f32::from(row[k]) / 255.0 - 0.5) / SH_C0));
        raw.opacities.push(f32::from(row[27]) / 255.0);
        raw.quats.push([28, 29, 30, 31].map(|k| (f32::from(row[k]) - 128.0) / 128.0));
    }
    if raw.means.is_empty() {
        return Err(Error::invalid("splat: the file is empty"));
    }
    fill_rest(&mut raw);
    SplatsRead::new(&SPLAT, raw, None)
}
