//! Levels of detail of a large scene: made once when it is done, given to the page, and as a
//! folder that other programs stream.

use std::{
    collections::HashMap,
    io::{Cursor, Read as _, Write as _},
};

use glam::DVec3;
use segsplat::{
    formats::{
        packed::CoarseForms,
        splats::{SPLAT, SplatFile, write_streamed},
        table::read_splats,
    },
    limits::Limits,
    render::{blocks::BLOCKS_MIN, coarse::Coarse},
    scene::{Gaussians, Upload, UploadFile},
};
use segsplat_testing::scenes::{camera, cloud};
use serde_json::{Value, json};
use zip::{ZipArchive, ZipWriter, write::SimpleFileOptions};

use crate::common::{
    client,
    doors::{Options, http},
    process::eventually,
    server::TestServer,
};

type Files = HashMap<String, Vec<u8>>;

fn unpacked(zip: &[u8]) -> Files {
    let mut zip = ZipArchive::new(Cursor::new(zip)).expect("a zip");
    let mut files = Files::new();
    for at in 0..zip.len() {
        let mut file = zip.by_index(at).expect("a file");
        let mut bytes = Vec::new();
        file.read_to_end(&mut bytes).expect("whole");
        let name = file.name().expect("a name").into_owned();
        files.insert(name, bytes);
    }
    files
}

/// The Gaussians of a bundle whose files lie in a folder.
fn bundle(files: &Files, meta: &str) -> Gaussians {
    let folder = meta.strip_suffix("meta.json").expect("a folder");
    let mut zip = ZipWriter::new(Cursor::new(Vec::new()));
    for (name, bytes) in files {
        if let Some(name) = name.strip_prefix(folder) {
            zip.start_file(name, SimpleFileOptions::default()).unwrap();
            zip.write_all(bytes).unwrap();
        }
    }
    let bytes = zip.finish().unwrap().into_inner();
    read_splats(&mut Cursor::new(bytes), "a.sog", &Limits::default()).expect("a SOG").gaussians
}

fn at(of: &Value, key: &str) -> usize {
    of[key].as_u64().unwrap_or_else(|| panic!("{key} of {of}")) as usize
}

fn leaves<'a>(node: &'a Value, to: &mut Vec<&'a Value>) {
    match node["children"].as_array() {
        Some(children) => children.iter().for_each(|child| leaves(child, to)),
        None => to.push(node),
    }
}

fn world(gaussians: &Gaussians, i: usize) -> DVec3 {
    gaussians.origin() + DVec3::from_array(gaussians.means()[i].map(f64::from))
}

fn corner(of: &Value) -> DVec3 {
    DVec3::from_array([0, 1, 2].map(|k| of[k].as_f64().expect("a number")))
}

/// What is in the zip: Gaussians of each level, after each file, range and box was looked at.
fn levels(zip: &[u8]) -> Vec<Vec<DVec3>> {
    let files = unpacked(zip);
    let meta: Value = serde_json::from_slice(&files["lod-meta.json"]).expect("JSON");
    assert_eq!(at(&meta, "version"), 1);
    let names = meta["filenames"].as_array().expect("files");
    let bundles: Vec<Gaussians> =
        names.iter().map(|name| bundle(&files, name.as_str().expect("a name"))).collect();
    let mut ends = vec![0; names.len()];
    let mut found = vec![Vec::new(); at(&meta, "lodLevels")];
    let mut all = Vec::new();
    leaves(&meta["tree"], &mut all);
    let root = &meta["tree"]["bound"];
    for leaf in &all {
        let (low, high) = (corner(&leaf["bound"]["min"]), corner(&leaf["bound"]["max"]));
        assert!(low.cmpge(corner(&root["min"])).all() && high.cmple(corner(&root["max"])).all());
        for (level, found) in found.iter_mut().enumerate() {
            let lod = &leaf["lods"][level.to_string()];
            let (file, offset, count) = (at(lod, "file"), at(lod, "offset"), at(lod, "count"));
            assert!(names[file].as_str().expect("a name").starts_with(&format!("{level}_")));
            assert!(offset == ends[file] && count > 0, "{lod} after {}", ends[file]);
            ends[file] += count;
            let slack = (high - low) * 1e-3;
            for i in offset..ends[file] {
                let place = world(&bundles[file], i);
                let inside = place.cmpge(low - slack).all() && place.cmple(high + slack).all();
                assert!(inside, "level {level}: {place} outside {low} to {high}");
                found.push(place);
            }
        }
    }
    let lengths: Vec<usize> = bundles.iter().map(Gaussians::len).collect();
    assert_eq!(ends, lengths, "each of a file in one leaf");
    let counts: Vec<usize> = found.iter().map(Vec::len).collect();
    assert_eq!(meta["counts"], serde_json::json!(counts));
    assert_eq!(at(&meta, "count"), counts.iter().sum::<usize>());
    println!("{} leaves, {} files, levels {counts:?}", all.len(), names.len());
    found
}

