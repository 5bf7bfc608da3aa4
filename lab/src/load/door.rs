//! Connections to a server: HTTP/1.1 and HTTP/2 by reqwest, gRPC by tonic. One connection at a time
//! belongs to a caller; HTTP/2 and gRPC share one between some.

use reqwest::{Client, RequestBuilder, StatusCode, header};
use serde_json::Value;
use tonic::{
    codegen::Bytes,
    transport::{Channel, Endpoint},
};

use segsplat::api::grpc::pb::{self, scene_service_client::SceneServiceClient};

use crate::error::{Error, ErrorCode, Result};

/// Windows of HTTP/2: a large picture must not wait for the other side's word.
const WINDOW_BYTES: u32 = 8 << 20;
/// Largest picture taken as one message.
const MESSAGE_BYTES_MAX: usize = 256 << 20;

/// How a call goes in.
#[derive(Clone, Copy, Debug, PartialEq, Eq, clap::ValueEnum)]
pub(super) enum Door {
    /// HTTP/1.1, a connection for each caller that is kept open
    Http1,
    /// HTTP/2, a connection for eight callers
    Http2,
    /// gRPC, a connection for eight callers
    Grpc,
}

impl Door {
    pub(super) fn name(self) -> &'static str {
        match self {
            Self::Http1 => "http1",
            Self::Http2 => "http2",
            Self::Grpc => "grpc",
        }
    }

    /// Callers that share a connection.
    fn callers(self) -> usize {
        if self == Self::Http1 { 1 } else { 8 }
    }

    /// A connection for each of so many callers.
    pub(super) async fn connect(self, address: &str, callers: usize) -> Result<Vec<Connection>> {
        let mut connections: Vec<Connection> = Vec::new();
        for caller in 0..callers {
            let shared = connections.last().filter(|_| caller % self.callers() != 0).cloned();
            connections.push(match (shared, self) {
                (Some(shared), _) => shared,
                (None, Self::Grpc) => Connection::grpc(address).await?,
                (None, _) => Connection::http(address, self)?,
            });
        }
        Ok(connections)
    }
}

/// A whole answer.
#[derive(Debug)]
pub(super) struct Answer {
    pub(super) bytes: Vec<Bytes>,
    /// Values of `Server-Timing`.
    pub(super) timing: Vec<String>,
    pub(super) etag: Option<String>,
}

impl Answer {
    pub(super) fn len(&self) -> usize {
        self.bytes.iter().map(Bytes::len).sum()
    }

    pub(super) fn body(&self) -> Vec<u8> {
        self.bytes.concat()
    }

    /// The parts of a `multipart/mixed` answer as pieces, with the times that their heads say.
    pub(super) fn parted(self) -> Result<Self> {
        let broken = || Error::invalid("the answer is no sequence of views");
        let body = Bytes::from(self.body());
        let (mut bytes, mut timing, mut at) = (Vec::new(), self.timing, 0);
        loop {
            let rest = body.get(at..).ok_or_else(broken)?;
            let end = rest.windows(4).position(|four| four == b"\r\n\r\n");
            // The last line closes the parts and has no head.
            let Some(end) = end else {
                if rest.ends_with(b"--\r\n") {
                    break;
                }
                return Err(broken());
            };
            let head = std::str::from_utf8(&rest[..end]).map_err(|_| broken())?;
            let field = |name: &str| head.lines().find_map(|line| line.strip_prefix(name));
            let length = field("content-length: ").and_then(|n| n.parse::<usize>().ok());
            // A part without a length holds an error.
            let length = length.ok_or_else(broken)?;
            timing.extend(field("server-timing: ").map(str::to_owned));
            at += end + 4;
            bytes.push(
                body.get(at..at + length).map(|part| body.slice_ref(part)).ok_or_else(broken)?,
            );
            at += length + 2;
        }
        Ok(Self { bytes, timing, etag: None })
    }
}

/// One caller's way to the server.
#[derive(Clone, Debug)]
pub(super) enum Connection {
    /// With the server's URL.
    Http(Client, String),
    Grpc(SceneServiceClient<Channel>),
}

fn broken(e: impl std::error::Error + Send + Sync + 'static) -> Error {
    Error::invalid("the connection to the server broke").caused_by(e)
}

impl Connection {
    pub(super) fn http(address: &str, door: Door) -> Result<Self> {
        segsplat::crypto::install();
        let client = Client::builder().no_proxy().tcp_nodelay(true);
        let client = match door {
            Door::Http2 => client
                .http2_prior_knowledge()
                .http2_initial_stream_window_size(WINDOW_BYTES)
                .http2_initial_connection_window_size(8 * WINDOW_BYTES),
            _ => client.http1_only(),
        };
        Ok(Self::Http(client.build().map_err(broken)?, format!("http://{address}")))
    }

