//! What a game links: cloth for its characters, streamed, cached, played and decoded.
//!
//! Goals: a face that an engine calls once a frame and that never blocks; no async type and no
//! thread in that face; an answer for every frame, with its error stated; memory within a budget.
//!
//! Non-goals: exploring, publishing, rendering, deciding which pose comes next.
//!
//! Per character: [`Character::step`] once per tick of the scene, [`Character::sample`] once per
//! frame of the screen, [`decode`] wherever the host wants the work done.
//!
//! Architecture invariants: nothing here waits for the network on the caller's side, apart from functions
//! that say so in their name (`wait_*`, `close`, and dropping a client, which closes it); what a frame
//! loop calls waits for no lock either, the other functions of a client take one that its thread holds
//! for copying a few words. The core knows no network, no file and no thread ([`walk`], a tool, reads its
//! list from a file); neither explorer nor server is linked.
//!
//! ```no_run
//! # #[cfg(feature = "driver")]
//! # fn main() -> Result<(), Box<dyn std::error::Error>> {
//! use client_lib::{Client, ClientConfig, StepOutcome, Walk, WalkSpec, decode};
//! use std::time::Duration;
//!
//! let client = Client::connect(ClientConfig::new("127.0.0.1:4433"))?;
//! client.wait_ready(Duration::from_secs(30))?;
//! let mut character = client.character(None)?;
//! let scene = client.scene(None)?;
//! // A game decides by itself which pose comes next.
//! let walk = Walk::new(&WalkSpec::Random(1), &scene, character.pose())?;
//! let mut positions = vec![0.0; character.version().basis().rows()];
//! for next_pose in walk.take(300) {
//!     if let StepOutcome::Substituted { error_m } = character.step(next_pose) {
//!         println!("off by {} mm", 1e3 * error_m);
//!     }
//!     for phase in [0.5, 1.0] {
//!         character.sample(phase);
//!         decode(&[&character], 0..positions.len(), usize::MAX, &mut positions)?;
//!         let _into_the_world = character.placement();
//!     }
//! }
//! client.close();
//! # Ok(())
//! # }
//! # #[cfg(not(feature = "driver"))]
//! # fn main() {}
//! ```
//!
//! Map: `client` connects (feature `driver`); [`loader`] makes versions of chunks; [`version`] a version assembled, [`cache`] decoded
//! regions, [`shared`] how both reach the frame loop; [`character`] the face, [`blend`] and
//! [`placement`] under it; [`prefetch`] what is needed next; [`telemetry`] and [`stats`] what was
//! played; [`scene`] the checked scene, [`walk`] walks over it, [`steer`] the way to a clip.

#![cfg_attr(test, allow(clippy::float_cmp))] // exact values are meant

pub mod blend;
pub mod cache;
pub mod character;
#[cfg(feature = "driver")]
pub mod client;
pub mod clock;
#[cfg(feature = "driver")]
pub mod driver;
pub mod free;
pub mod loader;
pub mod placement;
pub mod prefetch;
pub mod scene;
pub mod shared;
pub mod stats;
pub mod steer;
pub mod telemetry;
pub mod version;
pub mod walk;

#[cfg(test)]
mod tiny;

pub use blend::BlendMode;
pub use character::{Character, Group, Passed, StepOutcome, decode};
#[cfg(feature = "driver")]
pub use client::{Client, ClientConfig, ClientError, Status};
pub use cloth::Rigid;
pub use codec::toile::TIERS;
pub use free::{Outside, Push};
pub use loader::{FirstCloth, Memory};
pub use protocol::message::TagOutcome;
pub use protocol::table::Entry;
pub use protocol::{GarmentId, PoseId, StateId, VersionNumber};
pub use scene::Scene;
pub use stats::{Histogram, PlayStats};
pub use steer::Steer;
pub use walk::{Walk, WalkSpec};
