//! The state file: every state ever simulated, exactly, at a place that its id gives.
//!
//! | offset | bytes | what |
//! | --- | --- | --- |
//! | 0 | 8 | magic `TOILEst1` |
//! | 8 | 4 | vertex count, little-endian |
//! | 12 | 32 | BLAKE3 of the journal's header record |
//! | 44 | 20 | zero |
//! | 64 + id x 12 x vertices | 12 x vertices | positions, then velocities: i16 little-endian |
//!
//! Only appended to. What lies beyond the last state of the journal was never reported as done
//! and is cut off when the file is opened. Reads are positioned; the operating system's page cache is the cache.

use std::fs::File;
use std::io;
use std::path::Path;

use protocol::StateId;

use super::files;
use crate::grid::GridState;

const MAGIC: &[u8; 8] = b"TOILEst1";
const HEADER_BYTES: usize = 64;
const VERTEX_BYTES: usize = 12;

/// See the module.
#[derive(Debug)]
pub struct StateFile {
    file: File,
    vertex_count: usize,
}

impl StateFile {
    /// Makes a new, empty file at `path`, in one step; replaces what a torn start left there.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn create(path: &Path, vertex_count: u32, digest: &[u8; 32]) -> io::Result<Self> {
        let file = files::create_whole(path, &header(vertex_count, digest))?;
        Ok(Self { file, vertex_count: vertex_count as usize })
    }

    /// Whether there is a file with more than a header.
    ///
    /// # Errors
    /// The system does not tell.
    pub fn holds_states(path: &Path) -> io::Result<bool> {
        match std::fs::metadata(path) {
            Ok(found) => Ok(found.len() > HEADER_BYTES as u64),
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(false),
            Err(error) => Err(error),
        }
    }

    /// Opens the file of `states` states; cuts off what lies beyond them.
    ///
    /// # Errors
    /// The file cannot be read, is another file, or holds fewer states.
    pub fn open(
        path: &Path,
        vertex_count: u32,
        digest: &[u8; 32],
        states: u64,
    ) -> io::Result<Self> {
        let file = File::options().read(true).write(true).open(path)?;
        let file = Self::check(file, vertex_count, digest, states)?;
        file.file.set_len(file.offset(StateId(states)))?;
        Ok(file)
    }

    /// As [`StateFile::open`], for reading only: an explorer may be at work in the folder.
    ///
    /// # Errors
    /// As for [`StateFile::open`].
    pub fn open_to_read(
        path: &Path,
        vertex_count: u32,
        digest: &[u8; 32],
        states: u64,
    ) -> io::Result<Self> {
        Self::check(File::open(path)?, vertex_count, digest, states)
    }

    fn check(file: File, vertex_count: u32, digest: &[u8; 32], states: u64) -> io::Result<Self> {
        let mut found = [0; HEADER_BYTES];
        files::read_at(&file, &mut found, 0)?;
        if found != header(vertex_count, digest) {
            return Err(io::Error::other("this is not the state file of the journal beside it"));
        }
        let file = Self { file, vertex_count: vertex_count as usize };
        let needed = file.offset(StateId(states));
        let length = file.file.metadata()?.len();
        if length < needed {
            let text = format!("{length} bytes long, but the journal speaks of {needed}");
            return Err(io::Error::other(text));
        }
        Ok(file)
    }

    /// Opens a file to read what is in it, whatever the journal says, also while an explorer is at
    /// work.
    ///
    /// # Errors
    /// The file cannot be read or is no state file.
    pub fn view(path: &Path) -> io::Result<Self> {
        let file = File::open(path)?;
        let mut found = [0; HEADER_BYTES];
        files::read_at(&file, &mut found, 0)?;
        let vertex_count = u32::from_le_bytes([found[8], found[9], found[10], found[11]]);
        if found[..8] != *MAGIC || vertex_count == 0 {
            return Err(io::Error::other("this is no state file"));
        }
        Ok(Self { file, vertex_count: vertex_count as usize })
    }

    /// Vertices of a state.
    pub fn vertex_count(&self) -> usize {
        self.vertex_count
    }

    /// Bytes of a state.
    pub fn state_bytes(&self) -> u64 {
        (self.vertex_count * VERTEX_BYTES) as u64
    }

    /// Writes consecutive states and waits until they are on the disk.
    ///
    /// # Errors
    /// They cannot be written.
    pub fn write(&self, first: StateId, states: &[GridState]) -> io::Result<()> {
        self.write_unsynced(first, states)?;
        self.sync()
    }

    /// Waits until all that was written is on the disk.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn sync(&self) -> io::Result<()> {
        self.file.sync_data()
    }

    /// As [`StateFile::write`], without waiting.
    ///
    /// # Errors
    /// They cannot be written.
    pub fn write_unsynced(&self, first: StateId, states: &[GridState]) -> io::Result<()> {
        let mut bytes = Vec::with_capacity(states.len() * self.vertex_count * VERTEX_BYTES);
        for state in states {
            assert_eq!(state.vertex_count(), self.vertex_count, "a state of another mesh");
            for row in state.positions.iter().chain(&state.velocities) {
                row.iter().for_each(|step| bytes.extend_from_slice(&step.to_le_bytes()));
            }
        }
        files::write_at(&self.file, &bytes, self.offset(first))
    }

    /// Reads a state.
    ///
    /// # Errors
    /// It cannot be read.
    pub fn read(&self, state: StateId) -> io::Result<GridState> {
        let mut bytes = vec![0; self.vertex_count * VERTEX_BYTES];
        files::read_at(&self.file, &mut bytes, self.offset(state))?;
        Ok(self.parse(&bytes))
    }

    fn parse(&self, bytes: &[u8]) -> GridState {
        let step = |b: &[u8], axis: usize| i16::from_le_bytes([b[2 * axis], b[2 * axis + 1]]);
        let rows = bytes.chunks_exact(6).map(|b| [step(b, 0), step(b, 1), step(b, 2)]);
        let mut positions: Vec<[i16; 3]> = rows.collect();
        let velocities = positions.split_off(self.vertex_count);
        GridState { positions, velocities }
    }

    /// Reads `count` states, the first of them with this id, at once.
    ///
    /// # Errors
    /// They cannot be read.
    pub fn read_run(&self, first: StateId, count: usize) -> io::Result<Vec<GridState>> {
        let mut bytes = vec![0; count * self.vertex_count * VERTEX_BYTES];
        files::read_at(&self.file, &mut bytes, self.offset(first))?;
        Ok(bytes.chunks_exact(self.vertex_count * VERTEX_BYTES).map(|b| self.parse(b)).collect())
    }

    fn offset(&self, state: StateId) -> u64 {
        HEADER_BYTES as u64 + state.0 * (self.vertex_count * VERTEX_BYTES) as u64
    }
}

