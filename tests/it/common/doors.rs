//! One client for both doors, so that a case runs through each and expects the same code.

use segsplat::{
    api::grpc::pb::{self, scene_service_client::SceneServiceClient},
    scene::{Upload, UploadCameras},
};
use serde_json::Value;
use std::{fmt::Display, net::SocketAddr};
use tonic::{
    Status,
    service::{Interceptor, interceptor::InterceptedService},
    transport::Channel,
};

/// Bytes of a photo or archive in one gRPC message.
const PIECE: usize = 256 << 10;

/// What a refused call said.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Fault {
    pub(crate) code: String,
    pub(crate) message: String,
    /// HTTP status or gRPC number.
    pub(crate) number: i32,
    pub(crate) retry_after: Option<String>,
    pub(crate) request_id: String,
}

/// One of the two doors of a server.
#[derive(Clone, Debug)]
pub(crate) enum Door {
    Http { base: String, client: reqwest::Client },
    Grpc { client: SceneServiceClient<Keyed> },
}

/// A channel whose calls show a key.
pub(crate) type Keyed = InterceptedService<Channel, Bearer>;

/// Shows a key with each gRPC call, or none.
#[derive(Clone, Debug)]
pub(crate) struct Bearer(Option<String>);

impl Interceptor for Bearer {
    fn call(&mut self, mut request: tonic::Request<()>) -> Result<tonic::Request<()>, Status> {
        if let Some(key) = &self.0 {
            let value = format!("Bearer {key}").parse().expect("keys are ASCII");
            request.metadata_mut().insert("authorization", value);
        }
        Ok(request)
    }
}

/// Both doors of the server at `addr`, with this key shown at each call.
pub(crate) async fn both_with(addr: SocketAddr, key: Option<&str>) -> [Door; 2] {
    let mut headers = reqwest::header::HeaderMap::new();
    if let Some(key) = key {
        headers.insert("authorization", format!("Bearer {key}").parse().expect("ASCII"));
    }
    let client =
        crate::common::client_builder().default_headers(headers).build().expect("a client");
    let bearer = Bearer(key.map(str::to_owned));
    let keyed = SceneServiceClient::with_interceptor(channel(addr).await, bearer);
    [Door::Http { base: format!("http://{addr}"), client }, Door::Grpc { client: keyed }]
}

/// Both doors of the server at `addr`.
pub(crate) async fn both(addr: SocketAddr) -> [Door; 2] {
    [http(addr), grpc(addr).await]
}

/// Both doors of the server at `addr`, called by the name `host` as a rebound page does.
pub(crate) async fn both_named(addr: SocketAddr, host: &str) -> [Door; 2] {
    let mut headers = reqwest::header::HeaderMap::new();
    headers.insert("host", host.parse().expect("ASCII"));
    headers.insert("origin", format!("http://{host}").parse().expect("ASCII"));
    let client = reqwest::Client::builder().default_headers(headers).build().expect("a client");
    let endpoint = Channel::from_shared(format!("http://{addr}")).expect("an address is a URI");
    let endpoint = endpoint.origin(format!("http://{host}").parse().expect("a URI"));
    let channel = endpoint.connect().await.expect("the server listens");
    let grpc = SceneServiceClient::with_interceptor(channel, Bearer(None));
    [Door::Http { base: format!("http://{addr}"), client }, Door::Grpc { client: grpc }]
}

pub(crate) fn http(addr: SocketAddr) -> Door {
    Door::Http { base: format!("http://{addr}"), client: crate::common::client() }
}

pub(crate) async fn channel(addr: SocketAddr) -> Channel {
    let endpoint = Channel::from_shared(format!("http://{addr}")).expect("an address is a URI");
    endpoint.connect().await.expect("the server listens")
}

pub(crate) async fn grpc(addr: SocketAddr) -> Door {
    let client = SceneServiceClient::with_interceptor(channel(addr).await, Bearer(None))
        .max_decoding_message_size(512 << 20)
        .max_encoding_message_size(512 << 20);
    Door::Grpc { client }
}

