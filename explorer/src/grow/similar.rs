//! Finding the most similar state among many (the paper's FindMostSimilar).
//!
//! A few vertices of every state, spread over the garment, are kept in memory. A metric over some
//! of the vertices is never above the metric over all: candidates are looked at in the order of
//! this bound, and the search ends at the first whose bound is above what was found. So it returns
//! exactly what comparing with every candidate returns.

use std::io;
use std::path::Path;
use std::sync::{Mutex, MutexGuard, PoisonError};

use cloth::Vec3;
use protocol::StateId;

use super::class::{Class, Penalties};
use super::landmarks::{LANDMARK_BYTES_MAX, Pages, Row};
use super::metric::Metric;
use super::states::StateFile;
use crate::grid::GridState;
use crate::scene::Scene;

/// Vertices kept of every state: 288 bytes a state, in a file of which a part is in memory.
pub const LANDMARKS: usize = 24;

/// Everything a search needs.
#[derive(Debug)]
pub struct Similar {
    metric: Metric,
    few: Metric,
    penalties: Penalties,
    vertices: Vec<u32>,
    vertex_count: usize,
    file: Option<StateFile>,
    kept: Mutex<Kept>,
}

#[derive(Debug)]
struct Kept {
    pages: Pages,
    classes: Vec<Class>,
}

/// What was found.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Found<T> {
    /// The most similar state.
    pub target: T,
    /// The metric's distance to it (m).
    pub error_m: f32,
    /// Distance and the penalty for crossing classes (m): what was made smallest.
    pub cost_m: f32,
}

impl<T> Found<T> {
    /// The same with another name for the target.
    pub fn of<U>(&self, target: U) -> Found<U> {
        Found { target, error_m: self.error_m, cost_m: self.cost_m }
    }
}

impl Similar {
    /// Of a scene, without a state yet.
    pub fn new(scene: &Scene) -> Self {
        let metric = Metric::of_scene(scene);
        let vertices = spread(&scene.garment.positions, LANDMARKS);
        let pages = Pages::new(vertices.len(), 0, LANDMARK_BYTES_MAX);
        Self {
            few: metric.of_vertices(&vertices),
            metric,
            penalties: Penalties::new(&scene.metric.classes),
            vertex_count: scene.garment.positions.len(),
            vertices,
            file: None,
            kept: Mutex::new(Kept { pages, classes: Vec::new() }),
        }
    }

    /// Reads the landmarks of the states whose classes these are from the file at `path`, which is
    /// written anew where it is not whole; from now on additions are kept there.
    ///
    /// # Errors
    /// Neither the file nor the states can be read, or the file cannot be written.
    pub fn open(
        &mut self,
        path: &Path,
        digest: &[u8; 32],
        states: &StateFile,
        classes: Vec<Class>,
    ) -> io::Result<()> {
        let (count, size) = (classes.len() as u64, self.vertices.len() as u32);
        let file = match StateFile::open(path, size, digest, count) {
            Ok(file) => file,
            Err(_) => {
                let file = StateFile::create(path, size, digest)?;
                for id in (0..count).map(StateId) {
                    file.write_unsynced(id, &[self.cut(&states.read(id)?)])?;
                }
                file.sync()?;
                file
            }
        };
        self.file = Some(file);
        self.keep_all(classes);
        Ok(())
    }

    /// Knows the states whose classes these are; without a file their landmarks are cut from the states.
    pub fn keep_all(&mut self, classes: Vec<Class>) {
        let pages = Pages::new(self.vertices.len(), classes.len(), LANDMARK_BYTES_MAX);
        self.kept = Mutex::new(Kept { pages, classes });
    }

