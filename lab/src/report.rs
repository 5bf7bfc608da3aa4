//! Stub.

use crate::error::Result;

/// What to write.
#[derive(Clone, Debug, clap::Args)]
pub struct Args {}

/// Writes the page.
///
/// # Errors
/// None yet.
pub fn run(_args: &Args) -> Result<()> {
    Ok(())
}
