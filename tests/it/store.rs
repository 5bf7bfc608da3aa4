//! The store: files come back bit for bit, are whole or absent, and are put aside when they are
//! bad; PLY out and in.

use std::{
    collections::HashSet,
    fs,
    io::Cursor,
    path::Path,
    sync::{Arc, atomic::Ordering},
    time::{Duration, SystemTime},
};

use glam::DVec3;
use object_store::{memory::InMemory, path::Path as Name};
use segsplat::{
    error::{ErrorCode, Result},
    formats::{
        container::{read_scene, read_semantics, write_scene, write_semantics},
        splats::{PLY, SplatFile, SplatsRead},
        table::read_splats,
    },
    limits::Limits,
    scene::{
        Backdrop, Bank, BankMask, Gaussians, HealthReport, IndexMap, PhotoHash, Provenance,
        RawGaussians, RowViews, SanitizeReport, Scene, SceneId, SceneMeta, SceneOptions,
        SceneState, SceneStatus, Semantics, SemanticsReport, SourcePixel, Upload, UploadCameras,
        UploadFile,
    },
    store::{KeyUse, Record, Store, StoreLocation, provenance, request_sha256},
};
use serde_json::{Value, json};
use sha2::{Digest, Sha256};

use crate::common::faults::{FaultStore, Wrong};

/// Reproducible numbers in 0..1.
struct Numbers(u64);

impl Numbers {
    fn next(&mut self) -> f32 {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 40) as f32 / (1_u64 << 24) as f32
    }
}

fn gaussians(count: usize, sh_degree: u8) -> Gaussians {
    let mut n = Numbers(u64::from(sh_degree) + 17);
    let k = (usize::from(sh_degree) + 1).pow(2);
    let mut raw = RawGaussians { sh_degree, ..RawGaussians::default() };
    for i in 0..count {
        raw.means.push([0; 3].map(|_| n.next() * 20.0 - 10.0));
        raw.quats.push([0; 4].map(|_| n.next() * 2.0 - 1.0));
        raw.scales.push([0; 3].map(|_| 1e-4 + n.next()));
        raw.opacities.push(0.01 + 0.98 * n.next());
        (0..k).for_each(|_| raw.sh.push([0; 3].map(|_| n.next() * 4.0 - 2.0)));
        raw.semantic_index.push((n.next() * 65_535.0) as u16);
        raw.source.push(SourcePixel { view: i as u16 % 7, x: i as u16, y: 3 });
    }
    Gaussians::sanitize(raw).unwrap().0
}

fn scene(id: u8, count: usize, sh_degree: u8) -> Scene {
    let mut raw = gaussians(count, sh_degree).into_raw();
    raw.origin = DVec3::new(512_345.678_901, -1.0 / 3.0, 1e-300);
    let meta = SceneMeta {
        id: SceneId::from_bytes([id; 16]),
        created_ms: 1_700_000_000_123,
        cameras: Vec::new(),
        report: HealthReport { median_depth: 0.1 + 0.2, ..HealthReport::default() },
        provenance: Provenance { bundle_sha256: "ab".repeat(32), ..Provenance::default() },
    };
    let cells = (0..Backdrop::WIDTH * Backdrop::HEIGHT).map(|i| [i as u8, id, 7]).collect();
    let backdrop = Backdrop::from_cells(cells).unwrap();
    Scene::new(meta, Gaussians::restore(raw).unwrap(), backdrop)
}

fn bits(gaussians: &Gaussians) -> Vec<u32> {
    let raw = gaussians.clone().into_raw();
    let floats = [
        raw.means.as_flattened(),
        raw.quats.as_flattened(),
        raw.scales.as_flattened(),
        &raw.opacities,
        raw.sh.as_flattened(),
    ];
    let mut bits: Vec<u32> = floats.iter().copied().flatten().map(|v| v.to_bits()).collect();
    bits.extend(raw.semantic_index.iter().map(|&v| u32::from(v)));
    bits.extend(raw.source.iter().flat_map(|s| [s.view, s.x, s.y].map(u32::from)));
    bits.extend(
        raw.origin.to_array().iter().flat_map(|v| [v.to_bits() as u32, (v.to_bits() >> 32) as u32]),
    );
    bits
}

fn record(id: u8) -> Record {
    let id = SceneId::from_bytes([id; 16]);
    let status = SceneStatus::new(id, SceneState::Queued, 1_700_000_000_123);
    Record {
        owner: Some("somebody".to_owned()),
        options: SceneOptions { max_views: Some(4), ..SceneOptions::default() },
        idempotency_key: Some("key".to_owned()),
        request_sha256: "cd".repeat(32),
        ..Record::new(status)
    }
}

fn upload() -> Upload {
    let photo =
        |name: &str, bytes: &[u8]| UploadFile { name: name.to_owned(), bytes: bytes.to_vec() };
    Upload {
        cameras: Some(UploadCameras::Cameras(b"{\"cameras\":[]}".to_vec())),
        photos: vec![photo("../../a.png", &[1, 2, 3]), photo("b", &[])],
        archive: Some(vec![9; 1000]),
        splats: Some(photo("a.splat", &[7; 32])),
        kept: None,
    }
}

