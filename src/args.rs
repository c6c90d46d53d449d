//! What the user typed.

use std::net::SocketAddr;
use std::path::PathBuf;
use std::time::Duration;

use clap::{Args, Parser, Subcommand};
use explorer::grow::policy::Policy;
use explorer::pack::Profile;

mod codec;
mod lab;

pub use codec::{Codec, CodecBench, CodecCommand, CodecContact, DecodeBench};
pub use lab::{Lab, LabCommand, LabRun};

/// Near-exhaustive precomputed cloth: explore, publish, stream, play.
#[derive(Debug, Parser)]
#[command(name = "toile", version, about, max_term_width = 100)]
pub struct Arguments {
    /// More log on stderr: -v for info, -vv for debug.
    #[arg(short, long, global = true, action = clap::ArgAction::Count)]
    pub verbose: u8,
    /// What to do.
    #[command(subcommand)]
    pub command: Command,
}

/// The commands.
#[derive(Debug, Subcommand)]
pub enum Command {
    /// Explore, serve and play, all in one process over loopback QUIC.
    Up(Up),
    /// Grow the secondary graph of a scene and publish its versions to a store.
    Explore(Explore),
    /// Serve a store to players over QUIC, and to browsers and probes over HTTP.
    Serve(Serve),
    /// Walk through a served world without a window, and measure it.
    Play(Play),
    /// Show a served world, or a store, in the browser, and steer it.
    View(View),
    /// Verify a store and say what is in it; certify every merge, and replay some.
    Inspect(Inspect),
    /// Draw a store's error curve, graph, states per pose and merge errors.
    Plot(Plot),
    /// Compare what a store plays with continuous simulation, skinning, and the floor of chaos.
    Compare(Compare),
    /// Simulate a garment along a walk, without a graph, and measure it.
    Simulate(Simulate),
    /// Check a scene, draw it, or compute its motion graph.
    Scene(Scene),
    /// The simulator's test bench: scenes with known answers.
    Lab(Lab),
    /// Measure the codec.
    Codec(Codec),
    /// Learn what a coarse simulation lacks, and measure it (Kavan et al. 2011).
    Upsample(crate::upsample::Upsample),
    /// Draw bytes and milliseconds per frame against error, for every codec or way of upsampling.
    Chart(Chart),
}

/// `toile up`.
#[derive(Debug, Args)]
pub struct Up {
    /// A scene by name (robe, dress, dress-agile, robe-real, casual, coat, layers) or its file.
    #[arg(long, default_value = "robe")]
    pub scene: String,
    /// Object store: a folder or a URL [default: store/SCENE].
    #[arg(long, value_name = "URL|DIR")]
    pub store: Option<String>,
    /// Working data of the explorer [default: beside a local store].
    #[arg(long, value_name = "DIR")]
    pub work: Option<PathBuf>,
    /// Simulated players, at most as many as the server takes.
    #[arg(long, default_value_t = 3, value_parser = clap::value_parser!(u32).range(..=1000))]
    pub players: u32,
    /// How they walk: random:SEED, clip:A,B,... or edges:FILE.
    #[arg(long, default_value = "random:1")]
    pub walk: String,
    /// How they walk from a time on, e.g. 90s=clip:jump,kick; may be given again.
    #[arg(long, value_name = "TIME=WALK", value_parser = later_walk)]
    pub then: Vec<(Duration, String)>,
    /// Stop after this long, e.g. 60s, 5m [default: until Ctrl-C].
    #[arg(long = "for", value_name = "TIME", value_parser = duration)]
    pub time: Option<Duration>,
    /// How states are encoded: toile or kim2013 [default: as the store has them, else toile].
    #[arg(long, value_name = "PROFILE", value_parser = profile)]
    pub codec: Option<Profile>,
    /// Largest distance of any vertex from its simulated place, with --codec toile (mm).
    #[arg(long, value_name = "MM", default_value_t = 15.0, allow_negative_numbers = true)]
    pub bound_mm: f32,
    /// Simulation threads [default: all cores].
    #[arg(long)]
    pub workers: Option<usize>,
    /// Vertices of the garment, exactly [default: as the scene says].
    #[arg(long, value_name = "N")]
    pub vertices: Option<usize>,
    /// Which merges are undone first: greedy, visited or predictive (see `toile explore`).
    #[arg(long, default_value = "greedy", value_parser = policy)]
    pub policy: Policy,
    /// QUIC address.
    #[arg(long, default_value = "127.0.0.1:0")]
    pub listen: SocketAddr,
    /// HTTP address of the server.
    #[arg(long, default_value = "127.0.0.1:0")]
    pub http: SocketAddr,
    /// Where the page is that shows the character, on this machine only.
    #[arg(long, default_value = "127.0.0.1:0")]
    pub page: SocketAddr,
    /// One JSON object on the last line of stdout.
    #[arg(long)]
    pub json: bool,
}

