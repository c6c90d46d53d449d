//! Reads the surface of a Wavefront OBJ file: positions and faces, nothing else.
//!
//! Vertices keep the order of the file, so that what a person reads in a modelling program is what
//! attachments name and errors say. Polygons become fans of triangles.

use cloth::Vec3;
use protocol::limits::{TRIANGLES_MAX, VERTICES_MAX};

use super::garment::{GarmentError, Surface};

/// Most corners of one polygon.
const CORNERS_MAX: usize = 64;

/// Reads the bytes of a file.
///
/// # Errors
/// The line of what is not OBJ, of a face that names no vertex, or where a limit is passed.
pub fn parse(bytes: &[u8]) -> Result<Surface, GarmentError> {
    let text = String::from_utf8_lossy(bytes);
    let mut surface = Surface { positions: Vec::new(), triangles: Vec::new() };
    for (index, line) in text.lines().enumerate() {
        let error = |problem: String| GarmentError::Obj { line: index + 1, problem };
        let mut words = line.split_whitespace();
        match words.next() {
            Some("v") => surface.positions.push(parse_vertex(words).map_err(error)?),
            Some("f") => {
                let count = surface.positions.len();
                let corners: Result<Vec<u32>, String> =
                    words.take(CORNERS_MAX + 1).map(|word| parse_corner(word, count)).collect();
                let corners = corners.map_err(error)?;
                if !(3..=CORNERS_MAX).contains(&corners.len()) {
                    return Err(error(format!("a face has 3 to {CORNERS_MAX} corners")));
                }
                let fan = corners[1..].windows(2).map(|pair| [corners[0], pair[0], pair[1]]);
                surface.triangles.extend(fan);
            }
            _ => {}
        }
        if surface.positions.len() > VERTICES_MAX || surface.triangles.len() > TRIANGLES_MAX {
            return Err(error(format!(
                "over {VERTICES_MAX} vertices or {TRIANGLES_MAX} triangles"
            )));
        }
    }
    Ok(surface)
}

fn parse_vertex<'a>(words: impl Iterator<Item = &'a str>) -> Result<Vec3, String> {
    let numbers: Vec<f32> = words.take(3).map_while(|word| word.parse().ok()).collect();
    match numbers.as_slice() {
        [x, y, z] => Ok(Vec3::new(*x, *y, *z)),
        _ => Err("a vertex needs three numbers".to_owned()),
    }
}

/// `7`, `7/1`, `7/1/3`, `7//3`, or counted from the last vertex: `-1`.
fn parse_corner(word: &str, count: usize) -> Result<u32, String> {
    let number: i64 = word
        .split('/')
        .next()
        .and_then(|first| first.parse().ok())
        .ok_or_else(|| "a corner of a face is no number".to_owned())?;
    let index = if number < 0 { number.saturating_add(count as i64) } else { number - 1 };
    match u32::try_from(index) {
        Ok(index) if (index as usize) < count => Ok(index),
        _ => Err(format!("a face names vertex {number}, but {count} are given so far")),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn order_is_kept_and_polygons_become_fans() {
        let text = "# square\nv 9 9 9 1\nv 0 0 0\nv 1 0 0\nv 1 1 0\nv 0 1 0\nvn 0 0 1\nf 5/1/1 2//1 -3 4\nf 1 3 4";
        let surface = parse(text.as_bytes()).unwrap();
        assert_eq!(surface.positions[0], Vec3::splat(9.0));
        assert_eq!(surface.triangles, [[4, 1, 2], [4, 2, 3], [0, 2, 3]]);
    }

    #[test]
    fn errors_name_the_line() {
        for (text, line) in [
            ("v 1 2", 1),
            ("v 1 2 3\nf 1 1", 2),
            ("v 1 2 3\n\nf 1 2 3", 3),
            ("v 1 2 3\nf 0 1 1", 2),
            ("v 1 2 3\nf -2 1 1", 2),
            ("f a b c", 1),
        ] {
            match parse(text.as_bytes()) {
                Err(GarmentError::Obj { line: found, .. }) => assert_eq!(found, line, "{text}"),
                other => panic!("{text}: {other:?}"),
            }
        }
    }
}
