//! What one side may cost the other: memory, work and weight.

use std::sync::Arc;

use protocol::frame::{chunk_head, frame};
use protocol::manifest::ChunkRef;
use protocol::message::{
    ClientMessage, CloseCode, Have, Hello, PROTOCOL, Priority, ServerMessage, Telemetry,
};
use protocol::session::{
    Client, ClientConfig, ClientEvent, Deliveries, Server, ServerConfig, ServerEvent, SessionError,
    Time,
};
use protocol::{ChunkHash, EdgeId, GarmentId, SignedManifest, VersionNumber, limits};

use crate::samples;

fn server_for(have: Option<Have>) -> Server {
    let mut server = Server::new(ServerConfig::default(), Time(0));
    let hello = Hello { protocol: PROTOCOL, token: None, garments: Vec::new(), have };
    server.handle_control(Time(0), &frame(&ClientMessage::Hello(hello).encode()));
    while server.poll_transmit().is_some() || server.poll_event().is_some() {}
    server
}

fn say(server: &mut Server, now: Time, message: &ClientMessage) -> Vec<ServerEvent> {
    server.handle_control(now, &frame(&message.encode()));
    std::iter::from_fn(|| server.poll_event()).collect()
}

fn version(number: u64) -> Arc<SignedManifest> {
    Arc::new(samples::manifest(number, 3, 2, number).sign(&samples::key()))
}

/// A client that was let in.
fn client() -> Client {
    let mut client = Client::new(ClientConfig::default());
    let _ = connect(&mut client, Time(0));
    client
}

/// Connects, and gives what it says hello with.
fn connect(client: &mut Client, now: Time) -> Hello {
    client.handle_timeout(now);
    assert_eq!(client.poll_event(), Some(ClientEvent::Connect));
    client.handle_connected(now);
    let said = client.poll_transmit(now).unwrap();
    let ClientMessage::Hello(hello) = ClientMessage::decode(&said[4..]).unwrap() else {
        panic!("{said:?}");
    };
    let publisher = Some(samples::key().public());
    hear(client, now, &ServerMessage::Welcome { protocol: PROTOCOL, publisher });
    assert_eq!(client.poll_event(), Some(ClientEvent::Welcome));
    hello
}

fn hear(client: &mut Client, now: Time, message: &ServerMessage) {
    client.handle_control(now, &frame(&message.encode()));
}

#[test]
fn of_many_pins_one_is_looked_up_at_a_time_and_the_newest_counts() {
    let mut server = server_for(None);
    server.handle_publisher(samples::key().public());
    while server.poll_transmit().is_some() {}
    let pin = |number| ClientMessage::Pin { version: VersionNumber(number) };
    let mut looked_up = Vec::new();
    for number in 1..=10 {
        looked_up.extend(say(&mut server, Time(0), &pin(number)));
    }
    assert_eq!(looked_up, [ServerEvent::Pin(VersionNumber(1))]);
    server.handle_pinned(VersionNumber(1), Some(version(1)));
    assert_eq!(server.poll_transmit(), None, "nobody wants version 1 any more");
    assert_eq!(server.poll_event(), Some(ServerEvent::Pin(VersionNumber(10))));
    server.handle_pinned(VersionNumber(10), Some(version(10)));
    assert!(server.poll_transmit().is_some());
    assert_eq!(say(&mut server, Time(0), &pin(10)), [], "it is being played");
    let flood = (0..10).flat_map(|n| say(&mut server, Time(0), &pin(20 + n))).last();
    let too_many =
        matches!(flood, Some(ServerEvent::Closed { code: CloseCode::TooManyMessages, .. }));
    assert!(too_many, "{flood:?}");
}

#[test]
fn one_stream_at_a_time_collects_a_chunk_and_it_is_the_latest() {
    let mut client = client();
    let bytes = vec![7u8; 10_000];
    let hash = ChunkHash::of(&bytes);
    let chunk = ChunkRef { hash, bytes: bytes.len() as u32 };
    assert!(client.want(chunk, Priority::Urgent));
    assert!(client.poll_transmit(Time(0)).is_some());
    let head = chunk_head(&hash, chunk.bytes);
    // In no order: stream 41 is the latest.
    for stream in [3, 41, 1, 7, 40] {
        client.handle_chunk(Time(0), stream, &head, false);
        client.handle_chunk(Time(0), stream, &bytes[..9_999], false);
    }
    for stream in [3, 1, 7, 40] {
        client.handle_chunk(Time(0), stream, &bytes[9_999..], true);
        assert_eq!(client.poll_event(), None, "stream {stream} was dropped");
    }
    client.handle_chunk(Time(0), 41, &bytes[9_999..], true);
    assert_eq!(client.poll_event(), Some(ClientEvent::Chunk { hash, bytes: bytes.clone() }));
    assert_eq!(client.wanted(), 0);

    // A dropped stream that is cut is nothing to ask again for; the one that counts is.
    assert!(client.want(chunk, Priority::Urgent));
    assert!(client.poll_transmit(Time(0)).is_some());
    client.handle_chunk(Time(0), 50, &head, false);
    client.handle_chunk(Time(0), 51, &head, false);
    client.handle_chunk_reset(50);
    assert_eq!(client.poll_transmit(Time(0)), None);
    client.handle_chunk_reset(51);
    assert!(client.poll_transmit(Time(0)).is_some());
}

