//! `kill -9` at random points of create, view, delete and evict: no acknowledged scene is lost or
//! changed, and no object is left over. It runs the program itself, on a folder of its own.

use std::{
    collections::{BTreeMap, HashSet},
    fs::File,
    path::Path,
    process::Command,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::{Duration, Instant},
};

use reqwest::Client;
use segsplat::{
    sample::{self, SampleOptions},
    scene::Upload,
};
use sha2::{Digest, Sha256};

use crate::common::process::{self, Process, Start, can_serve, eventually, long};

/// Scenes beyond which callers rather delete than make.
const SCENES_MAX: usize = 60;

/// What was acknowledged of a scene.
#[derive(Clone, Debug, Default)]
struct Known {
    /// sha256 of its export, once it was seen whole.
    export: Option<Vec<u8>>,
    /// A deletion was sent; the scene may or may not be there.
    doomed: bool,
    /// The deletion was acknowledged.
    gone: bool,
}

type Ledger = Arc<Mutex<BTreeMap<String, Known>>>;

/// What the callers of one round got so far. The kill waits for counts, so that it does not depend
/// on the speed of the machine.
#[derive(Debug, Default)]
struct Progress {
    /// Calls that were answered.
    answers: AtomicU64,
    /// Exports that arrived whole.
    exports: AtomicU64,
}

/// Reproducible numbers.
struct Random(u64);

impl Random {
    fn below(&mut self, n: u64) -> u64 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) % n
    }
}

fn uploads() -> Vec<Upload> {
    let of = |seed| {
        let options = SampleOptions { photos: 2 + seed as usize % 2, width: 64, height: 48, seed };
        sample::upload(&options).expect("in range")
    };
    (0..12).map(of).collect()
}

fn note(ledger: &Ledger, id: &str, change: impl FnOnce(&mut Known)) {
    change(ledger.lock().unwrap().entry(id.to_owned()).or_default());
}

async fn export(
    client: &Client,
    server: &Process,
    id: &str,
) -> Result<Result<Vec<u8>, u16>, reqwest::Error> {
    let file = process::bytes(client, &server.url(&format!("/v1/scenes/{id}/export"))).await?;
    Ok(file.map(|file| Sha256::digest(file).to_vec()))
}

/// One caller: makes, looks, deletes, until the server is gone. Where there is no room for another
/// scene it deletes some.
async fn caller(
    server: Arc<Process>,
    ledger: Ledger,
    progress: Arc<Progress>,
    uploads: Arc<Vec<Upload>>,
    seed: u64,
) {
    let mut deletions = 0;
    let (client, mut random) = (crate::common::client(), Random(seed));
    loop {
        let ids: Vec<String> = {
            let ledger = ledger.lock().unwrap();
            ledger.iter().filter(|(_, known)| !known.doomed).map(|(id, _)| id.clone()).collect()
        };
        // So many that a check of them all stays short.
        if ids.len() > SCENES_MAX {
            deletions = 1;
        }
        let one = ids.get(random.below(ids.len().max(1) as u64) as usize);
        let dice = if deletions > 0 { 39 } else { random.below(40) };
        deletions -= i32::from(deletions > 0);
        let done = match (dice, one) {
            (0..=15, _) | (_, None) => {
                let upload = &uploads[random.below(uploads.len() as u64) as usize];
                let wait = [0, 5_000][random.below(2) as usize];
                process::create(&client, &server.url, upload, wait, None).await.map(
                    |(status, said)| {
                        let no_room = status == 503 && said["code"] == "store_unavailable";
                        assert!(no_room || [200, 201, 202, 429].contains(&status), "{said}");
                        deletions = if no_room { 6 } else { 0 };
                        // A scene that found no room while its caller waited is there, failed.
                        let id = said["id"].as_str().or(said["details"]["scene"].as_str());
                        if let Some(id) = id {
                            note(&ledger, id, |_| {});
                        }
                    },
                )
            }
            (16..=37, Some(id)) => export(&client, &server, id).await.map(|file| match file {
                Ok(digest) => {
                    note(&ledger, id, |known| {
                        let first = known.export.get_or_insert_with(|| digest.clone());
                        assert_eq!(*first, digest, "{id} changed");
                    });
                    progress.exports.fetch_add(1, Ordering::Relaxed);
                }
                // Not ready yet, or another caller's deletion came first.
                Err(status) => assert!([404, 409, 429].contains(&status), "{id}: {status}"),
            }),
            (_, Some(id)) => {
                note(&ledger, id, |known| known.doomed = true);
                let deleted =
                    process::delete(&client, &server.url(&format!("/v1/scenes/{id}"))).await;
                deleted.map(|status| {
                    assert!([200, 204, 404].contains(&status), "{id}: {status}");
                    note(&ledger, id, |known| known.gone = true);
                })
            }
        };
        if done.is_err() {
            return;
        }
        progress.answers.fetch_add(1, Ordering::Relaxed);
    }
}

