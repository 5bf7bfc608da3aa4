//! `/openapi.json`: the calls over HTTP. The schemas say what the bodies hold;
//! `tests/it/errors.rs` compares them with real answers and the paths with the routes.

use axum::Json;
use utoipa::{
    Modify, OpenApi, PartialSchema,
    openapi::{
        self, RefOr, Response,
        content::ContentBuilder,
        path::{ParameterBuilder, ParameterIn},
        response::ResponseBuilder,
    },
};

use super::{error::ErrorBody, health, render, scenes, texts, viewer, views};

/// This document
#[utoipa::path(
    get, path = "/openapi.json", operation_id = "openapi", tag = "server",
    responses((status = 200, description = "This document", content_type = "application/json"))
)]
pub(super) async fn document() -> Json<openapi::OpenApi> {
    Json(Document::openapi())
}

#[derive(OpenApi)]
#[openapi(
    info(
        title = "SegSplat Server",
        description = "Posed photos in; views at any pose, and answers to texts, out."
    ),
    paths(
        scenes::create, scenes::list, scenes::get, scenes::delete, scenes::events, scenes::refine,
        render::view, views::views, texts::query, texts::pick, render::export, render::features,
        health::models, health::live, health::ready, health::metrics, document, viewer::index,
    ),
    components(schemas(ErrorBody)),
    tags(
        (name = "scenes", description = "Make, list, show, watch and delete scenes"),
        (name = "views", description = "Pictures and files of a scene"),
        (name = "texts", description = "Where is it? Texts to a scene"),
        (name = "server", description = "Health, models, this document"),
    ),
    modifiers(&EveryCall),
)]
struct Document;

/// Adds to every call what every call has: `deadline_ms` is documented once, errors by default.
struct EveryCall;

impl Modify for EveryCall {
    fn modify(&self, document: &mut openapi::OpenApi) {
        let error = openapi::Ref::from_schema_name("ErrorBody");
        let fault: Response = ResponseBuilder::new()
            .description("An error of the table in docs/errors.md")
            .content("application/json", ContentBuilder::new().schema(Some(error)).build())
            .build();
        let deadline = ParameterBuilder::new()
            .name("deadline_ms")
            .parameter_in(ParameterIn::Query)
            .description(Some("Milliseconds after which the call is given up"))
            .schema(Some(<u64 as PartialSchema>::schema()))
            .build();
        for item in document.paths.paths.values_mut() {
            let operations = [&mut item.get, &mut item.post, &mut item.delete];
            for operation in operations.into_iter().flatten() {
                operation.parameters.get_or_insert_default().push(RefOr::T(deadline.clone()));
                let fault = RefOr::T(fault.clone());
                operation.responses.responses.insert("default".to_owned(), fault);
            }
        }
    }
}
