//! Our own extractors: the answer to a bad id or body has our shape and names what is wrong.

use axum::{
    body::Bytes,
    extract::{FromRequest, FromRequestParts, RawPathParams, Request},
    http::request::Parts,
};
use futures_util::StreamExt;
use utoipa::IntoParams;

use super::{error::ApiError, fields::Fields, multipart::read_on};
use crate::{
    api::{Api, upload::json_over},
    error::Error,
    scene::SceneId,
};

/// The `{id}` of the path, checked.
#[derive(Clone, Debug, IntoParams)]
#[into_params(names("id"), parameter_in = Path)]
pub(super) struct Id(
    /// 32 lower-case hex digits.
    #[param(value_type = String)]
    pub(super) SceneId,
);

impl FromRequestParts<Api> for Id {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, api: &Api) -> Result<Self, ApiError> {
        let params = RawPathParams::from_request_parts(parts, api)
            .await
            .map_err(|e| Error::invalid(format!("path: {e}")))?;
        let id = params.iter().find(|(name, _)| *name == "id").map_or("", |(_, value)| value);
        Ok(Self(id.parse()?))
    }
}

/// The API for the caller of this request, after the middleware has checked the key.
#[derive(Clone, Debug)]
pub(super) struct CallerApi(pub(super) Api);

impl FromRequestParts<Api> for CallerApi {
    type Rejection = ApiError;

    async fn from_request_parts(parts: &mut Parts, api: &Api) -> Result<Self, ApiError> {
        Ok(Self(api.for_caller(parts.extensions.get())?))
    }
}

/// The fields of a JSON body of at most `limits.json_bytes_max`, of any content type. Such a call
/// takes no query parameters.
#[derive(Clone, Debug)]
pub(super) struct JsonBody(pub(super) Fields);

impl FromRequest<Api> for JsonBody {
    type Rejection = ApiError;

    async fn from_request(request: Request, api: &Api) -> Result<Self, ApiError> {
        let limits = api.service.limits();
        let (mut parts, body) = request.into_parts();
        let mut body = body.into_data_stream();
        let mut bytes = Vec::new();
        while let Some(piece) = body.next().await {
            let piece: Bytes =
                piece.map_err(|e| Error::invalid("body: the upload broke off").caused_by(e))?;
            if bytes.len() + piece.len() > limits.json_bytes_max {
                read_on(body);
                return Err(json_over("body", bytes.len() + piece.len(), &limits).into());
            }
            bytes.extend_from_slice(&piece);
        }
        let Ok(query) = Fields::from_request_parts(&mut parts, api).await;
        query.finish()?;
        limits.check_json("body", &bytes)?;
        Ok(Self(Fields::of_json(&bytes)?))
    }
}
