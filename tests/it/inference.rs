//! The networks by the Open Inference Protocol, at both doors: what a caller gets is what the
//! library computes, to the bit; and what is refused, by name.

use std::collections::BTreeMap;

use segsplat::{
    api::grpc::pb_inference::{
        InferTensorContents, ModelInferRequest, ModelMetadataRequest, ModelReadyRequest,
        ServerLiveRequest, ServerMetadataRequest, ServerReadyRequest,
        grpc_inference_service_client::GrpcInferenceServiceClient,
        model_infer_request::{InferInputTensor, InferRequestedOutputTensor},
        model_infer_response::InferOutputTensor,
        model_metadata_response::TensorMetadata,
    },
    config::Config,
    models::{Tensor, TensorData},
    pipeline::{NETWORKS, Pipeline},
    scene::Photo,
};
use serde_json::{Value, json};
use tonic::transport::Channel;

use crate::common::{
    doors::{self, Fault, channel, fault_of},
    opened, root,
    server::TestServer,
};

type Client = GrpcInferenceServiceClient<Channel>;

struct Fixture {
    server: TestServer,
    /// The library with the same bundle.
    pipeline: Pipeline,
}

fn configured(config: &mut Config) {
    config.bundle = Some(root().join("tests/fixtures/colours"));
    config.threads = 1;
    config.jobs = 1;
}

/// A server with the fixture's networks; `None` (said aloud) without ONNX Runtime.
async fn fixture(change: impl FnOnce(&mut Config)) -> Option<Fixture> {
    let mut config = Config::default();
    configured(&mut config);
    let pipeline = opened(Pipeline::open(&config.networks()))?;
    let (parts, engine) = segsplat::cli::engine::parts(&config).unwrap();
    engine.get().unwrap();
    let server = TestServer::with(|of_server, of_test| {
        configured(of_server);
        change(of_server);
        *of_test = parts;
    });
    Some(Fixture { server: server.await, pipeline })
}

fn tensor(name: &str, shape: &[usize], data: TensorData) -> Tensor {
    Tensor { name: name.to_owned(), shape: shape.to_vec(), data }
}

/// Numbers of 0 to 1 without a pattern.
fn floats(name: &str, shape: &[usize]) -> Tensor {
    let value = |i: usize| (((i * 7919 + 13) % 1009) as f32) / 1009.0;
    tensor(name, shape, TensorData::F32((0..shape.iter().product()).map(value).collect()))
}

/// Inputs that a network of the fixture takes.
fn inputs(network: &str) -> Vec<Tensor> {
    let identity = |n: usize| (0..n * n).map(move |i| f32::from(u8::from(i % (n + 1) == 0)));
    let poses = |views: usize, n: usize| (0..views).flat_map(|_| identity(n)).collect();
    let geometry = |views: usize| {
        let next = |view: usize| i64::try_from((view + 1) % views).unwrap();
        vec![
            floats("images", &[views, 3, 32, 48]),
            tensor("intrinsics", &[views, 3, 3], TensorData::F32(poses(views, 3))),
            tensor("camera_to_world", &[views, 4, 4], TensorData::F32(poses(views, 4))),
            tensor("near", &[views], TensorData::F32(vec![1.0; views])),
            tensor("far", &[views], TensorData::F32(vec![9.0; views])),
            tensor("neighbors", &[views, 1], TensorData::I64((0..views).map(next).collect())),
        ]
    };
    match network {
        "geometry" => geometry(2),
        "geometry.many" => geometry(5),
        "masks.encoder" => vec![floats("images", &[1, 3, 64, 64])],
        "image_text.image" => vec![floats("images", &[3, 3, 16, 16])],
        "image_text.text" => vec![
            tensor("input_ids", &[2, 3], TensorData::I64(vec![1, 2, 3, 3, 2, 0])),
            tensor("attention_mask", &[2, 3], TensorData::I64(vec![1, 1, 1, 1, 1, 0])),
        ],
        other => panic!("no inputs of {other}"),
    }
}

/// Those of the decoder, with what the encoder gave.
fn prompts(pipeline: &Pipeline) -> Vec<Tensor> {
    let seen = inputs("masks.encoder");
    let mut seen = pipeline.with_network("masks.encoder", |n| n.infer(&seen, &[])).unwrap();
    let points = vec![10.0, 30.0, 0.0, 0.0, 50.0, 31.0, 0.0, 0.0];
    seen.push(tensor("point_coords", &[2, 2, 2], TensorData::F32(points)));
    seen.push(tensor("point_labels", &[2, 2], TensorData::F32(vec![1.0, -1.0, 1.0, -1.0])));
    seen
}

