//! Replicas that share an S3-compatible store, as plain processes behind HAProxy: all serve the
//! scenes of each, and no scene is lost with a replica that dies.

use std::{
    collections::HashMap,
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::Duration,
};

use reqwest::Client;
use segsplat::{
    sample::{self, SampleOptions},
    scene::Upload,
};
use tempfile::TempDir;

use crate::common::{
    cluster::{Balancer, S3},
    process::{self, Process, can_serve, eventually, long},
};

fn upload(seed: u64) -> Upload {
    let options = SampleOptions { photos: 2, width: 64, height: 48, seed };
    sample::upload(&options).expect("in range")
}

/// A store and three replicas on it.
struct Cluster {
    replicas: Vec<Process>,
    _s3: S3,
    _folder: TempDir,
}

fn cluster() -> Option<Cluster> {
    if !can_serve() {
        return None;
    }
    let s3 = S3::start();
    let folder = tempfile::tempdir().expect("a temporary folder");
    let config = folder.path().join("segsplat.toml");
    // Short, so that the test need not wait for what takes seconds by default.
    let limits =
        "[limits]\nreplica_beat_ms = 300\nreplica_lease_ms = 2500\nrecord_fresh_ms = 200\n";
    std::fs::write(&config, limits).expect("written");
    let data = |i: usize| folder.path().join(format!("data{i}"));
    let replicas = (0..3).map(|i| s3.replica(&data(i), &config).start()).collect();
    Some(Cluster { replicas, _s3: s3, _folder: folder })
}

async fn made(client: &Client, base: &str, seed: u64) -> String {
    let (status, said) = process::create(client, base, &upload(seed), 60_000, None).await.unwrap();
    assert_eq!((status, said["state"].as_str()), (201, Some("done")), "{said}");
    said["id"].as_str().unwrap().to_owned()
}

