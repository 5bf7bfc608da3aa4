//! One table, two doors, two descriptions: every code through both transports, the OpenAPI
//! document against the routes and real answers, the proto against the OpenAPI document.

use std::{collections::BTreeSet, sync::Arc};

use segsplat::{
    api::{grpc::DESCRIPTORS, http::routes},
    error::{Result, TABLE},
    jobs::{NoSemantics, Phrases, SemanticNetworks},
    scene::{Method, PosedPhoto, Scene, Semantics, TextEmbedding, Watch},
};
use serde_json::{Value, json};

use super::bad_input::raw;
use crate::common::{
    cpu_server::{CpuServer, PlaneNetworks, upload},
    doors::{Door, Options, both, form, json as body},
    root,
    server::TestServer,
};

#[tokio::test]
async fn every_code_comes_through_both_doors_as_its_row_says() {
    for row in &TABLE {
        let maker = PlaneNetworks { fails: Some(row.code) };
        let stand = CpuServer::with(maker, |_| {}).await;
        for door in both(stand.addr).await {
            let fault = door.create(&upload(), &Options::wait()).await.expect_err(row.name);
            assert_eq!(fault.code, row.name, "{}", door.name());
            assert_eq!(fault.number, door.number_of(row), "{} of {}", row.name, door.name());
            assert!(fault.message.contains("made to fail"), "{}", fault.message);
            assert!(!fault.request_id.is_empty(), "no request id from {}", door.name());
        }
    }
}

/// Panics when it is asked what the bundle lacks.
struct Panics;

impl SemanticNetworks for Panics {
    fn lacks(&self) -> Option<String> {
        panic!("on purpose")
    }

    fn phrases(&self) -> Result<Phrases> {
        NoSemantics.phrases()
    }

    fn embed_texts(&self, texts: &[String]) -> Result<Vec<TextEmbedding>> {
        NoSemantics.embed_texts(texts)
    }

    fn make(
        &self,
        photos: &[PosedPhoto],
        method: &Method,
        scene: &dyn Fn() -> Result<Arc<Scene>>,
        watch: Watch<'_>,
    ) -> Result<Semantics> {
        NoSemantics.make(photos, method, scene, watch)
    }
}

#[tokio::test]
async fn a_panic_in_a_call_is_an_internal_error_and_the_server_lives() {
    let server = TestServer::with(|_, parts| parts.semantics = Arc::new(Panics)).await;
    for door in both(server.addr).await {
        let options = Options { semantics: Some("eager"), ..Options::wait() };
        let fault = door.create(&upload(), &options).await.unwrap_err();
        let row = TABLE.iter().find(|row| row.name == "internal").unwrap();
        assert_eq!((&*fault.code, fault.number), ("internal", door.number_of(row)), "{fault:?}");
        assert!(!fault.request_id.is_empty(), "{fault:?}");
        assert!(!fault.message.contains("on purpose"), "the panic's text reached the client");
        let unknown = door.get(&"0".repeat(32)).await.unwrap_err();
        assert_eq!(unknown.code, "scene_not_found", "{} is dead", door.name());
    }
}

#[tokio::test]
async fn a_failed_scene_keeps_its_code_and_its_views_are_refused_with_it() {
    let maker = PlaneNetworks { fails: Some(segsplat::error::ErrorCode::PhotoUnreadable) };
    let stand = CpuServer::with(maker, |_| {}).await;
    for door in both(stand.addr).await {
        let (id, _) = door.create(&upload(), &Options::default()).await.unwrap();
        loop {
            let (state, _) = door.get(&id).await.unwrap();
            if state == "failed" {
                break;
            }
            assert!(["queued", "running"].contains(&state.as_str()), "{state}");
            tokio::task::yield_now().await;
        }
        let fault = door.view(&id, &crate::common::doors::Ask::first()).await.unwrap_err();
        assert!(!["internal", "scene_not_found"].contains(&fault.code.as_str()), "{fault:?}");
    }
}

#[tokio::test]
async fn a_full_queue_is_overloaded_and_says_when_to_come_back() {
    let stand = CpuServer::with(PlaneNetworks::default(), |config| {
        config.limits.queued_jobs_max = 0;
    })
    .await;
    for door in both(stand.addr).await {
        let fault = door.create(&upload(), &Options::default()).await.unwrap_err();
        assert_eq!(fault.code, "overloaded", "{}", fault.message);
        let seconds = fault.retry_after.expect("retry-after");
        assert!(seconds.parse::<u32>().unwrap() > 0, "{seconds} of {}", door.name());
    }
}

