//! The conversation with one page. The page asks for each frame, so that one that is hidden, slow or
//! gone costs nothing, and no more than one answer is ever under way.

use std::sync::Arc;
use std::sync::atomic::{AtomicU64, Ordering};
use std::time::Duration;

use anyhow::Result;
use axum::extract::ws::{Message, Utf8Bytes, WebSocket};
use serde_json::json;
use tokio::time::timeout;

use super::app::{App, PAGES_MAX};
use super::show::{Command, Said, Show};

/// A page that takes no answer for this long is given up.
const SEND_MAX: Duration = Duration::from_secs(10);
/// A page that says nothing is asked for a sign of life this often,
const PING: Duration = Duration::from_secs(10);
/// and given up after as many that were not answered.
const PINGS_MAX: u32 = 3;
/// What a page says to get a frame.
const FRAME: &str = "f";

/// Talks with a page until it is gone.
pub async fn run(app: Arc<App>, mut socket: WebSocket) {
    static SEED: AtomicU64 = AtomicU64::new(1);
    let mut show = Show::new(app, SEED.fetch_add(1, Ordering::Relaxed));
    let mut unanswered = 0;
    loop {
        let answers = match timeout(PING, socket.recv()).await {
            Err(_) if unanswered >= PINGS_MAX => break,
            Err(_) => {
                unanswered += 1;
                vec![Message::Ping(Vec::new().into())]
            }
            Ok(None | Some(Err(_) | Ok(Message::Close(_)))) => break,
            Ok(Some(Ok(message))) => {
                unanswered = 0;
                // Decoding is work, not waiting: other pages go on meanwhile.
                match tokio::task::block_in_place(|| answer(&mut show, &message)) {
                    Ok(answers) => answers,
                    Err(error) => {
                        tracing::warn!("a page was closed: {error:#}");
                        break;
                    }
                }
            }
        };
        for answer in answers {
            if !matches!(timeout(SEND_MAX, socket.send(answer)).await, Ok(Ok(()))) {
                return;
            }
        }
    }
}

/// Tells a page that there is no room for it, and closes its line.
pub async fn refuse(mut socket: WebSocket) {
    let why = format!("{PAGES_MAX} pages are open; close one");
    let text = said(Said::Text(json!({ "say": "refused", "why": why })));
    // A page that has gone already needs no word.
    let _ = socket.send(text).await;
    let _ = socket.send(Message::Close(None)).await;
}

/// What a message is answered with.
fn answer(show: &mut Show, message: &Message) -> Result<Vec<Message>> {
    let Message::Text(text) = message else { return Ok(Vec::new()) };
    if text.as_str() == FRAME {
        return Ok(show.frame()?.into_iter().map(said).collect());
    }
    let done = match serde_json::from_str::<Command>(text) {
        Ok(command) => show.command(command),
        Err(error) => Err(error.into()),
    };
    Ok(match done {
        Ok(None) => Vec::new(),
        Ok(Some(value)) => vec![said(Said::Text(value))],
        Err(error) => {
            let why = format!("{error:#}");
            vec![said(Said::Text(json!({ "say": "refused", "why": why })))]
        }
    })
}

fn said(said: Said) -> Message {
    match said {
        Said::Text(value) => Message::Text(Utf8Bytes::from(value.to_string())),
        Said::Bytes(bytes) => Message::Binary(bytes.into()),
    }
}
