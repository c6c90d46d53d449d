//! Both session machines, joined by a simulated link in virtual time.

use std::collections::{BTreeMap, VecDeque};
use std::sync::Arc;

use protocol::frame::{chunk_head, frame};
use protocol::manifest::ChunkRef;
use protocol::message::{
    ClientMessage, CloseCode, Hello, PROTOCOL, Priority, ServerMessage, TagOutcome, Telemetry,
};
use protocol::session::{
    Client, ClientConfig, ClientEvent, Server, ServerConfig, ServerEvent, SessionError, Time,
};
use protocol::{
    ChunkHash, EdgeId, GarmentId, SignedManifest, SigningKey, StateId, VersionNumber, limits,
};

use crate::link::{Faults, Link, Random, To};
use crate::samples;

/// A client, a server with a store, and the line between them.
struct Pair {
    now: Time,
    client: Client,
    server: Option<Server>,
    server_config: ServerConfig,
    link: Link,
    chunks: BTreeMap<ChunkHash, Vec<u8>>,
    versions: Vec<Arc<SignedManifest>>,
    streams: u64,
    connections: u32,
    arrived: BTreeMap<ChunkHash, Vec<u8>>,
    order: Vec<ChunkHash>,
    client_events: VecDeque<ClientEvent>,
    server_events: Vec<ServerEvent>,
    bytes_to_client: usize,
    spoil: Option<ChunkHash>,
}

const QUIET: Faults =
    Faults { delay_us: 10_000, jitter_us: 0, loss_percent: 0, bytes_per_second: 100_000_000 };

impl Pair {
    fn new(faults: Faults, seed: u64) -> Self {
        let config = ClientConfig {
            token: Some("letmein".into()),
            publisher: Some(samples::key().public()),
            jitter_seed: seed,
            ..ClientConfig::default()
        };
        Self {
            now: Time(0),
            client: Client::new(config),
            server: None,
            server_config: ServerConfig { token: Some("letmein".into()), tag_token: None },
            link: Link::new(faults, seed),
            chunks: BTreeMap::new(),
            versions: Vec::new(),
            streams: 0,
            connections: 0,
            arrived: BTreeMap::new(),
            order: Vec::new(),
            client_events: VecDeque::new(),
            server_events: Vec::new(),
            bytes_to_client: 0,
            spoil: None,
        }
    }

    /// Publishes the next version, with `regions` region chunks and four link pages.
    fn publish(&mut self, regions: u64) {
        let number = self.versions.len() as u64 + 1;
        let mut manifest = samples::manifest(number, regions, 4, number);
        let garment = &mut manifest.garments[0];
        for (index, region) in garment.regions.iter_mut().enumerate() {
            let bytes = vec![index as u8; 500 + index * 37 % 4000];
            region.chunk = ChunkRef { hash: ChunkHash::of(&bytes), bytes: bytes.len() as u32 };
            self.chunks.insert(region.chunk.hash, bytes);
        }
        let head = Arc::new(manifest.sign(&samples::key()));
        self.versions.push(head.clone());
        if let Some(server) = &mut self.server {
            server.handle_head(&head);
        }
        self.settle();
    }

    fn cut(&mut self) {
        self.link.cut();
        self.server = None;
        self.client.handle_disconnected(self.now, None, "the line was cut");
        self.settle();
    }

    /// Runs until `until`, or for ever while something happens.
    fn run(&mut self, until: Time) {
        self.settle();
        loop {
            let timeouts = [
                self.link.next_arrival(),
                self.client.poll_timeout(),
                self.server.as_ref().and_then(Server::poll_timeout),
            ];
            let Some(next) = timeouts.into_iter().flatten().min().filter(|t| *t <= until) else {
                break;
            };
            self.now = self.now.max(next);
            while let Some(packet) = self.link.receive(self.now) {
                match (packet.to, &mut self.server) {
                    (To::Server, Some(server)) => server.handle_control(self.now, &packet.bytes),
                    (To::Client(0), _) => self.client.handle_control(self.now, &packet.bytes),
                    (To::Client(stream), _) => {
                        self.client.handle_chunk(self.now, stream, &packet.bytes, packet.end);
                    }
                    (To::Server, None) => {}
                }
                self.settle();
            }
            self.client.handle_timeout(self.now);
            if let Some(server) = &mut self.server {
                server.handle_timeout(self.now);
            }
            self.settle();
        }
        self.now = self.now.max(until);
    }

    fn settle(&mut self) {
        while let Some(bytes) = self.client.poll_transmit(self.now) {
            self.link.send(self.now, To::Server, &bytes, false);
        }
        while let Some(event) = self.client.poll_event() {
            self.act(event);
        }
        self.settle_server();
    }

