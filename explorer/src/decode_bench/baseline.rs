//! What one would write without thinking about memory: a library's product, and a loop.

use std::convert::Infallible;
use std::hint::black_box;

use faer::linalg::matmul::matmul;
use faer::{Accum, ColMut, ColRef, MatRef, Par};

use super::{noise, time};

/// faer's f32 matrix times vector on one thread, the better of both layouts (us).
pub(super) fn faer(rows: usize, columns: usize) -> f64 {
    let (entries, c) = (noise(21, rows * columns), noise(22, columns));
    let mut out = vec![0.0f32; rows];
    let by_row = MatRef::from_row_major_slice(&entries, rows, columns);
    let by_column = MatRef::from_column_major_slice(&entries, rows, columns);
    [by_row, by_column]
        .map(|matrix| {
            let measured = time::<Infallible>(&[], || {
                let to = ColMut::from_slice_mut(&mut out);
                matmul(
                    to,
                    Accum::Replace,
                    black_box(matrix),
                    ColRef::from_slice(&c),
                    1.0,
                    Par::Seq,
                );
                Ok(())
            });
            match measured {
                Ok(us) => us,
            }
        })
        .into_iter()
        .fold(f64::INFINITY, f64::min)
}

/// A loop over columns, as the compiler makes it (us).
pub(super) fn plain(rows: usize, columns: usize) -> f64 {
    let (entries, c) = (noise(21, rows * columns), noise(22, columns));
    let mut out = vec![0.0f32; rows];
    let measured = time::<Infallible>(&[], || {
        out.fill(0.0);
        for (column, c) in black_box(&entries).chunks_exact(rows).zip(&c) {
            for (out, entry) in out.iter_mut().zip(column) {
                *out += entry * c;
            }
        }
        black_box(&mut out);
        Ok(())
    });
    match measured {
        Ok(us) => us,
    }
}
