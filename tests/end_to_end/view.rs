//! The page of `toile view`, spoken to as a browser does.

use std::io::{BufRead, BufReader, Read, Write};
use std::net::TcpStream;
use std::process::{Child, Stdio};
use std::time::{Duration, Instant};

use serde_json::{Value, json};

use crate::run::{command, path, shared_store};

const TEXT: u8 = 1;
const BINARY: u8 = 2;
const FRAME: u32 = 2;

/// `toile view` on a free port; killed when dropped.
struct Viewing {
    child: Child,
    host: String,
}

impl Viewing {
    fn start(arguments: &[&str]) -> Self {
        let mut child = command(&[&["view"], arguments].concat())
            .stdout(Stdio::piped())
            .spawn()
            .expect("toile starts");
        let mut line = String::new();
        let stdout = child.stdout.as_mut().expect("piped");
        BufReader::new(stdout).read_line(&mut line).expect("it says where the page is");
        let host = line.trim().trim_start_matches("http://").trim_end_matches('/').to_owned();
        assert!(host.starts_with("127.0.0.1:"), "{line}");
        Self { child, host }
    }

    fn get(&self, path: &str, more: &str) -> String {
        let mut stream = connect(&self.host);
        let host = &self.host;
        write!(stream, "GET {path} HTTP/1.1\r\nHost: {host}\r\nConnection: close\r\n{more}\r\n")
            .unwrap();
        let mut said = String::new();
        stream.read_to_string(&mut said).expect("an answer in text");
        said
    }

    fn page(&self) -> Page {
        Page::open(&self.host, &format!("http://{}", self.host)).expect("our own page may watch")
    }
}

impl Drop for Viewing {
    fn drop(&mut self) {
        self.child.kill().expect("it runs still");
        let _ = self.child.wait();
    }
}

fn connect(host: &str) -> TcpStream {
    let stream = TcpStream::connect(host).expect("the page answers");
    stream.set_read_timeout(Some(Duration::from_secs(20))).unwrap();
    stream
}

/// A WebSocket, as little of it as is needed.
struct Page {
    stream: TcpStream,
}

impl Page {
    /// The status line instead, where it is refused.
    fn open(host: &str, origin: &str) -> Result<Self, String> {
        let mut stream = connect(host);
        write!(
            stream,
            "GET /live HTTP/1.1\r\nHost: {host}\r\nOrigin: {origin}\r\nConnection: Upgrade\r\n\
             Upgrade: websocket\r\nSec-WebSocket-Version: 13\r\n\
             Sec-WebSocket-Key: dGhlIHNhbXBsZSBub25jZQ==\r\n\r\n"
        )
        .unwrap();
        let mut head = Vec::new();
        while !head.ends_with(b"\r\n\r\n") {
            let mut byte = [0];
            stream.read_exact(&mut byte).map_err(|e| e.to_string())?;
            head.extend(byte);
        }
        let head = String::from_utf8(head).unwrap();
        let status = head.lines().next().unwrap().to_owned();
        if status.contains(" 101 ") { Ok(Self { stream }) } else { Err(status) }
    }

    fn send(&mut self, text: &str) {
        assert!(text.len() < 126, "short messages only");
        let mut frame = vec![0x80 | TEXT, 0x80 | text.len() as u8, 0, 0, 0, 0];
        frame.extend(text.bytes());
        self.stream.write_all(&frame).expect("the line is up");
    }

    fn receive(&mut self) -> (u8, Vec<u8>) {
        let mut head = [0; 2];
        self.stream.read_exact(&mut head).expect("an answer");
        let length = match head[1] {
            126 => {
                let mut bytes = [0; 2];
                self.stream.read_exact(&mut bytes).unwrap();
                usize::from(u16::from_be_bytes(bytes))
            }
            127 => {
                let mut bytes = [0; 8];
                self.stream.read_exact(&mut bytes).unwrap();
                u64::from_be_bytes(bytes) as usize
            }
            short => usize::from(short),
        };
        let mut payload = vec![0; length];
        self.stream.read_exact(&mut payload).unwrap();
        (head[0] & 0xf, payload)
    }

    /// The next text that says `what`, frames being asked for meanwhile.
    fn wait_for(&mut self, what: &str) -> Value {
        let start = Instant::now();
        self.send("f");
        while start.elapsed() < Duration::from_secs(30) {
            let (kind, payload) = self.receive();
            let kind_of = |payload: &[u8]| u32::from_le_bytes(payload[..4].try_into().unwrap());
            if kind == TEXT {
                let said: Value = serde_json::from_slice(&payload).expect("JSON");
                if said["say"] == what {
                    return said;
                }
                if said["say"] == "waiting" {
                    std::thread::sleep(Duration::from_millis(20));
                    self.send("f");
                }
            } else if kind == BINARY && kind_of(&payload) == FRAME {
                self.send("f");
            }
        }
        panic!("nothing was said of {what}");
    }
}

