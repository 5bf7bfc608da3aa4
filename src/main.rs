//! The program: everything is in the library's `cli`.

use std::process::ExitCode;

fn main() -> ExitCode {
    bound_arenas();
    segsplat::cli::main()
}

/// Heaps that the system's allocator may make. Left alone it makes up to eight a core, one for each
/// of the threads that make, draw and send scenes in turn, and each keeps what it once held: the
/// memory of a server crept on for hundreds of scenes. All large arrays are outside of heaps.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn bound_arenas() {
    const ARENAS: i32 = 2;
    #[expect(unsafe_code, reason = "a call into the C library")]
    // SAFETY: a number of the allocator's own list, set before there is a second thread.
    let _known = unsafe { libc::mallopt(libc::M_ARENA_MAX, ARENAS) };
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn bound_arenas() {}
