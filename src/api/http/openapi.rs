//! `/openapi.json`: the calls over HTTP. The schemas say what the bodies hold, with the bounds of
//! the server's limits; `tests/it/errors.rs` compares them with real answers and the paths with
//! the routes.

use axum::{Json, extract::State};
use serde_json::{Map, Value, json};
use utoipa::{
    Modify, OpenApi, PartialSchema,
    openapi::{
        self, RefOr, Response,
        content::ContentBuilder,
        path::{ParameterBuilder, ParameterIn},
        response::ResponseBuilder,
    },
};

use super::{
    edits,
    error::{ErrorBody, PROBLEM, ProblemBody},
    health, inference, photos, render, scale, scenes, texts, viewer, views,
};
use crate::{
    api::Api,
    limits::{
        BANK_ROWS_MAX, CANON_MAX, FOCAL_RANGE, FOV_RANGE, LAMBDA_RANGE, Limits, SCENE_PHOTOS_MAX,
        TAU_RANGE,
    },
    render::plan::NEAR_RANGE,
    scene::ScoringMethod,
};

/// Schemas of what callers send, whose fields have bounds. Those of answers have none.
const SENT: [&str; 6] =
    ["CameraFields", "EditsBody", "MeasureBody", "QueryBody", "ScaleBody", "ViewsRequest"];

/// This document
#[utoipa::path(
    get, path = "/openapi.json", operation_id = "openapi", tag = "server",
    responses((status = 200, description = "This document", content_type = "application/json"))
)]
pub(super) async fn document(State(api): State<Api>) -> Json<Value> {
    Json(within(&api.service.limits()))
}

#[derive(OpenApi)]
#[openapi(
    info(
        title = "SegSplat Server",
        description = "Posed photos in; views at any pose, and answers to texts, out."
    ),
    paths(
        scenes::create, scenes::list, scenes::get, scenes::delete, scenes::events, scenes::refine,
        photos::add, photos::remove, edits::get, edits::set,
        scale::get, scale::set, scale::measure,
        render::view, views::views, texts::query, texts::pick, render::export, render::features,
        health::models, health::live, health::ready, health::metrics, document, viewer::index,
        viewer::sample, inference::server_metadata, inference::server_live,
        inference::server_ready, inference::model_metadata, inference::model_ready,
        inference::model_infer,
    ),
    components(schemas(ErrorBody, ProblemBody)),
    tags(
        (name = "scenes", description = "Make, list, show, watch and delete scenes"),
        (name = "views", description = "Pictures and files of a scene"),
        (name = "texts", description = "Where is it? Texts to a scene"),
        (name = "inference", description = "The networks, by the Open Inference Protocol v2"),
        (name = "server", description = "Health, models, this document"),
    ),
    modifiers(&EveryCall),
)]
struct Document;

/// Adds to every call what every call has: `deadline_ms` is documented once, errors by default.
struct EveryCall;

impl Modify for EveryCall {
    fn modify(&self, document: &mut openapi::OpenApi) {
        let [error, problem] = ["ErrorBody", "ProblemBody"].map(|name| {
            let schema = Some(openapi::Ref::from_schema_name(name));
            ContentBuilder::new().schema(schema).build()
        });
        let fault: Response = ResponseBuilder::new()
            .description(
                "An error of the table in docs/errors.md; problem details where Accept names them",
            )
            .content("application/json", error)
            .content(PROBLEM, problem)
            .build();
        let deadline = ParameterBuilder::new()
            .name("deadline_ms")
            .parameter_in(ParameterIn::Query)
            .description(Some("Milliseconds after which the call is given up"))
            .schema(Some(<u64 as PartialSchema>::schema()))
            .build();
        for item in document.paths.paths.values_mut() {
            let operations = [&mut item.get, &mut item.post, &mut item.put, &mut item.delete];
            for operation in operations.into_iter().flatten() {
                operation.parameters.get_or_insert_default().push(RefOr::T(deadline.clone()));
                let fault = RefOr::T(fault.clone());
                operation.responses.responses.insert("default".to_owned(), fault);
            }
        }
    }
}

/// The document of a server with these limits.
fn within(limits: &Limits) -> Value {
    let mut document = json!(Document::openapi());
    let bounds = bounds(limits);
    let schemas = &mut document["components"]["schemas"];
    let parts = schemas.clone();
    for schema in schemas.as_object_mut().into_iter().flat_map(Map::values_mut) {
        *schema = joined(schema, &parts);
    }
    for name in SENT {
        let needed = schemas[name]["required"].as_array().cloned().unwrap_or_default();
        for (field, schema) in schemas[name]["properties"].as_object_mut().into_iter().flatten() {
            merge(schema, &bounds[field]);
            // What must be given has no default; elsewhere `null` and nothing are the same.
            match schema.as_object_mut() {
                Some(schema) if needed.contains(&json!(field)) => drop(schema.remove("default")),
                Some(schema) => or_null(schema),
                None => {}
            }
        }
    }
    let items = document["paths"].as_object_mut().into_iter().flat_map(Map::values_mut);
    let calls = items.filter_map(Value::as_object_mut).flat_map(Map::values_mut);
    for parameter in calls.filter_map(|call| call["parameters"].as_array_mut()).flatten() {
        let bound = parameter["name"].as_str().map_or(&Value::Null, |name| &bounds[name]);
        merge(&mut parameter["schema"], bound);
    }
    document
}