#[tokio::test(flavor = "multi_thread")]
async fn what_one_replica_makes_the_others_serve_list_and_delete() {
    let Some(cluster) = cluster() else { return };
    let (client, [a, b, c]) = (crate::common::client(), [0, 1, 2].map(|i| &cluster.replicas[i]));
    let id = made(&client, &a.url, 1).await;
    let path = |what: &str| format!("/v1/scenes/{id}{what}");
    let view = path("/view?from=0&to=1&t=0.5&width=64&height=48");
    let first = process::bytes(&client, &a.url(&view)).await.unwrap().unwrap();
    for other in [b, c] {
        let (status, said) = process::get(&client, &other.url(&path(""))).await.unwrap();
        assert_eq!((status, said["state"].as_str()), (200, Some("done")), "{said}");
        assert_eq!(process::bytes(&client, &other.url(&view)).await.unwrap(), Ok(first.clone()));
        let (_, page) = process::get(&client, &other.url("/v1/scenes")).await.unwrap();
        assert_eq!(page["scenes"][0]["id"], id.as_str(), "{page}");
    }

    // One key makes one scene, whichever replica is asked.
    let (_, one) = process::create(&client, &a.url, &upload(2), 0, Some("k")).await.unwrap();
    let (_, again) = process::create(&client, &b.url, &upload(2), 0, Some("k")).await.unwrap();
    assert_eq!(one["id"], again["id"], "{one} {again}");
    let (status, _) = process::create(&client, &c.url, &upload(3), 0, Some("k")).await.unwrap();
    assert_eq!(status, 400, "the key stands for another upload");

    // Whoever watches at another replica sees the end of it.
    let events = c.url(&format!("/v1/scenes/{}/events", one["id"].as_str().unwrap()));
    let told = process::bytes(&client, &events).await.unwrap().unwrap();
    assert!(String::from_utf8_lossy(&told).contains("done"), "{}", String::from_utf8_lossy(&told));

    let deleted = process::delete(&client, &b.url(&path(""))).await.unwrap();
    assert!([200, 204].contains(&deleted), "another replica deletes: {deleted}");
    for replica in [a, b, c] {
        eventually("a deletion is seen everywhere", async || {
            let seen = process::bytes(&client, &replica.url(&view)).await.unwrap();
            (seen == Err(404)).then_some(())
        })
        .await;
    }
    assert_eq!(process::delete(&client, &a.url(&path(""))).await.unwrap(), 404);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_replica_killed_under_load_fails_its_own_calls_once_and_its_scenes_are_made() {
    let Some(mut cluster) = cluster() else { return };
    let all: Vec<&Process> = cluster.replicas.iter().collect();
    let Some(balancer) = Balancer::start(&all).await else { return };
    let client = crate::common::client();
    let mut pictures = HashMap::new();
    for seed in 0..6 {
        let id = made(&client, &balancer.url, seed).await;
        let url =
            format!("{}/v1/scenes/{id}/view?from=0&to=1&t=0.5&width=64&height=48", balancer.url);
        let picture = process::bytes(&client, &url).await.unwrap().unwrap();
        pictures.insert(url, picture);
    }
    let pictures = Arc::new(pictures);
    let (stop, calls) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicUsize::new(0)));
    let failed = Arc::new(AtomicUsize::new(0));
    let callers: Vec<_> = (0..6)
        .map(|i| {
            let (pictures, stop) = (Arc::clone(&pictures), Arc::clone(&stop));
            let (calls, failed) = (Arc::clone(&calls), Arc::clone(&failed));
            tokio::spawn(async move {
                let client = crate::common::client();
                for (url, picture) in pictures.iter().cycle().skip(i) {
                    if stop.load(Ordering::Acquire) {
                        return;
                    }
                    calls.fetch_add(1, Ordering::AcqRel);
                    // The call itself may die with the replica; one retry must succeed, after the
                    // moment that a health check takes.
                    let mut tries = Vec::new();
                    for pause in [0, 100, 2_500] {
                        tokio::time::sleep(Duration::from_millis(pause)).await;
                        match process::bytes(&client, url).await {
                            Ok(Ok(got)) => {
                                assert_eq!(got, *picture, "{url} changed");
                                tries.clear();
                                break;
                            }
                            other => tries.push(other.map(|bytes| bytes.map(|b| b.len()))),
                        }
                        if pause == 0 {
                            failed.fetch_add(1, Ordering::AcqRel);
                        }
                    }
                    assert!(tries.is_empty(), "{url}: {tries:?}");
                }
            })
        })
        .collect();
    let warm = eventually("some calls", async || {
        let calls = calls.load(Ordering::Acquire);
        (calls > 40).then_some(calls)
    })
    .await;
    // Work acknowledged by the one that dies: one scene at work, one waiting.
    let dying = &cluster.replicas[0];
    let mut left = Vec::new();
    for seed in [20, 21] {
        let (status, said) =
            process::create(&client, &dying.url, &upload(seed), 0, None).await.unwrap();
        assert_eq!(status, 202, "{said}");
        left.push(said["id"].as_str().unwrap().to_owned());
    }
    cluster.replicas[0].kill();
    let seconds = if long() { 60 } else { 4 };
    tokio::time::sleep(Duration::from_secs(seconds)).await;
    stop.store(true, Ordering::Release);
    for caller in callers {
        caller.await.expect("a retry failed");
    }
    let (calls, failed) = (calls.load(Ordering::Acquire), failed.load(Ordering::Acquire));
    // Callers wait for one answer at a time: at most that many calls were under way, and a few
    // met the dead replica before the health check saw it.
    assert!(calls > warm && failed <= 6 * 4, "{failed} of {calls} calls failed");
    for id in left {
        let url = format!("{}/v1/scenes/{id}", balancer.url);
        eventually("a scene of the dead replica", async || {
            let (status, said) = process::get(&client, &url).await.ok()?;
            assert!([200, 502, 503].contains(&status), "{status}: {said}");
            (said["state"] == "done").then_some(())
        })
        .await;
    }
    println!("{calls} calls, {failed} failed once when a replica was killed; its scenes were made");
}