fn file_of(scene: &Scene) -> Vec<u8> {
    let mut file = Vec::new();
    write_scene(&mut file, scene).unwrap();
    file
}

fn open(root: &Path) -> (Store, Vec<Record>) {
    Store::open(&StoreLocation::Folder(root.to_owned()), &Limits::default()).unwrap()
}

#[test]
fn a_scene_comes_back_bit_for_bit() {
    for (count, degree) in [(0, 0), (1, 3), (1000, 0), (77, 1), (50, 2)] {
        let written = scene(1, count, degree);
        let (back, _) = read_scene(&file_of(&written)).unwrap();
        assert_eq!(back.meta, written.meta);
        assert_eq!(back.gaussians.sh_degree(), degree);
        assert_eq!(bits(&back.gaussians), bits(&written.gaussians), "{count} of degree {degree}");
    }
}

#[test]
fn any_safetensors_reader_opens_a_scene() {
    let written = scene(1, 10, 1);
    let file = file_of(&written);
    let tensors = safetensors::SafeTensors::deserialize(&file).unwrap();
    assert_eq!(tensors.tensor("sh").unwrap().shape(), [10, 4, 3]);
    assert_eq!(tensors.tensor("sha256").unwrap().shape(), [32]);
}

#[test]
fn every_truncation_and_flipped_bit_is_found() {
    let file = file_of(&scene(1, 40, 1));
    let corrupt = |bytes: &[u8], what: String| {
        let error = read_scene(bytes).map(|_| ()).expect_err(&what);
        assert_eq!(error.code(), ErrorCode::SceneCorrupt, "{what}: {error}");
    };
    for length in (0..file.len()).step_by(7).chain([file.len() - 1]) {
        corrupt(&file[..length], format!("cut to {length} bytes"));
    }
    for at in (0..file.len()).step_by(3).chain([0, 7, 8, file.len() - 1]) {
        let mut flipped = file.clone();
        flipped[at] ^= 1 << (at % 8);
        corrupt(&flipped, format!("bit flipped in byte {at}"));
    }
    let mut longer = file;
    longer.push(0);
    corrupt(&longer, "one byte more".to_owned());
}

/// A container with another header, and with its checksum made right again.
pub(crate) fn reheaded(file: &[u8], change: impl FnOnce(&mut Value)) -> Vec<u8> {
    let end = 8 + u64::from_le_bytes(file[..8].try_into().unwrap()) as usize;
    let mut header = serde_json::from_slice(&file[8..end]).unwrap();
    change(&mut header);
    let text = header.to_string();
    let head = [&(text.len() as u64).to_le_bytes()[..], text.as_bytes()].concat();
    sealed(&[&head, &file[end..]].concat())
}

/// With a checksum that is right for what is before it.
fn sealed(file: &[u8]) -> Vec<u8> {
    let content = &file[..file.len().saturating_sub(32)];
    [content, &Sha256::digest(content)[..]].concat()
}

/// The same with another value in the JSON that is text in the header.
fn retold(file: &[u8], place: &str, value: Value) -> Vec<u8> {
    reheaded(file, |header| {
        let told = &mut header["__metadata__"]["json"];
        let mut json: Value = serde_json::from_str(told.as_str().unwrap()).unwrap();
        *json.pointer_mut(place).unwrap() = value;
        *told = json.to_string().into();
    })
}

/// With some bytes of an array replaced.
fn rewritten(file: &[u8], array: &str, bytes: &[u8]) -> Vec<u8> {
    let tensors = safetensors::SafeTensors::deserialize(file).unwrap();
    let at = tensors.tensor(array).unwrap().data().as_ptr() as usize - file.as_ptr() as usize;
    let mut file = file.to_vec();
    file[at..at + bytes.len()].copy_from_slice(bytes);
    sealed(&file)
}

/// What both containers have: files that are cut, lie or are of another program, with a right
/// checksum wherever one is possible.
fn damaged_containers(good: &[u8], array: &str) -> Vec<(Vec<u8>, &'static str)> {
    let head = |length: u64| sealed(&[&length.to_le_bytes()[..], &good[8..]].concat());
    let re = |change: fn(&mut Value)| reheaded(good, change);
    let mut flipped = good.to_vec();
    flipped[good.len() / 2] ^= 1;
    let of = |change: fn(&mut Value)| reheaded(good, |header| change(&mut header[array]));
    vec![
        (Vec::new(), "0 bytes are too few"),
        (good[..31].to_vec(), "31 bytes are too few"),
        (good[..good.len() - 1].to_vec(), "checksum"),
        ([good, &[0]].concat(), "checksum"),
        (flipped, "checksum"),
        (sealed(&good[..40]), "corrupt"),
        (sealed(&good[..good.len() - 40]), "corrupt"),
        (head(0), "corrupt"),
        (head(u64::MAX), "corrupt"),
        (head(1 << 40), "corrupt"),
        (head(100), "corrupt"),
        (re(|h| drop(h["__metadata__"].as_object_mut().unwrap().remove("kind"))), "no kind"),
        (re(|h| h["__metadata__"]["kind"] = "other".into()), "it is other and not"),
        (re(|h| h["__metadata__"]["json"] = "{".into()), "metadata"),
        (re(|h| h["__metadata__"] = json!({})), "no kind"),
        (reheaded(good, |h| drop(h.as_object_mut().unwrap().remove(array))), "corrupt"),
        (of(|a| a["dtype"] = "F16".into()), "corrupt"),
        (of(|a| a["dtype"] = "F65".into()), "corrupt"),
        (of(|a| a["shape"] = json!([u64::MAX, 3])), "corrupt"),
        (of(|a| a["shape"] = json!([-1])), "corrupt"),
        (of(|a| a["data_offsets"] = json!([0, u64::MAX])), "corrupt"),
        (of(|a| a["data_offsets"] = json!([8, 4])), "corrupt"),
    ]
}

