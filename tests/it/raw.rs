//! Samples without a codec, and how close the encoders are to them, at both doors.

use crate::common::{
    client,
    cpu_server::{CpuServer, upload},
    doors::{Ask, Options, both, bytes},
};

/// Largest difference of two lists of samples.
fn apart(a: &[u8], b: &[u8]) -> u8 {
    assert_eq!(a.len(), b.len(), "as many samples");
    a.iter().zip(b).map(|(a, b)| a.abs_diff(*b)).max().unwrap_or(0)
}

#[tokio::test]
async fn samples_without_a_codec_are_those_of_the_png() {
    let stand = CpuServer::start().await;
    for door in both(stand.addr).await {
        let (id, _) = door.create(&upload(), &Options::wait()).await.expect("a scene");
        let name = door.name();
        let view = async |kind: &str, format: &str| {
            let ask = Ask::first().with("kind", kind).with("format", format);
            door.view(&id, &ask).await
        };
        let picture = async |kind: &str, format: &str| {
            let file = view(kind, format).await.expect("a file");
            image::load_from_memory(&file).expect("a picture")
        };
        let rgb = view("color", "rgb8").await.expect("colour");
        assert_eq!(rgb.len(), 64 * 48 * 3, "{name}");
        assert!(apart(&rgb, &vec![rgb[0]; rgb.len()]) > 50, "{name}: the view shows something");
        for format in ["png", "webp"] {
            assert_eq!(picture("color", format).await.to_rgb8().into_raw(), rgb, "{format}");
        }
        assert!(apart(picture("color", "jpeg").await.to_rgb8().as_raw(), &rgb) < 40, "{name}");
        let alpha = view("alpha", "grey8").await.expect("alpha");
        assert_eq!(picture("alpha", "png").await.to_luma8().into_raw(), alpha, "{name}");
        let rgba = view("color", "rgba8").await.expect("both");
        let (pixels, rest) = rgba.as_chunks::<4>();
        assert!(rest.is_empty());
        let colour: Vec<u8> = pixels.iter().flat_map(|[r, g, b, _]| [*r, *g, *b]).collect();
        let last: Vec<u8> = pixels.iter().map(|pixel| pixel[3]).collect();
        assert_eq!((colour, last), (rgb, alpha), "{name}");
        for (kind, format, word) in [
            ("alpha", "rgb8", "grey8"),
            ("alpha", "rgba8", "grey8"),
            ("color", "grey8", "rgb8"),
            ("depth", "rgb8", "npy"),
            ("depth", "grey8", "npy"),
        ] {
            let fault = view(kind, format).await.expect_err("refused");
            assert_eq!(fault.code, "invalid_request", "{kind} {format} by {name}");
            assert!(fault.message.contains(word), "{kind} {format} by {name}: {}", fault.message);
        }
    }
}

#[tokio::test]
async fn headers_say_type_and_shape_and_accept_may_ask() {
    let stand = CpuServer::start().await;
    let (id, _) = both(stand.addr).await[0].create(&upload(), &Options::wait()).await.unwrap();
    let url = stand.url(&format!("/v1/scenes/{id}/view?from=0&width=32&height=24"));
    for (format, kind, shape) in
        [("rgb8", "color", "24,32,3"), ("rgba8", "color", "24,32,4"), ("grey8", "alpha", "24,32")]
    {
        let wanted = format!("application/x-{format}");
        let request = client().get(format!("{url}&kind={kind}")).header("accept", &wanted);
        let answer = request.send().await.expect("an answer");
        assert_eq!(answer.headers()["content-type"], wanted.as_str());
        assert_eq!(answer.headers()["x-shape"], shape);
        let length: usize = shape.split(',').map(|side| side.parse::<usize>().unwrap()).product();
        assert_eq!(bytes(answer).await.unwrap().len(), length, "{format}");
    }
    let answer = client().get(&url).send().await.expect("an answer");
    assert!(!answer.headers().contains_key("x-shape"), "a PNG says its own size");
}

#[tokio::test]
async fn a_large_jpeg_keeps_its_colours() {
    let stand = CpuServer::start().await;
    let door = &both(stand.addr).await[0];
    let (id, _) = door.create(&upload(), &Options::wait()).await.unwrap();
    // Sides that are no multiples of the codec's blocks.
    let ask = Ask::default().with("from", 0).with("width", 733).with("height", 541);
    let want = door.view(&id, &ask.clone().with("format", "rgb8")).await.unwrap();
    let jpeg = door.view(&id, &ask.with("format", "jpeg")).await.unwrap();
    let got = image::load_from_memory(&jpeg).unwrap().to_rgb8().into_raw();
    let square = |(a, b): (&u8, &u8)| f64::from(a.abs_diff(*b)).powi(2);
    let mean = got.iter().zip(&want).map(square).sum::<f64>() / want.len() as f64;
    let psnr = 10.0 * (255.0 * 255.0 / mean).log10();
    assert!(got.len() == want.len() && psnr > 30.0, "{psnr} dB");
}
