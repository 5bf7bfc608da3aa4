//! A view's crop and quality at both doors.

use crate::common::{
    cpu_server::{CpuServer, upload},
    doors::{Ask, Options, both},
};

/// The f32 values of an NPY file.
fn npy(file: &[u8]) -> Vec<f32> {
    let header = usize::from(u16::from_le_bytes([file[8], file[9]]));
    let (values, _) = file[10 + header..].as_chunks::<4>();
    values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect()
}

#[tokio::test]
async fn both_doors_give_a_part_and_take_a_quality() {
    let stand = CpuServer::start().await;
    for door in both(stand.addr).await {
        let (id, _) = door.create(&upload(), &Options::wait()).await.expect("a scene");
        let name = door.name();
        let ask = Ask::first().with("kind", "depth").with("format", "npy");
        let whole = npy(&door.view(&id, &ask).await.expect("the whole"));
        let crop = ask.clone().with("crop", "10,7,20,30");
        let part = npy(&door.view(&id, &crop).await.expect("a part"));
        assert_eq!(part.len(), 20 * 30, "values of a part by {name}");
        for (i, depth) in part.iter().enumerate() {
            let want = whole[(7 + i / 20) * 64 + 10 + i % 20];
            assert!((depth - want).abs() <= 1e-4 * want.max(1.0), "{name}: {depth}, not {want}");
        }
        for (case, ask, word) in [
            ("wide", ask.clone().with("crop", "10,7,60,30"), "60x30 px at 10,7"),
            ("empty", ask.clone().with("crop", "0,0,0,9"), "0x9 px at 0,0"),
        ] {
            let fault = door.view(&id, &ask).await.expect_err(case);
            assert_eq!(fault.code, "invalid_request", "{case} by {name}: {}", fault.message);
            assert!(fault.message.contains(word), "{case} by {name}: {}", fault.message);
        }
        let fast = npy(&door.view(&id, &ask.with("quality", "fast")).await.expect("a fast view"));
        for (fast, exact) in fast.iter().zip(&whole) {
            assert!((fast - exact).abs() < 0.05 * exact.max(1.0), "{name}: {fast}, not {exact}");
        }
    }
    for (query, word) in [
        ("from=0&crop=1,2,3", "3 numbers"),
        ("from=0&crop=1,2,3,-4", "-4"),
        ("from=0&quality=best", "exact or fast"),
    ] {
        let url = stand.url(&format!("/v1/scenes/{}/view?{query}", "0".repeat(32)));
        let answer = crate::common::client().get(url).send().await.expect("an answer");
        let fault = crate::common::doors::bytes(answer).await.expect_err(query);
        assert!(fault.message.contains(word), "{query}: {}", fault.message);
    }
}
