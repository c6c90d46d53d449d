//! What a server does on a good day.

use protocol::message::{CloseCode, Telemetry};
use protocol::session::SessionError;
use protocol::telemetry::TelemetryBatch;
use protocol::{EdgeId, GarmentId, VersionNumber, store};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::player::Player;
use crate::world::{World, until};

#[tokio::test]
async fn versions_and_chunks_reach_players_without_a_reconnect() {
    let mut world = World::new();
    let server = world.serve().await;
    let mut player = Player::new(&server, Some("letmein"));
    player.until("the welcome", |player| player.machine.is_open()).await;
    assert_eq!(server.stats().version, 0);

    world.publish(60);
    player.until("all chunks", |p| p.versions.len() == 1 && p.machine.wanted() == 0).await;
    assert_eq!(player.chunks.len(), 60 + 4);
    let sent_before = server.stats().bytes_sent;

    world.publish(61);
    server.notify();
    player.until("version 2", |p| p.versions.len() == 2 && p.machine.wanted() == 0).await;
    assert_eq!(player.versions, [VersionNumber(1), VersionNumber(2)]);
    assert_eq!(player.connections, 1);
    let applied = tokio::select! {
        () = player.until("for ever", |_| false) => unreachable!(),
        stats = until(&server, "version 2 applied", |s| s.applied.get(&2) == Some(&1)) => stats,
    };
    let cost = applied.bytes_sent - sent_before;
    assert!(cost < 20_000 + 3000, "version 2 cost {cost} bytes");
    assert_eq!(applied.history.len(), 2);

    server.shutdown().await;
    player.until("the end", |player| player.ended.is_some()).await;
    let ended = player.ended.unwrap();
    assert!(matches!(ended, SessionError::Closed { code: CloseCode::ShuttingDown, .. }), "{ended}");
}

#[tokio::test]
async fn a_player_who_comes_back_gets_the_difference() {
    let mut world = World::new();
    world.publish(200);
    let server = world.serve().await;
    let mut player = Player::new(&server, Some("letmein"));
    player.until("all chunks", |p| p.versions.len() == 1 && p.machine.wanted() == 0).await;
    let address = server.quic_addr();
    let fingerprint = server.fingerprint().to_string();
    server.shutdown().await;

    world.publish(200);
    let config = server::ServerConfig { listen: address, ..world.config() };
    let server = server::Server::start(config).await.unwrap();
    assert_eq!(server.fingerprint(), fingerprint, "the certificate is kept");
    player.until("version 2", |p| p.versions.len() == 2 && p.machine.wanted() == 0).await;
    let sent = server.stats().bytes_sent;
    assert!(sent < 3000, "{sent} bytes for one new link page");
    server.shutdown().await;
}

#[tokio::test]
async fn what_players_walked_lies_in_the_store() {
    let mut world = World::new();
    world.publish(1);
    let server = world.serve().await;
    let mut player = Player::new(&server, Some("letmein"));
    player.until("version 1", |player| player.versions.len() == 1).await;
    player.machine.report(Telemetry {
        garment: GarmentId(0),
        version: VersionNumber(1),
        edges: vec![(EdgeId(3), 5), (EdgeId(39), 2), (EdgeId(40), 1000)],
        exact: 6,
        substituted: 1,
        missed: 0,
        jumps: 0,
    });
    let path = world.path(&store::telemetry_path(1));
    player.until("the batch", |_| path.exists()).await;
    let batch = TelemetryBatch::decode(&std::fs::read(path).unwrap()).unwrap();
    assert_eq!(batch.garments[0].edges, [(EdgeId(3), 5), (EdgeId(39), 2)]);
    let stats = server.stats();
    assert_eq!((stats.outcomes.exact, stats.outcomes.substituted), (6, 1));
    assert_eq!((stats.traversals, stats.traversals_dropped), (7, 1000));
    server.shutdown().await;
}

#[tokio::test]
async fn http_tells_and_serves() {
    let mut world = World::new();
    let manifest = world.publish(2);
    let server = world.serve().await;
    until(&server, "version 1", |stats| stats.version == 1).await;
    let address = server.http_addr().unwrap();
    let get = async |path: &str| {
        let mut stream = TcpStream::connect(address).await.unwrap();
        let request = format!("GET {path} HTTP/1.1\r\nhost: toile\r\nconnection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).await.unwrap();
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).await.unwrap();
        String::from_utf8_lossy(&answer).into_owned()
    };
    assert!(get("/healthz").await.ends_with("ok\n"));
    assert!(get("/metrics").await.contains("\ntoile_version 1\n"));
    let status = get("/status").await;
    let json = &status[status.find("\r\n\r\n").unwrap()..];
    let status: serde_json::Value = serde_json::from_str(json).unwrap();
    assert_eq!(status["version"], 1);
    assert_eq!(status["garments"][0]["name"], "robe");
    let worst_mm = status["garments"][0]["worst_error_mm"].as_f64().unwrap();
    assert!((worst_mm - 10.0).abs() < 1e-4);
    let chunk = get(&format!("/chunks/{}", manifest.garments[0].mesh.hash)).await;
    assert!(chunk.starts_with("HTTP/1.1 200") && chunk.contains("immutable"));
    let page = get("/").await;
    assert!(page.contains("<title>Toile</title>") && !page.contains("http://"));
    assert!(get("/chunks/xyz").await.starts_with("HTTP/1.1 400"));
    assert!(get(&format!("/chunks/{:064}", 0)).await.starts_with("HTTP/1.1 404"));
    server.shutdown().await;
}

#[tokio::test]
async fn one_store_may_have_many_servers() {
    let mut world = World::new();
    world.publish(3);
    let (a, b) = (world.serve().await, world.serve().await);
    for server in [&a, &b] {
        let mut player = Player::new(server, Some("letmein"));
        player.until("all chunks", |p| p.versions.len() == 1 && p.machine.wanted() == 0).await;
    }
    a.shutdown().await;
    b.shutdown().await;
}
