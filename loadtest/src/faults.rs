//! What a server has to survive: noise, broken messages, and clients that do not belong there.
//!
//! Each function does its worst and says how the server answered. Whether the server still serves
//! others is for the caller to try.

use std::net::{SocketAddr, UdpSocket};
use std::time::Duration;

use anyhow::{Context, anyhow};
use client_lib::driver::quic_config;
use client_lib::{Client, ClientConfig};
use protocol::limits;
use protocol::message::{ClientMessage, CloseCode, Hello, PROTOCOL};
use rand_core::{Rng, SeedableRng};
use rand_pcg::Pcg64Mcg;

/// Largest datagram of noise.
const DATAGRAM_BYTES_MAX: usize = 1400;
/// Datagrams of noise that [`throw_garbage`] throws.
const NOISE_DATAGRAMS: usize = 300;
/// How long a server may take to answer a fault.
const ANSWER_MAX: Duration = Duration::from_secs(15);

/// Throws `count` datagrams of random bytes (of random length, from a seed) at a UDP port. Every
/// third one carries the first byte of a QUIC packet, so that it is read further.
///
/// # Errors
/// The local socket failed.
pub fn throw_noise(address: SocketAddr, count: usize, seed: u64) -> std::io::Result<()> {
    let local: SocketAddr = match address {
        SocketAddr::V4(_) => ([0, 0, 0, 0], 0).into(),
        SocketAddr::V6(_) => ([0u16; 8], 0).into(),
    };
    let socket = UdpSocket::bind(local)?;
    let mut random = Pcg64Mcg::seed_from_u64(seed);
    let mut bytes = [0u8; DATAGRAM_BYTES_MAX];
    for datagram in 0..count {
        random.fill_bytes(&mut bytes);
        if datagram % 3 == 0 {
            bytes[0] |= 0xc0;
            bytes[1..5].copy_from_slice(&1u32.to_be_bytes());
        }
        let length = 1 + random.next_u32() as usize % DATAGRAM_BYTES_MAX;
        match socket.send_to(&bytes[..length], address) {
            // The port may be closed: then there is nobody to disturb.
            Err(error) if error.kind() == std::io::ErrorKind::ConnectionRefused => {}
            sent => {
                sent?;
            }
        }
    }
    Ok(())
}

/// Bytes on the control stream that no client would send.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum BrokenControl {
    /// A message of random bytes.
    Garbage,
    /// A length of 100 and ten bytes; then the stream ends.
    Truncated,
    /// A length of 4 GiB.
    Oversized,
    /// A message one byte over the limit, sent whole.
    OverLimit,
    /// A good message before hello.
    NoHello,
    /// Hello twice.
    TwoHellos,
    /// Hello of a protocol that does not exist.
    OtherProtocol,
}

impl BrokenControl {
    /// All of them.
    pub const ALL: [Self; 7] = [
        Self::Garbage,
        Self::Truncated,
        Self::Oversized,
        Self::OverLimit,
        Self::NoHello,
        Self::TwoHellos,
        Self::OtherProtocol,
    ];

    fn bytes(self, token: Option<&str>) -> Vec<u8> {
        let hello = |protocol| {
            let token = token.map(str::to_owned);
            let hello = Hello { protocol, token, garments: Vec::new(), have: None };
            protocol::frame::frame(&ClientMessage::Hello(hello).encode())
        };
        match self {
            Self::Garbage => protocol::frame::frame(&[0xff; 64]),
            Self::Truncated => [&100u32.to_le_bytes()[..], &[0; 10]].concat(),
            Self::Oversized => u32::MAX.to_le_bytes().to_vec(),
            Self::OverLimit => protocol::frame::frame(&vec![0; limits::MESSAGE_BYTES_MAX + 1]),
            Self::NoHello => protocol::frame::frame(&ClientMessage::Bye.encode()),
            Self::TwoHellos => [hello(PROTOCOL), hello(PROTOCOL)].concat(),
            Self::OtherProtocol => hello(PROTOCOL + 1),
        }
    }
}

/// All faults at once, on one port: noise, then every kind of broken control bytes, each on a
/// connection of its own. Gives the server's answers.
///
/// # Errors
/// As [`throw_noise`] and [`send_broken`].
pub fn throw_garbage(
    address: SocketAddr,
    seed: u64,
) -> anyhow::Result<Vec<(BrokenControl, Answer)>> {
    throw_noise(address, NOISE_DATAGRAMS, seed)?;
    let faults = BrokenControl::ALL.into_iter();
    faults.map(|fault| Ok((fault, send_broken(address, None, fault)?))).collect()
}