#[test]
fn damaged_containers_are_refused_by_name() {
    let id = SceneId::from_bytes([1; 16]);
    let scene = file_of(&scene(1, 40, 1));
    let mut of_scene = damaged_containers(&scene, "means");
    let nan = f32::NAN.to_le_bytes();
    of_scene.extend([
        (retold(&scene, "/sh_degree", 3.into()), "unequal length"),
        (rewritten(&scene, "means", &nan), "number 0 is out of range"),
        (rewritten(&scene, "opacities", &nan), "number 0 is out of range"),
        (rewritten(&scene, "scales", &(-1.0_f32).to_le_bytes()), "number 0 is out of range"),
        (rewritten(&scene, "quats", &[0; 16]), "number 0 is out of range"),
    ]);
    let bank = Bank { dim: 3, rows: vec![0.5; 6] };
    let map = IndexMap { width: 3, height: 2, index: vec![0, 1, 2, 0, 1, 2] };
    let masks = vec![BankMask { photo: 0, mask: 0, entry: 1 }];
    let (index, report) = (vec![1; 40], SemanticsReport::default());
    let views = RowViews { entries: vec![1, 2], rows: vec![0.5; 6] };
    let semantics = Semantics { bank, views, index, photos: vec![map], masks, report };
    let mut file = Vec::new();
    write_semantics(&mut file, &id, &semantics).unwrap();
    let mut of_semantics = damaged_containers(&file, "bank");
    let other = SceneId::from_bytes([2; 16]);
    of_semantics.extend([
        (retold(&file, "/scene", json!(other)), "it is of scene"),
        (retold(&file, "/dim", 0.into()), "bank"),
        (retold(&file, "/dim", 4.into()), "bank"),
        (retold(&file, "/maps", json!([[u32::MAX, u32::MAX]])), "cut short"),
        (rewritten(&file, "bank", &nan), "finite"),
        (rewritten(&file, "masks", &[0, 0, 0, 0, 0, 0, 0, 0, 3, 0, 0, 0]), "no row of the bank"),
        (rewritten(&file, "views", &nan), "the views"),
        (rewritten(&file, "view_entries", &[2, 0, 1, 0]), "the views"),
        (rewritten(&file, "view_entries", &[0, 0, 1, 0]), "the views"),
        (rewritten(&file, "view_entries", &[1, 0, 3, 0]), "the views"),
    ]);
    let read = |file: &[u8], is_scene: bool| match is_scene {
        true => read_scene(file).map(drop),
        false => read_semantics(file, &id).map(drop),
    };
    for (cases, is_scene) in [(of_scene, true), (of_semantics, false)] {
        let files: HashSet<&[u8]> = cases.iter().map(|(file, _)| &file[..]).collect();
        assert!(files.len() == cases.len() && files.len() >= 20, "{}", files.len());
        println!("container, scene {is_scene}: {} damaged files", files.len());
        for (i, (file, says)) in cases.iter().enumerate() {
            let error = read(file, is_scene).expect_err(says);
            assert_eq!(error.code(), ErrorCode::SceneCorrupt, "{i}: {error}");
            assert!(error.message().contains(says), "{i}: {error} says not {says:?}");
        }
    }
}

/// Files that are whole and say what this program does not know.
fn of_other_versions(good: &[u8], told: &[(&str, Value)]) -> Vec<(Vec<u8>, String)> {
    let version = reheaded(good, |h| h["__metadata__"]["version"] = "2".into());
    let told =
        told.iter().map(|(place, value)| (retold(good, place, value.clone()), String::new()));
    [(version, "version 2; this program reads version 1".to_owned())]
        .into_iter()
        .chain(told)
        .collect()
}

