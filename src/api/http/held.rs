//! An answer that holds something until its last byte is sent or its caller is gone.

use std::{
    pin::Pin,
    task::{Context, Poll},
};

use axum::{
    body::{Body, Bytes},
    response::Response,
};
use http_body::{Frame, SizeHint};

/// A body with what must live as long.
struct Held<T> {
    body: Body,
    // Dropped with the body, which is when the connection is done with it.
    _held: T,
}

impl<T: Unpin> http_body::Body for Held<T> {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        Pin::new(&mut self.body).poll_frame(cx)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

/// The same answer, which drops `held` with its body.
pub(super) fn hold<T: Unpin + Send + 'static>(response: Response, held: T) -> Response {
    response.map(|body| Body::new(Held { body, _held: held }))
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use axum::response::IntoResponse;
    use http_body::Body as _;

    use super::*;

    #[tokio::test]
    async fn what_is_held_lives_as_long_as_the_body() {
        let held = Arc::new(());
        let response = hold("text".into_response(), Arc::clone(&held));
        assert_eq!(response.body().size_hint().exact(), Some(4), "the length is still known");
        assert_eq!(Arc::strong_count(&held), 2);
        let text = axum::body::to_bytes(response.into_body(), 10).await.unwrap();
        assert_eq!((&text[..], Arc::strong_count(&held)), (&b"text"[..], 1));
    }
}