    fn act(&mut self, event: ClientEvent) {
        match &event {
            ClientEvent::Connect => {
                self.link.cut();
                self.connections += 1;
                self.server = Some(Server::new(self.server_config.clone(), self.now));
                self.client.handle_connected(self.now);
                return self.settle();
            }
            ClientEvent::Version(signed) => {
                for region in &signed.manifest.garments[0].regions {
                    if !self.arrived.contains_key(&region.chunk.hash) {
                        let initial = region.initial;
                        let priority = if initial { Priority::Scene } else { Priority::Soon };
                        assert!(self.client.want(region.chunk, priority));
                    }
                }
                self.client.applied(signed.manifest.number);
                self.client_events.push_back(event);
                return self.settle();
            }
            ClientEvent::Chunk { hash, bytes } => {
                assert_eq!(ChunkHash::of(bytes), *hash);
                self.order.push(*hash);
                assert_eq!(self.arrived.insert(*hash, bytes.clone()), None, "arrived twice");
                return self.settle();
            }
            // Bye is still under way.
            ClientEvent::Disconnect { reason: SessionError::Done } => {}
            ClientEvent::Disconnect { .. } => self.server = None,
            ClientEvent::Welcome | ClientEvent::Missing { .. } | ClientEvent::Tagged { .. } => {}
        }
        self.client_events.push_back(event);
    }

    fn settle_server(&mut self) {
        let Some(server) = &mut self.server else { return };
        while let Some(event) = server.poll_event() {
            match &event {
                ServerEvent::Open { .. } => {
                    if let Some(head) = self.versions.last() {
                        server.handle_publisher(samples::key().public());
                        server.handle_head(head);
                    }
                }
                ServerEvent::Base(number) => {
                    let base = self.versions.get(number.0 as usize - 1).cloned();
                    server.handle_base(base);
                }
                ServerEvent::Send { hash, .. } => match self.chunks.get(hash) {
                    None => server.handle_missing(hash),
                    Some(bytes) => {
                        self.streams += 1;
                        let head = chunk_head(hash, bytes.len() as u32);
                        let mut stream = [&head[..], bytes].concat();
                        if self.spoil == Some(*hash) {
                            self.spoil = None;
                            *stream.last_mut().unwrap() ^= 1;
                        }
                        self.bytes_to_client += stream.len();
                        self.link.send(self.now, To::Client(self.streams), &stream, true);
                        server.handle_sent(hash);
                    }
                },
                ServerEvent::Applied(_)
                | ServerEvent::Pin(_)
                | ServerEvent::Tag { .. }
                | ServerEvent::Cancel { .. }
                | ServerEvent::Telemetry { .. }
                | ServerEvent::Outside { .. }
                | ServerEvent::Closed { .. } => {}
            }
            self.server_events.push(event);
        }
        if !self.versions.is_empty() {
            server.handle_publisher(samples::key().public());
        }
        while let Some(bytes) = server.poll_transmit() {
            self.bytes_to_client += bytes.len();
            self.link.send(self.now, To::Client(0), &bytes, false);
        }
    }

    fn reason(&self) -> Option<&SessionError> {
        self.client_events.iter().find_map(|event| match event {
            ClientEvent::Disconnect { reason } => Some(reason),
            _ => None,
        })
    }

    fn assert_complete(&self, seed: u64) {
        let head = self.versions.last().expect("published");
        assert_eq!(self.client.manifest(), Some(head), "seed {seed}");
        assert_eq!(self.client.wanted(), 0, "seed {seed}");
        for region in &head.manifest.garments[0].regions {
            assert!(self.arrived.contains_key(&region.chunk.hash), "seed {seed}");
        }
    }
}

/// Whatever the line does, in the end the client has the newest version and all of its chunks.
#[test]
fn a_bad_line_only_costs_time() {
    let mut overtaken = 0;
    for seed in 0..200 {
        let mut random = Random(seed * 77 + 5);
        let faults = Faults {
            delay_us: 1000 + random.below(150_000),
            jitter_us: random.below(80_000),
            loss_percent: random.below(20),
            bytes_per_second: 20_000 + random.below(5_000_000),
        };
        let mut pair = Pair::new(faults, seed);
        pair.publish(20 + random.below(40));
        for _ in 0..random.below(5) {
            pair.run(pair.now.after_us(random.below(2_000_000)));
            match random.below(2) {
                0 => pair.cut(),
                _ => pair.publish(60 + random.below(60)),
            }
        }
        pair.run(pair.now.after_us(200_000_000));
        pair.assert_complete(seed);
        let numbers: Vec<_> = pair.client_events.iter().filter_map(version).collect();
        assert!(numbers.is_sorted_by(|a, b| a < b), "seed {seed}: {numbers:?}");
        let regions = &pair.versions.last().unwrap().manifest.garments[0].regions;
        let place = |hash: &ChunkHash| regions.iter().position(|region| region.chunk.hash == *hash);
        overtaken += usize::from(!pair.order.iter().map(place).is_sorted());
    }
    assert!(overtaken > 100, "chunks should arrive out of order");
}