#[test]
fn what_another_version_wrote_is_told_from_damage_and_is_left_as_it_is() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = open(folder.path());
    for byte in [1, 2, 3] {
        store.put_upload(upload(), &record(byte)).unwrap();
        store.put_scene(scene(byte, 30, 0)).unwrap();
        store.put_record(&done(byte)).unwrap();
    }
    let bank = Bank { dim: 3, rows: vec![0.5; 6] };
    let (index, photos) = (vec![1; 30], Vec::new());
    let report = SemanticsReport::default();
    let semantics = Semantics { bank, index, photos, report, ..Semantics::default() };
    let mut meaning = Vec::new();
    write_semantics(&mut meaning, &id(3), &semantics).unwrap();
    drop(store);
    let scenes = folder.path().join("scenes");
    let path = |byte: u8, name: &str| scenes.join(id(byte).as_str()).join(name);
    let is_left = |path: &Path, file: &[u8]| {
        assert!(fs::read(path).unwrap() == file, "{path:?} is another");
        assert!(!path.with_extension("quarantined").exists(), "{path:?} is put aside");
    };

    let file = path(1, "scene.segsplat");
    let told = [("/sh_degree", json!(300)), ("/meta", json!({})), ("/origin", json!("here"))];
    for (other, says) in of_other_versions(&fs::read(&file).unwrap(), &told) {
        fs::write(&file, &other).unwrap();
        let (store, records) = open(folder.path());
        assert_eq!(records.len(), 3);
        for _ in 0..2 {
            let error = store.scene(&id(1)).unwrap_err();
            assert_eq!(error.code(), ErrorCode::OtherVersion, "{error}");
            assert!(error.message().contains("another version"), "{error}");
            assert!(error.message().contains(&says), "{error}");
        }
        assert!(store.scene(&id(2)).is_ok(), "its neighbour");
        is_left(&file, &other);
    }

    let file = path(3, "semantics.segsplat");
    let told = [("/dim", json!(-3)), ("/report", json!(7))];
    for (other, _) in of_other_versions(&meaning, &told) {
        fs::write(&file, &other).unwrap();
        let (store, _) = open(folder.path());
        let scene = store.scene(&id(3)).expect("the scene is whole without them");
        assert!(scene.semantics.is_none());
        is_left(&file, &other);
    }

    let file = path(2, "status.json");
    let mut sealed: Value = serde_json::from_slice(&fs::read(&file).unwrap()).unwrap();
    let mut inner: Value = serde_json::from_str(sealed["record"].as_str().unwrap()).unwrap();
    inner["status"]["state"] = "polished".into();
    let text = inner.to_string();
    let digest: String = Sha256::digest(&text).iter().map(|b| format!("{b:02x}")).collect();
    (sealed["record"], sealed["sha256"]) = (text.into(), digest.into());
    let other = sealed.to_string().into_bytes();
    fs::write(&file, &other).unwrap();
    for _ in 0..2 {
        let (_store, records) = open(folder.path());
        let found = records.iter().find(|r| r.status.id == id(2)).expect("it is listed");
        assert_eq!(found.status.state, SceneState::Failed);
        let error = found.status.error.as_ref().unwrap();
        assert_eq!(error.code, "other_version");
        assert!(error.message.contains("polished"), "{error:?}");
        is_left(&file, &other);
    }
}

#[test]
fn a_bad_scene_is_put_aside_and_the_start_goes_on() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = open(folder.path());
    for id in [1, 2] {
        store.put_upload(upload(), &record(id)).unwrap();
        store.put_scene(scene(id, 30, 0)).unwrap();
    }
    drop(store);
    let id = SceneId::from_bytes([1; 16]);
    let path = folder.path().join("scenes").join(id.as_str()).join("scene.segsplat");
    let mut file = fs::read(&path).unwrap();
    let middle = file.len() / 2;
    file[middle] ^= 4;
    fs::write(&path, file).unwrap();

    let (store, records) = open(folder.path());
    assert_eq!(records.len(), 2);
    assert_eq!(store.scene(&id).unwrap_err().code(), ErrorCode::SceneCorrupt);
    assert!(!path.exists() && path.with_extension("quarantined").exists());
    assert_eq!(store.scene(&id).unwrap_err().code(), ErrorCode::SceneCorrupt, "and stays so");
    assert!(store.scene(&SceneId::from_bytes([2; 16])).is_ok(), "its neighbour is untouched");
}

fn id(byte: u8) -> SceneId {
    SceneId::from_bytes([byte; 16])
}

fn done(byte: u8) -> Record {
    let mut record = record(byte);
    record.status.state = SceneState::Done;
    record
}

#[test]
fn uploads_arrive_beside_deletions() {
    // A deletion removes the folders that it empties, which a put needs meanwhile.
    for (gone, arrives) in [(4, true), (5, false)] {
        let faults = Arc::new(FaultStore::new(Arc::new(InMemory::new()), Duration::ZERO));
        let mut left = gone;
        faults.plan(move |what, path| {
            let hit = what == "put" && path.as_ref().starts_with("scenes") && left > 0;
            left -= u32::from(hit);
            hit.then_some(Wrong::NoFolder)
        });
        let (store, _) = Store::open(&StoreLocation::Own(faults), &Limits::default()).unwrap();
        let put = store.put_upload(upload(), &record(1));
        assert_eq!(put.is_ok(), arrives, "{gone} times: {:?}", put.err());
        assert_eq!(store.upload(&id(1)).is_ok(), arrives, "{gone} times");
    }
}

