//! A view's crop and the error that it accepts at both doors.

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
async fn both_doors_give_a_part_and_take_an_error() {
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
        let colors = Ask::first().with("format", "npy");
        let exact = npy(&door.view(&id, &colors).await.expect("an exact view"));
        let asked = [("error", "8"), ("error", "0.5"), ("quality", "fast"), ("quality", "exact")];
        for ((option, value), levels) in asked.into_iter().zip([8.0, 0.5, 2.0, 0.0]) {
            let what = format!("{option}={value} by {name}");
            let (file, told) =
                door.bounded(&id, &colors.clone().with(option, value)).await.expect(&what);
            assert_eq!(told.error, levels, "{what}: the bound that is told");
            for (got, want) in npy(&file).iter().zip(&exact) {
                assert!((got - want).abs() <= levels / 255.0 + 1e-5, "{what}: {got}, not {want}");
            }
        }
        let (file, told) = door.bounded(&id, &ask.clone().with("error", "8")).await.expect("depth");
        assert_eq!((told.error, npy(&file)), (0.0, whole), "depth is exact by {name}");
        // A scene of few Gaussians has no merged ones.
        let detail = colors.clone().with("detail", "0.75");
        let (file, told) = door.bounded(&id, &detail).await.expect("a detail");
        assert_eq!((told.error, told.detail), (0.0, 0.75), "the detail is told by {name}");
        assert_eq!(npy(&file), exact, "nothing is merged by {name}");
        let fault = door.view(&id, &detail.with("detail", "17")).await.expect_err("17 pixels");
        assert_eq!(fault.message, "detail is 17; it must be 0 to 16 pixels", "17 by {name}");
        let fault = door.view(&id, &ask.with("error", "33")).await.expect_err("33 levels");
        assert_eq!(fault.code, "invalid_request", "33 by {name}");
        let told = "error is 33; it must be 0 to 32 levels of 255, exact (0) or fast (2)";
        assert_eq!(fault.message, told, "33 by {name}");
    }
    for (query, word) in [
        ("from=0&crop=1,2,3", "3 numbers"),
        ("from=0&crop=1,2,3,-4", "-4"),
        ("from=0&error=best", "a number of levels, exact or fast"),
    ] {
        let url = stand.url(&format!("/v1/scenes/{}/view?{query}", "0".repeat(32)));
        let answer = crate::common::client().get(url).send().await.expect("an answer");
        let fault = crate::common::doors::bytes(answer).await.expect_err(query);
        assert!(fault.message.contains(word), "{query}: {}", fault.message);
    }
}