fn version(event: &ClientEvent) -> Option<VersionNumber> {
    match event {
        ClientEvent::Version(signed) => Some(signed.manifest.number),
        _ => None,
    }
}

#[test]
fn an_empty_store_is_waited_for() {
    let mut pair = Pair::new(QUIET, 1);
    pair.run(Time(60_000_000));
    assert!(pair.client.is_open());
    assert_eq!(pair.client.manifest(), None);
    pair.publish(3);
    pair.run(Time(61_000_000));
    pair.assert_complete(1);
    assert_eq!(pair.connections, 1);
}

#[test]
fn a_new_version_is_pushed_as_a_difference_even_after_a_reconnect() {
    let mut pair = Pair::new(QUIET, 1);
    pair.publish(1000);
    pair.run(Time(5_000_000));
    pair.assert_complete(1);
    let before = pair.bytes_to_client;
    pair.publish(1001);
    pair.run(Time(6_000_000));
    pair.assert_complete(1);
    pair.cut();
    pair.publish(1002);
    pair.run(Time(9_000_000));
    pair.assert_complete(1);
    assert_eq!(pair.connections, 2);
    let cost = pair.bytes_to_client - before;
    assert!(cost < 10_000, "{cost} bytes for two versions of one new chunk each");
    assert!(pair.server_events.contains(&ServerEvent::Applied(VersionNumber(3))));
}

#[test]
fn a_wrong_token_is_final() {
    let mut pair = Pair::new(QUIET, 1);
    pair.server_config.token = Some("another".into());
    pair.publish(1);
    pair.run(Time(60_000_000));
    assert_eq!(pair.connections, 1);
    let reason = pair.reason().unwrap();
    assert!(reason.is_final());
    assert!(matches!(reason, SessionError::Closed { code: CloseCode::TokenRefused, .. }));
}

#[test]
fn a_stranger_who_publishes_is_refused() {
    let mut pair = Pair::new(QUIET, 1);
    pair.client = Client::new(ClientConfig {
        token: Some("letmein".into()),
        publisher: Some(SigningKey::from_seed(&[1; 32]).public()),
        ..ClientConfig::default()
    });
    pair.publish(1);
    pair.run(Time(60_000_000));
    assert_eq!(pair.connections, 1);
    assert!(matches!(pair.reason(), Some(SessionError::WrongPublisher { .. })));
}

#[test]
fn a_forged_manifest_is_refused() {
    let mut pair = Pair::new(QUIET, 1);
    let forged = samples::manifest(1, 1, 1, 0).sign(&SigningKey::from_seed(&[1; 32]));
    pair.versions.push(Arc::new(forged));
    pair.run(Time(60_000_000));
    assert_eq!(pair.connections, 1);
    assert!(matches!(pair.reason(), Some(SessionError::Manifest(_))));
    assert_eq!(pair.client.manifest(), None);
}

#[test]
fn a_damaged_chunk_is_never_handed_out_and_asked_for_again() {
    let mut pair = Pair::new(QUIET, 1);
    pair.publish(30);
    let victim = pair.versions[0].manifest.garments[0].regions[7].chunk.hash;
    pair.spoil = Some(victim);
    pair.run(Time(10_000_000));
    pair.assert_complete(1);
    assert_eq!(pair.connections, 2);
    let expected = SessionError::DamagedChunk { hash: victim, why: "its bytes have another hash" };
    assert_eq!(pair.reason(), Some(&expected));
}

#[test]
fn a_missing_chunk_is_said_to_be_missing() {
    let mut pair = Pair::new(QUIET, 1);
    pair.publish(3);
    let hash = pair.versions[0].manifest.garments[0].regions[1].chunk.hash;
    pair.chunks.remove(&hash);
    pair.run(Time(10_000_000));
    assert!(pair.client_events.contains(&ClientEvent::Missing { hash }));
    assert_eq!((pair.arrived.len(), pair.client.wanted()), (2, 0));
}

