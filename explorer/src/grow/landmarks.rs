//! A few vertices of every state, in a file, of which the pages used last are in memory: so much and no more,
//! whatever the number of states.
//!
//! Whoever searches along a trajectory asks for states that were simulated one after another, pose by pose: a
//! page of consecutive states serves as many searches.

use std::io;

use protocol::StateId;

use crate::grid::GridState;

/// Most memory that pages take (bytes): 226,000 states of 24 landmarks.
pub const LANDMARK_BYTES_MAX: usize = 64 << 20;
/// States of a page.
pub const PAGE_STATES: usize = 32;

/// Position and velocity of a vertex in steps of the grid.
pub type Row = [i16; 6];

const NONE: u32 = u32::MAX;

/// Where the rows of a page are read from.
pub type Read<'a> = &'a dyn Fn(StateId, usize) -> io::Result<Vec<GridState>>;

/// Pages of rows; see the module.
#[derive(Debug)]
pub struct Pages {
    /// Rows of a state.
    size: usize,
    pages_max: usize,
    /// States there are.
    count: usize,
    /// Where each page is kept, or `NONE`.
    places: Vec<u32>,
    kept: Vec<Page>,
    /// Whose turn it is to make room, unless it was used.
    hand: usize,
}

#[derive(Debug)]
struct Page {
    number: usize,
    rows: Vec<Row>,
    used: bool,
}

impl Pages {
    /// Of `count` states with `size` rows each, in at most so much memory (bytes).
    pub fn new(size: usize, count: usize, bytes_max: usize) -> Self {
        let page_bytes = (size * PAGE_STATES * size_of::<Row>()).max(1);
        Self {
            size,
            pages_max: (bytes_max / page_bytes).max(2),
            count,
            places: vec![NONE; count.div_ceil(PAGE_STATES)],
            kept: Vec::new(),
            hand: 0,
        }
    }

    /// Adds states that are in the file, the first of them with this id; later ones are forgotten.
    pub fn add(&mut self, first: StateId, states: &[GridState]) {
        for (id, state) in (first.index()..).zip(states) {
            let (number, row) = (id / PAGE_STATES, id % PAGE_STATES * self.size);
            if number == self.places.len() {
                self.places.push(NONE);
            }
            if let Some(page) = self.kept.get_mut(self.places[number] as usize) {
                page.rows.truncate(row);
                page.rows.extend(rows(state));
            } else if row == 0 {
                let rows = rows(state).collect();
                self.keep(number, rows);
            }
        }
        self.count = first.index() + states.len();
        for place in self.places.drain(self.count.div_ceil(PAGE_STATES)..) {
            if let Some(page) = self.kept.get_mut(place as usize) {
                page.number = usize::MAX;
            }
        }
    }

    /// The rows of a state; `read` gives as many states from an id on, of the landmarks alone.
    ///
    /// # Errors
    /// They had to be read and could not be.
    pub fn rows(&mut self, state: StateId, read: Read<'_>) -> io::Result<&[Row]> {
        let number = state.index() / PAGE_STATES;
        if self.places[number] == NONE {
            let first = number * PAGE_STATES;
            let count = PAGE_STATES.min(self.count - first);
            let states = read(StateId(first as u64), count)?;
            self.keep(number, states.iter().flat_map(rows).collect());
        }
        let page = &mut self.kept[self.places[number] as usize];
        page.used = true;
        let row = state.index() % PAGE_STATES * self.size;
        Ok(&page.rows[row..row + self.size])
    }

    /// Bytes that the pages in memory take.
    pub fn bytes(&self) -> usize {
        self.kept.iter().map(|page| page.rows.capacity() * size_of::<Row>()).sum()
    }

    fn keep(&mut self, number: usize, rows: Vec<Row>) {
        let page = Page { number, rows, used: true };
        if self.kept.len() < self.pages_max {
            self.places[number] = self.kept.len() as u32;
            self.kept.push(page);
            return;
        }
        while std::mem::take(&mut self.kept[self.hand].used) {
            self.hand = (self.hand + 1) % self.kept.len();
        }
        if let Some(place) = self.places.get_mut(self.kept[self.hand].number) {
            *place = NONE;
        }
        self.places[number] = self.hand as u32;
        self.kept[self.hand] = page;
        self.hand = (self.hand + 1) % self.kept.len();
    }
}

/// The rows of a state that has landmarks alone.
fn rows(state: &GridState) -> impl Iterator<Item = Row> {
    let row = |(p, v): (&[i16; 3], &[i16; 3])| [p[0], p[1], p[2], v[0], v[1], v[2]];
    state.positions.iter().zip(&state.velocities).map(row)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(id: usize) -> GridState {
        let at = (id % 30_000) as i16;
        GridState { positions: vec![[at, 1, 2]; 3], velocities: vec![[3, at, 5]; 3] }
    }

    #[test]
    fn every_state_is_found_in_little_memory_wherever_it_was_added() {
        let read = |first: StateId, count: usize| {
            Ok((first.index()..first.index() + count).map(state).collect::<Vec<_>>())
        };
        let mut pages = Pages::new(3, 700, 20_000);
        let all: Vec<GridState> = (0..5000).map(state).collect();
        let mut at = 700;
        for step in (1..90).cycle() {
            let to = (at + step).min(all.len());
            pages.add(StateId(at as u64), &all[at..to]);
            for id in [0, at / 2, at.saturating_sub(50), at, to - 1] {
                let rows = pages.rows(StateId(id as u64), &read).unwrap();
                assert_eq!(rows, [[(id % 30_000) as i16, 1, 2, 3, (id % 30_000) as i16, 5]; 3]);
            }
            at = to;
            if at == all.len() {
                break;
            }
        }
        assert!(pages.bytes() <= 2 * 20_000, "{}", pages.bytes());
        // An attempt that was never recorded is written over.
        pages.add(StateId(4000), &[state(7)]);
        assert_eq!(pages.rows(StateId(4000), &read).unwrap()[0][0], 7);
        assert_eq!(pages.rows(StateId(3999), &read).unwrap()[0][0], 3999);
    }
}