fn bytes_of(data: &TensorData) -> Vec<u8> {
    match data {
        TensorData::F32(data) => data.iter().flat_map(|v| v.to_le_bytes()).collect(),
        TensorData::I64(data) => data.iter().flat_map(|v| v.to_le_bytes()).collect(),
        TensorData::U8(data) => data.clone(),
    }
}

fn datatype(data: &TensorData) -> &'static str {
    match data {
        TensorData::F32(_) => "FP32",
        TensorData::I64(_) => "INT64",
        TensorData::U8(_) => "UINT8",
    }
}

fn numbers(data: &TensorData) -> Value {
    match data {
        TensorData::F32(data) => json!(data),
        TensorData::I64(data) => json!(data),
        TensorData::U8(data) => json!(data),
    }
}

/// Name, shape, datatype and bytes of each output.
type Found = Vec<(String, Vec<usize>, String, Vec<u8>)>;

fn found(tensors: Vec<Tensor>) -> Found {
    let one = |Tensor { name, shape, data }: Tensor| {
        (name, shape, datatype(&data).to_owned(), bytes_of(&data))
    };
    tensors.into_iter().map(one).collect()
}

/// A body with the tensors as bytes behind the JSON, and the length of the JSON.
fn binary(inputs: &[Tensor], rest: &Value) -> (usize, Vec<u8>) {
    let one = |input: &Tensor| {
        let mut told = described(&input.name, &input.shape, datatype(&input.data));
        told["parameters"] = json!({ "binary_data_size": bytes_of(&input.data).len() });
        told
    };
    let mut body = rest.clone();
    body["inputs"] = inputs.iter().map(one).collect();
    let json = body.to_string().into_bytes();
    let behind = inputs.iter().flat_map(|input| bytes_of(&input.data));
    (json.len(), json.iter().copied().chain(behind).collect())
}

/// A tensor without its numbers.
fn described(name: &str, shape: impl serde::Serialize, datatype: &str) -> Value {
    json!({ "name": name, "shape": shape, "datatype": datatype })
}

/// The same as JSON alone.
fn listed(inputs: &[Tensor]) -> Value {
    let one = |input: &Tensor| {
        let mut told = described(&input.name, &input.shape, datatype(&input.data));
        told["data"] = numbers(&input.data);
        told
    };
    json!({ "id": "7", "inputs": inputs.iter().map(one).collect::<Vec<_>>() })
}

impl Fixture {
    async fn post(&self, network: &str, body: Vec<u8>, json: Option<usize>) -> reqwest::Response {
        let url = self.server.url(&format!("/v2/models/{network}/infer"));
        let mut call = crate::common::client().post(url).body(body);
        if let Some(json) = json {
            call = call.header("Inference-Header-Content-Length", json);
        }
        call.send().await.unwrap()
    }

    /// As tritonclient reads the answer.
    async fn http(
        &self,
        network: &str,
        body: Vec<u8>,
        json: Option<usize>,
    ) -> Result<Found, Fault> {
        let answer = self.post(network, body, json).await;
        let length = answer.headers().get("inference-header-content-length").cloned();
        let bytes = doors::bytes(answer).await?;
        let json = length.map_or(bytes.len(), |text| text.to_str().unwrap().parse().unwrap());
        let told: Value = serde_json::from_slice(&bytes[..json]).unwrap();
        assert_eq!(told["model_name"], network);
        let mut at = json;
        let one = |output: &Value| {
            let shape: Vec<usize> = serde_json::from_value(output["shape"].clone()).unwrap();
            let datatype = output["datatype"].as_str().unwrap().to_owned();
            let data = match output["parameters"]["binary_data_size"].as_u64() {
                Some(size) => {
                    at += size as usize;
                    bytes[at - size as usize..at].to_vec()
                }
                None if datatype == "FP32" => {
                    let data: Vec<f32> = serde_json::from_value(output["data"].clone()).unwrap();
                    bytes_of(&TensorData::F32(data))
                }
                None => serde_json::from_value(output["data"].clone()).unwrap(),
            };
            (output["name"].as_str().unwrap().to_owned(), shape, datatype, data)
        };
        let found = told["outputs"].as_array().unwrap().iter().map(one).collect();
        assert_eq!(at, bytes.len(), "all bytes belong to an output");
        Ok(found)
    }

