//! Edits of a scene over HTTP: what they take, what sees them, how they are undone, refused and
//! kept. The scene is the stand-in's: each photo is a wall, and means "photo 0", "photo 1", ...

use std::sync::Arc;

use object_store::memory::InMemory;
use reqwest::{Method, StatusCode};
use segsplat::{formats::table::ExportFormat, scene::SceneId, store::StoreLocation};
use serde_json::{Value, json};

use crate::common::{
    client,
    meaning::PhotoMeaning,
    process::{self, Start, can_serve},
    server::{TestServer, upload},
};

async fn start() -> (TestServer, SceneId) {
    let server = TestServer::with(|_, parts| {
        parts.semantics = Arc::new(PhotoMeaning::default());
    })
    .await;
    let id = server.scene().await.id;
    (server, id)
}

async fn send(server: &TestServer, id: &SceneId, edits: Value) -> (StatusCode, Value) {
    let url = server.url(&format!("/v1/scenes/{id}/edits"));
    let answer = client().put(url).json(&json!({ "edits": edits })).send().await.unwrap();
    (answer.status(), answer.json().await.unwrap())
}

async fn put(server: &TestServer, id: &SceneId, edits: Value) -> Value {
    let (status, answer) = send(server, id, edits).await;
    assert_eq!(status, StatusCode::OK, "{answer}");
    answer
}

async fn get(server: &TestServer, id: &SceneId, path: &str) -> reqwest::Response {
    let url = server.url(&format!("/v1/scenes/{id}/{path}"));
    let answer = client().request(Method::GET, url).send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::OK, "{path}");
    answer
}

async fn list(server: &TestServer, id: &SceneId) -> Value {
    get(server, id, "edits").await.json().await.unwrap()
}

/// Tag and bytes of a view.
async fn view(server: &TestServer, id: &SceneId) -> (String, Vec<u8>) {
    let answer = get(server, id, "view?from=0&format=npy").await;
    let tag = answer.headers()["etag"].to_str().unwrap().to_owned();
    (tag, answer.bytes().await.unwrap().to_vec())
}

async fn gaussians_of(server: &TestServer, id: &SceneId, text: &str) -> u64 {
    let url = server.url(&format!("/v1/scenes/{id}/query"));
    let asked = json!({ "texts": [text], "boxes": "none" });
    let answer: Value = client().post(url).json(&asked).send().await.unwrap().json().await.unwrap();
    answer["results"][0]["gaussians"].as_u64().unwrap_or_else(|| panic!("{answer}"))
}

#[tokio::test]
async fn what_a_text_deletes_is_gone_from_views_and_answers_and_comes_back_bit_for_bit() {
    let (server, id) = start().await;
    let before = view(&server, &id).await;
    assert_eq!(list(&server, &id).await["edits"], json!([]));
    let whole = list(&server, &id).await["gaussians"].as_u64().unwrap();
    let photo = gaussians_of(&server, &id, "photo 1").await;
    assert!(0 < photo && photo < whole);

    let edits = json!([{ "op": "delete", "select": { "text": "photo 1" } }]);
    let answer = put(&server, &id, edits.clone()).await;
    assert_eq!(answer["counts"], json!([photo]));
    assert_eq!(answer["gaussians"], json!(whole - photo));
    assert_eq!(answer["edits"], edits);
    assert_eq!(list(&server, &id).await, answer);
    assert_eq!(gaussians_of(&server, &id, "photo 1").await, 0);
    assert_eq!(gaussians_of(&server, &id, "photo 0").await, photo, "the others are as they were");
    let edited = view(&server, &id).await;
    assert_ne!(edited.0, before.0, "its tag says so");
    assert_ne!(edited.1, before.1);
    let url = server.url(&format!("/v1/scenes/{id}/view?from=0&format=npy"));
    let known = |tag: &str| client().get(&url).header("if-none-match", tag).send();
    assert_eq!(known(&edited.0).await.unwrap().status(), StatusCode::NOT_MODIFIED);
    assert_eq!(known(&before.0).await.unwrap().status(), StatusCode::OK);

    put(&server, &id, json!([])).await;
    assert_eq!(view(&server, &id).await, before, "undo brings back every bit and the tag");
    assert_eq!(gaussians_of(&server, &id, "photo 1").await, photo);
    put(&server, &id, edits).await;
    assert_eq!(view(&server, &id).await, edited, "and redo too");
}

