//! How large a scene is, over both doors: what is said of it, what is measured, what is kept and
//! what is refused.

use std::sync::Arc;

use reqwest::StatusCode;
use segsplat::{
    api::grpc::pb::{self, scene_service_client::SceneServiceClient},
    scene::SceneId,
};
use serde_json::{Value, json};

use crate::common::{client, doors::channel, meaning::PhotoMeaning, server::TestServer};

async fn start() -> (TestServer, SceneId) {
    let server = TestServer::with(|_, parts| parts.semantics = Arc::new(PhotoMeaning::default()));
    let server = server.await;
    let id = server.scene().await.id;
    (server, id)
}

async fn get(server: &TestServer, id: &SceneId) -> Value {
    let answer = client().get(server.url(&format!("/v1/scenes/{id}/scale"))).send().await.unwrap();
    assert_eq!(answer.status(), StatusCode::OK);
    answer.json().await.unwrap()
}

async fn put(server: &TestServer, id: &SceneId, scale: Value) -> (StatusCode, Value) {
    let url = server.url(&format!("/v1/scenes/{id}/scale"));
    let answer = client().put(url).json(&scale).send().await.unwrap();
    (answer.status(), answer.json().await.unwrap())
}

async fn measure(server: &TestServer, id: &SceneId, points: Value) -> (StatusCode, Value) {
    let url = server.url(&format!("/v1/scenes/{id}/measure"));
    let answer = client().post(url).json(&json!({ "points": points })).send().await.unwrap();
    (answer.status(), answer.json().await.unwrap())
}

#[tokio::test(flavor = "multi_thread")]
async fn one_length_makes_metres_of_all_and_is_kept() {
    let (server, id) = start().await;
    let tag = async |server: &TestServer| {
        let url = server.url(&format!("/v1/scenes/{id}/view?from=0"));
        client().get(url).send().await.unwrap().headers()["etag"].clone()
    };
    let before = (get(&server, &id).await, tag(&server).await);
    assert_eq!((&before.0["source"], &before.0["metres_per_unit"]), (&json!("none"), &Value::Null));
    let square = json!([[0, 0, 0], [3, 0, 4], [3, 5, 4], [0, 5, 0]]);
    let (_, units) = measure(&server, &id, square.clone()).await;
    assert_eq!((&units["unit"], &units["length"]), (&json!("unknown"), &json!(15.0)));
    assert_eq!((&units["legs"], &units["area"]), (&json!([5.0, 5.0, 5.0]), &json!(25.0)));
    let (status, set) =
        put(&server, &id, json!({ "metres": 2.5, "points": [[0, 0, 0], [3, 0, 4]] })).await;
    assert_eq!((status, &set["metres_per_unit"]), (StatusCode::OK, &json!(0.5)), "{set}");
    let server = server.restart().await;
    assert_eq!(get(&server, &id).await, set, "it is kept");
    let (_, metres) = measure(&server, &id, square).await;
    assert_eq!((&metres["unit"], &metres["length"]), (&json!("metre"), &json!(7.5)));
    assert_eq!(metres["area"], json!(6.25));
    assert_eq!(tag(&server).await, before.1, "no picture changes");
    let (_, reset) = put(&server, &id, json!({})).await;
    assert_eq!((&reset, get(&server, &id).await), (&before.0, before.0.clone()));
}