    async fn client(&self) -> Client {
        GrpcInferenceServiceClient::new(channel(self.server.addr).await)
            .max_decoding_message_size(1 << 26)
    }

    async fn grpc(&self, network: &str, inputs: &[Tensor], raw: bool) -> Result<Found, Fault> {
        let answer = self.client().await.model_infer(message(network, inputs, raw)).await;
        let answer = answer.map_err(fault_of)?.into_inner();
        assert_eq!((&*answer.model_name, &*answer.id), (network, "7"));
        let one = |(output, bytes): (InferOutputTensor, tonic::codegen::Bytes)| {
            let shape = output.shape.iter().map(|size| *size as usize).collect();
            (output.name, shape, output.datatype, bytes.to_vec())
        };
        Ok(answer.outputs.into_iter().zip(answer.raw_output_contents).map(one).collect())
    }

    /// The message of the refusal that both doors give.
    async fn refused(&self, network: &str, inputs: &[Tensor]) -> Fault {
        let (json, body) = binary(inputs, &json!({}));
        let http = self.http(network, body, Some(json)).await.unwrap_err();
        let listed = listed(inputs).to_string().into_bytes();
        let as_json = self.http(network, listed, None).await.unwrap_err();
        let grpc = self.grpc(network, inputs, true).await.unwrap_err();
        for other in [&as_json, &grpc] {
            assert_eq!((&http.code, &http.message), (&other.code, &other.message));
        }
        http
    }
}

fn message(network: &str, inputs: &[Tensor], raw: bool) -> ModelInferRequest {
    let contents = |data: &TensorData| {
        let mut contents = InferTensorContents::default();
        match data.clone() {
            TensorData::F32(data) => contents.fp32_contents = data,
            TensorData::I64(data) => contents.int64_contents = data,
            TensorData::U8(_) => {}
        }
        contents
    };
    let one = |input: &Tensor| InferInputTensor {
        name: input.name.clone(),
        datatype: datatype(&input.data).to_owned(),
        shape: input.shape.iter().map(|size| *size as i64).collect(),
        contents: (!raw).then(|| contents(&input.data)),
        ..InferInputTensor::default()
    };
    let bytes = inputs.iter().map(|input| bytes_of(&input.data).into());
    ModelInferRequest {
        model_name: network.to_owned(),
        id: "7".to_owned(),
        inputs: inputs.iter().map(one).collect(),
        raw_input_contents: if raw { bytes.collect() } else { Vec::new() },
        ..ModelInferRequest::default()
    }
}

/// The networks of the fixture's bundle.
fn networks() -> impl Iterator<Item = &'static str> {
    NETWORKS.into_iter().filter(|network| *network != "cameras")
}

#[tokio::test]
async fn a_run_is_that_of_the_library_to_the_bit() {
    let Some(fixture) = fixture(|_| {}).await else { return };
    for network in networks() {
        let given = match network {
            "masks.decoder" => prompts(&fixture.pipeline),
            other => inputs(other),
        };
        let ran = fixture.pipeline.with_network(network, |n| n.infer(&given, &[])).unwrap();
        let wanted = found(ran);
        assert!(wanted.iter().all(|(_, shape, _, bytes)| shape[0] > 0 && !bytes.is_empty()));
        let (json, body) = binary(&given, &json!({ "parameters": { "binary_data_output": true } }));
        assert_eq!(fixture.http(network, body, Some(json)).await.unwrap(), wanted, "{network}");
        let body = listed(&given).to_string().into_bytes();
        assert_eq!(fixture.http(network, body, None).await.unwrap(), wanted, "{network} as JSON");
        for raw in [true, false] {
            let answer = fixture.grpc(network, &given, raw).await.unwrap();
            assert_eq!(answer, wanted, "{network} by gRPC, raw: {raw}");
        }
        // One output alone, the last first: as bytes and as JSON.
        let (last, first) = (wanted.last().unwrap(), &wanted[0]);
        let outputs = json!([
            { "name": last.0, "parameters": { "binary_data": true } },
            { "name": first.0, "parameters": { "binary_data": false } },
        ]);
        if last.0 != first.0 {
            let (json, body) = binary(&given, &json!({ "outputs": outputs }));
            let answer = fixture.http(network, body, Some(json)).await.unwrap();
            assert_eq!(answer, [last.clone(), first.clone()], "{network}, two outputs");
        }
        let mut asked = message(network, &given, true);
        let name = last.0.clone();
        asked.outputs = vec![InferRequestedOutputTensor { name, ..Default::default() }];
        let answer = fixture.client().await.model_infer(asked).await.unwrap().into_inner();
        assert_eq!(
            answer.raw_output_contents,
            std::slice::from_ref(&last.3),
            "{network}, one output"
        );
    }
}

