//! The HTTP door, and the port that both doors share: HTTP/1.1, HTTP/2 and gRPC over h2c.
//!
//! [`routes`] is the list of calls; `/openapi.json` is held to it by `tests/it/errors.rs`.

mod ask;
mod connection;
mod cors;
mod edge;
mod error;
mod extract;
mod fields;
mod health;
mod held;
mod openapi;
mod receive;
mod render;
mod scenes;
mod serve;
mod tls;
mod viewer;
mod views;

use std::sync::Arc;

use axum::{
    Router,
    extract::DefaultBodyLimit,
    handler::Handler,
    middleware,
    routing::{self, MethodRouter},
};
use tower_http::catch_panic::CatchPanicLayer;

use super::{
    Api,
    access::{self, Access},
    grpc,
};
use crate::{error::Result, keys::Scope, telemetry::meter};

use self::connection::Pace;

pub use self::serve::{Doors, serve};

/// Name of the one call that the configuration can open.
const METRICS: &str = "metrics";

/// One call of the HTTP door.
#[derive(Clone, Debug)]
pub struct Route {
    /// Method, upper case.
    pub method: &'static str,
    /// Path with `{id}` where an id goes.
    pub path: &'static str,
    /// Name in metrics: that of the gRPC method where there is one.
    pub call: &'static str,
    /// What a key must be good for; `None`: nobody is asked.
    pub scope: Option<Scope>,
    handler: MethodRouter<Api>,
}

fn get<H: Handler<T, Api>, T: 'static>(
    path: &'static str,
    call: &'static str,
    scope: impl Into<Option<Scope>>,
    handler: H,
) -> Route {
    Route { method: "GET", path, call, scope: scope.into(), handler: routing::get(handler) }
}

fn post<H: Handler<T, Api>, T: 'static>(
    path: &'static str,
    call: &'static str,
    scope: Scope,
    handler: H,
) -> Route {
    Route { method: "POST", path, call, scope: Some(scope), handler: routing::post(handler) }
}

fn delete<H: Handler<T, Api>, T: 'static>(
    path: &'static str,
    call: &'static str,
    scope: Scope,
    handler: H,
) -> Route {
    Route { method: "DELETE", path, call, scope: Some(scope), handler: routing::delete(handler) }
}

/// Every call of the HTTP door.
#[must_use]
pub fn routes() -> Vec<Route> {
    use Scope::{Admin, Read, Write};
    vec![
        post("/v1/scenes", "create_scene", Write, scenes::create),
        get("/v1/scenes", "list_scenes", Read, scenes::list),
        get("/v1/scenes/{id}", "get_scene", Read, scenes::get),
        delete("/v1/scenes/{id}", "delete_scene", Write, scenes::delete),
        get("/v1/scenes/{id}/events", "watch_scene", Read, scenes::events),
        get("/v1/scenes/{id}/view", "render_view", Read, render::view),
        post("/v1/scenes/{id}/views", "render_views", Read, views::views),
        post("/v1/scenes/{id}/query", "query", Read, ask::query),
        get("/v1/scenes/{id}/pick", "pick", Read, ask::pick),
        get("/v1/scenes/{id}/export", "export", Read, render::export),
        get("/v1/models", "models", Read, health::models),
        get("/metrics", METRICS, Admin, health::metrics),
        get("/healthz", "live", None, health::live),
        get("/readyz", "ready", None, health::ready),
        get("/openapi.json", "openapi", None, openapi::document),
        get("/", "viewer", None, viewer::index),
    ]
}

/// Both doors as one router.
fn app(api: &Api) -> Result<Router> {
    let rpc = grpc::routes(api.clone())?.prepare().into_axum_router().reset_fallback();
    let pace = Pace::new(&api.service.limits());
    // Before the first call, so that every metric is there.
    access::rpc_calls().for_each(|call| meter::register_call("grpc", call));
    meter::register_call("http", access::OTHER);
    let guarded = |route: Route| {
        meter::register_call("http", route.call);
        let open = route.call == METRICS && api.service.config().open_metrics;
        let scope = route.scope.filter(|_| !open);
        let state = (api.clone(), route.call, scope);
        let guard = middleware::from_fn_with_state(state, edge::guard);
        (route.path, route.handler.route_layer(guard))
    };
    let rest = routes()
        .into_iter()
        .map(guarded)
        .fold(Router::new(), |router, (path, handler)| router.route(path, handler))
        .method_not_allowed_fallback(error::method_not_allowed)
        .with_state(api.clone());
    let rest = rest_edge(rest.fallback(error::no_such_route), (Arc::clone(&api.access), pace));
    let both = rest.merge(rpc_edge(rpc, (api.clone(), pace)));
    Ok(match cors::layer(&api.service.config().cors_origins)? {
        Some(cors) => both.layer(cors),
        None => both,
    })
}

/// What surrounds every HTTP call: request id, deadline, one error shape, a net for panics.
fn rest_edge(router: Router, state: (Arc<Access>, Pace)) -> Router {
    router
        .layer(DefaultBodyLimit::disable())
        .layer(CatchPanicLayer::custom(error::panicked))
        .layer(middleware::from_fn_with_state(state, edge::rest))
}

/// The same for every gRPC call.
fn rpc_edge(router: Router, state: (Api, Pace)) -> Router {
    router
        .layer(CatchPanicLayer::custom(edge::rpc_panicked))
        .layer(middleware::from_fn_with_state(state, edge::rpc))
}

#[cfg(test)]
mod tests {
    use axum::body::Body;
    use axum::http::{Request, StatusCode};
    use tower::ServiceExt;

    use super::*;

    async fn boom() -> &'static str {
        panic!("on purpose")
    }

    async fn call(router: Router, path: &str) -> (StatusCode, axum::http::HeaderMap, String) {
        let request = Request::get(path)
            .header("content-type", "application/grpc")
            .body(Body::empty())
            .unwrap();
        let response = router.oneshot(request).await.unwrap();
        let (parts, body) = response.into_parts();
        let bytes = axum::body::to_bytes(body, 1 << 20).await.unwrap();
        (parts.status, parts.headers, String::from_utf8(bytes.to_vec()).unwrap())
    }

    #[tokio::test]
    async fn a_panic_in_a_handler_is_an_internal_error_and_the_router_lives() {
        let router = rest_edge(
            Router::new()
                .route("/boom", routing::get(boom))
                .route("/ok", routing::get(|| async {})),
            (
                Arc::new(Access::new(&crate::config::Config::default()).unwrap()),
                Pace::new(&crate::limits::Limits::default()),
            ),
        );
        let (status, headers, body) = call(router.clone(), "/boom").await;
        assert_eq!(status, StatusCode::INTERNAL_SERVER_ERROR);
        let body: serde_json::Value = serde_json::from_str(&body).unwrap();
        assert_eq!(body["code"], "internal");
        assert_eq!(body["request_id"], headers["x-request-id"].to_str().unwrap());
        assert!(!body.to_string().contains("on purpose"), "the panic's text reached the client");
        assert_eq!(call(router, "/ok").await.0, StatusCode::OK);
    }

    #[tokio::test]
    async fn a_panic_in_a_grpc_call_is_an_internal_status() {
        let router = Router::new()
            .route("/boom", routing::get(boom))
            .layer(CatchPanicLayer::custom(edge::rpc_panicked));
        let (status, headers, _) = call(router, "/boom").await;
        assert_eq!(status, StatusCode::OK);
        assert_eq!(headers["grpc-status"], "13");
        assert_eq!(headers["segsplat-code"], "internal");
    }
}