    /// Adds states, the first of them with the id `first`; on the disk when it returns.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn add(&self, first: StateId, states: &[GridState], classes: &[Class]) -> io::Result<()> {
        let few: Vec<GridState> = states.iter().map(|state| self.cut(state)).collect();
        if let Some(file) = &self.file {
            file.write(first, &few)?;
        }
        let mut kept = self.kept();
        kept.pages.add(first, &few);
        // What an attempt before left that was never recorded.
        kept.classes.truncate(first.index());
        kept.classes.extend_from_slice(classes);
        Ok(())
    }

    /// The metric.
    pub fn metric(&self) -> &Metric {
        &self.metric
    }

    /// The class of a state that was added.
    pub fn class(&self, state: StateId) -> Class {
        self.kept().classes[state.index()]
    }

    /// Bytes of memory that landmarks take: at most `LANDMARK_BYTES_MAX`, about.
    pub fn landmark_bytes(&self) -> usize {
        self.kept().pages.bytes()
    }

    fn kept(&self) -> MutexGuard<'_, Kept> {
        self.kept.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// What merges between classes cost.
    pub fn penalties(&self) -> &Penalties {
        &self.penalties
    }

    /// The candidate with the smallest distance plus penalty, if that is at most `bound_m`; of
    /// equals the lowest id.
    ///
    /// # Errors
    /// A candidate could not be read.
    pub fn nearest(
        &self,
        states: &StateFile,
        (state, class): (&GridState, Class),
        candidates: &[StateId],
        bound_m: f32,
    ) -> io::Result<Option<Found<StateId>>> {
        let mut order = self.order(states, (state, class), candidates, bound_m)?;
        order.sort_unstable_by(|a, b| a.0.total_cmp(&b.0).then(a.1.cmp(&b.1)));
        let mut best: Option<Found<StateId>> = None;
        for (least_m, candidate, penalty_m) in order {
            let bound_m = best.map_or(bound_m, |found| found.cost_m);
            if least_m > bound_m {
                break;
            }
            let other = states.read(candidate)?;
            let found = self.judge((state, &other), penalty_m, bound_m);
            let found = found.map(|(error_m, cost_m)| Found { target: candidate, error_m, cost_m });
            if let Some(found) =
                found.filter(|f| best.is_none_or(|b| (f.cost_m, f.target) < (b.cost_m, b.target)))
            {
                best = Some(found);
            }
        }
        Ok(best)
    }

    /// Error and cost (m) of merging the first state into the second, where the cost is at most
    /// `bound_m`.
    pub fn judge(
        &self,
        (from, to): (&GridState, &GridState),
        penalty_m: f32,
        bound_m: f32,
    ) -> Option<(f32, f32)> {
        // A sum rounds: the bound is taken generously here and held below.
        let room_m = (bound_m - penalty_m) * (1.0 + 1e-6) + 1e-6;
        let error_m = self.metric.distance_within(from, to, room_m)?;
        let cost_m = error_m + penalty_m;
        (cost_m <= bound_m).then_some((error_m, cost_m))
    }

    /// The least that merging could cost (m), from the landmarks.
    ///
    /// # Errors
    /// A state could not be read.
    pub fn least_cost(&self, states: &StateFile, from: StateId, to: StateId) -> io::Result<f32> {
        let mut kept = self.kept();
        let read = |first, count| self.read(states, first, count);
        let own = kept.pages.rows(from, &read)?.to_vec();
        let least_m = self.few.least_distance(&own, kept.pages.rows(to, &read)?, self.vertex_count);
        let classes = &kept.classes;
        Ok(least_m + self.penalties.of(classes[from.index()], classes[to.index()]))
    }

    /// Candidates with the least that each could cost, and its penalty (m), without those above
    /// the bound.
    fn order(
        &self,
        states: &StateFile,
        (state, class): (&GridState, Class),
        candidates: &[StateId],
        bound_m: f32,
    ) -> io::Result<Vec<(f32, StateId, f32)>> {
        let of = |v: &u32| row(state.positions[*v as usize], state.velocities[*v as usize]);
        let own: Vec<Row> = self.vertices.iter().map(of).collect();
        let read = |first, count| self.read(states, first, count);
        let mut kept = self.kept();
        let mut order = Vec::new();
        for &candidate in candidates {
            let penalty_m = self.penalties.of(class, kept.classes[candidate.index()]);
            let rows = kept.pages.rows(candidate, &read)?;
            let least_m = self.few.least_distance(&own, rows, self.vertex_count) + penalty_m;
            if least_m <= bound_m {
                order.push((least_m, candidate, penalty_m));
            }
        }
        Ok(order)
    }

    /// The landmarks of `count` states from an id on.
    fn read(&self, states: &StateFile, first: StateId, count: usize) -> io::Result<Vec<GridState>> {
        if let Some(file) = &self.file {
            return file.read_run(first, count);
        }
        let cut = |id: u64| states.read(StateId(id)).map(|state| self.cut(&state));
        (first.0..first.0 + count as u64).map(cut).collect()
    }

    fn cut(&self, state: &GridState) -> GridState {
        let of = |all: &[[i16; 3]]| self.vertices.iter().map(|v| all[*v as usize]).collect();
        GridState { positions: of(&state.positions), velocities: of(&state.velocities) }
    }
}

