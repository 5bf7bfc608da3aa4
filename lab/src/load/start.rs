//! How long a server takes to start: until it listens, and until its networks are open.

use std::time::Instant;

use serde_json::json;

use super::server::{Servers, runtime};
use crate::{
    error::Result,
    rows::{Rows, median, ms},
    setup::Setup,
};

/// What to start: a row for each server.
#[derive(Clone, Debug, clap::Args)]
pub(crate) struct Args {
    #[command(flatten)]
    servers: Servers,
    /// Starts of each, one after the other
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..=100))]
    runs: u32,
    #[command(flatten)]
    setup: Setup,
}

/// Makes the rows: medians, and as their error the least and the longest time to open networks.
pub(crate) fn run(args: &Args, rows: &mut Rows) -> Result<()> {
    let runtime = runtime(Some(1))?;
    for program in args.servers.programs()? {
        let (mut listening, mut open) = (Vec::new(), Vec::new());
        let (mut name, mut renderer) = (String::new(), String::new());
        for _ in 0..args.runs {
            let begun = Instant::now();
            let mut server = args.servers.run(program, &args.setup)?;
            listening.push(ms(begun));
            runtime.block_on(server.wait_until_ready())?;
            open.push(ms(begun));
            name.clone_from(&server.name);
            renderer.clone_from(&server.renderer);
        }
        open.sort_by(f64::total_cmp);
        let row = json!({
            "load": "start",
            "server": name,
            "renderer": renderer,
            "runs": args.runs,
            "listening_ms": median(listening),
            "open_ms": median(open.clone()),
        });
        rows.push(json!({ "least_ms": open.first(), "most_ms": open.last() }), row)?;
    }
    Ok(())
}
