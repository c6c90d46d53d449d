//! Growing the secondary graph (Kim et al. 2013, section 3): the paper's algorithm whole.
//!
//! Map: [`graph`] states and links with the operations merge, revert, attach; [`metric`] how far
//! two states are; [`class`] hood up, hood down; [`similar`] the nearest of many; [`queue`] largest
//! error first; [`policy`] which dead ends are simulated next; [`plan`] the initial pass; [`job`] what a worker
//! does from one state; [`round`] many jobs on many workers, committed in order; [`record`] what
//! is journalled; [`ledger`] the graph and all bookkeeping as a pure function of the records;
//! [`states`] and [`journal`] the two files; [`archive`] a work folder read only; [`work`] the work folder that keeps them together;
//! [`view`] the graph at one commit, as publishing sees it.
//!
//! Invariants. The journal is written before anything is visible; everything that steers the
//! exploration is a function of the records, so a run that was killed goes on as if it had not
//! been. A job's outcome depends on its inputs and on the snapshot of its round alone.

pub mod ahead;
pub mod aim;
pub mod archive;
pub mod class;
mod compact;
mod files;
pub mod graph;
pub mod job;
pub mod journal;
mod landmarks;
pub mod ledger;
pub mod metric;
pub mod nodes;
pub mod plan;
pub mod policy;
pub mod queue;
pub mod record;
pub mod round;
pub mod similar;
pub mod states;
pub mod view;
pub mod visits;
pub mod work;

#[cfg(test)]
pub(crate) mod toy;
