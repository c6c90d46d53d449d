//! Whether the simulator is the one that made a work folder, and the program one that chose alike.

use super::{ExploreError, Setup};
use crate::grow::round::RoundError;
use crate::grow::work::{Work, WorkError};
use crate::simulator::Simulator;

/// Why records may contradict each other that nothing has damaged.
pub const OLDER: &str = "; where nothing has damaged it, an older toile wrote it, which chose the dead \
    ends to simulate otherwise: go on with that one, or begin anew in another work folder and store";

/// What to say beside an error of a work folder.
pub(super) fn older(error: &WorkError) -> &'static str {
    if matches!(error, WorkError::Records { .. }) { OLDER } else { "" }
}

/// A folder goes on only under the physics that made it: its first frame is simulated once more.
pub(super) fn check(
    setup: &Setup<'_>,
    work: &Work,
    simulator: &mut dyn Simulator,
) -> Result<(), ExploreError> {
    let Some((parent, edge, state)) = work.graph().some_frames(1).pop() else { return Ok(()) };
    let read = |state| work.states().read(state).map_err(RoundError::Read);
    let (from, expected) = (read(parent)?, read(state)?);
    let mut again = simulator.step(&from, edge);
    if again.is_err() && simulator.may_recover() {
        again = simulator.step(&from, edge);
    }
    match again {
        Ok(frame) if frame.state == expected => Ok(()),
        Ok(frame) => {
            let apart_mm = 1e3 * work.similar().metric().distance(&frame.state, &expected);
            Err(ExploreError::OtherPhysics { folder: setup.work.to_owned(), state, apart_mm })
        }
        // Jobs will tell what of it, and whether to go on.
        Err(error) => {
            tracing::warn!(%error, %state, "a state on record could not be simulated again");
            Ok(())
        }
    }
}
