//! What texts find: in space, in a view, under a pixel and in an export; how often a view is drawn
//! for them; and the error of each bad text at both doors.

use std::{
    collections::BTreeMap,
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use futures_util::StreamExt;
use segsplat::{
    error::ErrorCode,
    limits::Limits,
    scene::{Method, Preset, SceneCamera, SceneId, SceneOptions, SemanticsMode, SemanticsState},
    service::{
        Boxes, CreateScene, ExportFormat, FeatureKind, FeaturesSpec, Format, KnownWord, MaskFormat,
        PickSpec, PictureKind, PictureOptions, QuerySpec, Rle, ScoringOptions, TextOptions, Trust,
        ViewOptions, ViewSpec, ViewsSpec,
    },
};

use crate::common::{
    cpu_server::{self, CpuServer},
    doors::{Ask, Options, both, bytes, json},
    meaning::PhotoMeaning,
    server::{CountingRenderer, PATIENCE, TestServer, first_view, upload},
};

struct Fixture {
    server: TestServer,
    meaning: Arc<PhotoMeaning>,
    renderer: Arc<CountingRenderer>,
}

async fn fixture() -> Fixture {
    fixture_with(|_| ()).await
}

async fn fixture_with(change: impl FnOnce(&mut Limits)) -> Fixture {
    let meaning = Arc::new(PhotoMeaning::default());
    let renderer = Arc::new(CountingRenderer::default());
    let (given, drawing) = (Arc::clone(&meaning), Arc::clone(&renderer));
    let server = TestServer::with(|config, parts| {
        change(&mut config.limits);
        parts.semantics = given;
        parts.renderer = drawing;
    });
    Fixture { server: server.await, meaning, renderer }
}

impl Fixture {
    async fn scene(&self, semantics: SemanticsMode) -> SceneId {
        let options = SceneOptions { semantics, ..SceneOptions::default() };
        let wait = Some(PATIENCE);
        let request = CreateScene { upload: upload(), options, wait, ..CreateScene::default() };
        self.server.service.create_scene(request).await.expect("a good upload").status.id
    }
}

fn texts(texts: &[&str]) -> Vec<String> {
    texts.iter().map(|&text| text.to_owned()).collect()
}

fn in_view(asked: &[&str]) -> QuerySpec {
    let view = first_view();
    QuerySpec { texts: texts(asked), camera: Some(view.camera), ..QuerySpec::default() }
}

fn view(kind: PictureKind, text: Option<&str>, format: Format) -> ViewSpec {
    let ask = TextOptions { text: text.map(str::to_owned), ..TextOptions::default() };
    let picture = PictureOptions { format, ..PictureOptions::default() };
    ViewSpec { kind, picture, text: ask, ..first_view() }
}

/// Whether each pixel of an 8-bit grey PNG is white; black is the only other value.
fn white(png: &[u8]) -> Vec<bool> {
    let picture = image::load_from_memory(png).unwrap().to_luma8();
    picture
        .pixels()
        .map(|p| match p.0[0] {
            0 => false,
            255 => true,
            other => panic!("a mask with {other}"),
        })
        .collect()
}

#[tokio::test(flavor = "multi_thread")]
async fn a_text_finds_its_gaussians_in_space_and_in_a_view() {
    let Fixture { server, meaning, .. } = &fixture().await;
    let fixture = &server.service;
    let status = server.scene().await;
    let spec = QuerySpec {
        mask: MaskFormat::Png,
        relevancy: true,
        ..in_view(&["photo 1", " photo 7 ", "photo 0"])
    };
    let answer = fixture.query(&status.id, spec.clone()).await.unwrap();
    assert_eq!((answer.bank_size, answer.results.len()), (3, 3));
    let [one, absent, first] = &answer.results[..] else { panic!("three texts") };
    let each = status.report.unwrap().gaussians / 3;
    assert_eq!((one.entries.as_slice(), one.gaussians), (&[2_u16][..], each));
    assert!(one.scores[1] > 0.99 && one.scores[0] < 0.51 && one.scores.len() == 3);
    assert!((absent.text.as_str(), absent.gaussians, absent.parts.len()) == ("photo 7", 0, 0));
    let part = &one.parts[0];
    assert!(part.gaussians <= each && part.size.iter().all(|side| *side >= 0.0), "{part:?}");
    // The wall stands at one depth of camera 1 and is as wide as its photo there.
    assert!(part.center[2].is_finite() && part.size[0] > 0.1, "{part:?}");

    let camera = answer.camera.unwrap().intrinsics;
    let seen = first.view.as_ref().unwrap();
    let mask = white(seen.mask_png.as_ref().unwrap());
    assert_eq!(mask.len(), (camera.width * camera.height) as usize);
    assert_eq!(mask.iter().filter(|on| **on).count() as u64, seen.area);
    assert!(seen.area > 0, "photo 0 is what camera 0 sees");
    let [left, top, width, height] = seen.bbox.unwrap();
    assert!(left + width <= camera.width && top + height <= camera.height);
    let inside = |i: usize| {
        let (x, y) = (i as u32 % camera.width, i as u32 / camera.width);
        (left..left + width).contains(&x) && (top..top + height).contains(&y)
    };
    assert!(mask.iter().enumerate().all(|(i, on)| !on || inside(i)), "a pixel outside its box");
    let peak = seen.peak.unwrap();
    assert!(mask[(peak.y * camera.width + peak.x) as usize] && peak.relevancy > 0.99);
    let relevancy = image::load_from_memory(seen.relevancy_png.as_ref().unwrap()).unwrap();
    let relevancy = relevancy.to_luma8();
    assert!(mask.iter().zip(relevancy.pixels()).all(|(on, p)| *on == (p.0[0] > 127)));
    let nothing = absent.view.as_ref().unwrap();
    assert_eq!((nothing.area, nothing.bbox, nothing.peak), (0, None, None));

    let spec = QuerySpec { mask: MaskFormat::Rle, boxes: Boxes::None, ..spec };
    let answer = fixture.query(&status.id, spec).await.unwrap();
    let rle = answer.results[2].view.as_ref().unwrap().mask_rle.clone();
    assert_eq!(rle.unwrap(), Rle::encode(&mask, camera.width, camera.height));
    assert!(answer.results[0].parts.is_empty(), "no boxes were asked for");
    assert_eq!(meaning.calls.load(Ordering::Acquire), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_hundred_texts_take_one_drawing_and_a_known_view_takes_none() {
    let fixture = fixture().await;
    let id = fixture.scene(SemanticsMode::Lazy).await;
    let hundred: Vec<String> = (0..100).map(|i| format!("text {i}")).collect();
    let spec = QuerySpec { texts: hundred.clone(), ..in_view(&[]) };
    let service = &fixture.server.service;
    let answer = service.query(&id, spec.clone()).await.unwrap();
    assert_eq!((answer.results.len(), fixture.renderer.counts()), (100, [1, 0, 1]));
    assert!(answer.render_ms.unwrap() > 0.0);
    // 100 texts and the three canonical phrases.
    assert_eq!(fixture.meaning.embedded.load(Ordering::Acquire), 103);
    let again = service.query(&id, spec).await.unwrap();
    assert_eq!(again.render_ms, Some(0.0));
    assert_eq!(again.results, answer.results);
    service.query(&id, in_view(&["photo 2"])).await.unwrap();
    for (kind, text) in
        [(PictureKind::Mask, Some("photo 0")), (PictureKind::Relevancy, Some("new"))]
    {
        service.render(&id, view(kind, text, Format::Png)).await.unwrap();
    }
    service.render(&id, view(PictureKind::Semantics, None, Format::Png)).await.unwrap();
    assert_eq!(fixture.renderer.counts(), [1, 0, 1], "E of the view answers every text");
    assert_eq!(fixture.meaning.embedded.load(Ordering::Acquire), 106, "three new words");
    let paper = {
        let spec = in_view(&["photo 2"]);
        let options = ViewOptions { preset: Some(Preset::Paper), ..spec.options };
        QuerySpec { options, ..spec }
    };
    let paper = service.query(&id, paper).await.unwrap();
    assert_eq!((paper.scoring.unit_rows, paper.scoring.tau), (false, 10.0));
    let wide = ViewOptions { width: Some(40), ..ViewOptions::default() };
    let other = QuerySpec { options: wide, ..in_view(&["photo 2"]) };
    service.query(&id, other).await.unwrap();
    assert_eq!(fixture.renderer.counts(), [3, 0, 3], "another method or size is another view");
}

#[tokio::test(flavor = "multi_thread")]
async fn what_nobody_kept_is_asked_once_a_call_and_not_at_the_renderer() {
    // As after an eviction: no embedding and no bank is kept.
    let fixture = fixture_with(|limits| {
        (limits.texts_cached_max, limits.scorers_cache_bytes_max) = (0, 0);
    });
    let fixture = fixture.await;
    let id = &fixture.scene(SemanticsMode::Eager).await;
    let service = &fixture.server.service;
    let embedded = || fixture.meaning.embedded.swap(0, Ordering::AcqRel);
    embedded();
    let camera = first_view().camera;
    let options = ViewOptions::default();
    // The three canonical phrases, and the texts.
    service.query(id, in_view(&["photo 0", "photo 1"])).await.unwrap();
    assert_eq!(embedded(), 3 + 2, "a query");
    service.render(id, view(PictureKind::Mask, Some("photo 0"), Format::Png)).await.unwrap();
    assert_eq!(embedded(), 3 + 1, "a view");
    let mask = view(PictureKind::Mask, Some("photo 0"), Format::Png);
    let ViewSpec { options: how, picture, text, .. } = mask;
    let kinds = vec![PictureKind::Mask, PictureKind::Color];
    let many = ViewsSpec { cameras: vec![camera; 4], kinds, options: how, picture, text };
    let views: Vec<_> = service.render_many(id, &many).await.unwrap().collect().await;
    assert!(views.len() == 8 && views.iter().all(Result::is_ok));
    assert_eq!(embedded(), 3 + 1, "four views with two pictures each");
    let (scoring, wait) = (ScoringOptions::default(), None);
    let (labels, own) = (texts(&["photo 0"]), (options.clone(), scoring.clone()));
    let (x, y) = (8.0, 8.0);
    let pick = PickSpec { camera, x, y, options: own.0, labels, scoring: own.1, wait };
    service.pick(id, pick).await.unwrap();
    assert_eq!(embedded(), 3 + 1, "a pick");
    let kind = FeatureKind::Weights;
    let features = FeaturesSpec { camera, options, kind, scoring, wait };
    let file = service.features(id, features).await.unwrap().begin().await.unwrap();
    let file: Vec<_> = file.into_stream().collect().await;
    assert!(file.iter().all(Result::is_ok));
    assert_eq!(embedded(), 3, "features");
    for format in [ExportFormat::Ply, ExportFormat::Html, ExportFormat::Coco] {
        let ask = TextOptions { text: Some("photo 0".to_owned()), ..TextOptions::default() };
        let file = service.export(id, format, None, &ask).await.unwrap();
        let file = file.begin().await.unwrap();
        let file: Vec<_> = file.into_stream().collect().await;
        assert!(file.iter().all(Result::is_ok));
        assert_eq!(embedded(), 3 + 1, "{format}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_mask_alone_is_a_blend_and_equals_the_mask_of_the_entries() {
    let fixture = fixture().await;
    let id = fixture.scene(SemanticsMode::Lazy).await;
    let service = &fixture.server.service;
    let mask = || view(PictureKind::Mask, Some("photo 0"), Format::Png);
    assert_eq!(service.view_etag(&id, &mask()).await.unwrap(), None, "nobody knows it yet");
    let blended = service.render(&id, mask()).await.unwrap();
    assert_eq!(fixture.renderer.counts(), [1, 1, 0]);
    assert!(white(&blended.bytes).contains(&true) && white(&blended.bytes).contains(&false));
    service.query(&id, in_view(&["photo 1"])).await.unwrap();
    let kept = service.render(&id, mask()).await.unwrap();
    assert_eq!((kept.bytes, &kept.etag), (blended.bytes, &blended.etag));
    assert_eq!(fixture.renderer.counts(), [2, 1, 1]);
    assert_eq!(service.view_etag(&id, &mask()).await.unwrap().unwrap(), blended.etag);
    let mut other = mask();
    other.text.text = Some("photo 1".to_owned());
    assert_ne!(service.view_etag(&id, &other).await.unwrap().unwrap(), blended.etag);

    let numbers =
        service.render(&id, view(PictureKind::Semantics, None, Format::Npy)).await.unwrap();
    let entries: Vec<f32> =
        numbers.bytes[128..].chunks(4).map(|b| f32::from_le_bytes(b.try_into().unwrap())).collect();
    assert!(entries.iter().all(|m| [0.0, 1.0, 2.0, 3.0].contains(m)));
    let own: Vec<bool> = entries.iter().map(|m| (m - 1.0).abs() < 0.5).collect();
    let mask = service.render(&id, mask()).await.unwrap();
    assert_eq!(white(&mask.bytes), own, "photo 0 is entry 1");
}

#[tokio::test(flavor = "multi_thread")]
async fn a_pick_tells_depth_point_gaussian_entry_and_labels() {
    let fixture = fixture().await;
    let id = fixture.scene(SemanticsMode::Lazy).await;
    let service = &fixture.server.service;
    let pick = |labels: &[&str]| PickSpec {
        camera: first_view().camera,
        x: 30.5,
        y: 20.5,
        options: ViewOptions::default(),
        labels: texts(labels),
        scoring: ScoringOptions::default(),
        wait: None,
    };
    let bare = service.pick(&id, pick(&[])).await.unwrap();
    assert!(bare.alpha > 0.5 && bare.gaussian.is_some(), "{bare:?}");
    assert_eq!((bare.entry, bare.labels.len()), (None, 0));
    let state = service.get(&id).await.unwrap().semantics.state;
    assert_eq!(state, SemanticsState::None, "a pick without labels asks for no semantics");
    let named = service.pick(&id, pick(&["photo 2", "photo 0", "photo 1"])).await.unwrap();
    assert_eq!((named.gaussian, named.depth), (bare.gaussian, bare.depth));
    let entry = named.entry.unwrap();
    assert_eq!(named.labels[0].text, format!("photo {}", entry - 1), "the best label first");
    assert!(named.labels[0].relevancy > 0.99 && named.labels[1].relevancy < 0.51);
    // The point lies at the depth, and the view from there sees it at the pixel.
    let camera = service.get(&id).await.unwrap().cameras[0].camera;
    let at = camera.camera_to_world.viewmat().transform_point3(named.point.unwrap().into());
    assert!((at.z - named.depth.unwrap()).abs() < 1e-9);
    let (u, v) = camera.intrinsics.project(at);
    assert!((u - 30.5).abs() < 1e-6 && (v - 20.5).abs() < 1e-6, "{u} {v}");
    let outside = PickSpec { x: 64.0, ..pick(&[]) };
    let error = service.pick(&id, outside).await.unwrap_err();
    assert_eq!(error.message(), "x is 64; the picture is 64 px wide");
}

#[tokio::test(flavor = "multi_thread")]
async fn both_doors_give_the_same_features() {
    let fixture = fixture().await;
    let id = fixture.scene(SemanticsMode::Lazy).await.to_string();
    let mut files = Vec::new();
    for door in both(fixture.server.addr).await {
        let dense = Ask::first().with("kind", "features").with("preset", "paper");
        let weights = door.features(&id, &Ask::first()).await.unwrap();
        let features = door.features(&id, &dense).await.unwrap();
        assert!(features.len() > weights.len(), "{} and {}", features.len(), weights.len());
        files.push([weights, features]);
        let odd = door.features(&id, &Ask::first().with("front_photos", 5000)).await.unwrap_err();
        assert_eq!(odd.message, "front_photos is 5000; it must be 0 to 1024");
    }
    assert_eq!(files[0], files[1]);
}

#[tokio::test(flavor = "multi_thread")]
async fn features_over_their_limit_are_refused_and_weights_are_not() {
    let meaning: Arc<PhotoMeaning> = Arc::default();
    let server = TestServer::with(|config, parts| {
        config.limits.features_bytes_max = 1 << 10;
        parts.semantics = meaning;
        parts.renderer = Arc::new(CountingRenderer::default());
    });
    let fixture =
        Fixture { server: server.await, meaning: Arc::default(), renderer: Arc::default() };
    let id = fixture.scene(SemanticsMode::Lazy).await.to_string();
    for door in both(fixture.server.addr).await {
        door.features(&id, &Ask::first()).await.unwrap();
        let dense = Ask::first().with("kind", "features");
        let fault = door.features(&id, &dense).await.unwrap_err();
        assert_eq!(fault.code, "limit_exceeded", "{}", door.name());
        let told = ["64x48 px", "bytes", "1024 bytes"];
        assert!(told.iter().all(|part| fault.message.contains(part)), "{}", fault.message);
    }
}

/// The method that a scene was made by, as each door's caller asked.
#[tokio::test(flavor = "multi_thread")]
async fn a_scene_is_made_by_the_preset_that_each_door_names() {
    let server = CpuServer::start().await;
    for door in both(server.addr).await {
        let mut made = Vec::new();
        for preset in [None, Some("paper")] {
            let options = Options { preset, ..Options::wait() };
            let (id, _) = door.create(&cpu_server::upload(), &options).await.unwrap();
            let status = server.service.get(&id.parse().unwrap()).await.unwrap();
            made.push(status.report.unwrap().method);
        }
        let want = [Preset::Default, Preset::Paper].map(Method::of);
        assert_eq!(made, want, "{}", door.name());
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_export_of_a_text_holds_what_it_selects() {
    let fixture = fixture().await;
    let id = fixture.scene(SemanticsMode::Lazy).await;
    let service = &fixture.server.service;
    let export = async |text: Option<&str>| {
        let ask = TextOptions { text: text.map(str::to_owned), ..TextOptions::default() };
        let export = service.export(&id, ExportFormat::Ply, None, &ask).await.unwrap();
        let etag = export.etag.clone();
        let export = export.begin().await.unwrap();
        let size = export.size_bytes;
        let file: Vec<u8> = export.into_stream().map(Result::unwrap).concat().await;
        assert_eq!(size, Some(file.len() as u64));
        let count = String::from_utf8_lossy(&file[..400])
            .lines()
            .find_map(|line| line.strip_prefix("element vertex ")?.parse::<u64>().ok())
            .expect("a PLY with vertices");
        (count, etag)
    };
    let (all, whole) = export(None).await;
    let (part, etag) = export(Some("photo 2")).await;
    assert_eq!(part * 3, all);
    assert_ne!(etag, whole);
    assert_eq!(export(Some("photo 7")).await.0, 0, "a text that selects nothing");
    // SOG cannot be empty. Who has the file is told so before it is made, and so not of that.
    let url = fixture.server.url(&format!("/v1/scenes/{id}/export?format=sog&text=photo%207"));
    let get = || crate::common::client().get(&url);
    assert_eq!(get().send().await.unwrap().status(), 400);
    assert_eq!(get().header("if-none-match", "*").send().await.unwrap().status(), 304);
}

#[tokio::test(flavor = "multi_thread")]
async fn bad_texts_are_told_each_what_is_wrong_by_both_doors() {
    let fixture = fixture().await;
    let id = fixture.scene(SemanticsMode::Lazy).await.to_string();
    let off = fixture.scene(SemanticsMode::Off).await.to_string();
    let long = "x".repeat(10_000);
    let many: Vec<&str> = vec!["chair"; 129];
    fixture.server.service.understand(&id.parse().unwrap(), None).await.unwrap();
    let cases: Vec<(&str, &str, Vec<&str>, &str, &str)> = vec![
        ("empty", &id, vec!["chair", ""], "invalid_request", "texts[1] is empty"),
        ("no texts", &id, vec![], "invalid_request", "give 1 to 128"),
        ("long", &id, vec![&long], "limit_exceeded", "10000 characters is over 256"),
        ("control", &id, vec!["a\u{1b}b"], "invalid_request", "U+001B at 1"),
        ("129 texts", &id, many, "limit_exceeded", "texts: 129 is over 128"),
        ("off", &off, vec!["chair"], "semantics_off", "semantics=off"),
    ];
    for door in both(fixture.server.addr).await {
        let mut messages = BTreeMap::new();
        for (case, id, texts, code, words) in &cases {
            let fault = door.query(id, texts, None, None).await.expect_err(case);
            let case = format!("{case} by {}", door.name());
            assert_eq!(&fault.code, code, "{case}: {}", fault.message);
            assert!(fault.message.contains(words), "{case}: {:?} lacks {words:?}", fault.message);
            if let Some(other) = messages.insert(fault.message.clone(), case.clone()) {
                panic!("{case} and {other} say the same");
            }
        }
        let view = Ask::first();
        let found = door.query(&id, &["🦊", "кресло", "?zzz"], Some(&view), None).await.unwrap();
        assert!(found.iter().all(|one| one.gaussians == 0 && one.area == Some(0)), "{found:?}");
        assert_eq!(found[2].warnings, ["unknown_words"], "it knows no word of it");
        assert!(found[0].warnings.is_empty());
        let found = door.query(&id, &["photo 0"], Some(&view), None).await.unwrap();
        assert!(found[0].gaussians > 0 && found[0].parts[0].len() > 12 && found[0].area > Some(0));
        for (ask, words) in [
            (view.clone().with("kind", "mask"), "kind=mask needs text"),
            (
                view.clone().with("kind", "mask").with("text", "a").with("format", "jpeg"),
                "does not survive JPEG",
            ),
        ] {
            let fault = door.view(&id, &ask).await.expect_err(words);
            assert_eq!(fault.code, "invalid_request");
            assert!(fault.message.contains(words), "{}", fault.message);
        }
        let (gaussian, entry, labels) =
            door.pick(&id, &view, [32.0, 24.0], &["photo 1", "photo 0"]).await.unwrap();
        assert!(gaussian.is_some() && entry.is_some() && labels.len() == 2);
        let fault = door.pick(&id, &view, [-1.0, 2.0], &[]).await.unwrap_err();
        assert!(fault.message.contains("x is -1"), "{}", fault.message);
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn a_query_while_semantics_run_waits_or_is_told_how_far_they_are() {
    let fixture = fixture().await;
    fixture.meaning.hold.store(true, Ordering::Release);
    let id = fixture.scene(SemanticsMode::Lazy).await.to_string();
    for door in both(fixture.server.addr).await {
        let fault = door.query(&id, &["photo 0"], None, Some(0)).await.unwrap_err();
        assert_eq!(fault.code, "scene_not_ready", "{}", fault.message);
        assert!(fault.message.contains("are being made"), "{}", fault.message);
        assert_eq!(fault.retry_after.as_deref(), Some("2"), "{}", door.name());
        let view = Ask::first().with("width", 32);
        door.view(&id, &view).await.expect("it can be viewed meanwhile");
    }
    let [http, grpc] = both(fixture.server.addr).await;
    let let_go = async {
        tokio::time::sleep(Duration::from_millis(50)).await;
        fixture.meaning.hold.store(false, Ordering::Release);
    };
    let (a, b, ()) = tokio::join!(
        http.query(&id, &["photo 0"], None, None),
        grpc.query(&id, &["photo 0"], None, None),
        let_go
    );
    assert_eq!(a.unwrap(), b.unwrap(), "both doors say the same");
    assert_eq!(fixture.meaning.calls.load(Ordering::Acquire), 1);
}

#[tokio::test(flavor = "multi_thread")]
async fn a_bundle_without_a_text_tower_says_so_to_every_text_call() {
    let meaning = PhotoMeaning { lack: Some("no text tower"), ..PhotoMeaning::default() };
    let server = TestServer::with(|_, parts| parts.semantics = Arc::new(meaning)).await;
    let id = server.scene().await.id;
    for door in both(server.addr).await {
        let view = Ask::first().with("kind", "mask");
        let faults = [
            door.query(id.as_str(), &["chair"], None, None).await.unwrap_err(),
            door.view(id.as_str(), &view).await.unwrap_err(),
            door.pick(id.as_str(), &Ask::first(), [3.0, 3.0], &["chair"]).await.unwrap_err(),
        ];
        for fault in faults {
            assert_eq!(fault.code, "model_unavailable", "{}", fault.message);
            assert!(fault.message.contains("no text tower"), "{}", fault.message);
        }
    }
    let export = format!("/v1/scenes/{id}/export?text=chair");
    let fault = bytes(crate::common::client().get(server.url(&export)).send().await.unwrap())
        .await
        .unwrap_err();
    assert_eq!(fault.code, ErrorCode::ModelUnavailable.name());
}

#[tokio::test(flavor = "multi_thread")]
async fn http_gives_pictures_of_texts_as_files_and_in_json() {
    let fixture = fixture().await;
    let id = fixture.scene(SemanticsMode::Eager).await;
    let server = &fixture.server;
    let client = crate::common::client();
    let path = format!("/v1/scenes/{id}/view?from=0&width=32&height=24&kind=mask&text=photo+0");
    let first = client.get(server.url(&path)).send().await.unwrap();
    assert_eq!(first.headers()["content-type"], "image/png");
    let tag = first.headers()["etag"].clone();
    let again = client.get(server.url(&path)).header("if-none-match", tag).send().await.unwrap();
    assert_eq!(again.status(), 304);
    let picky = client.get(server.url(&path)).header("accept", "image/jpeg").send().await.unwrap();
    assert!(bytes(picky).await.unwrap_err().message.contains("kind=mask"));

    let url = server.url(&format!("/v1/scenes/{id}/views"));
    let body = serde_json::json!({
        "cameras": [{ "from": 0 }], "kinds": ["color", "mask", "semantics"], "text": "photo 0",
        "width": 32, "height": 24, "container": "zip",
    });
    let before = fixture.renderer.counts()[0];
    let answer = client.post(url).json(&body).send().await.unwrap();
    let file = std::io::Cursor::new(answer.bytes().await.unwrap());
    let names: Vec<String> = zip::ZipArchive::new(file)
        .unwrap()
        .file_names()
        .map(|name| name.unwrap().into_owned())
        .collect();
    assert!(names.contains(&"view-000-mask.png".to_owned()), "{names:?}");
    assert_eq!(fixture.renderer.counts()[0], before + 1, "one drawing for three kinds");

    let url = server.url(&format!("/v1/scenes/{id}/query"));
    let body = serde_json::json!({
        "texts": ["photo 0"], "camera": { "from": 0 }, "width": 32, "height": 24, "mask": "png",
        "boxes": "aligned",
    });
    let answer = json(client.post(url.clone()).json(&body).send().await.unwrap()).await.unwrap();
    let found = &answer["results"][0];
    assert!(found["view"]["mask_png"].as_str().unwrap().starts_with("iVBOR"), "{found}");
    assert_eq!(found["parts"][0]["axes"][0], serde_json::json!([1.0, 0.0, 0.0]));
    let mut upright = body.clone();
    upright["boxes"] = "upright".into();
    let call = client.post(url.clone()).json(&upright);
    let part = json(call.send().await.unwrap()).await.unwrap()["results"][0]["parts"][0].clone();
    let cameras = server.service.get(&id).await.unwrap().cameras;
    let up = SceneCamera::level_up(&cameras).to_array();
    for (axis, up) in up.into_iter().enumerate() {
        assert!((part["axes"][2][axis].as_f64().unwrap() - up).abs() < 1e-9, "{part}");
    }
    for (field, count) in [("centroid", 3), ("covariance", 3), ("visibility", cameras.len())] {
        assert_eq!(part[field].as_array().unwrap().len(), count, "{part}");
    }
    assert_eq!(part["visibility"][0], 1.0, "what photo 0 made: {part}");
    for (key, value) in [("boxes", "round"), ("mask", "gif"), ("preset", "best")] {
        let mut body = body.clone();
        body[key] = value.into();
        let fault = bytes(client.post(url.clone()).json(&body).send().await.unwrap()).await;
        let fault = fault.unwrap_err();
        assert!(fault.message.starts_with(key) && fault.message.contains(value), "{fault:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn views_are_drawn_while_texts_wait_for_a_network() {
    let fixture = fixture().await;
    let id = fixture.scene(SemanticsMode::Eager).await;
    let (service, meaning) = (&fixture.server.service, &fixture.meaning);
    service.understand(&id, Some(PATIENCE)).await.expect("semantics");
    meaning.hold_texts.store(true, Ordering::Release);
    let ask = || service.query(&id, in_view(&["photo 0"]));
    let mask = || {
        let text = TextOptions { text: Some("photo 1".to_owned()), ..TextOptions::default() };
        service.render(&id, ViewSpec { kind: PictureKind::Mask, text, ..first_view() })
    };
    let texts = async { tokio::join!(ask(), mask()) };
    let color = async {
        // Both wait for the phrases that every text is compared with: three texts each.
        while meaning.embedded.load(Ordering::Acquire) < 6 {
            tokio::time::sleep(Duration::from_millis(1)).await;
        }
        let drawn = tokio::time::timeout(PATIENCE / 4, service.render(&id, first_view())).await;
        meaning.hold_texts.store(false, Ordering::Release);
        drawn.expect("a view does not wait for texts").expect("a view");
    };
    let ((answer, mask), ()) = tokio::join!(texts, color);
    let times = answer.expect("a query").times;
    assert!(times.score_ms > Some(0.0), "the network's time is in {times:?}");
    mask.expect("a mask");
}

#[tokio::test]
async fn the_text_tower_is_asked_on_no_async_thread() {
    let fixture = fixture().await;
    let id = fixture.scene(SemanticsMode::Eager).await;
    let (service, meaning) = (&fixture.server.service, &fixture.meaning);
    service.understand(&id, Some(PATIENCE)).await.expect("semantics");
    service.query(&id, in_view(&["photo 0"])).await.expect("a query");
    let asked_on = meaning.asked_on.lock().unwrap();
    let here = std::thread::current().id();
    assert!(!asked_on.is_empty() && !asked_on.contains(&here), "{here:?} in {asked_on:?}");
}

#[tokio::test]
async fn queries_say_where_their_time_went_over_both_doors() {
    let fixture = fixture().await;
    let id = fixture.scene(SemanticsMode::Eager).await;
    let body = serde_json::json!({ "texts": ["photo 0"], "camera": { "from": 0 } });
    let url = fixture.server.url(&format!("/v1/scenes/{id}/query"));
    let answer = crate::common::client().post(url).json(&body).send().await.unwrap();
    let lines = answer.headers().get_all("server-timing").iter().map(|v| v.to_str().unwrap());
    let http = lines.collect::<Vec<_>>().join(", ");
    let mut client = segsplat::api::grpc::pb::scene_service_client::SceneServiceClient::new(
        crate::common::doors::channel(fixture.server.addr).await,
    );
    let query = segsplat::api::grpc::pb::QueryRequest {
        scene_id: id.to_string(),
        texts: texts(&["photo 0"]),
        camera: Some(Ask::first().camera()),
        ..Default::default()
    };
    let answer = client.query(query).await.unwrap();
    let lines = answer.metadata().get_all("server-timing").iter().map(|v| v.to_str().unwrap());
    let grpc = lines.collect::<Vec<_>>().join(", ");
    for (door, line) in [("HTTP", http), ("gRPC", grpc)] {
        let times: Vec<(&str, f64)> = line
            .split(", ")
            .filter_map(|entry| entry.split_once(";dur="))
            .map(|(stage, ms)| (stage, ms.parse().unwrap()))
            .collect();
        let stages: Vec<&str> = times.iter().map(|(stage, _)| *stage).collect();
        assert_eq!(stages, ["queue", "load", "score", "render", "encode", "total"], "{door}");
        let sum: f64 = times[..5].iter().map(|(_, ms)| ms).sum();
        assert!(sum > 0.0 && sum <= times[5].1 + 0.06, "{door}: {times:?}");
    }
}

#[tokio::test(flavor = "multi_thread")]
async fn an_answer_says_what_is_known_of_its_word_and_how_its_parts_score_at_both_doors() {
    let known = |word: &str, trust: Trust| KnownWord {
        word: word.to_owned(),
        trust,
        things: 0,
        things_found: None,
        photographs: 0,
        photographs_found: None,
        absent: 0.0,
    };
    let words = vec![known("photo 1", Trust::Good), known("photo 7", Trust::Poor)];
    let server = TestServer::with(|_, parts| {
        parts.semantics = Arc::new(PhotoMeaning::default());
        parts.models.words = words;
    })
    .await;
    let id = server.scene().await.id;
    let asked = ["photo 1", "Photo 7", "photo 0"];
    let url = server.url(&format!("/v1/scenes/{id}/query"));
    let call = crate::common::client().post(url).json(&serde_json::json!({ "texts": asked }));
    let answer = json(call.send().await.unwrap()).await.unwrap();
    let http = answer["results"].as_array().unwrap().iter().map(|found| {
        let score = found["parts"][0]["score"].as_f64().map(|score| score as f32);
        let [word, trust] = ["word", "trust"].map(|key| found[key].as_str().unwrap_or_default());
        (word.to_owned(), trust.to_owned(), found["found"].as_bool().unwrap(), score)
    });
    let mut client = segsplat::api::grpc::pb::scene_service_client::SceneServiceClient::new(
        crate::common::doors::channel(server.addr).await,
    );
    let query = segsplat::api::grpc::pb::QueryRequest {
        scene_id: id.to_string(),
        texts: texts(&asked),
        ..Default::default()
    };
    let answer = client.query(query).await.unwrap().into_inner();
    let grpc = answer.results.iter().map(|found| {
        let score = found.parts.first().map(|part| part.score);
        (found.word.clone(), found.trust.clone(), found.found, score)
    });
    let best = |result: usize| answer.results[result].scores.iter().copied().reduce(f32::max);
    let want = |word: &str, trust: &str, found: bool, score: Option<f32>| {
        (word.to_owned(), trust.to_owned(), found, score)
    };
    let want = [
        want("photo 1", "good", true, best(0)),
        want("photo 7", "poor", false, None),
        want("", "", true, best(2)),
    ];
    assert_eq!(http.collect::<Vec<_>>(), want);
    assert_eq!(grpc.collect::<Vec<_>>(), want);
}
