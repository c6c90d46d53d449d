//! A10: a sheet on an incline sticks or slides as Coulomb says.

use glam::Vec3;

use super::shapes::{Cut, pose_at, sheet, slab};
use super::{Bench, LabError, Limit, Setting, Stage};
use crate::material::Material;
use crate::model::{Environment, Model};

pub(crate) const A10: Bench = Bench {
    name: "A10",
    about: "sheet on an incline of the ground and of a body, friction 0.4",
    reference: "sticks below 21.8 deg, else a = g (sin a - mu cos a)",
    fast: true,
    reads: Setting::ALL,
    run: incline,
};

const FRICTION: f32 = 0.4;

fn incline(stage: &mut Stage<'_>) -> Result<(), LabError> {
    let threshold = f64::from(FRICTION).atan().to_degrees();
    for (on_body, where_) in [(false, "ground"), (true, "body")] {
        let (creep, _) = slide(stage, threshold - 0.5, on_body)?;
        let what = format!("creep half a degree below the threshold, {where_}");
        stage.row(what, 1e3 * creep, "mm/s", "sticks", Limit::AtMost(1.0));
        let (speed, seconds) = slide(stage, threshold + 0.5, on_body)?;
        let what = format!("share of the speed half a degree above, {where_}");
        let law = acceleration(threshold + 0.5) * seconds;
        stage.row(what, speed / law, "", "1: it slides", Limit::AtLeast(0.5));
        let (speed, seconds) = slide(stage, 30.0, on_body)?;
        let law = acceleration(30.0) * seconds;
        let error = 100.0 * (speed / law - 1.0).abs();
        let what = format!("error of the acceleration at 30 deg, {where_}");
        let reference = format!("{:.3} m/s^2", acceleration(30.0));
        stage.row(what, error, "%", reference, Limit::AtMost(3.0));
    }
    Ok(())
}

fn acceleration(degrees: f64) -> f64 {
    let (s, c) = degrees.to_radians().sin_cos();
    9.81 * (s - f64::from(FRICTION) * c)
}

/// Speed gained (m/s) in a time (s): the plane lies level and gravity leans.
fn slide(stage: &mut Stage<'_>, degrees: f64, on_body: bool) -> Result<(f64, f64), LabError> {
    let n = stage.side(11) - 1;
    let (s, c) = degrees.to_radians().sin_cos();
    let down = Vec3::new(s as f32, -c as f32, 0.0) * 9.81;
    let material = Material { friction: FRICTION, drag: 0.0, ..Material::default() };
    let material = Material { friction: FRICTION, ..stage.material(material) };
    let place = |u: f32, v: f32| Vec3::new(0.3 * u, material.offset, 0.3 * v);
    let mesh = sheet(n, n, Cut::Alternating, place)?;
    let environment = Environment {
        gravity: down,
        ground: !on_body,
        ground_friction: FRICTION,
        ..Environment::default()
    };
    let body = on_body.then(|| slab(Vec3::new(0.5, -0.1, 0.15), Vec3::new(2.0, 0.1, 1.0)));
    let pose = body.as_ref().map(|b| pose_at(b, b.skeleton.rest[0].translation));
    let model = Model::new(mesh, material, environment, body, &[])?;
    let mut sim = stage.sim(model, 1.0 / 30.0);
    let motion = pose.as_ref().map(|p| (p, p));
    let mean = |sim: &super::Sim| {
        let v = &sim.state.velocities;
        v.iter().map(|v| f64::from(v.x)).sum::<f64>() / v.len() as f64
    };
    for _ in 0..6 {
        stage.step(&mut sim, motion)?;
    }
    let (start, from) = (mean(&sim), f64::from(sim.time_s));
    for _ in 0..15 {
        stage.step(&mut sim, motion)?;
    }
    let slower = if degrees < f64::from(FRICTION).atan().to_degrees() { 0.0 } else { start };
    Ok((mean(&sim) - slower, f64::from(sim.time_s) - from))
}
