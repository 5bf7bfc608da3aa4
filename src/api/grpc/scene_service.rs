//! `segsplat.v1.SceneService`: messages to requests, calls of the service, answers to messages.

use std::{future::ready, io, pin::Pin, sync::Arc, time::Duration};

use futures_util::{Stream, StreamExt, stream};
use prost::Message;
use tonic::{Request, Response, Status, Streaming};

use super::{
    convert::{self, not_empty},
    pb::{self, create_scene_header::Cameras},
    status::{logged, unreadable},
};
use crate::{
    api::{
        Api, Held, request_id, server_timing,
        upload::{UploadBuilder, UploadGuard, check_bundle},
    },
    error::{Error, ErrorCode, Result},
    scene::{CamerasMode, SceneId, Upload, UploadCameras},
    service::{
        AddPhotos, CreateScene, Export, PageRequest, PictureKind, SceneState, SceneStatus,
        SemanticsMode, ViewSpec, ViewTimes, ViewsSpec, WatchUntil,
    },
};

pub(super) type Answer<T> = Result<Response<T>, Status>;
/// A file in pieces, and its place among the exports.
type Chunks = (Many<pb::ExportChunk>, Option<Held>);
type Many<T> = Pin<Box<dyn Stream<Item = Result<T, Status>> + Send + 'static>>;

/// Does `work` for the caller of `request`. An error goes to the log and becomes a status.
pub(super) async fn answer<Q, A, F: Future<Output = Result<A>>>(
    api: &Api,
    request: Request<Q>,
    work: impl FnOnce(Api, Q) -> F,
) -> Answer<A> {
    let api = api.for_caller(request.extensions().get()).map_err(|e| logged(&e))?;
    let answer = work(api, request.into_inner()).await.map_err(|e| logged(&e))?;
    Ok(Response::new(answer))
}

#[tonic::async_trait]
impl pb::scene_service_server::SceneService for Api {
    type WatchSceneStream = Many<pb::SceneEvent>;
    type RenderViewsStream = Many<pb::View>;
    type ExportStream = Many<pb::ExportChunk>;
    type FeaturesStream = Many<pb::ExportChunk>;

    async fn create_scene(
        &self,
        request: Request<Streaming<pb::CreateSceneRequest>>,
    ) -> Answer<pb::Scene> {
        let request_id = request.metadata().get(request_id::HEADER);
        let request_id = request_id.and_then(|id| id.to_str().ok()).map(str::to_owned);
        answer(self, request, |api, messages| create(api, messages, request_id)).await
    }

    async fn watch_scene(
        &self,
        request: Request<pb::WatchSceneRequest>,
    ) -> Answer<Self::WatchSceneStream> {
        answer(self, request, |api, request| async move {
            let id = request.scene_id.parse()?;
            let until = WatchUntil { semantics: request.semantics, edits: request.edits };
            let events = api.service.watch_for(&id, until).await?;
            let cut_off =
                stream::once(async move { unless_whole(&api, &id, until.edits).await.err() });
            let cut_off = cut_off.filter_map(|error| ready(error.map(|e| Err(logged(&e)))));
            Ok(events.map(|event| Ok(convert::event(event))).chain(cut_off).boxed())
        })
        .await
    }

    async fn get_scene(&self, request: Request<pb::GetSceneRequest>) -> Answer<pb::Scene> {
        answer(self, request, |api, request| async move {
            Ok(convert::scene(api.service.get(&request.scene_id.parse()?).await?))
        })
        .await
    }

    async fn list_scenes(
        &self,
        request: Request<pb::ListScenesRequest>,
    ) -> Answer<pb::ListScenesResponse> {
        answer(self, request, |api, request| async move {
            let page = PageRequest {
                limit: request.limit.map(|limit| limit as usize),
                after: not_empty(request.after),
            };
            let page = api.service.list(&page).await?;
            let scenes = page.scenes.into_iter().map(convert::scene).collect();
            Ok(pb::ListScenesResponse { scenes, next: page.next.unwrap_or_default() })
        })
        .await
    }

