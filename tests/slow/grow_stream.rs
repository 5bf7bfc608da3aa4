//! A stream of photos into one scene that keeps the newest of them: neither its memory nor the
//! time of a call grows with the photos that came before.

use std::time::{Duration, Instant};

use segsplat::sample::{self, SampleOptions};

use crate::common::{
    doors::form,
    process::{self, Process, Start, can_serve, long, photos_of},
};

/// Photos that join one by one: in the short form, and in the long one.
const PHOTOS: [usize; 2] = [8, 1_000];
/// Photos that the scene keeps.
const KEPT: usize = 12;
/// Photos that are sent again and again; each time the scene has forgotten them.
const ROUND: SampleOptions = SampleOptions { photos: 60, width: 160, height: 120, seed: 3 };
/// Photos of a row of the table.
const ROW: usize = 50;
/// Most that a call may take, as a multiple of the first ones, and memory that may come, bytes.
const SLOWER_MAX: f64 = 1.5;
const MEMORY_MAX: u64 = 64 << 20;

fn median(times: &[Duration]) -> f64 {
    let mut ms: Vec<f64> = times.iter().map(|time| time.as_secs_f64() * 1e3).collect();
    ms.sort_by(f64::total_cmp);
    ms[ms.len() / 2]
}

fn row(server: &Process, photos: usize, joins: &[Duration]) -> u64 {
    let (resident, times) = (server.resident(), &joins[joins.len().saturating_sub(ROW)..]);
    let most = times.iter().max().expect("a call").as_secs_f64() * 1e3;
    println!("| {photos} | {} | {:.0} | {most:.0} |", resident >> 20, median(times));
    resident
}

#[tokio::test(flavor = "multi_thread")]
async fn a_stream_of_photos_takes_no_more_memory_or_time_than_its_first_ones() {
    if !can_serve() {
        return;
    }
    let data = tempfile::tempdir().unwrap();
    let server = Start::on(data.path()).arg("--refine").arg("off").start();
    let client = crate::common::client();
    let upload = sample::upload(&ROUND).expect("in range");
    let some = |from: usize, count: usize| {
        photos_of(&upload, &(from..from + count).map(|i| i % ROUND.photos).collect::<Vec<_>>())
    };
    let made = process::create(&client, &server.url, &some(0, KEPT), 60_000, None).await;
    let id = made.unwrap().1["id"].as_str().expect("a scene").to_owned();
    let (url, mut joins) = (server.url(&format!("/v1/scenes/{id}/photos")), Vec::new());
    println!("| photos | MiB resident | ms a photo, median | most |\n|---|---|---|---|");
    let (mut settled, mut last) = (0, 0);
    for photo in KEPT..KEPT + PHOTOS[usize::from(long())] {
        let (new, begun) = (some(photo, 1), Instant::now());
        let answer = client.post(format!("{url}?wait_ms=60000")).multipart(form(&new));
        let answer = answer.send().await.unwrap();
        joins.push(begun.elapsed());
        assert_eq!(answer.status(), 200, "photo {photo}: {}", answer.text().await.unwrap());
        let gone = upload.photos[(photo - KEPT) % ROUND.photos].name.replace('/', "%2F");
        let left = client.delete(format!("{url}/{gone}?wait_ms=60000")).send().await.unwrap();
        assert_eq!(left.status(), 200, "photo {photo}: {}", left.text().await.unwrap());
        if joins.len() % ROW == 0 {
            last = row(&server, joins.len(), &joins);
            settled = if settled == 0 { last } else { settled };
        }
    }
    let (_, scene) = process::get(&client, &server.url(&format!("/v1/scenes/{id}"))).await.unwrap();
    assert_eq!(scene["cameras"].as_array().map(Vec::len), Some(KEPT));
    if long() {
        let (first, then) = (median(&joins[..ROW]), median(&joins[joins.len() - ROW..]));
        assert!(then < SLOWER_MAX * first, "{first:.0} ms a photo at first, then {then:.0}");
        assert!(last < settled + MEMORY_MAX, "{settled} bytes at first, then {last}");
    }
}
