//! gRPC, the command line and the page have what `/openapi.json` has: each call, option, format of
//! an export and field of a status is there, or in a list here with its reason. The same of the
//! Python client is `clients/python/tests/test_openapi.py`.

use std::{
    collections::{BTreeMap, BTreeSet},
    process::Command,
};

use segsplat::{scene::SceneOptions, service::VIEWER};
use serde_json::Value;

use crate::common::{cpu_server::CpuServer, root};

/// What a door does not have, and why; `*` is every option of the call.
type Absent = &'static [(&'static str, &'static str)];

/// Calls on the command line, and its commands.
const COMMANDS: [(&str, &str); 9] = [
    ("add_photos", "add"),
    ("create_scene", "reconstruct"),
    ("render_view", "render"),
    ("query", "query"),
    ("features", "features"),
    ("export", "export"),
    ("set_edits", "edit"),
    ("measure", "measure"),
    ("models", "models"),
];

const NOT_IN_GRPC: Absent = &[
    ("*.deadline_ms", "the deadline of gRPC itself"),
    ("*.wait_ms", "`semantics_wait_ms`, beside the `wait_ms` of a new scene"),
    ("create_scene.cameras", "`cameras_json`, and `cameras_mode`"),
    ("create_scene.masks", "a `photo` of the name `masks/PHOTO.png`"),
    ("create_scene.transforms", "`transforms_json`"),
    ("add_photos.cameras", "`cameras_json`"),
    ("add_photos.transforms", "`transforms_json`"),
    ("add_photos.masks", "a `photo` of the name `masks/PHOTO.png`"),
    ("add_photos.splats", "a file of Gaussians is a scene of its own"),
    ("pick.label", "`labels`"),
    ("set_edits.edits", "`edits_json`"),
    ("render_views.container", "a stream of views"),
    ("Scene.depth_range", "`depth_near` and `depth_far`"),
    ("Scene.network", "the lens of pixels that only a PLY names"),
    ("Event.event", "`state`; a version is `done` with its number"),
];

const NOT_ON_THE_COMMAND_LINE: Absent = &[
    ("list_scenes", "it works on files"),
    ("get_scene", "`inspect` shows a file"),
    ("delete_scene", "it works on files"),
    ("watch_scene", "`reconstruct` shows its progress"),
    ("add_photos.*", "the arguments"),
    ("remove_photo", "files keep no photos; `curl -X DELETE`"),
    ("get_scale", "`measure` says it too"),
    ("set_scale", "a file keeps none: `measure --metres` and `--metres-per-unit`"),
    ("get_edits", "a file has no list: `edit` writes what it comes to"),
    ("refine_scene", "`reconstruct --refine`: a file has no photos"),
    ("render_views", "a call of `render` for each camera"),
    ("pick", "a pixel is named by whoever looks at a picture: the page, a program"),
    ("*.deadline_ms", "whoever waits can stop it"),
    ("*.wait_ms", "it waits"),
    ("*.format", "the ending of the file"),
    ("*.texts", "the arguments"),
    ("create_scene.photo", "the argument"),
    ("create_scene.archive", "the argument"),
    ("create_scene.splats", "the argument"),
    ("create_scene.masks", "in the folder of the photos"),
    ("create_scene.transforms", "in the folder of the photos"),
    ("export.format=npz", "`features`"),
    ("export.format=packed", "what the page draws comes from a server"),
    ("export.format=html", "the page comes from a server"),
    ("query.mask", "the ending of the file"),
    ("query.relevancy", "`render --kind relevancy`"),
];