#[test]
fn a_sweep_leaves_an_upload_whose_record_is_on_its_way() {
    let stall = Duration::from_millis(300);
    let faults = Arc::new(FaultStore::new(Arc::new(InMemory::new()), stall));
    let is_record = |what: &str, path: &Name| what == "put" && path.as_ref().starts_with("pending");
    faults.plan(move |what, path| is_record(what, path).then_some(Wrong::Stalls));
    let place = StoreLocation::Own(faults);
    let (store, _) = Store::open(&place, &Limits::default()).unwrap();
    std::thread::scope(|scope| {
        let put = scope.spawn(|| store.put_upload(upload(), &record(1)));
        while store.upload(&id(1)).is_err() && !put.is_finished() {}
        assert!(!put.is_finished(), "the record is on its way");
        assert_eq!(store.sweep(Duration::ZERO).unwrap(), 0, "nothing is removed");
        put.join().unwrap().unwrap();
    });
    store.upload(&id(1)).unwrap();
}

#[test]
fn a_reader_brings_no_replaced_version_back_into_memory() {
    let inner = Arc::new(InMemory::new());
    let put_first = Store::open(&StoreLocation::Own(Arc::clone(&inner) as _), &Limits::default());
    put_first.unwrap().0.put_scene(scene(1, 5, 0)).unwrap();
    let faults = Arc::new(FaultStore::new(inner, Duration::from_millis(400)));
    let place = StoreLocation::Own(Arc::clone(&faults) as _);
    let (store, _) = Store::open(&place, &Limits::default()).unwrap();
    faults.plan(|what, path| {
        (what == "get" && path.as_ref().ends_with("scene.segsplat")).then_some(Wrong::Late)
    });
    std::thread::scope(|scope| {
        let reader = scope.spawn(|| store.scene(&id(1)));
        while faults.wrongs.load(Ordering::Acquire) == 0 {
            std::thread::yield_now();
        }
        store.put_version(scene(1, 9, 0)).unwrap();
        reader.join().unwrap().unwrap();
    });
    assert_eq!(store.scene(&id(1)).unwrap().gaussians.len(), 9, "the version that was put last");
}

#[test]
fn a_probe_that_was_left_goes_when_it_is_old() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = open(folder.path());
    let probes = folder.path().join("probe");
    fs::create_dir_all(&probes).unwrap();
    for (name, hours) in [("old", 2), ("new", 0)] {
        let file = fs::File::create(probes.join(name)).unwrap();
        file.set_modified(SystemTime::now() - Duration::from_hours(hours)).unwrap();
    }
    assert_eq!(store.sweep(Duration::ZERO).unwrap(), 1);
    assert!(!probes.join("old").exists() && probes.join("new").exists());
}

#[test]
fn a_bad_status_is_rebuilt_from_the_scene_or_from_the_upload() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = open(folder.path());
    for byte in [1, 2, 3, 4] {
        store.put_upload(upload(), &record(byte)).unwrap();
    }
    store.put_scene(scene(1, 5, 0)).unwrap();
    for byte in [1, 3] {
        store.put_record(&done(byte)).unwrap();
    }
    drop(store);
    let scenes = folder.path().join("scenes");
    let status = |byte: u8| scenes.join(id(byte).as_str()).join("status.json");
    let pending = |byte: u8| folder.path().join("pending").join(id(byte).as_str());
    for path in [status(1), pending(2), status(3), pending(4)] {
        let mut file = fs::read(&path).unwrap();
        let digit = file.windows(3).position(|w| w == b"123").unwrap();
        file[digit] = b'9';
        fs::write(&path, file).unwrap();
    }
    for byte in [3, 4] {
        fs::write(scenes.join(id(byte).as_str()).join("upload.segsplat"), b"rubbish").unwrap();
    }

    let (_store, records) = open(folder.path());
    let found = |byte: u8| records.iter().find(|r| r.status.id == id(byte)).unwrap();
    assert_eq!(found(1).status.state, SceneState::Done, "the scene file says so");
    assert_eq!(found(1).owner.as_deref(), Some("somebody"), "it stays its owner's");
    assert!(found(1).scene_sha256.is_some());
    assert_eq!(*found(2), record(2), "the upload holds the first record");
    for byte in [3, 4] {
        assert_eq!(found(byte).status.state, SceneState::Failed);
        assert_eq!(found(byte).status.error.as_ref().unwrap().code, "scene_corrupt");
    }
}

