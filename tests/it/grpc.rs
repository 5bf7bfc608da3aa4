//! The gRPC door over real sockets: a scene's life, streams, health, reflection, bad services.

use prost::Message;
use segsplat::api::grpc::{
    DESCRIPTORS,
    pb::{self, camera_spec::Pose, scene_service_client::SceneServiceClient},
};
use tonic::{
    Code, Request,
    codegen::{http::uri::PathAndQuery, tokio_stream},
    transport::Channel,
};
use tonic_health::pb::{HealthCheckRequest, health_client::HealthClient};
use tonic_reflection::pb::{v1, v1alpha};

use crate::common::{
    cpu_server::{CpuServer, upload},
    doors::{Options, channel, fault_of, messages},
};

async fn client(stand: &CpuServer) -> SceneServiceClient<Channel> {
    SceneServiceClient::new(channel(stand.addr).await)
}

async fn made(client: &mut SceneServiceClient<Channel>) -> pb::Scene {
    let sent = tokio_stream::iter(messages(&upload(), &Options::wait()));
    let scene = client.create_scene(sent).await.unwrap().into_inner();
    assert_eq!(scene.state(), pb::SceneState::Done, "{scene:?}");
    scene
}

#[tokio::test]
async fn a_scene_is_made_listed_shown_and_deleted() {
    let stand = CpuServer::start().await;
    let mut client = client(&stand).await;
    let scene = made(&mut client).await;
    assert_eq!(scene.cameras.len(), 3, "cameras of three photos");
    assert_eq!(scene.cameras[0].camera_to_world.len(), 16);
    let report = scene.report.clone().unwrap();
    assert!(report.gaussians > 100, "{report:?}");
    assert!(!scene.semantics.clone().unwrap().available);
    let id = pb::GetSceneRequest { scene_id: scene.id.clone() };
    assert_eq!(client.get_scene(id.clone()).await.unwrap().into_inner(), scene);
    let other = made(&mut client).await;

    let ask = |after: String| pb::ListScenesRequest { limit: Some(1), after };
    let first = client.list_scenes(ask(String::new())).await.unwrap().into_inner();
    assert_eq!(first.scenes[0].id, other.id, "newest first");
    let second = client.list_scenes(ask(first.next)).await.unwrap().into_inner();
    assert_eq!((second.scenes[0].id.as_str(), second.next.as_str()), (scene.id.as_str(), ""));

    client.delete_scene(pb::DeleteSceneRequest { scene_id: scene.id }).await.unwrap();
    let gone = fault_of(client.get_scene(id).await.unwrap_err());
    assert_eq!(gone.code, "scene_not_found");
}

#[tokio::test]
async fn watching_ends_with_done() {
    let stand = CpuServer::start().await;
    let mut client = client(&stand).await;
    let sent = tokio_stream::iter(messages(&upload(), &Options::default()));
    let scene = client.create_scene(sent).await.unwrap().into_inner();
    let request = pb::WatchSceneRequest { scene_id: scene.id, semantics: false, edits: false };
    let mut events = client.watch_scene(request).await.unwrap().into_inner();
    let mut states = Vec::new();
    while let Some(event) = events.message().await.unwrap() {
        assert!((0.0..=1.0).contains(&event.fraction), "{event:?}");
        states.push(event.state());
    }
    assert_eq!(states.last(), Some(&pb::SceneState::Done), "{states:?}");
    let unfinished = |state| [pb::SceneState::Queued, pb::SceneState::Running].contains(state);
    assert!(states[..states.len() - 1].iter().all(unfinished), "{states:?}");
}

#[tokio::test]
async fn many_views_stream_in_order_and_equal_single_ones() {
    let stand = CpuServer::start().await;
    let mut client = client(&stand).await;
    let id = made(&mut client).await.id;
    let between = |to: u32, t: f64| pb::CameraSpec {
        pose: Some(pb::camera_spec::Pose::Between(pb::Between { from: 0, to, t })),
        lens: None,
    };
    let options = Some(pb::ViewOptions { width: Some(40), height: Some(30), ..Default::default() });
    let request = pb::RenderViewsRequest {
        scene_id: id.clone(),
        cameras: vec![between(0, 0.0), between(2, 0.5)],
        kinds: vec![pb::Kind::Color.into(), pb::Kind::Depth.into()],
        options,
        ..Default::default()
    };
    let mut stream = client.render_views(request).await.unwrap().into_inner();
    let mut views = Vec::new();
    while let Some(view) = stream.message().await.unwrap() {
        views.push(view);
    }
    let order: Vec<_> = views.iter().map(|view| (view.camera_index, view.kind())).collect();
    let (color, depth) = (pb::Kind::Color, pb::Kind::Depth);
    assert_eq!(order, [(0, color), (0, depth), (1, color), (1, depth)]);
    assert!(views[1].depth_scale.is_some_and(|scale| scale > 0.0), "depth PNG without scale");
    let request = pb::RenderViewRequest {
        scene_id: id,
        camera: Some(between(2, 0.5)),
        options,
        ..Default::default()
    };
    let single = client.render_view(request).await.unwrap().into_inner();
    assert_eq!((single.width, single.height), (40, 30));
    assert_eq!(single.data, views[2].data, "a single view of the same camera");
    assert!(single.data.starts_with(b"\x89PNG"), "not a PNG");
}