    async fn grpc(address: &str) -> Result<Self> {
        let endpoint = Endpoint::from_shared(format!("http://{address}")).map_err(broken)?;
        let channel = endpoint
            .tcp_nodelay(true)
            .initial_stream_window_size(WINDOW_BYTES)
            .initial_connection_window_size(8 * WINDOW_BYTES)
            .connect()
            .await
            .map_err(broken)?;
        let client = SceneServiceClient::new(channel);
        Ok(Self::Grpc(client.max_decoding_message_size(MESSAGE_BYTES_MAX)))
    }

    pub(super) fn get(&self, target: &str) -> Result<RequestBuilder> {
        let (client, server) = self.client()?;
        Ok(client.get(format!("{server}{target}")))
    }

    pub(super) fn post(&self, target: &str) -> Result<RequestBuilder> {
        let (client, server) = self.client()?;
        Ok(client.post(format!("{server}{target}")))
    }

    fn client(&self) -> Result<(&Client, &str)> {
        match self {
            Self::Http(client, server) => Ok((client, server)),
            Self::Grpc(_) => Err(Error::internal("an HTTP call over gRPC")),
        }
    }

    /// Asks for many views over gRPC.
    pub(super) async fn render_many(&mut self, request: pb::RenderViewsRequest) -> Result<Answer> {
        let Self::Grpc(client) = self else {
            return Err(Error::internal("a gRPC call over HTTP"));
        };
        let refused = |status: tonic::Status| Error::invalid(status.message().to_owned());
        let mut views = client.render_views(request).await.map_err(refused)?.into_inner();
        let mut bytes = Vec::new();
        while let Some(view) = views.message().await.map_err(refused)? {
            bytes.push(view.data);
        }
        Ok(Answer { bytes, timing: Vec::new(), etag: None })
    }

    /// Asks for a view over gRPC.
    pub(super) async fn render(&mut self, request: pb::RenderViewRequest) -> Result<Answer> {
        let Self::Grpc(client) = self else {
            return Err(Error::internal("a gRPC call over HTTP"));
        };
        let refused = |status: tonic::Status| Error::invalid(status.message().to_owned());
        let answer = client.render_view(request).await.map_err(refused)?;
        let timing = answer.metadata().get_all("server-timing").iter();
        let timing = timing.filter_map(|value| Some(value.to_str().ok()?.to_owned())).collect();
        let view = answer.into_inner();
        Ok(Answer { bytes: vec![view.data], timing, etag: Some(view.etag) })
    }
}

/// Makes a call over HTTP. A refusal is an error with the server's words.
pub(super) async fn answer(request: RequestBuilder) -> Result<Answer> {
    let mut response = request.send().await.map_err(broken)?;
    let text = |value: &header::HeaderValue| value.to_str().unwrap_or_default().to_owned();
    let (status, headers) = (response.status(), response.headers());
    let timing = headers.get_all("server-timing").iter().map(text).collect();
    let etag = headers.get(header::ETAG).map(text);
    let mut bytes = Vec::new();
    while let Some(chunk) = response.chunk().await.map_err(broken)? {
        bytes.push(chunk);
    }
    let answer = Answer { bytes, timing, etag };
    if status.is_success() || status == StatusCode::NOT_MODIFIED {
        return Ok(answer);
    }
    let said: Value = serde_json::from_slice(&answer.body()).unwrap_or_default();
    let (code, why) = (&said["code"], &said["message"]);
    Err(Error::new(ErrorCode::InvalidRequest, format!("{status} {code} {why}")))
}

/// Makes a call whose answer is JSON.
pub(super) async fn json(request: RequestBuilder) -> Result<Value> {
    let unlike = |e| Error::internal("the server's answer is no JSON").caused_by(e);
    serde_json::from_slice(&answer(request).await?.body()).map_err(unlike)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parted(body: &str) -> Result<Answer> {
        let body = Bytes::copy_from_slice(body.as_bytes());
        Answer { bytes: vec![body], timing: vec!["total;dur=9".to_owned()], etag: None }.parted()
    }

    #[test]
    fn parts_are_pieces_with_the_times_of_their_heads() {
        let part = |ms: u32, body: &str| {
            let length = body.len();
            let head = format!("server-timing: render;dur={ms}\r\ncontent-length: {length}");
            format!("--b\r\n{head}\r\n\r\n{body}\r\n")
        };
        // A picture may hold what ends a head.
        let whole = format!("{}{}--b--\r\n", part(1, "ab\r\n\r\n--b"), part(2, ""));
        let answer = parted(&whole).unwrap();
        assert_eq!(answer.bytes, ["ab\r\n\r\n--b", ""]);
        assert_eq!(answer.timing, ["total;dur=9", "render;dur=1", "render;dur=2"]);
        let fault = "--b\r\ncontent-type: application/json\r\n\r\n{}\r\n--b--\r\n";
        assert!(parted(&format!("{}{fault}", part(1, "a"))).is_err(), "a part with an error");
        assert!(parted(&whole[..whole.len() - 20]).is_err(), "cut off");
    }
}
