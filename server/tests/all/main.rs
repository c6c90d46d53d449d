//! A server on loopback: real sockets, a store in a folder, versions made by hand.

mod faults;
mod player;
mod serving;
mod tags;
mod world;
