//! Solves match files and compares the cameras with given ones: `solve_scenes FILE.xm…`.
//!
//! `FOCAL=1` gives the true focal length, `SETS=4,8,16` the numbers of photos, `STARTS` how many sets
//! of each. Little-endian files: `XM01`, the number of photos, for each photo width and height (u32),
//! fx, cx, cy and the first three rows of the OpenCV camera-to-world (f64), the number of keypoints
//! and their x and y (f32); the number of pairs, for each two photos, the number of matches, and for
//! each match two keypoints (u32) and its score (f32).
#![allow(
    clippy::print_stdout,
    clippy::unwrap_used,
    missing_docs,
    reason = "a tool of the developer"
)]

use std::{sync::atomic::AtomicBool, time::Instant};

use glam::DMat3;
use segsplat_cameras::{PairMatches, PhotoKeypoints, Placing, SolveOptions, solve};

struct File {
    photos: Vec<(PhotoKeypoints, f64, DMat3)>,
    pairs: Vec<PairMatches>,
}

fn read(path: &str) -> File {
    let data = std::fs::read(path).unwrap();
    let mut at = 4;
    let mut take = |n: usize| {
        at += n;
        data[at - n..at].to_vec()
    };
    macro_rules! number {
        ($t:ty) => {
            <$t>::from_le_bytes(take(size_of::<$t>()).try_into().unwrap())
        };
    }
    let count = number!(u32);
    let mut photos = Vec::new();
    for _ in 0..count {
        let size = [number!(u32), number!(u32)];
        let (focal, _, _) = (number!(f64), number!(f64), number!(f64));
        let m: Vec<f64> = (0..12).map(|_| number!(f64)).collect();
        let r = DMat3::from_cols_array(&[m[0], m[4], m[8], m[1], m[5], m[9], m[2], m[6], m[10]]);
        let k = number!(u32);
        let keypoints = (0..k).map(|_| [number!(f32), number!(f32)]).collect();
        photos.push((PhotoKeypoints { size, focal: None, keypoints, seconds: None }, focal, r));
    }
    let count = number!(u32);
    let mut pairs = Vec::new();
    for _ in 0..count {
        let photos = [number!(u32) as usize, number!(u32) as usize];
        let n = number!(u32);
        let mut pair = PairMatches { photos, ..Default::default() };
        for _ in 0..n {
            pair.pairs.push([number!(u32), number!(u32)]);
            pair.scores.push(number!(f32));
        }
        pairs.push(pair);
    }
    File { photos, pairs }
}

fn angle(r: DMat3) -> f64 {
    ((r.x_axis.x + r.y_axis.y + r.z_axis.z - 1.0) * 0.5).clamp(-1.0, 1.0).acos().to_degrees()
}

fn main() {
    let var = |name: &str, default: &str| std::env::var(name).unwrap_or_else(|_| default.into());
    let with_focal = var("FOCAL", "0") == "1";
    let starts: usize = var("STARTS", "1").parse().unwrap();
    println!(
        "{:20} {:>3} {:>6} {:>7} {:>7} {:>6} | {:>5} evidence",
        "scene", "n", "placed", "med deg", "max deg", "focal", "conf"
    );
    for path in std::env::args().skip(1) {
        let file = read(&path);
        let name = path.rsplit('/').next().unwrap().trim_end_matches(".xm").to_owned();
        for n in var("SETS", "4,8,16").split(',').map(|n| n.parse::<usize>().unwrap()) {
            let total = file.photos.len();
            if n > total {
                continue;
            }
            let mut sets: Vec<Vec<usize>> = Vec::new();
            if n <= 6 {
                // Neighbours in order.
                let last = total - n;
                sets.extend((0..starts).map(|s| {
                    let first = if starts == 1 { 0 } else { last * s / (starts - 1) };
                    (first..first + n).collect()
                }));
            } else {
                // Spread evenly, from several first photos.
                sets.extend((0..starts).map(|s| {
                    let first = s.min(total - n);
                    let step = (total - 1 - first) as f64 / (n - 1) as f64;
                    (0..n).map(|i| first + (i as f64 * step) as usize).collect()
                }));
            }
            sets.dedup();
            for set in sets {
                run(&file, &set, &name, with_focal);
            }
        }
    }
}

fn run(file: &File, set: &[usize], name: &str, with_focal: bool) {
    let photos: Vec<PhotoKeypoints> = set
        .iter()
        .map(|&i| {
            let (photo, focal, _) = &file.photos[i];
            PhotoKeypoints { focal: with_focal.then_some(*focal), ..photo.clone() }
        })
        .collect();
    let place = |i: usize| set.iter().position(|&s| s == i);
    let pairs: Vec<PairMatches> = file
        .pairs
        .iter()
        .filter_map(|p| {
            let photos = [place(p.photos[0])?, place(p.photos[1])?];
            Some(PairMatches { photos, ..p.clone() })
        })
        .collect();
    let start = Instant::now();
    let solution =
        solve(&photos, &pairs, &SolveOptions::default(), &AtomicBool::new(false), &|_| ()).unwrap();
    let seconds = start.elapsed().as_secs_f64();
    let placed: Vec<(DMat3, DMat3, f64)> = solution
        .photos
        .iter()
        .zip(set)
        .filter_map(|(placing, &i)| match placing {
            Placing::Placed(p) => Some((
                p.camera.camera_to_world.rotation(),
                file.photos[i].2,
                p.camera.intrinsics.fx / file.photos[i].1,
            )),
            Placing::LeftOut(_) => None,
        })
        .collect();
    let mut errors = Vec::new();
    for (i, a) in placed.iter().enumerate() {
        for b in &placed[i + 1..] {
            errors.push(angle(a.0.transpose() * b.0 * (a.1.transpose() * b.1).transpose()));
        }
    }
    errors.sort_by(f64::total_cmp);
    let median = errors.get(errors.len() / 2).copied().unwrap_or(f64::NAN);
    let max = errors.last().copied().unwrap_or(f64::NAN);
    let e = solution.evidence;
    println!(
        "{name:20} {:3} {:6} {median:7.2} {max:7.2} {:6.3} | {:5.2} links {} agree {:.2} \
         expl {:.2} rival {:.2} mirr {:.2} held {} {} angle {:.1} err {:.2} loops {:.2} miss {:.2} \
         weak {:.2} t {seconds:.2}",
        set.len(),
        placed.len(),
        placed.first().map_or(f64::NAN, |p| p.2),
        solution.confidence,
        e.links,
        e.agreeing,
        e.explained,
        e.rival,
        e.mirrored,
        e.held,
        e.held_median,
        e.angle_deg,
        e.error,
        e.loops,
        e.missing,
        e.weakest,
    );
}
