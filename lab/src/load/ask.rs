//! A view as a caller asks for it.

use reqwest::header;
use segsplat::api::grpc::pb;
use serde_json::{Value, json};

use super::door::{Answer, Connection, answer};
use crate::{
    error::{Error, Result},
    scene::Camera,
};

/// What all views of a row share.
#[derive(Clone, Debug)]
pub(super) struct Ask {
    /// Id of the scene.
    pub(super) scene: String,
    pub(super) kind: String,
    pub(super) format: String,
    /// For kinds that answer a text.
    pub(super) text: String,
    /// More parameters of the query string.
    pub(super) more: String,
}

impl Ask {
    /// Asks for the view of this camera. `etag` makes the answer 304 where it is the view's.
    pub(super) async fn view(
        &self,
        connection: &mut Connection,
        camera: &Camera,
        etag: Option<String>,
    ) -> Result<Answer> {
        match connection {
            Connection::Grpc(_) => connection.render(self.message(camera)?).await,
            Connection::Http(..) => {
                let request = connection.get(&self.target(camera))?;
                let unless = etag.map(|etag| (header::IF_NONE_MATCH, etag));
                answer(unless.into_iter().fold(request, |r, (name, etag)| r.header(name, etag)))
                    .await
            }
        }
    }

    /// Asks for the views of many cameras in one call.
    pub(super) async fn views(
        &self,
        connection: &mut Connection,
        cameras: &[Camera],
    ) -> Result<Answer> {
        let answer = match connection {
            Connection::Grpc(_) => connection.render_many(self.messages(cameras)?).await?,
            Connection::Http(..) => {
                let request = connection.post(&format!("/v1/scenes/{}/views", self.scene))?;
                answer(request.json(&self.posted(cameras))).await?.parted()?
            }
        };
        if answer.bytes.len() != cameras.len() {
            let (views, cameras) = (answer.bytes.len(), cameras.len());
            return Err(Error::internal(format!("{views} views of {cameras} cameras")));
        }
        Ok(answer)
    }

    fn posted(&self, cameras: &[Camera]) -> Value {
        let fields = cameras.iter().map(|camera| {
            let lens = camera.intrinsics;
            let pose = camera.camera_to_world.to_row_major();
            json!({
                "camera_to_world": pose.as_slice(),
                "fx": lens.fx, "fy": lens.fy, "cx": lens.cx, "cy": lens.cy,
            })
        });
        let mut body = json!({
            "cameras": fields.collect::<Vec<_>>(),
            "kinds": [self.kind],
            "format": self.format,
        });
        if let Some(camera) = cameras.first() {
            body["width"] = json!(camera.intrinsics.width);
            body["height"] = json!(camera.intrinsics.height);
        }
        if self.takes_text() {
            body["text"] = json!(self.text);
        }
        body
    }

    fn messages(&self, cameras: &[Camera]) -> Result<pb::RenderViewsRequest> {
        let each: Vec<_> = cameras.iter().map(|c| self.message(c)).collect::<Result<_>>()?;
        let first = each.first().cloned().unwrap_or_default();
        Ok(pb::RenderViewsRequest {
            scene_id: first.scene_id,
            cameras: each.into_iter().filter_map(|one| one.camera).collect(),
            kinds: vec![first.kind],
            options: first.options,
            text: first.text,
            ..Default::default()
        })
    }

    /// Whether the kind answers a text.
    fn takes_text(&self) -> bool {
        matches!(self.kind.as_str(), "mask" | "relevancy")
    }

    fn target(&self, camera: &Camera) -> String {
        let pose = camera.camera_to_world.to_row_major().map(|v| v.to_string()).join(",");
        let lens = camera.intrinsics;
        let text = match self.takes_text() {
            true => format!("&text={}", escaped(&self.text)),
            false => String::new(),
        };
        format!(
            "/v1/scenes/{}/view?camera_to_world={pose}&fx={}&fy={}&cx={}&cy={}&width={}&height={}\
             &kind={}&format={}{text}{}",
            self.scene,
            lens.fx,
            lens.fy,
            lens.cx,
            lens.cy,
            lens.width,
            lens.height,
            self.kind,
            self.format,
            self.more,
        )
    }

    fn message(&self, camera: &Camera) -> Result<pb::RenderViewRequest> {
        let lens = camera.intrinsics;
        let named = |name: &str, of: &str| {
            Error::invalid(format!("{name} is {of:?}; the messages have no such value"))
        };
        let kind = pb::Kind::from_str_name(&format!("KIND_{}", self.kind.to_uppercase()));
        let format = pb::Format::from_str_name(&format!("FORMAT_{}", self.format.to_uppercase()));
        let values = camera.camera_to_world.to_row_major().to_vec();
        let focal =
            pb::Focal { fx: lens.fx, fy: Some(lens.fy), cx: Some(lens.cx), cy: Some(lens.cy) };
        let format = format.ok_or_else(|| named("format", &self.format))?;
        Ok(pb::RenderViewRequest {
            scene_id: self.scene.clone(),
            camera: Some(pb::CameraSpec {
                pose: Some(pb::camera_spec::Pose::CameraToWorld(pb::Matrix { values })),
                lens: Some(pb::camera_spec::Lens::Focal(focal)),
            }),
            kind: kind.ok_or_else(|| named("kind", &self.kind))?.into(),
            options: Some(pb::ViewOptions {
                width: Some(lens.width),
                height: Some(lens.height),
                format: format.into(),
                ..Default::default()
            }),
            text: if self.takes_text() { self.text.clone() } else { String::new() },
            ..Default::default()
        })
    }
}

/// A text as a part of a query string.
fn escaped(text: &str) -> String {
    let escape = |byte: u8| match byte {
        b'a'..=b'z' | b'A'..=b'Z' | b'0'..=b'9' => char::from(byte).to_string(),
        _ => format!("%{byte:02X}"),
    };
    text.bytes().map(escape).collect()
}