#[tokio::test(flavor = "multi_thread")]
async fn a_thing_that_a_text_finds_makes_metres() {
    let (server, id) = start().await;
    let url = server.url(&format!("/v1/scenes/{id}/query"));
    let asked = json!({ "texts": ["photo 0"], "boxes": "upright" });
    let found: Value = client().post(url).json(&asked).send().await.unwrap().json().await.unwrap();
    let size = &found["results"][0]["parts"][0]["size"];
    let [a, b, high] = [0, 1, 2].map(|k| size[k].as_f64().unwrap());
    for (side, length) in [("height", high), ("width", a.max(b)), ("longest", a.max(b).max(high))] {
        let thing = json!({ "text": "photo 0", "side": side });
        let (status, set) = put(&server, &id, json!({ "metres": 2.0, "thing": thing })).await;
        assert_eq!(status, StatusCode::OK, "{set}");
        let got = set["metres_per_unit"].as_f64().unwrap();
        assert!((got - 2.0 / length).abs() < 1e-9 * got, "{side}: {got}");
    }
    let mut grpc = SceneServiceClient::new(channel(server.addr).await);
    let scene_id = id.to_string();
    let thing = pb::ScaleThing { text: "photo 0".to_owned(), part: 0, side: 0 };
    let request = pb::SetScaleRequest {
        scene_id: scene_id.clone(),
        metres: Some(3.0),
        thing: Some(thing),
        ..Default::default()
    };
    let set = grpc.set_scale(request).await.expect("a thing").into_inner();
    assert_eq!((set.metres_per_unit, set.source()), (Some(3.0 / high), pb::ScaleSource::Given));
    let asked = pb::GetScaleRequest { scene_id: scene_id.clone() };
    assert_eq!(grpc.get_scale(asked).await.unwrap().into_inner(), set);
    let points = vec![0.0, 0.0, 0.0, 0.0, high, 0.0];
    let request = pb::MeasureRequest { scene_id: scene_id.clone(), points };
    let found = grpc.measure(request).await.unwrap().into_inner();
    assert!((found.length - 3.0).abs() < 1e-9 && found.area.is_none(), "{found:?}");
    assert_eq!(found.unit(), pb::LengthUnit::Metre);
    let odd = pb::MeasureRequest { scene_id: scene_id.clone(), points: vec![1.0; 4] };
    let refused = grpc.measure(odd).await.expect_err("four numbers");
    assert!(refused.message().contains("4 numbers"), "{refused}");
    let three = pb::SetScaleRequest {
        scene_id,
        metres: Some(1.0),
        points: vec![1.0; 9],
        ..Default::default()
    };
    let refused = grpc.set_scale(three).await.expect_err("three points");
    assert!(refused.message().contains("3 points"), "{refused}");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_scale_that_cannot_be_is_refused_and_changes_nothing() {
    let (server, id) = start().await;
    let before = get(&server, &id).await;
    for (scale, word) in [
        (json!({ "metres": 1.0 }), "points or with thing"),
        (json!({ "points": [[0, 0, 0], [1, 0, 0]] }), "points or with thing"),
        (json!({ "metres": 1.0, "points": [[0, 0, 0], [0, 0, 0]] }), "inf"),
        (json!({ "metres": -1.0, "points": [[0, 0, 0], [1, 0, 0]] }), "-1"),
        (json!({ "metres_per_unit": 0 }), "0.000001"),
        (json!({ "metres": 1.0, "points": [[0, 0, 0], [1e300, 0, 0]] }), "points[1]"),
        (json!({ "metres": 1.0, "points": [[0, 0, 0]] }), "2"),
        (json!({ "metres": 1.0, "thing": { "text": "photo 9" } }), "0 parts"),
        (json!({ "metres": 1.0, "thing": { "text": "photo 0", "side": "top" } }), "top"),
        (json!({ "miles": 1.0 }), "miles"),
    ] {
        let (status, told) = put(&server, &id, scale.clone()).await;
        assert_eq!(status, StatusCode::BAD_REQUEST, "{scale}: {told}");
        assert!(told["message"].as_str().unwrap().contains(word), "{scale}: {told}");
    }
    for (points, word) in [
        (json!([]), "no points"),
        (json!(vec![[0; 3]; 65]), "64"),
        (json!([[0, 0, "x"]]), "points"),
        (json!([[0, 0, 1e40]]), "points[0]"),
    ] {
        let (status, told) = measure(&server, &id, points).await;
        assert!(status.is_client_error(), "{told}");
        assert!(told["message"].as_str().unwrap().contains(word), "{told}");
    }
    assert_eq!(get(&server, &id).await, before);
}
