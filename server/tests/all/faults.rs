//! What a server does on a bad day: it says so, and goes on for everybody else.

use std::time::Duration;

use protocol::frame::frame;
use protocol::message::{ALPN, ClientMessage, CloseCode, Hello, PROTOCOL};
use protocol::session::SessionError;
use protocol::{SigningKey, limits, store};
use quinn::Connection;
use server::Server;

use crate::player::{Player, endpoint};
use crate::world::{World, until};

/// The server still lets a player in and serves the head.
async fn assert_serves(server: &Server) {
    let mut player = Player::new(server, Some("letmein"));
    player.until("all chunks", |p| !p.versions.is_empty() && p.machine.wanted() == 0).await;
}

async fn world() -> (World, Server) {
    let mut world = World::new();
    world.publish(5);
    let server = world.serve().await;
    (world, server)
}

#[tokio::test]
async fn garbage_on_the_port_is_counted_and_ignored() {
    let (_world, server) = world().await;
    let socket = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    let mut state = 1u32;
    for length in 0..300usize {
        let mut random = || {
            state = state.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            (state >> 24) as u8
        };
        let garbage: Vec<u8> = (0..length * 5).map(|_| random()).collect();
        socket.send_to(&garbage, server.quic_addr()).unwrap();
    }
    until(&server, "garbage counted", |stats| stats.stray_datagrams > 100).await;
    assert_serves(&server).await;
    server.shutdown().await;
}

#[tokio::test]
async fn a_wrong_token_is_told_so() {
    let (_world, server) = world().await;
    for token in [None, Some("guess")] {
        let mut player = Player::new(&server, token);
        player.until("the refusal", |player| player.ended.is_some()).await;
        let ended = player.ended.unwrap();
        let refused = matches!(ended, SessionError::Closed { code: CloseCode::TokenRefused, .. });
        assert!(refused && ended.is_final(), "{ended}");
    }
    until(&server, "refusals counted", |stats| stats.refused_tokens == 2).await;
    assert_serves(&server).await;
    server.shutdown().await;
}

#[tokio::test]
async fn another_protocol_or_fingerprint_fails_the_handshake() {
    let (_world, server) = world().await;
    let wrong_alpn = endpoint(server.fingerprint(), b"h3");
    let wrong_pin = endpoint(&"0".repeat(64), ALPN);
    for endpoint in [wrong_alpn, wrong_pin] {
        endpoint.connect(server.quic_addr(), "toile").unwrap().await.unwrap_err();
    }
    until(&server, "failures counted", |stats| stats.failed_handshakes == 2).await;
    assert_serves(&server).await;
    server.shutdown().await;
}

/// Says `bytes` on the control stream and hears how the server ends it.
async fn say(server: &Server, bytes: &[u8]) -> (Connection, Option<CloseCode>) {
    let endpoint = endpoint(server.fingerprint(), ALPN);
    let connection = endpoint.connect(server.quic_addr(), "toile").unwrap().await.unwrap();
    let (mut control, _messages) = connection.open_bi().await.unwrap();
    let _ = control.write_all(bytes).await;
    let closed = tokio::time::timeout(Duration::from_secs(5), connection.closed()).await;
    let code = match closed {
        Ok(quinn::ConnectionError::ApplicationClosed(close)) => {
            CloseCode::from_number(close.error_code.into())
        }
        _ => None,
    };
    (connection, code)
}

#[tokio::test]
async fn broken_messages_end_their_own_session_only() {
    let (_world, server) = world().await;
    let oversized = (limits::MESSAGE_BYTES_MAX as u32 + 1).to_le_bytes();
    assert_eq!(say(&server, &oversized).await.1, Some(CloseCode::TooLong));
    assert_eq!(say(&server, &frame(&[200; 50])).await.1, Some(CloseCode::Malformed));
    assert_eq!(say(&server, &frame(&[])).await.1, Some(CloseCode::Malformed));
    let hello = Hello { protocol: PROTOCOL + 1, token: None, garments: Vec::new(), have: None };
    let newer = frame(&ClientMessage::Hello(hello).encode());
    assert_eq!(say(&server, &newer).await.1, Some(CloseCode::OtherProtocol));
    until(&server, "all counted", |stats| stats.broken_sessions == 4).await;
    assert_serves(&server).await;
    server.shutdown().await;
}

