//! What a page shows while there is no version yet: the character on its walk, the garment skinned to it.

use std::sync::Arc;

use client_lib::placement::{Placement, between};
use client_lib::{PoseId, Rigid, Scene};
use glam::Vec3;

use super::skinned::Skinned;
use super::wire::{self, Figure, FrameWriter};

/// A scene whose cloth is still being simulated.
#[derive(Debug)]
pub struct Bare {
    /// What is walked.
    pub scene: Arc<Scene>,
    triangles: Vec<[u32; 3]>,
    vertices: u32,
    skinned: Skinned,
}

impl Bare {
    /// Binds the garment to the body as both are in the rest pose; `None` where there is no body.
    pub fn new(scene: &explorer::scene::Scene) -> Option<Self> {
        let chunk = explorer::pack::scene_chunk::scene_chunk(scene);
        let garment = &scene.garment;
        let positions: Vec<f32> = garment.positions.iter().flat_map(Vec3::to_array).collect();
        let scene = Scene::new(chunk).ok()?;
        let rest = (&Rigid::IDENTITY, &scene.skeleton().rest[..]);
        let skinned = Skinned::bind(&scene, rest, &positions, &garment.triangles)?;
        Some(Self {
            scene: Arc::new(scene),
            triangles: garment.triangles.clone(),
            vertices: u32::try_from(garment.positions.len()).ok()?,
            skinned,
        })
    }

    /// Topology of body and garment, for the page.
    pub fn meshes(&self) -> Vec<u8> {
        wire::meshes(&self.scene, self.vertices, &self.triangles)
    }
}

/// A character without simulated cloth.
#[derive(Debug)]
pub struct StandIn {
    bare: Arc<Bare>,
    now: Placement,
    before: Placement,
    joints: Vec<Rigid>,
    positions: Vec<f32>,
}

impl StandIn {
    /// At the scene's first pose.
    pub fn new(bare: &Arc<Bare>) -> Self {
        let at = Placement::at(PoseId(0));
        let positions = vec![0.0; 3 * bare.vertices as usize];
        Self { bare: Arc::clone(bare), now: at, before: at, joints: Vec::new(), positions }
    }

    /// The pose of this frame.
    pub fn pose(&self) -> PoseId {
        self.now.pose()
    }

    /// Goes on to a pose; one that is no successor is jumped to.
    pub fn step(&mut self, next: PoseId) {
        let scene = &self.bare.scene;
        self.before = self.now;
        match scene.edge_between(self.now.pose(), next) {
            Some(edge) => self.now.walk(scene, edge),
            None => self.now.jump(scene, next),
        }
    }

    /// Writes body and skinned garment at `phase` between the last frame and this one.
    pub fn write(&mut self, phase: f32, writer: &mut FrameWriter) {
        let scene = &self.bare.scene;
        let placement = between(&self.before.hips(scene), &self.now.hips(scene), phase);
        let pose = self.before.world_pose(scene).interpolate(&self.now.world_pose(scene), phase);
        scene.skeleton().world(&pose, &mut self.joints);
        for (joint, rest) in self.joints.iter_mut().zip(&scene.skeleton().rest) {
            *joint = joint.after(&rest.inverse());
        }
        self.bare.skinned.positions(&placement, &self.joints, &mut self.positions);
        writer.add(&Figure {
            pane: 0,
            placement,
            positions: &self.positions,
            triangles: &self.bare.triangles,
            joints: &self.joints,
            distances: &[],
        });
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_garment_goes_where_the_body_goes() {
        let scene = crate::scene::load("robe").unwrap();
        let bare = Arc::new(Bare::new(&scene).unwrap());
        let mut stand_in = StandIn::new(&bare);
        let mut writer = FrameWriter::default();
        let mut furthest = 0.0f32;
        for _ in 0..90 {
            let walked = &bare.scene;
            let edge = walked.out_edges(stand_in.pose()).next().unwrap();
            stand_in.step(walked.edges()[edge.index()].to);
            writer.begin();
            stand_in.write(0.5, &mut writer);
            let words = writer.end();
            assert_eq!(words[4..8], 1u32.to_le_bytes());
            let (vertices, _) = stand_in.positions.as_chunks::<3>();
            let hips = |p: &[f32; 3]| Vec3::from_array(*p).length();
            let span = vertices.iter().map(hips).fold(0.0, f32::max);
            assert!((0.5..1.6).contains(&span), "{span} m from the hips");
            let place = stand_in.now.hips(walked).translation;
            furthest = furthest.max(place.with_y(0.0).length());
        }
        assert!(furthest > 0.5, "it walks: {furthest} m");
    }
}