/// A view as `RenderView` asks for it, and as query parameters.
#[derive(Clone, Debug, Default)]
pub(crate) struct Ask {
    pub(crate) pairs: Vec<(&'static str, String)>,
}

impl Ask {
    /// From the first input camera, 64x48.
    pub(crate) fn first() -> Self {
        Self::default().with("from", 0).with("width", 64).with("height", 48)
    }

    pub(crate) fn with(mut self, name: &'static str, value: impl Display) -> Self {
        self.pairs.retain(|(known, _)| *known != name);
        self.pairs.push((name, value.to_string()));
        self
    }

    pub(crate) fn with_numbers(self, name: &'static str, numbers: &[f64]) -> Self {
        let texts: Vec<_> = numbers.iter().map(f64::to_string).collect();
        self.with(name, texts.join(","))
    }

    fn get(&self, name: &str) -> Option<&str> {
        self.pairs.iter().find(|(known, _)| *known == name).map(|(_, value)| value.as_str())
    }

    fn number<T: std::str::FromStr>(&self, name: &str) -> Option<T> {
        self.get(name).map(|text| text.parse().ok().expect("a number that gRPC can carry"))
    }

    fn numbers(&self, name: &str) -> Option<Vec<f64>> {
        let text = self.get(name)?;
        Some(text.split(',').map(|n| n.parse().expect("a number")).collect())
    }

    pub(crate) fn camera(&self) -> pb::CameraSpec {
        use pb::camera_spec::{Lens, Pose};
        let vec3 = |name| self.numbers(name).map(|v| pb::Vec3 { x: v[0], y: v[1], z: v[2] });
        let pose = if let Some(values) = self.numbers("camera_to_world") {
            Some(Pose::CameraToWorld(pb::Matrix { values }))
        } else if let Some(from) = self.number("from") {
            let (to, t) = (self.number("to").unwrap_or(from), self.number("t").unwrap_or(0.0));
            Some(Pose::Between(pb::Between { from, to, t }))
        } else if self.get("eye").is_some() {
            let (eye, target, up) = (vec3("eye"), vec3("target"), vec3("up"));
            Some(Pose::LookAt(pb::LookAt { eye, target, up }))
        } else {
            None
        };
        let focal = |fx| {
            let (fy, cx, cy) = (self.number("fy"), self.number("cx"), self.number("cy"));
            Lens::Focal(pb::Focal { fx, fy, cx, cy })
        };
        let lens = self.number("fx").map(focal).or(self.number("fov").map(Lens::Fov));
        pb::CameraSpec { pose, lens }
    }

    pub(crate) fn options(&self) -> pb::ViewOptions {
        let format = match self.get("format") {
            None => pb::Format::Unspecified,
            Some("png") => pb::Format::Png,
            Some("jpeg") => pb::Format::Jpeg,
            Some("webp") => pb::Format::Webp,
            Some("npy") => pb::Format::Npy,
            Some("rgb8") => pb::Format::Rgb8,
            Some("rgba8") => pb::Format::Rgba8,
            Some("grey8") => pb::Format::Grey8,
            Some(other) => panic!("format {other} is not in the proto"),
        };
        pb::ViewOptions {
            width: self.number("width"),
            height: self.number("height"),
            format: format.into(),
            background: self.numbers("background").map(|v| pb::Vec3 { x: v[0], y: v[1], z: v[2] }),
            antialiased: self.get("antialiased").map(|given| given == "true"),
            near: self.number("near"),
            preset: preset(self.get("preset")).into(),
            front_photos: self.number("front_photos"),
            magnify: self.number("magnify"),
            crop: self.numbers("crop").map(|v| {
                let [x, y, width, height] = [0, 1, 2, 3].map(|k| v[k] as u32);
                pb::Region { x, y, width, height }
            }),
            quality: match self.get("quality") {
                None => pb::Quality::Unspecified,
                Some("exact") => pb::Quality::Exact,
                Some("fast") => pb::Quality::Fast,
                Some(other) => panic!("quality {other} is not in the proto"),
            }
            .into(),
            error: self.number("error"),
            detail: self.number("detail").unwrap_or_default(),
        }
    }

