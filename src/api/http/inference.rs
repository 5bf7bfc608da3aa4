//! The Open Inference Protocol, version 2, with the extension for tensors as bytes: each network of
//! the bundle as a model. `docs/adr/0053-networks-by-the-open-inference-protocol.md`.

use axum::{
    Json,
    body::Bytes,
    extract::{FromRequest, Path, Request, State},
    http::{HeaderName, header},
    response::{IntoResponse, Response},
};
use futures_util::StreamExt;
use serde::{Deserialize, Serialize, Serializer};
use serde_json::{Map, Value};
use utoipa::ToSchema;

use super::{
    error::ApiError, extract::CallerApi, fields::Fields, headers::text_of, health::status,
    multipart::read_on,
};
use crate::{
    api::{
        Api,
        inference::{
            EXTENSIONS, PLATFORM, SERVER, datatype, kind_of, of_bytes, shape_of, to_bytes,
        },
        upload::UploadGuard,
    },
    error::{Error, Result, short},
    limits::Limits,
    models::{Tensor, TensorData, TensorKind, TensorSpec},
    service::InferSpec,
};

/// Bytes of JSON before the tensors, of a request and of an answer.
const JSON_LENGTH: HeaderName = HeaderName::from_static("inference-header-content-length");

/// Whether the server answers, and whether its networks are open.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ServerHealth {
    /// True.
    live: bool,
    /// Whether the networks are open; not in the answer of `live`.
    #[serde(skip_serializing_if = "Option::is_none")]
    ready: Option<bool>,
}

/// What the server is.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ServerMetadata {
    /// `segsplat`.
    name: &'static str,
    /// Version of the server.
    version: &'static str,
    /// Extensions of the protocol: `binary_tensor_data`.
    extensions: [&'static str; 1],
}

/// What a network takes and gives.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ModelMetadata {
    /// Name of the network, as in `/v1/models`.
    name: String,
    /// `onnx_onnxv1`.
    platform: &'static str,
    /// What it takes, all of it.
    inputs: Vec<TensorMetadata>,
    /// What it gives.
    outputs: Vec<TensorMetadata>,
}

/// A tensor of a network.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct TensorMetadata {
    /// Its name.
    name: String,
    /// `FP32`, `INT64` or `UINT8`.
    datatype: &'static str,
    /// Size of each dimension; -1 where it is free.
    shape: Vec<i64>,
}

/// Whether a network can be run.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct ModelReadiness {
    /// Name of the network.
    name: String,
    /// Whether it is open, or opens at its first run.
    ready: bool,
}

/// A run of a network.
#[derive(Debug, Deserialize, ToSchema)]
pub(super) struct InferRequest {
    /// Comes back in the answer.
    id: Option<String>,
    /// `binary_data_output`: whether outputs that say nothing of their own come as bytes.
    #[serde(default)]
    parameters: Map<String, Value>,
    /// The inputs of the network, each once.
    inputs: Vec<InferInput>,
    /// The outputs to give; none: all.
    #[serde(default)]
    outputs: Vec<InferOutput>,
}

/// A tensor that goes in.
#[derive(Debug, Deserialize, ToSchema)]
pub(super) struct InferInput {
    /// Name of the input.
    name: String,
    /// Size of each dimension.
    shape: Vec<i64>,
    /// `FP32` or `INT64`.
    datatype: String,
    /// `binary_data_size`: its bytes behind the JSON, in the order of the inputs; little-endian.
    #[serde(default)]
    parameters: Map<String, Value>,
    /// Its numbers, row-major, in lists of any depth, where they are not behind the JSON.
    #[serde(default)]
    data: Value,
}

/// An output that is asked for.
#[derive(Debug, Deserialize, ToSchema)]
pub(super) struct InferOutput {
    /// Name of the output.
    name: String,
    /// `binary_data`: whether it comes as bytes behind the JSON.
    #[serde(default)]
    parameters: Map<String, Value>,
}

/// What a network gave.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct InferResponse {
    /// Name of the network.
    model_name: String,
    /// That of the request.
    #[serde(skip_serializing_if = "Option::is_none")]
    id: Option<String>,
    /// The outputs, in the order in which they were asked for.
    outputs: Vec<InferredTensor>,
}

