//! `segsplat keys`: new API keys, and the hashes that the server keeps of them.

use std::{
    io::{Read as _, Write as _},
    path::{Path, PathBuf},
};

use clap::Subcommand;
use serde_json::json;

use super::output::Output;
use crate::{
    error::{Error, ErrorCode, Result},
    keys::{self, Keys, Scope},
    names::named,
};

/// Longest key read from standard input.
const KEY_BYTES_MAX: u64 = 4_096;

#[derive(Clone, Debug, clap::Args)]
pub(super) struct Args {
    #[command(subcommand)]
    action: Action,
}

#[derive(Clone, Debug, Subcommand)]
enum Action {
    /// Make a key. It is shown once; the keys file gets its hash
    New {
        /// Name of the key, for log and metrics
        name: String,
        /// What it allows: `read` shows, searches and exports scenes; `write` also makes and
        /// deletes scenes; `admin` also shows the scenes of all owners and the metrics
        #[arg(long, default_value = "write", value_parser = named::<Scope>)]
        scope: Scope,
        /// Owner of the scenes that it makes and sees; keys of one owner share them [default: NAME]
        #[arg(long)]
        owner: Option<String>,
        /// Keys file to add it to; without one the lines for the file are printed
        #[arg(long, value_name = "FILE", alias = "file")]
        keys: Option<PathBuf>,
    },
    /// Read a key from standard input and print its hash
    Hash,
}

pub(super) fn run(args: &Args, out: &Output) -> Result<()> {
    match &args.action {
        Action::New { name, scope, owner, keys } => {
            new(name, *scope, owner.as_deref(), keys.as_deref(), out)
        }
        Action::Hash => {
            let mut key = String::new();
            std::io::stdin()
                .take(KEY_BYTES_MAX)
                .read_to_string(&mut key)
                .map_err(|e| Error::invalid("the key is not text").caused_by(e))?;
            let hash = keys::key_sha256(key.trim());
            out.answer(&hash, &json!({ "sha256": hash }))
        }
    }
}

fn new(
    name: &str,
    scope: Scope,
    owner: Option<&str>,
    keys_file: Option<&Path>,
    out: &Output,
) -> Result<()> {
    keys::check_name("name", name)?;
    keys::check_name("owner", owner.unwrap_or(name))?;
    let key = keys::generate()?;
    let owner_line = owner.map(|owner| format!("owner = \"{owner}\"\n")).unwrap_or_default();
    let sha256 = keys::key_sha256(&key);
    let lines = format!(
        "[[key]]\nname = \"{name}\"\n{owner_line}sha256 = \"{sha256}\"\nscopes = [\"{scope}\"]\n"
    );
    let value = json!({ "name": name, "key": key, "sha256": sha256, "scope": scope });
    let Some(path) = keys_file else {
        return out.answer(&format!("{key}\n\nfor the keys file:\n\n{lines}"), &value);
    };
    add(path, &lines)?;
    out.answer(&key, &value)
}

/// Adds the lines of a key to a keys file that only its owner may read. On an error the file is not
/// changed.
fn add(path: &Path, lines: &str) -> Result<()> {
    let before = match fs_err::read_to_string(path) {
        Ok(text) => text,
        Err(cause) if cause.kind() == std::io::ErrorKind::NotFound => String::new(),
        Err(cause) => return Err(Error::invalid(format!("keys file: {cause}")).caused_by(cause)),
    };
    let gap = if before.is_empty() || before.ends_with("\n\n") { "" } else { "\n" };
    let text = format!("{before}{gap}{lines}");
    Keys::parse(&text)?;
    let mut options = fs_err::OpenOptions::new();
    options.create(true).append(true);
    #[cfg(unix)]
    {
        use fs_err::os::unix::fs::OpenOptionsExt;
        options.mode(0o600);
    }
    options
        .open(path)
        .and_then(|mut file| file.write_all(format!("{gap}{lines}").as_bytes()))
        .map_err(|e| Error::new(ErrorCode::StoreUnavailable, format!("keys file: {e}")))
}