    pub(crate) fn kind(&self) -> pb::Kind {
        match self.get("kind") {
            None => pb::Kind::Unspecified,
            Some("color") => pb::Kind::Color,
            Some("depth") => pb::Kind::Depth,
            Some("alpha") => pb::Kind::Alpha,
            Some("holes") => pb::Kind::Holes,
            Some("semantics") => pb::Kind::Semantics,
            Some("relevancy") => pb::Kind::Relevancy,
            Some("mask") => pb::Kind::Mask,
            Some(other) => panic!("kind {other} is not in the proto"),
        }
    }
}

fn preset(name: Option<&str>) -> pb::Preset {
    match name {
        None => pb::Preset::Unspecified,
        Some("default") => pb::Preset::Default,
        Some("paper") => pb::Preset::Paper,
        Some(other) => panic!("preset {other} is not in the proto"),
    }
}

/// Options of a create call.
#[derive(Clone, Debug, Default)]
pub(crate) struct Options {
    pub(crate) wait_ms: Option<u64>,
    pub(crate) semantics: Option<&'static str>,
    pub(crate) bundle: Option<&'static str>,
    pub(crate) preset: Option<&'static str>,
    pub(crate) ignore: Vec<&'static str>,
    pub(crate) idempotency_key: Option<String>,
}

impl Options {
    pub(crate) fn wait() -> Self {
        Self { wait_ms: Some(120_000), ..Self::default() }
    }
}

impl Door {
    pub(crate) fn name(&self) -> &'static str {
        match self {
            Self::Http { .. } => "http",
            Self::Grpc { .. } => "grpc",
        }
    }

    /// The number that this door answers for a row of the error table.
    pub(crate) fn number_of(&self, row: &segsplat::error::ErrorRow) -> i32 {
        match self {
            Self::Http { .. } => i32::from(row.http),
            Self::Grpc { .. } => row.grpc,
        }
    }

    /// Makes a scene; its id and state.
    pub(crate) async fn create(
        &self,
        upload: &Upload,
        options: &Options,
    ) -> Result<(String, String), Fault> {
        match self {
            Self::Http { base, client } => {
                let mut query: Vec<(&str, String)> = Vec::new();
                query.extend(options.wait_ms.map(|ms| ("wait_ms", ms.to_string())));
                query.extend(options.semantics.map(|s| ("semantics", s.to_owned())));
                query.extend(options.bundle.map(|s| ("bundle", s.to_owned())));
                query.extend(options.preset.map(|s| ("preset", s.to_owned())));
                let url = url(base, "/v1/scenes", &query);
                let words = options.ignore.iter();
                let form = words.fold(form(upload), |form, word| form.text("ignore", *word));
                let mut request = client.post(url).multipart(form);
                if let Some(key) = &options.idempotency_key {
                    request = request.header("idempotency-key", key);
                }
                let scene = json(request.send().await.expect("an answer")).await?;
                Ok((text(&scene["id"]), text(&scene["state"])))
            }
            Self::Grpc { client } => {
                let messages = tokio_stream::iter(messages(upload, options));
                let scene = client.clone().create_scene(messages).await.map_err(fault_of)?;
                let scene = scene.into_inner();
                let state = scene.state().as_str_name().trim_start_matches("SCENE_STATE_");
                let state = state.to_lowercase();
                Ok((scene.id, state))
            }
        }
    }

    /// A scene's state and warning codes.
    pub(crate) async fn get(&self, id: &str) -> Result<(String, Vec<String>), Fault> {
        match self {
            Self::Http { base, client } => {
                let url = format!("{base}/v1/scenes/{id}");
                let scene = json(client.get(url).send().await.expect("an answer")).await?;
                let warnings = scene["report"]["warnings"].as_array().cloned().unwrap_or_default();
                Ok((text(&scene["state"]), warnings.iter().map(|w| text(&w["code"])).collect()))
            }
            Self::Grpc { client } => {
                let request = pb::GetSceneRequest { scene_id: id.to_owned() };
                let scene = client.clone().get_scene(request).await.map_err(fault_of)?;
                let scene = scene.into_inner();
                let state = scene.state().as_str_name().trim_start_matches("SCENE_STATE_");
                let state = state.to_lowercase();
                let warnings = scene.report.unwrap_or_default().warnings;
                Ok((state, warnings.into_iter().map(|warning| warning.code).collect()))
            }
        }
    }

