//! The answers of a connection, each owned until its last byte is written.
//!
//! hyper drops the body of an answer when it has taken the last of it, long before the caller has.
//! So a body goes out in small pieces, and what the body holds (a key's permit, a place among the
//! open calls, bytes of a budget) is given back when the last piece is written to the socket, or
//! when the connection is gone. A caller who takes an answer too slowly loses the connection.

use std::{
    fmt,
    pin::Pin,
    sync::{Arc, Weak},
    task::{Context, Poll},
};

use axum::{
    body::{Body, Bytes},
    response::Response,
};
use http_body::{Body as _, Frame, SizeHint};
use parking_lot::Mutex;
use tokio::time::{Instant, sleep};

use super::body::Pace;

/// Bytes that the connection takes at once: what it has taken of a body and not written is memory
/// that nobody counts.
const PIECE_BYTES: usize = 64 << 10;
/// How often in the window of the pace the answers are looked at.
const LOOKS: u32 = 4;

/// The answers of one connection that are not written yet. Cloning shares them.
#[derive(Clone, Debug)]
pub(super) struct Answers {
    pace: Pace,
    open: Arc<Mutex<Vec<Weak<Answer>>>>,
}

impl Answers {
    /// None yet. Each must be taken at this pace.
    pub(super) fn new(pace: Pace) -> Self {
        Self { pace, open: Arc::default() }
    }

    /// The same answer, which holds all that its body holds until its last byte is written.
    pub(super) fn own(&self, response: Response) -> Response {
        response.map(|body| {
            if body.is_end_stream() {
                return body;
            }
            let answer = Arc::new(Answer { pace: self.pace, state: Mutex::new(State::new()) });
            let mut open = self.open.lock();
            open.retain(|one| one.strong_count() > 0);
            open.push(Arc::downgrade(&answer));
            Body::new(Pieces { body: Some(body), rest: Bytes::new(), answer })
        })
    }

    /// Resolves when a caller takes an answer too slowly.
    pub(super) async fn too_slow(&self) {
        while self.slow(1).0 == 0 {
            sleep(self.pace.window / LOOKS).await;
        }
    }

    /// Resolves when there are answers that are taken too slowly and no others, or when one has
    /// been too slow for a window more.
    pub(super) async fn only_slow(&self) {
        loop {
            let (slow, open) = self.slow(1);
            if slow > 0 && (slow == open || self.slow(2).0 > 0) {
                return;
            }
            sleep(self.pace.window / LOOKS).await;
        }
    }

    /// How many answers were not taken at the pace for so many windows, and how many there are.
    fn slow(&self, windows: u32) -> (usize, usize) {
        let now = Instant::now();
        let open: Vec<_> = self.open.lock().iter().filter_map(Weak::upgrade).collect();
        let late = |answer: &&Arc<Answer>| {
            let waited = answer.state.lock().waiting.map(|since| now - since);
            waited.is_some_and(|waited| waited >= self.pace.window * windows)
        };
        (open.iter().filter(late).count(), open.len())
    }
}

/// One answer: alive until its last piece is written.
struct Answer {
    pace: Pace,
    state: Mutex<State>,
}

struct State {
    /// Pieces that the connection has and has not written.
    pieces: usize,
    /// Bytes written in this window.
    written: usize,
    /// Whether all that there is so far has been handed out.
    handed_out: bool,
    /// Since when the caller is waited for; `None` while the server is.
    waiting: Option<Instant>,
    /// The body when the connection has finished with it.
    ended: Option<Body>,
}

impl State {
    /// An answer that waits for its caller.
    fn new() -> Self {
        let waiting = Some(Instant::now());
        Self { pieces: 0, written: 0, handed_out: false, waiting, ended: None }
    }

    /// Ends the window where the caller has all that there is.
    fn rest(&mut self) {
        if self.handed_out && self.pieces == 0 {
            (self.written, self.waiting) = (0, None);
        }
    }
}

impl fmt::Debug for Answer {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_struct("Answer").finish_non_exhaustive()
    }
}

impl Answer {
    fn hand_out(self: &Arc<Self>, bytes: Bytes) -> Bytes {
        let mut state = self.state.lock();
        state.pieces += 1;
        state.handed_out = false;
        state.waiting.get_or_insert_with(Instant::now);
        Bytes::from_owner(Piece { bytes, answer: Arc::clone(self) })
    }

    fn wait_for_the_server(&self) {
        let mut state = self.state.lock();
        state.handed_out = true;
        state.rest();
    }
}

/// Bytes on their way. Dropped when they are written.
struct Piece {
    bytes: Bytes,
    answer: Arc<Answer>,
}

impl AsRef<[u8]> for Piece {
    fn as_ref(&self) -> &[u8] {
        &self.bytes
    }
}

impl Drop for Piece {
    fn drop(&mut self) {
        let mut state = self.answer.state.lock();
        state.pieces -= 1;
        state.written += self.bytes.len();
        if state.written >= self.answer.pace.bytes {
            (state.written, state.waiting) = (0, Some(Instant::now()));
        }
        state.rest();
    }
}

/// The body of an answer in pieces.
struct Pieces {
    body: Option<Body>,
    /// What is left of the frame that the body gave last.
    rest: Bytes,
    answer: Arc<Answer>,
}

impl Drop for Pieces {
    fn drop(&mut self) {
        self.answer.state.lock().ended = self.body.take();
    }
}

impl http_body::Body for Pieces {
    type Data = Bytes;
    type Error = axum::Error;

    fn poll_frame(
        mut self: Pin<&mut Self>,
        cx: &mut Context<'_>,
    ) -> Poll<Option<Result<Frame<Bytes>, axum::Error>>> {
        let this = &mut *self;
        if this.rest.is_empty() {
            let Some(body) = &mut this.body else { return Poll::Ready(None) };
            match Pin::new(body).poll_frame(cx) {
                Poll::Pending => {
                    this.answer.wait_for_the_server();
                    return Poll::Pending;
                }
                Poll::Ready(Some(Ok(frame))) => match frame.into_data() {
                    Ok(bytes) => this.rest = bytes,
                    Err(trailers) => return Poll::Ready(Some(Ok(trailers))),
                },
                end => return end,
            }
        }
        let piece = this.rest.split_to(this.rest.len().min(PIECE_BYTES));
        Poll::Ready(Some(Ok(Frame::data(this.answer.hand_out(piece)))))
    }

    fn is_end_stream(&self) -> bool {
        self.rest.is_empty() && self.body.as_ref().is_none_or(Body::is_end_stream)
    }

    fn size_hint(&self) -> SizeHint {
        let rest = self.rest.len() as u64;
        let after = self.body.as_ref().map(Body::size_hint).unwrap_or_default();
        let mut hint = SizeHint::new();
        hint.set_lower(after.lower() + rest);
        if let Some(upper) = after.upper() {
            hint.set_upper(upper + rest);
        }
        hint
    }
}
