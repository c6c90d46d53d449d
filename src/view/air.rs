//! Wind on the page, and what it does: cloth that leaves the graph.

use client_lib::Character;
use serde_json::{Value, json};

use super::actor::Actor;

/// Fastest wind of the slider (m/s).
pub const WIND_MAX_M_S: f32 = 12.0;

/// The air over the page.
#[derive(Debug, Default)]
pub struct Air {
    /// Speed along x, with gusts (m/s).
    wind_m_s: f32,
    ticks: u64,
}

impl Air {
    /// Lets it blow at this speed (m/s); what is out of range is brought into it.
    pub fn set(&mut self, m_s: f32) {
        self.wind_m_s = m_s.clamp(0.0, WIND_MAX_M_S);
    }

    /// Before a tick: all characters feel it. Gusts of a fifth come every two seconds or so.
    pub fn blow(&mut self, actors: &mut [Actor]) {
        self.ticks += 1;
        let turn = self.ticks as f32 / 30.0 * std::f32::consts::PI;
        let speed = self.wind_m_s * (1.0 + 0.2 * turn.sin());
        let aside = 0.3 * self.wind_m_s * (0.37 * turn).sin();
        for actor in actors {
            // Back as soon as a state is as near as the graph's worst merge: whoever moves the slider
            // back wants the graph back, and that blend is on the page as it is.
            let worst_m = actor.character.version().listing().stats.worst_error_m;
            actor.character.return_within(Some(worst_m));
            actor.character.set_wind([speed, 0.0, aside]);
        }
    }
}

/// Where a character stands, for the page: whether it can leave the graph, for how long it is outside,
/// and how far the nearest state is.
pub fn told(lead: &Character) -> Value {
    let outside = lead.outside();
    json!({
        "can_leave": lead.can_leave(),
        "frames": outside.map(|outside| outside.frames),
        "nearest_mm": outside.and_then(|outside| outside.nearest_m).map(|m| m * 1e3),
        "total": lead.stats().outside,
    })
}