#[tokio::test]
async fn an_export_comes_in_pieces_that_start_with_its_size() {
    let stand = CpuServer::start().await;
    let mut client = client(&stand).await;
    let scene_id = made(&mut client).await.id;
    let format = pb::ExportFormat::Ply.into();
    let request = pb::ExportRequest { scene_id, format, ..Default::default() };
    let mut chunks = client.export(request).await.unwrap().into_inner();
    let first = chunks.message().await.unwrap().unwrap();
    assert!(first.file_name.ends_with(".ply"), "{}", first.file_name);
    let mut file = first.data.to_vec();
    while let Some(chunk) = chunks.message().await.unwrap() {
        file.extend_from_slice(&chunk.data);
    }
    assert_eq!(first.size_bytes, Some(file.len() as u64));
    assert!(file.starts_with(b"ply\n"), "{:?}", &file[..16]);
}

#[tokio::test]
async fn a_picture_over_four_mebibytes_fits_one_message() {
    let stand = CpuServer::start().await;
    let mut client = client(&stand).await.max_decoding_message_size(64 << 20);
    let scene_id = made(&mut client).await.id;
    let pose = pb::camera_spec::Pose::Between(pb::Between::default());
    let request = pb::RenderViewRequest {
        scene_id,
        camera: Some(pb::CameraSpec { pose: Some(pose), lens: None }),
        options: Some(pb::ViewOptions {
            width: Some(1024),
            height: Some(768),
            format: pb::Format::Npy.into(),
            ..Default::default()
        }),
        ..Default::default()
    };
    let view = client.render_view(request).await.unwrap().into_inner();
    assert!(view.data.len() >= 4 * 1024 * 768 * 3, "{} bytes", view.data.len());
}

#[tokio::test]
async fn health_and_reflection_of_both_versions_answer() {
    let stand = CpuServer::start().await;
    let channel = channel(stand.addr).await;
    let mut health = HealthClient::new(channel.clone());
    for service in ["", "segsplat.v1.SceneService"] {
        let request = HealthCheckRequest { service: service.to_owned() };
        let status = health.check(request).await.unwrap().into_inner().status;
        assert_eq!(status, 1, "{service:?} is not SERVING");
    }

    use v1::server_reflection_request::MessageRequest;
    use v1::server_reflection_response::MessageResponse;
    let request = v1::ServerReflectionRequest {
        host: String::new(),
        message_request: Some(MessageRequest::ListServices(String::new())),
    };
    let mut client = v1::server_reflection_client::ServerReflectionClient::new(channel.clone());
    let sent = tokio_stream::iter([request]);
    let mut answers = client.server_reflection_info(sent).await.unwrap().into_inner();
    let answer = answers.message().await.unwrap().unwrap().message_response;
    let Some(MessageResponse::ListServicesResponse(list)) = answer else { panic!("{answer:?}") };
    let names: Vec<_> = list.service.iter().map(|service| service.name.as_str()).collect();
    for name in ["segsplat.v1.SceneService", "grpc.health.v1.Health"] {
        assert!(names.contains(&name), "{name} is not among {names:?}");
    }

    use v1alpha::server_reflection_request::MessageRequest as OldRequest;
    use v1alpha::server_reflection_response::MessageResponse as OldResponse;
    let symbol = "grpc.health.v1.Health".to_owned();
    let request = v1alpha::ServerReflectionRequest {
        host: String::new(),
        message_request: Some(OldRequest::FileContainingSymbol(symbol)),
    };
    let mut client = v1alpha::server_reflection_client::ServerReflectionClient::new(channel);
    let sent = tokio_stream::iter([request]);
    let mut answers = client.server_reflection_info(sent).await.unwrap().into_inner();
    let answer = answers.message().await.unwrap().unwrap().message_response;
    let file = matches!(answer, Some(OldResponse::FileDescriptorResponse(_)));
    assert!(file, "v1alpha knows nothing of health: {answer:?}");
}

