//! Tests of everything that travels and everything that is stored.

mod formats;
mod link;
mod rudeness;
mod samples;
mod sessions;
mod versions;
