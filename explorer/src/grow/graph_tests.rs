//! The paper's Figures 3 and 4, and a model test of the operations.

use proptest::prelude::*;
use protocol::{EdgeId, PoseId, StateId};

use super::*;
use crate::grow::plan::Plan;
use crate::grow::toy;

/// Every table agrees with every other.
pub fn check(graph: &Graph) -> Result<(), GraphError> {
    let broken = |state: u64, what| Err(GraphError::Broken(StateId(state), what));
    let mut queue = Queue::default();
    for (id, state) in (0..).zip(graph.states()) {
        let this = StateId(id);
        let interior = graph.interior(state.pose).contains(&this);
        let dead = graph.dead_ends(state.pose).contains(&this);
        let next: Vec<Option<StateId>> = graph.next(this).each().collect();
        if let Kind::DeadEnd { target, error_m } = state.kind {
            queue.insert(this, error_m);
            let other = graph.state(target);
            if other.kind != Kind::Interior || other.pose != state.pose {
                return broken(id, "merged into what is no interior state of its pose");
            }
        }
        let whole = next.len() == graph.primary().out_degree(state.pose) && !next.contains(&None);
        if interior != (state.kind == Kind::Interior)
            || dead != matches!(state.kind, Kind::DeadEnd { .. })
            || graph.open().contains(&this) != (state.kind == Kind::Open)
            || interior && !whole
        {
            return broken(id, "listed as another kind");
        }
        for (edge, next) in graph.primary().out_edges(state.pose).zip(next) {
            let Some(next) = next else { continue };
            let child = graph.state(next);
            if child.parent != Some((this, edge))
                || child.pose != graph.primary().edge(edge).to
                || next <= this
            {
                return broken(id, "a link does not name what was simulated");
            }
        }
    }
    let covered: u64 = graph.runs().iter().map(|run| u64::from(run.count)).sum();
    if covered != graph.next_id().0 || queue != *graph.queue() {
        return broken(0, "runs or queue");
    }
    for run in graph.runs() {
        for id in run.first.0 + 1..run.first.0 + u64::from(run.count) {
            if graph.state(StateId(id)).parent.map(|(p, _)| p.0) != Some(id - 1) {
                return broken(id, "not simulated from the one before in its run");
            }
        }
    }
    Ok(())
}

/// From every interior state every edge leads to an interior state of the right pose.
pub fn check_table(graph: &Graph) {
    for (id, state) in (0..).zip(graph.states()) {
        for edge in graph.primary().out_edges(state.pose) {
            let next = graph.follow(StateId(id), edge);
            match &state.kind {
                Kind::Interior => {
                    let next = graph.state(next.expect("total"));
                    assert_eq!(next.pose, graph.primary().edge(edge).to);
                    assert_eq!(next.kind, Kind::Interior);
                }
                _ => assert_eq!(next, None),
            }
        }
    }
}

/// The graph after the initial pass, without a simulator: only its links matter.
pub fn initial(primary: PrimaryGraph) -> Graph {
    let primary = Arc::new(primary);
    let plan = Plan::new(&primary, PoseId(0));
    let mut graph = Graph::new(Arc::clone(&primary), PoseId(0));
    let mut placed = vec![None; primary.poses().len()];
    placed[0] = Some(StateId(0));
    for job in plan.jobs() {
        for &edge in &job.edges {
            let parent = placed[primary.edge(edge).from.index()].unwrap();
            let state = graph.attach(parent, edge).unwrap();
            if plan.is_tree(edge) {
                placed[primary.edge(edge).to.index()] = Some(state);
            }
        }
        graph.end_commit();
    }
    placed.iter().flatten().for_each(|&state| graph.close(state).unwrap());
    for state in graph.open().clone() {
        let target = placed[graph.state(state).pose.index()].unwrap();
        graph.merge(state, target, 0.1 * state.0 as f32).unwrap();
    }
    graph.end_initial_pass().unwrap();
    graph
}

fn edge(graph: &Graph, from: u32, to: u32) -> EdgeId {
    let ends = |edge: &EdgeId| graph.primary().edge(*edge).to == PoseId(to);
    graph.primary().out_edges(PoseId(from)).find(ends).unwrap()
}

#[test]
fn figure_4_left_and_centre_initialisation() {
    let graph = initial(toy::figure_4());
    check(&graph).unwrap();
    check_table(&graph);
    assert_eq!(graph.next_id(), StateId(10));
    let dead: Vec<u64> = graph.queue().iter().map(|(state, _)| state.0).collect();
    assert_eq!(dead, [9, 5], "c5 and c9 are the dead ends, the larger error first");
    // c4 goes on to c0 where c5 was, c8 to c2 where c9 was.
    assert_eq!(graph.follow(StateId(4), edge(&graph, 4, 0)), Some(StateId(0)));
    assert_eq!(graph.follow(StateId(8), edge(&graph, 7, 2)), Some(StateId(2)));
    assert_eq!(graph.simulated_frames(), graph.primary().edges().len() as u64);
}

