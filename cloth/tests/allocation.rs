//! No allocation per step once warm: a frame that has been simulated before asks for no memory.

mod common;

use allocation_counter::measure;
use cloth::{Environment, Material, Model, Span, Vec3, Workspace, step};
use common::{ellipsoids, pose_at, sheet};

#[test]
fn a_warm_workspace_asks_for_no_memory() {
    let mesh = sheet(24, 24, |u, v| Vec3::new(u - 0.5, 0.45, v - 0.5));
    let start = Vec3::new(0.0, 0.2, -0.1);
    let body = ellipsoids(&[(start, Vec3::splat(0.2))], 24);
    let environment = Environment { ground: true, ..Environment::default() };
    let model =
        Model::new(mesh, Material::default(), environment, Some(body.clone()), &[]).unwrap();
    let mut ws = Workspace::default();
    let mut run = || {
        let mut state = model.rest_state();
        let mut count = 0;
        for frame in 0..24u32 {
            let at = |f: u32| pose_at(&body, start + Vec3::Z * (0.4 * f as f32 / 30.0));
            let (from, to) = (at(frame), at(frame + 1));
            let span = Span {
                motion: Some((&from, &to)),
                seconds: 1.0 / 30.0,
                refine: 1,
                sort_layers: false,
            };
            let asked = measure(|| {
                step(&model, &span, &mut state, &mut ws).unwrap();
            });
            count += asked.count_total;
        }
        count
    };
    assert!(run() > 0, "a cold workspace asks for some");
    assert_eq!(run(), 0, "a warm one for none");
}
