//! HTTP/1.1 and HTTP/2, and gRPC on the same port.
//!
//! [`routes`] is the list of calls; `tests/it/errors.rs` compares `/openapi.json` with it.

mod answers;
mod body;
mod connection;
mod cors;
mod edits;
mod error;
mod extract;
mod fields;
mod gzip;
mod headers;
mod health;
mod inference;
mod middleware;
mod multipart;
mod openapi;
mod photos;
mod render;
mod scale;
mod scenes;
mod serve;
mod texts;
mod tls;
mod viewer;
mod views;

use std::sync::Arc;

use axum::{
    Router,
    extract::DefaultBodyLimit,
    middleware::{from_fn, from_fn_with_state},
    routing::{MethodRouter, delete, get, post, put},
};
use tower_http::catch_panic::CatchPanicLayer;

use super::{Api, access, grpc};
use crate::{error::Result, keys::Scope, telemetry::meter};

use self::{
    body::Pace,
    error::panic_error,
    middleware::{Around, Transport, around, grpc_guard, http_guard},
};

pub use self::serve::Server;

/// Name of the one call that the configuration can open.
const METRICS: &str = "metrics";

/// One call over HTTP.
#[derive(Clone, Debug)]
pub struct Route {
    /// Method, upper case.
    pub method: &'static str,
    /// Path with `{id}` where an id goes.
    pub path: &'static str,
    /// Name in metrics: that of the gRPC method where there is one.
    pub call: &'static str,
    /// The scope that a key must have; `None`: callers need no key.
    pub scope: Option<Scope>,
    handler: MethodRouter<Api>,
}

/// Every call over HTTP.
#[must_use]
pub fn routes() -> Vec<Route> {
    let (none, read, write) = (None, Some(Scope::Read), Some(Scope::Write));
    let admin = Some(Scope::Admin);
    [
        ("POST", "/v1/scenes", "create_scene", write, post(scenes::create)),
        ("GET", "/v1/scenes", "list_scenes", read, get(scenes::list)),
        ("GET", "/v1/scenes/{id}", "get_scene", read, get(scenes::get)),
        ("DELETE", "/v1/scenes/{id}", "delete_scene", write, delete(scenes::delete)),
        ("GET", "/v1/scenes/{id}/events", "watch_scene", read, get(scenes::events)),
        ("POST", "/v1/scenes/{id}/refine", "refine_scene", write, post(scenes::refine)),
        ("POST", "/v1/scenes/{id}/photos", "add_photos", write, post(photos::add)),
        ("DELETE", "/v1/scenes/{id}/photos/{name}", "remove_photo", write, delete(photos::remove)),
        ("GET", "/v1/scenes/{id}/edits", "get_edits", read, get(edits::get)),
        ("PUT", "/v1/scenes/{id}/edits", "set_edits", write, put(edits::set)),
        ("GET", "/v1/scenes/{id}/scale", "get_scale", read, get(scale::get)),
        ("PUT", "/v1/scenes/{id}/scale", "set_scale", write, put(scale::set)),
        ("POST", "/v1/scenes/{id}/measure", "measure", read, post(scale::measure)),
        ("GET", "/v1/scenes/{id}/view", "render_view", read, get(render::view)),
        ("POST", "/v1/scenes/{id}/views", "render_views", read, post(views::views)),
        ("POST", "/v1/scenes/{id}/query", "query", read, post(texts::query)),
        ("GET", "/v1/scenes/{id}/pick", "pick", read, get(texts::pick)),
        ("GET", "/v1/scenes/{id}/export", "export", read, get(render::export)),
        ("GET", "/v1/scenes/{id}/features", "features", read, get(render::features)),
        ("GET", "/v1/models", "models", read, get(health::models)),
        ("GET", "/v2", "server_metadata", read, get(inference::server_metadata)),
        ("GET", "/v2/health/live", "server_live", none, get(inference::server_live)),
        ("GET", "/v2/health/ready", "server_ready", none, get(inference::server_ready)),
        ("GET", "/v2/models/{name}", "model_metadata", read, get(inference::model_metadata)),
        ("GET", "/v2/models/{name}/ready", "model_ready", read, get(inference::model_ready)),
        ("POST", "/v2/models/{name}/infer", "model_infer", write, post(inference::model_infer)),
        ("GET", "/metrics", METRICS, admin, get(health::metrics)),
        ("GET", "/healthz", "live", none, get(health::live)),
        ("GET", "/readyz", "ready", none, get(health::ready)),
        ("GET", "/openapi.json", "openapi", none, get(openapi::document)),
        ("GET", "/", "viewer", none, get(viewer::index)),
        ("GET", "/sample.zip", "sample", read, get(viewer::sample)),
    ]
    .map(|(method, path, call, scope, handler)| Route { method, path, call, scope, handler })
    .into()
}

/// HTTP and gRPC as one router.
fn app(api: &Api) -> Result<Router> {
    let grpc = grpc::routes(api.clone())?.prepare().into_axum_router().reset_fallback();
    let grpc = grpc.layer(from_fn_with_state(api.clone(), grpc_guard));
    // Before the first call, so that every metric is there.
    access::rpc_calls().for_each(|call| meter::register_call("grpc", call));
    meter::register_call("http", access::OTHER);
    let guarded = |route: Route| {
        meter::register_call("http", route.call);
        let open = route.call == METRICS && api.service.config().open_metrics;
        let scope = route.scope.filter(|_| !open);
        let guard = from_fn_with_state((api.clone(), route.call, scope), http_guard);
        (route.path, route.handler.route_layer(from_fn(gzip::pack)).route_layer(guard))
    };
    let http = routes()
        .into_iter()
        .map(guarded)
        .fold(Router::new(), |router, (path, handler)| router.route(path, handler))
        .method_not_allowed_fallback(error::method_not_allowed)
        .with_state(api.clone())
        .fallback(error::no_such_route)
        .layer(DefaultBodyLimit::disable());
    let pace = Pace::of_requests(&api.service.limits());
    let state = |transport| (transport, Arc::clone(&api.access), pace);
    let both = surrounded(http, state(Transport::Http));
    let both = both.merge(surrounded(grpc, state(Transport::Grpc)));
    Ok(match cors::layer(&api.service.config().cors_origins)? {
        Some(cors) => both.layer(cors),
        None => both,
    })
}

/// What surrounds every call: request id, deadline, one shape of errors, answers to panics.
fn surrounded(router: Router, state: Around) -> Router {
    let transport = state.0;
    router
        .layer(CatchPanicLayer::custom(move |panic| transport.refusal(panic_error(panic))))
        .layer(from_fn_with_state(state, around))
}