#[tokio::test]
async fn a_full_queue_refuses_before_the_photos_come() {
    let stand = CpuServer::with(PlaneNetworks::default(), |config| {
        config.limits.queued_jobs_max = 0;
    })
    .await;
    let head = "POST /v1/scenes HTTP/1.1\r\nhost: localhost\r\ncontent-length: 9000000\r\n\
                content-type: multipart/form-data; boundary=b\r\n\r\n";
    let waited = std::time::Duration::from_secs(20);
    let answer = tokio::time::timeout(waited, raw(&stand, head, b"--b")).await;
    let answer = answer.expect("nothing more is waited for");
    assert!(answer.starts_with("HTTP/1.1 429") && answer.contains("overloaded"), "{answer}");
}

/// Problem details (RFC 9457) are there where `Accept` names them, whoever refuses the call, and
/// they say what our own body says.
#[tokio::test]
async fn problem_details_are_told_where_they_are_asked_for() {
    let stand = CpuServer::start().await;
    let none = format!("/v1/scenes/{}", "0".repeat(32));
    for (path, status, code, title) in [
        (&*none, 404, "scene_not_found", "Scene not found"),
        ("/v1/scenes?limit=0", 400, "invalid_request", "Invalid request"),
        ("/v1/nothing", 404, "not_found", "Not found"),
        ("/v1/scenes?deadline_ms=0", 400, "invalid_request", "Invalid request"),
    ] {
        let ask = async |accept: &str| {
            let call = crate::common::client().get(stand.url(path)).header("accept", accept);
            let answer = call.header("x-request-id", "call-7").send().await.unwrap();
            assert_eq!(answer.status(), status, "{path}");
            let varies = answer.headers().get_all("vary").iter();
            assert!(varies.into_iter().any(|v| v.to_str().unwrap().contains("accept")), "{path}");
            let kind = answer.headers()["content-type"].to_str().unwrap().to_owned();
            let body: Value = serde_json::from_slice(&answer.bytes().await.unwrap()).unwrap();
            (kind, body)
        };
        let (kind, ours) = ask("application/json").await;
        assert_eq!(kind, "application/json");
        assert_eq!(ours["code"], code);
        let (kind, problem) = ask("application/json;q=0.9, application/problem+json").await;
        assert_eq!(kind, "application/problem+json");
        let expected = json!({
            "type": format!("urn:segsplat:error:{code}"),
            "title": title,
            "status": status,
            "detail": ours["message"],
            "instance": path.split('?').next(),
            "code": code,
            "request_id": "call-7",
            "details": ours["details"],
        });
        assert_eq!(problem, expected);
    }
    let document = document(&stand).await;
    let fault = &document["paths"]["/v1/scenes"]["get"]["responses"]["default"]["content"];
    let schema = fault["application/problem+json"]["schema"]["$ref"].as_str().unwrap();
    let schema = document.pointer(schema.trim_start_matches('#')).unwrap();
    assert_eq!(schema["required"].as_array().unwrap().len(), 8, "{schema}");
}

async fn document(stand: &CpuServer) -> Value {
    body(crate::common::client().get(stand.url("/openapi.json")).send().await.unwrap())
        .await
        .unwrap()
}

/// `POST /v1/scenes` and so on, of the document.
fn documented(document: &Value) -> BTreeSet<String> {
    let paths = document["paths"].as_object().expect("paths");
    paths
        .iter()
        .flat_map(|(path, item)| {
            let methods = ["get", "post", "delete", "put", "patch", "head"];
            let given = methods.into_iter().filter(|method| item.get(method).is_some());
            given.map(move |method| format!("{} {path}", method.to_uppercase()))
        })
        .collect()
}

#[tokio::test]
async fn the_openapi_document_has_the_routes_and_nothing_else() {
    let stand = CpuServer::start().await;
    let served: BTreeSet<_> =
        routes().iter().map(|route| format!("{} {}", route.method, route.path)).collect();
    let document = document(&stand).await;
    assert_eq!(documented(&document), served);
    // Summaries say what a call does, not once more what it is called.
    for operation in document["paths"].as_object().unwrap().values() {
        for operation in operation.as_object().unwrap().values() {
            let summary = operation["summary"].as_str().unwrap();
            assert!(!summary.is_empty() && !summary.contains("/v1"), "{summary}");
        }
    }
    // And each of them is really served: none is answered as an unknown route.
    for route in routes() {
        let path = route.path.replace("{id}", &"0".repeat(32));
        let method = reqwest::Method::from_bytes(route.method.as_bytes()).unwrap();
        // A parameter that no call takes: none does its work.
        let url = stand.url(&format!("{path}?no_such_parameter=1"));
        let answer = crate::common::client().request(method, url).send().await;
        let answer = answer.unwrap();
        assert_ne!(answer.status(), 405, "{} {path}", route.method);
        let text = answer.text().await.unwrap();
        assert!(!text.contains("no such route"), "{} {path}: {text}", route.method);
    }
}

