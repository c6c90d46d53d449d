//! What a scene file says about comparing states, beside the velocity time scale.
//!
//! ```toml
//! [exploration.metric]
//! norm = "largest"                              # or "rms"
//! weights = [{ region = "hood", weight = 2.0 }] # default: 1 everywhere; later entries win
//!
//! [[exploration.class]]
//! name = "hood"
//! region = "hood"                               # of [garment.regions]
//! joint = "Head"
//! axis = [0.0, 1.0, 0.0]                        # in the axes of the rest pose, carried by the joint
//! threshold_m = 0.05                            # of the region's mean place along it
//! values = ["down", "up"]                       # below and above
//! implausible = ["down", "up"]                  # a merge from down into up ...
//! penalty_mm = 1000.0                           # ... costs this in the queue
//! ```

use std::collections::BTreeMap;

use cloth::{Skeleton, Vec3};
use serde::Deserialize;

use super::garment::Surface;
use super::scene_file::{GarmentTable, SceneFile, SceneFileError, in_range, named, value};
use crate::scene::{CLASS_RULES_MAX, ClassRule, MetricSettings, Norm};

/// `[exploration.metric]`.
#[derive(Debug, Clone, Default, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct MetricTable {
    norm: Option<NormTable>,
    #[serde(default)]
    weights: Vec<WeightTable>,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
enum NormTable {
    Largest,
    Rms,
}

#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
struct WeightTable {
    region: String,
    weight: f32,
}

/// One `[[exploration.class]]`.
#[derive(Debug, Clone, PartialEq, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ClassTable {
    name: String,
    region: String,
    joint: String,
    axis: [f32; 3],
    threshold_m: f32,
    values: [String; 2],
    implausible: [String; 2],
    penalty_mm: f32,
}

type Regions = BTreeMap<String, Vec<u32>>;

/// The metric of a scene: names become vertices and joints of the refined garment.
///
/// # Errors
/// A region, joint or value that is not there, or a number out of range.
pub(super) fn resolve(
    file: &SceneFile,
    garment: &GarmentTable,
    (surface, file_vertices): (&Surface, usize),
    skeleton: &Skeleton,
) -> Result<MetricSettings, SceneFileError> {
    let mut regions = Regions::new();
    for (name, list) in &garment.regions {
        let key = format!("garment.regions.{name}");
        let list = super::scene_file::attachments(&key, list)?;
        let vertices = surface.attach(&list, skeleton, file_vertices);
        regions.insert(name.clone(), vertices.map_err(|e| value(&key, &e.to_string()))?);
    }
    let table = &file.exploration.metric;
    let norm = match table.norm {
        None | Some(NormTable::Largest) => Norm::Largest,
        Some(NormTable::Rms) => Norm::Rms,
    };
    let weights = weights(&table.weights, &regions, surface.positions.len())?;
    let tables = &file.exploration.class;
    if tables.len() > CLASS_RULES_MAX {
        let text = format!("given {} times; at most {CLASS_RULES_MAX}", tables.len());
        return Err(value("exploration.class", &text));
    }
    let class = |(index, table)| class(index, table, &regions, skeleton);
    let classes = tables.iter().enumerate().map(class).collect::<Result<_, _>>()?;
    Ok(MetricSettings { norm, weights, classes })
}

fn weights(
    tables: &[WeightTable],
    regions: &Regions,
    vertices: usize,
) -> Result<Vec<f32>, SceneFileError> {
    if tables.is_empty() {
        return Ok(Vec::new());
    }
    let mut weights = vec![1.0; vertices];
    for (index, table) in tables.iter().enumerate() {
        let key = format!("exploration.metric.weights[{index}]");
        in_range(&format!("{key}.weight"), table.weight, [0.0, 1e3])?;
        for vertex in region(&key, &table.region, regions)? {
            weights[*vertex as usize] = table.weight;
        }
    }
    Ok(weights)
}

fn region<'a>(key: &str, name: &str, regions: &'a Regions) -> Result<&'a [u32], SceneFileError> {
    let known = || regions.keys().cloned().collect::<Vec<_>>().join(", ");
    match regions.get(name) {
        Some(vertices) if !vertices.is_empty() => Ok(vertices),
        Some(_) => Err(value(key, &format!("region {name:?} has no vertex; make it larger"))),
        None => {
            let text = format!("there is no region {name:?} in [garment.regions] ({})", known());
            Err(value(key, &text))
        }
    }
}

fn class(
    index: usize,
    table: &ClassTable,
    regions: &Regions,
    skeleton: &Skeleton,
) -> Result<ClassRule, SceneFileError> {
    let key = |name: &str| format!("exploration.class[{index}].{name}");
    named(&key("name"), &table.name)?;
    let joint = skeleton.joint(&table.joint).ok_or_else(|| {
        let text = format!("the skeleton has no joint {:?}", table.joint);
        value(&key("joint"), &text)
    })?;
    let axis = Vec3::from_array(table.axis);
    in_range(&key("axis"), axis.length(), [1e-3, 1e3])?;
    in_range(&key("threshold_m"), table.threshold_m, [-10.0, 10.0])?;
    in_range(&key("penalty_mm"), table.penalty_mm, [0.0, 1e6])?;
    let place = |name: &String| {
        let found = table.values.iter().position(|v| v == name).map(|place| place as u8);
        found.ok_or_else(|| {
            let text = format!("{name:?} is none of the values {:?}", table.values);
            value(&key("implausible"), &text)
        })
    };
    let [from, to] = &table.implausible;
    let implausible = [place(from)?, place(to)?];
    if implausible[0] == implausible[1] {
        return Err(value(&key("implausible"), "give two different values"));
    }
    Ok(ClassRule {
        name: table.name.clone(),
        values: table.values.clone(),
        joint: joint as u16,
        vertices: region(&key("region"), &table.region, regions)?.to_vec(),
        axis: axis.normalize(),
        threshold_m: table.threshold_m,
        implausible,
        penalty_m: table.penalty_mm * 1e-3,
    })
}