fn row([a, b, c]: [i16; 3], [d, e, f]: [i16; 3]) -> Row {
    [a, b, c, d, e, f]
}

/// Up to `count` vertices, each as far from those before it as can be: the garment's extremes,
/// where states differ most, come first.
fn spread(positions: &[Vec3], count: usize) -> Vec<u32> {
    let middle = positions.iter().sum::<Vec3>() / positions.len().max(1) as f32;
    let farthest = |far: &[f32]| {
        let best = far.iter().enumerate().max_by(|a, b| a.1.total_cmp(b.1).then(b.0.cmp(&a.0)));
        best.map(|(vertex, _)| vertex)
    };
    let mut far: Vec<f32> = positions.iter().map(|p| p.distance_squared(middle)).collect();
    let mut chosen = Vec::new();
    while chosen.len() < count.min(positions.len()) {
        let Some(next) = farthest(&far) else { break };
        chosen.push(next as u32);
        for (vertex, far) in far.iter_mut().enumerate() {
            let from = positions[vertex].distance_squared(positions[next]);
            *far = if chosen.len() == 1 { from } else { far.min(from) };
        }
        far[next] = -1.0;
    }
    chosen
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::grow::toy;
    use crate::scene::{ClassRule, Norm};

    fn scene(vertices: usize, rms: bool, classes: bool) -> Scene {
        let mut scene = toy::scene(toy::knot(), toy::settings());
        scene.garment.positions =
            (0..vertices).map(|v| Vec3::new(v as f32, (v * v % 17) as f32, 0.0)).collect();
        scene.metric.norm = if rms { Norm::Rms } else { Norm::Largest };
        scene.metric.weights = (0..vertices).map(|v| 0.5 + (v % 3) as f32).collect();
        if classes {
            scene.metric.classes.push(ClassRule {
                name: "side".into(),
                values: ["left".into(), "right".into()],
                joint: 0,
                vertices: vec![0],
                axis: Vec3::X,
                threshold_m: 0.0,
                implausible: [0, 1],
                penalty_m: 0.07,
            });
        }
        scene
    }

    fn states(vertices: usize) -> impl Strategy<Value = Vec<GridState>> {
        // Few values, so that equal distances occur.
        let row = proptest::array::uniform3(-2i16..3);
        let rows = proptest::collection::vec(row, 2 * vertices);
        let state = rows.prop_map(move |rows| GridState {
            positions: rows[..vertices].iter().map(|r| r.map(|c| c * 900)).collect(),
            velocities: rows[vertices..].to_vec(),
        });
        proptest::collection::vec(state, 2..25)
    }

    proptest! {
        #[test]
        fn finds_what_comparing_with_all_finds(
            all in states(40), rms in any::<bool>(), classes in any::<bool>(), share in 0.0f32..3.0,
        ) {
            let scene = scene(40, rms, classes);
            let classifier = crate::grow::class::Classifier::new(&scene);
            let class = |state: &GridState| classifier.class(protocol::PoseId(0), state);
            let folder = tempfile::tempdir().unwrap();
            let file = StateFile::create(&folder.path().join("states"), 40, &[0; 32]).unwrap();
            file.write(StateId(0), &all).unwrap();
            let mut similar = Similar::new(&scene);
            let path = folder.path().join("landmarks");
            let all_classes: Vec<Class> = all.iter().map(class).collect();
            similar.open(&path, &[0; 32], &file, all_classes[..1].to_vec()).unwrap();
            similar.add(StateId(1), &all[1..], &all_classes[1..]).unwrap();
            let own = &all[0];
            let candidates: Vec<StateId> = (1..all.len() as u64).map(StateId).collect();
            let cost = |id: &StateId| {
                let other = &all[id.index()];
                similar.metric().distance(own, other)
                    + similar.penalties().of(class(own), class(other))
            };
            let brute = candidates.iter().map(|id| (cost(id), *id)).reduce(|a, b| {
                if (b.0, b.1) < (a.0, a.1) { b } else { a }
            }).unwrap();
            for bound_m in [f32::INFINITY, brute.0 * share] {
                let found = similar.nearest(&file, (own, class(own)), &candidates, bound_m);
                let found = found.unwrap().map(|found| (found.cost_m, found.target));
                prop_assert_eq!(found, (brute.0 <= bound_m).then_some(brute));
            }
            for id in &candidates {
                prop_assert!(similar.least_cost(&file, StateId(0), *id).unwrap() <= cost(id));
            }
            // Opened again, from the file and without it, it knows the same.
            for _ in 0..2 {
                let mut again = Similar::new(&scene);
                again.open(&path, &[0; 32], &file, all_classes.clone()).unwrap();
                for id in (0..all.len() as u64).map(StateId) {
                    let bits = |similar: &Similar| {
                        similar.least_cost(&file, StateId(0), id).unwrap().to_bits()
                    };
                    prop_assert_eq!(bits(&again), bits(&similar));
                }
                std::fs::remove_file(&path).unwrap();
            }
        }
    }

    #[test]
    fn landmarks_are_spread_and_each_is_chosen_once() {
        let positions: Vec<Vec3> = (0..30).map(|v| Vec3::new(v as f32, 0.0, 0.0)).collect();
        assert_eq!(spread(&positions, 3), [0, 29, 14]);
        let mut all = spread(&positions, 100);
        all.sort_unstable();
        assert_eq!(all, (0..30).collect::<Vec<u32>>());
        assert_eq!(spread(&[Vec3::ZERO; 4], 2).len(), 2);
    }

    /// `cargo test --release -p explorer -- --ignored --nocapture a_search_among`: 1,000 states of
    /// 5,000 vertices, made of 20 smooth shapes.
    #[test]
    #[ignore = "prints times"]
    fn a_search_among_a_thousand_states_of_a_pose() {
        use rand_core::{Rng, SeedableRng};
        const VERTICES: usize = 5000;
        let mut random = rand_pcg::Pcg64Mcg::seed_from_u64(5);
        let mut unit = || random.next_u32() as f32 / u32::MAX as f32 * 2.0 - 1.0;
        let mut state = || {
            let shapes: Vec<[f32; 3]> = (0..20).map(|_| [unit(), unit(), unit()]).collect();
            let row = |v: usize, metres: f32| {
                [0, 1, 2].map(|axis| {
                    let x = v as f32 / VERTICES as f32;
                    let wave = |(k, a): (usize, &[f32; 3])| {
                        a[axis] * ((k + 1) as f32 * 3.0 * x + axis as f32).sin() / (k + 1) as f32
                    };
                    (shapes.iter().enumerate().map(wave).sum::<f32>() * metres * 16_384.0) as i16
                })
            };
            GridState {
                positions: (0..VERTICES).map(|v| row(v, 0.15)).collect(),
                velocities: (0..VERTICES).map(|v| row(v, 0.05)).collect(),
            }
        };
        let all: Vec<GridState> = (0..1050).map(|_| state()).collect();
        let mut scene = toy::scene(toy::knot(), toy::settings());
        scene.garment.positions =
            (0..VERTICES).map(|v| Vec3::new(v as f32 / VERTICES as f32, 0.0, 0.0)).collect();
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("states");
        let file = StateFile::create(&path, VERTICES as u32, &[0; 32]).unwrap();
        file.write(StateId(0), &all).unwrap();
        let mut similar = Similar::new(&scene);
        similar.keep_all(vec![0; all.len()]);
        let candidates: Vec<StateId> = (0..1000).map(StateId).collect();
        for (what, bound_m) in [("near a known state", 0.01), ("nearest", f32::INFINITY)] {
            let clock = crate::cpu::CpuClock::start();
            for state in &all[1000..] {
                similar.nearest(&file, (state, 0), &candidates, bound_m).unwrap();
            }
            println!("{what}: {:.3} ms of CPU a search", 1e3 * clock.elapsed_s() / 50.0);
        }
        let clock = crate::cpu::CpuClock::start();
        for state in &all[1000..1005] {
            for id in &candidates {
                similar.metric().distance(state, &file.read(*id).unwrap());
            }
        }
        println!("comparing with all: {:.3} ms of CPU", 1e3 * clock.elapsed_s() / 5.0);
    }
}
