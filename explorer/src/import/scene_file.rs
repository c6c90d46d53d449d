//! The TOML of a scene: what is written there, and nothing else (unknown keys are refused).
//!
//! ```toml
//! name = "dress"
//! fps = 30.0                                   # default 30
//! start = { clip = "walk_figure8", frame = 40 } # default: the first pose
//!
//! [character]
//! file = "$TOILE_DATA/character.glb"
//! clips = ["more/dance.bvh"]                   # BVH for the same skeleton; default: none
//!
//! [motion_graph]
//! file = "motion-graph.json"                   # or computed: threshold_m or reach_s
//!
//! [garment]
//! file = "$TOILE_DATA/garments/dress_long.obj"
//! name = "dress"                               # default: the scene's name
//! edge_length_m = 0.03                         # or vertices = 10000; default: as the file is
//! ease_mm = 10.0                               # room around the body; default: none
//! flare = { below_m = 0.8, times = 1.6 }       # wider towards the hem; default: not
//! attach = [{ loop_near = "Neck" }]            # or near + within_m, or vertices
//!
//! [garment.material]                           # SI; each has a default
//! density = 0.2
//!
//! [garment.regions]                            # default: none; the same forms as attach
//! hood = [{ near = "Head", within_m = 0.2 }]
//!
//! [exploration]                                # each has a default
//! tolerance_mm = 10.0
//! ```
//!
//! `[simulator]` with `command` and `timeout_s` names a program: [`crate::pipe`].
//! `[exploration.metric]` and `[[exploration.class]]`: see `import::metric`.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use cloth::{Vec3, fabrics};
use protocol::limits::NAME_BYTES_MAX;
use serde::Deserialize;

use super::compute::Density;
use super::ease::{Ease, FlareTable};
use super::garment::Attachment;
use super::metric::{ClassTable, MetricTable};
use crate::pipe::Foreign;
use crate::scene::{ExplorationSettings, Fabric};

/// Longest way from the rest pose to the start pose (frames).
const DRAPE_FRAMES_MAX: f32 = 10_000.0;
/// Layers that a garment may have.
pub const LAYERS_MAX: usize = 16;
/// Frames per second that a scene may have.
pub const FPS: [f32; 2] = [5.0, 240.0];

/// Why a scene file was refused, without the file's name.
#[derive(Debug, Clone, PartialEq, Eq, thiserror::Error)]
#[non_exhaustive]
pub enum SceneFileError {
    /// TOML that cannot be read, or a key that is unknown, missing or of another type.
    #[error("{0}")]
    Toml(String),
    /// More than one garment.
    #[error("[garment] is given {0} times; a scene has exactly one garment: keep one")]
    Garments(usize),
    /// A value.
    #[error("{key}: {problem}")]
    Value {
        /// Where.
        key: String,
        /// What is wrong and what to do.
        problem: String,
    },
}

/// A scene as written.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SceneFile {
    /// Name of the scene.
    pub name: String,
    /// Frames per second.
    #[serde(default = "default_fps")]
    pub fps: f32,
    /// Where exploration starts.
    pub start: Option<StartTable>,
    /// The character.
    pub character: CharacterTable,
    /// Its motion graph.
    pub motion_graph: MotionGraphTable,
    garment: OneOrMany,
    /// How far to explore.
    #[serde(default)]
    pub exploration: ExplorationTable,
    simulator: Option<SimulatorTable>,
}

/// A program that simulates.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct SimulatorTable {
    command: Vec<String>,
    timeout_s: Option<f32>,
}

/// A frame of a clip.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct StartTable {
    /// Name of the clip.
    pub clip: String,
    /// Frame of it.
    pub frame: u32,
}

/// The character's files.
#[derive(Debug, Clone, PartialEq, Eq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CharacterTable {
    /// glTF or GLB: the skinned body, and its animations.
    pub file: String,
    /// BVH files of the same skeleton, retargeted by joint names; clips are called like the
    /// files and replace animations of that name.
    #[serde(default)]
    pub clips: Vec<String>,
}

