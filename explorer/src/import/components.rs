//! Strongly connected components and shortest times of a directed graph.

/// Out-neighbours of each node, packed: those of node n are `to[first[n]..first[n + 1]]`.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Digraph {
    first: Vec<u32>,
    to: Vec<u32>,
}

impl Digraph {
    /// Packs `(from, to)` pairs over `nodes` nodes; every index must be below `nodes`.
    pub fn new(nodes: usize, edges: &[(u32, u32)]) -> Self {
        let mut first = vec![0u32; nodes + 1];
        for (from, _) in edges {
            first[*from as usize + 1] += 1;
        }
        for node in 0..nodes {
            first[node + 1] += first[node];
        }
        let mut next = first.clone();
        let mut to = vec![0; edges.len()];
        for (from, target) in edges {
            to[next[*from as usize] as usize] = *target;
            next[*from as usize] += 1;
        }
        Self { first, to }
    }

    /// Number of nodes.
    pub fn node_count(&self) -> usize {
        self.first.len() - 1
    }

    fn out(&self, node: u32) -> &[u32] {
        &self.to[self.first[node as usize] as usize..self.first[node as usize + 1] as usize]
    }

    /// Nodes of the largest strongly connected component that holds a cycle, in order of index;
    /// of equals the one with the smallest index; empty where the graph has no cycle.
    ///
    /// Tarjan 1972, without recursion.
    pub fn largest_cycle_component(&self) -> Vec<u32> {
        let component = self.components();
        let count = component.iter().map(|c| *c as usize + 1).max().unwrap_or(0);
        let mut size = vec![0usize; count];
        for c in &component {
            size[*c as usize] += 1;
        }
        let mut best: Option<u32> = None;
        for node in 0..self.node_count() as u32 {
            let c = component[node as usize];
            let cycle = size[c as usize] > 1 || self.out(node).contains(&node);
            if cycle && best.is_none_or(|b| size[c as usize] > size[b as usize]) {
                best = Some(c);
            }
        }
        let kept = |node: &u32| Some(component[*node as usize]) == best;
        (0..self.node_count() as u32).filter(kept).collect()
    }

    /// The strongly connected component of each node, numbered from 0.
    pub fn components(&self) -> Vec<u32> {
        const NEW: u32 = u32::MAX;
        let nodes = self.node_count();
        let mut component = vec![NEW; nodes];
        let (mut order, mut low) = (vec![NEW; nodes], vec![NEW; nodes]);
        let (mut stack, mut calls) = (Vec::new(), Vec::new());
        let (mut clock, mut count) = (0, 0);
        for root in 0..nodes as u32 {
            if order[root as usize] != NEW {
                continue;
            }
            calls.push((root, 0usize));
            while let Some((node, edge)) = calls.pop() {
                let at = node as usize;
                if edge == 0 {
                    order[at] = clock;
                    low[at] = clock;
                    clock += 1;
                    stack.push(node);
                } else {
                    let child = self.out(node)[edge - 1] as usize;
                    if component[child] == NEW {
                        low[at] = low[at].min(low[child]);
                    }
                }
                if let Some(next) = self.out(node).get(edge) {
                    calls.push((node, edge + 1));
                    match order[*next as usize] {
                        NEW => calls.push((*next, 0)),
                        _ if component[*next as usize] == NEW => {
                            low[at] = low[at].min(order[*next as usize]);
                        }
                        _ => {}
                    }
                } else if low[at] == order[at] {
                    while let Some(member) = stack.pop() {
                        component[member as usize] = count;
                        if member == node {
                            break;
                        }
                    }
                    count += 1;
                }
            }
        }
        component
    }

    /// Steps of the shortest walk from each node to the nearest of `targets`; `u32::MAX` where
    /// there is none.
    pub fn steps_to(&self, targets: &[u32]) -> Vec<u32> {
        let mut back: Vec<(u32, u32)> = Vec::with_capacity(self.to.len());
        for node in 0..self.node_count() as u32 {
            back.extend(self.out(node).iter().map(|to| (*to, node)));
        }
        Self::new(self.node_count(), &back).steps_from(targets)
    }

    fn steps_from(&self, sources: &[u32]) -> Vec<u32> {
        let mut steps = vec![u32::MAX; self.node_count()];
        for source in sources {
            steps[*source as usize] = 0;
        }
        let mut queue: Vec<u32> = sources.to_vec();
        let mut next = 0;
        while next < queue.len() {
            let node = queue[next];
            next += 1;
            for to in self.out(node) {
                if steps[*to as usize] == u32::MAX {
                    steps[*to as usize] = steps[node as usize] + 1;
                    queue.push(*to);
                }
            }
        }
        steps
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    #[test]
    fn a_ring_with_a_tail_keeps_the_ring() {
        let graph = Digraph::new(6, &[(0, 1), (1, 2), (2, 3), (3, 1), (3, 4), (5, 0)]);
        assert_eq!(graph.largest_cycle_component(), [1, 2, 3]);
        assert_eq!(graph.steps_to(&[3]), [3, 2, 1, 0, u32::MAX, 4]);
    }

    #[test]
    fn without_a_cycle_nothing_is_kept() {
        assert!(Digraph::new(3, &[(0, 1), (1, 2)]).largest_cycle_component().is_empty());
        assert_eq!(Digraph::new(1, &[(0, 0)]).largest_cycle_component(), [0]);
    }

    #[test]
    fn a_long_chain_does_not_overflow_the_stack() {
        let edges: Vec<_> = (0..300_000u32).map(|n| (n, (n + 1) % 300_000)).collect();
        assert_eq!(Digraph::new(300_000, &edges).largest_cycle_component().len(), 300_000);
    }

    proptest! {
        #[test]
        fn components_are_mutual_reachability(
            edges in proptest::collection::vec((0u32..9, 0u32..9), 0..24),
        ) {
            let graph = Digraph::new(9, &edges);
            let component = graph.components();
            let reach: Vec<Vec<u32>> = (0..9).map(|n| graph.steps_from(&[n])).collect();
            for a in 0..9 {
                for b in 0..9 {
                    let mutual = reach[a][b] != u32::MAX && reach[b][a] != u32::MAX;
                    prop_assert_eq!(component[a] == component[b], mutual);
                }
            }
        }
    }
}