/// Holds the server to what it had acknowledged.
async fn check(server: &Process, ledger: &Ledger, room: Room) {
    let client = crate::common::client();
    let known: Vec<_> = ledger.lock().unwrap().clone().into_iter().collect();
    for (id, known) in known {
        let (status, said) =
            process::get(&client, &server.url(&format!("/v1/scenes/{id}"))).await.unwrap();
        if known.gone {
            assert_eq!(status, 404, "{id} came back: {said}");
        } else if !(known.doomed && status == 404) {
            assert_eq!(status, 200, "{id} is lost: {said}");
            let state = said["state"].as_str().unwrap();
            // What was accepted and then found no room says so.
            let no_room = room == Room::Scarce && said["error"]["code"] == "store_unavailable";
            assert!(no_room || ["queued", "running", "done"].contains(&state), "{id}: {said}");
            if let Some(first) = known.export {
                let now = export(&client, server, &id).await.unwrap();
                assert_eq!(now, Ok(first), "{id} changed");
            }
        }
        // A deletion that the kill cut off was done or not; it is not done later.
        note(ledger, &id, |known| (known.gone, known.doomed) = (status == 404, status == 404));
    }
}

/// Room on the disk.
#[derive(Clone, Copy, Debug, PartialEq)]
enum Room {
    Ample,
    /// So little that it is full most of the time.
    Scarce,
}

/// A file system of its own with little room, for as long as it lives.
struct SmallDisk(tempfile::TempDir);

impl SmallDisk {
    /// `None` (said on standard output) where this process may not mount.
    fn mount(size: &str) -> Option<Self> {
        if !may_mount() {
            println!("skipped: a small file system takes root, which no script can get");
            return None;
        }
        let folder = tempfile::tempdir().expect("a temporary folder");
        let mounted = Command::new("mount")
            .args(["-t", "tmpfs", "-o", &format!("size={size}"), "tmpfs"])
            .arg(folder.path())
            .status();
        assert!(mounted.expect("mount starts").success(), "a small file system is mounted");
        Some(Self(folder))
    }
}

/// Whether this process has the capability to mount (`CAP_SYS_ADMIN`).
fn may_mount() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").unwrap_or_default();
    let mask = status.lines().find_map(|line| line.strip_prefix("CapEff:"));
    mask.and_then(|mask| u64::from_str_radix(mask.trim(), 16).ok())
        .is_some_and(|mask| mask >> 21 & 1 == 1)
}

impl Drop for SmallDisk {
    fn drop(&mut self) {
        let _ = Command::new("umount").arg("--lazy").arg(self.0.path()).status();
    }
}

/// Ids in the names of everything under the folder.
fn ids_on_disk(data: &Path) -> (HashSet<String>, Vec<String>) {
    let (mut ids, mut odd) = (HashSet::new(), Vec::new());
    for prefix in ["scenes", "pending", "keys", "contents"] {
        for entry in std::fs::read_dir(data.join(prefix)).into_iter().flatten() {
            let path = entry.unwrap().path();
            let name = path.file_name().unwrap().to_string_lossy().into_owned();
            match prefix {
                "scenes" | "pending" => drop(ids.insert(name)),
                _ => {
                    let text = std::fs::read_to_string(&path).unwrap();
                    let json: serde_json::Value = serde_json::from_str(&text).unwrap();
                    ids.insert(json["id"].as_str().unwrap().to_owned());
                }
            }
            if path.is_dir() {
                for file in std::fs::read_dir(&path).unwrap() {
                    let file = file.unwrap().file_name().to_string_lossy().into_owned();
                    if file.contains('#') {
                        odd.push(file);
                    }
                }
            }
        }
    }
    (ids, odd)
}