#[test]
fn a_small_scene_is_one_level() {
    let own = cloud(3_000, 2, 5);
    let mut zip = Vec::new();
    write_streamed(&own, None, false, &mut zip).expect("a zip");
    assert_eq!(levels(&zip).iter().map(Vec::len).collect::<Vec<_>>(), [3_000]);
    let empty = own.only(|_| false);
    let refused = write_streamed(&empty, None, false, &mut Vec::new()).expect_err("nothing");
    assert!(refused.to_string().contains("no Gaussians"), "{refused}");
}

#[test]
fn each_level_is_the_whole_scene_by_place() {
    let own = cloud(BLOCKS_MIN, 0, 5);
    let coarse = Coarse::of(&own, &camera(64, 64)).expect("forms").expect("large enough");
    let Coarse { gaussians, ends, order } = &coarse;
    let forms = CoarseForms { gaussians, entries: &[], ends, order };
    let mut zip = Vec::new();
    write_streamed(&own, Some(forms), true, &mut zip).expect("a zip");
    let found = levels(&zip);
    let mut want: Vec<usize> = coarse.ends.iter().map(Vec::len).collect();
    want.push(own.len());
    want.reverse();
    assert_eq!(found.iter().map(Vec::len).collect::<Vec<_>>(), want);
    // Whatever the order: each of the scene's is there, to the steps of the format.
    let sorted = |mut places: Vec<f64>| {
        places.sort_unstable_by(f64::total_cmp);
        places
    };
    for axis in 0..3 {
        let ours = sorted((0..own.len()).map(|i| world(&own, i)[axis]).collect());
        let theirs = sorted(found[0].iter().map(|place| place[axis]).collect());
        let wide = ours[ours.len() - 1] - ours[0];
        let off = ours.iter().zip(theirs).map(|(a, b)| (a - b).abs()).fold(0.0, f64::max);
        assert!(off < 1e-3 * wide, "axis {axis}: {off} of {wide}");
    }
}

#[tokio::test]
async fn forms_are_made_when_a_scene_changes_and_not_by_its_readers() {
    let mut server = TestServer::with(|_, _| {}).await;
    let upload = large(40_000);
    let get = async |server: &TestServer, path: &str| {
        client().get(server.url(path)).send().await.unwrap().bytes().await.unwrap()
    };
    let made = async |server: &TestServer| {
        let text = String::from_utf8(get(server, "/metrics").await.to_vec()).unwrap();
        let name = "segsplat_stage_seconds_count{stage=\"coarse\"} ";
        text.lines().find_map(|line| line.strip_prefix(name)?.parse::<f64>().ok()).unwrap_or(0.0)
    };
    let before = made(&server).await;
    let (id, _) = http(server.addr).create(&upload, &Options::wait()).await.unwrap();
    let export = |format: &str| format!("/v1/scenes/{id}/export?format={format}");
    // The packed form, once the forms are there: those who read it made none.
    let read = async |server: &TestServer, times: f64| {
        let more = async || (made(server).await > before + times - 0.5).then_some(());
        eventually("the forms", more).await;
        let bytes = get(server, &export("packed")).await;
        assert!((made(server).await - before - times).abs() < 0.5, "readers take what is there");
        bytes
    };
    let whole = read(&server, 1.0).await;
    let counts: Vec<usize> =
        levels(&get(&server, &export("sog_lod")).await).iter().map(Vec::len).collect();
    assert!(counts[0] >= BLOCKS_MIN && counts.len() > 1, "{counts:?}");
    assert_eq!(read(&server, 1.0).await, whole);
    let sphere = json!({ "center": [0, 0, 4], "radius": 1 });
    let edits = json!({ "edits": [{ "op": "delete", "select": { "sphere": sphere } }] });
    let url = server.url(&format!("/v1/scenes/{id}/edits"));
    let put: Value = client().put(url).json(&edits).send().await.unwrap().json().await.unwrap();
    assert!(put["counts"][0].as_u64().unwrap() > 0, "{put}");
    let edited = read(&server, 2.0).await;
    assert!(edited.len() < whole.len(), "they are those of the edited scene");
    server = server.restart().await;
    assert_eq!(read(&server, 3.0).await, edited);
}

/// A file of so many Gaussians over the fewest that have forms.
fn large(more: usize) -> Upload {
    let mut bytes = Vec::new();
    let file = SplatFile::new(&SPLAT, cloud(BLOCKS_MIN + more, 0, 5), None).unwrap();
    file.write(&mut bytes).unwrap();
    let splats = UploadFile { name: "large.splat".to_owned(), bytes };
    Upload { splats: Some(splats), ..Upload::default() }
}
