//! Dresses a character: reads or makes each layer of a garment, innermost first, and joins them to
//! one mesh.

use std::cell::OnceCell;
use std::collections::BTreeSet;
use std::path::PathBuf;

use super::character::Character;
use super::garment::{Attachment, GarmentError, Surface};
use super::scene_file::{GarmentTable, LayerTable, SceneFileError};
use super::{Place, SceneError, check, read, scene_file};
use crate::tailor::{self, Fineness, Form, Piece, sew};

/// Edges of a piece that is made, where the scene does not say (m).
const EDGE_M: f32 = 0.028;

/// A garment, put together.
pub(super) struct Dressed {
    pub surface: Surface,
    /// Layer of each vertex, the innermost 0; empty where there is one.
    pub layers: Vec<u8>,
    /// Vertices held to the body, ascending.
    pub attached: Vec<u32>,
    /// Vertices that can be named by index, from 0: the file's, or all.
    pub file_vertices: usize,
}

struct Layer {
    table: LayerTable,
    /// Where it comes from, for messages.
    path: PathBuf,
    /// As read; `None` where it is made.
    file: Option<Surface>,
    attach: Vec<Attachment>,
}

/// Dresses the character in a scene's garment, with exactly `vertices` where given.
pub(super) fn dress(
    table: &GarmentTable,
    vertices: Option<usize>,
    character: &Character,
    place: &Place<'_>,
) -> Result<Dressed, SceneError> {
    let pieces = table.pieces().map_err(|e| place.error(e))?;
    let layers: Vec<Layer> =
        pieces.iter().map(|piece| open(piece, place)).collect::<Result<_, _>>()?;
    let form = OnceCell::new();
    let wardrobe = Wardrobe { layers: &layers, table, character, form: &form };
    let counts = wardrobe.counts(vertices.or(table.vertices))?;
    let mut worn: Vec<Piece> = Vec::new();
    let mut all = Surface { positions: Vec::new(), triangles: Vec::new() };
    let (mut layer_of, mut attached) = (Vec::new(), BTreeSet::new());
    for (index, layer) in layers.iter().enumerate() {
        let count = counts.as_ref().map(|counts| counts[index]);
        let made = wardrobe.make(layer, &worn, count);
        let (surface, held) = made.map_err(|source| match source {
            // What is written in the scene file, not in the garment's.
            GarmentError::Attach { index, problem } => place
                .error(SceneFileError::Value { key: format!("garment.attach[{index}]"), problem }),
            source => layer.error(source),
        })?;
        let first = all.positions.len() as u32;
        attached.extend(held.iter().map(|v| v + first));
        all.positions.extend(&surface.positions);
        all.triangles.extend(surface.triangles.iter().map(|t| t.map(|v| v + first)));
        layer_of.resize(all.positions.len(), index as u8);
        worn.push(Piece { positions: surface.positions, triangles: surface.triangles });
    }
    if layers.len() == 1 {
        layer_of.clear();
    }
    let checked = check::check_garment(&character.body, &all.positions, &all.triangles);
    checked.map_err(|source| layers[0].error(source))?;
    let file_vertices = match &layers[..] {
        [Layer { file: Some(file), .. }] => file.positions.len(),
        _ => all.positions.len(),
    };
    let attached = attached.into_iter().collect();
    Ok(Dressed { surface: all, layers: layer_of, attached, file_vertices })
}

fn open(piece: &LayerTable, place: &Place<'_>) -> Result<Layer, SceneError> {
    let attach = scene_file::attachments("garment.attach", &piece.attach);
    let attach = attach.map_err(|e| place.error(e))?;
    let mut layer =
        Layer { table: piece.clone(), path: place.scene.to_owned(), file: None, attach };
    if let Some(written) = &piece.file {
        layer.path = place.resolve("garment.file", written)?;
        let bytes = read(&layer.path, "garment.file")?;
        let surface = Surface::read(&layer.path, &bytes).and_then(|surface| {
            check::check_mesh(&surface.positions, &surface.triangles)?;
            Ok(surface)
        });
        layer.file = Some(surface.map_err(|source| layer.error(source))?);
    }
    Ok(layer)
}

impl Layer {
    fn error(&self, source: GarmentError) -> SceneError {
        SceneError::Garment { path: self.path.clone(), source }
    }
}

struct Wardrobe<'a> {
    layers: &'a [Layer],
    table: &'a GarmentTable,
    character: &'a Character,
    form: &'a OnceCell<Form>,
}

impl Wardrobe<'_> {
    /// Measured once, and only where something is made or layered.
    fn form(&self) -> &Form {
        self.form.get_or_init(|| Form::new(&std::sync::Arc::new(self.character.body.clone())))
    }

    /// Vertices of each layer where the sum is asked for: by area, rounded, the last the rest.
    fn counts(&self, vertices: Option<usize>) -> Result<Option<Vec<usize>>, SceneError> {
        let Some(vertices) = vertices else { return Ok(None) };
        if self.layers.len() == 1 {
            return Ok(Some(vec![vertices]));
        }
        let mut worn: Vec<Piece> = Vec::new();
        for layer in self.layers {
            let made = self.make(layer, &worn, None);
            let (surface, _) = made.map_err(|source| layer.error(source))?;
            worn.push(Piece { positions: surface.positions, triangles: surface.triangles });
        }
        let areas: Vec<f32> = worn.iter().map(sew::area).collect();
        let all: f32 = areas.iter().sum();
        let mut counts: Vec<usize> =
            areas.iter().map(|a| (vertices as f32 * a / all).round() as usize).collect();
        let before: usize = counts[..counts.len() - 1].iter().sum();
        if let Some(last) = counts.last_mut() {
            *last = vertices.saturating_sub(before);
        }
        Ok(Some(counts))
    }

    /// Reads or makes a layer over what is worn; also says which of its vertices are held.
    fn make(
        &self,
        layer: &Layer,
        worn: &[Piece],
        vertices: Option<usize>,
    ) -> Result<(Surface, Vec<u32>), GarmentError> {
        let edge_m = self.table.edge_length_m;
        let mut surface = match (&layer.file, &layer.table.made) {
            (Some(file), _) => {
                let mut surface = file.clone();
                match (vertices, edge_m) {
                    (Some(vertices), _) => surface.refine_to(vertices)?,
                    (None, Some(edge_m)) => surface.refine(edge_m)?,
                    (None, None) => {}
                }
                surface
            }
            (None, made) => {
                let edge = Fineness::Edge(edge_m.unwrap_or(EDGE_M));
                let fineness = vertices.map_or(edge, Fineness::Vertices);
                let name = made.as_deref().unwrap_or_default();
                let piece = tailor::make(name, self.form(), worn, fineness)?;
                Surface { positions: piece.positions, triangles: piece.triangles }
            }
        };
        if layer.file.is_some() && !worn.is_empty() {
            let mut piece = Piece { positions: surface.positions, triangles: surface.triangles };
            sew::fit(&mut piece, self.form(), worn);
            surface = Surface { positions: piece.positions, triangles: piece.triangles };
        }
        let skeleton = &self.character.body.skeleton;
        let file_vertices =
            layer.file.as_ref().map_or(surface.positions.len(), |file| file.positions.len());
        let held = surface.attach(&layer.attach, skeleton, file_vertices)?;
        if layer.file.is_some() && worn.is_empty() {
            self.table.ease().apply(&mut surface, &held);
        }
        Ok((surface, held))
    }
}