/// The motion graph: a file, or computed.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MotionGraphTable {
    /// JSON.
    pub file: Option<String>,
    /// Take every local minimum of the distance below this (m).
    pub threshold_m: Option<f32>,
    /// Take as few local minima as bring the median time to reach a clip below this (s).
    pub reach_s: Option<f32>,
    /// The clips that `reach_s` speaks of; none: all.
    #[serde(default)]
    pub reach_clips: Vec<String>,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(untagged)]
enum OneOrMany {
    One(toml::Table),
    Many(Vec<toml::Table>),
}

/// The garment.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct GarmentTable {
    /// OBJ, glTF or GLB, in the character's rest pose ...
    pub file: Option<String>,
    /// ... or the name of a piece that is made for the character (see [`crate::tailor`]) ...
    pub made: Option<String>,
    /// ... or several of these, worn over each other, the innermost first.
    #[serde(default)]
    pub layers: Vec<LayerTable>,
    /// Name in the world.
    pub name: Option<String>,
    /// Longest edge after refinement (m).
    pub edge_length_m: Option<f32>,
    /// Number of vertices after refinement, exactly; in place of `edge_length_m`.
    pub vertices: Option<usize>,
    /// Room around the body: way outwards of all that is not held, where read from a file (mm).
    pub ease_mm: Option<f32>,
    /// Widening towards the hem, where read from a file.
    pub flare: Option<FlareTable>,
    /// What is held to the body.
    #[serde(default)]
    pub attach: Vec<AttachTable>,
    /// Parts of it that metric and classes name.
    #[serde(default)]
    pub regions: BTreeMap<String, Vec<AttachTable>>,
    /// The cloth.
    #[serde(default)]
    pub material: MaterialTable,
}

/// A layer of a garment.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct LayerTable {
    /// OBJ, glTF or GLB, in the character's rest pose ...
    pub file: Option<String>,
    /// ... or the name of a piece that is made for the character.
    pub made: Option<String>,
    /// What is held to the body.
    #[serde(default)]
    pub attach: Vec<AttachTable>,
}

/// One of `loop_near`, `near` with `within_m` (and `offset_m`), `vertices`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct AttachTable {
    /// The boundary loop nearest to this joint.
    pub loop_near: Option<String>,
    /// Vertices near this joint ...
    pub near: Option<String>,
    /// ... within so many metres.
    pub within_m: Option<f32>,
    /// The middle lies so far from the joint (m), in the rest pose; default: at the joint.
    pub offset_m: Option<[f32; 3]>,
    /// Vertices of the file, from 0.
    pub vertices: Option<Vec<u32>>,
}

/// [`Fabric`], all optional, same units.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MaterialTable {
    /// A measured fabric's name; the other keys change it.
    fabric: Option<String>,
    density: Option<f32>,
    stretch: Option<f32>,
    weft: Option<f32>,
    shear: Option<f32>,
    bend: Option<f32>,
    friction: Option<f32>,
    drag: Option<f32>,
    damping_s: Option<f32>,
    offset: Option<f32>,
}

/// [`ExplorationSettings`], all optional, the tolerance in millimetres.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ExplorationTable {
    velocity_time_s: Option<f32>,
    tolerance_mm: Option<f32>,
    depth_frames: Option<u32>,
    round_jobs: Option<u32>,
    publish_every_frames: Option<u64>,
    drape_frames: Option<u32>,
    rank_max: Option<u16>,
    ground: Option<bool>,
    self_contact: Option<bool>,
    /// How states are compared.
    #[serde(default)]
    pub metric: MetricTable,
    /// Classes of states.
    #[serde(default)]
    pub class: Vec<ClassTable>,
}

/// Where a scene's transitions come from.
#[derive(Debug, Clone, PartialEq)]
pub enum MotionSource {
    /// A JSON file, as written.
    File(String),
    /// Computed from the clips.
    Computed(Density),
}

