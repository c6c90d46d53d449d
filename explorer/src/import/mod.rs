//! Reads scenes: characters, motion graphs and garments in other people's formats.
//!
//! [`load_scene`] is the door: `robe` is made by [`crate::builtin`]; `dress`, `robe-real`, `casual`,
//! `layers` and `coat` are shipped as TOML and read the data folder; anything else is a scene file
//! ([`scene_file`]).

pub mod align;
mod animation;
pub mod bvh;
pub mod character;
pub mod check;
pub mod components;
pub mod compute;
mod distances;
pub mod ease;
pub mod exits;
pub mod garment;
pub mod gltf_file;
mod layers;
mod metric;
pub mod motion_graph;
pub mod obj;
pub mod reach;
#[cfg(test)]
mod real_data;
pub mod refine;
#[cfg(test)]
mod refusals;
pub mod retarget;
pub mod scene_file;
#[cfg(test)]
mod synthetic;
#[cfg(test)]
mod synthetic_glb;
pub mod transition;

use std::path::{Path, PathBuf};
use std::sync::Arc;

use protocol::PoseId;

use self::bvh::{Bvh, BvhError};
use self::character::{Character, CharacterError};
use self::compute::{ComputeError, Density};
use self::garment::GarmentError;
use self::gltf_file::FILE_BYTES_MAX;
use self::motion_graph::{GraphFile, GraphReport, MotionGraphError};
use self::scene_file::{MotionSource, SceneFile, SceneFileError, resolve_path};
use self::transition::Transition;
use crate::builtin::BuiltinError;
use crate::primary::PrimaryGraph;
use crate::scene::{Garment, MetricSettings, Scene};

/// Scenes that are shipped as TOML and read the data folder, by name.
const SHIPPED: [(&str, &str); 6] = [
    ("dress", include_str!("../../../scenes/dress.toml")),
    ("dress-agile", include_str!("../../../scenes/dress-agile.toml")),
    ("layers", include_str!("../../../scenes/layers.toml")),
    ("robe-real", include_str!("../../../scenes/robe-real.toml")),
    ("casual", include_str!("../../../scenes/casual.toml")),
    ("coat", include_str!("../../../scenes/coat.toml")),
];

/// Why a scene could not be loaded: always the file, the place in it and what to do.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum SceneError {
    /// A file could not be opened.
    #[error("{}: {source} ({key} names it; check the path)", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// The key that names it.
        key: String,
        /// Why.
        source: std::io::Error,
    },
    /// Neither a scene that is built in nor a file.
    #[error("there is no scene {name:?}: name a TOML file, or one of robe{list}", name = .0, list = shipped())]
    Unknown(String),
    /// The scene file itself.
    #[error("{}: {source}", path.display())]
    File {
        /// The scene file.
        path: PathBuf,
        /// What is wrong.
        source: SceneFileError,
    },
    /// The built-in scene.
    #[error(transparent)]
    Builtin(#[from] BuiltinError),
    /// The character.
    #[error("{}: {source}", path.display())]
    Character {
        /// Its file.
        path: PathBuf,
        /// What is wrong.
        source: CharacterError,
    },
    /// A BVH clip.
    #[error("{}: {source}", path.display())]
    Bvh {
        /// Its file.
        path: PathBuf,
        /// What is wrong.
        source: BvhError,
    },
    /// The motion graph could not be computed.
    #[error("{}: {source}", path.display())]
    Compute {
        /// The scene file.
        path: PathBuf,
        /// What is wrong.
        source: ComputeError,
    },
    /// The motion graph.
    #[error("{}: {source}", path.display())]
    MotionGraph {
        /// Its file, or the scene file where it is computed.
        path: PathBuf,
        /// What is wrong.
        source: MotionGraphError,
    },
    /// The garment.
    #[error("{}: {source}", path.display())]
    Garment {
        /// Its file.
        path: PathBuf,
        /// What is wrong.
        source: GarmentError,
    },
}

/// The names of the scenes that are shipped, after a comma each.
fn shipped() -> String {
    SHIPPED.iter().map(|(name, _)| format!(", {name}")).collect()
}