    pub(crate) async fn delete(&self, id: &str) -> Result<(), Fault> {
        match self {
            Self::Http { base, client } => {
                let url = format!("{base}/v1/scenes/{id}");
                bytes(client.delete(url).send().await.expect("an answer")).await.map(drop)
            }
            Self::Grpc { client } => {
                let request = pb::DeleteSceneRequest { scene_id: id.to_owned() };
                client.clone().delete_scene(request).await.map(drop).map_err(fault_of)
            }
        }
    }

    /// The bytes of one view.
    pub(crate) async fn view(&self, id: &str, ask: &Ask) -> Result<Vec<u8>, Fault> {
        Ok(self.bounded(id, ask).await?.0)
    }

    /// The same, and the bounds that the answer tells.
    pub(crate) async fn bounded(&self, id: &str, ask: &Ask) -> Result<(Vec<u8>, Told), Fault> {
        match self {
            Self::Http { base, client } => {
                let url = url(base, &format!("/v1/scenes/{id}/view"), &ask.pairs);
                let answer = client.get(url).send().await.expect("an answer");
                let headers = answer.headers().clone();
                let told = |name: &str| {
                    let told = headers.get(name).expect(name).to_str().expect("a text").parse();
                    told.expect("a number")
                };
                let file = bytes(answer).await?;
                Ok((file, Told { error: told("x-error"), detail: told("x-detail") }))
            }
            Self::Grpc { client } => {
                let request = pb::RenderViewRequest {
                    scene_id: id.to_owned(),
                    camera: Some(ask.camera()),
                    kind: ask.kind().into(),
                    options: Some(ask.options()),
                    text: ask.get("text").unwrap_or_default().to_owned(),
                    ..Default::default()
                };
                let view = client.clone().render_view(request).await.map_err(fault_of)?;
                let view = view.into_inner();
                let bounds = Told { error: view.error, detail: view.detail };
                Ok((view.data.to_vec(), bounds))
            }
        }
    }

    /// The bytes of an export as PLY.
    pub(crate) async fn export(&self, id: &str) -> Result<Vec<u8>, Fault> {
        self.export_as(id, "ply").await
    }

    /// The bytes of an export in this format.
    pub(crate) async fn export_as(&self, id: &str, format: &str) -> Result<Vec<u8>, Fault> {
        match self {
            Self::Http { base, client } => {
                let url = format!("{base}/v1/scenes/{id}/export?format={format}");
                bytes(client.get(url).send().await.expect("an answer")).await
            }
            Self::Grpc { client } => {
                let name = format!("EXPORT_FORMAT_{}", format.to_ascii_uppercase());
                let format = pb::ExportFormat::from_str_name(&name).expect("a format").into();
                let request =
                    pb::ExportRequest { scene_id: id.to_owned(), format, ..Default::default() };
                let chunks = client.clone().export(request).await.map_err(fault_of)?;
                let (file, size) = whole(chunks.into_inner()).await?;
                assert!(size.is_none_or(|size| size == file.len() as u64), "the size said first");
                Ok(file)
            }
        }
    }

    /// The features of a view as `Features` gives them, of the kind in the ask.
    pub(crate) async fn features(&self, id: &str, ask: &Ask) -> Result<Vec<u8>, Fault> {
        match self {
            Self::Http { base, client } => {
                let url = url(base, &format!("/v1/scenes/{id}/features"), &ask.pairs);
                bytes(client.get(url).send().await.expect("an answer")).await
            }
            Self::Grpc { client } => {
                let dense = ask.get("kind") == Some("features");
                let request = pb::FeaturesRequest {
                    scene_id: id.to_owned(),
                    camera: Some(ask.camera()),
                    options: Some(ask.options()),
                    kind: if dense { 2 } else { 0 },
                    ..Default::default()
                };
                let chunks = client.clone().features(request).await.map_err(fault_of)?;
                Ok(whole(chunks.into_inner()).await?.0)
            }
        }
    }
}

/// How far a view may be from the exact one, as its answer tells.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Told {
    pub(crate) error: f32,
    pub(crate) detail: f32,
}