#[test]
fn what_a_crash_leaves_is_nothing_or_all() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = open(folder.path());
    for byte in [1, 2, 3] {
        store.put_upload(upload(), &record(byte)).unwrap();
    }
    store.put_scene(scene(1, 20, 0)).unwrap();
    store.put_record(&done(1)).unwrap();
    drop(store);
    let path = |name: &str| folder.path().join(name);
    let of = |byte: u8, name: &str| path("scenes").join(id(byte).as_str()).join(name);
    // Killed while a file was written, after a status and before the pending record went, before an
    // upload was kept, and in the middle of a deletion.
    fs::write(of(1, "scene.segsplat#1"), b"half").unwrap();
    fs::write(path("pending").join(id(1).as_str()), b"late").unwrap();
    fs::remove_file(of(2, "upload.segsplat")).unwrap();
    fs::remove_file(path("pending").join(id(3).as_str())).unwrap();
    fs::create_dir_all(path("keys")).unwrap();
    let key = serde_json::json!({ "id": id(3), "request_sha256": "" });
    fs::write(path("keys").join("ab".repeat(32)), key.to_string()).unwrap();
    fs::create_dir(path("scenes").join(id(4).as_str())).unwrap();
    fs::create_dir(path("scenes").join("not-an-id")).unwrap();
    let not_ours = [path("scenes").join("not-an-id/note"), path("notes#1")];
    not_ours.iter().for_each(|file| fs::write(file, b"somebody's").unwrap());

    let (store, records) = open(folder.path());
    let states: Vec<_> = records.iter().map(|r| (r.status.id.clone(), r.status.state)).collect();
    assert_eq!(states, [(id(1), SceneState::Done)], "the others were never acknowledged");
    assert_eq!(bits(&store.scene(&id(1)).unwrap().gaussians), bits(&scene(1, 20, 0).gaussians));
    assert!(!of(1, "scene.segsplat#1").exists());
    assert_eq!(store.sweep(Duration::ZERO).unwrap(), 2, "an upload and a key of nobody");
    assert!(of(1, "scene.segsplat").exists() && of(1, "upload.segsplat").exists());
    assert!(!path("scenes").join(id(3).as_str()).exists() && !path("keys").exists());
    assert!(!path("scenes").join(id(4).as_str()).exists(), "an empty folder");
    assert!(not_ours.iter().all(|file| file.exists()), "what is not ours is left alone");
    assert_eq!(store.sweep(Duration::ZERO).unwrap(), 0);
}

#[test]
fn uploads_come_back_as_sent_and_names_are_no_paths() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = open(folder.path());
    store.put_upload(upload(), &record(1)).unwrap();
    drop(store);
    let (store, records) = open(folder.path());
    assert_eq!(records, [record(1)]);
    let id = id(1);
    assert_eq!(store.upload(&id).unwrap(), upload());
    store.remove(&record(1)).unwrap();
    let again = store.remove(&record(1));
    for result in [store.upload(&id).map(|_| ()), again, store.scene(&id).map(|_| ())] {
        assert_eq!(result.unwrap_err().code(), ErrorCode::SceneNotFound);
    }
    for late in [store.put_scene(scene(1, 1, 0)).map(|_| ()), store.put_record(&done(1))] {
        assert_eq!(late.unwrap_err().code(), ErrorCode::SceneNotFound, "it does not come back");
    }
    let left = |name: &str| fs::read_dir(folder.path().join(name)).map_or(0, Iterator::count);
    assert_eq!((left("scenes"), left("pending")), (0, 0), "nothing is left of it");
}

#[test]
fn a_key_and_a_content_lead_to_their_owners_scene_only() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = open(folder.path());
    let of = |byte: u8| KeyUse { id: id(byte), request_sha256: "cd".repeat(32) };
    let (ann, bob) = (Some("ann"), Some("bob"));
    assert_eq!(store.use_key(ann, "k", &of(1)).unwrap(), None);
    assert_eq!(store.use_key(ann, "k", &of(2)).unwrap(), Some(of(1)), "the first counts");
    assert_eq!(store.use_key(bob, "k", &of(3)).unwrap(), None, "nobody else's key");
    assert_eq!(store.use_key(None, "k", &of(4)).unwrap(), None);
    store.forget_key(ann, "k").unwrap();
    assert_eq!(
        (store.key_use(ann, "k").unwrap(), store.key_use(bob, "k").unwrap()),
        (None, Some(of(3)))
    );

    store.put_content(ann, "ab", &id(1)).unwrap();
    assert_eq!(store.scene_of_content(ann, "ab").unwrap(), Some(id(1)));
    for (owner, hash) in [(bob, "ab"), (None, "ab"), (ann, "ac")] {
        assert_eq!(store.scene_of_content(owner, hash).unwrap(), None, "{owner:?} {hash}");
    }
}

#[cfg(unix)]
#[test]
fn a_data_folder_is_its_owners_and_a_moved_one_is_not_written_to() {
    use std::os::unix::fs::PermissionsExt;
    let folder = tempfile::tempdir().unwrap();
    let (data, away) = (folder.path().join("data"), folder.path().join("away"));
    let (store, _) = open(&data);
    assert_eq!(fs::metadata(&data).unwrap().permissions().mode() & 0o777, 0o700);
    store.put_upload(upload(), &record(1)).unwrap();
    fs::rename(&data, &away).unwrap();
    let moved = store.put_upload(upload(), &record(2)).unwrap_err();
    assert_eq!(moved.code(), ErrorCode::StoreUnavailable);
    assert!(!data.exists(), "another folder of its name was made");
    fs::rename(&away, &data).unwrap();
    store.put_upload(upload(), &record(2)).expect("it is back");
}

#[test]
fn one_process_holds_a_folder() {
    let folder = tempfile::tempdir().unwrap();
    let (store, _) = open(folder.path());
    let second = Store::open(&StoreLocation::Folder(folder.path().to_owned()), &Limits::default())
        .unwrap_err();
    assert_eq!(second.code(), ErrorCode::StoreUnavailable);
    drop(store);
    open(folder.path());
}

