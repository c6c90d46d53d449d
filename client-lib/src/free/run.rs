//! One character's cloth outside the graph, frame after frame.

use std::sync::Arc;

use cloth::coarse::{Input, Moving, Tether};
use cloth::{Pose, Rigid, State, Vec3};
use codec::upsample::{Drive, Held, Transform};

use super::draw::Draw;
use super::{Forces, Upsampled, transform};
use crate::blend::BLEND_FRAMES;
use crate::placement::Placement;
use crate::scene::Scene;

/// What is kept while a character is outside; its memory is kept after that.
#[derive(Debug, Default)]
pub(crate) struct Run {
    /// What it runs; `None` in the graph.
    pub(crate) upsampled: Option<Arc<Upsampled>>,
    /// Frames since it left.
    pub(crate) frames: u32,
    /// Fine positions (m) shown in this frame and the one before, each in its own state frame.
    pub(crate) now: Vec<f32>,
    pub(crate) before: Vec<f32>,
    /// Which of the two are shown.
    pub(crate) shows_now: bool,
    pub(crate) shows_before: bool,
    /// By row (m), in the state frame: the cloth at leaving less what the upsampler makes of it.
    residual: Vec<f32>,
    /// Coarse cloth in the world.
    state: State,
    /// What leads it back to the graph.
    pub(crate) draw: Draw,
    scratch: Scratch,
}

#[derive(Debug, Default)]
struct Scratch {
    coarse: cloth::coarse::Workspace,
    fine: codec::upsample::Workspace,
    poses: [Option<Pose>; 3],
    joints: Vec<Rigid>,
    joints_before: Vec<Rigid>,
    transforms: Vec<Transform>,
    pins_m: Vec<[f32; 3]>,
    pins: Vec<Vec3>,
    capsules: Vec<Moving>,
    held: Vec<Held>,
    tethers: Vec<Tether>,
    /// By tether, what the cloth at leaving was beyond its reach and its floor (m).
    slack: Vec<[f32; 2]>,
    pushes: Vec<Vec3>,
    coarse_m: Vec<f32>,
}

/// The way of a character during a frame.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Way<'a> {
    pub(crate) scene: &'a Scene,
    pub(crate) from: &'a Placement,
    pub(crate) to: &'a Placement,
}

impl Run {
    /// Whether it is outside.
    pub(crate) fn is_on(&self) -> bool {
        self.upsampled.is_some()
    }

    /// A new frame begins.
    pub(crate) fn begin_frame(&mut self) {
        self.shows_before = std::mem::take(&mut self.shows_now);
        if self.shows_before {
            std::mem::swap(&mut self.before, &mut self.now);
        }
    }

    /// Ends it at once.
    pub(crate) fn stop(&mut self) {
        self.upsampled = None;
        (self.shows_now, self.shows_before) = (false, false);
    }

    /// Takes over the cloth in `self.now`, and its velocity from that in `self.before`, each in the
    /// state frame of its placement. `false`, and nothing changed, where it cannot.
    pub(crate) fn start(
        &mut self,
        upsampled: &Arc<Upsampled>,
        way: &Way<'_>,
        velocities: bool,
    ) -> bool {
        let rows = 3 * upsampled.upsampler.fine();
        let coarse = upsampled.upsampler.coarse();
        if self.now.len() != rows || self.before.len() != rows {
            return false;
        }
        let (hips, hips_before) = (way.to.hips(way.scene), way.from.hips(way.scene));
        let coarse_m = &mut self.scratch.coarse_m;
        coarse_m.resize(3 * coarse, 0.0);
        self.state.positions.clear();
        self.state.velocities.clear();
        for (rows, hips, out) in [
            (&self.before, &hips_before, &mut self.state.velocities),
            (&self.now, &hips, &mut self.state.positions),
        ] {
            if upsampled.upsampler.restrict(rows, coarse_m).is_err() {
                return false;
            }
            let (points, _) = coarse_m.as_chunks::<3>();
            out.extend(points.iter().map(|p| hips.point(Vec3::from_array(*p))));
        }
        let fps = way.scene.fps();
        for (v, x) in self.state.velocities.iter_mut().zip(&self.state.positions) {
            *v = if velocities { (*x - *v) * fps } else { Vec3::ZERO };
        }
        self.scratch.fine.reset();
        self.scratch.pose(way.scene, way.to, 1);
        self.scratch.place(way.scene, 1);
        self.residual.resize(rows, 0.0);
        self.before.copy_from_slice(&self.now);
        if !self.upsample(upsampled, &hips) {
            return false;
        }
        let s = &mut self.scratch;
        s.lead(upsampled, &Rigid::IDENTITY);
        s.slacken(upsampled, &self.state.positions);
        for ((out, shown), made) in self.residual.iter_mut().zip(&self.before).zip(&self.now) {
            *out = shown - made;
        }
        self.now.copy_from_slice(&self.before);
        self.upsampled = Some(Arc::clone(upsampled));
        self.frames = 0;
        self.draw.stop();
        self.shows_now = true;
        true
    }