/// All pieces of a file, and the size that was said.
async fn whole(
    mut chunks: tonic::Streaming<pb::ExportChunk>,
) -> Result<(Vec<u8>, Option<u64>), Fault> {
    let (mut file, mut size) = (Vec::new(), None);
    while let Some(chunk) = chunks.message().await.map_err(fault_of)? {
        size = size.or(chunk.size_bytes);
        file.extend_from_slice(&chunk.data);
    }
    Ok((file, size))
}

/// What a text found, as far as both doors say the same.
#[derive(Clone, Debug, PartialEq)]
pub(crate) struct Found {
    pub(crate) gaussians: u64,
    /// Centroid, covariance and visibility of each part.
    pub(crate) parts: Vec<Vec<f32>>,
    pub(crate) warnings: Vec<String>,
    pub(crate) area: Option<u64>,
    pub(crate) rle: Option<String>,
}

impl Door {
    /// Asks texts, with a camera where one is given.
    pub(crate) async fn query(
        &self,
        id: &str,
        texts: &[&str],
        ask: Option<&Ask>,
        wait_ms: Option<u64>,
    ) -> Result<Vec<Found>, Fault> {
        match self {
            Self::Http { base, client } => {
                let mut body = serde_json::json!({ "texts": texts, "wait_ms": wait_ms });
                if let Some(ask) = ask {
                    let mut camera = serde_json::Map::new();
                    for (name, value) in &ask.pairs {
                        let value: Value = serde_json::from_str(value).expect("a number");
                        if ["width", "height"].contains(name) {
                            body[*name] = value;
                        } else {
                            camera.insert((*name).to_owned(), value);
                        }
                    }
                    body["camera"] = camera.into();
                }
                let request = client.post(format!("{base}/v1/scenes/{id}/query")).json(&body);
                let answer = json(request.send().await.expect("an answer")).await?;
                let found = |one: &Value| Found {
                    gaussians: one["gaussians"].as_u64().expect("a count"),
                    parts: one["parts"].as_array().expect("a list").iter().map(numbers).collect(),
                    warnings: one["warnings"]
                        .as_array()
                        .expect("a list")
                        .iter()
                        .map(|warning| text(&warning["code"]))
                        .collect(),
                    area: one["view"]["area"].as_u64(),
                    rle: one["view"]["mask_rle"]["counts"].as_str().map(str::to_owned),
                };
                Ok(answer["results"].as_array().expect("a list").iter().map(found).collect())
            }
            Self::Grpc { client } => {
                let request = pb::QueryRequest {
                    scene_id: id.to_owned(),
                    texts: texts.iter().map(|&text| text.to_owned()).collect(),
                    camera: ask.map(Ask::camera),
                    options: ask.map(Ask::options),
                    semantics_wait_ms: wait_ms,
                    ..Default::default()
                };
                let answer = client.clone().query(request).await.map_err(fault_of)?.into_inner();
                let found = |one: pb::TextResult| Found {
                    gaussians: one.gaussians,
                    parts: one.parts.into_iter().map(moments).collect(),
                    warnings: one.warnings.into_iter().map(|warning| warning.code).collect(),
                    area: one.view.as_ref().map(|view| view.area),
                    rle: one.view.map(|view| view.mask_rle),
                };
                Ok(answer.results.into_iter().map(found).collect())
            }
        }
    }

    /// What lies under a pixel: the Gaussian, its entry, the labels from the best.
    pub(crate) async fn pick(
        &self,
        id: &str,
        ask: &Ask,
        at: [f64; 2],
        labels: &[&str],
    ) -> Result<(Option<u64>, Option<u64>, Vec<String>), Fault> {
        let [x, y] = at;
        match self {
            Self::Http { base, client } => {
                let mut pairs = ask.pairs.clone();
                pairs.extend([("x", x.to_string()), ("y", y.to_string())]);
                pairs.extend(labels.iter().map(|label| ("label", (*label).to_owned())));
                let url = url(base, &format!("/v1/scenes/{id}/pick"), &pairs);
                let picked = json(client.get(url).send().await.expect("an answer")).await?;
                let labels = picked["labels"].as_array().expect("a list");
                let labels = labels.iter().map(|label| text(&label["text"])).collect();
                Ok((picked["gaussian"].as_u64(), picked["entry"].as_u64(), labels))
            }
            Self::Grpc { client } => {
                let request = pb::PickRequest {
                    scene_id: id.to_owned(),
                    camera: Some(ask.camera()),
                    x,
                    y,
                    options: Some(ask.options()),
                    labels: labels.iter().map(|&label| label.to_owned()).collect(),
                    ..Default::default()
                };
                let picked = client.clone().pick(request).await.map_err(fault_of)?.into_inner();
                let labels = picked.labels.into_iter().map(|label| label.text).collect();
                Ok((picked.gaussian, picked.entry.map(u64::from), labels))
            }
        }
    }
}

