//! The process at the other end of the pipe, and the frames that go to and fro.
//!
//! | bytes of a message | what |
//! | --- | --- |
//! | 4 | length n of the payload, little-endian |
//! | 1 | kind |
//! | n | payload |

use std::io::{Read, Write};
use std::process::{Child, ChildStdin, ChildStdout, Command, Stdio};
use std::sync::mpsc::{Receiver, RecvTimeoutError, Sender, channel};
use std::time::{Duration, Instant};

use super::Foreign;
use crate::cpu::program_cpu_s;

/// From us: what stays the same, as JSON.
const HELLO: u8 = 1;
/// From the program: it is ready.
const READY: u8 = 2;
/// From us: simulate one frame.
const STEP: u8 = 3;
/// From the program: the state at its end.
const STATE: u8 = 4;
/// From the program: why this step cannot be simulated, as UTF-8 text.
const FAILED: u8 = 5;
/// A program may take so long to start, whatever the limit of a step.
const START_TIMEOUT: Duration = Duration::from_secs(60);
/// Bytes of text that are kept of an error.
const TEXT_BYTES_MAX: usize = 4096;

/// What a program answered.
pub enum Answer {
    /// Positions, then velocities.
    State(Vec<u8>),
    /// In its own words.
    Failed(String),
}

/// Why there is no answer, in words.
#[derive(Debug)]
pub struct NoAnswer {
    pub text: String,
    /// It was given the time, and did not take more than that.
    pub late: bool,
}

impl From<String> for NoAnswer {
    fn from(text: String) -> Self {
        Self { text, late: false }
    }
}

type Message = Result<(u8, Vec<u8>), String>;

/// A running program; ended when it is dropped. Two threads move bytes, so that no pipe that is
/// full or empty can hold up the explorer.
pub struct Process {
    child: Child,
    requests: Sender<Vec<u8>>,
    answers: Receiver<Message>,
    has_answered: bool,
    waited: Duration,
}

impl Process {
    /// Starts it, says hello, and waits until it is ready.
    pub fn start(
        foreign: &Foreign,
        hello: &[u8],
        answer_bytes: usize,
        timeout: Duration,
    ) -> Result<Self, String> {
        let (program, arguments) =
            foreign.command.split_first().ok_or("no program is named; give simulator.command")?;
        let mut child = Command::new(program)
            .args(arguments)
            .current_dir(&foreign.folder)
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .spawn()
            .map_err(|e| format!("cannot be started in {}: {e}", foreign.folder.display()))?;
        let stdin = child.stdin.take().ok_or("no standard input")?;
        let stdout = child.stdout.take().ok_or("no standard output")?;
        let (requests, to_write) = channel();
        let (read, answers) = channel();
        std::thread::spawn(move || write_all(stdin, &to_write));
        let limit = answer_bytes.max(TEXT_BYTES_MAX);
        std::thread::spawn(move || read_all(stdout, limit, &read));
        let (has_answered, waited) = (false, Duration::ZERO);
        let mut process = Self { child, requests, answers, has_answered, waited };
        process.send(HELLO, hello);
        match process.receive(timeout.max(START_TIMEOUT)).map_err(|none| none.text)? {
            (READY, _) => Ok(process),
            (FAILED, text) => Err(words(&text)),
            (kind, _) => Err(format!("answered hello with a message of kind {kind}")),
        }
    }

    /// One step.
    pub fn ask(&mut self, request: &[u8], timeout: Duration) -> Result<Answer, NoAnswer> {
        self.send(STEP, request);
        let answer = match self.receive(timeout)? {
            (STATE, bytes) => Answer::State(bytes),
            (FAILED, text) => Answer::Failed(words(&text)),
            (kind, _) => {
                return Err(format!("answered a step with a message of kind {kind}").into());
            }
        };
        self.has_answered = true;
        Ok(answer)
    }

    /// Whether it ever answered a step.
    pub fn has_answered(&self) -> bool {
        self.has_answered
    }

    /// CPU time that it took so far, or else how long it was waited for (s).
    pub fn cpu_s(&self) -> f64 {
        program_cpu_s(self.child.id()).unwrap_or(self.waited.as_secs_f64())
    }

    fn send(&self, kind: u8, payload: &[u8]) {
        let mut bytes = (payload.len() as u32).to_le_bytes().to_vec();
        bytes.push(kind);
        bytes.extend_from_slice(payload);
        // A writer that is gone means a program that is gone: receiving says so.
        let _ = self.requests.send(bytes);
    }

    fn receive(&mut self, timeout: Duration) -> Result<(u8, Vec<u8>), NoAnswer> {
        let clock = Instant::now();
        let answer = self.answers.recv_timeout(timeout);
        self.waited += clock.elapsed();
        match answer {
            Ok(message) => Ok(message?),
            Err(RecvTimeoutError::Timeout) => {
                let text = format!("no answer in {} s; it was ended", timeout.as_secs_f32());
                Err(NoAnswer { text, late: true })
            }
            Err(RecvTimeoutError::Disconnected) => Err("it ended".to_owned().into()),
        }
    }
}

impl Drop for Process {
    fn drop(&mut self) {
        // It may have ended by itself.
        let _ = self.child.kill();
        let _ = self.child.wait();
    }
}

fn write_all(mut stdin: ChildStdin, requests: &Receiver<Vec<u8>>) {
    for bytes in requests {
        if stdin.write_all(&bytes).and_then(|()| stdin.flush()).is_err() {
            return;
        }
    }
}

/// Reads messages until the program ends, sends nonsense, or nobody listens.
fn read_all(mut stdout: ChildStdout, limit: usize, to: &Sender<Message>) {
    loop {
        let message = read_message(&mut stdout, limit);
        let failed = message.is_err();
        if to.send(message).is_err() || failed {
            return;
        }
    }
}

fn read_message(stdout: &mut impl Read, limit: usize) -> Message {
    let mut head = [0; 5];
    stdout.read_exact(&mut head).map_err(|_| "it ended without an answer".to_owned())?;
    let length = u32::from_le_bytes([head[0], head[1], head[2], head[3]]) as usize;
    if length > limit {
        return Err(format!("announced {length} bytes, at most {limit} are expected"));
    }
    let mut payload = vec![0; length];
    stdout
        .read_exact(&mut payload)
        .map_err(|_| format!("it ended in the middle of an answer of {length} bytes"))?;
    Ok((head[4], payload))
}

fn words(text: &[u8]) -> String {
    String::from_utf8_lossy(&text[..text.len().min(TEXT_BYTES_MAX)]).into_owned()
}
