//! Tests of everything that travels and everything that is stored.

mod formats;
mod samples;
mod versions;