#[test]
fn what_is_urgent_overtakes_what_is_not() {
    let slow = Faults { bytes_per_second: 100_000, ..QUIET };
    let mut pair = Pair::new(slow, 1);
    pair.publish(1);
    pair.run(Time(1_000_000));
    let mut wanted = Vec::new();
    for index in 0..100u32 {
        let bytes = [&index.to_le_bytes()[..], &[0; 2000]].concat();
        let chunk = ChunkRef { hash: ChunkHash::of(&bytes), bytes: bytes.len() as u32 };
        pair.chunks.insert(chunk.hash, bytes);
        assert!(pair.client.want(chunk, Priority::Background));
        wanted.push(chunk);
    }
    assert!(pair.client.want(wanted[99], Priority::Urgent));
    pair.client.cancel(wanted[98].hash);
    pair.run(Time(20_000_000));
    let place = pair.order.iter().position(|hash| *hash == wanted[99].hash);
    assert_eq!(place, Some(1), "right after the first version's only region");
    assert_eq!(pair.arrived.len(), 1 + 99);
}

#[test]
fn bye_ends_it_after_the_reports() {
    let mut pair = Pair::new(QUIET, 1);
    pair.publish(1);
    pair.run(Time(1_000_000));
    let edges = (0..10_000).map(|edge| (EdgeId(edge), 1)).collect();
    pair.client.report(Telemetry {
        garment: GarmentId(0),
        version: VersionNumber(1),
        edges,
        exact: 10_000,
        substituted: 2,
        missed: 0,
        jumps: 1,
    });
    pair.client.report_outside(GarmentId(0), VersionNumber(1), 0);
    pair.client.report_outside(GarmentId(0), VersionNumber(1), 2);
    pair.client.close();
    pair.run(Time(2_000_000));
    assert_eq!(pair.reason(), Some(&SessionError::Done));
    assert_eq!(pair.client.poll_timeout(), None);
    let outside = pair.server_events.iter().filter_map(|event| match event {
        ServerEvent::Outside { steps } => Some(*steps),
        _ => None,
    });
    assert_eq!(outside.collect::<Vec<_>>(), [2]);
    let reports = pair.server_events.iter().filter_map(|event| match event {
        ServerEvent::Telemetry { telemetry, dropped: 0 } => Some(telemetry),
        _ => None,
    });
    let (edges, exact): (Vec<_>, Vec<_>) = reports.map(|t| (t.edges.len(), t.exact)).unzip();
    assert_eq!(edges.iter().sum::<usize>(), 10_000);
    assert_eq!(exact.iter().sum::<u32>(), 10_000);
    let last = pair.server_events.last().unwrap();
    assert!(matches!(last, ServerEvent::Closed { code: CloseCode::Done, .. }));
}

fn server() -> Server {
    let mut server = Server::new(ServerConfig::default(), Time(0));
    let hello = Hello { protocol: PROTOCOL, token: None, garments: Vec::new(), have: None };
    server.handle_control(Time(0), &frame(&ClientMessage::Hello(hello).encode()));
    while server.poll_transmit().is_some() || server.poll_event().is_some() {}
    server
}

fn closed_with(server: &mut Server) -> Option<CloseCode> {
    std::iter::from_fn(|| server.poll_event()).find_map(|event| match event {
        ServerEvent::Closed { code, .. } => Some(code),
        _ => None,
    })
}

#[test]
fn one_client_cannot_outweigh_the_others() {
    let mut server = server();
    let telemetry = |count| Telemetry {
        garment: GarmentId(0),
        version: VersionNumber(1),
        edges: vec![(EdgeId(5), count), (EdgeId(6), count)],
        exact: 1,
        substituted: 0,
        missed: 0,
        jumps: 0,
    };
    let mut counted = 0u64;
    for second in 1..=100u64 {
        let message = ClientMessage::Telemetry(telemetry(u32::MAX));
        server.handle_control(Time(second * 1_000_000), &frame(&message.encode()));
        while let Some(event) = server.poll_event() {
            let ServerEvent::Telemetry { telemetry, dropped } = event else { panic!("{event:?}") };
            let kept: u64 = telemetry.edges.iter().map(|(_, count)| u64::from(*count)).sum();
            assert_eq!(kept + dropped, 2 * u64::from(u32::MAX));
            counted += kept;
        }
    }
    let cap = limits::TRAVERSALS_BURST_MAX + 99 * limits::TRAVERSALS_PER_SECOND_MAX;
    assert_eq!(counted, u64::from(cap));
}