#[tokio::test]
async fn the_encoder_gives_what_the_product_itself_uses() {
    let Some(fixture) = fixture(|_| {}).await else { return };
    // As large as the network's picture, so that it is not resized.
    let rgb: Vec<u8> = (0..64 * 64 * 3).map(|i| (i * 31 % 251) as u8).collect();
    let photo = Photo { width: 64, height: 64, rgb: rgb.clone(), valid: None };
    let planes = (0..3).flat_map(|c| rgb.iter().skip(c).step_by(3).copied());
    let images: Vec<f32> = planes.map(|v| f32::from(v) / 255.0).collect();
    let given = [tensor("images", &[1, 3, 64, 64], TensorData::F32(images))];
    let (json, body) = binary(&given, &json!({ "parameters": { "binary_data_output": true } }));
    let answer = fixture.http("masks.encoder", body, Some(json)).await.unwrap();
    let own = fixture.pipeline.masks().unwrap().encode(&photo).unwrap().numbers();
    assert_eq!(answer[0].3, bytes_of(&TensorData::F32(own)));
}

#[tokio::test]
async fn both_doors_say_what_is_there() {
    let Some(fixture) = fixture(|_| {}).await else { return };
    let get = async |path: &str| {
        let answer = crate::common::client().get(fixture.server.url(path)).send().await.unwrap();
        doors::json(answer).await
    };
    let mut client = fixture.client().await;
    assert_eq!(get("/v2/health/live").await.unwrap(), json!({ "live": true }));
    assert_eq!(get("/v2/health/ready").await.unwrap(), json!({ "live": true, "ready": true }));
    assert!(client.server_live(ServerLiveRequest {}).await.unwrap().into_inner().live);
    assert!(client.server_ready(ServerReadyRequest {}).await.unwrap().into_inner().ready);
    let server = client.server_metadata(ServerMetadataRequest {}).await.unwrap().into_inner();
    let told = get("/v2").await.unwrap();
    assert_eq!(told["extensions"], json!(["binary_tensor_data"]));
    assert_eq!((&told["name"], &told["version"]), (&json!(server.name), &json!(server.version)));
    for network in networks() {
        let name = network.to_owned();
        let told = get(&format!("/v2/models/{network}")).await.unwrap();
        let asked = ModelMetadataRequest { name: name.clone(), ..Default::default() };
        let said = client.model_metadata(asked).await.unwrap().into_inner();
        let sides = [(&told["inputs"], &said.inputs), (&told["outputs"], &said.outputs)];
        for (told, said) in sides {
            let of = |t: &TensorMetadata| described(&t.name, &t.shape, &t.datatype);
            assert_eq!(*told, said.iter().map(of).collect::<Value>(), "{network}");
        }
        assert_eq!(told["platform"], "onnx_onnxv1");
        let ready = get(&format!("/v2/models/{network}/ready")).await.unwrap();
        assert_eq!(ready, json!({ "name": network, "ready": true }));
        let asked = ModelReadyRequest { name, ..Default::default() };
        assert!(client.model_ready(asked).await.unwrap().into_inner().ready);
    }
    let text = get("/v2/models/image_text.text").await.unwrap();
    let of = |name: &str| json!({ "name": name, "datatype": "INT64", "shape": [-1, -1] });
    assert_eq!(text["inputs"], json!([of("input_ids"), of("attention_mask")]));
    // The protocol's name of the message, beside our own body.
    for (path, code) in [("/v2/models/nothing", "not_found"), ("/v2/nothing", "not_found")] {
        let answer = crate::common::client().get(fixture.server.url(path)).send().await.unwrap();
        let body: Value = serde_json::from_slice(&answer.bytes().await.unwrap()).unwrap();
        assert_eq!((&body["code"], &body["error"]), (&json!(code), &body["message"]), "{path}");
    }
    let unknown = get("/v2/models/nothing").await.unwrap_err();
    assert!(unknown.message.contains("geometry, geometry.many, masks.encoder"), "{unknown:?}");
    let version = ModelReadyRequest { name: "geometry".to_owned(), version: "2".to_owned() };
    assert_eq!(fault_of(client.model_ready(version).await.unwrap_err()).code, "not_found");
}

