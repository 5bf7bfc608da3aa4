//! The HTTP door, and the port that both doors share: HTTP/1.1, HTTP/2 and gRPC over h2c.
//!
//! [`routes`] is the list of calls; `/openapi.json` is held to it by `tests/it/errors.rs`.

mod ask;
mod cors;
mod edge;
mod error;
mod extract;
mod health;
mod held;
mod openapi;
mod params;
mod receive;
mod render;
mod scenes;
mod schemas;
mod serve;
mod tls;
mod viewer;
mod views;

use axum::{
    Router,
    extract::DefaultBodyLimit,
    handler::Handler,
    middleware,
    routing::{self, MethodRouter},
};
use tower_http::catch_panic::CatchPanicLayer;

use super::{Api, grpc};
use crate::{error::Result, keys::Scope};

pub use self::serve::{Doors, serve};

/// One call of the HTTP door.
#[derive(Clone, Debug)]
pub struct Route {
    /// Method, upper case.
    pub method: &'static str,
    /// Path with `{id}` where an id goes.
    pub path: &'static str,
    /// What a key must be good for; `None`: nobody is asked.
    pub scope: Option<Scope>,
    handler: MethodRouter<Api>,
}

fn get<H: Handler<T, Api>, T: 'static>(
    path: &'static str,
    scope: impl Into<Option<Scope>>,
    handler: H,
) -> Route {
    Route { method: "GET", path, scope: scope.into(), handler: routing::get(handler) }
}

fn post<H: Handler<T, Api>, T: 'static>(path: &'static str, scope: Scope, handler: H) -> Route {
    Route { method: "POST", path, scope: Some(scope), handler: routing::post(handler) }
}

fn delete<H: Handler<T, Api>, T: 'static>(path: &'static str, scope: Scope, handler: H) -> Route {
    Route { method: "DELETE", path, scope: Some(scope), handler: routing::delete(handler) }
}

/// Every call of the HTTP door.
#[must_use]
pub fn routes() -> Vec<Route> {
    use Scope::{Read, Write};
    vec![
        post("/v1/scenes", Write, scenes::create),
        get("/v1/scenes", Read, scenes::list),
        get("/v1/scenes/{id}", Read, scenes::get),
        delete("/v1/scenes/{id}", Write, scenes::delete),
        get("/v1/scenes/{id}/events", Read, scenes::events),
        get("/v1/scenes/{id}/view", Read, render::view),
        post("/v1/scenes/{id}/views", Read, views::views),
        post("/v1/scenes/{id}/query", Read, ask::query),
        get("/v1/scenes/{id}/pick", Read, ask::pick),
        get("/v1/scenes/{id}/export", Read, render::export),
        get("/v1/models", Read, health::models),
        get("/healthz", None, health::live),
        get("/readyz", None, health::ready),
        get("/openapi.json", None, openapi::document),
        get("/", None, viewer::index),
    ]
}

/// Both doors as one router.
fn app(api: &Api) -> Result<Router> {
    let rpc = grpc::routes(api.clone())?.prepare().into_axum_router().reset_fallback();
    let guarded = |route: Route| match route.scope {
        None => (route.path, route.handler),
        Some(scope) => {
            let guard = middleware::from_fn_with_state((api.clone(), scope), edge::guard);
            (route.path, route.handler.route_layer(guard))
        }
    };
    let rest = routes()
        .into_iter()
        .map(guarded)
        .fold(Router::new(), |router, (path, handler)| router.route(path, handler))
        .method_not_allowed_fallback(error::method_not_allowed)
        .with_state(api.clone());
    let rest = rest_edge(rest.fallback(error::no_such_route));
    let both = rest.merge(rpc_edge(rpc, api.clone()));
    Ok(match cors::layer(&api.service.config().cors_origins)? {
        Some(cors) => both.layer(cors),
        None => both,
    })
}

/// What surrounds every HTTP call: request id, deadline, one error shape, a net for panics.
fn rest_edge(router: Router) -> Router {
    router
        .layer(DefaultBodyLimit::disable())
        .layer(CatchPanicLayer::custom(error::panicked))
        .layer(middleware::from_fn(edge::rest))
}

/// The same for every gRPC call.
fn rpc_edge(router: Router, api: Api) -> Router {
    router
        .layer(CatchPanicLayer::custom(edge::rpc_panicked))
        .layer(middleware::from_fn_with_state(api, edge::rpc))
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