/// `toile explore`.
#[derive(Debug, Args)]
pub struct Explore {
    /// A scene by name (robe, dress, dress-agile, robe-real, casual, coat, layers) or its file.
    #[arg(long)]
    pub scene: String,
    /// Object store: a folder or a URL.
    #[arg(long, value_name = "URL|DIR")]
    pub store: String,
    /// Working data [default: beside a local store].
    #[arg(long, value_name = "DIR")]
    pub work: Option<PathBuf>,
    /// Stop after the job with which the store holds this many simulated frames: a job adds up to
    /// depth_frames along every branch, at most 512. The initial pass is made whole.
    #[arg(long)]
    pub frames: Option<u64>,
    /// Stop when the best prefix has no merge that costs more than this (mm): its error, and the
    /// scene's penalty where it crosses classes.
    #[arg(long, value_name = "MM", allow_negative_numbers = true)]
    pub error: Option<f32>,
    /// Stop after this long, e.g. 60s, 5m.
    #[arg(long = "for", value_name = "TIME", value_parser = duration)]
    pub time: Option<Duration>,
    /// How states are encoded: toile or kim2013 [default: as the store has them, else toile].
    #[arg(long, value_name = "PROFILE", value_parser = profile)]
    pub codec: Option<Profile>,
    /// Largest distance of any vertex from its simulated place, with --codec toile (mm).
    #[arg(long, value_name = "MM", default_value_t = 15.0, allow_negative_numbers = true)]
    pub bound_mm: f32,
    /// Simulation threads [default: all cores].
    #[arg(long)]
    pub workers: Option<usize>,
    /// Vertices of the garment, exactly [default: as the scene says].
    #[arg(long, value_name = "N")]
    pub vertices: Option<usize>,
    /// Which merges are undone first: greedy (the largest error), visited (error times the
    /// probability that a player passes), predictive (the error expected to be seen).
    #[arg(long, default_value = "greedy", value_parser = policy)]
    pub policy: Policy,
    /// Undo merges in these clips only, e.g. walk,run [default: all].
    #[arg(long, value_name = "CLIP,CLIP", value_delimiter = ',')]
    pub clips: Vec<String>,
    /// Stop before less than this is left on the disk (MB).
    #[arg(long, value_name = "MB", default_value_t = 256)]
    pub keep_free: u64,
    /// Publish a learned upsampler with a later version, so that cloth can leave the graph.
    #[arg(long)]
    pub upsampler: bool,
    /// The paper's plain algorithm: no early stop, no re-merging.
    #[arg(long)]
    pub paper: bool,
    /// One JSON object on the last line of stdout.
    #[arg(long)]
    pub json: bool,
}