#[tokio::test]
async fn tensors_that_do_not_fit_are_refused_by_name() {
    let Some(fixture) = fixture(|_| {}).await else { return };
    type Change = Box<dyn Fn(&mut Vec<Tensor>)>;
    let change = |change: fn(&mut Vec<Tensor>)| -> Change { Box::new(change) };
    let cases: Vec<(&str, Change, &str)> = vec![
        ("image_text.image", change(|t| t[0].name = "picture".into()), "\"picture\" is unknown"),
        ("image_text.text", change(|t| drop(t.pop())), "input \"attention_mask\" is missing"),
        ("image_text.text", change(|t| t.push(t[0].clone())), "\"input_ids\" is given twice"),
        ("image_text.text", change(|t| t[0] = floats("input_ids", &[2, 3])), "must be I64"),
        ("image_text.image", change(|t| t[0] = floats("images", &[3, 16, 16])), "4 dimensions"),
        ("image_text.image", change(|t| t[0] = floats("images", &[1, 3, 16, 17])), "3 has 17"),
        ("image_text.image", change(|t| t[0] = floats("images", &[5, 3, 16, 16])), "0 has 5"),
        ("image_text.image", change(|t| t[0].shape[0] = 2), "2304 numbers; the shape"),
        ("image_text.image", change(|t| set(&mut t[0], f32::NAN)), "must be finite"),
        ("image_text.image", change(|t| set(&mut t[0], f32::INFINITY)), "must be finite"),
        ("image_text.text", change(|t| put(&mut t[0], 1 << 40)), "numbers must be 0 to"),
        ("image_text.text", change(|t| put(&mut t[0], -1)), "holds -1; numbers must be 0 to"),
        ("image_text.text", change(|t| put(&mut t[1], 2)), "numbers must be 0 to 1"),
        ("geometry", change(|t| put(&mut t[5], 2)), "numbers must be 0 to 1"),
        (
            "geometry",
            change(|t| t[0] = floats("images", &[9, 3, 32, 32])),
            "must have one of [2, 3, 4, 5, 6, 7, 8]",
        ),
        ("geometry", change(|t| t[3] = floats("near", &[3])), "\"near\" has 3 V, and input"),
        ("image_text.image", change(Vec::clear), "input \"images\" is missing"),
    ];
    for (network, change, why) in cases {
        let mut given = inputs(network);
        change(&mut given);
        let fault = match given.iter().any(|t| numbers(&t.data).to_string().contains("null")) {
            // JSON has no such numbers.
            true => fixture.grpc(network, &given, true).await.unwrap_err(),
            false => fixture.refused(network, &given).await,
        };
        assert_eq!(fault.code, "invalid_request", "{why}: {fault:?}");
        assert!(fault.message.contains(why), "{why} is not in {}", fault.message);
    }
    // What no tensor is to blame for.
    let given = inputs("image_text.image");
    let (json, body) = binary(&given, &json!({ "outputs": [{ "name": "none" }] }));
    let unknown = fixture.http("image_text.image", body, Some(json)).await.unwrap_err();
    assert!(unknown.message.contains("gives embeddings"), "{}", unknown.message);
    let (json, body) = binary(&given, &json!({}));
    for (json, body, why) in [
        (Some(json), [&*body, b"rest"].concat(), "4 bytes behind the JSON"),
        (Some(json), body[..body.len() - 1].to_vec(), "bytes are left"),
        (Some(1 << 40), body.clone(), "and the body has"),
        (None, b"{".to_vec(), "body: "),
        (None, b"{}".to_vec(), "missing field `inputs`"),
    ] {
        let fault = fixture.http("image_text.image", body, json).await.unwrap_err();
        assert_eq!(fault.code, "invalid_request");
        assert!(fault.message.contains(why), "{why} is not in {}", fault.message);
    }
}

fn set(tensor: &mut Tensor, value: f32) {
    if let TensorData::F32(data) = &mut tensor.data {
        data[5] = value;
    }
}

fn put(tensor: &mut Tensor, value: i64) {
    if let TensorData::I64(data) = &mut tensor.data {
        data[1] = value;
    }
}

