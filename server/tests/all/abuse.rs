//! What strangers and broken stores may cost: a bounded amount, and nobody else their game.

use std::net::SocketAddr;
use std::sync::Arc;
use std::sync::atomic::Ordering;
use std::time::{Duration, Instant};

use protocol::frame::frame;
use protocol::message::{ALPN, ClientMessage, CloseCode, Hello, PROTOCOL, Priority, Telemetry};
use protocol::session::SessionError;
use protocol::{ChunkHash, EdgeId, GarmentId, StateId, VersionNumber, store};
use server::{Server, ServerConfig};
use tokio::io::{AsyncReadExt, AsyncWriteExt};
use tokio::net::TcpStream;

use crate::faulty::Faulty;
use crate::player::{Player, endpoint};
use crate::world::{World, until};

async fn faulty(regions: u64) -> (World, Arc<Faulty>, Server) {
    let mut world = World::new();
    world.publish(regions);
    let store = Arc::new(Faulty::new(world.store()));
    let server = Server::start(world.config_with(store.clone())).await.unwrap();
    (world, store, server)
}

async fn play_all(server: &Server) -> Player {
    let mut player = Player::new(server, Some("letmein"));
    player.until("all chunks", |p| !p.versions.is_empty() && p.machine.wanted() == 0).await;
    player
}

async fn get(address: SocketAddr, path: &str) -> String {
    let mut stream = TcpStream::connect(address).await.unwrap();
    let request = format!("GET {path} HTTP/1.1\r\nhost: toile\r\nconnection: close\r\n\r\n");
    stream.write_all(request.as_bytes()).await.unwrap();
    let mut answer = Vec::new();
    stream.read_to_end(&mut answer).await.unwrap();
    String::from_utf8_lossy(&answer).into_owned()
}

#[tokio::test]
async fn a_store_that_fails_for_a_moment_costs_a_moment() {
    let (world, store, server) = faulty(5).await;
    let victim = world.manifest(1, 5).garments[0].regions[2].chunk.hash;
    let path = store::chunk_path(&victim);
    store.fail(&path, 2);
    let player = play_all(&server).await;
    assert_eq!((store.failures_left(), player.connections), (0, 1));
    assert!(player.missing.is_empty() && player.chunks.contains_key(&victim));
    assert_eq!(server.stats().store_failures, 2);
    server.shutdown().await;

    // One chunk that cannot be read keeps nobody from the others.
    let server = Server::start(world.config_with(store.clone())).await.unwrap();
    store.fail(&path, u32::MAX);
    let player = play_all(&server).await;
    assert_eq!((player.missing.as_slice(), player.connections), (&[victim][..], 1));
    server.shutdown().await;

    // The whole store, for longer: the session ends, the player comes back and asks again.
    store.fail(&path, 0);
    let server = Server::start(world.config_with(store.clone())).await.unwrap();
    until(&server, "version 1", |stats| stats.version == 1).await;
    store.is_down.store(true, Ordering::Relaxed);
    let mut player = Player::new(&server, Some("letmein"));
    player.until("the end of the session", |player| player.ended.is_some()).await;
    let ended = player.ended.take().unwrap();
    store.is_down.store(false, Ordering::Relaxed);
    player.until("all chunks", |p| p.chunks.len() == 5 + 4 && p.machine.wanted() == 0).await;
    assert!(player.missing.is_empty() && player.connections >= 2);
    let internal = matches!(ended, SessionError::Closed { code: CloseCode::Internal, .. });
    assert!(internal && !ended.is_final(), "{ended}");
    assert_eq!(server.stats().broken_sessions, 0, "it was not the player's fault");
    server.shutdown().await;
}

#[tokio::test]
async fn readiness_says_what_lacks_and_liveness_that_the_server_runs() {
    let mut world = World::new();
    let store = Arc::new(Faulty::new(world.store()));
    let server = Server::start(world.config_with(store.clone())).await.unwrap();
    let http = server.http_addr().unwrap();
    let wait = async |status: &str, word: &str| {
        let began = Instant::now();
        loop {
            let answer = get(http, "/readyz").await;
            if answer.starts_with(&format!("HTTP/1.1 {status}")) && answer.contains(word) {
                return;
            }
            assert!(began.elapsed() < Duration::from_secs(5), "{status} {word}: {answer}");
            tokio::time::sleep(Duration::from_millis(10)).await;
        }
    };
    wait("503", "no version").await;
    world.publish(1);
    wait("200", "ready").await;
    store.is_down.store(true, Ordering::Relaxed);
    wait("503", "out of order").await;
    assert!(get(http, "/healthz").await.ends_with("ok\n"));
    store.is_down.store(false, Ordering::Relaxed);
    wait("200", "ready").await;
    server.shutdown().await;
}

/// Five exact steps along one edge.
fn five_steps() -> Telemetry {
    Telemetry {
        garment: GarmentId(0),
        version: VersionNumber(1),
        edges: vec![(EdgeId(3), 5)],
        exact: 5,
        substituted: 0,
        missed: 0,
        jumps: 0,
    }
}

