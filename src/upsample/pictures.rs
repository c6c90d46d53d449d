//! Pictures of a scene: the figures of Kavan et al. 2011, on our data.

use std::path::Path;

use anyhow::{Context, Result};
use explorer::cloth::Vec3;
use explorer::upsample::learn::Lesson;
use explorer::upsample::report::Method;
use picture::{Camera, Layer, Paint, Rgb, Sheet, View, render};

/// Size of a picture in a sheet (pixels).
const SIZE: [u32; 2] = [340, 360];
/// Height of a shape function's largest value over the square it is drawn on.
const BUMP: f32 = 0.35;
/// Harmonics drawn.
const HARMONICS: [usize; 6] = [1, 2, 4, 8, 32, 128];

/// Writes all of them into `folder`.
pub fn write(lesson: &Lesson, folder: &Path) -> Result<()> {
    std::fs::create_dir_all(folder)
        .with_context(|| format!("the folder {} cannot be made", folder.display()))?;
    let methods = lesson.methods()?.all;
    let name = lesson.scene.name;
    let mut sheets = vec![
        (format!("{name}-shapes.png"), shapes(lesson, &methods)?),
        (format!("{name}-harmonics.png"), harmonics(lesson)?),
    ];
    sheets.extend(modes(lesson, &methods)?.map(|sheet| (format!("{name}-modes.png"), sheet)));
    for at in 0..lesson.frames.len() {
        let motion = lesson.scene.motions[at].name.replace(' ', "-");
        sheets.push((format!("{name}-{motion}.png"), side_by_side(lesson, &methods, at)?));
    }
    for (file, sheet) in sheets {
        let path = folder.join(file);
        std::fs::write(&path, sheet.image()?.png()?)
            .with_context(|| format!("writing {}", path.display()))?;
        println!("{}", path.display());
    }
    Ok(())
}