#[test]
fn figure_4_right_one_expansion_from_c5() {
    let mut graph = initial(toy::figure_4());
    let c5 = StateId(5);
    assert_eq!(graph.revert(c5).unwrap().target, StateId(0));
    let path = [(0, 1), (1, 2), (1, 5), (5, 6), (6, 7), (7, 2)];
    let parents = [5, 10, 10, 12, 13, 14];
    for ((from, to), parent) in path.into_iter().zip(parents) {
        graph.attach(StateId(parent), edge(&graph, from, to)).unwrap();
    }
    for interior in [5, 10, 12, 13, 14] {
        graph.close(StateId(interior)).unwrap();
    }
    // Two new dead ends, both merged into c2.
    graph.merge(StateId(11), StateId(2), 0.3).unwrap();
    graph.merge(StateId(15), StateId(2), 0.2).unwrap();
    graph.end_commit();
    check(&graph).unwrap();
    check_table(&graph);
    graph.check_total().unwrap();
    // Only the edge that led to c5 has moved; c9 still goes to c2.
    assert_eq!(graph.follow(StateId(4), edge(&graph, 4, 0)), Some(c5));
    assert_eq!(graph.follow(StateId(8), edge(&graph, 7, 2)), Some(StateId(2)));
    assert_eq!(graph.follow(StateId(14), edge(&graph, 7, 2)), Some(StateId(2)));
}

#[test]
fn figure_3_several_states_of_a_pose_and_a_table_for_each() {
    let edges = [(0, 1), (1, 2), (2, 0), (1, 3), (3, 4), (4, 5), (5, 6), (6, 0), (3, 1)];
    let mut graph = initial(toy::primary(7, &edges));
    // Seven interior states and three dead ends; expand one of p0 so that p0 has two states.
    let at_p0 = *graph.dead_ends(PoseId(0)).first().unwrap();
    graph.revert(at_p0).unwrap();
    let child = graph.attach(at_p0, edge(&graph, 0, 1)).unwrap();
    graph.close(at_p0).unwrap();
    let target = graph.interior(PoseId(1))[0];
    graph.merge(child, target, 0.5).unwrap();
    graph.end_commit();
    check(&graph).unwrap();
    check_table(&graph);
    assert_eq!(graph.interior(PoseId(0))[..], [StateId(0), at_p0]);
    // The same primary edge, two states: two rows of the table.
    let row = |state| graph.follow(state, edge(&graph, 0, 1));
    assert_eq!(row(StateId(0)), Some(target));
    assert_eq!(row(at_p0), Some(target));
    assert_eq!(graph.follow(StateId(0), edge(&graph, 1, 2)), None, "an edge of another pose");
}

#[test]
fn what_does_not_fit_is_refused_and_changes_nothing() {
    let mut graph = initial(toy::figure_4());
    let before = graph.clone();
    let (c0, c5, c9) = (StateId(0), StateId(5), StateId(9));
    assert!(graph.attach(c0, EdgeId(0)).is_err());
    assert!(graph.attach(StateId(99), EdgeId(0)).is_err());
    assert!(graph.close(c0).is_err());
    assert!(graph.merge(c0, c0, 0.0).is_err());
    assert!(graph.revert(c0).is_err());
    assert!(graph.remerge(c5, StateId(1), 0.0).is_err(), "another pose");
    assert!(graph.remerge(c5, c9, 0.0).is_err(), "not interior");
    assert!(graph.remerge(c5, c0, 0.5).is_err(), "not nearer");
    assert!(graph.remerge(c5, c0, f32::NAN).is_err());
    assert_eq!(graph, before);
    graph.revert(c5).unwrap();
    assert!(graph.attach(c5, EdgeId(3)).is_err(), "an edge of another pose");
    assert!(graph.close(c5).is_err(), "an edge is missing");
    assert_eq!(graph.check_total(), Err(GraphError::NotTotal(c5)));
}

proptest! {
    #[test]
    fn random_operations_keep_every_invariant(
        primary in toy::any_primary(10),
        choices in proptest::collection::vec((any::<u16>(), any::<u8>()), 1..25),
    ) {
        let mut graph = initial(primary);
        for (choice, what) in choices {
            let dead: Vec<(StateId, f32)> = graph.queue().iter().collect();
            prop_assume!(!dead.is_empty());
            let (state, error_m) = dead[choice as usize % dead.len()];
            let pose = graph.state(state).pose;
            let candidates = graph.interior(pose).to_vec();
            let target = candidates[what as usize % candidates.len()];
            let before = graph.clone();
            match what % 3 {
                0 if error_m > 0.0 => graph.remerge(state, target, error_m * 0.5).unwrap(),
                1 => {
                    // Merge after revert is the identity, but for the record of it.
                    let merge = graph.revert(state).unwrap();
                    graph.merge(state, merge.target, merge.error_m).unwrap();
                    prop_assert_eq!(
                        graph.merges(state).len(), before.merges(state).len() + 1);
                    prop_assert_eq!(graph.queue(), before.queue());
                    prop_assert_eq!(&graph.state(state).kind, &before.state(state).kind);
                }
                _ => {
                    graph.revert(state).unwrap();
                    let out: Vec<EdgeId> = graph.primary().out_edges(pose).collect();
                    let new: Vec<StateId> =
                        out.iter().map(|&e| graph.attach(state, e).unwrap()).collect();
                    graph.close(state).unwrap();
                    for child in new {
                        let target = graph.interior(graph.state(child).pose)[0];
                        graph.merge(child, target, f32::from(what) * 0.01).unwrap();
                    }
                    // Nobody else's links moved.
                    for (id, old) in (0..).map(StateId).zip(before.states()) {
                        if id != state {
                            prop_assert_eq!(old, graph.state(id));
                            prop_assert_eq!(before.next(id), graph.next(id));
                        }
                    }
                }
            }
            graph.end_commit();
            check(&graph).unwrap();
            check_table(&graph);
            graph.check_total().unwrap();
        }
    }
}