/// `base` + `path` + the pairs, percent-encoded.
pub(crate) fn url(base: &str, path: &str, pairs: &[(&str, String)]) -> reqwest::Url {
    let mut url = reqwest::Url::parse(&format!("{base}{path}")).expect("a URL");
    if !pairs.is_empty() {
        url.query_pairs_mut().extend_pairs(pairs);
    }
    url
}

/// An upload as a multipart form.
pub(crate) fn form(upload: &Upload) -> reqwest::multipart::Form {
    let part = |bytes: &[u8]| reqwest::multipart::Part::bytes(bytes.to_vec());
    // Names as curl and browsers send them, slashes and all.
    let mut form = reqwest::multipart::Form::new().percent_encode_noop();
    match &upload.cameras {
        None => {}
        Some(UploadCameras::Transforms(json)) => form = form.part("transforms", part(json)),
        Some(UploadCameras::Cameras(json)) => form = form.part("cameras", part(json)),
    }
    if let Some(archive) = &upload.archive {
        form = form.part("archive", part(archive));
    }
    if let Some(file) = &upload.splats {
        form = form.part("splats", part(&file.bytes).file_name(file.name.clone()));
    }
    upload.photos.iter().fold(form, |form, photo| {
        let file = photo.name.rsplit('/').next().unwrap_or_default().to_owned();
        form.part(photo.name.clone(), part(&photo.bytes).file_name(file))
    })
}

/// Photos of a scene with a `transforms.json`, as the messages of `AddPhotos`.
pub(crate) fn adding(upload: &Upload, scene_id: &str, key: &str) -> Vec<pb::AddPhotosRequest> {
    use pb::{add_photos_header::Cameras, add_photos_request::Part};
    let Some(UploadCameras::Transforms(json)) = &upload.cameras else { panic!("no transforms") };
    let header = pb::AddPhotosHeader {
        scene_id: scene_id.to_owned(),
        cameras: Some(Cameras::TransformsJson(json.clone().into())),
        wait_ms: Some(60_000),
        idempotency_key: key.to_owned(),
    };
    let piece = |photo: &segsplat::scene::UploadFile| {
        let (name, data) = (photo.name.clone(), photo.bytes.clone().into());
        Part::Photo(pb::PhotoChunk { name, data })
    };
    let parts = std::iter::once(Part::Header(header)).chain(upload.photos.iter().map(piece));
    parts.map(|part| pb::AddPhotosRequest { part: Some(part) }).collect()
}