impl SceneFile {
    /// Reads the TOML and checks every value that needs no other file.
    ///
    /// # Errors
    /// Line and key of what is wrong, and what to do.
    pub fn parse(text: &str) -> Result<Self, SceneFileError> {
        let tables = text.lines().filter(|l| l.trim().starts_with("[garment]")).count();
        if tables > 1 {
            return Err(SceneFileError::Garments(tables));
        }
        let file: Self = toml::from_str(text)
            .map_err(|e| SceneFileError::Toml(e.to_string().trim_end().to_owned()))?;
        if let OneOrMany::Many(all) = &file.garment
            && all.len() != 1
        {
            return Err(SceneFileError::Garments(all.len()));
        }
        in_range("fps", file.fps, FPS)?;
        named("name", &file.name)?;
        let garment = file.garment()?;
        named("garment.name", garment.name.as_ref().unwrap_or(&file.name))?;
        file.motion_source()?;
        file.simulator(PathBuf::new())?;
        file.exploration()?;
        Ok(file)
    }

    /// The garment.
    ///
    /// # Errors
    /// An unknown or missing key, or a value out of range.
    pub fn garment(&self) -> Result<GarmentTable, SceneFileError> {
        let table = match &self.garment {
            OneOrMany::One(table) => table.clone(),
            OneOrMany::Many(all) => all.first().cloned().unwrap_or_default(),
        };
        let garment: GarmentTable = table
            .try_into()
            .map_err(|e: toml::de::Error| value("[garment]", e.to_string().trim_end()))?;
        garment.fabric()?;
        if garment.vertices.is_some() && garment.edge_length_m.is_some() {
            return Err(value("garment", "give edge_length_m or vertices, not both"));
        }
        garment.pieces()?;
        garment.ease().check().map_err(|(key, problem)| value(key, &problem))?;
        Ok(garment)
    }

    /// The program that simulates, if one is named; it runs in `folder`.
    ///
    /// # Errors
    /// No command, or a value out of range.
    pub fn simulator(&self, folder: PathBuf) -> Result<Option<Foreign>, SceneFileError> {
        let Some(table) = &self.simulator else { return Ok(None) };
        if table.command.is_empty() {
            return Err(value("simulator.command", "give the program and its arguments"));
        }
        let timeout_s = table.timeout_s.unwrap_or(60.0);
        in_range("simulator.timeout_s", timeout_s, [0.01, 1e5])?;
        Ok(Some(Foreign { command: table.command.clone(), folder, timeout_s }))
    }

    /// Where transitions come from.
    ///
    /// # Errors
    /// None or several of the three keys, or a value out of range.
    pub fn motion_source(&self) -> Result<MotionSource, SceneFileError> {
        let table = &self.motion_graph;
        match (&table.file, table.threshold_m, table.reach_s) {
            (Some(file), None, None) => Ok(MotionSource::File(file.clone())),
            (None, Some(threshold_m), None) => {
                in_range("motion_graph.threshold_m", threshold_m, [1e-3, 10.0])?;
                Ok(MotionSource::Computed(Density::Threshold(threshold_m)))
            }
            (None, None, Some(reach_s)) => {
                in_range("motion_graph.reach_s", reach_s, [0.1, 1e4])?;
                Ok(MotionSource::Computed(Density::Reach(reach_s)))
            }
            _ => Err(value("motion_graph", "give exactly one of file, threshold_m, reach_s")),
        }
    }

