//! Connections to a server: HTTP/1.1 and HTTP/2 by hyper, gRPC by tonic. One connection at a time
//! belongs to a caller; HTTP/2 and gRPC share one between some.

use http_body_util::{BodyExt as _, Full};
use hyper::{
    Method, Request,
    body::Bytes,
    client::conn::{http1, http2},
    header,
};
use hyper_util::rt::{TokioExecutor, TokioIo};
use serde_json::Value;
use tokio::net::TcpStream;
use tonic::transport::{Channel, Endpoint};

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
            let shared = (caller % self.callers() != 0)
                .then(|| connections.last().and_then(Connection::share))
                .flatten();
            connections.push(match (shared, self) {
                (Some(shared), _) => shared,
                (None, Self::Http1) => Connection::http1(address).await?,
                (None, Self::Http2) => Connection::http2(address).await?,
                (None, Self::Grpc) => Connection::grpc(address).await?,
            });
        }
        Ok(connections)
    }
}

/// An HTTP call.
#[derive(Debug)]
pub(super) struct Call {
    method: Method,
    target: String,
    body: Vec<u8>,
    headers: Vec<(header::HeaderName, String)>,
}

impl Call {
    pub(super) fn get(target: String) -> Self {
        Self { method: Method::GET, target, body: Vec::new(), headers: Vec::new() }
    }

    /// The same, answered with 304 where the server's tag is this one.
    pub(super) fn get_unless(target: String, etag: String) -> Self {
        Self { headers: vec![(header::IF_NONE_MATCH, etag)], ..Self::get(target) }
    }

    pub(super) fn post(target: String, body: Vec<u8>, kind: String) -> Self {
        Self { method: Method::POST, target, body, headers: vec![(header::CONTENT_TYPE, kind)] }
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
#[derive(Debug)]
pub(super) enum Connection {
    Http1(http1::SendRequest<Full<Bytes>>, String),
    Http2(http2::SendRequest<Full<Bytes>>, String),
    Grpc(SceneServiceClient<Channel>),
}

fn broken(e: impl std::error::Error + Send + Sync + 'static) -> Error {
    Error::invalid("the connection to the server broke").caused_by(e)
}

async fn stream(address: &str) -> Result<TokioIo<TcpStream>> {
    let stream = TcpStream::connect(address).await.map_err(broken)?;
    stream.set_nodelay(true).map_err(broken)?;
    Ok(TokioIo::new(stream))
}

impl Connection {
    pub(super) async fn http1(address: &str) -> Result<Self> {
        let (to, connection) = http1::handshake(stream(address).await?).await.map_err(broken)?;
        tokio::spawn(connection);
        Ok(Self::Http1(to, address.to_owned()))
    }

    async fn http2(address: &str) -> Result<Self> {
        let mut builder = http2::Builder::new(TokioExecutor::new());
        builder.initial_stream_window_size(WINDOW_BYTES);
        builder.initial_connection_window_size(8 * WINDOW_BYTES);
        let (to, connection) = builder.handshake(stream(address).await?).await.map_err(broken)?;
        tokio::spawn(connection);
        Ok(Self::Http2(to, address.to_owned()))
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

    fn share(&self) -> Option<Self> {
        match self {
            Self::Http1(..) => None,
            Self::Http2(to, address) => Some(Self::Http2(to.clone(), address.clone())),
            Self::Grpc(client) => Some(Self::Grpc(client.clone())),
        }
    }

    /// Makes a call over HTTP. A refusal is an error with the server's words.
    pub(super) async fn call(&mut self, call: Call) -> Result<Answer> {
        let (http2, address) = match &*self {
            Self::Http1(_, address) => (false, address),
            Self::Http2(_, address) => (true, address),
            Self::Grpc(_) => return Err(Error::internal("an HTTP call over gRPC")),
        };
        let target = if http2 { format!("http://{address}{}", call.target) } else { call.target };
        let mut request = Request::builder().method(call.method).uri(target);
        if !http2 {
            request = request.header(header::HOST, address.as_str());
        }
        for (name, value) in call.headers {
            request = request.header(name, value);
        }
        let request = request.body(Full::new(Bytes::from(call.body))).map_err(broken)?;
        let response = match self {
            Self::Http1(to, _) => {
                to.ready().await.map_err(broken)?;
                to.send_request(request).await
            }
            Self::Http2(to, _) => {
                to.ready().await.map_err(broken)?;
                to.send_request(request).await
            }
            Self::Grpc(_) => return Err(Error::internal("an HTTP call over gRPC")),
        };
        let (head, mut body) = response.map_err(broken)?.into_parts();
        let mut bytes = Vec::new();
        while let Some(frame) = body.frame().await {
            bytes.extend(frame.map_err(broken)?.into_data().ok());
        }
        let text = |value: &header::HeaderValue| value.to_str().unwrap_or_default().to_owned();
        let answer = Answer {
            bytes,
            timing: head.headers.get_all("server-timing").iter().map(text).collect(),
            etag: head.headers.get(header::ETAG).map(text),
        };
        if head.status.is_success() || head.status.as_u16() == 304 {
            return Ok(answer);
        }
        let said: Value = serde_json::from_slice(&answer.body()).unwrap_or_default();
        let (code, why) = (&said["code"], &said["message"]);
        Err(Error::new(ErrorCode::InvalidRequest, format!("{} {code} {why}", head.status)))
    }

    /// Makes a call whose answer is JSON.
    pub(super) async fn json(&mut self, call: Call) -> Result<Value> {
        let answer = self.call(call).await?.body();
        let unlike = |e| Error::internal("the server's answer is no JSON").caused_by(e);
        serde_json::from_slice(&answer).map_err(unlike)
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