#[tokio::test]
async fn edits_see_what_those_before_them_left() {
    let (server, id) = start().await;
    let photo = gaussians_of(&server, &id, "photo 1").await;
    let far = json!({ "op": "copy", "select": { "text": "photo 1" }, "translation": [100, 0, 0],
        "scale": 0.5 });
    let there = json!({ "center": [100, 0, 0], "size": [60, 60, 60] });
    let answer =
        put(&server, &id, json!([far, { "op": "keep", "select": { "box": there } }])).await;
    assert_eq!(answer["counts"], json!([photo, photo]), "the copies alone are there");
    assert_eq!(gaussians_of(&server, &id, "photo 1").await, photo, "with their labels");
    let ball = json!({ "center": [100, 0, 0], "radius": 60 });
    let paint = json!({ "op": "recolor", "select": { "sphere": ball }, "color": [1, 0, 0] });
    let answer = put(&server, &id, json!([paint, far])).await;
    assert_eq!(answer["counts"], json!([0, photo]), "in another order nothing is there yet");
    let answer = put(&server, &id, json!([far, paint])).await;
    assert_eq!(answer["counts"], json!([photo, photo]));
}

#[tokio::test]
async fn an_answer_says_how_much_of_the_photos_shows_nothing_now() {
    let (server, id) = start().await;
    let hole = async |edits: Value| put(&server, &id, edits).await["uncovered"].as_f64().unwrap();
    assert_eq!(hole(json!([])).await, 0.0);
    let painted = json!([{ "op": "recolor", "select": { "text": "photo 0" }, "color": [1, 0, 0] }]);
    assert_eq!(hole(painted).await, 0.0, "nothing is gone");
    let one = hole(json!([{ "op": "delete", "select": { "text": "photo 0" } }])).await;
    let sphere = json!({ "center": [900, 0, 0], "radius": 100 });
    let far = json!({ "op": "copy", "select": { "text": "photo 0" }, "translation": [900, 0, 0] });
    let all = json!([far, { "op": "keep", "select": { "sphere": sphere } }]);
    let all = put(&server, &id, all).await;
    let whole = all["uncovered"].as_f64().unwrap();
    assert!(one < whole && whole > 0.9, "{one}, {whole}");
    assert_eq!(list(&server, &id).await, all, "it is said again");
}

/// What a view has of each pixel, as numbers.
async fn layer(server: &TestServer, id: &SceneId, kind: &str) -> Vec<f32> {
    let url = format!("view?from=0&format=npy&width=64&height=48&kind={kind}");
    let bytes = get(server, id, &url).await.bytes().await.unwrap();
    let numbers = &bytes[bytes.len() - 4 * 64 * 48..];
    numbers.chunks_exact(4).map(|v| f32::from_le_bytes(v.try_into().unwrap())).collect()
}