    /// One frame on: coarse steps along the body's way, U, and what is left of the residual.
    /// `false` where the numbers leave what can be simulated.
    pub(crate) fn step(&mut self, way: &Way<'_>, forces: &mut Forces) -> bool {
        let Some(upsampled) = self.upsampled.take() else { return false };
        self.now.resize(3 * upsampled.upsampler.fine(), 0.0);
        let steps = upsampled.upsampler.parts().stepping.steps;
        let seconds = 1.0 / (way.scene.fps() * f32::from(steps));
        self.scratch.pose(way.scene, way.from, 0);
        self.scratch.pose(way.scene, way.to, 1);
        self.scratch.place(way.scene, 0);
        for step in 1..=steps {
            if !self.coarse_step(&upsampled, way.scene, (step, steps), seconds, forces) {
                return false;
            }
        }
        self.frames += 1;
        let wind = forces.wind.length();
        self.scratch.fine.advance(&upsampled.upsampler, 1.0 / way.scene.fps(), wind);
        forces.pass();
        let made = self.upsample(&upsampled, &way.to.hips(way.scene));
        let left = left(self.frames);
        if left > 0.0 {
            self.now.iter_mut().zip(&self.residual).for_each(|(x, r)| *x += left * r);
        }
        self.shows_now = true;
        self.upsampled = Some(upsampled);
        made
    }

    fn coarse_step(
        &mut self,
        upsampled: &Upsampled,
        scene: &Scene,
        (step, steps): (u8, u8),
        seconds: f32,
        forces: &Forces,
    ) -> bool {
        let s = &mut self.scratch;
        std::mem::swap(&mut s.joints, &mut s.joints_before);
        if step == steps {
            s.place(scene, 1);
        } else {
            s.between(f32::from(step) / f32::from(steps));
            s.place(scene, 2);
        }
        s.lead(upsampled, &Rigid::IDENTITY);
        s.pins.clear();
        s.pins.extend(s.pins_m.iter().map(|p| Vec3::from_array(*p)));
        s.capsules.clear();
        let moving = upsampled.upsampler.parts().capsules.iter().map(|capsule| {
            let at = |joints: &[Rigid]| {
                let joint = &joints[usize::from(capsule.joint)];
                let ends = capsule.ends.map(|end| joint.point(Vec3::from_array(end)));
                cloth::coarse::Capsule { ends, radius: capsule.radius }
            };
            Moving { from: at(&s.joints_before), to: at(&s.joints) }
        });
        s.capsules.extend(moving);
        s.hold(upsampled, left(self.frames));
        s.pushes.clear();
        if !forces.pushes.is_empty() {
            s.pushes.extend(self.state.positions.iter().map(|x| forces.acceleration(*x)));
        } else if self.draw.is_on() {
            s.pushes.resize(self.state.positions.len(), Vec3::ZERO);
            let begun = f32::from(step - 1) / f32::from(steps);
            let frame_s = seconds * f32::from(steps);
            let State { positions, velocities } = &self.state;
            self.draw.add((positions, velocities), begun, (frame_s, seconds), &mut s.pushes);
            self.draw.pass(seconds);
        }
        let body = !self.draw.passes_body();
        let input = Input {
            pins: &s.pins,
            colliders: if body { &s.capsules } else { &[] },
            wind: forces.wind,
            push: &s.pushes,
            tethers: if body { &s.tethers } else { &[] },
            seconds,
        };
        upsampled.coarse.step(&input, &mut self.state, &mut s.coarse).is_ok()
    }

