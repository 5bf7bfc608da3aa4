//! `kill -9` in the middle of a refinement: the version that was published last is whole and
//! served, and the refinement goes on.

use segsplat::sample::{self, SampleOptions};

use crate::common::process::{self, Process, Start, can_serve, eventually, long};

/// Kills of the short form and of the long one.
const KILLS: [usize; 2] = [3, 50];

async fn status(client: &reqwest::Client, url: &str) -> serde_json::Value {
    let (status, said) = process::get(client, url).await.unwrap();
    assert_eq!((status, said["state"].as_str()), (200, Some("done")), "{said}");
    said
}

/// The export has all Gaussians of the report, and a view is drawn. Between two reads another
/// version may be published: then it is looked at again.
async fn whole(client: &reqwest::Client, server: &Process, id: &str) {
    let url = server.url(&format!("/v1/scenes/{id}"));
    eventually("one version", async || {
        let before = status(client, &url).await;
        let ply = process::bytes(client, &format!("{url}/export")).await.unwrap().unwrap();
        let view = format!("{url}/view?from=0&format=rgb8");
        let view = process::bytes(client, &view).await.unwrap().unwrap();
        let after = status(client, &url).await;
        let head = String::from_utf8_lossy(&ply[..ply.len().min(2_000)]).into_owned();
        let count = format!("element vertex {}\n", before["report"]["gaussians"]);
        assert!(view.iter().any(|v| *v > 0), "a picture");
        (before["version"] == after["version"]).then(|| assert!(head.contains(&count), "{head}"))
    })
    .await;
}

#[tokio::test(flavor = "multi_thread")]
async fn a_kill_in_the_middle_of_a_refinement_leaves_the_last_version_whole() {
    if !can_serve() {
        return;
    }
    let data = tempfile::tempdir().unwrap();
    // A version comes soon, so that some kills meet the writing of one.
    let config = data.path().with_extension("toml");
    std::fs::write(&config, "[limits]\nrefine_steps_max = 100\n").unwrap();
    let start = Start::on(data.path()).arg("--refine").arg("600000");
    let start = start.arg("--config").arg(&config.display().to_string());
    let mut server = start.start();
    let client = crate::common::client();
    let (mut scene, mut resumed, mut refined) = (None, 0, 0);
    for kill in 0..KILLS[usize::from(long())] {
        // Another scene as soon as one is refined.
        let id = match scene.take() {
            Some(id) => id,
            None => {
                let options = SampleOptions { photos: 6, width: 64, height: 48, seed: kill as u64 };
                let upload = sample::upload(&options).expect("in range");
                let made = process::create(&client, &server.url, &upload, 60_000, None).await;
                made.unwrap().1["id"].as_str().unwrap().to_owned()
            }
        };
        let state = |said: &serde_json::Value| said["refinement"]["state"].clone();
        let version = |said: &serde_json::Value| said["version"].as_u64().unwrap();
        // A different part of its life each time: its start, its steps, the writing of a version.
        for _ in 0..kill % 7 {
            status(&client, &server.url(&format!("/v1/scenes/{id}"))).await;
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
        // Some come right after a version was published.
        let url = server.url(&format!("/v1/scenes/{id}"));
        if kill % 3 == 1 {
            eventually("a version, or the end", async || {
                let now = status(&client, &url).await;
                (version(&now) > 1 || state(&now) != "running").then_some(())
            })
            .await;
        }
        let before = status(&client, &url).await;
        server.kill();
        server = start.start();
        let after = status(&client, &server.url(&format!("/v1/scenes/{id}"))).await;
        assert!(version(&after) >= version(&before), "kill {kill}: {before} became {after}");
        whole(&client, &server, &id).await;
        resumed += usize::from(state(&after) == "running");
        refined += usize::from(version(&after) > 1);
        scene = (state(&after) == "running").then_some(id);
    }
    assert!(resumed > 0 && refined > 0, "{resumed} went on, {refined} were refined");
    let (status, _) = process::get(&client, &server.url("/readyz")).await.unwrap();
    assert_eq!(status, 200);
    println!("{resumed} refinements went on, {refined} scenes were refined");
}