/// A scene, and what was dropped on the way to it.
#[derive(Debug, Clone)]
pub struct Loaded {
    /// The scene.
    pub scene: Scene,
    /// What fell outside the largest strongly connected component; `None` for built-in scenes.
    pub graph: Option<GraphReport>,
    /// What the scene asks of its motion graph; `None` where it names a file or a threshold.
    pub asked: Option<AskedReach>,
}

/// What a scene asks of a motion graph that is computed.
#[derive(Debug, Clone, PartialEq)]
pub struct AskedReach {
    /// Median time to reach a given clip (s).
    pub reach_s: f32,
    /// Of the ways among these clips; none: among all.
    pub clips: Vec<String>,
}

/// Loads a scene by name (`robe`, or one that is shipped as TOML) or from a file.
///
/// * `data_dir`: the data folder, for `dress` and for `$TOILE_DATA` in files (see [`data_dir`]).
///
/// # Errors
/// File, place and remedy of whatever is wrong.
pub fn load_scene(name_or_path: &str, data_dir: Option<&Path>) -> Result<Scene, SceneError> {
    load(name_or_path, data_dir).map(|loaded| loaded.scene)
}

/// As [`load_scene`], with the report on the motion graph.
///
/// # Errors
/// As for [`load_scene`].
pub fn load(name_or_path: &str, data_dir: Option<&Path>) -> Result<Loaded, SceneError> {
    load_with(name_or_path, data_dir, LoadOptions::default())
}

/// What the caller wants otherwise than the scene says.
#[derive(Debug, Clone, Copy, Default, PartialEq, Eq)]
pub struct LoadOptions {
    /// Vertices of the garment, exactly.
    pub vertices: Option<usize>,
}

/// As [`load`], with changes.
///
/// # Errors
/// As for [`load_scene`]; also fewer vertices than the garment's file has.
pub fn load_with(
    name_or_path: &str,
    data_dir: Option<&Path>,
    options: LoadOptions,
) -> Result<Loaded, SceneError> {
    if name_or_path == "robe" {
        let scene = crate::builtin::robe(options.vertices)?;
        return Ok(Loaded { scene, graph: None, asked: None });
    }
    let (text, path) = scene_text(name_or_path)?;
    load_text_with(&text, &path, data_dir, options)
}

/// The data folder: the environment's `TOILE_DATA`, else the first `shared/data` beside the
/// current folder or one above it that holds a character.
pub fn data_dir() -> Option<PathBuf> {
    if let Some(folder) = std::env::var_os("TOILE_DATA").filter(|folder| !folder.is_empty()) {
        return Some(PathBuf::from(folder));
    }
    let here = std::env::current_dir().ok()?;
    let beside = |folder: &Path| folder.join("shared/data");
    here.ancestors().map(beside).find(|data| data.join("character.glb").is_file())
}

/// Computes the motion graph of a scene's character (`dress` or a file; not a built-in one).
///
/// * `density`: `None` takes what the scene file asks for.
/// * `to`: the clips to be reached; none: those of the scene file, or all.
///
/// # Errors
/// As for [`load_scene`]; also where no density is given at all.
pub fn scene_graph(
    name_or_path: &str,
    data_dir: Option<&Path>,
    density: Option<Density>,
    to: &[String],
) -> Result<GraphFile, SceneError> {
    let (text, path) = scene_text(name_or_path)?;
    let place = Place { scene: &path, data: data_dir };
    let file = SceneFile::parse(&text).map_err(|e| place.error(e))?;
    let written = file.motion_source().map_err(|e| place.error(e))?;
    let density = match (density, written) {
        (Some(density), _) | (None, MotionSource::Computed(density)) => density,
        (None, MotionSource::File(_)) => {
            return Err(place.error(SceneFileError::Value {
                key: "motion_graph".to_owned(),
                problem: "names a file; give the density to compute one with".to_owned(),
            }));
        }
    };
    let to = if to.is_empty() { &file.motion_graph.reach_clips[..] } else { to };
    let character = load_character(&file, &place)?;
    let transitions =
        compute::compute(&character.body.skeleton, &character.clips, file.fps, density, to)
            .map_err(|source| SceneError::Compute { path: path.clone(), source })?;
    Ok(compute::to_file(&character.clips, file.fps, &transitions))
}