/// `toile serve`.
#[derive(Debug, Args)]
pub struct Serve {
    /// Object store: a folder or a URL.
    #[arg(long, value_name = "URL|DIR")]
    pub store: String,
    /// QUIC address.
    #[arg(long, default_value = "127.0.0.1:4433")]
    pub listen: SocketAddr,
    /// HTTP address.
    #[arg(long, default_value = "127.0.0.1:8080")]
    pub http: SocketAddr,
    /// Token that players must show [default: none needed].
    #[arg(long, env = "TOILE_TOKEN", hide_env_values = true)]
    pub token: Option<String>,
    /// Token that lets a client tag merges for the explorer [default: nobody may].
    #[arg(long, env = "TOILE_TAG_TOKEN", hide_env_values = true)]
    pub tag_token: Option<String>,
    /// Where the server's certificate is kept [default: beside a local store].
    #[arg(long, value_name = "DIR")]
    pub identity: Option<PathBuf>,
    /// Players at the same time; a few hundred kilobytes of buffers each.
    #[arg(long, default_value_t = 1000, value_parser = clap::value_parser!(u32).range(1..=100_000))]
    pub players_max: u32,
    /// Chunks kept in memory, in megabytes.
    #[arg(long, default_value_t = 256, value_parser = clap::value_parser!(u32).range(..=1 << 20))]
    pub cache_mb: u32,
    /// How often the store is asked for a new version, one small read each time; 5s spares a bucket.
    #[arg(long, default_value = "250ms", value_parser = interval)]
    pub poll: Duration,
    /// How often what players walked is written to the store.
    #[arg(long, default_value = "10s", value_parser = interval)]
    pub telemetry: Duration,
}

/// `toile play`.
#[derive(Debug, Args)]
pub struct Play {
    /// The server's QUIC address, HOST:PORT.
    #[arg(long, value_parser = address)]
    pub connect: String,
    /// SHA-256 of the server's certificate, in hexadecimal.
    #[arg(long)]
    pub fingerprint: Option<String>,
    /// Token that the server asks for.
    #[arg(long, env = "TOILE_TOKEN", hide_env_values = true)]
    pub token: Option<String>,
    /// random:SEED, clip:A,B,... or edges:FILE.
    #[arg(long, default_value = "random:1")]
    pub walk: String,
    /// Frames to play, at least 1.
    #[arg(long, default_value_t = 300, value_parser = clap::value_parser!(u64).range(1..))]
    pub frames: u64,
    /// At the scene's rate instead of as fast as possible.
    #[arg(long)]
    pub realtime: bool,
    /// Push the cloth each time so many frames have passed; it needs an upsampler.
    #[arg(long, value_name = "FRAMES", value_parser = clap::value_parser!(u64).range(1..))]
    pub push_every: Option<u64>,
    /// Let a wind blow in the middle third of the walk (m/s, along x); it needs an upsampler.
    #[arg(long, value_name = "M/S", value_parser = wind)]
    pub wind: Option<f32>,
    /// Write body and cloth as an animated glTF file.
    #[arg(long, value_name = "FILE.glb")]
    pub export: Option<PathBuf>,
    /// Write a contact sheet.
    #[arg(long, value_name = "FILE.png")]
    pub picture: Option<PathBuf>,
    /// Frames on the contact sheet.
    #[arg(long, default_value_t = crate::record::SHOTS, requires = "picture",
          value_parser = clap::value_parser!(u64).range(1..=400))]
    pub shots: u64,
    /// One JSON object on the last line of stdout.
    #[arg(long)]
    pub json: bool,
}

/// `toile view`.
#[derive(Debug, Args)]
pub struct View {
    /// A store to show: a folder or a URL. It is served on this machine.
    #[arg(value_name = "STORE", conflicts_with = "connect")]
    pub store: Option<String>,
    /// The QUIC address of a server to show instead, HOST:PORT.
    #[arg(long, value_parser = address)]
    pub connect: Option<String>,
    /// SHA-256 of the server's certificate, in hexadecimal.
    #[arg(long, requires = "connect")]
    pub fingerprint: Option<String>,
    /// Token that the server asks for.
    #[arg(long, env = "TOILE_TOKEN", hide_env_values = true)]
    pub token: Option<String>,
    /// Token that lets the page tag merges for the explorer.
    #[arg(long, env = "TOILE_TAG_TOKEN", hide_env_values = true)]
    pub tag_token: Option<String>,
    /// Where the page is, on this machine only.
    #[arg(long, default_value = "127.0.0.1:0")]
    pub listen: SocketAddr,
}