#[tokio::test]
async fn a_store_that_hangs_holds_no_shutdown_and_counts_are_written_once_it_can() {
    let (world, store, server) = faulty(1).await;
    let mut player = play_all(&server).await;
    store.hanging_puts.store(1, Ordering::Relaxed);
    player.machine.report(five_steps());
    player.until("a write that hangs", |_| store.hanging_puts.load(Ordering::Relaxed) == 0).await;
    let began = Instant::now();
    server.shutdown().await;
    assert!(began.elapsed() < Duration::from_secs(8), "{:?}", began.elapsed());
    let path = world.path(&store::telemetry_path(1));
    let batch = protocol::telemetry::TelemetryBatch::decode(&std::fs::read(path).unwrap()).unwrap();
    assert_eq!(batch.garments[0].edges, [(EdgeId(3), 5)]);

    // Never again: what was counted is lost, the server ends all the same.
    let server = Server::start(world.config_with(store.clone())).await.unwrap();
    play_all(&server).await;
    store.hanging_puts.store(u32::MAX, Ordering::Relaxed);
    let mut player = play_all(&server).await;
    player.machine.report(five_steps());
    player.until("a count", |_| server.stats().traversals == 5).await;
    let began = Instant::now();
    server.shutdown().await;
    assert!(began.elapsed() < Duration::from_secs(11), "{:?}", began.elapsed());
}

#[tokio::test]
async fn counts_whose_receipt_was_lost_count_once() {
    let (world, store, server) = faulty(1).await;
    let mut player = play_all(&server).await;
    store.unanswered_puts.store(1, Ordering::Relaxed);
    player.machine.report(five_steps());
    player.until("an answer lost", |_| store.unanswered_puts.load(Ordering::Relaxed) == 0).await;
    player.machine.report(five_steps());
    player.until("more counts", |_| server.stats().traversals == 10).await;
    server.shutdown().await;
    let read = |number| std::fs::read(world.path(&store::telemetry_path(number))).ok();
    let batches = (1..9).map_while(read).map(|bytes| {
        let batch = protocol::telemetry::TelemetryBatch::decode(&bytes).unwrap();
        batch.garments[0].edges[0].1
    });
    assert_eq!(batches.collect::<Vec<_>>(), [5, 5]);
}

/// A connection that was let in, with its control stream, and no credit for chunk streams.
async fn without_credit(server: &Server) -> (quinn::Connection, quinn::SendStream) {
    let mut transport = quinn::TransportConfig::default();
    transport.max_concurrent_uni_streams(0u32.into());
    let (endpoint, mut config) = endpoint_and_config(server);
    config.transport_config(Arc::new(transport));
    let connecting = endpoint.connect_with(config, server.quic_addr(), "toile").unwrap();
    let connection = connecting.await.unwrap();
    let (mut control, messages) = connection.open_bi().await.unwrap();
    let token = Some("letmein".into());
    let hello = Hello { protocol: PROTOCOL, token, garments: Vec::new(), have: None };
    control.write_all(&frame(&ClientMessage::Hello(hello).encode())).await.unwrap();
    tokio::spawn(async move {
        let mut messages = messages;
        while let Ok(Some(_)) = messages.read_chunk(1 << 16, true).await {}
    });
    (connection, control)
}

fn endpoint_and_config(server: &Server) -> (quinn::Endpoint, quinn::ClientConfig) {
    let config = crate::player::config(server.fingerprint(), ALPN);
    (quinn::Endpoint::client("127.0.0.1:0".parse().unwrap()).unwrap(), config)
}

#[tokio::test]
async fn what_was_cancelled_holds_nothing_even_where_no_stream_can_be_opened() {
    let (world, _store, server) = faulty(1).await;
    until(&server, "version 1", |stats| stats.version == 1).await;
    let hash = world.manifest(1, 1).garments[0].mesh.hash;
    let (_connection, mut control) = without_credit(&server).await;
    until(&server, "a player", |stats| stats.players == 1).await;
    let tasks = || tokio::runtime::Handle::current().metrics().num_alive_tasks();
    let before = tasks();
    let fetch = frame(&ClientMessage::Fetch { hash, priority: Priority::Urgent }.encode());
    let cancel = frame(&ClientMessage::Cancel { hash }.encode());
    for _ in 0..500 {
        control.write_all(&fetch).await.unwrap();
        tokio::task::yield_now().await;
        control.write_all(&cancel).await.unwrap();
        tokio::time::sleep(Duration::from_micros(500)).await;
    }
    tokio::time::sleep(Duration::from_millis(200)).await;
    assert!(tasks() < before + 20, "{} tasks, {before} before", tasks());
    server.shutdown().await;
}

