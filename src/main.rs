//! The program: everything is in the library's `cli`.

use std::process::ExitCode;

fn main() -> ExitCode {
    bound_arenas();
    segsplat::cli::main()
}

/// Limits the heaps of the system's allocator. By default it makes up to eight for each core, and
/// each keeps the memory that it once had: the memory of a server grew over hundreds of scenes.
/// Large arrays are outside of these heaps.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn bound_arenas() {
    const ARENAS: i32 = 2;
    #[expect(unsafe_code, reason = "a call into the C library")]
    // SAFETY: a number of the allocator's own list, set before there is a second thread.
    let _known = unsafe { libc::mallopt(libc::M_ARENA_MAX, ARENAS) };
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn bound_arenas() {}