    /// Fine positions of the coarse cloth into `self.now`, in the state frame at `hips`.
    fn upsample(&mut self, upsampled: &Upsampled, hips: &Rigid) -> bool {
        let to_frame = hips.inverse();
        let s = &mut self.scratch;
        s.coarse_m.clear();
        let points = self.state.positions.iter();
        s.coarse_m.extend(points.flat_map(|x| to_frame.point(*x).to_array()));
        s.lead(upsampled, &to_frame);
        let drive = Drive { coarse_m: &s.coarse_m, joints: &s.transforms };
        let upsampler = &upsampled.upsampler;
        upsampler.apply(&drive, &upsampled.faces, &mut s.fine, &mut self.now, &mut []).is_ok()
    }
}

impl Scratch {
    fn pose(&mut self, scene: &Scene, placement: &Placement, slot: usize) {
        let pose = self.poses[slot].get_or_insert_with(empty);
        placement.world_pose_into(scene, pose);
    }

    fn between(&mut self, t: f32) {
        let [from, to, between] = &mut self.poses;
        let (Some(from), Some(to)) = (from, to) else { return };
        between.get_or_insert_with(empty).interpolate_into(from, to, t);
    }

    /// Joints in the world of one of the poses.
    fn place(&mut self, scene: &Scene, slot: usize) {
        if let Some(pose) = &self.poses[slot] {
            scene.skeleton().world(pose, &mut self.joints);
        }
    }

    /// Transforms of the joints as they are, followed by `then`; and where they lead the pins.
    fn lead(&mut self, upsampled: &Upsampled, then: &Rigid) {
        self.transforms.clear();
        let joints = self.joints.iter().zip(&upsampled.to_joint);
        self.transforms.extend(joints.map(|(j, r)| transform(&then.after(&j.after(r)))));
        upsampled.upsampler.pins(&self.transforms, &mut self.pins_m);
        upsampled.upsampler.tethers(&self.transforms, &mut self.held);
    }

    /// How far the cloth at `positions` is beyond its tethers, which give way by this at first.
    fn slacken(&mut self, upsampled: &Upsampled, positions: &[Vec3]) {
        let tethers = upsampled.upsampler.parts().tethers.iter().zip(&self.held);
        self.slack.clear();
        self.slack.extend(tethers.map(|(t, held)| {
            let off = positions[usize::from(t.point)] - Vec3::from_array(held.at);
            let low = t.floor_m - Vec3::from_array(held.normal).dot(off);
            [(off.length() - t.reach_m).max(0.0), low.max(0.0)]
        }));
    }

    /// The tethers where the joints are; `left` of their slack is.
    fn hold(&mut self, upsampled: &Upsampled, left: f32) {
        let tethers = upsampled.upsampler.parts().tethers.iter().zip(&self.held);
        self.tethers.clear();
        self.tethers.extend(tethers.zip(&self.slack).map(|((t, held), [far, low])| Tether {
            point: t.point.into(),
            at: Vec3::from_array(held.at),
            reach_m: t.reach_m + left * far,
            normal: Vec3::from_array(held.normal),
            floor_m: t.floor_m - left * low,
        }));
    }
}

/// What is left, after so many frames, of what was there at leaving.
fn left(frames: u32) -> f32 {
    BLEND_FRAMES.saturating_sub(frames as usize) as f32 / BLEND_FRAMES as f32
}

fn empty() -> Pose {
    Pose { root: Vec3::ZERO, rotations: Vec::new() }
}