/// Where an explored store's working data and scene are.
#[derive(Debug, Args)]
pub struct Explored {
    /// Working data of the explorer [default: beside a local store].
    #[arg(long, value_name = "DIR")]
    pub work: Option<PathBuf>,
    /// The scene [default: the one that the store was explored with].
    #[arg(long)]
    pub scene: Option<String>,
}

/// `toile plot`.
#[derive(Debug, Args)]
pub struct Plot {
    /// Object store: a folder or a URL.
    #[arg(value_name = "STORE")]
    pub store: String,
    /// Folder for the SVG and PNG files.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Draw the newest graph, whatever players have.
    #[arg(long)]
    pub newest: bool,
    /// Where things are.
    #[command(flatten)]
    pub explored: Explored,
}

/// `toile compare`.
#[derive(Debug, Args)]
pub struct Compare {
    /// Object store: a folder or a URL.
    #[arg(value_name = "STORE")]
    pub store: String,
    /// Walks.
    #[arg(long, default_value_t = 50, value_parser = clap::value_parser!(u64).range(1..=100_000))]
    pub walks: u64,
    /// Frames of each walk.
    #[arg(long, default_value_t = 300)]
    pub frames: usize,
    /// Seed of the walks.
    #[arg(long, default_value_t = 1)]
    pub seed: u64,
    /// States of the stages after the first; the last is always what the store shows
    /// [default: 4906, 36073 and 99352, as in the paper].
    #[arg(long, value_name = "N,N", value_delimiter = ',')]
    pub stages: Option<Vec<u64>>,
    /// Where things are.
    #[command(flatten)]
    pub explored: Explored,
    /// Simulation threads [default: all cores].
    #[arg(long)]
    pub workers: Option<usize>,
    /// One JSON object on the last line of stdout.
    #[arg(long)]
    pub json: bool,
}

/// `toile inspect`.
#[derive(Debug, Args)]
pub struct Inspect {
    /// Object store: a folder or a URL.
    #[arg(long, value_name = "URL|DIR")]
    pub store: String,
    /// Write every merge with pose, clip, error, class and visits, and all bifurcations.
    #[arg(long, value_name = "FILE.json")]
    pub certificate: Option<PathBuf>,
    /// Simulate so many merges' trajectories again and compare their errors.
    #[arg(long, value_name = "K")]
    pub replay: Option<usize>,
    /// Where things are.
    #[command(flatten)]
    pub explored: Explored,
    /// Simulation threads [default: all cores].
    #[arg(long)]
    pub workers: Option<usize>,
    /// One JSON object on the last line of stdout.
    #[arg(long)]
    pub json: bool,
}