#[test]
fn a_rude_client_is_told_why() {
    let fetch = |index: u32| {
        let hash = ChunkHash::of(&index.to_le_bytes());
        frame(&ClientMessage::Fetch { hash, priority: Priority::Soon }.encode())
    };
    let mut greedy = server();
    (0..300).for_each(|index| greedy.handle_control(Time(0), &fetch(index)));
    assert_eq!(closed_with(&mut greedy), Some(CloseCode::TooManyFetches));

    let mut deaf = server();
    for index in 0..300 {
        deaf.handle_control(Time(0), &fetch(index));
        deaf.handle_missing(&ChunkHash::of(&index.to_le_bytes()));
    }
    assert_eq!(closed_with(&mut deaf), Some(CloseCode::TooManyFetches));

    let mut noisy = server();
    (0..5000).for_each(|_| noisy.handle_control(Time(0), &fetch(0)));
    assert_eq!(closed_with(&mut noisy), Some(CloseCode::TooManyMessages));

    let mut long = server();
    long.handle_control(Time(0), &(limits::MESSAGE_BYTES_MAX as u32 + 1).to_le_bytes());
    assert_eq!(closed_with(&mut long), Some(CloseCode::TooLong));

    let mut garbage = server();
    garbage.handle_control(Time(0), &frame(&[99, 1, 2]));
    assert_eq!(closed_with(&mut garbage), Some(CloseCode::Malformed));

    let mut silent = Server::new(ServerConfig::default(), Time(0));
    silent.handle_timeout(silent.poll_timeout().unwrap());
    assert_eq!(closed_with(&mut silent), Some(CloseCode::HandshakeTimeout));

    let mut rash = Server::new(ServerConfig::default(), Time(0));
    rash.handle_control(Time(0), &fetch(1));
    assert_eq!(closed_with(&mut rash), Some(CloseCode::Malformed));
}

/// Random bytes, whole frames and half ones: a machine closes, it never panics.
#[test]
fn garbage_never_panics() {
    for seed in 0..500 {
        let mut random = Random(seed);
        let mut server = server();
        let mut client = Client::new(ClientConfig::default());
        client.handle_timeout(Time(0));
        client.handle_connected(Time(0));
        let _ = client.poll_transmit(Time(0));
        let welcome = ServerMessage::Welcome { protocol: PROTOCOL, publisher: None };
        client.handle_control(Time(0), &frame(&welcome.encode()));
        for _ in 0..20 {
            let length = random.below(60) as usize;
            let mut bytes: Vec<u8> = (0..length).map(|_| random.below(256) as u8).collect();
            if let Some(kind) = bytes.first_mut() {
                *kind %= 7;
            }
            let bytes = if random.below(3) > 0 { frame(&bytes) } else { bytes };
            server.handle_control(Time(0), &bytes);
            client.handle_control(Time(0), &bytes);
            client.handle_chunk(Time(0), random.below(3), &bytes, random.below(2) == 0);
            while server.poll_transmit().is_some() || server.poll_event().is_some() {}
            while client.poll_transmit(Time(0)).is_some() || client.poll_event().is_some() {}
        }
    }
}

/// The first bytes of every message, as other implementers read them in `docs/protocol.md`.
#[test]
fn golden_messages() {
    let hex = |bytes: &[u8]| bytes.iter().map(|b| format!("{b:02x}")).collect::<String>();
    let hello = Hello {
        protocol: PROTOCOL,
        token: Some("t".into()),
        garments: vec!["robe".into()],
        have: None,
    };
    let frame_bytes = frame(&ClientMessage::Hello(hello).encode());
    assert_eq!(hex(&frame_bytes), "0c000000000101017401".to_string() + "04726f626500");
    assert_eq!(hex(&ClientMessage::Applied { version: VersionNumber(300) }.encode()), "03ac02");
    assert_eq!(hex(&ClientMessage::Bye.encode()), "05");
    assert_eq!(hex(&ClientMessage::Pin { version: VersionNumber(300) }.encode()), "06ac02");
    let (garment, state) = (GarmentId(1), StateId(300));
    assert_eq!(hex(&ClientMessage::Tag { garment, state }.encode()), "0701ac02");
    let outcome = TagOutcome::Kept { number: 9 };
    assert_eq!(hex(&ServerMessage::Tagged { garment, state, outcome }.encode()), "0601ac020009");
    let welcome = ServerMessage::Welcome { protocol: PROTOCOL, publisher: None };
    assert_eq!(hex(&welcome.encode()), "000100");
    let close = ServerMessage::Close { code: CloseCode::Full, message: "later".into() };
    assert_eq!(hex(&close.encode()), "0509056c61746572");
    for (number, code) in CloseCode::ALL.into_iter().enumerate() {
        assert_eq!(CloseCode::from_number(number as u64), Some(code));
        assert_eq!(code.number() as usize, number);
    }
}