#[tokio::test]
async fn holes_are_where_edits_left_nothing_and_nowhere_else() {
    let (server, id) = start().await;
    let none = |holes: &[f32]| holes.iter().all(|v| *v == 0.0);
    assert!(none(&layer(&server, &id, "holes").await), "without edits");
    let before = layer(&server, &id, "alpha").await;
    // The middle of the picture, through all walls: photos saw nothing behind the last one.
    let url = "pick?from=0&x=32&y=24&width=64&height=48";
    let seen: Value = get(&server, &id, url).await.json().await.unwrap();
    let middle = json!({ "center": seen["point"], "radius": 1 });
    let paint = json!([{ "op": "recolor", "select": { "sphere": middle }, "color": [1, 0, 0] }]);
    put(&server, &id, paint).await;
    assert!(none(&layer(&server, &id, "holes").await), "what is painted is there");
    let sphere = json!({ "center": [900, 0, 0], "radius": 100 });
    let far = json!({ "op": "copy", "select": { "text": "photo 0" }, "translation": [900, 0, 0] });
    let mut sizes = Vec::new();
    for edits in [
        json!([{ "op": "delete", "select": { "sphere": middle } }]),
        json!([{ "op": "delete", "select": { "text": "photo 0" } }]),
        json!([far, { "op": "keep", "select": { "sphere": sphere } }]),
    ] {
        put(&server, &id, edits).await;
        let [after, holes] =
            [layer(&server, &id, "alpha").await, layer(&server, &id, "holes").await];
        let truth: Vec<f32> = before.iter().zip(&after).map(|(a, b)| (a - b).max(0.0)).collect();
        assert_eq!(holes, truth);
        sizes.push(holes.iter().sum::<f32>() / before.iter().sum::<f32>());
    }
    assert!(sizes[1] < sizes[2] && sizes[2] > 0.99, "{sizes:?}");
    // In levels, beside the alpha of the same call.
    let mut shown = Vec::new();
    for kind in ["alpha", "holes"] {
        let url = format!("view?from=0&format=grey8&width=64&height=48&kind={kind}");
        shown.push(get(&server, &id, &url).await.bytes().await.unwrap());
    }
    assert!(shown[0].iter().zip(&shown[1]).zip(&before).all(|((alpha, hole), before)| {
        (f32::from(*alpha) + f32::from(*hole) - 255.0 * before).abs() <= 1.0
    }));
}

#[tokio::test]
async fn a_pick_and_a_part_take_one_thing() {
    let (server, id) = start().await;
    let photo = gaussians_of(&server, &id, "photo 0").await;
    let pick = json!({ "camera": { "from": 0 }, "x": 32, "y": 24, "width": 64, "height": 48 });
    let url = "pick?from=0&x=32&y=24&width=64&height=48&label=photo+0";
    let seen: Value = get(&server, &id, url).await.json().await.unwrap();
    let entry = seen["entry"].as_u64().unwrap();
    let taken = gaussians_of(&server, &id, &format!("photo {}", entry - 1)).await;
    let edits = json!([{ "op": "delete", "select": { "pick": pick } }]);
    let answer = put(&server, &id, edits).await;
    assert_eq!(answer["counts"], json!([taken]), "a wall is connected");
    assert_eq!(gaussians_of(&server, &id, &format!("photo {}", entry - 1)).await, 0);
    let edits = json!([{ "op": "keep", "select": { "text": "photo 0", "parts": [0] } }]);
    let answer = put(&server, &id, edits).await;
    assert_eq!(answer["gaussians"], json!(photo));
}

/// The thing at a point is the same one wherever the edit stands in the list.
#[tokio::test]
async fn a_point_takes_the_thing_there_and_nothing_where_nothing_is() {
    let (server, id) = start().await;
    let walls = async || {
        let mut counts = Vec::new();
        for photo in 0..3 {
            counts.push(gaussians_of(&server, &id, &format!("photo {photo}")).await);
        }
        counts
    };
    let before = walls().await;
    let url = "pick?from=0&x=32&y=24&width=64&height=48";
    let seen: Value = get(&server, &id, url).await.json().await.unwrap();
    let delete = json!({ "op": "delete", "select": { "point": seen["point"] } });
    let answer = put(&server, &id, json!([delete])).await;
    let after = walls().await;
    let changed: Vec<usize> = (0..3).filter(|&photo| before[photo] != after[photo]).collect();
    assert!(matches!(changed[..], [photo] if after[photo] == 0), "{before:?}, {after:?}");
    let taken = before.iter().sum::<u64>() - after.iter().sum::<u64>();
    assert_eq!(answer["counts"], json!([taken]), "a wall is connected");
    let name = format!("photo {}", (changed[0] + 1) % 3);
    let other = json!({ "op": "delete", "select": { "text": name } });
    let counts = put(&server, &id, json!([other, delete])).await["counts"].clone();
    assert_eq!(counts[1], json!(taken), "in another order it is the same thing");
    let far = json!({ "op": "delete", "select": { "point": [900, 0, 0] } });
    assert_eq!(put(&server, &id, json!([far])).await["counts"], json!([0]));
}