/// `toile simulate`.
#[derive(Debug, Args)]
pub struct Simulate {
    /// A scene by name (robe, dress, dress-agile, robe-real, casual, coat, layers) or its file.
    pub scene: String,
    /// random:SEED, clip:A,B,... or edges:FILE. A walk through clips starts at the first of them.
    #[arg(long, default_value = "random:1")]
    pub walk: String,
    /// Frames to simulate, at least 1 [default: 300; of a soak 100000].
    #[arg(long, value_parser = clap::value_parser!(u64).range(1..))]
    pub frames: Option<u64>,
    /// Vertices of the garment, exactly [default: as the scene says].
    #[arg(long, value_name = "N")]
    pub vertices: Option<usize>,
    /// Stop after this long, e.g. 60s, 5m.
    #[arg(long = "for", value_name = "TIME", value_parser = duration)]
    pub time: Option<Duration>,
    /// For hours, unattended: a frame that cannot be simulated is counted and the walk begun anew.
    #[arg(long)]
    pub soak: bool,
    /// Three seconds of the walk at finer steps and on finer meshes, compared as a table.
    #[arg(long, conflicts_with_all = ["soak", "frames", "time", "refine", "nudge", "table", "export", "picture"])]
    pub converge: bool,
    /// Divide every step by this more than usual.
    #[arg(long, default_value_t = 1, value_name = "K", visible_alias = "substeps",
          value_parser = clap::value_parser!(u32).range(1..=64))]
    pub refine: u32,
    /// Shift the drape by so many micrometres before the first frame, at most 10,000.
    #[arg(long, default_value_t = 0.0, value_name = "MICRONS", allow_negative_numbers = true,
          value_parser = nudge)]
    pub nudge: f32,
    /// Write the measures of every frame as a table.
    #[arg(long, value_name = "FILE.csv")]
    pub table: Option<PathBuf>,
    /// Write body and cloth as an animated glTF file.
    #[arg(long, value_name = "FILE.glb")]
    pub export: Option<PathBuf>,
    /// Write a contact sheet.
    #[arg(long, value_name = "FILE.png")]
    pub picture: Option<PathBuf>,
    /// One JSON object on the last line of stdout.
    #[arg(long)]
    pub json: bool,
}

/// `toile scene`.
#[derive(Debug, Args)]
pub struct Scene {
    /// What to do with it.
    #[command(subcommand)]
    pub command: SceneCommand,
}

/// The commands of `toile scene`.
#[derive(Debug, Subcommand)]
pub enum SceneCommand {
    /// Read a scene, say what was read, and refuse what cannot work.
    Check {
        /// Built-in scene or a scene file.
        file: String,
        /// One JSON object on the last line of stdout.
        #[arg(long)]
        json: bool,
    },
    /// Compute a motion graph from the scene's clips.
    Graph {
        /// Built-in scene or a scene file.
        file: String,
        /// Median time to reach a given clip (s); smaller is denser [default: as the file says].
        #[arg(long, value_name = "SECONDS", allow_negative_numbers = true)]
        density: Option<f32>,
        /// The clips to be reached in that time, e.g. walk,run [default: the file's, or all].
        #[arg(long, value_name = "CLIP,CLIP", value_delimiter = ',')]
        to: Vec<String>,
        /// Where to write it (the format of `motion_graph.file`).
        #[arg(long, value_name = "FILE.json")]
        out: PathBuf,
    },
    /// How soon the motion graph answers a player's presses.
    Answers {
        /// Built-in scene or a scene file.
        file: String,
        /// Presses, each of another clip.
        #[arg(long, default_value_t = 200, value_parser = clap::value_parser!(u32).range(1..=100_000))]
        presses: u32,
        /// Of the presses.
        #[arg(long, default_value_t = 1)]
        seed: u64,
        /// One JSON object on the last line of stdout.
        #[arg(long)]
        json: bool,
    },
    /// Draw the garment in the rest pose and the clips' poses as a contact sheet.
    Picture {
        /// Built-in scene or a scene file.
        file: String,
        /// Where to write it.
        #[arg(long, value_name = "FILE.png")]
        out: PathBuf,
    },
}

/// `toile chart`.
#[derive(Debug, Args)]
pub struct Chart {
    /// Object store (a folder or a URL), or flag, curtain, skirt or cape.
    #[arg(value_name = "STORE|SCENE")]
    pub store: String,
    /// Where to write the files.
    #[arg(long, value_name = "DIR")]
    pub out: PathBuf,
    /// Work folder that it was explored in [default: beside a local store].
    #[arg(long, value_name = "DIR")]
    pub work: Option<PathBuf>,
    /// At most so many states, whole regions spread evenly [default: all].
    #[arg(long)]
    pub states: Option<usize>,
    /// What `toile codec bench --json` printed, instead of measuring again.
    #[arg(long, value_name = "FILE.json")]
    pub bench: Option<PathBuf>,
}

