//! Everything that the program writes to the terminal.

use std::{
    error::Error as _,
    io::{self, IsTerminal, Write},
    sync::Mutex,
};

use serde::Serialize;
use serde_json::json;

use crate::error::{Error, Result};

/// Where answers, progress and errors go.
#[derive(Debug)]
pub(super) struct Output {
    json: bool,
    terminal: bool,
    /// Last progress line, so that a log is not filled with the same one.
    last: Mutex<String>,
}

impl Output {
    pub(super) fn new(json: bool) -> Self {
        Self { json, terminal: io::stderr().is_terminal(), last: Mutex::default() }
    }

    /// An answer: `text` for people, `value` for machines. A closed pipe is no error.
    pub(super) fn answer(&self, text: &str, value: &impl Serialize) -> Result<()> {
        let words = if self.json {
            serde_json::to_string(value)
                .map_err(|e| Error::internal("the answer is no JSON").caused_by(e))?
        } else {
            text.trim_end().to_owned()
        };
        write(&mut io::stdout().lock(), &format!("{words}\n"));
        Ok(())
    }

    /// Progress: one line that changes on a terminal, plain lines in a log.
    pub(super) fn progress(&self, what: &str, fraction: f32) {
        if self.json {
            return;
        }
        let mut last = self.last.lock().unwrap_or_else(std::sync::PoisonError::into_inner);
        if self.terminal {
            const WIDTH: usize = 30;
            #[expect(clippy::cast_possible_truncation, clippy::cast_sign_loss, reason = "0..=30")]
            let full = (fraction.clamp(0.0, 1.0) * WIDTH as f32) as usize;
            let bar = format!("{}{}", "#".repeat(full), ".".repeat(WIDTH - full));
            let end = if fraction >= 1.0 { "\n" } else { "" };
            let line = format!("\r[{bar}] {:3.0} % {what:<12}{end}", fraction * 100.0);
            if *last != line {
                write(&mut io::stderr().lock(), &line);
                *last = line;
            }
        } else if *last != what {
            write(&mut io::stderr().lock(), &format!("{:3.0} % {what}\n", fraction * 100.0));
            what.clone_into(&mut last);
        }
    }

    /// An error with its causes, which stay on this machine.
    pub(super) fn error(&self, error: &Error) {
        let mut causes = Vec::new();
        let mut source = error.source();
        while let Some(cause) = source {
            causes.push(cause.to_string());
            source = cause.source();
        }
        let code = error.code().name();
        let words = if self.json {
            json!({ "code": code, "message": error.message(), "causes": causes }).to_string()
        } else {
            let causes: String = causes.iter().map(|c| format!("\n  because: {c}")).collect();
            format!("error ({code}): {}{causes}", error.message())
        };
        write(&mut io::stderr().lock(), &format!("{words}\n"));
    }
}

fn write(to: &mut dyn Write, words: &str) {
    // When the terminal is gone, the error cannot be shown.
    let _ = to.write_all(words.as_bytes()).and_then(|()| to.flush());
}