#[tokio::test]
async fn unknown_services_and_methods_are_unimplemented() {
    let stand = CpuServer::start().await;
    let channel = channel(stand.addr).await;
    for path in ["/segsplat.v9.Nothing/Call", "/segsplat.v1.SceneService/Nothing"] {
        let mut grpc = tonic::client::Grpc::new(channel.clone());
        grpc.ready().await.unwrap();
        let codec = tonic_prost::ProstCodec::<pb::GetSceneRequest, pb::Scene>::default();
        let path = PathAndQuery::from_static(path);
        let request = Request::new(pb::GetSceneRequest::default());
        let status = grpc.unary(request, path.clone(), codec).await.unwrap_err();
        assert_eq!(status.code(), Code::Unimplemented, "{path}: {status:?}");
        assert_eq!(fault_of(status).code, "not_found", "{path}");
    }
}

#[tokio::test]
async fn a_message_that_is_no_protobuf_is_an_invalid_request() {
    #[derive(Clone, PartialEq, Message)]
    struct Odd {
        #[prost(uint64, tag = "1")]
        scene_id: u64,
    }
    let stand = CpuServer::start().await;
    let mut grpc = tonic::client::Grpc::new(channel(stand.addr).await);
    grpc.ready().await.unwrap();
    let codec = tonic_prost::ProstCodec::<Odd, pb::Scene>::default();
    let path = PathAndQuery::from_static("/segsplat.v1.SceneService/GetScene");
    let request = Request::new(Odd { scene_id: 7 });
    let fault = fault_of(grpc.unary(request, path, codec).await.unwrap_err());
    assert_eq!((fault.code.as_str(), fault.number), ("invalid_request", 3), "{}", fault.message);
    // tonic refuses a message of 4 GiB by its length alone.
    let client = crate::common::client_builder().http2_prior_knowledge().build().unwrap();
    let request = client.post(stand.url("/segsplat.v1.SceneService/GetScene"));
    let request = request.header("content-type", "application/grpc").header("te", "trailers");
    let answer = request.body([&[0, 255, 255, 255, 255][..], &[0; 64]].concat()).send().await;
    let answer = answer.unwrap();
    assert_eq!(answer.headers()["segsplat-code"], "limit_exceeded");
    assert_eq!(answer.headers()["grpc-status"], "3");
}

#[tokio::test]
async fn the_callers_deadline_and_request_id_are_honoured() {
    let stand = CpuServer::start().await;
    let mut client = client(&stand).await;
    let mut request = Request::new(pb::GetSceneRequest { scene_id: "0".repeat(32) });
    request.metadata_mut().insert("x-request-id", "mine-8".parse().unwrap());
    let fault = fault_of(client.get_scene(request).await.unwrap_err());
    assert_eq!(fault.request_id, "mine-8");
    // tonic's client ends such a call by itself; this one leaves it to the server.
    let path = stand.url("/segsplat.v1.SceneService/CreateScene");
    let never = tokio_stream::pending::<Result<Vec<u8>, std::io::Error>>();
    let plain = crate::common::client_builder().http2_prior_knowledge().build().unwrap();
    let request = plain.post(path).header("content-type", "application/grpc");
    let request = request.header("grpc-timeout", "20m").header("te", "trailers");
    let answer = request.body(reqwest::Body::wrap_stream(never)).send().await.unwrap();
    assert_eq!(answer.headers()["grpc-status"], "4");
    assert_eq!(answer.headers()["segsplat-code"], "deadline_exceeded");
}

#[test]
fn the_descriptors_are_those_of_the_proto_file() {
    let set = texts(DESCRIPTORS);
    for name in ["scene.proto", "SceneService", "CreateScene", "WatchScene", "ExportChunk"] {
        assert!(set.contains(name), "{name} is not in the descriptors");
    }
}

/// The descriptors' texts; enough to look for names.
fn texts(bytes: &[u8]) -> String {
    bytes.iter().map(|&b| if b.is_ascii_graphic() { b as char } else { ' ' }).collect()
}

#[tokio::test]
async fn what_a_message_lacks_is_named() {
    let stand = CpuServer::start().await;
    let mut client = client(&stand).await;
    let id = made(&mut client).await.id;
    let camera = |pose| Some(pb::CameraSpec { pose, lens: None });
    let short = pb::Matrix { values: vec![1.0; 12] };
    let from = Pose::Between(pb::Between { from: 0, to: 0, t: 0.0 });
    let format = Some(pb::ViewOptions { format: -1, ..Default::default() });
    for (camera, kind, options, word) in [
        (None, 0, None, "no camera"),
        (camera(None), 0, None, "no pose"),
        (camera(Some(Pose::CameraToWorld(short))), 0, None, "12 numbers"),
        (camera(Some(from.clone())), 99, None, "kind is 99"),
        (camera(Some(from.clone())), 0, format, "format is -1"),
        (camera(Some(from)), pb::Kind::Mask.into(), None, "mask"),
    ] {
        let scene_id = id.clone();
        let request =
            pb::RenderViewRequest { scene_id, camera, kind, options, ..Default::default() };
        let fault = client.render_view(request).await.expect_err(word);
        assert!(fault.message().contains(word), "{fault:?} lacks {word}");
    }
}
