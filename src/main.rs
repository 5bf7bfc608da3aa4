//! The program: everything is in the library's `cli`.

use std::process::ExitCode;

fn main() -> ExitCode {
    bound_arenas();
    segsplat::cli::main()
}

/// Limits the heaps of the system's allocator to one a core. By default it makes up to eight a
/// core, and each keeps the memory that it once had: the memory of a server grew over hundreds of
/// scenes. With fewer than cores, calls wait for each other: on 16 cores, two heaps gave 33,000
/// answers of 304 a second, eight 87,000, 32 gave 138,000. Large arrays are outside of these heaps.
#[cfg(all(target_os = "linux", target_env = "gnu"))]
fn bound_arenas() {
    const ARENAS_MAX: usize = 64;
    let cores = std::thread::available_parallelism().map_or(2, |cores| cores.get().max(2));
    let arenas = cores.min(ARENAS_MAX);
    #[expect(unsafe_code, reason = "a call into the C library")]
    // SAFETY: a number of the allocator's own list, set before there is a second thread.
    let _known = unsafe { libc::mallopt(libc::M_ARENA_MAX, arenas as i32) };
}

#[cfg(not(all(target_os = "linux", target_env = "gnu")))]
fn bound_arenas() {}