#[tokio::test]
async fn exports_of_every_format_hold_the_edits() {
    let (server, id) = start().await;
    let formats: Vec<_> = ExportFormat::all().map(|format| format.name).collect();
    // Masks are those of a text.
    let path = |format: &str| match format {
        "coco" | "labelme" => format!("export?format={format}&text=photo%201"),
        _ => format!("export?format={format}"),
    };
    let mut before = Vec::new();
    for format in &formats {
        let file = get(&server, &id, &path(format)).await;
        before.push((file.headers()["etag"].clone(), file.bytes().await.unwrap()));
    }
    let edits = json!([{ "op": "delete", "select": { "text": "photo 1" } }]);
    put(&server, &id, edits).await;
    for (format, (tag, bytes)) in formats.iter().zip(before) {
        let file = get(&server, &id, &path(format)).await;
        assert_ne!(file.headers()["etag"], tag, "{format}");
        let edited = file.bytes().await.unwrap();
        assert_ne!(edited, bytes, "{format}");
        if ["ply", "splat"].contains(format) {
            // A third of the walls is gone.
            let share = edited.len() as f64 / bytes.len() as f64;
            assert!((0.6..0.75).contains(&share), "{format}: {share}");
        }
    }
}

#[tokio::test]
async fn a_list_outlives_a_restart_and_goes_with_its_scene() {
    let (server, id) = start().await;
    let edits = json!([
        { "op": "delete", "select": { "text": "photo 2" } },
        { "op": "move", "select": { "text": "photo 0" }, "rotation": [0.6, 0, 0.8, 0] },
    ]);
    put(&server, &id, edits).await;
    let (kept, seen) = (list(&server, &id).await, view(&server, &id).await);
    let server = server.restart().await;
    assert_eq!(view(&server, &id).await, seen);
    assert_eq!(list(&server, &id).await, kept);
    let deleted = client().delete(server.url(&format!("/v1/scenes/{id}"))).send().await.unwrap();
    assert_eq!(deleted.status(), StatusCode::NO_CONTENT);
    let (status, _) = send(&server, &id, json!([])).await;
    assert_eq!(status, StatusCode::NOT_FOUND);
    let folder = server.data_dir().join("scenes").join(id.to_string());
    assert!(!folder.exists(), "nothing of it is left");
}

#[tokio::test]
async fn bad_edits_are_refused_by_name_value_and_bound_and_change_nothing() {
    let (server, id) = start().await;
    let good = json!([{ "op": "delete", "select": { "text": "photo 1" } }]);
    let kept = put(&server, &id, good).await;
    let of = |op: &str, more: Value| {
        let mut edit = json!({ "op": op, "select": { "text": "photo 0" } });
        edit.as_object_mut().unwrap().extend(more.as_object().unwrap().clone());
        json!([edit])
    };
    let select = |select: Value| json!([{ "op": "delete", "select": select }]);
    let cases = [
        (of("paint", json!({})), "edits[0]: op is \"paint\"; it must be delete, keep"),
        (of("move", json!({ "scale": 0 })), "edits[0].scale is 0; it must be 0.001 to 1000"),
        (of("move", json!({ "rotation": [2, 0, 0, 0] })), "edits[0].rotation has the length 2"),
        (of("delete", json!({ "scale": 2 })), "delete takes no scale"),
        (of("recolor", json!({})), "recolor needs color"),
        (of("recolor", json!({ "color": [0, 1.5, 0] })), "edits[0].color is 1.5"),
        (of("move", json!({ "by": 3 })), "\"by\""),
        (select(json!({})), "edits[0].select has none"),
        (
            select(json!({ "text": "a", "pick": null, "sphere": { "center": [0, 0, 0],
            "radius": 1 } })),
            "has text and sphere",
        ),
        (select(json!({ "sphere": { "center": [0, 0, 0], "radius": -1 } })), "radius is -1"),
        (
            select(json!({ "box": { "center": [0, 0, 0], "size": [1, 1, 1],
            "axes": [[1, 0, 0], [1, 0, 0], [0, 0, 1]] } })),
            "axes are off by 1",
        ),
        (select(json!({ "point": [2e9, 0, 0] })), "edits[0].select.point is"),
        (select(json!({ "text": "photo 0", "parts": [40] })), "edits[0].select.parts has 40"),
        (select(json!({ "pick": { "camera": { "from": 0 }, "x": 9000, "y": 1 } })), "x is 9000"),
        (
            json!([{ "op": "keep", "select": { "sphere": {
                "center": [999, 0, 0], "radius": 1 } } }]),
            "edits[0] leaves nothing of the scene",
        ),
        (Value::Array(vec![good_edit(); 257]), "257"),
    ];
    for (edits, why) in cases {
        let (status, answer) = send(&server, &id, edits).await;
        assert!(status.is_client_error(), "{answer}");
        let message = answer["message"].as_str().unwrap_or_else(|| panic!("{answer}"));
        assert!(message.contains(why), "{message:?} does not say {why:?}");
    }
    assert_eq!(list(&server, &id).await, kept);
}

