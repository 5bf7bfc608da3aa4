//! A pool of ONNX sessions. `Session::run` needs a session for itself, so each caller borrows one.

use std::ops::{Deref, DerefMut};

use ort::{session::Session, value::ValueType};
use parking_lot::{Condvar, Mutex};
use tracing::{info, warn};

use crate::{
    error::{Error, ErrorCode, Result},
    models::{Bundle, NetworkOptions, Provider, Runtime},
};

/// Sessions of one network, lent one at a time.
#[derive(Debug)]
pub(super) struct Pool {
    idle: Mutex<Vec<Session>>,
    returned: Condvar,
}

/// A borrowed session; goes back when dropped.
#[derive(Debug)]
pub(super) struct Lent<'a> {
    pool: &'a Pool,
    session: Option<Session>,
}

impl Pool {
    /// Opens one session a concurrent job of a file of the bundle, on the first provider that takes
    /// it; `what` names the network in messages.
    pub(super) fn open(
        runtime: &Runtime,
        bundle: &Bundle,
        options: &NetworkOptions,
        what: &'static str,
        file: &str,
    ) -> Result<(Self, Provider)> {
        let (count, threads) = shares(options.threads, options.jobs);
        let path = bundle.path(file);
        let mut refused = None;
        for provider in runtime.candidates(options.provider)? {
            let opened: std::result::Result<Vec<_>, _> =
                (0..count).map(|_| runtime.session(&path, provider, threads)).collect();
            match opened {
                Ok(sessions) => {
                    let name = provider.name();
                    info!(network = what, provider = name, sessions = count, threads, "open");
                    return Ok((Self::new(sessions), provider));
                }
                Err(e) => {
                    warn!(network = what, provider = provider.name(), error = %e, "refused");
                    refused = Some((provider, e));
                }
            }
        }
        let named = refused.as_ref().map_or("none", |(provider, _)| provider.name());
        let message = format!("{what}: {named} does not open {file}");
        let error = Error::new(ErrorCode::ModelUnavailable, message);
        Err(match refused {
            Some((_, cause)) => error.caused_by(cause),
            None => error,
        })
    }

    /// A pool of these sessions; at least one, or [`Self::take`] waits for ever.
    pub(super) fn new(sessions: Vec<Session>) -> Self {
        debug_assert!(!sessions.is_empty(), "an empty pool");
        Self { idle: Mutex::new(sessions), returned: Condvar::new() }
    }

    /// Waits for an idle session.
    pub(super) fn take(&self) -> Lent<'_> {
        let mut idle = self.idle.lock();
        loop {
            if let Some(session) = idle.pop() {
                return Lent { pool: self, session: Some(session) };
            }
            self.returned.wait(&mut idle);
        }
    }
}

impl Deref for Lent<'_> {
    type Target = Session;

    fn deref(&self) -> &Session {
        self.session.as_ref().expect("a lent session is there until dropped; this is a bug")
    }
}

impl DerefMut for Lent<'_> {
    fn deref_mut(&mut self) -> &mut Session {
        self.session.as_mut().expect("a lent session is there until dropped; this is a bug")
    }
}

impl Drop for Lent<'_> {
    fn drop(&mut self) {
        if let Some(session) = self.session.take() {
            self.pool.idle.lock().push(session);
            self.pool.returned.notify_one();
        }
    }
}

/// Shape of a session's input, -1 where it is free; `None` where it has no such input.
pub(super) fn input_shape(session: &Session, name: &str) -> Option<Vec<i64>> {
    let input = session.inputs().iter().find(|input| input.name() == name)?;
    match input.dtype() {
        ValueType::Tensor { shape, .. } => Some(shape.to_vec()),
        _ => Some(Vec::new()),
    }
}

/// How `threads` are shared: sessions, and threads an operator in each.
///
/// One session a concurrent job, never more sessions than threads, never more threads than given.
pub(super) fn shares(threads: usize, jobs: usize) -> (usize, usize) {
    let sessions = jobs.clamp(1, threads.max(1));
    (sessions, (threads / sessions).max(1))
}

#[cfg(test)]
mod tests {
    use super::shares;

    #[test]
    fn threads_are_never_oversubscribed() {
        for threads in 1..20 {
            for jobs in 1..20 {
                let (sessions, each) = shares(threads, jobs);
                assert!(sessions * each <= threads, "{threads} threads, {jobs} jobs");
                assert!(sessions >= 1 && each >= 1, "{threads} threads, {jobs} jobs");
            }
        }
        assert_eq!(shares(2, 1), (1, 2), "one job gets all threads");
        assert_eq!(shares(8, 2), (2, 4), "two jobs share");
    }
}