/// The text of a scene file and where it lies.
fn scene_text(name_or_path: &str) -> Result<(String, PathBuf), SceneError> {
    if let Some((name, text)) = SHIPPED.iter().find(|(name, _)| *name == name_or_path) {
        return Ok(((*text).to_owned(), PathBuf::from(format!("scenes/{name}.toml"))));
    }
    let path = PathBuf::from(name_or_path);
    if path.extension().is_none() && !path.exists() {
        return Err(SceneError::Unknown(name_or_path.to_owned()));
    }
    let text = String::from_utf8(read(&path, "the command line")?).map_err(|_| {
        let source = SceneFileError::Toml("is not UTF-8 text; give a TOML file".to_owned());
        SceneError::File { path: path.clone(), source }
    })?;
    Ok((text, path))
}

/// The character of a scene file with its animations, and BVH clips in place of or beside them.
fn load_character(file: &SceneFile, place: &Place<'_>) -> Result<Character, SceneError> {
    let path = place.resolve("character.file", &file.character.file)?;
    let bytes = read(&path, "character.file")?;
    let mut character = character::read_character(&bytes, path.parent(), file.fps)
        .map_err(|source| SceneError::Character { path: path.clone(), source })?;
    for (index, written) in file.character.clips.iter().enumerate() {
        let key = format!("character.clips[{index}]");
        let path = place.resolve(&key, written)?;
        let bytes = read(&path, &key)?;
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        let clip = Bvh::parse(&String::from_utf8_lossy(&bytes))
            .and_then(|bvh| retarget::retarget(&name, &bvh, &character.body.skeleton, file.fps))
            .map_err(|source| SceneError::Bvh { path, source })?;
        match character.clips.iter_mut().find(|c| c.name == clip.name) {
            Some(old) => *old = clip,
            None => character.clips.push(clip),
        }
    }
    Ok(character)
}

/// Loads a scene from the text of a scene file that lies (or would lie) at `path`.
///
/// # Errors
/// As for [`load_scene`].
pub fn load_text(text: &str, path: &Path, data_dir: Option<&Path>) -> Result<Loaded, SceneError> {
    load_text_with(text, path, data_dir, LoadOptions::default())
}

fn load_text_with(
    text: &str,
    path: &Path,
    data_dir: Option<&Path>,
    options: LoadOptions,
) -> Result<Loaded, SceneError> {
    let place = Place { scene: path, data: data_dir };
    let file = SceneFile::parse(text).map_err(|e| place.error(e))?;
    let character = load_character(&file, &place)?;
    let (primary, graph) = load_primary(&file, &character, &place)?;
    let start = start_pose(&file, &primary).map_err(|e| place.error(e))?;
    let (garment, metric) = load_garment(&file, &character, &place, options)?;
    let scene = Scene {
        name: file.name.clone(),
        body: Arc::new(character.body),
        primary: Arc::new(primary),
        start,
        garment,
        exploration: file.exploration().map_err(|e| place.error(e))?,
        metric,
        simulator: file.simulator(place.folder()).map_err(|e| place.error(e))?,
    };
    let asked = match file.motion_source().map_err(|e| place.error(e))? {
        MotionSource::Computed(Density::Reach(reach_s)) => {
            Some(AskedReach { reach_s, clips: file.motion_graph.reach_clips })
        }
        _ => None,
    };
    Ok(Loaded { scene, graph: Some(graph), asked })
}

struct Place<'a> {
    scene: &'a Path,
    data: Option<&'a Path>,
}

impl Place<'_> {
    fn error(&self, source: SceneFileError) -> SceneError {
        SceneError::File { path: self.scene.to_owned(), source }
    }

    /// Where a program is started: absolute, also of a bare file name.
    fn folder(&self) -> PathBuf {
        let folder = self.scene.parent().filter(|folder| *folder != Path::new(""));
        let folder = folder.unwrap_or(Path::new("."));
        std::path::absolute(folder).unwrap_or_else(|_| folder.to_owned())
    }

    fn resolve(&self, key: &str, written: &str) -> Result<PathBuf, SceneError> {
        let folder = self.scene.parent().unwrap_or(Path::new(""));
        resolve_path(key, written, folder, self.data).map_err(|e| self.error(e))
    }
}