#[tokio::test]
async fn the_two_doors_have_the_same_calls() {
    let stand = CpuServer::start().await;
    let document = document(&stand).await;
    let descriptors = String::from_utf8_lossy(DESCRIPTORS);
    for (paths, file, service) in [
        ("/v1/", "segsplat/v1/scene.proto", "SceneService"),
        ("/v2", "inference/open_inference_grpc.proto", "GRPCInferenceService"),
    ] {
        let operations: BTreeSet<_> = document["paths"]
            .as_object()
            .unwrap()
            .iter()
            .filter(|(path, _)| path.starts_with(paths))
            .flat_map(|(_, item)| item.as_object().unwrap().values())
            .filter_map(|operation| operation.get("operationId"))
            .map(|id| id.as_str().unwrap().to_owned())
            .collect();
        let proto = std::fs::read_to_string(root().join("proto").join(file)).unwrap();
        let rpcs: BTreeSet<_> = proto
            .lines()
            .filter_map(|line| line.trim().strip_prefix("rpc "))
            .map(|rest| snake(rest.split('(').next().unwrap()))
            .collect();
        assert_eq!(operations, rpcs, "HTTP operations and gRPC methods");
        assert!(descriptors.contains(service), "the descriptors lack {service}");
    }
}

fn snake(camel: &str) -> String {
    let mut name = String::new();
    for c in camel.chars() {
        if c.is_uppercase() && !name.is_empty() {
            name.push('_');
        }
        name.extend(c.to_lowercase());
    }
    name
}