/// How a server ended a connection.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Answer {
    /// The code of its close, where it is one of the protocol's.
    pub code: Option<CloseCode>,
    /// The same for people.
    pub text: String,
}

/// Connects like a client, sends one kind of broken bytes, and waits for the server to end it.
///
/// # Errors
/// No connection, or a server that does not react within 15 s.
pub fn send_broken(
    address: SocketAddr,
    token: Option<&str>,
    fault: BrokenControl,
) -> anyhow::Result<Answer> {
    let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build()?;
    runtime.block_on(async {
        let local = if address.is_ipv4() { "0.0.0.0:0" } else { "[::]:0" };
        let endpoint = quinn::Endpoint::client(local.parse()?)?;
        let config = quic_config(None).map_err(|why| anyhow!(why))?;
        let connection = endpoint
            .connect_with(config, address, "toile")?
            .await
            .with_context(|| format!("no connection to {address}"))?;
        let (mut send, _receive) = connection.open_bi().await?;
        // A server may end the connection before it has read everything.
        let _ = send.write_all(&fault.bytes(token)).await;
        let _ = send.finish();
        let closed = tokio::time::timeout(ANSWER_MAX, connection.closed());
        let closed = closed.await.with_context(|| format!("no answer to {fault:?}"))?;
        endpoint.wait_idle().await;
        Ok(match closed {
            quinn::ConnectionError::ApplicationClosed(close) => Answer {
                code: CloseCode::from_number(close.error_code.into_inner()),
                text: String::from_utf8_lossy(&close.reason).into_owned(),
            },
            other => Answer { code: None, text: other.to_string() },
        })
    })
}

/// Connects as a client that must not be let in (wrong token, wrong fingerprint, another
/// publisher) and gives the sentence with which it was refused.
///
/// # Errors
/// It was let in, or nothing final happened within `timeout`.
pub fn refusal(config: ClientConfig, timeout: Duration) -> anyhow::Result<String> {
    let client = Client::connect(config)?;
    let outcome = client.wait_ready(timeout);
    let is_final = client.status().is_final;
    client.close();
    match outcome {
        Ok(()) => Err(anyhow!("the client was let in")),
        Err(error) if is_final => Ok(error.to_string()),
        Err(error) => Err(anyhow!("the client was neither let in nor refused: {error}")),
    }
}

#[cfg(test)]
mod tests {
    use protocol::frame::FrameDecoder;

    use super::*;

    #[test]
    fn noise_arrives_and_is_the_same_for_the_same_seed() {
        let listen = || {
            let socket = UdpSocket::bind("127.0.0.1:0").unwrap();
            socket.set_read_timeout(Some(Duration::from_secs(5))).unwrap();
            throw_noise(socket.local_addr().unwrap(), 3, 7).unwrap();
            let mut bytes = [0; 2000];
            (0..3).map(|_| socket.recv(&mut bytes).map(|n| bytes[..n].to_vec()).unwrap()).collect()
        };
        let (first, second): (Vec<Vec<u8>>, Vec<Vec<u8>>) = (listen(), listen());
        assert_eq!(first, second);
        assert!(first[0].len() > 5 && first[0][0] & 0xc0 == 0xc0, "a long QUIC header");
    }

    #[test]
    fn every_fault_is_one() {
        for fault in BrokenControl::ALL {
            let mut frames = FrameDecoder::new(limits::MESSAGE_BYTES_MAX);
            frames.push(&fault.bytes(Some("token")));
            let first = frames.poll();
            match fault {
                BrokenControl::Oversized | BrokenControl::OverLimit => assert!(first.is_err()),
                BrokenControl::Truncated => assert_eq!(first, Ok(None)),
                BrokenControl::Garbage => {
                    assert!(ClientMessage::decode(&first.unwrap().unwrap()).is_err());
                }
                BrokenControl::NoHello | BrokenControl::OtherProtocol => {
                    let message = ClientMessage::decode(&first.unwrap().unwrap()).unwrap();
                    let greets =
                        matches!(message, ClientMessage::Hello(h) if h.protocol == PROTOCOL);
                    assert!(!greets);
                }
                BrokenControl::TwoHellos => assert_eq!(first, frames.poll()),
            }
        }
    }
}
