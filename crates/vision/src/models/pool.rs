//! A pool of ONNX sessions. `Session::run` needs a session for itself, so each caller borrows one.

use std::ops::{Deref, DerefMut};

use ort::{
    session::{Session, SessionInputValue, SessionOutputs},
    value::{PrimitiveTensorElementType, TensorRef, ValueType},
};
use parking_lot::{Condvar, Mutex};
use tracing::{info, warn};

use crate::{
    error::{Error, Result},
    models::{Bundle, NetworkOptions, Provider, Runtime, manifest::unavailable},
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
                Ok(idle) => {
                    let name = provider.name();
                    info!(network = what, provider = name, sessions = count, threads, "open");
                    let pool = Self { idle: Mutex::new(idle), returned: Condvar::new() };
                    return Ok((pool, provider));
                }
                Err(e) => {
                    warn!(network = what, provider = provider.name(), error = %e, "refused");
                    refused = Some((provider, e));
                }
            }
        }
        let named = refused.as_ref().map_or("none", |(provider, _)| provider.name());
        let error = unavailable(format!("{what}: {named} does not open {file}"));
        Err(refused.into_iter().fold(error, |error, (_, cause)| error.caused_by(cause)))
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

/// `data` as an input of the network `what`.
pub(super) fn tensor<'a, T: PrimitiveTensorElementType + std::fmt::Debug + Clone + 'static>(
    what: &str,
    shape: &[usize],
    data: &'a [T],
) -> Result<SessionInputValue<'a>> {
    let view = TensorRef::from_array_view((shape.to_vec(), data));
    Ok(view.map_err(fault(what, "input"))?.into())
}

/// Shape and numbers of an output of the network `what`.
pub(super) fn output<'a>(
    what: &str,
    outputs: &'a SessionOutputs<'_>,
    name: &str,
) -> Result<(Vec<usize>, &'a [f32])> {
    let value =
        outputs.get(name).ok_or_else(|| Error::internal(format!("{what}: no output {name:?}")))?;
    let (shape, data) = value.try_extract_tensor::<f32>().map_err(fault(what, "output"))?;
    Ok((shape.iter().map(|&n| usize::try_from(n).unwrap_or(0)).collect(), data))
}

/// The error of a step of the network `what`.
pub(super) fn fault(what: &str, step: &str) -> impl Fn(ort::Error) -> Error {
    let message = format!("{what}: {step} failed");
    move |e| Error::internal(&message).caused_by(e)
}

/// A dimension of a file; `None` where the file leaves it free.
pub(super) fn fixed(dimension: i64) -> Option<usize> {
    usize::try_from(dimension).ok().filter(|&n| n > 0)
}

/// Shape of a session's input, -1 where it is free; `None` where it has no such input.
pub(super) fn input_shape(session: &Session, name: &str) -> Option<Vec<i64>> {
    let input = session.inputs().iter().find(|input| input.name() == name)?;
    match input.dtype() {
        ValueType::Tensor { shape, .. } => Some(shape.to_vec()),
        _ => Some(Vec::new()),
    }
}

/// Sessions, and threads of an operator in each: a session for each job, together at most
/// `threads`.
fn shares(threads: usize, jobs: usize) -> (usize, usize) {
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