const NOT_ON_THE_PAGE: Absent = &[
    ("refine_scene", "it takes the machine for minutes: an operator or a program asks for it"),
    ("render_view.*", "a small picture of what a photo shows, as the server draws it"),
    ("render_views", "the page draws the scene itself"),
    ("features", "arrays are for programs"),
    ("*.deadline_ms", "whoever looks can go away"),
    ("*.wait_ms", "it waits, and shows the progress"),
    ("*.preset", "as the scene was made"),
    ("create_scene.*", "photos and cameras alone: the rest is as the server is set"),
    ("query.*", "in space alone: the page draws the masks itself"),
    ("pick.*", "the pose and lens of the page's own view"),
    ("*.canon", "scored as the scene was made; the cut alone is the page's"),
    ("*.near_best", "scored as the scene was made; the cut alone is the page's"),
    ("*.rivals", "scored as the scene was made; the cut alone is the page's"),
    ("*.unit_rows", "scored as the scene was made; the cut alone is the page's"),
    ("measure", "it measures itself, by the same scale and ground"),
    ("Scene.updated_ms", "it shows when a scene was made"),
    ("SemanticsStatus.available", "a question is refused with the reason"),
    ("SemanticsStatus.reason", "a question is refused with it"),
    ("SemanticsStatus.bank_size", "a figure for programs"),
];

/// The document's calls of `/v1`: the options of each by the name of the call, and `format=ply` and
/// so on of an export.
fn calls(document: &Value) -> BTreeMap<String, BTreeSet<String>> {
    let mut calls = BTreeMap::new();
    let paths = document["paths"].as_object().unwrap().iter();
    let ours = paths.filter(|(path, _)| path.starts_with("/v1/"));
    for operation in ours.flat_map(|(_, item)| item.as_object().unwrap().values()) {
        let parameters = operation["parameters"].as_array().into_iter().flatten();
        let of_query = parameters.filter(|one| one["in"] == "query");
        let mut options: BTreeSet<_> = of_query.map(|one| text(&one["name"])).collect();
        let bodies = operation["requestBody"]["content"].as_object();
        for body in bodies.into_iter().flatten().map(|(_, body)| &body["schema"]) {
            let fields = resolved(document, body)["properties"].as_object();
            options.extend(fields.into_iter().flat_map(|fields| fields.keys().cloned()));
        }
        calls.insert(text(&operation["operationId"]), options);
    }
    let export = &document["paths"]["/v1/scenes/{id}/export"]["get"]["parameters"];
    let formats = export.as_array().unwrap().iter().find(|one| one["name"] == "format").unwrap();
    let formats = formats["schema"]["enum"].as_array().expect("all formats").iter();
    let formats = formats.map(|format| format!("format={}", text(format)));
    calls.get_mut("export").unwrap().extend(formats);
    calls
}

fn text(value: &Value) -> String {
    value.as_str().unwrap_or_else(|| panic!("{value} is not a text")).to_owned()
}

fn resolved<'a>(document: &'a Value, schema: &'a Value) -> &'a Value {
    match schema["$ref"].as_str() {
        Some(path) => document.pointer(path.trim_start_matches('#')).unwrap(),
        None => schema,
    }
}

/// Names of all fields of a schema and of the schemas in it.
fn fields(document: &Value, schema: &Value, found: &mut BTreeSet<String>) {
    let schema = resolved(document, schema);
    for (name, field) in schema["properties"].as_object().into_iter().flatten() {
        found.insert(name.clone());
        fields(document, field, found);
    }
    for inner in ["oneOf", "anyOf", "allOf"].map(|key| schema[key].as_array()) {
        inner.into_iter().flatten().for_each(|inner| fields(document, inner, found));
    }
    if schema["items"].is_object() {
        fields(document, &schema["items"], found);
    }
}

/// Fields of these schemas of the document.
fn told<const N: usize>(
    document: &Value,
    names: [&str; N],
    fields: impl Fn(&Value, &Value, &mut BTreeSet<String>),
) -> [(String, BTreeSet<String>); N] {
    names.map(|name| {
        let mut found = BTreeSet::new();
        fields(document, &document["components"]["schemas"][name], &mut found);
        assert!(found.len() > 1, "{name}: {found:?}");
        (name.to_owned(), found)
    })
}

