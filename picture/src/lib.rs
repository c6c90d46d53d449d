//! Pictures for people who look: is the cloth where it should be, and does the error fall?
//!
//! # Goals
//! - A mesh becomes a picture within some tens of milliseconds, without a graphics card.
//! - Faults are to be seen: the back of a triangle has another hue than its front, a contact shadow
//!   shows what floats, colours by vertex show strain or error.
//! - Equal input, equal bytes (on one machine), so that a picture can be a test.
//!
//! # Non-goals
//! - No files, threads, clocks or windows: every function returns values or bytes.
//! - Not a renderer for games: no textures, no materials, no reflections.
//!
//! # Example
//! ```
//! use glam::Vec3;
//! use picture::{Camera, Layer, Paint, Sheet, View};
//!
//! let positions = [Vec3::ZERO, Vec3::X, Vec3::Y];
//! let triangles = [[0, 1, 2]];
//! let cloth = Layer { positions: &positions, triangles: &triangles, paint: Paint::CLOTH };
//! let view = View::new(Camera::around(Vec3::new(0.5, 0.5, 0.0), 3.0), 120, 90);
//! let mut sheet = Sheet::new(2);
//! sheet.push(picture::render(&view, &[cloth])?, "frame 0");
//! let png: Vec<u8> = sheet.image()?.png()?;
//! assert_eq!(&png[1..4], b"PNG");
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! # Map
//! | module | what |
//! | --- | --- |
//! | [`mod@glb`] | a moving clip of meshes as binary glTF, for Blender and others |
//! | [`drawing`] | very many lines, as SVG and as a picture |
//! | [`image`] | an RGB picture: fill, line, text, PNG in and out |
//! | [`plot`] | line plots, as SVG and as a picture |
//! | [`raster`] | meshes to a picture: z-buffer, two-sided shading, ground and its shadow |
//! | [`sheet`] | a grid of pictures with captions |

mod camera;
pub mod drawing;
mod font;
pub mod glb;
pub mod image;
pub mod plot;
pub mod raster;
pub mod sheet;

pub use camera::Camera;
pub use drawing::Drawing;
pub use glb::{Clip, ClipMesh, GlbError, glb};
pub use image::{Image, ImageError, Rgb};
pub use plot::{Plot, Series};
pub use raster::{Layer, Paint, RasterError, View, render};
pub use sheet::Sheet;
