//! The whole path with networks: photos over HTTP, the fixture's mask network and towers, a word,
//! and its mask at a pose between the photos; then the same without a server.

use std::{io::Cursor, path::Path, process::Command};

use image::{Rgb, RgbImage};
use segsplat::{cli::engine, config::Config, service::Parts};
use serde_json::{Value, json};

use crate::common::{
    doors::{bytes, json as body},
    opened,
    server::TestServer,
};

/// Sides of a photo, focal length in pixels.
const SIDE: u32 = 96;
/// World units that a pixel covers on the wall.
const STEP: f64 = 4.0 / 96.0;
/// Where the red square lies on the wall: left, top, right, bottom.
const RED: [f64; 4] = [-0.8, -0.7, 0.4, 0.5];

fn is_red(x: f64, y: f64) -> bool {
    (RED[0]..RED[2]).contains(&x) && (RED[1]..RED[3]).contains(&y)
}

/// A wall of grey blotches with a red square, seen from `x`.
fn photo(x: f64) -> Vec<u8> {
    let picture = RgbImage::from_fn(SIDE, SIDE, |u, v| {
        let at = |pixel: u32| (f64::from(pixel) + 0.5 - f64::from(SIDE) / 2.0) * STEP;
        let (wx, wy) = (at(u) + x, at(v));
        let cell = |w: f64| (w / (2.0 * STEP)).floor() as i64 + 1000;
        let mut seed = (cell(wx) * 7919 + cell(wy) * 104_729) as u32;
        seed ^= seed << 13;
        seed ^= seed >> 17;
        seed ^= seed << 5;
        let tone = (seed >> 8) % 60;
        if is_red(wx, wy) {
            Rgb([200, 20 + (tone / 4) as u8, 25])
        } else {
            Rgb([100 + tone as u8; 3])
        }
    });
    let mut png = Cursor::new(Vec::new());
    picture.write_to(&mut png, image::ImageFormat::Png).unwrap();
    png.into_inner()
}

/// Cameras a step apart, side by side.
fn cameras() -> String {
    let half = f64::from(SIDE) / 2.0;
    let one = |i: usize| {
        let x = i as f64 * 0.4;
        json!({
            "file": format!("{i}.png"),
            "intrinsics": {
                "fx": SIDE, "fy": SIDE, "cx": half, "cy": half, "width": SIDE, "height": SIDE,
            },
            "camera_to_world": [1, 0, 0, x, 0, 1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1],
        })
    };
    json!({ "cameras": [one(0), one(1)] }).to_string()
}

fn form() -> reqwest::multipart::Form {
    let part =
        |bytes: Vec<u8>, name: String| reqwest::multipart::Part::bytes(bytes).file_name(name);
    let form = reqwest::multipart::Form::new().text("cameras", cameras());
    (0..2).fold(form, |form, i| {
        let name = format!("{i}.png");
        form.part(name.clone(), part(photo(0.4 * f64::from(i)), name))
    })
}

/// The product's own parts with the fixture's bundle; `None` (said aloud) without ONNX Runtime.
fn parts(config: &Config) -> Option<Parts> {
    opened(engine::parts(config).and_then(|(parts, engine)| engine.get().map(|_| parts)))
}

fn configured(config: &mut Config) {
    config.bundle = Some(Path::new("tests/fixtures/colours").to_owned());
    config.renderer = segsplat::render::RendererChoice::Cpu;
    config.threads = 2;
    config.jobs = 1;
}

/// IoU of a mask picture with the red square as the camera at `x` sees it.
fn iou(png: &[u8], x: f64) -> f64 {
    let mask = image::load_from_memory(png).unwrap().to_luma8();
    let step = STEP * f64::from(SIDE) / f64::from(mask.width());
    let (mut both, mut any) = (0.0, 0.0);
    for (u, v, p) in mask.enumerate_pixels() {
        let at = |pixel: u32| (f64::from(pixel) + 0.5 - f64::from(mask.width()) / 2.0) * step;
        let (on, truth) = (p.0[0] > 127, is_red(at(u) + x, at(v)));
        both += f64::from(u8::from(on && truth));
        any += f64::from(u8::from(on || truth));
    }
    both / any
}