#[test]
fn the_page_is_embedded_and_asks_nothing_of_elsewhere() {
    let viewing = Viewing::start(&[path(shared_store())]);
    let page = viewing.get("/", "");
    assert!(page.starts_with("HTTP/1.1 200") && page.contains("toile.js"), "{page}");
    assert!(page.contains("default-src 'none'"), "{page}");
    for part in ["/toile.js", "/style.css"] {
        let said = viewing.get(part, "");
        assert!(said.starts_with("HTTP/1.1 200"), "{said}");
        let addresses = said.matches("://").count() - said.matches("ws://${").count();
        assert_eq!(addresses, 0, "{part} names an address");
    }
    let evil = viewing.get("/", "Origin: http://evil.example\r\n");
    assert!(evil.starts_with("HTTP/1.1 403"), "{evil}");
    let refused = Page::open(&viewing.host, "http://evil.example").err().expect("refused");
    assert!(refused.contains("403"), "{refused}");
}

#[test]
fn a_page_is_streamed_a_character_and_steers_it() {
    let viewing = Viewing::start(&[path(shared_store())]);
    let mut page = viewing.page();
    let version = page.wait_for("version");
    assert_eq!(version["vertices"], 3088);
    assert!(version["worst"].as_array().unwrap().len() > 5);
    let clips = version["clips"].as_array().unwrap();
    let run = clips.iter().position(|clip| clip == "run").expect("the robe can run");
    page.send(&json!({ "do": "steer", "clip": run }).to_string());
    let arrived = (0..40).any(|_| {
        let figures = page.wait_for("figures");
        figures["goal"] == run && figures["answers"]["count"] == 1 && figures["clip"] == "run"
    });
    assert!(arrived, "it runs");
    // The walk around the worst merge passes that merge.
    let worst = &version["worst"][0];
    page.send(&json!({ "do": "inspect", "dead_end": worst["dead_end"] }).to_string());
    let inspected = page.wait_for("inspect");
    assert_eq!(inspected["merge"]["mm"], worst["mm"]);
    assert!(inspected["worst_mm"].as_f64().unwrap() >= worst["mm"].as_f64().unwrap() - 1e-3);
    let is_worst = |mark: &Value| mark["dead_end"] == worst["dead_end"];
    let passed = (0..40).any(|_| {
        let figures = page.wait_for("figures");
        figures["passed"].as_array().unwrap().iter().any(is_worst)
    });
    assert!(passed, "the loop goes through the merge");
    page.send(&json!({ "do": "crowd", "count": 16 }).to_string());
    page.wait_for("figures");
    assert!((0..10).any(|_| page.wait_for("figures")["characters"] == 16));
    for nonsense in
        ["{}", "{\"do\":\"crowd\",\"count\":100000}", "[", "{\"do\":\"dial\",\"mm\":-1}"]
    {
        page.send(nonsense);
        assert!(page.wait_for("refused")["why"].is_string(), "{nonsense}");
    }
}

#[test]
fn pages_that_vanish_or_never_read_disturb_nobody() {
    let viewing = Viewing::start(&[path(shared_store())]);
    let mut steady = viewing.page();
    steady.wait_for("figures");
    // Asks for more than any buffer holds and reads nothing of it.
    let mut deaf = viewing.page();
    deaf.stream.set_write_timeout(Some(Duration::from_millis(200))).unwrap();
    for _ in 0..2000 {
        let frame = [0x80 | TEXT, 0x81, 0, 0, 0, 0, b'f'];
        if deaf.stream.write_all(&frame).is_err() {
            break;
        }
    }
    for _ in 0..5 {
        let mut hasty = viewing.page();
        hasty.wait_for("figures");
        hasty.send("f");
        // Gone in the middle of a frame.
        let mut some = [0; 100];
        hasty.stream.read_exact(&mut some).unwrap();
    }
    let before = steady.wait_for("figures");
    let after = (0..4).map(|_| steady.wait_for("figures")).next_back().unwrap();
    assert!(after["frame"].as_u64() > before["frame"].as_u64(), "the steady one goes on");
    drop(deaf);
    let refused = (0..40).filter(|_| {
        let host = &viewing.host;
        Page::open(host, &format!("http://{host}")).is_err()
    });
    assert_eq!(refused.count(), 0, "places are given back");
}
