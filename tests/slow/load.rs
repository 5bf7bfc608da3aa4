//! The program under too much load for a long time: it answers what it can, refuses the rest with a
//! code, stays alive, and does not grow.

use std::{
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    time::{Duration, Instant},
};

use reqwest::Client;
use segsplat::{
    sample::{self, SampleOptions},
    scene::{Photo, PosedPhoto, Upload, UploadCameras, UploadFile},
};
use serde_json::json;

use crate::common::process::{self, Process, Start, can_serve, long};

/// The budget of the loaded server.
const MEMORY_BYTES_MAX: u64 = 512 << 20;
/// The most that stays resident when all scenes are deleted.
const LEFT_BYTES_MAX: u64 = 716 << 20;

fn upload(seed: u64, photos: usize, width: u32, height: u32) -> Upload {
    sample::upload(&SampleOptions { photos, width, height, seed }).expect("in range")
}

/// A server with these limits.
fn server(folder: &std::path::Path, limits: &str) -> Process {
    let config = folder.join("segsplat.toml");
    std::fs::write(&config, format!("[limits]\n{limits}\n")).expect("written");
    let start = Start::on(&folder.join("data")).bundle("colours");
    start.arg("--config").arg(&config.display().to_string()).start()
}

async fn made(client: &Client, server: &Process, upload: &Upload) -> String {
    let (status, said) = process::create(client, &server.url, upload, 120_000, None).await.unwrap();
    assert_eq!((status, said["state"].as_str()), (201, Some("done")), "{said}");
    said["id"].as_str().unwrap().to_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn memory_stays_as_it_is_over_many_scenes_of_many_shapes() {
    if !can_serve() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    // Small, so that what the cache holds is no growth.
    let server = server(folder.path(), "cache_bytes_max = 4000000");
    let client = crate::common::client();
    let shapes = [(2, 64, 48), (3, 48, 96), (2, 320, 240), (5, 96, 64), (4, 160, 160)];
    let uploads: Vec<_> = (0..20)
        .map(|i| {
            let (photos, width, height) = shapes[i as usize % shapes.len()];
            upload(i, photos, width, height)
        })
        .collect();
    // The most of the first creates, and the most of all later: one reading may lie far below.
    let (all, settled, most) = if long() { (1_000, 100, 1.05) } else { (60, 30, 1.2) };
    let (mut first, mut last) = (0, 0);
    for i in 0..all {
        let id = made(&client, &server, &uploads[i % uploads.len()]).await;
        let view = format!("/v1/scenes/{id}/view?from=0&to=1&t=0.5&width=64&height=48");
        process::bytes(&client, &server.url(&view)).await.unwrap().expect("a view");
        // Each is made anew: the next of this content finds none to copy.
        let gone = process::delete(&client, &server.url(&format!("/v1/scenes/{id}"))).await;
        assert!([200, 204].contains(&gone.unwrap()));
        let part = if i < settled { &mut first } else { &mut last };
        *part = server.resident().max(*part);
    }
    let grown = last as f64 / first as f64;
    println!(
        "{all} creates: {} MiB at most in the first {settled}, {} MiB later, x {grown:.3}",
        first >> 20,
        last >> 20
    );
    assert!(grown <= most, "resident memory grew {grown:.3} times");
    // A job ends a little after its scene can be deleted.
    let until = Instant::now() + Duration::from_secs(60);
    while photos_bytes(&client, &server).await > 0 {
        assert!(Instant::now() < until, "photos of deleted scenes stay in memory");
        tokio::time::sleep(Duration::from_millis(50)).await;
    }
}

/// Bytes of photos that the server holds for its jobs and for first texts.
async fn photos_bytes(client: &Client, server: &Process) -> u64 {
    let answer = client.get(server.url("/metrics")).send().await.expect("an answer");
    let text = answer.text().await.expect("text");
    let value = text.lines().find_map(|line| line.strip_prefix("segsplat_photos_bytes "));
    value.expect("the gauge").parse().expect("a number")
}

/// Large JPEG photos of a room: small ones enlarged, with the cameras of the small ones.
fn large_photos(seed: u64, photos: usize, [width, height]: [u32; 2]) -> Upload {
    let options = SampleOptions { photos, width: width / 10, height: height / 10, seed };
    let posed = sample::photos(&options).expect("in range");
    let file = tempfile::Builder::new().suffix(".jpg").tempfile().expect("a file");
    let enlarged = |posed: &PosedPhoto| {
        let Photo { width: w, height: h, rgb, .. } = &posed.photo;
        let small = image::RgbImage::from_raw(*w, *h, rgb.clone()).expect("three bytes a pixel");
        // What is not generic is optimised where it is defined.
        let filter = image::imageops::FilterType::Triangle;
        let large = image::DynamicImage::from(small).resize_exact(width, height, filter);
        large.save(file.path()).expect("encoded");
        let bytes = std::fs::read(file.path()).expect("written");
        UploadFile { name: posed.file.clone(), bytes }
    };
    Upload {
        cameras: Some(UploadCameras::Transforms(sample::transforms_json(&posed))),
        photos: posed.iter().map(enlarged).collect(),
        ..Upload::default()
    }
}

/// Makes `jobs` scenes of large photos at once and asks each a text; then all are deleted. The
/// longest form is that of the bar: 64 photos of 24 megapixels. `MEMORY_PHOTOS`: for a short look.
async fn hold_memory(jobs: usize, peak_max: u64) {
    if !can_serve() {
        return;
    }
    let asked = || std::env::var("MEMORY_PHOTOS").ok().and_then(|text| text.parse().ok());
    let (photos, size, bundle) = match long() {
        true => (asked().unwrap_or(64), [6_000, 4_000], "../../models/embedded"),
        false => (6, [1_600, 1_200], "colours"),
    };
    // Photos and networks of the short form are small, and so are its bounds.
    let share = if long() { 1 } else { 3 };
    let (peak_max, left_max) = (peak_max / share, LEFT_BYTES_MAX / share);
    let folder = tempfile::tempdir().unwrap();
    let config = folder.path().join("segsplat.toml");
    // Whatever else the machine does.
    std::fs::write(&config, "[limits]\nscene_timeout_ms = 3600000\nwait_ms_max = 3600000\n")
        .unwrap();
    let server = Start::on(&folder.path().join("data"))
        .bundle(bundle)
        .arg("--jobs")
        .arg(&jobs.to_string())
        .arg("--config")
        .arg(&config.display().to_string())
        .start();
    let client = crate::common::client();
    // Before any is sent: a caller that pauses in the middle is cut off.
    let uploads: Vec<Upload> =
        (0..jobs as u64).map(|seed| large_photos(seed, photos, size)).collect();
    let begun = Instant::now();
    let one = async |upload: Upload| {
        let answer = process::create(&client, &server.url, &upload, 3_600_000, None).await;
        let (status, said) = answer.unwrap();
        assert_eq!((status, said["state"].as_str()), (201, Some("done")), "{said}");
        let (id, made) = (said["id"].as_str().unwrap().to_owned(), server.peak());
        let url = server.url(&format!("/v1/scenes/{id}/query"));
        let asked = json!({ "texts": ["red"], "wait_ms": 3_600_000 });
        let (status, said) = process::post(&client, &url, &asked).await.unwrap();
        assert_eq!(status, 200, "{said}");
        (id, made)
    };
    let scenes = futures_util::future::join_all(uploads.into_iter().map(one)).await;
    let (took, peak) = (begun.elapsed(), server.peak());
    for (id, _) in &scenes {
        let url = server.url(&format!("/v1/scenes/{id}"));
        assert_eq!(process::delete(&client, &url).await.unwrap(), 204);
    }
    let deleted = Instant::now();
    let left = process::eventually("memory is given back", async || {
        let left = server.resident();
        (left <= left_max).then_some(left)
    });
    let left = left.await;
    println!(
        "{jobs} scenes of {photos} photos of {size:?} in {took:?}: at most {} MiB resident while \
         made, {} MiB with texts, {} MiB {:?} after all is deleted",
        scenes.iter().map(|(_, made)| made >> 20).max().unwrap_or(0),
        peak >> 20,
        left >> 20,
        deleted.elapsed()
    );
    assert!(peak <= peak_max, "{} MiB of {}", peak >> 20, peak_max >> 20);
}

#[tokio::test(flavor = "multi_thread")]
async fn one_scene_of_many_large_photos_takes_bounded_memory_and_gives_it_back() {
    hold_memory(1, 1_536 << 20).await;
}

#[tokio::test(flavor = "multi_thread")]
async fn two_scenes_of_many_large_photos_take_bounded_memory_and_give_it_back() {
    hold_memory(2, 2_560 << 20).await;
}

/// What some callers met.
#[derive(Debug, Default)]
struct Met {
    good: usize,
    refused: usize,
    times: Vec<Duration>,
}

/// Makes the call of a random number; gives its status. Of twenty calls one makes a scene, one
/// lists, four ask by text and fourteen look.
async fn call(client: &Client, server: &Process, ids: &[String], made: &[Upload], n: u64) -> u16 {
    let id = &ids[(n >> 33) as usize % ids.len()];
    match (n >> 40) % 20 {
        0 => {
            let upload = &made[(n >> 50) as usize % made.len()];
            let made = process::create(client, &server.url, upload, 60_000, None).await;
            let (status, said) = made.expect("an answer");
            if let Some(id) = said["id"].as_str() {
                let url = server.url(&format!("/v1/scenes/{id}"));
                process::delete(client, &url).await.expect("an answer");
            }
            status
        }
        1 => process::get(client, &server.url("/v1/scenes?limit=5")).await.expect("an answer").0,
        2..=5 => {
            let url = server.url(&format!("/v1/scenes/{id}/query"));
            let words = ["red", "green", "blue", "yellow"];
            let body = json!({ "texts": [words[(n >> 50) as usize % words.len()]] });
            process::post(client, &url, &body).await.expect("an answer").0
        }
        _ => {
            let t = (n >> 20) % 1_000;
            let view = format!("/v1/scenes/{id}/view?from=0&to=1&t=0.{t:03}&width=96&height=72");
            let view = process::bytes(client, &server.url(&view)).await.expect("an answer");
            view.map_or_else(|status| status, |_| 200)
        }
    }
}

/// `callers` for so long: each the next call as soon as it has an answer, and the same again after
/// a pause where it was refused, so that what is answered keeps its mix.
async fn press(server: &Arc<Process>, ids: &Arc<Vec<String>>, callers: u64, time: Duration) -> Met {
    let uploads: Arc<Vec<_>> = Arc::new((0..8).map(|i| upload(50 + i, 2, 64, 48)).collect());
    let until = Instant::now() + time;
    let calls = (0..callers).map(|seed| {
        let (server, ids, uploads) = (Arc::clone(server), Arc::clone(ids), Arc::clone(&uploads));
        tokio::spawn(async move {
            let next = |n: u64| {
                n.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407)
            };
            let (client, mut met, mut n) = (crate::common::client(), Met::default(), next(seed));
            while Instant::now() < until {
                let begun = Instant::now();
                match call(&client, &server, &ids, &uploads, n).await {
                    200..=202 => {
                        met.good += 1;
                        met.times.push(begun.elapsed());
                        n = next(n);
                    }
                    429 | 503 => {
                        met.refused += 1;
                        // Ruder than Retry-After says, kinder than a loop.
                        tokio::time::sleep(Duration::from_millis(100)).await;
                    }
                    other => panic!("{other} is no answer for a good call"),
                }
            }
            met
        })
    });
    let mut all = Met::default();
    for call in calls.collect::<Vec<_>>() {
        let met = call.await.expect("a caller met what it must not");
        all.good += met.good;
        all.refused += met.refused;
        all.times.extend(met.times);
    }
    all.times.sort();
    all
}

