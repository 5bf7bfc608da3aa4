//! Uploads over HTTP that are refused while they are read; messages name the bound.

use std::sync::Arc;

use reqwest::multipart::{Form, Part};
use segsplat::service::QuerySpec;

use crate::common::{
    doors::{Fault, Options, both, bytes},
    meaning::PhotoMeaning,
    server::{PATIENCE, TestServer, upload},
};

async fn refused(server: &TestServer, form: Form) -> Fault {
    let request = crate::common::client().post(server.url("/v1/scenes")).multipart(form);
    bytes(request.send().await.unwrap()).await.expect_err("refused")
}

fn file(name: &str, size: usize) -> Part {
    Part::bytes(vec![b' '; size]).file_name(name.to_owned())
}

#[tokio::test]
async fn limits_stop_an_upload_at_the_first_byte_over_and_name_the_bound() {
    let server = TestServer::with(|config, _| {
        config.limits.archive_entries_max = 3;
        config.limits.json_bytes_max = 10;
        config.limits.upload_bytes_max = 100;
        config.limits.uploads_bytes_max = 150;
    })
    .await;
    let photos = |count: usize| {
        (0..count).fold(Form::new(), |form, i| form.part("photo", file(&format!("{i}.png"), 1)))
    };
    // The budget holds one of these uploads: their bytes are not counted after the refusal.
    for _ in 0..3 {
        for (form, words) in [
            (Form::new().part("transforms", file("t.json", 11)), ["11 bytes", "10 bytes"]),
            (photos(4), ["\"3.png\" is number 4", "3 files"]),
            (Form::new().part("photo", file("a.png", 101)), ["101 bytes", "100 bytes"]),
            (Form::new().part("photo", file(&"x".repeat(257), 1)), ["257 bytes", "256 bytes"]),
            (Form::new().part("splats", file(&"x".repeat(257), 1)), ["257 bytes", "256 bytes"]),
            (Form::new().part("splats", file("a.ply", 101)), ["101 bytes", "100 bytes"]),
        ] {
            let fault = refused(&server, form).await;
            assert_eq!(fault.code, "limit_exceeded", "{fault:?}");
            for word in words {
                assert!(fault.message.contains(word), "{fault:?} lacks {word}");
            }
        }
    }
}

#[tokio::test]
async fn an_upload_that_cannot_be_a_scene_says_what_is_missing() {
    let server = TestServer::start().await;
    let photo = |form: Form, part: &'static str, name: &str| form.part(part, file(name, 1));
    let plain = || Form::new().percent_encode_noop();
    let cameras = || Form::new().text("cameras", "{}");
    for (form, word) in [
        (Form::new().text("density", "full"), "no photos"),
        (photo(photo(Form::new(), "photo", "a.png"), "photo", "a.png"), "\"a.png\" was sent twice"),
        (photo(Form::new(), "photo", "a.png"), "1 photo; a scene needs at least 2"),
        (photo(cameras(), "photo", "a.png"), "1 photo; a scene needs at least 2"),
        (cameras().text("transforms", "{}"), "camera description given twice"),
        (cameras().part("archive", file("a.zip", 1)), "its own camera description"),
        (cameras().part("splats", file("a.ply", 1)), "without other files"),
        (photo(Form::new().part("splats", file("a.ply", 1)), "p", "a.png"), "without other files"),
        (
            Form::new().part("splats", file("a.ply", 1)).part("splats", file("b.ply", 1)),
            "two files of Gaussians",
        ),
        (photo(Form::new().part("archive", file("a.zip", 1)), "p", "a.png"), "its own photos"),
        // A photo is named by its part where that has an extension, else by its file.
        (
            photo(photo(plain(), "images/a.png", "b.png"), "images/a.png", "c.png"),
            "\"images/a.png\" was sent twice",
        ),
        (Form::new().text("a.png", "x").text("a.png", "x"), "\"a.png\" was sent twice"),
        (Form::new().text("", "x"), "a part has no name"),
        (Form::new().text("density", "full").text("density", "full"), "density is given twice"),
    ] {
        let fault = refused(&server, form).await;
        assert_eq!(fault.code, "invalid_request", "{fault:?}");
        assert!(fault.message.contains(word), "{fault:?} lacks {word}");
    }
}

#[tokio::test]
async fn what_words_name_is_left_out_of_a_scene_over_both_doors() {
    let meaning = Arc::new(PhotoMeaning::default());
    let given = Arc::clone(&meaning);
    let server = TestServer::with(|_, parts| parts.semantics = given).await;
    for door in both(server.addr).await {
        let gaussians = async |ignore: Vec<&'static str>| {
            let options = Options { ignore, ..Options::wait() };
            let (id, state) = door.create(&upload(), &options).await.expect("a good upload");
            assert_eq!(state, "done", "{}", door.name());
            let status = server.service.get(&id.parse().unwrap()).await.unwrap();
            (id, status.report.unwrap().gaussians)
        };
        let (_, all) = gaussians(Vec::new()).await;
        let (id, rest) = gaussians(vec!["person", " dog "]).await;
        assert_eq!(2 * rest, all, "the stand-in finds each word in half of a photo");
        // The semantics are those of the photos without it.
        server.service.query(&id.parse().unwrap(), spec()).await.expect("texts are answered");
        for (words, why) in [(vec![""; 1], "ignore[0] is empty"), (vec!["a"; 129], "128")] {
            let options = Options { ignore: words, ..Options::wait() };
            let fault = door.create(&upload(), &options).await.unwrap_err();
            assert!(fault.message.contains("ignore"), "{fault:?}");
            assert!(fault.message.contains(why), "{fault:?} lacks {why}");
        }
    }
    // The second door's scene has the content of the first one's.
    assert_eq!(*meaning.ignored.lock().unwrap(), [["person", "dog"]], "once for all");
}

fn spec() -> QuerySpec {
    QuerySpec { texts: vec!["photo 0".to_owned()], wait: Some(PATIENCE), ..QuerySpec::default() }
}