#[tokio::test]
async fn a_run_has_limits() {
    let Some(fixture) = fixture(|config| {
        config.limits.inference_bytes_max = 20_000;
        config.limits.json_values_max = 50;
    })
    .await
    else {
        return;
    };
    let given = inputs("image_text.image");
    let (json, body) = binary(&given, &json!({}));
    assert!(fixture.http("image_text.image", body, Some(json)).await.is_ok(), "24 numbers");
    let geometry = listed(&inputs("geometry")[1..]).to_string().into_bytes();
    let fault = fixture.http("geometry", geometry, None).await.unwrap_err();
    assert!(fault.message.contains("values of JSON"), "{}", fault.message);
    let large = inputs("masks.encoder");
    let (json, body) = binary(&large, &json!({}));
    let fault = fixture.http("masks.encoder", body, Some(json)).await.unwrap_err();
    assert_eq!(fault.code, "limit_exceeded", "{fault:?}");
    assert!(fault.message.contains("20000 bytes"), "{}", fault.message);
    let few = self::fixture(|config| config.limits.json_values_max = 50).await.unwrap();
    let (json, body) = binary(&large, &json!({}));
    let fault = few.http("masks.encoder", body, Some(json)).await.unwrap_err();
    assert_eq!(fault.code, "limit_exceeded", "{fault:?}");
    assert!(fault.message.contains("binary_data_output=true has no such"), "{}", fault.message);
    let (json, body) = binary(&large, &json!({ "parameters": { "binary_data_output": true } }));
    assert!(few.http("masks.encoder", body, Some(json)).await.is_ok());
    let full = self::fixture(|config| config.limits.inferences_max = 0).await.unwrap();
    let fault = full.refused("image_text.image", &given).await;
    assert_eq!(
        (&*fault.code, fault.retry_after.as_deref()),
        ("overloaded", Some("1")),
        "{fault:?}"
    );
    let large = Tensor { data: TensorData::F32(vec![0.0; 5 << 20]), ..given[0].clone() };
    let asked = full.client().await.model_infer(message("image_text.image", &[large], true)).await;
    assert_eq!(fault_of(asked.unwrap_err()).code, "limit_exceeded");
}

#[tokio::test]
async fn a_run_needs_a_key_that_writes() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("keys.toml");
    let keys: BTreeMap<&str, &str> = [("reader", "read"), ("writer", "write")].into();
    let row = |(name, scope): (&str, &str)| {
        let hash = segsplat::keys::key_sha256(name);
        format!("[[key]]\nname = \"{name}\"\nsha256 = \"{hash}\"\nscopes = [\"{scope}\"]\n")
    };
    std::fs::write(&path, keys.into_iter().map(row).collect::<String>()).unwrap();
    let Some(fixture) = fixture(|config| config.keys = Some(path)).await else { return };
    let body = listed(&inputs("image_text.text")).to_string();
    let status = async |method: &str, path: &str, key: Option<&str>| {
        let method = reqwest::Method::from_bytes(method.as_bytes()).unwrap();
        let call = crate::common::client().request(method, fixture.server.url(path));
        let call = call.body(body.clone());
        let call = key.into_iter().fold(call, |call, key| call.bearer_auth(key));
        call.send().await.unwrap().status().as_u16()
    };
    let infer = "/v2/models/image_text.text/infer";
    assert_eq!(status("POST", infer, None).await, 401);
    assert_eq!(status("POST", infer, Some("reader")).await, 403);
    assert_eq!(status("POST", infer, Some("writer")).await, 200);
    assert_eq!(status("GET", "/v2/models/geometry", None).await, 401);
    assert_eq!(status("GET", "/v2/models/geometry", Some("reader")).await, 200);
    for open in ["/v2/health/live", "/v2/health/ready"] {
        assert_eq!(status("GET", open, None).await, 200, "{open}");
    }
    let mut client = fixture.client().await;
    assert!(client.server_ready(ServerReadyRequest {}).await.is_ok());
    let asked = message("image_text.text", &inputs("image_text.text"), true);
    let fault = fault_of(client.model_infer(asked.clone()).await.unwrap_err());
    assert_eq!(fault.code, "unauthenticated");
    let mut asked = tonic::Request::new(asked);
    asked.metadata_mut().insert("authorization", "Bearer reader".parse().unwrap());
    let fault = fault_of(client.model_infer(asked).await.unwrap_err());
    assert_eq!(fault.code, "permission_denied");
}