fn read(path: &Path, key: &str) -> Result<Vec<u8>, SceneError> {
    let error = |source| SceneError::Read { path: path.to_owned(), key: key.to_owned(), source };
    let length = std::fs::metadata(path).map_err(error)?.len();
    if length > FILE_BYTES_MAX as u64 {
        return Err(error(std::io::Error::other(format!("over {FILE_BYTES_MAX} bytes"))));
    }
    std::fs::read(path).map_err(error)
}

fn load_primary(
    file: &SceneFile,
    character: &Character,
    place: &Place<'_>,
) -> Result<(PrimaryGraph, GraphReport), SceneError> {
    let source = file.motion_source().map_err(|e| place.error(e))?;
    let (path, transitions) = transitions(&source, file, character, place)?;
    motion_graph::build(&character.body.skeleton, &character.clips, file.fps, &transitions)
        .map_err(|source| SceneError::MotionGraph { path, source })
}

fn transitions(
    source: &MotionSource,
    file: &SceneFile,
    character: &Character,
    place: &Place<'_>,
) -> Result<(PathBuf, Vec<Transition>), SceneError> {
    let skeleton = &character.body.skeleton;
    match source {
        MotionSource::File(written) => {
            let path = place.resolve("motion_graph.file", written)?;
            let bytes = read(&path, "motion_graph.file")?;
            let resolve = || {
                let graph = GraphFile::parse(&String::from_utf8_lossy(&bytes))?;
                graph.resolve(&character.clips, file.fps)
            };
            match resolve() {
                Ok(transitions) => Ok((path, transitions)),
                Err(source) => Err(SceneError::MotionGraph { path, source }),
            }
        }
        MotionSource::Computed(density) => {
            let path = place.scene.to_owned();
            let to = &file.motion_graph.reach_clips;
            match compute::compute(skeleton, &character.clips, file.fps, *density, to) {
                Ok(transitions) => Ok((path, transitions)),
                Err(source) => Err(SceneError::Compute { path, source }),
            }
        }
    }
}

fn start_pose(file: &SceneFile, primary: &PrimaryGraph) -> Result<PoseId, SceneFileError> {
    let Some(start) = &file.start else { return Ok(PoseId(0)) };
    let clip = primary.clips().iter().position(|c| *c == start.clip);
    let found = primary
        .poses()
        .iter()
        .position(|p| !p.transition && Some(usize::from(p.clip)) == clip && p.frame == start.frame);
    found.map(|pose| PoseId(pose as u32)).ok_or_else(|| {
        let recorded = || primary.poses().iter().filter(|p| !p.transition);
        let of_clip = || recorded().filter(|p| Some(usize::from(p.clip)) == clip);
        let frames = || of_clip().map(|p| p.frame);
        let problem = match (clip, frames().min(), frames().max()) {
            (None, ..) => {
                format!("there is no clip {:?}; there are {}", start.clip, primary.clips().join(", "))
            }
            (_, Some(first), Some(last)) => format!(
                "frame {} of clip {:?} is not in the motion graph's largest component; name one from {first} to {last}",
                start.frame, start.clip
            ),
            _ => format!("no frame of clip {:?} is in the motion graph's largest component", start.clip),
        };
        SceneFileError::Value { key: "start".to_owned(), problem }
    })
}

fn load_garment(
    file: &SceneFile,
    character: &Character,
    place: &Place<'_>,
    options: LoadOptions,
) -> Result<(Garment, MetricSettings), SceneError> {
    let table = file.garment().map_err(|e| place.error(e))?;
    let dressed = layers::dress(&table, options.vertices, character, place)?;
    let cut = (&dressed.surface, dressed.file_vertices);
    let metric =
        metric::resolve(file, &table, cut, &character.body.skeleton).map_err(|e| place.error(e))?;
    let garment = Garment {
        name: table.name.clone().unwrap_or_else(|| file.name.clone()),
        positions: dressed.surface.positions,
        triangles: dressed.surface.triangles,
        layers: dressed.layers,
        attached: dressed.attached,
        fabric: table.fabric().map_err(|e| place.error(e))?,
    };
    Ok((garment, metric))
}
