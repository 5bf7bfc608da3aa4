//! `kill -9` while photos join a scene: no photo that was acknowledged is lost, and the version
//! that is served is whole.

use std::time::Duration;

use segsplat::sample::{self, SampleOptions};
use serde_json::Value;

use crate::common::{
    doors::form,
    process::{self, Process, Start, can_serve, eventually, long, photos_of},
};

/// Kills of the short form and of the long one.
const KILLS: [usize; 2] = [3, 30];
/// Photos of a scene before it grows, and afterwards.
const PHOTOS: [usize; 2] = [3, 8];

async fn status(client: &reqwest::Client, server: &Process, id: &str) -> Value {
    let url = server.url(&format!("/v1/scenes/{id}"));
    let (status, said) = process::get(client, &url).await.unwrap();
    assert_eq!((status, said["state"].as_str()), (200, Some("done")), "{said}");
    said
}

fn files(scene: &Value) -> Vec<&str> {
    let cameras = scene["cameras"].as_array().into_iter().flatten();
    cameras.map(|camera| camera["file"].as_str().expect("a name")).collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn no_photo_that_was_acknowledged_is_lost_by_a_kill() {
    if !can_serve() {
        return;
    }
    let data = tempfile::tempdir().unwrap();
    let start = Start::on(data.path()).arg("--refine").arg("off");
    let mut server = start.start();
    let client = crate::common::client();
    let (mut cut_off, mut scene, mut next) = (0, None::<(String, u64)>, 0);
    for kill in 0..KILLS[usize::from(long())] {
        let (id, seed) = match scene.take() {
            Some(known) => known,
            None => {
                next = PHOTOS[0];
                let upload = sample::upload(&options(kill as u64)).expect("in range");
                let first = photos_of(&upload, &(0..PHOTOS[0]).collect::<Vec<_>>());
                let made = process::create(&client, &server.url, &first, 60_000, None).await;
                (made.unwrap().1["id"].as_str().unwrap().to_owned(), kill as u64)
            }
        };
        let upload = sample::upload(&options(seed)).expect("in range");
        let one = photos_of(&upload, &[next]);
        let url = server.url(&format!("/v1/scenes/{id}/photos"));
        let answer = client.post(url).multipart(form(&one)).send().await.unwrap();
        assert_eq!(answer.status(), 202);
        next += 1;
        // Another part of its life each time.
        tokio::time::sleep(Duration::from_millis(40 * (kill as u64 % 7))).await;
        server.kill();
        server = start.start();
        let after = status(&client, &server, &id).await;
        cut_off += usize::from(after["growth"]["state"] == "running");
        let whole = eventually("the photo", async || {
            let now = status(&client, &server, &id).await;
            (now["growth"]["state"] != "running").then_some(now)
        })
        .await;
        assert_eq!(whole["growth"]["state"], "done", "kill {kill}: {whole}");
        assert_eq!(files(&whole).len(), next, "kill {kill}: {whole}");
        let view = format!("/v1/scenes/{id}/view?from={}&format=rgb8", next - 1);
        let view = process::bytes(&client, &server.url(&view)).await.unwrap();
        assert!(view.expect("a view").iter().any(|v| *v > 0), "a picture");
        scene = (next < PHOTOS[1]).then_some((id, seed));
    }
    assert!(cut_off > 0, "some kills came before the photo had joined");
    println!("{cut_off} additions went on after a kill");
}

fn options(seed: u64) -> SampleOptions {
    SampleOptions { photos: PHOTOS[1], width: 64, height: 48, seed }
}
