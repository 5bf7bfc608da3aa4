//! Replicas that share an S3-compatible store, as plain processes behind HAProxy: all serve the
//! scenes of each, and no scene is lost with a replica that dies.

use std::{
    collections::{BTreeSet, HashMap},
    sync::{
        Arc,
        atomic::{AtomicBool, AtomicUsize, Ordering},
    },
    time::Duration,
};

use reqwest::Client;
use segsplat::{
    error::TABLE,
    sample::{self, SampleOptions},
    scene::Upload,
};
use serde_json::Value;
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
    assert_eq!(status, 422, "the key stands for another upload");

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

/// Fails unless this is an error that a caller may try again, by its name.
fn may_be_tried_again(status: u16, said: &Value) {
    let known = TABLE.iter().any(|row| row.retry && said["code"] == row.name);
    assert!(known && said["details"]["retry"] == true, "{status}: {said}");
}

/// A picture; `None` where the call is to be tried again.
async fn picture(client: &Client, url: &str) -> Option<Vec<u8>> {
    let answer = client.get(url).send().await.ok()?;
    let status = answer.status().as_u16();
    let body = answer.bytes().await.ok()?;
    if status == 200 {
        return Some(body.to_vec());
    }
    may_be_tried_again(status, &serde_json::from_slice(&body).unwrap_or_default());
    None
}

/// Makes scenes, one after the other, until it is told to stop; the ids that were acknowledged. A
/// call that fails is tried again with its key.
async fn make_scenes(base: String, stop: Arc<AtomicBool>) -> Vec<String> {
    let (client, mut ids) = (crate::common::client(), Vec::new());
    while !stop.load(Ordering::Acquire) {
        let (upload, key) = (upload(100 + ids.len() as u64), format!("scene {}", ids.len()));
        for tried in 0.. {
            assert!(tried < 40, "{key} is not taken");
            match process::create(&client, &base, &upload, 0, Some(&key)).await {
                Ok((_, said)) if said["id"].is_string() => {
                    ids.push(said["id"].as_str().unwrap().to_owned());
                    break;
                }
                Ok((status, said)) => may_be_tried_again(status, &said),
                Err(_) => {}
            }
            tokio::time::sleep(Duration::from_millis(250)).await;
        }
        tokio::time::sleep(Duration::from_millis(250)).await;
    }
    ids
}

/// The ids that a replica lists, page by page.
async fn listed(client: &Client, replica: &Process) -> BTreeSet<String> {
    let (mut ids, mut after) = (BTreeSet::new(), String::new());
    loop {
        let url = replica.url(&format!("/v1/scenes?limit=100{after}"));
        let (_, page) = process::get(client, &url).await.unwrap();
        let scenes = page["scenes"].as_array().unwrap();
        ids.extend(scenes.iter().map(|scene| scene["id"].as_str().unwrap().to_owned()));
        let Some(next) = page["next"].as_str() else { return ids };
        after = format!("&after={next}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_replica_killed_under_load_fails_its_own_calls_once_and_its_scenes_are_made() {
    let Some(mut cluster) = cluster() else { return };
    let all: Vec<&Process> = cluster.replicas.iter().collect();
    let Some(balancer) = Balancer::start(&all).await else { return };
    let client = crate::common::client();
    let (mut ids, mut pictures) = (Vec::new(), HashMap::new());
    for seed in 0..6 {
        let id = made(&client, &balancer.url, seed).await;
        let url =
            format!("{}/v1/scenes/{id}/view?from=0&to=1&t=0.5&width=64&height=48", balancer.url);
        let first = picture(&client, &url).await.expect("no replica is killed yet");
        pictures.insert(url, first);
        ids.push(id);
    }
    let pictures = Arc::new(pictures);
    let (stop, calls) = (Arc::new(AtomicBool::new(false)), Arc::new(AtomicUsize::new(0)));
    let failed = Arc::new(AtomicUsize::new(0));
    let maker = tokio::spawn(make_scenes(balancer.url.clone(), Arc::clone(&stop)));
    let callers: Vec<_> = (0..6)
        .map(|i| {
            let (pictures, stop) = (Arc::clone(&pictures), Arc::clone(&stop));
            let (calls, failed) = (Arc::clone(&calls), Arc::clone(&failed));
            tokio::spawn(async move {
                let client = crate::common::client();
                for (url, first) in pictures.iter().cycle().skip(i) {
                    if stop.load(Ordering::Acquire) {
                        return;
                    }
                    calls.fetch_add(1, Ordering::AcqRel);
                    // The call itself may die with the replica; one retry must succeed, after the
                    // moment that a health check takes.
                    let mut got = None;
                    for pause in [0, 100, 2_500] {
                        tokio::time::sleep(Duration::from_millis(pause)).await;
                        got = picture(&client, url).await;
                        if got.is_some() {
                            break;
                        }
                        failed.fetch_add(usize::from(pause == 0), Ordering::AcqRel);
                    }
                    let got = got.unwrap_or_else(|| panic!("{url} does not come back"));
                    assert!(got == *first, "{url} changed");
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
    for seed in [20, 21] {
        let (status, said) =
            process::create(&client, &dying.url, &upload(seed), 0, None).await.unwrap();
        assert_eq!(status, 202, "{said}");
        ids.push(said["id"].as_str().unwrap().to_owned());
    }
    cluster.replicas[0].kill();
    let seconds = if long() { 60 } else { 4 };
    tokio::time::sleep(Duration::from_secs(seconds)).await;
    stop.store(true, Ordering::Release);
    for caller in callers {
        caller.await.expect("a retry failed");
    }
    let taken = maker.await.expect("a scene was refused for good");
    let (calls, failed) = (calls.load(Ordering::Acquire), failed.load(Ordering::Acquire));
    // Callers wait for one answer at a time: at most that many calls were under way, and a few
    // met the dead replica before the health check saw it.
    assert!(calls > warm && failed <= 6 * 4, "{failed} of {calls} calls failed");
    println!(
        "{calls} views, {failed} failed once, {} scenes taken while a replica was killed",
        taken.len()
    );
    ids.extend(taken);
    for id in &ids {
        let url = format!("{}/v1/scenes/{id}", balancer.url);
        eventually("each scene that was taken is made", async || {
            let (status, said) = process::get(&client, &url).await.ok()?;
            if status != 200 {
                may_be_tried_again(status, &said);
            }
            (said["state"] == "done").then_some(())
        })
        .await;
    }
    // A call that was tried again has made one scene.
    let listed = listed(&client, &cluster.replicas[1]).await;
    assert_eq!(listed, ids.into_iter().collect(), "what is listed is what was taken");
    // With none left the balancer answers by itself, and by name.
    for replica in &mut cluster.replicas[1..] {
        replica.kill();
    }
    let url = format!("{}/v1/scenes", balancer.url);
    // A connection that was open ends without an answer.
    let asked = async || process::get(&client, &url).await.ok();
    let (status, said) = eventually("the balancer answers", asked).await;
    assert_eq!(status, 503, "{said}");
    may_be_tried_again(status, &said);
}