type Methods = [(&'static str, Method)];

/// Coarse, subdivided, harmonic and fine, in three frames (the paper's Figure 1).
fn side_by_side(lesson: &Lesson, methods: &Methods, at: usize) -> Result<Sheet> {
    let (scene, frames) = (&lesson.scene, &lesson.frames[at]);
    let motion = &scene.motions[at];
    let mut sheet = Sheet::new(5).titled(format!("{}, {}", scene.name, motion.name));
    for share in [0.3, 0.6, 0.95] {
        let frame = (frames.count() as f32 * share) as usize;
        let part = frames.part(frame, frame + 1);
        let points = |list: &dyn Fn(usize, usize) -> f32, count: usize| -> Vec<Vec3> {
            let axis = |i: usize, a: usize| list(i, a) + part.middles[a] as f32;
            (0..count).map(|i| Vec3::new(axis(i, 0), axis(i, 1), axis(i, 2))).collect()
        };
        let coarse = points(&|i, a| part.coarse[(i, a)] as f32, scene.coarse.count());
        let fine = points(&|i, a| part.fine[(i, a)], scene.fine.count());
        let mut shown = vec![("coarse", coarse, scene.coarse.mesh.triangles())];
        for wanted in ["loop", "harmonic", "harmonic-lift"] {
            let Some((name, method)) = methods.iter().find(|(n, _)| *n == wanted) else { continue };
            let up = lesson.upsample(method, &part);
            let positions = points(&|i, a| up[(i, a)], scene.fine.count());
            shown.push((name, positions, scene.fine.mesh.triangles()));
        }
        shown.push(("fine simulation", fine.clone(), scene.fine.mesh.triangles()));
        let body = motion.body(frame as f32 * scene.frame_s, scene.frame_s);
        // A character is seen from where its cloth is: from behind, in turn with its heading.
        let yaw = if scene.name == "cape" { heading(&fine) } else { 0.5 };
        let camera = Camera::framing(&fine, SIZE[0] as f32 / SIZE[1] as f32, yaw, 0.12);
        for (name, positions, triangles) in &shown {
            let mut layers = vec![Layer { positions, triangles, paint: Paint::CLOTH }];
            if let Some((positions, triangles)) = &body {
                layers.push(Layer { positions, triangles, paint: Paint::BODY });
            }
            let view = View { ground: None, ..View::new(camera, SIZE[0], SIZE[1]) };
            sheet.push(render(&view, &layers)?, format!("{name}, frame {frame}"));
        }
    }
    Ok(sheet)
}

/// Direction from the neck to the middle of a cape, about the vertical.
fn heading(fine: &[Vec3]) -> f32 {
    let middle = fine.iter().sum::<Vec3>() / fine.len() as f32;
    let out = middle - fine[fine.len() / 200];
    out.x.atan2(out.z)
}

/// One column of each operator over the square of the parameters (Figures 3 and 4).
fn shapes(lesson: &Lesson, methods: &Methods) -> Result<Sheet> {
    let coarse = &lesson.scene.coarse;
    let from_middle = |i: &usize| {
        let [u, v] = coarse.uv[*i];
        (u - 0.5).hypot(v - 0.5)
    };
    let column =
        (0..coarse.count()).min_by(|a, b| from_middle(a).total_cmp(&from_middle(b))).unwrap_or(0);
    let mut sheet = Sheet::new(4).titled(format!("{}: shape functions", lesson.scene.name));
    for (name, method) in methods {
        let Method::Linear(operator) = method else { continue };
        let values: Vec<f32> = (0..operator.nrows()).map(|i| operator[(i, column)]).collect();
        sheet.push(surface(lesson, &values)?, *name);
    }
    Ok(sheet)
}

/// Some of the harmonics (Figure 5).
fn harmonics(lesson: &Lesson) -> Result<Sheet> {
    let k = lesson.harmonics.eigenvalues.len();
    let mut sheet = Sheet::new(3).titled(format!("{}: harmonics", lesson.scene.name));
    for n in HARMONICS.into_iter().filter(|n| *n < k) {
        let values: Vec<f32> =
            lesson.harmonics.functions.iter().skip(n).step_by(k).copied().collect();
        sheet.push(surface(lesson, &values)?, format!("number {n}"));
    }
    Ok(sheet)
}

/// Sine and cosine amplitudes of the oscillatory modes (Figure 7), if there are any.
fn modes(lesson: &Lesson, methods: &Methods) -> Result<Option<Sheet>> {
    let found = methods.iter().find_map(|(_, m)| match m {
        Method::Modes(_, modes) if !modes.is_empty() => Some(modes),
        _ => None,
    });
    let Some(found) = found else { return Ok(None) };
    let mut sheet = Sheet::new(2).titled(format!("{}: oscillatory modes", lesson.scene.name));
    for mode in found {
        let hertz = mode.theta / std::f64::consts::TAU / f64::from(lesson.scene.frame_s);
        for (part, name) in ["sine", "cosine"].iter().enumerate() {
            let values: Vec<f32> = mode.amplitudes.iter().map(|e| e[part]).collect();
            sheet.push(surface(lesson, &values)?, format!("{name}, {hertz:.2} Hz"));
        }
    }
    Ok(Some(sheet))
}

/// A function of the mesh over the square of its parameters, as height and colour.
fn surface(lesson: &Lesson, values: &[f32]) -> Result<picture::Image> {
    let fine = &lesson.scene.fine;
    let most = values.iter().fold(1e-12f32, |m, v| m.max(v.abs()));
    let positions: Vec<Vec3> = fine
        .uv
        .iter()
        .zip(values)
        .map(|([u, v], value)| Vec3::new(*u, BUMP * value / most, *v))
        .collect();
    let colours: Vec<Rgb> = values.iter().map(|v| colour(v / most)).collect();
    // Where the mesh closes round, the triangles between last and first column would cross it.
    let far = |t: &&[u32; 3]| {
        let u = t.map(|v| fine.uv[v as usize][0]);
        u.iter().fold(0.0f32, |m, x| m.max((x - u[0]).abs())) < 0.5
    };
    let triangles: Vec<[u32; 3]> = fine.mesh.triangles().iter().filter(far).copied().collect();
    let corners = [Vec3::ZERO, Vec3::X, Vec3::Z, Vec3::X + Vec3::Z, Vec3::new(0.5, BUMP, 0.5)];
    let camera = Camera::framing(&corners, SIZE[0] as f32 / SIZE[1] as f32, 0.5, 0.7);
    let view = View { ground: None, ..View::new(camera, SIZE[0], SIZE[1]) };
    let paint = Paint::Vertices(&colours);
    Ok(render(&view, &[Layer { positions: &positions, triangles: &triangles, paint }])?)
}

/// Blue below zero, white at zero, red above.
fn colour(x: f32) -> Rgb {
    let fade = |x: f32| (245.0 - 190.0 * x.clamp(0.0, 1.0)) as u8;
    if x < 0.0 { [fade(-x), fade(-0.6 * x), 245] } else { [245, fade(0.6 * x), fade(x)] }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn zero_is_white_and_signs_differ() {
        assert_eq!(colour(0.0), [245, 245, 245]);
        assert!(colour(1.0)[0] > 200 && colour(1.0)[2] < 60);
        assert!(colour(-1.0)[2] > 200 && colour(-1.0)[0] < 60);
    }
}