/// A schema of one type, or a name of another schema, that takes `null` too.
fn or_null(schema: &mut Map<String, Value>) {
    if let Some(name) = schema.remove("$ref") {
        schema.insert("oneOf".to_owned(), json!([{ "$ref": name }, { "type": "null" }]));
    } else if let Some(Value::String(kind)) = schema.get("type") {
        let kinds = json!([kind, "null"]);
        schema.insert("type".to_owned(), kinds);
    }
}

/// A struct that takes in others as one object. `allOf` of closed objects would have no value:
/// each of them refuses the others' fields.
fn joined(schema: &Value, all: &Value) -> Value {
    let named = |part: &Value| Some(&all[part["$ref"].as_str()?.rsplit('/').next()?]);
    let Some(parts) = schema["allOf"].as_array() else { return schema.clone() };
    let (mut whole, mut required) = (json!({ "type": "object" }), Vec::new());
    for part in parts {
        let mut part = joined(named(part).unwrap_or(part), all);
        required.extend(part["required"].as_array_mut().into_iter().flat_map(std::mem::take));
        merge(&mut whole, &part);
    }
    merge(&mut whole, &json!({ "required": required, "description": schema["description"] }));
    whole
}

/// Puts the fields of `more` into `schema`, and into the objects there.
fn merge(schema: &mut Value, more: &Value) {
    match (schema, more) {
        (_, Value::Null) => {}
        (Value::Object(schema), Value::Object(more)) => {
            for (name, value) in more.iter().filter(|(_, value)| !value.is_null()) {
                merge(schema.entry(name).or_insert(Value::Null), value);
            }
        }
        (schema, more) => *schema = more.clone(),
    }
}

/// What the numbers, texts and lists of requests must keep to, by the name of the field.
fn bounds(limits: &Limits) -> Value {
    let range = |[least, most]: [f64; 2]| json!({ "minimum": least, "maximum": most });
    let whole = |least: u64, most: u64| json!({ "minimum": least, "maximum": most });
    let text = json!({ "minLength": 1, "maxLength": limits.text_chars_max });
    let list = |items: &Value, most: usize| json!({ "maxItems": most, "items": items });
    let some =
        |items: &Value, most: usize| json!({ "minItems": 1, "maxItems": most, "items": items });
    let of_photos = whole(0, SCENE_PHOTOS_MAX.into());
    let centre = range([-FOCAL_RANGE[1], FOCAL_RANGE[1]]);
    let side = whole(1, limits.view_side_max.into());
    let views = whole(limits.photos_min as u64, limits.network_photos_max as u64);
    json!({
        "id": { "pattern": "^[0-9a-f]{32}$" },
        "deadline_ms": { "minimum": 1, "format": "uint64" },
        "wait_ms": { "format": "uint64" },
        "limit": whole(1, limits.page_max as u64),
        "max_views": views,
        "fuse_layers": of_photos, "front_photos": of_photos,
        "lambda": range(LAMBDA_RANGE),
        "bank_rows": whole(0, BANK_ROWS_MAX as u64),
        "merge_cosine": range([0.0, 1.0]),
        "from": of_photos, "to": of_photos,
        "t": range([0.0, 1.0]),
        "fx": range(FOCAL_RANGE), "fy": range(FOCAL_RANGE),
        "cx": centre, "cy": centre,
        "fov": range(FOV_RANGE),
        "width": side, "height": side,
        "near": range(NEAR_RANGE.map(f64::from)),
        "x": { "minimum": 0 }, "y": { "minimum": 0 },
        "text": text,
        "texts": some(&text, limits.texts_max),
        "label": list(&text, limits.texts_max),
        "ignore": list(&text, limits.texts_max),
        "canon": list(&text, CANON_MAX),
        "tau": range(TAU_RANGE),
        "cut": range([0.0, 1.0]), "coverage_floor": range([0.0, 1.0]),
        "near_best": range([0.0, ScoringMethod::NEAR_BEST_MAX]), "margin": range([-2.0, 2.0]),
        "rivals": range([0.0, 1.0]),
        "cameras": some(&Value::Null, limits.cameras_max),
        "kinds": some(&Value::Null, limits.kinds_max),
    })
}
