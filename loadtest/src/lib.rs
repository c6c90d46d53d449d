//! Simulated players and fault injection.
//!
//! Goals: real clients over real sockets, each on a thread of its own as in a game; totals that
//! were measured, not computed; broken bytes that a server has to survive.
//!
//! Non-goals: simulated networks (`protocol`'s tests have one), rendering.
//!
//! Map: [`players`] clients that walk at random; [`faults`] what a server must refuse.

pub mod faults;
pub mod players;

pub use players::{Pace, Players, PlayersConfig, Totals};
