//! First cloth over a narrow line: how much has to come before anything can be drawn, and what it shows.

use std::net::{SocketAddr, UdpSocket};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::thread::JoinHandle;
use std::time::{Duration, Instant};

use client_lib::{Client, ClientConfig, StepOutcome, decode};

use crate::run::{Serving, shared_store};

/// Most basis that may come before cloth is drawn (bytes).
const BASIS_BYTES_MAX: u64 = 200_000;
/// The line to the player (bits/s).
const LINE_BITS_S: f64 = 4e6;

/// Carries datagrams between one player and the server, those to the player at the line's rate.
struct Line {
    address: SocketAddr,
    /// Bytes that went to the player.
    carried: Arc<AtomicU64>,
    stop: Arc<AtomicBool>,
    threads: Vec<JoinHandle<()>>,
}

impl Line {
    fn to(server: SocketAddr) -> Self {
        let near = UdpSocket::bind("127.0.0.1:0").unwrap();
        let far = UdpSocket::bind("127.0.0.1:0").unwrap();
        far.connect(server).unwrap();
        let address = near.local_addr().unwrap();
        let (carried, stop) = (Arc::new(AtomicU64::new(0)), Arc::new(AtomicBool::new(false)));
        for socket in [&near, &far] {
            socket.set_read_timeout(Some(Duration::from_millis(50))).unwrap();
        }
        let (near_in, far_out) = (near.try_clone().unwrap(), far.try_clone().unwrap());
        let player = Arc::new(std::sync::Mutex::new(None));
        let (to, ended) = (Arc::clone(&player), Arc::clone(&stop));
        let up = std::thread::spawn(move || {
            let mut bytes = [0; 2048];
            while !ended.load(Ordering::Relaxed) {
                let Ok((length, from)) = near_in.recv_from(&mut bytes) else { continue };
                *to.lock().unwrap() = Some(from);
                let _ = far_out.send(&bytes[..length]);
            }
        });
        let (count, ended) = (Arc::clone(&carried), Arc::clone(&stop));
        let down = std::thread::spawn(move || {
            let mut bytes = [0; 2048];
            let mut free_at = Instant::now();
            while !ended.load(Ordering::Relaxed) {
                let Ok(length) = far.recv(&mut bytes) else { continue };
                // What comes faster than the line waits in the socket, and is lost where that is full.
                let takes = Duration::from_secs_f64(length as f64 * 8.0 / LINE_BITS_S);
                free_at = free_at.max(Instant::now()) + takes;
                std::thread::sleep(free_at.saturating_duration_since(Instant::now()));
                let Some(player) = *player.lock().unwrap() else { continue };
                count.fetch_add(length as u64, Ordering::Relaxed);
                let _ = near.send_to(&bytes[..length], player);
            }
        });
        Self { address, carried, stop, threads: vec![up, down] }
    }

    fn carried(&self) -> u64 {
        self.carried.load(Ordering::Relaxed)
    }
}

impl Drop for Line {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Relaxed);
        for thread in self.threads.drain(..) {
            let _ = thread.join();
        }
    }
}

#[test]
fn cloth_is_drawn_after_200_kb_of_basis_with_its_error_stated() {
    let serving = Serving::start(shared_store(), &[]);
    let line = Line::to(serving.address.parse().unwrap());
    let start = Instant::now();
    let client = Client::connect(ClientConfig {
        fingerprint: Some(serving.fingerprint.clone()),
        ..ClientConfig::new(line.address.to_string())
    })
    .unwrap();
    assert!(client.wait_first_cloth(Duration::from_secs(60)), "{:?}", client.status().error);
    let (after, carried) = (start.elapsed(), line.carried());
    let mut character = client.character(None).unwrap();
    assert!(character.version().columns_to_come() > 0, "the basis is not whole yet");
    let scene = Arc::clone(character.version().scene());
    let edge = scene.out_edges(character.pose()).next().expect("every pose has a way out");
    let next = scene.edges()[edge.index()].to;
    let outcome = character.step(next);
    let StepOutcome::Substituted { error_m } = outcome else { panic!("{outcome:?}") };
    let mut positions = vec![0.0; character.version().basis().rows()];
    decode(&[&character], 0..positions.len(), usize::MAX, &mut positions).unwrap();
    let first = positions.clone();
    let stated = client.status().first_cloth.expect("it came before the basis was whole");
    assert!(stated.basis_bytes <= BASIS_BYTES_MAX, "{stated:?}");
    assert!(stated.columns < stated.all_columns, "{stated:?}");
    assert!(error_m > 0.0 && error_m <= stated.error_m, "{error_m} of {stated:?}");
    // The whole basis: the same state is as far away as was stated, and no further.
    client.wait_ready(Duration::from_secs(60)).unwrap();
    let whole_after = start.elapsed();
    let state = character.state();
    character.refresh();
    assert_eq!(character.version().columns_to_come(), 0);
    character.place(state);
    decode(&[&character], 0..positions.len(), usize::MAX, &mut positions).unwrap();
    let apart = |(a, b): (&[f32], &[f32])| {
        a.iter().zip(b).map(|(a, b)| (a - b).powi(2)).sum::<f32>().sqrt()
    };
    let worst_m = first.chunks(3).zip(positions.chunks(3)).map(apart).fold(0.0, f32::max);
    eprintln!(
        "first cloth after {} kB of basis ({} kB carried, {:.2} s at {:.0} Mbit/s); stated {:.1} mm, \
         found {:.1} mm; the whole basis after {:.2} s",
        stated.basis_bytes / 1000,
        carried / 1000,
        after.as_secs_f64(),
        LINE_BITS_S / 1e6,
        error_m * 1e3,
        worst_m * 1e3,
        whole_after.as_secs_f64()
    );
    assert!(worst_m > 1e-3 && worst_m <= error_m + 1e-3, "{worst_m} of {error_m}");
}