/// A tensor that came out.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct InferredTensor {
    /// Name of the output.
    name: String,
    /// Size of each dimension.
    shape: Vec<usize>,
    /// `FP32` or `UINT8`.
    datatype: &'static str,
    /// `binary_data_size`: its bytes behind the JSON, in the order of the outputs; little-endian.
    #[serde(skip_serializing_if = "Option::is_none")]
    parameters: Option<BinarySize>,
    /// Its numbers, row-major, where they are not behind the JSON.
    #[serde(skip_serializing_if = "Option::is_none", serialize_with = "flat")]
    #[schema(value_type = Option<Vec<f32>>)]
    data: Option<TensorData>,
}

/// Where the numbers of a tensor are.
#[derive(Debug, Serialize, ToSchema)]
pub(super) struct BinarySize {
    /// Bytes behind the JSON.
    binary_data_size: usize,
}

#[expect(clippy::ref_option, reason = "serde calls it so")]
fn flat<S: Serializer>(data: &Option<TensorData>, to: S) -> Result<S::Ok, S::Error> {
    match data {
        Some(TensorData::F32(data)) => data.serialize(to),
        Some(TensorData::I64(data)) => data.serialize(to),
        Some(TensorData::U8(data)) => data.serialize(to),
        None => to.serialize_none(),
    }
}

/// Whether the server answers, by the Open Inference Protocol
#[utoipa::path(
    get, path = "/v2/health/live", operation_id = "server_live", tag = "inference",
    responses((status = 200, description = "It answers", body = ServerHealth))
)]
pub(super) async fn server_live() -> Json<ServerHealth> {
    Json(ServerHealth { live: true, ready: None })
}

/// Whether the networks can be run: 200, else 503 with the same body
#[utoipa::path(
    get, path = "/v2/health/ready", operation_id = "server_ready", tag = "inference",
    responses(
        (status = 200, description = "They can be run", body = ServerHealth),
        (status = 503, description = "Not now", body = ServerHealth),
    )
)]
pub(super) async fn server_ready(State(api): State<Api>) -> Response {
    let ready = api.networks_ready();
    (status(ready), Json(ServerHealth { live: true, ready: Some(ready) })).into_response()
}

/// What the server is, by the Open Inference Protocol
#[utoipa::path(
    get, path = "/v2", operation_id = "server_metadata", tag = "inference",
    responses((status = 200, description = "Name and extensions", body = ServerMetadata))
)]
pub(super) async fn server_metadata(fields: Fields) -> Result<Json<ServerMetadata>, ApiError> {
    fields.finish()?;
    let version = env!("CARGO_PKG_VERSION");
    Ok(Json(ServerMetadata { name: SERVER, version, extensions: EXTENSIONS }))
}

/// The tensors of a network
#[utoipa::path(
    get, path = "/v2/models/{name}", operation_id = "model_metadata", tag = "inference",
    params(("name" = String, Path, description = "Name of the network, as in `/v1/models`")),
    responses((status = 200, description = "What it takes and gives", body = ModelMetadata))
)]
pub(super) async fn model_metadata(
    CallerApi(api): CallerApi,
    Path(name): Path<String>,
    fields: Fields,
) -> Result<Json<ModelMetadata>, ApiError> {
    fields.finish()?;
    let tensors = api.service.network_tensors(&name).await?;
    let all = |specs: Vec<TensorSpec>| specs.into_iter().map(metadata).collect();
    let (inputs, outputs) = (all(tensors.inputs), all(tensors.outputs));
    Ok(Json(ModelMetadata { name, platform: PLATFORM, inputs, outputs }))
}

fn metadata(TensorSpec { name, kind, shape, .. }: TensorSpec) -> TensorMetadata {
    TensorMetadata { name, datatype: datatype(kind), shape }
}

/// Whether a network can be run: 200, else 503 with the same body
#[utoipa::path(
    get, path = "/v2/models/{name}/ready", operation_id = "model_ready", tag = "inference",
    params(("name" = String, Path, description = "Name of the network, as in `/v1/models`")),
    responses(
        (status = 200, description = "It can be run", body = ModelReadiness),
        (status = 503, description = "Not now", body = ModelReadiness),
    )
)]
pub(super) async fn model_ready(
    CallerApi(api): CallerApi,
    Path(name): Path<String>,
    fields: Fields,
) -> Result<Response, ApiError> {
    fields.finish()?;
    let ready = api.service.network_ready(&name)?;
    Ok((status(ready), Json(ModelReadiness { name, ready })).into_response())
}

