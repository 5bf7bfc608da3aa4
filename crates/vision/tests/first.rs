//! The first networks of a process, opened by many threads at once.

use std::{process::Command, sync::Barrier};

use segsplat_testing::{opened, ort_library, root};
use segsplat_vision::models::{Bundle, Geometry, NetworkOptions, Runtime};

const THREADS: usize = 16;
/// Processes that try. Without the lock one in seven failed.
const PROCESSES: usize = 24;

/// ONNX Runtime adds the domain of our operators without a lock (microsoft/onnxruntime#22663).
#[test]
fn many_threads_open_the_first_networks_at_once() {
    for _ in 0..PROCESSES {
        let mut one = Command::new(std::env::current_exe().unwrap());
        let tried = one.args(["--ignored", "--exact", "one_process"]).output().unwrap();
        let told = String::from_utf8_lossy(&tried.stdout);
        assert!(tried.status.success() && told.contains("1 passed"), "{told}");
    }
}

#[test]
#[ignore = "the test above starts it, each time in a new process"]
fn one_process() {
    let options =
        NetworkOptions { threads: 1, ort_library: ort_library(), ..NetworkOptions::default() };
    let Some(runtime) = opened(Runtime::load(&options)) else { return };
    let bundle = Bundle::open(&root().join("tests/fixtures/colours")).unwrap();
    let barrier = Barrier::new(THREADS);
    std::thread::scope(|threads| {
        for _ in 0..THREADS {
            threads.spawn(|| {
                barrier.wait();
                Geometry::open(&runtime, &bundle, &options).unwrap();
            });
        }
    });
}
