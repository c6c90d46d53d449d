//! The HTTP side: health, metrics, status, chunks for CDNs, and the live page.

use std::sync::Arc;

use axum::Router;
use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use axum::response::{Html, IntoResponse, Json, Response};
use axum::routing::get;
use protocol::ChunkHash;
use tokio::net::TcpListener;

use crate::session::count_failure;
use crate::shared::Shared;
use crate::store::ReadError;

/// Serves until the end.
pub(crate) async fn serve(shared: Arc<Shared>, listener: TcpListener) {
    let mut stop = shared.stop.subscribe();
    let routes = Router::new()
        .route("/", get(async || Html(include_str!("page.html"))))
        .route("/healthz", get(async || "ok\n"))
        .route("/metrics", get(metrics))
        .route("/status", get(async |State(shared): State<Arc<Shared>>| Json(shared.stats())))
        .route("/chunks/{hash}", get(chunk))
        .with_state(shared);
    let end = async move { drop(stop.wait_for(|stop| *stop).await) };
    let served = axum::serve(listener, routes).with_graceful_shutdown(end).await;
    if let Err(error) = served {
        tracing::error!(%error, "the HTTP side has ended");
    }
}

async fn metrics(State(shared): State<Arc<Shared>>) -> impl IntoResponse {
    const OPEN_METRICS: &str = "application/openmetrics-text; version=1.0.0; charset=utf-8";
    ([(header::CONTENT_TYPE, OPEN_METRICS)], shared.metrics.text())
}

/// A chunk under its hash: it never changes, so that any cache may keep it for ever.
async fn chunk(State(shared): State<Arc<Shared>>, Path(hash): Path<String>) -> Response {
    let Some(hash) = ChunkHash::from_hex(&hash) else {
        return (StatusCode::BAD_REQUEST, "a chunk's name is 64 hexadecimal digits\n")
            .into_response();
    };
    match shared.source.chunk(&hash).await {
        Ok(bytes) => {
            let headers = [
                (header::CONTENT_TYPE, "application/octet-stream"),
                (header::CACHE_CONTROL, "public, max-age=31536000, immutable"),
            ];
            (headers, bytes).into_response()
        }
        Err(error) => {
            count_failure(&shared, &error);
            let status = match error {
                ReadError::Missing(_) => StatusCode::NOT_FOUND,
                _ => StatusCode::INTERNAL_SERVER_ERROR,
            };
            (status, format!("{error}\n")).into_response()
        }
    }
}