/// Fails with what is neither there nor in the list, and with what the list has for nothing.
fn compare(
    door: &str,
    wanted: &BTreeMap<String, BTreeSet<String>>,
    absent: Absent,
    has_call: impl Fn(&str) -> bool,
    has: impl Fn(&str, &str) -> bool,
) {
    let mut used = BTreeSet::new();
    let mut excused = |names: &[String]| {
        let of = |(name, _): &&(&str, &str)| names.iter().any(|one| one == name);
        absent.iter().find(of).map(|(name, _)| used.insert(*name)).is_some()
    };
    let mut faults = Vec::new();
    for (call, names) in wanted {
        if !has_call(call) {
            if !excused(std::slice::from_ref(call)) {
                faults.push(call.clone());
            }
            continue;
        }
        for name in names.iter().filter(|name| !has(call, name)) {
            let whole = format!("{call}.{name}");
            if !excused(&[whole.clone(), format!("*.{name}"), format!("{call}.*")]) {
                faults.push(whole);
            }
        }
    }
    assert!(faults.is_empty(), "{door} lacks {faults:?}");
    let idle: Vec<_> =
        absent.iter().map(|(name, _)| name).filter(|n| !used.contains(**n)).collect();
    assert!(idle.is_empty(), "{door} has {idle:?}, which is listed as absent");
}

async fn document() -> Value {
    let stand = CpuServer::start().await;
    let answer = crate::common::client().get(stand.url("/openapi.json")).send().await.unwrap();
    answer.json().await.unwrap()
}

/// `render_view` to `RenderView`.
fn camel(snake: &str) -> String {
    let word = |word: &str| word[..1].to_uppercase() + &word[1..];
    snake.split('_').map(word).collect()
}

#[tokio::test]
async fn grpc_has_what_http_has() {
    let document = document().await;
    let files = protox::compile(["segsplat/v1/scene.proto"], [root().join("proto")]).unwrap().file;
    let ours: Vec<_> = files.iter().filter(|file| file.package() == "segsplat.v1").collect();
    let messages: BTreeMap<_, _> = ours
        .iter()
        .flat_map(|file| &file.message_type)
        .map(|message| (format!(".segsplat.v1.{}", message.name()), message))
        .collect();
    let fields_of = |name: &str| {
        let (mut seen, mut open) = (BTreeSet::new(), vec![name.to_owned()]);
        let mut found = BTreeSet::new();
        while let Some(name) = open.pop() {
            let message = messages.get(&name).filter(|_| seen.insert(name.clone()));
            for field in message.into_iter().flat_map(|message| &message.field) {
                found.insert(field.name().to_owned());
                open.push(field.type_name().to_owned());
            }
        }
        found
    };
    let methods: BTreeMap<_, _> = ours
        .iter()
        .flat_map(|file| &file.service)
        .flat_map(|service| &service.method)
        .map(|method| (method.name(), fields_of(method.input_type())))
        .collect();
    let answers = [("Scene", "Scene"), ("Event", "SceneEvent")]
        .map(|(name, message)| (name, fields_of(&format!(".segsplat.v1.{message}"))));
    let told = told(&document, ["Scene", "Event"], fields);
    let wanted = calls(&document).into_iter().chain(told).collect();
    let method = |call: &str| {
        let answer = answers.iter().find(|(name, _)| *name == call).map(|(_, fields)| fields);
        answer.or_else(|| methods.get(&*camel(call)))
    };
    let formats: BTreeSet<_> = ours
        .iter()
        .flat_map(|file| &file.enum_type)
        .filter(|kind| kind.name() == "ExportFormat")
        .flat_map(|kind| &kind.value)
        .map(|value| value.name().replace("EXPORT_FORMAT_", "format=").to_lowercase())
        .collect();
    let has = |call: &str, name: &str| match name.starts_with("format=") {
        true => formats.contains(name),
        false => method(call).is_some_and(|fields| fields.contains(name)),
    };
    compare("gRPC", &wanted, NOT_IN_GRPC, |call| method(call).is_some(), has);
}