#[tokio::test]
async fn packets_from_nowhere_take_nobodys_place() {
    let mut world = World::new();
    world.publish(1);
    let config = ServerConfig { players_max: 4, ..world.config() };
    let server = Server::start(config).await.unwrap();
    // First packets of connections that will never go on, caught on the way to a port of ours.
    let trap = tokio::net::UdpSocket::bind("127.0.0.1:0").await.unwrap();
    let dialling = endpoint(server.fingerprint(), ALPN);
    let mut packets = Vec::new();
    for _ in 0..200 {
        let connecting = dialling.connect(trap.local_addr().unwrap(), "toile").unwrap();
        let mut packet = vec![0; 2000];
        let caught = trap.recv(&mut packet).await.unwrap();
        packet.truncate(caught);
        packets.push(packet);
        drop(connecting);
    }
    let nowhere = std::net::UdpSocket::bind("127.0.0.1:0").unwrap();
    for packet in &packets {
        nowhere.send_to(packet, server.quic_addr()).unwrap();
    }
    let player = play_all(&server).await;
    assert_eq!(player.connections, 1, "let in at the first try");
    assert_eq!(server.stats().refused_connections, 0);
    server.shutdown().await;
}

#[tokio::test]
async fn a_browser_that_says_nothing_gives_its_place_back() {
    let mut world = World::new();
    world.publish(1);
    let server = world.serve().await;
    let http = server.http_addr().unwrap();
    let mut silent = Vec::new();
    for index in 0..300 {
        let mut stream = TcpStream::connect(http).await.unwrap();
        if index % 2 == 0 {
            stream.write_all(b"GET /status HT").await.unwrap();
        }
        silent.push(stream);
    }
    let began = Instant::now();
    assert!(get(http, "/healthz").await.ends_with("ok\n"));
    assert!(began.elapsed() < Duration::from_secs(9), "{:?}", began.elapsed());
    let mut nothing = [0; 10];
    assert_eq!(silent[1].read(&mut nothing).await.unwrap_or(0), 0, "closed");
    server.shutdown().await;
}

#[tokio::test]
async fn names_that_no_version_lists_are_looked_up_few_at_a_time() {
    let (world, store, server) = faulty(1).await;
    until(&server, "version 1", |stats| stats.version == 1).await;
    let http = server.http_addr().unwrap();
    store.delay_ms.store(30, Ordering::Relaxed);
    let guesses = (0..60u64).map(|guess| async move {
        let hash = ChunkHash::of(&guess.to_le_bytes());
        get(http, &format!("/chunks/{hash}")).await
    });
    let guesses = tokio::spawn(futures::future::join_all(guesses));
    tokio::time::sleep(Duration::from_millis(60)).await;
    // What is listed need not queue behind them.
    let began = Instant::now();
    let listed = world.manifest(1, 1).garments[0].mesh.hash;
    assert!(get(http, &format!("/chunks/{listed}")).await.starts_with("HTTP/1.1 200"));
    let took = began.elapsed();
    let guesses = guesses.await.unwrap();
    assert!(guesses.iter().all(|answer| answer.starts_with("HTTP/1.1 404")));
    assert!(took < Duration::from_millis(400), "{took:?}");
    // Eight, one that is listed, and the look for a new version.
    assert!(store.gets_max() <= 10, "{} at the same time", store.gets_max());
    assert_eq!(server.stats().chunks_missing, 60);
    // Of an older version, whoever asks: still there.
    let old = world.chunk(77, 500).hash;
    assert!(get(http, &format!("/chunks/{old}")).await.starts_with("HTTP/1.1 200"));
    server.shutdown().await;
}

#[tokio::test]
async fn a_folder_of_numbers_is_listed_once() {
    let mut world = World::new();
    world.publish(2);
    let store = Arc::new(Faulty::new(world.store()));
    let config =
        ServerConfig { tag_token: Some("pointer".into()), ..world.config_with(store.clone()) };
    let servers =
        [Server::start(config.clone()).await.unwrap(), Server::start(config).await.unwrap()];
    let mut players = Vec::new();
    for server in &servers {
        let mut player = Player::new(server, Some("pointer"));
        player.until("a version", |player| !player.versions.is_empty()).await;
        players.push(player);
    }
    // In turns, so that each finds its number taken by the other.
    for turn in 0..5 {
        for player in &mut players {
            assert!(player.machine.tag(GarmentId(0), StateId(5 + turn)));
            player.until("an answer", |player| player.tagged.len() as u64 > turn).await;
        }
    }
    let numbers = players.iter().flat_map(|player| &player.tagged).map(|(_, outcome)| *outcome);
    let mut numbers: Vec<_> = numbers.map(|outcome| format!("{outcome:?}")).collect();
    numbers.sort_by_key(|text| (text.len(), text.clone()));
    let expected: Vec<_> = (1..=10).map(|number| format!("Kept {{ number: {number} }}")).collect();
    assert_eq!(numbers, expected, "none left out, none twice");
    assert_eq!(store.listings("tags"), 2, "once by each server");
}