/// Run a network
///
/// The body is JSON, or JSON with the bytes of tensors behind it: then the header
/// `Inference-Header-Content-Length` says how many bytes the JSON has. So is the answer.
#[utoipa::path(
    post, path = "/v2/models/{name}/infer", operation_id = "model_infer", tag = "inference",
    params(
        ("name" = String, Path, description = "Name of the network, as in `/v1/models`"),
        ("Inference-Header-Content-Length" = Option<u64>, Header,
            description = "Bytes of the JSON, where tensors are behind it"),
    ),
    request_body(content = InferRequest, content_type = "application/json"),
    responses((status = 200, description = "What it gave", body = InferResponse))
)]
pub(super) async fn model_infer(
    CallerApi(api): CallerApi,
    Path(network): Path<String>,
    fields: Fields,
    body: InferBody,
) -> Result<Response, ApiError> {
    fields.finish()?;
    let InferBody { request, inputs, _held } = body;
    let as_bytes = flag(&request.parameters, "binary_data_output")?.unwrap_or(false);
    let own = |output: &InferOutput| flag(&output.parameters, "binary_data");
    let own = request.outputs.iter().map(own).collect::<Result<Vec<_>>>()?;
    let outputs = request.outputs.into_iter().map(|output| output.name).collect();
    let found = api.service.infer(InferSpec { network: network.clone(), inputs, outputs }).await?;
    let as_bytes = |i: usize| own.get(i).copied().flatten().unwrap_or(as_bytes);
    answer(network, request.id, found, as_bytes, &api.service.limits())
}

/// Writes the answer; `as_bytes` says whether an output comes behind the JSON.
fn answer(
    model_name: String,
    id: Option<String>,
    found: Vec<Tensor>,
    as_bytes: impl Fn(usize) -> bool,
    limits: &Limits,
) -> Result<Response, ApiError> {
    let (mut behind, mut listed) = (Vec::new(), 0);
    let mut outputs = Vec::with_capacity(found.len());
    for (i, Tensor { name, shape, data }) in found.into_iter().enumerate() {
        let datatype = datatype(data.kind());
        let (mut parameters, mut left) = (None, None);
        if as_bytes(i) {
            let bytes = to_bytes(&data);
            parameters = Some(BinarySize { binary_data_size: bytes.len() });
            behind.extend(bytes);
        } else {
            listed += data.len();
            left = Some(data);
        }
        outputs.push(InferredTensor { name, shape, datatype, parameters, data: left });
    }
    let max = limits.json_values_max;
    if listed > max {
        let what = "outputs as JSON (binary_data_output=true has no such limit)";
        return Err(Error::limit(what, format!("{listed} numbers"), max).into());
    }
    let told = InferResponse { model_name, id, outputs };
    if behind.is_empty() {
        return Ok(Json(told).into_response());
    }
    let json = serde_json::to_vec(&told).map_err(|e| Error::internal("JSON").caused_by(e))?;
    let head = [(JSON_LENGTH, json.len().to_string())];
    let kind = [(header::CONTENT_TYPE, "application/octet-stream")];
    Ok((head, kind, [json, behind].concat()).into_response())
}

/// The body of a run, read and counted against the budget of uploads.
pub(super) struct InferBody {
    request: InferRequest,
    inputs: Vec<Tensor>,
    _held: UploadGuard,
}

impl FromRequest<Api> for InferBody {
    type Rejection = ApiError;

    async fn from_request(request: Request, api: &Api) -> Result<Self, ApiError> {
        let limits = api.service.limits();
        let max = api.service.config().limits.inference_bytes_max;
        let json = text_of(request.headers(), JSON_LENGTH.as_str());
        let json = json.map(|text| {
            text.parse::<usize>().map_err(|_| {
                let must = "it must be a number of bytes";
                Error::invalid(format!("{JSON_LENGTH} is {:?}; {must}", short(text)))
            })
        });
        let json = json.transpose()?;
        let mut body = request.into_body().into_data_stream();
        let (mut bytes, mut held) = (Vec::new(), UploadGuard::new(&api.uploads));
        while let Some(piece) = body.next().await {
            let piece: Bytes =
                piece.map_err(|e| Error::invalid("body: the upload broke off").caused_by(e))?;
            if let Err(error) = held.account("body", piece.len(), max) {
                read_on(body);
                return Err(error.into());
            }
            bytes.extend_from_slice(&piece);
        }
        let (json, behind) = split(&bytes, json)?;
        limits.check_json("body", json)?;
        let mut request: InferRequest =
            serde_json::from_slice(json).map_err(|e| Error::invalid(format!("body: {e}")))?;
        let inputs = std::mem::take(&mut request.inputs);
        Ok(Self { inputs: tensors(inputs, behind)?, request, _held: held })
    }
}