#[tokio::test(flavor = "multi_thread")]
async fn another_replica_sees_a_list_and_may_replace_it() {
    let objects = Arc::new(InMemory::new());
    let place = StoreLocation::Shared(objects);
    let replica = || {
        TestServer::at(&place, |config, parts| {
            parts.semantics = Arc::new(PhotoMeaning::default());
            config.limits.record_fresh_ms = 0;
        })
    };
    let (one, other) = (replica().await, replica().await);
    let id = one.scene().await.id;
    let before = view(&other, &id).await;
    let edits = json!([{ "op": "delete", "select": { "text": "photo 1" } }]);
    put(&one, &id, edits).await;
    assert_eq!(list(&other, &id).await, list(&one, &id).await);
    assert_eq!(view(&other, &id).await, view(&one, &id).await);
    assert_ne!(view(&other, &id).await, before);
    put(&other, &id, json!([])).await;
    assert_eq!(view(&one, &id).await, before);
}

#[tokio::test(flavor = "multi_thread")]
async fn an_acknowledged_list_outlives_a_kill() {
    if !can_serve() {
        return;
    }
    let folder = tempfile::tempdir().unwrap();
    let mut server = Start::on(folder.path()).start();
    let client = client();
    let made = process::create(&client, &server.url, &upload(), 60_000, None).await;
    let (status, scene) = made.unwrap();
    assert_eq!(status, 201, "{scene}");
    let path = format!("/v1/scenes/{}/edits", scene["id"].as_str().unwrap());
    for radius in 1..=5 {
        let ball = json!({ "center": [0, 0, 0], "radius": f64::from(radius) * 0.01 });
        let edit = json!({ "op": "recolor", "select": { "sphere": ball }, "color": [1, 0, 0] });
        let request = client.put(server.url(&path)).json(&json!({ "edits": [edit] }));
        let answer = request.send().await.unwrap();
        assert_eq!(answer.status(), StatusCode::OK);
        let acknowledged: Value = answer.json().await.unwrap();
        server.kill();
        server = Start::on(folder.path()).start();
        let (_, kept) = process::get(&client, &server.url(&path)).await.unwrap();
        assert_eq!(kept, acknowledged);
    }
}

fn good_edit() -> Value {
    json!({ "op": "delete", "select": { "sphere": { "center": [0, 0, 0], "radius": 0 } } })
}

/// The stand-in's walls are at one depth: nothing floats. A scene of two photos has no floaters.
#[tokio::test(flavor = "multi_thread")]
async fn floaters_are_a_selection_like_others() {
    let (server, id) = start().await;
    let floaters = json!({ "op": "delete", "select": { "floaters": true } });
    let photos = server.service.get(&id).await.unwrap().cameras.len();
    let (status, told) = send(&server, &id, json!([floaters])).await;
    if photos < 3 {
        assert_eq!(status, StatusCode::BAD_REQUEST, "{told}");
        assert!(told["message"].as_str().unwrap().contains("3 photos and more"), "{told}");
    } else {
        assert_eq!((status, &told["counts"]), (StatusCode::OK, &json!([0])), "{told}");
        assert_eq!(list(&server, &id).await["edits"], json!([floaters]), "as it was sent");
    }
    let both = json!({ "op": "delete", "select": { "floaters": true, "text": "photo 0" } });
    let (status, told) = send(&server, &id, json!([both])).await;
    assert_eq!(status, StatusCode::BAD_REQUEST, "{told}");
    assert!(told["message"].as_str().unwrap().contains("text and floaters"), "{told}");
}
