//! A UDP socket that counts datagrams which cannot be QUIC. quinn drops them without a word.

use std::io::{self, IoSliceMut};
use std::net::SocketAddr;
use std::pin::Pin;
use std::sync::Arc;
use std::task::{Context, Poll};

use prometheus_client::metrics::counter::Counter;
use quinn::udp::{RecvMeta, Transmit};
use quinn::{AsyncUdpSocket, UdpPoller};

/// Passes everything on, and counts.
#[derive(Debug)]
pub(crate) struct CountingSocket {
    pub inner: Arc<dyn AsyncUdpSocket>,
    pub stray: Counter,
}

impl AsyncUdpSocket for CountingSocket {
    fn create_io_poller(self: Arc<Self>) -> Pin<Box<dyn UdpPoller>> {
        self.inner.clone().create_io_poller()
    }

    fn try_send(&self, transmit: &Transmit<'_>) -> io::Result<()> {
        self.inner.try_send(transmit)
    }

    fn poll_recv(
        &self,
        cx: &mut Context<'_>,
        bufs: &mut [IoSliceMut<'_>],
        meta: &mut [RecvMeta],
    ) -> Poll<io::Result<usize>> {
        let received = self.inner.poll_recv(cx, bufs, meta);
        if let Poll::Ready(Ok(count)) = &received {
            for (buffer, meta) in bufs.iter().zip(meta.iter()).take(*count) {
                let datagrams = buffer[..meta.len].chunks(meta.stride.max(1));
                let strays = datagrams.filter(|datagram| is_stray(datagram)).count();
                self.stray.inc_by(strays as u64);
            }
        }
        received
    }

    fn local_addr(&self) -> io::Result<SocketAddr> {
        self.inner.local_addr()
    }

    fn max_transmit_segments(&self) -> usize {
        self.inner.max_transmit_segments()
    }

    fn max_receive_segments(&self) -> usize {
        self.inner.max_receive_segments()
    }

    fn may_fragment(&self) -> bool {
        self.inner.may_fragment()
    }
}

/// Shorter than any QUIC packet, the fixed bit unset, or a long header of an unknown version
/// (RFC 9000, section 17).
fn is_stray(datagram: &[u8]) -> bool {
    const SHORTEST: usize = 21;
    let Some((&first, rest)) = datagram.split_first() else { return true };
    let (is_long, is_fixed) = (first & 0x80 != 0, first & 0x40 != 0);
    datagram.len() < SHORTEST || !is_fixed || is_long && rest[..4] != [0, 0, 0, 1]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn garbage_is_told_from_quic() {
        let with_head = |head: &[u8]| [head, &[0; 40]].concat();
        assert!(is_stray(b""));
        assert!(is_stray(&[0x40; 20]));
        assert!(is_stray(&with_head(&[0x16, 3, 1])));
        assert!(is_stray(&with_head(&[0xc0, 9, 9, 9, 9])));
        assert!(!is_stray(&with_head(&[0xc0, 0, 0, 0, 1])));
        assert!(!is_stray(&with_head(&[0x40])));
    }
}