#[tokio::test(flavor = "multi_thread")]
async fn ten_times_the_load_takes_little_of_what_is_answered() {
    if !can_serve() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let limits = format!(
        "queued_renders_max = 16\nqueued_jobs_max = 4\ncache_bytes_max = 64000000\n\
         memory_bytes_max = {MEMORY_BYTES_MAX}"
    );
    let server = Arc::new(server(folder.path(), &limits));
    let client = crate::common::client();
    let mut ids = Vec::new();
    for seed in 0..4 {
        let id = made(&client, &server, &upload(seed, 2, 160, 120)).await;
        // Its meaning is made now, so that every text below is answered at once.
        let url = server.url(&format!("/v1/scenes/{id}/query"));
        let asked = json!({ "texts": ["red"], "wait_ms": 60_000 });
        let (status, said) = process::post(&client, &url, &asked).await.unwrap();
        assert_eq!(status, 200, "{said}");
        ids.push(id);
    }
    let ids = Arc::new(ids);
    // What a machine with other work on it can hold is no measure: then it must go on at all.
    // LOAD_SECONDS: for a short look.
    let (peak_s, crowd_s, least) = if long() { (120, 600, 0.9) } else { (3, 3, 0.0) };
    let shorter = std::env::var("LOAD_SECONDS").ok().and_then(|text| text.parse().ok());
    let (peak_s, crowd_s) = shorter.map_or((peak_s, crowd_s), |s: u64| (s.div_ceil(5), s));
    let stop = Arc::new(AtomicBool::new(false));
    let alive = tokio::spawn({
        let (server, stop) = (Arc::clone(&server), Arc::clone(&stop));
        async move {
            let (client, mut slowest, mut most) = (crate::common::client(), Duration::ZERO, 0);
            while !stop.load(Ordering::Acquire) {
                let begun = Instant::now();
                let live = client.get(server.url("/healthz")).send().await.expect("alive");
                assert_eq!(live.status().as_u16(), 200);
                slowest = slowest.max(begun.elapsed());
                most = most.max(server.resident());
                tokio::time::sleep(Duration::from_millis(50)).await;
            }
            (slowest, most)
        }
    });
    press(&server, &ids, 6, Duration::from_secs(1)).await;
    let peak = press(&server, &ids, 6, Duration::from_secs(peak_s)).await;
    let crowd = press(&server, &ids, 64, Duration::from_secs(crowd_s)).await;
    stop.store(true, Ordering::Release);
    let (slowest, most) = alive.await.expect("liveness stays 200");
    let (best, now) = (peak.good as f64 / peak_s as f64, crowd.good as f64 / crowd_s as f64);
    let at = |met: &Met, share: f64| met.times[(met.times.len() as f64 * share) as usize];
    println!(
        "6 callers: {best:.1}/s, p50 {:?}, p99 {:?}; 64 callers: {now:.1}/s ({:.2} of that), p50 \
         {:?}, p99 {:?}, {} refused; liveness at most {slowest:?}; at most {} MiB resident",
        at(&peak, 0.5),
        at(&peak, 0.99),
        now / best,
        at(&crowd, 0.5),
        at(&crowd, 0.99),
        crowd.refused,
        most >> 20,
    );
    assert!(most <= MEMORY_BYTES_MAX, "{most} bytes resident of {MEMORY_BYTES_MAX}");
    assert!(now > 0.0 && now >= least * best, "{now:.1}/s of {best:.1}/s");
}
