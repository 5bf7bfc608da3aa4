//! The laboratory's program: `segsplat-lab COMMAND`. Everything is in the library.

use std::process::ExitCode;

fn main() -> ExitCode {
    segsplat_lab::main()
}