fn ply_of(gaussians: &Gaussians) -> Vec<u8> {
    bytes_of(&SplatFile::new(&PLY, gaussians.clone(), None).unwrap())
}

fn bytes_of(file: &SplatFile) -> Vec<u8> {
    let mut bytes = Vec::new();
    file.write(&mut bytes).unwrap();
    assert_eq!(file.size_bytes().unwrap_or(bytes.len() as u64), bytes.len() as u64);
    bytes
}

fn read_ply(file: &[u8], gaussians_max: usize) -> Result<SplatsRead> {
    let limits = Limits { gaussians_max, ..Limits::default() };
    read_splats(&mut Cursor::new(file), "a.ply", &limits)
}

fn read(file: &[u8]) -> Result<(Gaussians, SanitizeReport)> {
    let SplatsRead { gaussians, dropped: report, semantics, .. } = read_ply(file, 100_000)?;
    assert_eq!(semantics, None);
    Ok((gaussians, report))
}

#[test]
fn a_ply_carries_index_and_bank_together_and_programs_that_know_no_bank_stop_before_it() {
    let index = (0..50).map(|i| i % 3).collect::<Vec<u16>>();
    let gaussians = gaussians(50, 0).with_semantic_index(index.clone()).unwrap();
    let masks = [(0, 0, 1), (0, 1, 2), (1, 0, 1)];
    let masks = masks.map(|(photo, mask, entry)| BankMask { photo, mask, entry }).to_vec();
    let semantics = Semantics {
        bank: Bank { dim: 2, rows: vec![0.5, 0.25, -1.0, 3.0] },
        views: RowViews { entries: vec![1, 2], rows: vec![0.5, 0.25, -1.0, 3.0] },
        index,
        photos: vec![IndexMap { width: 2, height: 1, index: vec![1, 2] }],
        masks,
        report: SemanticsReport::default(),
    };
    let bytes = bytes_of(&SplatFile::new(&PLY, gaussians, Some(&semantics)).unwrap());
    let SplatsRead { gaussians: back, semantics: read, .. } = read_ply(&bytes, 100).unwrap();
    assert_eq!((back.semantic_index(), read.as_ref()), (&semantics.index[..], Some(&semantics)));
    assert_eq!(read.unwrap().row_sizes(), [2, 1]);
    // Its header says where the vertices end, as that of any PLY.
    let end = bytes.windows(11).position(|w| w == b"end_header\n").unwrap() + 11;
    let text = std::str::from_utf8(&bytes[..end]).unwrap();
    let said = text.lines().find_map(|line| line.strip_prefix("comment segsplat_semantics_bytes "));
    let after: usize = said.unwrap().parse().unwrap();
    let stride = 4 * text.matches("property float").count() + 2;
    assert_eq!(end + 50 * stride + after, bytes.len());
    let cut = read_ply(&bytes[..bytes.len() - 1], 100).unwrap_err();
    assert!(cut.message().contains("the semantics end after"), "{cut}");
    let mut broken = bytes;
    *broken.last_mut().unwrap() ^= 1;
    let error = read_ply(&broken, 100).unwrap_err();
    assert_eq!(error.code(), ErrorCode::InvalidRequest, "{error}");
}

#[test]
fn ply_goes_out_and_comes_in() {
    for degree in 0..=3 {
        let out = gaussians(20_000, degree);
        let file = ply_of(&out);
        let (back, report) = read(&file).unwrap();
        assert_eq!(report, SanitizeReport::default());
        let (a, b) = (out.clone().into_raw(), back.clone().into_raw());
        assert_eq!((&a.means, &a.sh, &a.semantic_index), (&b.means, &b.sh, &b.semantic_index));
        let close = |x: &[f32], y: &[f32]| {
            assert_eq!(x.len(), y.len());
            let worst = x.iter().zip(y).map(|(x, y)| (x - y).abs() / x.abs().max(1e-3));
            assert!(worst.fold(0.0, f32::max) < 2e-6, "degree {degree}");
        };
        close(a.quats.as_flattened(), b.quats.as_flattened());
        close(a.scales.as_flattened(), b.scales.as_flattened());
        close(&a.opacities, &b.opacities);
    }
}

#[test]
fn ply_has_the_standard_attributes_in_the_standard_order() {
    let file = ply_of(&gaussians(2, 1));
    let text = String::from_utf8_lossy(&file);
    let header = &text[..text.find("end_header").unwrap()];
    let names: Vec<&str> = header
        .lines()
        .filter_map(|line| line.strip_prefix("property ").and_then(|l| l.split(' ').nth(1)))
        .collect();
    let mut want = vec!["x", "y", "z", "nx", "ny", "nz", "f_dc_0", "f_dc_1", "f_dc_2"];
    let rest: Vec<String> = (0..9).map(|i| format!("f_rest_{i}")).collect();
    want.extend(rest.iter().map(String::as_str));
    want.extend(["opacity", "scale_0", "scale_1", "scale_2"]);
    want.extend(["rot_0", "rot_1", "rot_2", "rot_3", "semantic_index"]);
    assert_eq!(names, want);

    // Channel-major: f_rest_1 is the second red coefficient beyond the constant one.
    let scene = gaussians(2, 1);
    let vertices = &file[text.find("end_header").unwrap() + "end_header\n".len()..];
    let float = |i: usize| f32::from_le_bytes(vertices[4 * i..4 * i + 4].try_into().unwrap());
    assert_eq!(float(9 + 1), scene.sh()[2][0]);
    assert_eq!(float(9 + 3), scene.sh()[1][1]);
    assert!((float(18) - (scene.opacities()[0] / (1.0 - scene.opacities()[0])).ln()).abs() < 1e-4);
    assert!((float(19) - scene.scales()[0][0].ln()).abs() < 1e-5);
    assert_eq!(float(22), scene.quats()[0][0], "w first");
}