#[tokio::test]
async fn real_answers_have_the_fields_that_the_document_says() {
    let stand = CpuServer::start().await;
    let document = document(&stand).await;
    let client = crate::common::client();
    let request = client.post(stand.url("/v1/scenes?wait_ms=120000")).multipart(form(&upload()));
    let scene = body(request.send().await.unwrap()).await.unwrap();
    let get = async |path: &str| crate::common::client().get(stand.url(path)).send().await.unwrap();
    let mut faults = Vec::new();
    check(&document, "Scene", &scene, &mut faults);
    for (name, path) in [
        ("Page", "/v1/scenes"),
        ("Models", "/v1/models"),
        ("Readiness", "/readyz"),
        ("Liveness", "/healthz"),
        ("ErrorBody", "/v1/scenes/none"),
        ("ErrorBody", "/nothing"),
    ] {
        check(&document, name, &get(path).await.json().await.unwrap(), &mut faults);
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    let mut broken = Vec::new();
    check(&document, "Scene", &json!({ "id": "x", "colour": 1 }), &mut broken);
    assert!(broken.len() > 3, "the check finds nothing wrong with nonsense: {broken:?}");
}

#[tokio::test]
async fn the_document_has_the_bodies_and_the_bounds_that_the_server_takes() {
    let stand = CpuServer::with(PlaneNetworks::default(), |config| {
        config.limits.view_side_max = 300;
        config.limits.page_max = 7;
        config.limits.texts_max = 3;
    })
    .await;
    let document = document(&stand).await;
    let schemas = &document["components"]["schemas"];
    let mut faults = Vec::new();
    let common = json!({
        "width": 8, "height": 8, "antialiased": true, "near": 0.1, "error": 0.5,
        "preset": "paper", "front_photos": 0, "magnify": true, "canon": ["thing"], "tau": 1.0,
        "cut": 0.2, "unit_rows": true, "coverage_floor": 0.1, "near_best": 0.3,
        "margin": 0.01, "rivals": 0.5,
        "wait_ms": 0,
    });
    let [mut query, mut views] = [common.clone(), common];
    query["texts"] = json!(["a chair"]);
    query["camera"] = json!({ "from": 0, "fov": 40.0 });
    views["cameras"] = json!([{ "eye": [0, 0, 0], "target": [0, 0, 1] }]);
    views["background"] = json!("white");
    views["container"] = json!("zip");
    for (name, body) in [("QueryBody", query), ("ViewsRequest", views)] {
        check(&document, name, &body, &mut faults);
        assert_eq!(schemas[name]["additionalProperties"], false, "{name}");
    }
    assert!(faults.is_empty(), "{}", faults.join("\n"));
    for (name, schema) in schemas.as_object().unwrap() {
        assert!(schema.get("allOf").is_none(), "{name}: closed objects in allOf have no value");
    }
    assert_eq!(schemas["Event"]["oneOf"].as_array().map(Vec::len), Some(7), "events");
    let texts = &schemas["QueryBody"]["properties"]["texts"];
    assert_eq!((&texts["minItems"], &texts["maxItems"]), (&json!(1), &json!(3)), "{texts}");
    for (path, name, range) in [
        ("/v1/scenes/{id}/view", "width", [json!(1), json!(300)]),
        ("/v1/scenes/{id}/view", "fov", [json!(0.1), json!(170.0)]),
        ("/v1/scenes/{id}/view", "deadline_ms", [json!(1), Value::Null]),
        ("/v1/scenes", "limit", [json!(1), json!(7)]),
    ] {
        let given = document["paths"][path]["get"]["parameters"].as_array().unwrap();
        let schema = &given.iter().find(|given| given["name"] == name).unwrap()["schema"];
        assert_eq!([&schema["minimum"], &schema["maximum"]], range.each_ref(), "{path} {name}");
    }
}

/// Compares `value` with the schema `name`: no field unknown, none missing, those below too.
fn check(document: &Value, name: &str, value: &Value, faults: &mut Vec<String>) {
    let schema = &document["components"]["schemas"][name];
    if let Some(names) = schema["enum"].as_array() {
        if !names.contains(value) {
            faults.push(format!("{name}: {value} is none of {names:?}"));
        }
        return;
    }
    let fields = schema["properties"].as_object().unwrap_or_else(|| panic!("no schema {name}"));
    let object = value.as_object().unwrap_or_else(|| panic!("{name} is {value}"));
    for key in object.keys().filter(|key| !fields.contains_key(*key)) {
        faults.push(format!("{name}: `{key}` is not in the document"));
    }
    for key in schema["required"].as_array().into_iter().flatten() {
        let key = key.as_str().unwrap();
        if !object.contains_key(key) {
            faults.push(format!("{name}: `{key}` is missing"));
        }
    }
    for (key, field) in fields {
        let Some(value) = object.get(key).filter(|value| !value.is_null()) else { continue };
        let reference = [field, &field["items"]]
            .into_iter()
            .chain(field["oneOf"].as_array().into_iter().flatten());
        let reference = reference.filter_map(|field| field["$ref"].as_str()).next();
        let Some(reference) = reference else { continue };
        let inner = reference.rsplit('/').next().unwrap();
        let values = value.as_array().map_or(vec![value], |values| values.iter().collect());
        for value in values {
            check(document, inner, value, faults);
        }
    }
}

#[tokio::test]
async fn null_is_documented_where_it_is_taken() {
    let stand = CpuServer::start().await;
    let [http, _] = both(stand.addr).await;
    let Door::Http { base, client } = http else { panic!("the first door is HTTP") };
    let document = client.get(format!("{base}/openapi.json")).send().await.unwrap();
    let document: Value = serde_json::from_slice(&document.bytes().await.unwrap()).unwrap();
    for (call, name, needed) in [
        ("query", "QueryBody", json!({ "texts": ["x"] })),
        ("views", "ViewsRequest", json!({ "cameras": [{ "from": 0 }] })),
    ] {
        let schema = &document["components"]["schemas"][name];
        let null = json!("null");
        let taken = |field: &Value| {
            let kinds = field["type"].as_array();
            let any =
                field["oneOf"].as_array().is_some_and(|of| of.iter().any(|s| s["type"] == null));
            // `background` is of any kind.
            let free = ["type", "oneOf", "$ref"].iter().all(|key| field.get(key).is_none());
            any || free || kinds.is_some_and(|kinds| kinds.contains(&null))
        };
        let fields = schema["properties"].as_object().unwrap();
        assert!(fields.len() > 10, "{fields:?}");
        for (field, of) in fields {
            let must = schema["required"].as_array().unwrap().contains(&json!(field));
            assert_eq!(taken(of), !must, "{name}.{field}: {of}");
            if must {
                continue;
            }
            let mut body = needed.clone();
            body[field.as_str()] = Value::Null;
            let url = format!("{base}/v1/scenes/00000000000000000000000000000000/{call}");
            let post = client.post(url).header("content-type", "application/json");
            let answer = post.body(body.to_string()).send().await.unwrap();
            let fault = crate::common::doors::bytes(answer).await.expect_err(field);
            assert_eq!(fault.code, "scene_not_found", "{name}.{field}: {}", fault.message);
        }
    }
}

#[tokio::test]
async fn a_request_of_ours_is_never_answered_with_another_shape() {
    let stand = CpuServer::start().await;
    let [http, _] = both(stand.addr).await;
    let Door::Http { base, client } = http else { panic!("the first door is HTTP") };
    for (method, path) in [
        ("POST", "/v1/scenes"),
        ("POST", "/v1/scenes/00000000000000000000000000000000/views"),
        ("PATCH", "/v1/models"),
        ("GET", "/v1/scenes/%ff"),
        ("GET", "/v1/scenes/x/view?width=%00"),
        ("DELETE", "/"),
    ] {
        let method = reqwest::Method::from_bytes(method.as_bytes()).unwrap();
        let request = client.request(method.clone(), format!("{base}{path}"));
        let answer = request.body("{ not json").send().await.unwrap();
        // `bytes` panics where the body is not ours.
        let fault = crate::common::doors::bytes(answer).await.expect_err(path);
        assert!(!fault.message.is_empty(), "{method} {path}");
    }
}
