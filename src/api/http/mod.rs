//! The HTTP door, and the port that both doors share: HTTP/1.1, HTTP/2 and gRPC over h2c.
//!
//! [`routes`] is the list of calls; `/openapi.json` is held to it by `tests/it/errors.rs`.

mod ask;
mod edge;
mod error;
mod extract;
mod health;
mod openapi;
mod params;
mod receive;
mod render;
mod scenes;
mod schemas;
mod viewer;
mod views;

use std::{future::Future, time::Duration};

use axum::{
    Router,
    extract::DefaultBodyLimit,
    handler::Handler,
    middleware,
    routing::{self, MethodRouter},
    serve::ListenerExt,
};
use tokio::{net::TcpListener, sync::watch};
use tower_http::catch_panic::CatchPanicLayer;

use super::{Api, grpc};
use crate::{
    error::{Error, Result},
    service::Service,
};

/// How long open calls may go on after the stop signal.
const GRACE: Duration = Duration::from_secs(10);

/// One call of the HTTP door.
#[derive(Clone, Debug)]
pub struct Route {
    /// Method, upper case.
    pub method: &'static str,
    /// Path with `{id}` where an id goes.
    pub path: &'static str,
    handler: MethodRouter<Api>,
}

fn get<H: Handler<T, Api>, T: 'static>(path: &'static str, handler: H) -> Route {
    Route { method: "GET", path, handler: routing::get(handler) }
}

fn post<H: Handler<T, Api>, T: 'static>(path: &'static str, handler: H) -> Route {
    Route { method: "POST", path, handler: routing::post(handler) }
}

fn delete<H: Handler<T, Api>, T: 'static>(path: &'static str, handler: H) -> Route {
    Route { method: "DELETE", path, handler: routing::delete(handler) }
}

/// Every call of the HTTP door.
#[must_use]
pub fn routes() -> Vec<Route> {
    vec![
        post("/v1/scenes", scenes::create),
        get("/v1/scenes", scenes::list),
        get("/v1/scenes/{id}", scenes::get),
        delete("/v1/scenes/{id}", scenes::delete),
        get("/v1/scenes/{id}/events", scenes::events),
        get("/v1/scenes/{id}/view", render::view),
        post("/v1/scenes/{id}/views", views::views),
        post("/v1/scenes/{id}/query", ask::query),
        get("/v1/scenes/{id}/pick", ask::pick),
        get("/v1/scenes/{id}/export", render::export),
        get("/v1/models", health::models),
        get("/healthz", health::live),
        get("/readyz", health::ready),
        get("/openapi.json", openapi::document),
        get("/", viewer::index),
    ]
}

/// Both doors as one router.
///
/// # Errors
/// `internal` when the gRPC descriptors are damaged.
pub fn app(service: Service) -> Result<Router> {
    let api = Api::new(service);
    let rpc = grpc::routes(api.clone())?.prepare().into_axum_router().reset_fallback();
    let rest = routes()
        .into_iter()
        .fold(Router::new(), |router, route| router.route(route.path, route.handler))
        .method_not_allowed_fallback(error::method_not_allowed)
        .with_state(api);
    Ok(rest_edge(rest.fallback(error::no_such_route)).merge(rpc_edge(rpc)))
}

/// What surrounds every HTTP call: request id, deadline, one error shape, a net for panics.
fn rest_edge(router: Router) -> Router {
    router
        .layer(DefaultBodyLimit::disable())
        .layer(CatchPanicLayer::custom(error::panicked))
        .layer(middleware::from_fn(edge::rest))
}

/// The same for every gRPC call.
fn rpc_edge(router: Router) -> Router {
    router.layer(CatchPanicLayer::custom(edge::rpc_panicked)).layer(middleware::from_fn(edge::rpc))
}

/// Serves both doors on `listener` until `stop` resolves; open calls get ten seconds to end.
///
/// # Errors
/// `internal` when the listener fails.
pub async fn serve(
    listener: TcpListener,
    service: Service,
    stop: impl Future<Output = ()> + Send + 'static,
) -> Result<()> {
    let app = app(service)?;
    // Nagle's algorithm against delayed acknowledgements costs a unary call 45 ms.
    let listener = listener.tap_io(|stream| {
        if let Err(error) = stream.set_nodelay(true) {
            tracing::debug!(%error, "TCP_NODELAY refused");
        }
    });
    let (stopped, mut stopping) = watch::channel(false);
    let graceful = axum::serve(listener, app).with_graceful_shutdown(async move {
        stop.await;
        stopped.send_replace(true);
    });
    let late = async move {
        // An error means that the sender is gone: the server has ended by itself.
        if stopping.wait_for(|&stopped| stopped).await.is_err() {
            std::future::pending::<()>().await;
        }
        tokio::time::sleep(GRACE).await;
    };
    tokio::select! {
        ended = graceful.into_future() => {
            ended.map_err(|e| Error::internal("the listener failed").caused_by(e))
        }
        () = late => Ok(()),
    }
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
        let router = rpc_edge(Router::new().route("/boom", routing::get(boom)));
        let (status, headers, _) = call(router, "/boom").await;
        assert_eq!(status, StatusCode::OK);
        assert_eq!(headers["grpc-status"], "13");
        assert_eq!(headers["segsplat-code"], "internal");
    }
}