fn header(vertex_count: u32, digest: &[u8; 32]) -> [u8; HEADER_BYTES] {
    let mut header = [0; HEADER_BYTES];
    header[..8].copy_from_slice(MAGIC);
    header[8..12].copy_from_slice(&vertex_count.to_le_bytes());
    header[12..44].copy_from_slice(digest);
    header
}

#[cfg(test)]
mod tests {
    use super::*;

    fn state(seed: i16) -> GridState {
        GridState { positions: vec![[seed, -seed, 7]; 2], velocities: vec![[i16::MIN, seed, 0]; 2] }
    }

    #[test]
    fn states_come_back_and_stale_ones_are_cut_off() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("states");
        let file = StateFile::create(&path, 2, &[5; 32]).unwrap();
        file.write(StateId(0), &[state(1), state(2), state(3)]).unwrap();
        file.write(StateId(1), &[state(9)]).unwrap();
        drop(file);
        let file = StateFile::open(&path, 2, &[5; 32], 2).unwrap();
        assert_eq!(file.read(StateId(0)).unwrap(), state(1));
        assert_eq!(file.read(StateId(1)).unwrap(), state(9));
        assert!(file.read(StateId(2)).is_err());
        assert_eq!(std::fs::metadata(&path).unwrap().len(), 64 + 2 * 24);
    }

    #[test]
    fn other_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("states");
        StateFile::create(&path, 2, &[5; 32]).unwrap();
        for (vertices, digest, states) in [(3, 5, 0), (2, 6, 0), (2, 5, 1)] {
            let opened = StateFile::open(&path, vertices, &[digest; 32], states);
            assert!(opened.is_err(), "{vertices} {digest} {states}");
        }
    }
}
