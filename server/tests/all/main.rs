//! A server on loopback: real sockets, a store in a folder, versions made by hand.

mod abuse;
mod faults;
mod faulty;
mod player;
mod serving;
mod tags;
mod world;
