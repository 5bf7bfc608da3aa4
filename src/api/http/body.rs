//! Bodies with something around them: a request's body that must not be too slow, an answer's body
//! that holds what must live as long as it.

use std::{
    pin::Pin,
    sync::{
        Arc,
        atomic::{AtomicBool, Ordering},
    },
    task::{Context, Poll},
    time::Duration,
};

use axum::{
    body::{Body, Bytes},
    extract::Request,
    response::Response,
};
use http_body::{Frame, SizeHint};
use tokio::time::{Sleep, sleep};

use crate::{
    error::{Error, ErrorCode},
    limits::Limits,
};

type Polled = Poll<Option<Result<Frame<Bytes>, axum::Error>>>;

/// A body whose frames pass through a function. Both are dropped when the connection has finished
/// with the body.
struct Through<F> {
    body: Body,
    each: F,
}

impl<F: FnMut(&mut Context<'_>, Polled) -> Polled + Unpin> http_body::Body for Through<F> {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Polled {
        let polled = Pin::new(&mut self.body).poll_frame(cx);
        (self.each)(cx, polled)
    }

    fn is_end_stream(&self) -> bool {
        self.body.is_end_stream()
    }

    fn size_hint(&self) -> SizeHint {
        self.body.size_hint()
    }
}

fn through<F>(body: Body, each: F) -> Body
where
    F: FnMut(&mut Context<'_>, Polled) -> Polled + Unpin + Send + 'static,
{
    Body::new(Through { body, each })
}

/// The same answer, whose body holds `held`. [`super::answers`] keeps the body until it is written.
pub(super) fn hold<T: Unpin + Send + 'static>(response: Response, held: T) -> Response {
    response.map(|body| {
        through(body, move |_, polled| {
            let _ = &held;
            polled
        })
    })
}

/// Bytes that hold `held` until the last of them is written.
pub(super) fn held_bytes<T: Send + 'static>(bytes: Vec<u8>, held: T) -> Bytes {
    struct Held<T>(Vec<u8>, T);
    impl<T> AsRef<[u8]> for Held<T> {
        fn as_ref(&self) -> &[u8] {
            &self.0
        }
    }
    Bytes::from_owner(Held(bytes, held))
}

/// How fast the body of a request must come, or that of an answer be taken.
#[derive(Clone, Copy, Debug)]
pub(super) struct Pace {
    /// Bytes that each `window` of waiting must bring.
    pub(super) bytes: usize,
    pub(super) window: Duration,
}

impl Pace {
    /// That of requests.
    pub(super) fn of_requests(limits: &Limits) -> Self {
        Self { bytes: limits.body_bytes_min, window: Duration::from_millis(limits.body_window_ms) }
    }

    /// That of answers.
    pub(super) fn of_answers(limits: &Limits) -> Self {
        let window = Duration::from_millis(limits.answer_window_ms);
        Self { bytes: limits.answer_bytes_min, window }
    }

    /// The request with a body that fails where it comes too slowly, and whether it did. Only the
    /// time in which the server waits for the body counts.
    pub(super) fn watch(self, request: Request) -> (Request, Arc<AtomicBool>) {
        let too_slow = Arc::new(AtomicBool::new(false));
        if http_body::Body::is_end_stream(request.body()) {
            return (request, too_slow);
        }
        let failed = Arc::clone(&too_slow);
        let (mut bytes, mut waiting) = (0, None::<Pin<Box<Sleep>>>);
        let each = move |cx: &mut Context<'_>, polled: Polled| {
            if failed.load(Ordering::Acquire) {
                return Poll::Ready(None);
            }
            if let Poll::Ready(frame) = &polled {
                if let Some(Ok(frame)) = frame {
                    bytes += frame.data_ref().map_or(0, Bytes::len);
                }
                if bytes >= self.bytes {
                    (bytes, waiting) = (0, None);
                }
                return polled;
            }
            let timer = waiting.get_or_insert_with(|| Box::pin(sleep(self.window)));
            if timer.as_mut().poll(cx).is_pending() {
                return Poll::Pending;
            }
            failed.store(true, Ordering::Release);
            Poll::Ready(Some(Err(axum::Error::new("too slow"))))
        };
        (request.map(|body| through(body, each)), too_slow)
    }

    /// The error of a body that came too slowly.
    pub(super) fn error(self) -> Error {
        let (bytes, ms) = (self.bytes, self.window.as_millis());
        let message = format!("the body came too slowly: under {bytes} bytes in {ms} ms");
        Error::new(ErrorCode::DeadlineExceeded, message)
    }
}