#[tokio::test]
async fn the_command_line_has_what_http_has() {
    let document = document().await;
    let help = |command: &str| {
        let mut program = Command::new(env!("CARGO_BIN_EXE_segsplat"));
        let output = program.args([command, "--help"]).output().expect("the program starts");
        assert!(output.status.success(), "{command} --help");
        String::from_utf8(output.stdout).unwrap()
    };
    let commands: BTreeMap<_, _> =
        COMMANDS.into_iter().map(|(call, command)| (call, help(command))).collect();
    let has = |call: &str, name: &str| {
        let is_word = |c: char| c.is_alphanumeric() || "-.".contains(c);
        let mut words = commands[call].split(|c| !is_word(c)).map(|word| word.trim_matches('.'));
        match (name.strip_prefix("format="), call) {
            (Some("compressed_ply"), _) => words.any(|word| word == "compressed.ply"),
            (Some("spz4"), _) => words.any(|word| word == "v4.spz"),
            (Some("sog_lod"), _) => words.any(|word| word == "sog.zip"),
            (Some(format), _) => {
                words.any(|word| word == format || word == format!("{format}.zip"))
            }
            // `--method NAME=VALUE` sets each field of the method.
            (None, "create_scene") if SceneOptions::NAMES.contains(&name) => true,
            (None, _) => words.any(|word| word == format!("--{}", name.replace('_', "-"))),
        }
    };
    let has_call = |call: &str| commands.contains_key(call);
    compare("the command line", &calls(&document), NOT_ON_THE_COMMAND_LINE, has_call, has);
}

#[tokio::test]
async fn the_page_has_what_http_has() {
    let document = document().await;
    let html = &VIEWER.html;
    let words: BTreeSet<_> = html.split(|c: char| !(c.is_alphanumeric() || c == '_')).collect();
    let mut paths = BTreeMap::new();
    for (path, item) in document["paths"].as_object().unwrap() {
        for (verb, operation) in item.as_object().unwrap() {
            paths.insert(text(&operation["operationId"]), (path.clone(), verb.to_uppercase()));
        }
    }
    // Paths are written as they are, up to the id and after it.
    let has_call = |call: &str| {
        let Some((path, verb)) = paths.get(call) else { return true };
        let end = path.rsplit('/').next().unwrap();
        match (end, &**verb) {
            ("{id}", "DELETE") => html.contains("method: 'DELETE'"),
            ("{id}", _) => html.contains("`/v1/scenes/${"),
            ("{name}", "DELETE") => html.contains("/photos/${"),
            ("scenes", "POST") => html.contains("send('/v1/scenes'"),
            ("scenes", _) => html.contains("'/v1/scenes' +"),
            ("models", _) => html.contains("/v1/models"),
            (end, _) => html.contains(&format!("}}/{end}")),
        }
    };
    // Reports are for programs: the page shows some figures of them.
    let own = |_: &Value, schema: &Value, found: &mut BTreeSet<String>| {
        let kinds = schema["oneOf"].as_array().into_iter().flatten().chain([schema]);
        let fields = kinds.filter_map(|kind| kind["properties"].as_object());
        found.extend(fields.flat_map(|fields| fields.keys().cloned()));
    };
    let shown = ["Scene", "SemanticsStatus", "RefineStatus", "SceneError", "Event"];
    let told = told(&document, shown, own);
    let wanted = calls(&document).into_iter().chain(told).collect();
    let (_, exports) = html.split_once("<select id=\"export\">").expect("the list of exports");
    let (exports, _) = exports.split_once("</select>").unwrap();
    let has = |_: &str, name: &str| match name.strip_prefix("format=") {
        Some(format) => exports.contains(&format!("value=\"{format}\"")),
        None => words.contains(name),
    };
    compare("the page", &wanted, NOT_ON_THE_PAGE, has_call, has);
}
