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
    // Versions come often, so that some kills meet the writing of one.
    let config = data.path().with_extension("toml");
    std::fs::write(&config, "[limits]\nrefine_steps_max = 1000\n").unwrap();
    let start = Start::on(data.path()).arg("--refine").arg("600000");
    let start = start.arg("--config").arg(&config.display().to_string());
    let mut server = start.start();
    let client = crate::common::client();
    let options = SampleOptions { photos: 6, width: 64, height: 48, seed: 5 };
    let upload = sample::upload(&options).expect("in range");
    let made = process::create(&client, &server.url, &upload, 60_000, None).await.unwrap();
    let id = made.1["id"].as_str().unwrap().to_owned();
    let (mut last, mut resumed) = (1, 0);
    for kill in 0..KILLS[usize::from(long())] {
        let url = server.url(&format!("/v1/scenes/{id}"));
        let found = status(&client, &url).await;
        let version = found["version"].as_u64().unwrap();
        assert!(version >= last, "kill {kill}: version {version} after {last}");
        last = version;
        resumed += usize::from(kill > 0 && found["refinement"]["state"] == "running");
        whole(&client, &server, &id).await;
        if found["refinement"]["state"] != "running" {
            let asked = client.post(format!("{url}/refine?refine=600000")).send().await.unwrap();
            assert_eq!(asked.status(), 202);
        }
        // A different part of its life each time: its start, its steps, the writing of a version.
        for _ in 0..kill % 7 {
            last = last.max(status(&client, &url).await["version"].as_u64().unwrap());
            tokio::time::sleep(std::time::Duration::from_millis(20)).await;
        }
        // Some come right after a version was published.
        if kill % 3 == 1 {
            last = eventually("a version, or the end", async || {
                let now = status(&client, &url).await;
                let version = now["version"].as_u64().unwrap();
                let over = now["refinement"]["state"] != "running";
                (version > last || over).then_some(version)
            })
            .await;
        }
        server.kill();
        server = start.start();
    }
    whole(&client, &server, &id).await;
    assert!(resumed > 0 && last > 1, "{resumed} went on, {last} versions");
    let (status, _) = process::get(&client, &server.url("/readyz")).await.unwrap();
    assert_eq!(status, 200);
    println!("version {last} at the end, {resumed} refinements went on");
}
