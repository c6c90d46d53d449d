//! `toile plot`: the pictures of an exploration.

use std::path::Path;

use anyhow::{Context, Result};
use explorer::figures::{self, ColourBy};

use crate::recall::recall;
use crate::{args, store};

/// Pixels to a unit of the PNG files.
const SCALE: u32 = 2;

/// Draws everything there is to draw of a store: of the version that players have, or of all that was simulated.
pub fn run(a: &args::Plot) -> Result<()> {
    let opened = store::open_store(&a.store)?;
    let explored = recall(&opened, &a.explored)?;
    std::fs::create_dir_all(&a.out)
        .with_context(|| format!("the folder {} cannot be made", a.out.display()))?;
    let (archive, scene) = (&explored.archive, &explored.scene);
    let view = archive.view(if a.newest { archive.graph().commit() } else { archive.shown() });
    let plots = [
        ("error", figures::error_curve(archive.graph())),
        ("merge-errors", figures::merge_histogram(&view)),
        ("states-per-pose", figures::states_per_pose(&view)),
    ];
    for (name, plot) in plots {
        write(&a.out, name, &plot.svg(), &plot.png(SCALE)?)?;
    }
    let drawings = [("graph-clips", ColourBy::Clip), ("graph-classes", ColourBy::Class)];
    for (name, by) in drawings {
        let drawing = figures::graph_drawing(&view, scene, by);
        write(&a.out, name, &drawing.svg(), &drawing.png(1)?)?;
    }
    if !a.newest && archive.shown() < archive.graph().commit() {
        eprintln!("drawn as players have it; --newest draws all that was simulated");
    }
    Ok(())
}

fn write(folder: &Path, name: &str, svg: &str, png: &[u8]) -> Result<()> {
    for (ending, bytes) in [("svg", svg.as_bytes()), ("png", png)] {
        let file = folder.join(format!("{name}.{ending}"));
        std::fs::write(&file, bytes).with_context(|| format!("writing {}", file.display()))?;
        println!("{}", file.display());
    }
    Ok(())
}