    /// Exploration settings with defaults filled in.
    ///
    /// # Errors
    /// A value out of range.
    pub fn exploration(&self) -> Result<ExplorationSettings, SceneFileError> {
        let (t, default) = (&self.exploration, ExplorationSettings::default());
        if let Some(mm) = t.tolerance_mm {
            in_range("exploration.tolerance_mm", mm, [0.0, 1e4])?;
        }
        if let Some(s) = t.velocity_time_s {
            in_range("exploration.velocity_time_s", s, [0.0, 10.0])?;
        }
        let counts = [
            ("depth_frames", t.depth_frames.map(u64::from)),
            ("round_jobs", t.round_jobs.map(u64::from)),
            ("publish_every_frames", t.publish_every_frames),
            ("rank_max", t.rank_max.map(u64::from)),
        ];
        if let Some((key, _)) = counts.iter().find(|(_, count)| *count == Some(0)) {
            return Err(value(&format!("exploration.{key}"), "must be at least 1"));
        }
        if let Some(frames) = t.drape_frames {
            in_range("exploration.drape_frames", frames as f32, [1.0, DRAPE_FRAMES_MAX])?;
        }
        Ok(ExplorationSettings {
            velocity_time_s: t.velocity_time_s.unwrap_or(default.velocity_time_s),
            tolerance_m: t.tolerance_mm.map_or(default.tolerance_m, |mm| mm * 1e-3),
            depth_frames: t.depth_frames.unwrap_or(default.depth_frames),
            round_jobs: t.round_jobs.unwrap_or(default.round_jobs),
            publish_every_frames: t.publish_every_frames.unwrap_or(default.publish_every_frames),
            drape_frames: t.drape_frames.unwrap_or(default.drape_frames),
            rank_max: t.rank_max.unwrap_or(default.rank_max),
            ground: t.ground.unwrap_or(default.ground),
            self_contact: t.self_contact.unwrap_or(default.self_contact),
        })
    }
}

impl GarmentTable {
    /// The material with defaults filled in.
    ///
    /// # Errors
    /// A value out of range.
    pub fn fabric(&self) -> Result<Fabric, SceneFileError> {
        let m = &self.material;
        let default = match &m.fabric {
            None => Fabric::default(),
            Some(name) => fabrics::find(name).map(fabrics::Fabric::material).ok_or_else(|| {
                let known = fabrics::names();
                value("garment.material.fabric", &format!("there is no `{name}`; give {known}"))
            })?,
        };
        let field = |key: &str, given: Option<f32>, default: f32, range: [f32; 2]| {
            let number = given.unwrap_or(default);
            in_range(&format!("garment.material.{key}"), number, range)?;
            Ok::<f32, SceneFileError>(number)
        };
        Ok(Fabric {
            density: field("density", m.density, default.density, [1e-3, 100.0])?,
            stretch: field("stretch", m.stretch, default.stretch, [1e-3, 1e7])?,
            weft: match m.weft {
                Some(weft) => Some(field("weft", m.weft, weft, [1e-3, 1e7])?),
                None => default.weft,
            },
            shear: field("shear", m.shear, default.shear, [0.0, 1e7])?,
            bend: field("bend", m.bend, default.bend, [0.0, 1.0])?,
            friction: field("friction", m.friction, default.friction, [0.0, 10.0])?,
            drag: field("drag", m.drag, default.drag, [0.0, 100.0])?,
            damping_s: field("damping_s", m.damping_s, default.damping_s, [0.0, 1.0])?,
            offset: field("offset", m.offset, default.offset, [0.0, 0.1])?,
        })
    }

    /// How the innermost layer is let out.
    pub fn ease(&self) -> Ease {
        Ease { ease_mm: self.ease_mm, flare: self.flare }
    }

    /// The layers, the innermost first; a garment of one piece has one.
    ///
    /// # Errors
    /// None or several of `file`, `made`, `layers`; an attachment of no kind.
    pub fn pieces(&self) -> Result<Vec<LayerTable>, SceneFileError> {
        let single = LayerTable {
            file: self.file.clone(),
            made: self.made.clone(),
            attach: self.attach.clone(),
        };
        let pieces = match (&self.file, &self.made, self.layers.is_empty()) {
            (Some(_), None, true) | (None, Some(_), true) => vec![single],
            (None, None, false) if self.attach.is_empty() => self.layers.clone(),
            (None, None, false) => {
                return Err(value("garment.attach", "give each of the layers its own"));
            }
            _ => return Err(value("[garment]", "give exactly one of file, made and layers")),
        };
        if pieces.len() > LAYERS_MAX {
            return Err(value("garment.layers", &format!("at most {LAYERS_MAX} are possible")));
        }
        for (index, piece) in pieces.iter().enumerate() {
            if piece.file.is_some() == piece.made.is_some() {
                let key = format!("garment.layers[{index}]");
                return Err(value(&key, "give exactly one of file and made"));
            }
            attachments("garment.attach", &piece.attach)?;
        }
        Ok(pieces)
    }

