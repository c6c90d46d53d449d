//! Running `toile` as a user does.

use std::collections::BTreeMap;
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::{Child, Command, Output, Stdio};
use std::sync::OnceLock;
use std::time::{Duration, Instant};

use serde_json::Value;

/// Simulated frames of the shared store: the initial pass of the robe and some expansion.
pub const SHARED_FRAMES: u64 = 700;

pub fn command(arguments: &[&str]) -> Command {
    let mut command = Command::new(env!("CARGO_BIN_EXE_toile"));
    command.args(arguments).stdin(Stdio::null());
    command
}

pub fn toile(arguments: &[&str]) -> Output {
    command(arguments).output().expect("toile starts")
}

/// Runs a command that must succeed, and reads the object on the last line of stdout.
pub fn toile_json(arguments: &[&str]) -> Value {
    let output = toile(arguments);
    let stdout = String::from_utf8_lossy(&output.stdout);
    let stderr = String::from_utf8_lossy(&output.stderr);
    assert!(output.status.success(), "{arguments:?} failed:\n{stderr}\n{stdout}");
    let last = stdout.lines().last().unwrap_or_default();
    serde_json::from_str(last).unwrap_or_else(|e| panic!("{e}: last line is {last:?}\n{stderr}"))
}

/// Runs a command that must fail, and returns what it said.
pub fn toile_error(arguments: &[&str]) -> String {
    let output = toile(arguments);
    assert!(!output.status.success(), "{arguments:?} should have failed");
    let said = String::from_utf8_lossy(&output.stderr).into_owned();
    assert!(!said.contains("panicked"), "{arguments:?} panicked:\n{said}");
    said
}

/// An explored store of the robe, made once per test run.
pub fn shared_store() -> &'static Path {
    static STORE: OnceLock<(tempfile::TempDir, PathBuf)> = OnceLock::new();
    let (_, store) = STORE.get_or_init(|| {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let store = folder.path().join("robe");
        explore(&store, SHARED_FRAMES, 2);
        (folder, store)
    });
    store
}

pub fn explore(store: &Path, frames: u64, workers: usize) -> Value {
    toile_json(&[
        "explore",
        "--scene",
        "robe",
        "--store",
        path(store),
        "--frames",
        &frames.to_string(),
        "--workers",
        &workers.to_string(),
        "--json",
    ])
}

pub fn path(path: &Path) -> &str {
    path.to_str().expect("temporary paths are UTF-8")
}

/// Every file of a store by its path, manifests without the 64 bytes of their signature.
pub fn contents(store: &Path) -> BTreeMap<String, Vec<u8>> {
    let mut found = BTreeMap::new();
    let mut folders = vec![store.to_path_buf()];
    while let Some(folder) = folders.pop() {
        for entry in std::fs::read_dir(&folder).expect("readable store") {
            let file = entry.expect("readable entry").path();
            if file.is_dir() {
                folders.push(file);
                continue;
            }
            let name = path(file.strip_prefix(store).expect("below the store")).to_string();
            let mut bytes = std::fs::read(&file).expect("readable file");
            if name.starts_with("versions/") {
                bytes.truncate(bytes.len() - 64);
            }
            if name != "publisher.pub" {
                found.insert(name, bytes);
            }
        }
    }
    found
}

/// `toile serve` on free ports; killed when dropped.
pub struct Serving {
    child: Child,
    pub address: String,
    pub http: String,
    pub fingerprint: String,
}

impl Serving {
    pub fn start(store: &Path, more: &[&str]) -> Self {
        let mut arguments = vec![
            "serve",
            "--store",
            path(store),
            "--listen",
            "127.0.0.1:0",
            "--http",
            "127.0.0.1:0",
            // A store that tests share is compared byte by byte: nothing is added to it.
            "--telemetry",
            "1h",
        ];
        arguments.extend(more);
        let mut child = command(&arguments)
            .stdout(Stdio::piped())
            .stderr(Stdio::null())
            .spawn()
            .expect("toile serve starts");
        let mut lines = BufReader::new(child.stdout.take().expect("piped")).lines();
        let mut said = BTreeMap::new();
        while said.len() < 3 {
            let line = lines.next().expect("serve says where it listens").expect("UTF-8");
            for key in ["quic", "http", "fingerprint"] {
                if let Some(value) = line.trim().strip_prefix(key) {
                    said.insert(key, value.trim().to_string());
                }
            }
        }
        std::thread::spawn(move || lines.for_each(drop));
        let [address, http, fingerprint] = ["quic", "http", "fingerprint"]
            .map(|key| said[key].trim_start_matches("http://").into());
        Self { child, address, http, fingerprint }
    }

    pub fn play(&self, more: &[&str]) -> Value {
        toile_json(&self.play_arguments(more))
    }

    pub fn play_arguments<'a>(&'a self, more: &[&'a str]) -> Vec<&'a str> {
        let mut arguments =
            vec!["play", "--connect", &self.address, "--fingerprint", &self.fingerprint];
        arguments.extend(more);
        arguments.push("--json");
        arguments
    }

    /// The body of an HTTP GET, or what went wrong.
    pub fn get(&self, target: &str) -> Result<(u16, Vec<u8>), String> {
        use std::io::{Read, Write};
        let mut stream =
            std::net::TcpStream::connect(&self.http).map_err(|e| format!("{}: {e}", self.http))?;
        let request = format!("GET {target} HTTP/1.1\r\nHost: toile\r\nConnection: close\r\n\r\n");
        stream.write_all(request.as_bytes()).map_err(|e| e.to_string())?;
        let mut answer = Vec::new();
        stream.read_to_end(&mut answer).map_err(|e| e.to_string())?;
        let head_end = answer.windows(4).position(|w| w == b"\r\n\r\n").ok_or("no header")?;
        let head = String::from_utf8_lossy(&answer[..head_end]).into_owned();
        let status = head.split(' ').nth(1).and_then(|s| s.parse().ok()).ok_or("no status")?;
        Ok((status, answer[head_end + 4..].to_vec()))
    }

    pub fn is_up(&mut self) -> bool {
        self.child.try_wait().expect("child can be asked").is_none()
            && matches!(self.get("/healthz"), Ok((200, _)))
    }
}

impl Drop for Serving {
    fn drop(&mut self) {
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

/// Waits until `done` answers, at most `limit`.
pub fn wait_for<T>(limit: Duration, mut done: impl FnMut() -> Option<T>) -> T {
    let start = Instant::now();
    loop {
        if let Some(value) = done() {
            return value;
        }
        assert!(start.elapsed() < limit, "nothing came in {limit:?}");
        std::thread::sleep(Duration::from_millis(20));
    }
}