    async fn delete_scene(
        &self,
        request: Request<pb::DeleteSceneRequest>,
    ) -> Answer<pb::DeleteSceneResponse> {
        answer(self, request, |api, request| async move {
            api.service.delete(&request.scene_id.parse()?).await?;
            Ok(pb::DeleteSceneResponse {})
        })
        .await
    }

    async fn refine_scene(&self, request: Request<pb::RefineSceneRequest>) -> Answer<pb::Scene> {
        answer(self, request, |api, request| async move {
            let refine = convert::refine(&request.refine)?.unwrap_or_default();
            Ok(convert::scene(api.service.refine(&request.scene_id.parse()?, refine).await?))
        })
        .await
    }

    async fn add_photos(
        &self,
        request: Request<Streaming<pb::AddPhotosRequest>>,
    ) -> Answer<pb::Scene> {
        answer(self, request, add_photos).await
    }

    async fn remove_photo(&self, request: Request<pb::RemovePhotoRequest>) -> Answer<pb::Scene> {
        answer(self, request, |api, request| async move {
            let pb::RemovePhotoRequest { scene_id, name, wait_ms } = request;
            let wait = wait_ms.map(Duration::from_millis);
            let left = api.service.remove_photo(&scene_id.parse()?, name, wait).await?;
            Ok(convert::scene(left))
        })
        .await
    }

    async fn get_scale(&self, request: Request<pb::GetScaleRequest>) -> Answer<pb::SceneScale> {
        answer(self, request, |api, request| async move {
            Ok(convert::scale(api.service.scale(&request.scene_id.parse()?).await?))
        })
        .await
    }

    async fn set_scale(&self, request: Request<pb::SetScaleRequest>) -> Answer<pb::SceneScale> {
        answer(self, request, |api, request| async move {
            let id = request.scene_id.parse()?;
            let wait = request.semantics_wait_ms.map(Duration::from_millis);
            let spec = convert::scale_spec(request)?;
            Ok(convert::scale(api.service.set_scale(&id, spec, wait).await?))
        })
        .await
    }

    async fn measure(&self, request: Request<pb::MeasureRequest>) -> Answer<pb::Measured> {
        answer(self, request, |api, request| async move {
            let points = convert::places(&request.points)?;
            Ok(convert::measured(api.service.measure(&request.scene_id.parse()?, points).await?))
        })
        .await
    }

    async fn get_edits(&self, request: Request<pb::GetEditsRequest>) -> Answer<pb::SceneEdits> {
        answer(self, request, |api, request| async move {
            convert::edits(api.service.edits(&request.scene_id.parse()?).await?)
        })
        .await
    }

    async fn set_edits(&self, request: Request<pb::SetEditsRequest>) -> Answer<pb::SceneEdits> {
        answer(self, request, |api, request| async move {
            let id = request.scene_id.parse()?;
            api.service.limits().check_json("edits_json", &request.edits_json)?;
            let edits = serde_json::from_slice(&request.edits_json)
                .map_err(|e| Error::invalid(format!("edits_json: {e}")).caused_by(e))?;
            let wait = request.semantics_wait_ms.map(Duration::from_millis);
            convert::edits(api.service.set_edits(&id, edits, wait).await?)
        })
        .await
    }

    async fn render_view(&self, request: Request<pb::RenderViewRequest>) -> Answer<pb::View> {
        answer(self, request, render).await.map(timed).map(held)
    }

    async fn render_views(
        &self,
        request: Request<pb::RenderViewsRequest>,
    ) -> Answer<Self::RenderViewsStream> {
        answer(self, request, render_many).await
    }

    async fn query(&self, request: Request<pb::QueryRequest>) -> Answer<pb::QueryResponse> {
        answer(self, request, |api, request| async move {
            let id = request.scene_id.parse()?;
            let answer = api.service.query(&id, convert::query(request)?).await?;
            let times = answer.times;
            Ok((weighed(&api, convert::answer(answer))?, times))
        })
        .await
        .map(timed)
        .map(held)
    }

