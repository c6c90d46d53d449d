//! Mirrored frames: a cloth that is the same seen in a mirror has been shown twice as much.
//!
//! Where a reflection of the rest shape takes each vertex of both meshes to a vertex, and pins to
//! pins, every training frame has a twin in which left and right are exchanged: what an operator
//! that treats all axes alike learns from it is what it learns from the same frame with its vertices
//! exchanged. A turn to one side then teaches the other one too.

use cloth::Vec3;

use super::data::Frames;
use super::patch::Patch;
use super::scene::Scene;

/// Largest distance of a mirrored vertex from its twin (m).
const APART_M: f32 = 1e-4;

/// For each vertex its twin.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Mirror {
    /// Of the coarse mesh.
    pub coarse: Vec<usize>,
    /// Of the fine mesh.
    pub fine: Vec<usize>,
}

impl Mirror {
    /// Of a scene whose meshes are the same on both sides of the plane x = 0; `None` for another.
    pub fn of(scene: &Scene) -> Option<Self> {
        Some(Self { coarse: twins(&scene.coarse)?, fine: twins(&scene.fine)? })
    }

    /// Frames, each followed by its twin.
    pub fn both(&self, frames: &Frames) -> Frames {
        frames.with_rows_of(&self.coarse, &self.fine)
    }
}

fn twins(patch: &Patch) -> Option<Vec<usize>> {
    let points = patch.mesh.rest_positions();
    // Those of nearly the same height alone are compared.
    let mut order: Vec<usize> = (0..points.len()).collect();
    order.sort_by(|a, b| points[*a].y.total_cmp(&points[*b].y).then(a.cmp(b)));
    let twin = |p: &Vec3| {
        let goal = *p * Vec3::new(-1.0, 1.0, 1.0);
        let first = order.partition_point(|v| points[*v].y < goal.y - APART_M);
        let near = order[first..].iter().take_while(|v| points[**v].y <= goal.y + APART_M);
        near.copied().find(|v| points[*v].distance(goal) <= APART_M)
    };
    let twins: Option<Vec<usize>> = points.iter().map(twin).collect();
    let held = |v: usize| patch.pins.binary_search(&(v as u32)).is_ok();
    twins.filter(|twins| twins.iter().enumerate().all(|(v, t)| held(v) == held(*t)))
}

#[cfg(test)]
mod tests {
    use super::*;
    use faer::Mat;

    #[test]
    fn a_curtain_has_a_mirror_and_a_flag_has_none() {
        assert!(Mirror::of(&Scene::named("flag").unwrap()).is_none(), "its pole is on one side");
        let scene = Scene::named("curtain").unwrap();
        let mirror = Mirror::of(&scene).unwrap();
        for twins in [&mirror.coarse, &mirror.fine] {
            assert!(twins.iter().enumerate().all(|(v, t)| twins[*t] == v), "twice is none");
            assert!(twins.iter().enumerate().filter(|(v, t)| v == *t).count() <= 71);
        }
    }

    #[test]
    fn twins_follow_their_frames() {
        let frames = Frames {
            coarse: Mat::from_fn(2, 3, |i, c| (10 * i + c) as f64),
            fine: Mat::from_fn(3, 3, |i, c| (10 * i + c) as f32),
            points: 2,
            middles: vec![1.0, 2.0, 3.0],
        };
        let mirror = Mirror { coarse: vec![1, 0], fine: vec![2, 1, 0] };
        let both = mirror.both(&frames);
        assert_eq!((both.count(), both.middles.len()), (2, 6));
        assert_eq!((both.coarse[(0, 4)], both.coarse[(1, 4)]), (11.0, 1.0));
        assert_eq!((both.fine[(0, 5)], both.fine[(1, 5)], both.fine[(2, 5)]), (22.0, 12.0, 2.0));
        let again = mirror.both(&both);
        assert_eq!(again.count(), 4);
        assert_eq!((again.coarse[(0, 1)], again.coarse[(0, 10)]), (1.0, 1.0), "twins of twins");
        assert_eq!((again.coarse[(0, 3)], again.coarse[(0, 6)]), (10.0, 10.0));
    }
}
