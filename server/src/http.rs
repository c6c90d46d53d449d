//! The HTTP side: health, metrics, status, chunks for CDNs, and the live page.

use std::sync::Arc;
use std::time::Duration;

use axum::Router;
use axum::extract::{Path, State};
use axum::http::{StatusCode, header};
use axum::response::{Html, IntoResponse, Json, Response};
use axum::routing::get;
use hyper::server::conn::http1;
use hyper_util::rt::{TokioIo, TokioTimer};
use hyper_util::service::TowerToHyperService;
use protocol::ChunkHash;
use tokio::net::{TcpListener, TcpStream};
use tokio::sync::watch;
use tokio::task::JoinSet;

use crate::session::count_failure;
use crate::shared::Shared;
use crate::store::ReadError;

/// Connections at the same time; more wait in the system's queue.
const CONNECTIONS_MAX: usize = 256;
/// A connection that has not sent the head of a request for so long is closed.
const HEAD: Duration = Duration::from_secs(5);
/// A connection is closed after this long: enough for the largest chunk at 2 Mbit/s.
const LIFE: Duration = Duration::from_secs(300);
/// What is being answered may take so long when all else is over.
const LAST_WORDS: Duration = Duration::from_secs(1);
/// Pause where no connection can be accepted.
const PAUSE: Duration = Duration::from_millis(100);

/// Serves until the end.
pub(crate) async fn serve(shared: Arc<Shared>, listener: TcpListener) {
    let mut stop = shared.stop.subscribe();
    let routes = Router::new()
        .route("/", get(async || Html(include_str!("page.html"))))
        .route("/healthz", get(async || "ok\n"))
        .route("/readyz", get(ready))
        .route("/metrics", get(metrics))
        .route("/status", get(async |State(shared): State<Arc<Shared>>| Json(shared.stats())))
        .route("/chunks/{hash}", get(chunk))
        .with_state(shared.clone());
    let mut connections = JoinSet::new();
    loop {
        tokio::select! {
            _ = stop.wait_for(|stop| *stop) => break,
            Some(_) = connections.join_next(), if !connections.is_empty() => {}
            stream = accept(&shared, &listener), if connections.len() < CONNECTIONS_MAX => {
                connections.spawn(converse(stream, routes.clone(), shared.stop.subscribe()));
            }
        }
    }
    while connections.join_next().await.is_some() {}
}

async fn accept(shared: &Shared, listener: &TcpListener) -> TcpStream {
    loop {
        match listener.accept().await {
            Ok((stream, _)) => return stream,
            Err(error) => {
                if let Some(more) = shared.logs.http.may_write() {
                    tracing::warn!(%error, more, "no HTTP connection could be accepted");
                }
                tokio::time::sleep(PAUSE).await;
            }
        }
    }
}

/// One connection to its end. What goes wrong on it is the other side's to know.
async fn converse(stream: TcpStream, routes: Router, mut stop: watch::Receiver<bool>) {
    let service = TowerToHyperService::new(routes);
    let connection = http1::Builder::new()
        .timer(TokioTimer::new())
        .header_read_timeout(HEAD)
        .serve_connection(TokioIo::new(stream), service);
    let mut connection = std::pin::pin!(connection);
    tokio::select! {
        _ = connection.as_mut() => return,
        _ = stop.wait_for(|stop| *stop) => {}
        () = tokio::time::sleep(LIFE) => {}
    }
    connection.as_mut().graceful_shutdown();
    let _ = tokio::time::timeout(LAST_WORDS, connection).await;
}

/// Whether players can play: for what decides where they are sent.
async fn ready(State(shared): State<Arc<Shared>>) -> Response {
    match shared.lacks() {
        None => "ready\n".into_response(),
        Some(why) => (StatusCode::SERVICE_UNAVAILABLE, format!("{why}\n")).into_response(),
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
    match shared.chunk(&hash).await {
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
                ReadError::Store { .. } => StatusCode::SERVICE_UNAVAILABLE,
                _ => StatusCode::INTERNAL_SERVER_ERROR,
            };
            (status, format!("{error}\n")).into_response()
        }
    }
}