    async fn pick(&self, request: Request<pb::PickRequest>) -> Answer<pb::PickResponse> {
        answer(self, request, |api, request| async move {
            let id = request.scene_id.parse()?;
            Ok(convert::picked(api.service.pick(&id, convert::pick(request)?).await?))
        })
        .await
    }

    async fn export(&self, request: Request<pb::ExportRequest>) -> Answer<Self::ExportStream> {
        answer(self, request, export).await.map(held)
    }

    async fn features(
        &self,
        request: Request<pb::FeaturesRequest>,
    ) -> Answer<Self::FeaturesStream> {
        answer(self, request, |api, request| async move {
            let id = request.scene_id.parse()?;
            chunks(api.service.features(&id, convert::features(request)?).await?).await
        })
        .await
        .map(held)
    }

    async fn models(&self, request: Request<pb::ModelsRequest>) -> Answer<pb::ModelsResponse> {
        answer(self, request, |api, _| async move { Ok(convert::models(api.service.models())) })
            .await
    }
}

/// Fails with `stopping` where the events of a scene have ended because the server stops.
async fn unless_whole(api: &Api, id: &SceneId, edits: bool) -> Result<()> {
    let goes_on = |status: SceneStatus| {
        let is_done = status.state == SceneState::Done;
        !status.is_settled() || status.is_refined_now() || edits && is_done
    };
    let goes_on = api.service.get(id).await.is_ok_and(goes_on);
    if goes_on && api.drain.is_stopping() {
        return Err(Error::new(ErrorCode::Stopping, "the server is stopping; watch again"));
    }
    Ok(())
}

/// A message and its bytes of the budget.
pub(super) fn weighed<T: Message>(api: &Api, message: T) -> Result<(T, Option<Held>)> {
    let bytes = api.service.answer_bytes(message.encoded_len() as u64)?;
    Ok((message, Some(Held::new(Arc::new(bytes)))))
}

/// A message, or messages, and what they hold until they are sent.
pub(super) fn held<T>(answer: Response<(T, Option<Held>)>) -> Response<T> {
    let (metadata, (message, held), mut extensions) = answer.into_parts();
    if let Some(held) = held {
        extensions.insert(held);
    }
    Response::from_parts(metadata, message, extensions)
}

/// A message with its stages as metadata.
fn timed<T>(answer: Response<(T, ViewTimes)>) -> Response<T> {
    let (message, times) = answer.into_inner();
    let mut answer = Response::new(message);
    if let Ok(value) = server_timing(times.stages()).parse() {
        answer.metadata_mut().insert("server-timing", value);
    }
    answer
}

async fn create(
    api: Api,
    messages: Streaming<pb::CreateSceneRequest>,
    request_id: Option<String>,
) -> Result<pb::Scene> {
    let (upload, header, _guard) = read_upload(&api, messages).await?;
    let wait = header.wait_ms.map(Duration::from_millis);
    let request = CreateScene {
        upload,
        options: convert::scene_options(&header)?,
        idempotency_key: not_empty(header.idempotency_key),
        wait,
        request_id,
    };
    let created = api.service.create_scene(request).await?;
    match (&created.status.error, wait) {
        (Some(error), Some(_)) => Err(error.to_error()),
        _ => Ok(convert::scene(created.status)),
    }
}

async fn add_photos(api: Api, mut messages: Streaming<pb::AddPhotosRequest>) -> Result<pb::Scene> {
    use pb::add_photos_header::Cameras;
    let limits = api.service.limits();
    let mut header = read_header(&mut messages).await?;
    // Before the photos are sent.
    let id: SceneId = header.scene_id.parse()?;
    api.service.get(&id).await?;
    let upload = UploadBuilder::new(&limits, &api.uploads).at_least(1);
    let mut upload = upload.kept_by(&api.service, Some(id.clone()));
    let cameras = header.cameras.take().map(|cameras| match cameras {
        Cameras::TransformsJson(json) => UploadCameras::Transforms(json.into()),
        Cameras::CamerasJson(json) => UploadCameras::Cameras(json.into()),
    });
    cameras.map_or(Ok(()), |cameras| upload.begin_cameras(cameras))?;
    read_pieces(&mut messages, &mut upload).await?;
    let (upload, _guard) = upload.finish().await?;
    let request = AddPhotos {
        upload,
        idempotency_key: not_empty(header.idempotency_key),
        wait: header.wait_ms.map(Duration::from_millis),
    };
    Ok(convert::scene(api.service.add_photos(&id, request).await?.status))
}