fn other_ply(format: &str, endian: impl Fn(f64) -> [u8; 8]) -> Vec<u8> {
    let names =
        "rot_3 opacity z y x f_dc_2 f_dc_1 f_dc_0 odd scale_0 scale_1 scale_2 rot_0 rot_1 rot_2";
    let mut file = format!("ply\r\nformat {format} 1.0\ncomment made elsewhere\nobj_info x\n");
    file.push_str("element vertex 1\n");
    names.split(' ').for_each(|name| file.push_str(&format!("property double {name}\n")));
    file.push_str("element face 3\nproperty list uchar int vertex_index\nend_header\n");
    let mut file = file.into_bytes();
    let far = 5e6 + 0.125;
    for value in [0.0, 0.0, 3.0, 2.0, far, 0.3, 0.2, 0.1, 99.0, -1.0, -2.0, -3.0, 2.0, 0.0, 0.0] {
        file.extend(endian(value));
    }
    file
}

#[test]
fn ply_of_other_programs_is_read() {
    for file in [
        other_ply("binary_little_endian", f64::to_le_bytes),
        other_ply("binary_big_endian", f64::to_be_bytes),
    ] {
        let (back, _) = read(&file).unwrap();
        let raw = back.clone().into_raw();
        let at = raw.origin + DVec3::from_array(raw.means[0].map(f64::from));
        assert_eq!(at, DVec3::new(5e6 + 0.125, 2.0, 3.0), "f64 positions are kept");
        assert_eq!(raw.sh[0], [0.1, 0.2, 0.3]);
        assert_eq!(raw.opacities[0], 0.5);
        assert_eq!(raw.quats[0], [1.0, 0.0, 0.0, 0.0]);
        assert!((raw.scales[0][2] - (-3.0_f32).exp()).abs() < 1e-6);
    }
}

#[test]
fn poisoned_ply_is_dropped_or_clamped_with_counts() {
    let raw = gaussians(1, 0).into_raw();
    let one = ply_of(&Gaussians::restore(raw).unwrap());
    let text = String::from_utf8_lossy(&one).into_owned();
    let start = text.find("end_header").unwrap() + "end_header\n".len();
    let header = text[..start].replace("vertex 1\n", "vertex 8\n");
    let vertex = &one[start..];
    // Which float of the vertex, and the poison in it.
    let poisons: [(&[usize], f32); 8] = [
        (&[0], f32::NAN),
        (&[1], f32::INFINITY),
        (&[2], 1e30),
        (&[9], -20.0),
        (&[10], 1e30),
        (&[11], -1e30),
        (&[13, 14, 15, 16], 0.0),
        (&[6], f32::NEG_INFINITY),
    ];
    let mut file = header.into_bytes();
    for (places, poison) in poisons {
        let mut bad = vertex.to_vec();
        for place in places {
            bad[4 * place..4 * place + 4].copy_from_slice(&poison.to_le_bytes());
        }
        file.extend(bad);
    }
    let (back, report) = read(&file).unwrap();
    let want =
        SanitizeReport { not_finite: 4, too_far: 1, transparent: 1, ..SanitizeReport::default() };
    assert_eq!(report, want);
    // Flat ones and those whose rotation says nothing are drawn.
    let kept = back.into_raw();
    assert_eq!(kept.means.len(), 2);
    assert!(kept.scales[0].iter().all(|&scale| scale > 0.0), "{:?}", kept.scales[0]);
    assert_eq!(kept.quats[1], [1.0, 0.0, 0.0, 0.0]);
}

#[test]
fn requests_hash_as_they_always_did_and_networks_tell_contents_apart() {
    let files = vec![PhotoHash { file: "a.png".to_owned(), sha256: "ab".repeat(32) }];
    let set = SceneOptions { max_views: Some(4), ..SceneOptions::default() };
    // Kept in stores: these must not change.
    let kept = [&SceneOptions::default(), &set].map(|options| request_sha256(&files, options));
    let want = [
        "b7bd00d38ce6aaa41c0f929fbb8971a3c739290c1f29d43e4d7466783ed1f611",
        "8249305ff777f2e2298755ba26fb029c872ef1f89eb1cb9e8addc6ecb6ce556d",
    ];
    assert_eq!(kept, want);
    let content = |networks| provenance(files.clone(), &set, networks).content_sha256;
    assert_ne!(content("n"), content("m"));
}
