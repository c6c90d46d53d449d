//! The page and its WebSocket, for this machine's own browser only.

use std::net::SocketAddr;
use std::sync::Arc;

use axum::Router;
use axum::extract::ws::WebSocketUpgrade;
use axum::extract::{Request, State};
use axum::http::{HeaderMap, HeaderValue, StatusCode, header};
use axum::middleware::{self, Next};
use axum::response::{IntoResponse, Response};
use axum::routing::get;
use tokio::net::TcpListener;

use super::app::{App, Place};
use super::session;

const PAGE: &str = include_str!("page/index.html");
const STYLE: &str = include_str!("page/style.css");
/// One module, in parts: the graphics, the plots, the page.
const MODULE: &str = concat!(
    include_str!("page/graphics.js"),
    include_str!("page/plots.js"),
    include_str!("page/panels.js"),
    include_str!("page/main.js")
);
/// Bytes of a message from the page.
pub const MESSAGE_BYTES_MAX: usize = 4096;

/// Serves until `stop` resolves.
pub async fn serve(
    app: Arc<App>,
    listener: TcpListener,
    stop: impl Future<Output = ()> + Send + 'static,
) {
    let address = listener.local_addr().ok();
    let guard = move |headers: HeaderMap, request: Request, next: Next| async move {
        match refusal(&headers, address) {
            Some(why) => (StatusCode::FORBIDDEN, why).into_response(),
            None => next.run(request).await,
        }
    };
    let routes = Router::new()
        .route("/", get(async || content("text/html; charset=utf-8", PAGE)))
        .route("/style.css", get(async || content("text/css; charset=utf-8", STYLE)))
        .route("/toile.js", get(async || content("text/javascript; charset=utf-8", MODULE)))
        .route("/live", get(live))
        .with_state(app)
        .layer(middleware::from_fn(guard));
    if let Err(error) = axum::serve(listener, routes).with_graceful_shutdown(stop).await {
        tracing::error!(%error, "the page's server has ended");
    }
}

/// Nothing from elsewhere, no frame around the page, no copy kept.
fn content(kind: &'static str, body: &'static str) -> impl IntoResponse {
    const POLICY: &str = "default-src 'none'; script-src 'self'; style-src 'self'; \
        connect-src 'self'; img-src data:; frame-ancestors 'none'; base-uri 'none'";
    let headers = [
        (header::CONTENT_TYPE, kind),
        (header::CONTENT_SECURITY_POLICY, POLICY),
        (header::X_CONTENT_TYPE_OPTIONS, "nosniff"),
        (header::CACHE_CONTROL, "no-store"),
    ];
    (headers, body)
}

async fn live(State(app): State<Arc<App>>, upgrade: WebSocketUpgrade) -> Response {
    let upgrade = upgrade.max_message_size(MESSAGE_BYTES_MAX).max_frame_size(MESSAGE_BYTES_MAX);
    let Some(place) = Place::take(&app) else {
        // A page cannot read why its socket is refused; so it is told over the socket.
        return upgrade.on_upgrade(session::refuse);
    };
    upgrade.write_buffer_size(0).on_upgrade(move |socket| async move {
        session::run(app, socket).await;
        drop(place);
    })
}

/// Why a request is refused. A name that leads here (by a rebound DNS entry) must be this machine's,
/// and a page that asks must be our own: else any site that is open in the browser could watch and
/// steer.
fn refusal(headers: &HeaderMap, address: Option<SocketAddr>) -> Option<&'static str> {
    let text = |value: &HeaderValue| value.to_str().unwrap_or("?").to_owned();
    let Some(host) = headers.get(header::HOST).map(text) else { return Some("name the host\n") };
    let port = address.map_or(0, |address| address.port());
    let own = ["127.0.0.1", "localhost", "[::1]"].map(|name| format!("{name}:{port}"));
    let listens = address.map(|address| address.to_string());
    if !own.contains(&host) && listens.as_ref() != Some(&host) {
        return Some("this page answers to the address that it was started at\n");
    }
    let is_socket = headers.contains_key(header::UPGRADE);
    let origin = headers.get(header::ORIGIN).map(text);
    match origin {
        Some(origin) if origin == format!("http://{host}") => None,
        None if !is_socket => None,
        _ => Some("another origin may not watch\n"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn asked(pairs: &[(header::HeaderName, &str)]) -> Option<&'static str> {
        let headers = pairs.iter().map(|(name, value)| (name.clone(), value.parse().unwrap()));
        refusal(&headers.collect(), Some("127.0.0.1:81".parse().unwrap()))
    }

    #[test]
    fn only_our_own_page_may_watch() {
        let host = (header::HOST, "localhost:81");
        let socket = (header::UPGRADE, "websocket");
        assert_eq!(asked(std::slice::from_ref(&host)), None);
        assert!(asked(&[(header::ORIGIN, "http://localhost:81")]).is_some(), "no host");
        assert_eq!(asked(&[host.clone(), (header::ORIGIN, "http://localhost:81")]), None);
        let own = (header::ORIGIN, "http://localhost:81");
        assert_eq!(asked(&[host.clone(), socket.clone(), own.clone()]), None);
        assert!(asked(&[host.clone(), socket.clone()]).is_some(), "a socket names its origin");
        for origin in ["http://evil.example", "http://127.0.0.1:81", "null", "http://localhost:82"]
        {
            let from = (header::ORIGIN, origin);
            assert!(asked(&[host.clone(), from.clone()]).is_some(), "{origin}");
            assert!(asked(&[host.clone(), socket.clone(), from]).is_some(), "{origin}");
        }
        for name in ["evil.example:81", "127.0.0.1", "127.0.0.1:82", "localhost"] {
            let own = format!("http://{name}");
            assert!(asked(&[(header::HOST, name), (header::ORIGIN, &own)]).is_some(), "{name}");
        }
    }
}
