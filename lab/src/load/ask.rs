//! A view as a caller asks for it.

use super::{
    door::{Answer, Call, Connection},
    pb,
};
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
            _ => {
                let target = self.target(camera);
                let call = match etag {
                    Some(etag) => Call::get_unless(target, etag),
                    None => Call::get(target),
                };
                connection.call(call).await
            }
        }
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