#[test]
fn after_a_difference_that_cannot_be_read_the_whole_manifest_is_asked_for() {
    let mut client = client();
    hear(&mut client, Time(0), &ServerMessage::ManifestFull(version(1).encode()));
    assert!(matches!(client.poll_event(), Some(ClientEvent::Version(_))));
    hear(&mut client, Time(0), &ServerMessage::ManifestDifference(vec![1, 2, 3]));
    let event = client.poll_event();
    let broken =
        matches!(event, Some(ClientEvent::Disconnect { reason: SessionError::Malformed(_) }));
    assert!(broken, "{event:?}");
    let later = Time(60_000_000);
    assert_eq!(connect(&mut client, later).have, None);
    hear(&mut client, later, &ServerMessage::ManifestFull(version(1).encode()));
    assert_eq!(client.poll_event(), None, "it is held already");
    hear(&mut client, later, &ServerMessage::ManifestFull(version(2).encode()));
    assert!(matches!(client.poll_event(), Some(ClientEvent::Version(_))));
}

#[test]
fn outcomes_of_one_client_are_capped_and_keep_their_shares() {
    let mut server = server_for(None);
    let garment = GarmentId(0);
    let version = VersionNumber(1);
    let mut tell = |second: u64, exact, substituted, missed, outside| {
        let now = Time(second * 1_000_000);
        let edges = vec![(EdgeId(0), 1)];
        let report = Telemetry { garment, version, edges, exact, substituted, missed, jumps: 0 };
        let told = say(&mut server, now, &ClientMessage::Telemetry(report));
        let [ServerEvent::Telemetry { telemetry, .. }] = &told[..] else { panic!("{told:?}") };
        let outside = ClientMessage::Outside { garment, version, steps: outside };
        let ServerEvent::Outside { steps } = say(&mut server, now, &outside)[0] else { panic!() };
        ([telemetry.exact, telemetry.substituted, telemetry.missed], steps)
    };
    assert_eq!(tell(0, 30, 3, 1, 2), ([30, 3, 1], 2), "what players say counts as it is");
    assert_eq!(tell(0, 30, 3, 1, 9), ([30, 3, 1], 3), "no more outside than substituted");
    // All that was saved up, in equal shares; then what a second brings.
    let kept = tell(0, u32::MAX, u32::MAX, 0, u32::MAX).0;
    let left = limits::TRAVERSALS_BURST_MAX - 68;
    assert_eq!(kept, [left / 2, left / 2, 0]);
    let third = limits::TRAVERSALS_PER_SECOND_MAX / 3;
    assert_eq!(tell(1, 1 << 20, 1 << 20, 1 << 20, 0).0, [third; 3]);
}

#[test]
fn a_version_is_put_into_bytes_once_for_all_players() {
    let (old, new) = (version(1), version(2));
    let deliveries = Arc::new(Deliveries::default());
    let deliver = |base: Option<&Arc<SignedManifest>>| {
        let have = base.map(|b| Have { version: b.manifest.number, hash: b.manifest.hash() });
        let mut server = server_for(have).sharing(Arc::clone(&deliveries));
        server.handle_base(base.cloned());
        server.handle_publisher(samples::key().public());
        server.handle_head(&new);
        std::iter::from_fn(|| server.poll_transmit()).last().unwrap()
    };
    let (full, again) = (deliver(None), deliver(None));
    assert!(Arc::ptr_eq(&full, &again));
    let (difference, again) = (deliver(Some(&old)), deliver(Some(&old)));
    assert!(Arc::ptr_eq(&difference, &again) && difference.len() < full.len());
    let expected = ServerMessage::ManifestFull(new.encode());
    assert_eq!(full[..], frame(&expected.encode())[..]);
    assert!(matches!(
        ServerMessage::decode(&difference[4..]),
        Ok(ServerMessage::ManifestDifference(_))
    ));
}