    /// Attachments, each of one kind.
    ///
    /// # Errors
    /// None or several kinds in one entry.
    pub fn attachments(&self) -> Result<Vec<Attachment>, SceneFileError> {
        attachments("garment.attach", &self.attach)
    }
}

/// Entries of `attach`, or of a region, each of one kind.
///
/// # Errors
/// None or several kinds in one entry; `key` names the list.
pub(super) fn attachments(
    key: &str,
    list: &[AttachTable],
) -> Result<Vec<Attachment>, SceneFileError> {
    let one = |(index, a): (usize, &AttachTable)| match a {
        AttachTable {
            loop_near: Some(joint),
            near: None,
            within_m: None,
            offset_m: None,
            vertices: None,
        } => Ok(Attachment::Loop { joint: joint.clone() }),
        AttachTable {
            loop_near: None,
            near: Some(joint),
            within_m: Some(within_m),
            offset_m,
            vertices: None,
        } => {
            let offset = Vec3::from_array(offset_m.unwrap_or_default());
            Ok(Attachment::Near { joint: joint.clone(), offset, within_m: *within_m })
        }
        AttachTable {
            loop_near: None,
            near: None,
            within_m: None,
            offset_m: None,
            vertices: Some(v),
        } => Ok(Attachment::Vertices(v.clone())),
        _ => Err(value(
            &format!("{key}[{index}]"),
            "give loop_near, or near with within_m (and offset_m), or vertices",
        )),
    };
    list.iter().enumerate().map(one).collect()
}

/// A path as written: relative to the scene's folder, or below the data folder.
///
/// # Errors
/// `$TOILE_DATA` where no data folder is known.
pub fn resolve_path(
    key: &str,
    written: &str,
    folder: &Path,
    data: Option<&Path>,
) -> Result<PathBuf, SceneFileError> {
    match written.strip_prefix("$TOILE_DATA") {
        None => Ok(folder.join(written)),
        Some(rest) => {
            let data = data.ok_or_else(|| {
                let text = "the data folder is not known; set TOILE_DATA to the folder that holds \
                            character.glb";
                value(key, text)
            })?;
            Ok(data.join(rest.trim_start_matches('/')))
        }
    }
}

fn default_fps() -> f32 {
    30.0
}

pub(super) fn value(key: &str, problem: &str) -> SceneFileError {
    SceneFileError::Value { key: key.to_owned(), problem: problem.to_owned() }
}

pub(super) fn named(key: &str, name: &str) -> Result<(), SceneFileError> {
    if (1..=NAME_BYTES_MAX).contains(&name.len()) {
        Ok(())
    } else {
        Err(value(key, &format!("give 1 to {NAME_BYTES_MAX} bytes")))
    }
}

pub(super) fn in_range(
    key: &str,
    number: f32,
    [low, high]: [f32; 2],
) -> Result<(), SceneFileError> {
    if (low..=high).contains(&number) {
        Ok(())
    } else {
        Err(value(key, &format!("{number} is out of range; give {low} to {high}")))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn fabric_of(material: &str) -> Result<Fabric, SceneFileError> {
        let text = format!(
            "name = \"a\"\n[character]\nfile = \"a.glb\"\n[motion_graph]\nfile = \"a.json\"\n\
             [garment]\nfile = \"a.obj\"\n[garment.material]\n{material}"
        );
        SceneFile::parse(&text)?.garment()?.fabric()
    }

    #[test]
    fn a_fabric_is_named_and_changed_key_by_key() {
        let denim = fabrics::find("denim").unwrap().material();
        assert_eq!(fabric_of("fabric = \"denim\"").unwrap(), denim);
        let thin = fabric_of("fabric = \"Denim\"\ndensity = 0.1").unwrap();
        assert_eq!(thin, Fabric { density: 0.1, ..denim });
        assert_eq!(fabric_of("").unwrap(), Fabric::default());
        let error = fabric_of("fabric = \"velvet\"").unwrap_err().to_string();
        assert!(error.contains("velvet") && error.contains("rib-knit"), "{error}");
    }
}