async fn read_upload(
    api: &Api,
    mut messages: Streaming<pb::CreateSceneRequest>,
) -> Result<(Upload, pb::CreateSceneHeader, UploadGuard)> {
    let limits = api.service.limits();
    let mut upload = UploadBuilder::new(&limits, &api.uploads).kept_by(&api.service, None);
    let first = read_header(&mut messages).await?;
    api.service.has_room(!first.idempotency_key.is_empty())?;
    let header = begin(api, first, &mut upload)?;
    read_pieces(&mut messages, &mut upload).await?;
    let (upload, guard) = upload.finish().await?;
    Ok((upload, header, guard))
}

/// What a message of an upload has: first a header, then pieces of files.
enum UploadPart<H> {
    Header(H),
    Photo(pb::PhotoChunk),
    Splats(pb::SplatsChunk),
    Archive(prost::bytes::Bytes),
}

/// A message of the stream of an upload.
trait UploadMessage {
    type Header;

    /// Its part; `None` if it is empty.
    fn part(self) -> Option<UploadPart<Self::Header>>;
}

impl UploadMessage for pb::CreateSceneRequest {
    type Header = pb::CreateSceneHeader;

    fn part(self) -> Option<UploadPart<Self::Header>> {
        use pb::create_scene_request::Part;
        Some(match self.part? {
            Part::Header(header) => UploadPart::Header(header),
            Part::Photo(piece) => UploadPart::Photo(piece),
            Part::Splats(piece) => UploadPart::Splats(piece),
            Part::Archive(piece) => UploadPart::Archive(piece),
        })
    }
}

impl UploadMessage for pb::AddPhotosRequest {
    type Header = pb::AddPhotosHeader;

    fn part(self) -> Option<UploadPart<Self::Header>> {
        use pb::add_photos_request::Part;
        Some(match self.part? {
            Part::Header(header) => UploadPart::Header(header),
            Part::Photo(piece) => UploadPart::Photo(piece),
            Part::Archive(piece) => UploadPart::Archive(piece),
        })
    }
}

/// The next part of an upload; `None` at its end.
async fn next_part<M: UploadMessage>(
    messages: &mut Streaming<M>,
) -> Result<Option<UploadPart<M::Header>>> {
    let next = messages.message().await.map_err(|status| unreadable(&status))?;
    let empty = || Error::invalid("upload: an empty message");
    next.map(|message| message.part().ok_or_else(empty)).transpose()
}

async fn read_header<M: UploadMessage>(messages: &mut Streaming<M>) -> Result<M::Header> {
    match next_part(messages).await? {
        Some(UploadPart::Header(header)) => Ok(header),
        Some(_) => Err(Error::invalid("upload: the first message must be the header")),
        None => Err(Error::invalid("upload: no header, nothing was sent")),
    }
}

/// Reads all that comes after the header.
async fn read_pieces<M: UploadMessage>(
    messages: &mut Streaming<M>,
    upload: &mut UploadBuilder<'_>,
) -> Result<()> {
    while let Some(part) = next_part(messages).await? {
        match part {
            UploadPart::Header(_) => return Err(Error::invalid("upload: a second header")),
            UploadPart::Photo(piece) => {
                if !piece.name.is_empty() {
                    upload.begin_photo(&piece.name).await?;
                }
                upload.extend(&piece.data).await?;
            }
            UploadPart::Splats(piece) => {
                if !piece.name.is_empty() {
                    upload.begin_splats(&piece.name).await?;
                }
                upload.extend(&piece.data).await?;
            }
            UploadPart::Archive(piece) => {
                upload.begin_archive().await?;
                upload.extend(&piece).await?;
            }
        }
    }
    Ok(())
}