#[tokio::test]
async fn a_message_cut_short_is_no_harm() {
    let (_world, server) = world().await;
    let endpoint = endpoint(server.fingerprint(), ALPN);
    let connection = endpoint.connect(server.quic_addr(), "toile").unwrap().await.unwrap();
    let (mut control, mut messages) = connection.open_bi().await.unwrap();
    control.write_all(&[40, 0, 0, 0, 1, 2, 3]).await.unwrap();
    control.finish().unwrap();
    assert!(messages.read_to_end(100).await.is_ok(), "the server ends its side too");
    assert_serves(&server).await;
    server.shutdown().await;
}

#[tokio::test]
async fn a_corrupted_chunk_is_never_served() {
    let (world, server) = world().await;
    let victim = world.manifest(1, 5).garments[0].regions[2].chunk.hash;
    let path = world.path(&store::chunk_path(&victim));
    let mut bytes = std::fs::read(&path).unwrap();
    bytes[100] ^= 1;
    std::fs::write(&path, bytes).unwrap();
    let mut player = Player::new(&server, Some("letmein"));
    player.until("the rest", |p| !p.versions.is_empty() && p.machine.wanted() == 0).await;
    assert_eq!(player.missing, [victim]);
    assert_eq!(player.chunks.len(), 5 + 4 - 1);
    assert_eq!(server.stats().chunks_corrupted, 1);
    std::fs::remove_file(path).unwrap();
    let mut player = Player::new(&server, Some("letmein"));
    player.until("the rest", |p| !p.missing.is_empty() && p.machine.wanted() == 0).await;
    assert_eq!(server.stats().chunks_missing, 1);
    server.shutdown().await;
}

#[tokio::test]
async fn a_damaged_or_forged_version_is_passed_over() {
    let (mut world, server) = world().await;
    until(&server, "version 1", |stats| stats.version == 1).await;
    world.put_version(b"garbage");
    until(&server, "garbage refused", |stats| stats.bad_manifests == 1).await;
    let late = world.serve().await;
    until(&late, "the version before garbage", |stats| stats.version == 1).await;
    late.shutdown().await;
    let forged = world.manifest(3, 6).sign(&SigningKey::from_seed(&[4; 32]));
    world.put_version(&forged.encode());
    until(&server, "forgery refused", |stats| stats.bad_manifests == 2).await;
    assert_eq!(server.stats().version, 1);
    world.publish(7);
    until(&server, "version 4", |stats| stats.version == 4).await;
    assert_serves(&server).await;
    server.shutdown().await;
}

#[tokio::test]
async fn a_full_server_says_so() {
    let mut world = World::new();
    world.publish(1);
    let config = server::ServerConfig { players_max: 1, ..world.config() };
    let server = Server::start(config).await.unwrap();
    let mut first = Player::new(&server, Some("letmein"));
    first.until("the first player", |player| player.machine.is_open()).await;
    let mut second = Player::new(&server, Some("letmein"));
    second.until("the refusal", |player| player.ended.is_some()).await;
    let ended = second.ended.clone().unwrap();
    assert!(matches!(ended, SessionError::Closed { code: CloseCode::Full, .. }), "{ended}");
    assert_eq!(server.stats().players, 1);
    drop(first);
    second.ended = None;
    second.until("a place", |player| player.machine.is_open()).await;
    server.shutdown().await;
}

#[tokio::test]
async fn a_taken_port_is_named() {
    let (world, server) = world().await;
    let config = server::ServerConfig { listen: server.quic_addr(), ..world.config() };
    let error = Server::start(config).await.unwrap_err().to_string();
    assert!(error.contains(&server.quic_addr().to_string()), "{error}");
    server.shutdown().await;
}