#[tokio::test(flavor = "multi_thread")]
async fn a_word_finds_its_thing_at_a_pose_between_the_photos() {
    let mut config = Config::default();
    configured(&mut config);
    let Some(made) = parts(&config) else { return };
    let server = TestServer::with(|config, parts| {
        configured(config);
        *parts = made;
    })
    .await;
    let client = crate::common::client();
    let post = client.post(server.url("/v1/scenes?wait_ms=120000")).multipart(form());
    let scene = body(post.send().await.unwrap()).await.unwrap();
    assert_eq!(scene["semantics"]["state"], "none", "{scene}");
    let id = scene["id"].as_str().unwrap();

    let view = |text: &str| {
        let query = "from=0&to=1&t=0.5&width=96&height=96&kind=mask&text=";
        server.url(&format!("/v1/scenes/{id}/view?{query}{text}"))
    };
    let mask = bytes(client.get(view("red")).send().await.unwrap()).await.unwrap();
    let score = iou(&mask, 0.2);
    assert!(score > 0.7, "the mask of `red` has IoU {score:.2} with the red square");
    let none = bytes(client.get(view("green")).send().await.unwrap()).await.unwrap();
    let green = image::load_from_memory(&none).unwrap().to_luma8();
    assert!(green.iter().filter(|v| **v > 0).count() < 100, "green things on a red and grey wall");

    let query = server.url(&format!("/v1/scenes/{id}/query"));
    let asked = json!({ "texts": ["red", "zzz"], "camera": { "from": 0 }, "boxes": "aligned" });
    let sent = client.post(query.clone()).json(&asked).send().await.unwrap();
    let answer = body(sent).await.unwrap();
    let [red, unknown] = [&answer["results"][0], &answer["results"][1]];
    let part = &red["parts"][0];
    let size = |axis: usize| part["size"][axis].as_f64().unwrap();
    assert!(size(0) > 0.6 && size(0) < 2.4 && size(1) > 0.6 && size(1) < 2.4, "{part}");
    assert!(red["view"]["peak"]["relevancy"].as_f64().unwrap() > 0.5, "{red}");
    assert_eq!(unknown["warnings"][0]["code"], "unknown_words", "{unknown}");
    assert_eq!([&red["found"], &unknown["found"]], [&json!(true), &json!(false)], "{answer}");
    // Where every entry is near enough, a text that says nothing still finds nothing.
    let asked = json!({ "texts": ["green", "zzz"], "margin": -2.0, "near_best": 2.0 });
    let answer = body(client.post(query).json(&asked).send().await.unwrap()).await.unwrap();
    let found = [0, 1].map(|i| answer["results"][i]["found"].as_bool().unwrap());
    assert_eq!(found, [true, false], "{answer}");

    let shown = client.get(server.url(&format!("/v1/scenes/{id}"))).send().await.unwrap();
    let semantics = body(shown).await.unwrap()["semantics"].clone();
    assert_eq!((&semantics["state"], &semantics["available"]), (&json!("ready"), &json!(true)));
    let stages: Vec<&Value> = semantics["report"]["stages"].as_array().unwrap().iter().collect();
    assert_eq!(stages.len(), 4, "{semantics}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_word_is_found_in_the_photos_by_a_network_that_masks_texts() {
    let from = Path::new("tests/fixtures/colours");
    let bundle = tempfile::tempdir().unwrap();
    for entry in std::fs::read_dir(from).unwrap() {
        let entry = entry.unwrap();
        std::fs::copy(entry.path(), bundle.path().join(entry.file_name())).unwrap();
    }
    let read = |name: &str| std::fs::read_to_string(from.join(name)).unwrap();
    let manifest = read("bundle.toml") + &read("text_masks.toml");
    std::fs::write(bundle.path().join("bundle.toml"), manifest).unwrap();
    let configure = |config: &mut Config| {
        configured(config);
        config.bundle = Some(bundle.path().to_owned());
    };
    let mut config = Config::default();
    configure(&mut config);
    let Some(made) = parts(&config) else { return };
    let server = TestServer::with(|config, parts| {
        configure(config);
        *parts = made;
    })
    .await;
    let client = crate::common::client();
    let post = client.post(server.url("/v1/scenes?wait_ms=120000")).multipart(form());
    let scene = body(post.send().await.unwrap()).await.unwrap();
    let at =
        |path: &str| server.url(&format!("/v1/scenes/{}/{path}", scene["id"].as_str().unwrap()));
    let get = async |path: &str| bytes(client.get(at(path)).send().await.unwrap()).await.unwrap();
    let ask = async |asked: Value| {
        body(client.post(at("query")).json(&asked).send().await.unwrap()).await.unwrap()
    };

    let view = "view?from=0&to=1&t=0.5&width=96&height=96&kind=mask&text=";
    let score = iou(&get(&format!("{view}red")).await, 0.2);
    assert!(score > 0.7, "the mask of `red` has IoU {score:.2} with the red square");
    let texts = json!({ "texts": ["red", "grey", "green"], "camera": { "from": 0 } });
    let answer = ask(texts).await;
    let [red, grey, green] = [0, 1, 2].map(|i| &answer["results"][i]);
    assert_eq!([&red["found"], &grey["found"], &green["found"]], [true, true, false], "{answer}");
    // The network's own score, in the part and at the peak of the view.
    let close = |of: &Value| (of.as_f64().unwrap() - 0.9).abs() < 0.02;
    assert!(close(&red["parts"][0]["score"]) && close(&red["view"]["peak"]["relevancy"]), "{red}");
    assert_eq!(answer["scoring"]["canon"], json!(["(no mask)"]), "{answer}");
    let words = [red, grey].map(|word| word["gaussians"].as_u64().unwrap());
    assert!(words[0] > 50 && words[1] > words[0], "{words:?}");
    // Who changes how texts are scored asks the towers, and so do labels of a pick.
    let towers = ask(json!({ "texts": ["red"], "tau": 9.0 })).await;
    assert_ne!(towers["scoring"]["canon"], answer["scoring"]["canon"], "{towers}");
    let pick = get("pick?from=0&x=16&y=16&label=red&label=grey").await;
    let pick: Value = serde_json::from_slice(&pick).unwrap();
    assert_eq!(pick["labels"].as_array().unwrap().len(), 2, "{pick}");
    // A file of what the text selects has as many Gaussians, with the semantics of the scene.
    let ply = get("export?format=ply&text=red").await;
    let head = String::from_utf8_lossy(&ply[..200]).into_owned();
    assert!(head.contains(&format!("element vertex {}\n", words[0])), "{head}");
    // An edit takes what the query shows, also of what an edit before it has copied, or a part.
    let put = async |edits: Value| {
        let put = client.put(at("edits")).json(&json!({ "edits": edits }));
        body(put.send().await.unwrap()).await.unwrap()["counts"].clone()
    };
    let red_of = |op: &str, more: Value| {
        let mut edit = json!({ "op": op, "select": { "text": "red" } });
        edit.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        edit
    };
    let copy = red_of("copy", json!({ "translation": [0.0, 9.0, 0.0] }));
    let taken = put(json!([copy, red_of("delete", json!({}))])).await;
    assert_eq!(taken, json!([words[0], 2 * words[0]]));
    let part = json!({ "select": { "text": "red", "parts": [0] } });
    let counts = put(json!([red_of("delete", part)])).await;
    let [taken, of_part] =
        [&counts[0], &red["parts"][0]["gaussians"]].map(|count| count.as_u64().unwrap());
    assert!((of_part..=words[0]).contains(&taken), "{counts}");
    put(json!([])).await;
    // Without photos the towers answer, by the semantics of the file.
    let part = reqwest::multipart::Part::bytes(ply).file_name("red.ply");
    let form = reqwest::multipart::Form::new().part("splats", part);
    let post = client.post(server.url("/v1/scenes?wait_ms=120000")).multipart(form);
    let file = body(post.send().await.unwrap()).await.unwrap();
    let at = server.url(&format!("/v1/scenes/{}/query", file["id"].as_str().unwrap()));
    let sent = client.post(at).json(&json!({ "texts": ["red", "grey"] })).send().await.unwrap();
    let answer = body(sent).await.unwrap();
    assert_eq!(answer["scoring"]["canon"], towers["scoring"]["canon"], "{answer}");
    let found = [0, 1].map(|i| answer["results"][i]["gaussians"].as_u64().unwrap());
    // At the edge of the square they may say otherwise than the network.
    let edge = words[0] - found[0];
    assert!(20 * edge < words[0] && found[1] <= edge, "{edge} of {words:?}: {answer}");
}

#[test]
fn the_command_line_asks_a_scene_that_was_made_with_its_semantics() {
    let mut config = Config::default();
    configured(&mut config);
    if parts(&config).is_none() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let at = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    std::fs::create_dir(folder.path().join("photos")).unwrap();
    std::fs::write(at("photos/cameras.json"), cameras()).unwrap();
    for i in 0..2 {
        std::fs::write(at(&format!("photos/{i}.png")), photo(0.4 * f64::from(i))).unwrap();
    }
    let run = |args: &[&str]| {
        let output = Command::new(env!("CARGO_BIN_EXE_segsplat"))
            .current_dir(crate::common::root())
            .args(args)
            .args(["--bundle", "tests/fixtures/colours", "--json"])
            .output()
            .unwrap();
        let said = String::from_utf8_lossy(&output.stderr).into_owned();
        let value: Value = serde_json::from_slice(&output.stdout).unwrap_or(Value::Null);
        (output.status.success(), value, said)
    };
    let (photos, scene) = (at("photos"), at("x.segsplat"));
    let (ok, made, said) = run(&["reconstruct", &photos, "-o", &scene, "--semantics", "eager"]);
    assert!(ok, "{said}");
    assert!(made["semantics"]["bank_size"].as_u64() > Some(0), "{made}");
    let cpu = ["--renderer", "cpu", "--camera", "0"];
    let (mask, part) = (at("mask.png"), at("red.ply"));
    let (ok, answer, said) = run(&[&["query", &scene, "red", "-o", &mask][..], &cpu].concat());
    assert!(ok, "{said}");
    assert!(answer["results"][0]["gaussians"].as_u64() > Some(0), "{answer}");
    let score = iou(&std::fs::read(&mask).unwrap(), 0.0);
    assert!(score > 0.7, "IoU {score:.2}");
    let (ok, _, said) = run(&["query", &scene, "red", "-o", &part, "--renderer", "cpu"]);
    assert!(ok && std::fs::read(&part).unwrap().starts_with(b"ply"), "{said}");
    let picture = at("kind.png");
    for kind in ["semantics", "relevancy", "mask"] {
        let text = if kind == "semantics" { &[][..] } else { &["--text", "red"][..] };
        let line = ["render", &scene, "-o", &picture, "--kind", kind];
        let (ok, _, said) = run(&[&line[..], text, &cpu].concat());
        assert!(ok, "{kind}: {said}");
    }
    // Made again without, the old file beside it must not answer for the new scene.
    let (ok, _, said) = run(&["reconstruct", &photos, "-o", &scene]);
    assert!(ok, "{said}");
    let (ok, _, said) = run(&[&["query", &scene, "red"][..], &cpu].concat());
    assert!(!ok && said.contains("semantics_off"), "{said}");
}