/// The JSON, and the bytes behind it.
fn split(bytes: &[u8], json: Option<usize>) -> Result<(&[u8], &[u8])> {
    bytes.split_at_checked(json.unwrap_or(bytes.len())).ok_or_else(|| {
        let (json, all) = (json.unwrap_or_default(), bytes.len());
        Error::invalid(format!("{JSON_LENGTH} is {json}, and the body has {all} bytes"))
    })
}

/// The inputs with their numbers, of the JSON or of the bytes behind it.
fn tensors(inputs: Vec<InferInput>, mut behind: &[u8]) -> Result<Vec<Tensor>> {
    let mut tensors = Vec::with_capacity(inputs.len());
    for InferInput { name, shape, datatype, parameters, data } in inputs {
        let what = format!("input {:?}", short(&name));
        let kind = kind_of(&what, &datatype)?;
        if let Some(other) = parameters.keys().find(|key| *key != "binary_data_size") {
            let why = format!("{what} has the parameter {:?}, which is not known", short(other));
            return Err(Error::invalid(why));
        }
        let data = match (parameters.get("binary_data_size"), data) {
            (Some(size), Value::Null) => {
                let size = size.as_u64().and_then(|size| usize::try_from(size).ok());
                let taken =
                    size.and_then(|size| behind.split_at_checked(size)).ok_or_else(|| {
                        let (size, left) = (&parameters["binary_data_size"], behind.len());
                        let why =
                            format!("{what}: binary_data_size is {size}; {left} bytes are left");
                        Error::invalid(why)
                    })?;
                behind = taken.1;
                of_bytes(&what, kind, taken.0)?
            }
            (Some(_), _) => {
                let why = format!("{what} has both data and binary_data_size");
                return Err(Error::invalid(why));
            }
            (None, data) => of_json(&what, kind, &data)?,
        };
        tensors.push(Tensor { shape: shape_of(&what, &shape)?, name, data });
    }
    if behind.is_empty() {
        return Ok(tensors);
    }
    let left = behind.len();
    Err(Error::invalid(format!("body: {left} bytes behind the JSON belong to no input")))
}

/// Numbers in lists of any depth.
fn of_json(what: &str, kind: TensorKind, data: &Value) -> Result<TensorData> {
    fn leaves(data: &Value, found: &mut impl FnMut(&Value) -> Option<()>) -> Option<()> {
        match data {
            Value::Array(rows) => rows.iter().try_for_each(|row| leaves(row, found)),
            leaf => found(leaf),
        }
    }
    let mut numbers = match kind {
        TensorKind::F32 => TensorData::F32(Vec::new()),
        TensorKind::I64 => TensorData::I64(Vec::new()),
        TensorKind::U8 => TensorData::U8(Vec::new()),
    };
    let mut wrong = None;
    leaves(data, &mut |leaf| {
        wrong = Some(leaf.to_string());
        match &mut numbers {
            #[expect(clippy::cast_possible_truncation, reason = "too large ones become infinite")]
            TensorData::F32(to) => to.push(leaf.as_f64()? as f32),
            TensorData::I64(to) => to.push(leaf.as_i64()?),
            TensorData::U8(to) => to.push(u8::try_from(leaf.as_u64()?).ok()?),
        }
        Some(())
    })
    .map(|()| numbers)
    .ok_or_else(|| {
        let (found, kind) = (wrong.unwrap_or_default(), datatype(kind));
        Error::invalid(format!("{what}: data holds {}, which is no {kind}", short(&found)))
    })
}

/// A parameter that is true or false.
fn flag(parameters: &Map<String, Value>, name: &str) -> Result<Option<bool>> {
    let Some(value) = parameters.get(name) else { return Ok(None) };
    let must = || {
        Error::invalid(format!("{name} is {}; it must be true or false", short(&value.to_string())))
    };
    value.as_bool().map(Some).ok_or_else(must)
}