fn policy(text: &str) -> Result<Policy, String> {
    text.parse()
}

fn profile(text: &str) -> Result<Profile, String> {
    Profile::named(text).ok_or_else(|| "toile or kim2013".into())
}

fn duration(text: &str) -> Result<Duration, String> {
    let digits = text.trim_end_matches(|c: char| c.is_ascii_alphabetic());
    let seconds = match &text[digits.len()..] {
        "ms" => 1e-3,
        "s" | "" => 1.0,
        "m" | "min" => 60.0,
        "h" => 3600.0,
        unit => return Err(format!("unknown unit `{unit}`: use ms, s, m or h, as in 60s")),
    };
    let value: f64 = digits.parse().map_err(|_| "expected a time such as 60s or 5m".to_string())?;
    Duration::try_from_secs_f64(value * seconds).map_err(|e| e.to_string())
}

fn address(text: &str) -> Result<String, String> {
    let port = text.rsplit_once(':').filter(|(host, _)| !host.is_empty());
    match port.map(|(_, port)| port.parse::<u16>()) {
        Some(Ok(_)) => Ok(text.to_owned()),
        _ => Err("write HOST:PORT, as in 127.0.0.1:4433".into()),
    }
}

fn later_walk(text: &str) -> Result<(Duration, String), String> {
    let (time, walk) = text.split_once('=').ok_or("write TIME=WALK, as in 90s=clip:jump,kick")?;
    Ok((duration(time)?, walk.to_owned()))
}

/// A time between two things that are done again and again.
fn interval(text: &str) -> Result<Duration, String> {
    let interval = duration(text)?;
    let range = Duration::from_millis(10)..=Duration::from_secs(3600);
    range.contains(&interval).then_some(interval).ok_or_else(|| "from 10ms to 1h".to_string())
}

/// Further than this, the cloth would be through its wearer before it is simulated (um).
const NUDGE_MAX: f32 = 1e4;

fn nudge(text: &str) -> Result<f32, String> {
    let microns = text.parse::<f32>().ok().filter(|microns| microns.abs() <= NUDGE_MAX);
    microns.ok_or_else(|| format!("micrometres, at most {NUDGE_MAX} either way"))
}

fn wind(text: &str) -> Result<f32, String> {
    let speed = text.parse::<f32>().ok().filter(|m_s| m_s.abs() <= client_lib::free::FORCE_MAX);
    speed.ok_or_else(|| format!("metres a second, at most {}", client_lib::free::FORCE_MAX))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn times_are_read_with_their_units() {
        assert_eq!(duration("60s"), Ok(Duration::from_secs(60)));
        assert_eq!(duration("1.5m"), Ok(Duration::from_secs(90)));
        assert_eq!(duration("250ms"), Ok(Duration::from_millis(250)));
        for wrong in ["", "s", "-1s", "5 parsecs", "1e400s", "NaN"] {
            assert!(duration(wrong).is_err(), "{wrong}");
        }
        assert_eq!(interval("10ms"), Ok(Duration::from_millis(10)));
        assert!(interval("0s").is_err() && interval("2h").is_err());
    }

    #[test]
    fn what_a_command_does_not_read_is_refused() {
        let parse = |line: &str| Arguments::try_parse_from(line.split(' ')).map(|_| ());
        for right in [
            "toile plot s --out d",
            "toile compare s --workers 1",
            "toile simulate robe --nudge -50",
        ] {
            assert!(parse(right).is_ok(), "{right}");
        }
        for wrong in [
            "toile plot s --out d --workers 1",
            "toile simulate robe --converge --for 3s",
            "toile simulate robe --nudge 1e9",
            "toile simulate robe --nudge NaN",
            "toile lab run S1 --n 4 --vertices 16",
        ] {
            assert!(parse(wrong).is_err(), "{wrong}");
        }
    }
}