/// An upload as the messages of `CreateScene`.
pub(crate) fn messages(upload: &Upload, options: &Options) -> Vec<pb::CreateSceneRequest> {
    use pb::{create_scene_header::Cameras, create_scene_request::Part};
    let cameras = upload.cameras.as_ref().map(|cameras| match cameras {
        UploadCameras::Transforms(json) => Cameras::TransformsJson(json.clone().into()),
        UploadCameras::Cameras(json) => Cameras::CamerasJson(json.clone().into()),
    });
    let semantics = match options.semantics {
        None => pb::Semantics::Unspecified,
        Some("lazy") => pb::Semantics::Lazy,
        Some("eager") => pb::Semantics::Eager,
        Some("off") => pb::Semantics::Off,
        Some(other) => panic!("semantics {other} is not in the proto"),
    };
    let header = pb::CreateSceneHeader {
        cameras,
        semantics: semantics.into(),
        bundle: options.bundle.unwrap_or_default().to_owned(),
        max_views: None,
        method: options
            .preset
            .map(|name| pb::Method { preset: preset(Some(name)).into(), ..pb::Method::default() }),
        refine: String::new(),
        cameras_mode: pb::CamerasMode::Unspecified.into(),
        wait_ms: options.wait_ms,
        idempotency_key: options.idempotency_key.clone().unwrap_or_default(),
        ignore: options.ignore.iter().map(|word| (*word).to_owned()).collect(),
    };
    let mut parts = vec![Part::Header(header)];
    for photo in &upload.photos {
        let mut name = photo.name.clone();
        if photo.bytes.is_empty() {
            parts.push(Part::Photo(pb::PhotoChunk { name: name.clone(), data: Vec::new().into() }));
        }
        for piece in photo.bytes.chunks(PIECE) {
            let name = std::mem::take(&mut name);
            parts.push(Part::Photo(pb::PhotoChunk { name, data: piece.to_vec().into() }));
        }
    }
    for piece in upload.archive.iter().flat_map(|archive| archive.chunks(PIECE)) {
        parts.push(Part::Archive(piece.to_vec().into()));
    }
    if let Some(file) = &upload.splats {
        let mut name = file.name.clone();
        for piece in file.bytes.chunks(PIECE) {
            let name = std::mem::take(&mut name);
            parts.push(Part::Splats(pb::SplatsChunk { name, data: piece.to_vec().into() }));
        }
    }
    parts.into_iter().map(|part| pb::CreateSceneRequest { part: Some(part) }).collect()
}

/// The body of a good answer, or the fault of a bad one.
pub(crate) async fn bytes(answer: reqwest::Response) -> Result<Vec<u8>, Fault> {
    let (status, headers) = (answer.status(), answer.headers().clone());
    let body = answer.bytes().await.expect("a whole body").to_vec();
    if status.is_success() || status.as_u16() == 304 {
        return Ok(body);
    }
    let value: Value = serde_json::from_slice(&body).unwrap_or_else(|e| {
        panic!("{status} without our body: {e}: {}", String::from_utf8_lossy(&body))
    });
    let header = |name: &str| headers.get(name).map(|v| v.to_str().unwrap().to_owned());
    assert_eq!(Some(text(&value["request_id"])), header("x-request-id"), "two request ids");
    assert!(value["details"].is_object(), "no details in {value}");
    Err(Fault {
        code: text(&value["code"]),
        message: text(&value["message"]),
        number: i32::from(status.as_u16()),
        retry_after: header("retry-after"),
        request_id: text(&value["request_id"]),
    })
}

/// The JSON of a good answer.
pub(crate) async fn json(answer: reqwest::Response) -> Result<Value, Fault> {
    Ok(serde_json::from_slice(&bytes(answer).await?).expect("JSON"))
}

/// The fault of a gRPC status.
#[expect(clippy::needless_pass_by_value, reason = "goes into map_err as it is")]
pub(crate) fn fault_of(status: tonic::Status) -> Fault {
    let key = |name: &str| {
        status.metadata().get(name).map(|value| value.to_str().expect("ASCII").to_owned())
    };
    Fault {
        code: key("segsplat-code").unwrap_or_else(|| panic!("no segsplat-code: {status:?}")),
        message: status.message().to_owned(),
        number: status.code() as i32,
        retry_after: key("retry-after"),
        request_id: key("x-request-id").unwrap_or_default(),
    }
}

/// Centroid, covariance and visibility of a part.
fn moments(part: pb::Part) -> Vec<f32> {
    let pb::Vec3 { x, y, z } = part.centroid.expect("a centroid");
    let moments = [x, y, z].into_iter().chain(part.covariance).map(|v| v as f32);
    moments.chain(part.visibility).collect()
}

/// The same of JSON.
fn numbers(part: &Value) -> Vec<f32> {
    fn leaves(value: &Value, found: &mut Vec<f32>) {
        match value {
            Value::Array(values) => values.iter().for_each(|value| leaves(value, found)),
            number => found.push(number.as_f64().expect("a number") as f32),
        }
    }
    let mut found = Vec::new();
    for name in ["centroid", "covariance", "visibility"] {
        leaves(&part[name], &mut found);
    }
    found
}

fn text(value: &Value) -> String {
    value.as_str().unwrap_or_else(|| panic!("{value} is not a text")).to_owned()
}
