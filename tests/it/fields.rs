//! What is wrong with a query string or a JSON body, said in words without a type of Rust.

use crate::common::{cpu_server::CpuServer, doors::bytes};

/// A scene that does not exist: the fields are read before anybody looks for it.
const ABSENT: &str = "00000000000000000000000000000000";

async fn message(request: reqwest::RequestBuilder) -> String {
    bytes(request.send().await.unwrap()).await.expect_err("refused").message
}

#[tokio::test]
async fn messages_name_the_field_the_value_and_what_it_must_be() {
    let stand = CpuServer::start().await;
    let client = crate::common::client();
    let numbers = "it must have 3, separated by commas";
    let kinds = "color, depth, alpha, holes, semantics, relevancy or mask";
    for (query, want) in [
        ("view?from=0&width=abc", "width is \"abc\"; it must be a whole number".to_owned()),
        (
            "view?from=0&width=4294967296",
            "width is \"4294967296\"; it must be a whole number".to_owned(),
        ),
        (
            "view?from=0&error=best",
            "error is \"best\"; it must be a number of levels, exact or fast".to_owned(),
        ),
        (
            "view?from=0&quality=best",
            "quality is \"best\"; it must be a number of levels, exact or fast".to_owned(),
        ),
        ("view?eye=1,2", format!("eye has 2 numbers; {numbers}")),
        ("view?up=0,%201,x", "up is \"x\"; it must be a number".to_owned()),
        ("view?from=0&from=1", "from is given twice".to_owned()),
        (
            "export?limti=1",
            "unknown parameter \"limti\"; this call takes format, preset, canon, tau, cut, \
             unit_rows, coverage_floor, near_best, margin, rivals, text, wait_ms"
                .to_owned(),
        ),
        // Without a text too.
        ("export?canon=", "canon[0] is empty; say what to look for".to_owned()),
        ("pick?from=0&x=1", "y is missing".to_owned()),
        ("pick?from=0&label=cup&x=1&label=a%20table&y=1", format!("no scene has the id {ABSENT}")),
    ] {
        let told = message(client.get(stand.url(&format!("/v1/scenes/{ABSENT}/{query}")))).await;
        assert_eq!(told, want, "{query}");
    }
    for (call, body, want) in [
        ("views", r#"{"cameras": 5}"#, "cameras is 5; it must be a list".to_owned()),
        ("views", r#"{"cameras": [{}, 7]}"#, "cameras[1] is 7; it must be an object".to_owned()),
        (
            "views",
            r#"{"cameras": [{"from": -1}]}"#,
            "cameras[0]: from is -1; it must be a whole number".to_owned(),
        ),
        (
            "views",
            r#"{"cameras": [{"eye": [1, 2]}]}"#,
            "cameras[0]: eye has 2 numbers; it must have 3".to_owned(),
        ),
        ("views", r#"{"cameras": [{"t": 1, "t": 2}]}"#, "cameras[0]: t is given twice".to_owned()),
        (
            "views",
            r#"{"cameras": [{"from": 0}], "kinds": ["smell"]}"#,
            format!("kinds[0] is \"smell\"; it must be {kinds}"),
        ),
        ("query", r#"{"texts": [1]}"#, "texts[0] is 1; it must be a text".to_owned()),
        ("query", "[1]", "body is a list; it must be a JSON object".to_owned()),
    ] {
        let url = stand.url(&format!("/v1/scenes/{ABSENT}/{call}"));
        assert_eq!(message(client.post(url).body(body)).await, want, "{body}");
    }
    for (call, body, start) in [
        ("views", r#"{"cameras": [{"form": 1}]}"#, "cameras[0]: unknown parameter \"form\""),
        ("views", r#"{"background": [0, 0, 0, 0]}"#, "background is a list; it must be backdrop, "),
        ("views", r#"{"background": "sky"}"#, "background is \"sky\"; it must be backdrop, "),
        ("query", "{", "body: not valid JSON"),
    ] {
        let url = stand.url(&format!("/v1/scenes/{ABSENT}/{call}"));
        let told = message(client.post(url).body(body)).await;
        assert!(told.starts_with(start), "{body}: {told}");
    }
}