/// Checks the header and takes the camera JSON out of it.
fn begin(
    api: &Api,
    mut header: pb::CreateSceneHeader,
    upload: &mut UploadBuilder<'_>,
) -> Result<pb::CreateSceneHeader> {
    convert::value::<SemanticsMode>("semantics", header.semantics)?;
    convert::value::<CamerasMode>("cameras_mode", header.cameras_mode)?;
    convert::refine(&header.refine)?;
    check_bundle(&header.bundle, api.service.bundle())?;
    let cameras = header.cameras.take().map(|cameras| match cameras {
        Cameras::TransformsJson(json) => UploadCameras::Transforms(json.into()),
        Cameras::CamerasJson(json) => UploadCameras::Cameras(json.into()),
    });
    cameras.map_or(Ok(()), |cameras| upload.begin_cameras(cameras))?;
    Ok(header)
}

async fn render(
    api: Api,
    request: pb::RenderViewRequest,
) -> Result<((pb::View, Option<Held>), ViewTimes)> {
    let id = request.scene_id.parse()?;
    let given = request.options.unwrap_or_default();
    let spec = ViewSpec {
        kind: convert::value("kind", request.kind)?,
        text: convert::text(request.text, request.scoring, request.semantics_wait_ms),
        camera: convert::camera(request.camera, "view")?,
        options: convert::options(&given)?,
        picture: convert::picture(&given)?,
    };
    let mut view = api.service.render(&id, spec).await?;
    let (held, times) = (view.held.take().map(Held::new), view.times);
    Ok(((convert::view(view), held), times))
}

async fn render_many(api: Api, request: pb::RenderViewsRequest) -> Result<Many<pb::View>> {
    let id = request.scene_id.parse()?;
    let text = convert::text(request.text, request.scoring, request.semantics_wait_ms);
    let kinds = match request.kinds.as_slice() {
        [] => vec![PictureKind::Color],
        kinds => kinds.iter().map(|kind| convert::value("kind", *kind)).collect::<Result<_>>()?,
    };
    let cameras = request.cameras.into_iter().enumerate();
    let cameras = cameras
        .map(|(i, camera)| convert::camera(Some(camera), &format!("camera {i}")))
        .collect::<Result<_>>()?;
    let given = request.options.unwrap_or_default();
    let (options, picture) = (convert::options(&given)?, convert::picture(&given)?);
    let spec = ViewsSpec { cameras, kinds, options, picture, text };
    let views = api.service.render_many(&id, &spec).await?;
    // tonic copies a message to encode it, and asks for the next one when that is sent.
    let mut _sent = None;
    let message = views.map(move |view| {
        let mut view = view.map_err(|e| logged(&e))?;
        _sent = view.held.take();
        Ok(convert::view(view))
    });
    Ok(message.boxed())
}

async fn export(api: Api, request: pb::ExportRequest) -> Result<Chunks> {
    let id = request.scene_id.parse()?;
    let text = convert::text(request.text, request.scoring, request.semantics_wait_ms);
    let format = convert::value("format", request.format)?;
    let preset = convert::given("preset", request.preset)?;
    chunks(api.service.export(&id, format, preset, &text).await?).await
}

/// A file in pieces.
async fn chunks(export: Export) -> Result<Chunks> {
    let file_name = export.file_name.clone();
    let body = export.begin().await?;
    let first = pb::ExportChunk { size_bytes: body.size_bytes, file_name, ..Default::default() };
    let piece = |data: io::Result<Vec<u8>>| match data {
        Ok(data) => Ok(pb::ExportChunk { data: data.into(), ..Default::default() }),
        Err(e) => Err(logged(&Error::internal("the file broke off").caused_by(e))),
    };
    let place = body.place.clone().map(Held::new);
    let pieces = body.into_stream().map(piece);
    Ok((stream::once(async { Ok(first) }).chain(pieces).boxed(), place))
}