/// A small memory cache, so that scenes are evicted all the time, and uploads of which the first
/// bytes stay in memory and the others go to the store as they come.
fn start(data: &Path, config: &Path) -> Start {
    let limits = "cache_bytes_max = 200000\nqueued_jobs_max = 64\nupload_memory_bytes_max = 6000\n";
    std::fs::write(config, format!("[limits]\n{limits}")).unwrap();
    Start::on(data).arg("--config").arg(&config.display().to_string())
}

#[tokio::test(flavor = "multi_thread")]
async fn nothing_acknowledged_is_lost_or_changed_by_kill_9() {
    if can_serve() {
        let folder = tempfile::tempdir().unwrap();
        killed(folder.path(), if long() { 200 } else { 6 }, Room::Ample).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn nor_by_kill_9_on_a_full_disk() {
    if can_serve()
        && let Some(disk) = SmallDisk::mount("4m")
    {
        killed(disk.0.path(), if long() { 200 } else { 5 }, Room::Scarce).await;
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_create_that_finds_the_disk_full_leaves_nothing() {
    if !can_serve() {
        return;
    }
    let Some(disk) = SmallDisk::mount("4m") else { return };
    let (folder, client) = (disk.0.path(), crate::common::client());
    let config = tempfile::NamedTempFile::new().unwrap();
    let server = start(&folder.join("data"), config.path()).start();
    let ballast = folder.join("ballast");
    let zeros = std::io::copy(&mut std::io::repeat(0), &mut File::create(&ballast).unwrap());
    assert_eq!(zeros.unwrap_err().kind(), std::io::ErrorKind::StorageFull);
    let upload = &uploads()[0];
    for _ in 0..3 {
        let (status, said) = process::create(&client, &server.url, upload, 0, None).await.unwrap();
        assert_eq!((status, &said["code"]), (503, &"store_unavailable".into()), "{said}");
    }
    eventually("folders of scenes that are not there go", async || {
        let left = std::fs::read_dir(folder.join("data/scenes")).into_iter().flatten().count();
        (left == 0).then_some(())
    })
    .await;
    std::fs::remove_file(ballast).unwrap();
    let (status, said) = process::create(&client, &server.url, upload, 5_000, None).await.unwrap();
    assert_eq!(status, 201, "there is room again: {said}");
}

async fn killed(folder: &Path, kills: u64, room: Room) {
    let config = tempfile::NamedTempFile::new().unwrap();
    let data = folder.join("data");
    let start = start(&data, config.path());
    let ledger = Ledger::default();
    let uploads = Arc::new(uploads());
    let mut random = Random(77);
    let mut starts = Vec::new();
    for round in 0..kills {
        let server = Arc::new(start.start());
        starts.push(server.started_in);
        // Scenes whose answer the kill cut off: callers know and delete them from now on, else
        // they would fill a small disk.
        for id in unacknowledged(&server, &ledger).await {
            note(&ledger, &id, |_| {});
        }
        check(&server, &ledger, room).await;
        let progress = Arc::new(Progress::default());
        let callers: Vec<_> = (0..4)
            .map(|i| {
                let (server, ledger) = (Arc::clone(&server), Arc::clone(&ledger));
                let (progress, uploads) = (Arc::clone(&progress), Arc::clone(&uploads));
                tokio::spawn(caller(server, ledger, progress, uploads, 100 * round + i))
            })
            .collect();
        // Every second kill may come before any scene is whole, the others only after some were.
        let (answers, exports) = (random.below(150), (1 - round % 2) * (1 + random.below(15)));
        eventually("answers before the kill", async || {
            let reached = progress.answers.load(Ordering::Relaxed) >= answers
                && progress.exports.load(Ordering::Relaxed) >= exports;
            // A caller that panicked says so below.
            (reached || callers.iter().any(|caller| caller.is_finished())).then_some(())
        })
        .await;
        tokio::time::sleep(Duration::from_millis(random.below(100))).await;
        server.kill_now();
        for caller in callers {
            caller.await.expect("a caller saw what it must not");
        }
    }
    let server = start.start();
    check(&server, &ledger, room).await;
    let client = crate::common::client();
    // Everything acknowledged is made, or has said why not.
    let mut done = 0;
    for id in there(&ledger) {
        let url = server.url(&format!("/v1/scenes/{id}"));
        let state = eventually(&id, async || {
            if room == Room::Scarce {
                delete_the_done(&server, &ledger).await;
            }
            let (_, said) = process::get(&client, &url).await.unwrap();
            let state = said["state"].as_str().unwrap_or("done").to_owned();
            (state != "queued" && state != "running").then_some(state)
        })
        .await;
        // A scene whose making was killed three times is given up, by its code.
        done += usize::from(state == "done");
    }
    let known = there(&ledger);
    check_after(&server, &ledger).await;
    let unknown = unacknowledged(&server, &ledger).await;
    assert!(server.stop(), "it ends well");
    let swept = start.start();
    let begun = Instant::now();
    let (on_disk, odd) = eventually("the sweep", async || {
        let (ids, odd) = ids_on_disk(&data);
        let left: Vec<_> =
            ids.iter().filter(|id| !known.contains(id) && !unknown.contains(*id)).collect();
        assert!(
            left.is_empty() || begun.elapsed() < Duration::from_secs(50),
            "left over: {left:?}"
        );
        left.is_empty().then_some((ids.clone(), odd))
    })
    .await;
    assert_eq!(odd, Vec::<String>::new(), "staging files are cleared");
    assert!(known.iter().all(|id| on_disk.contains(id)));
    starts.push(swept.started_in);
    starts.sort();
    let slowest = starts[starts.len() - 1];
    // A bound on time is held where nothing else runs.
    assert!(!long() || slowest < Duration::from_secs(2), "a start took {slowest:?}");
    let seen = ledger.lock().unwrap().values().filter(|known| known.export.is_some()).count();
    assert!(seen > 0, "some were seen whole");
    println!(
        "{kills} kills, room {room:?}: {} scenes acknowledged, {seen} seen whole, {} there at the \
         end ({done} done), none lost or changed; start median {:?}, slowest {slowest:?}",
        ledger.lock().unwrap().len(),
        known.len(),
        starts[starts.len() / 2],
    );
}

/// Scenes that are known and not deleted.
fn there(ledger: &Ledger) -> Vec<String> {
    let ledger = ledger.lock().unwrap();
    ledger.iter().filter(|(_, known)| !known.gone).map(|(id, _)| id.clone()).collect()
}

/// Makes room for scenes that wait for it.
async fn delete_the_done(server: &Process, ledger: &Ledger) {
    let client = crate::common::client();
    for id in there(ledger) {
        let url = server.url(&format!("/v1/scenes/{id}"));
        let (_, said) = process::get(&client, &url).await.unwrap();
        if said["state"] == "done" {
            assert_eq!(process::delete(&client, &url).await.unwrap(), 204, "{id}");
            note(ledger, &id, |known| known.gone = true);
        }
    }
}

/// As [`check`], where nothing is in the making any more: a scene given up is no loss.
async fn check_after(server: &Process, ledger: &Ledger) {
    let client = crate::common::client();
    let known: Vec<_> = ledger.lock().unwrap().clone().into_iter().collect();
    for (id, known) in known.into_iter().filter(|(_, known)| known.export.is_some() && !known.gone)
    {
        let now = export(&client, server, &id).await.unwrap();
        assert_eq!(now.ok(), known.export, "{id} changed");
    }
}

/// Scenes of the server whose id no caller got: the kill came before the answer.
async fn unacknowledged(server: &Process, ledger: &Ledger) -> HashSet<String> {
    let client = crate::common::client();
    let (mut ids, mut after) = (HashSet::new(), String::new());
    loop {
        let url = server.url(&format!("/v1/scenes?limit=100{after}"));
        let (_, page) = process::get(&client, &url).await.unwrap();
        for scene in page["scenes"].as_array().unwrap() {
            ids.insert(scene["id"].as_str().unwrap().to_owned());
        }
        match page["next"].as_str() {
            Some(next) => after = format!("&after={next}"),
            None => break,
        }
    }
    let ledger = ledger.lock().unwrap();
    ids.into_iter().filter(|id| !ledger.contains_key(id)).collect()
}
