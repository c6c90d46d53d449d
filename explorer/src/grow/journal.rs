//! The journal: an append-only log of records.
//!
//! | offset | bytes | what |
//! | --- | --- | --- |
//! | 0 | 8 | magic `TOILEjl1` |
//! | 8 | ... | records |
//!
//! | bytes of a record | what |
//! | --- | --- |
//! | 4 | length n of the payload, little-endian |
//! | n | payload: a [`Record`] in postcard |
//! | 8 | first bytes of BLAKE3 over the record's offset (u64, little-endian) and the payload |
//!
//! Records that have grown many are **compacted**: a new journal with the same records, the newer of them packed
//! into one, takes the old one's place in one step. So a journal is the header, packed records (a tenth of what
//! they were), and a short tail; killed at any instant it is the old one or the new one.
//!
//! A record is on the disk before the next is written, so only the last can be torn: it is cut
//! off when the journal is opened. A bad record with a good one anywhere behind it, or with more behind it than one
//! record can have, is damage, and refused.

use std::fs::File;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use super::compact;
use super::files;
use super::record::Record;

const MAGIC: &[u8; 8] = b"TOILEjl1";
/// Largest payload: 4,096 frames and a hundred thousand re-merges fit several times over.
const RECORD_BYTES_MAX: usize = 16 << 20;
const LENGTH_BYTES: usize = 4;
const CHECK_BYTES: usize = 8;
/// A tail of more bytes than this is compacted, unless another number is asked for.
pub const TAIL_BYTES: u64 = 64 << 10;
/// So much is copied at once.
const COPY_BYTES: u64 = 1 << 20;

/// Why a journal could not be opened.
#[derive(Debug, thiserror::Error)]
#[non_exhaustive]
pub enum JournalError {
    /// It could not be read or written.
    #[error(transparent)]
    Io(#[from] io::Error),
    /// It is some other file.
    #[error("this is not a journal of toile")]
    Foreign,
    /// It was damaged.
    #[error("the record at byte {0} is damaged, with whole records behind it; restore a copy")]
    Damaged(u64),
    /// A record of another version.
    #[error("the record at byte {0} cannot be understood: another version of toile wrote it")]
    Unknown(u64),
}

/// See the module.
#[derive(Debug)]
pub struct Journal {
    file: File,
    path: PathBuf,
    end: u64,
    /// Where records begin that are not packed, the header apart.
    tail: u64,
}

impl Journal {
    /// Makes a journal that holds one record, in one step.
    ///
    /// # Errors
    /// It cannot be written.
    pub fn create(path: &Path, first: &Record) -> io::Result<Self> {
        let mut bytes = MAGIC.to_vec();
        bytes.extend_from_slice(&frame(first, MAGIC.len() as u64)?);
        let file = files::create_whole(path, &bytes)?;
        let end = bytes.len() as u64;
        Ok(Self { file, path: path.to_owned(), end, tail: end })
    }

    /// Opens a journal and hands every record to `each`, in order; cuts a torn tail off and says
    /// how many bytes it had.
    ///
    /// # Errors
    /// It is not a journal, was damaged, or `each` refuses a record.
    pub fn open<E: From<JournalError>>(
        path: &Path,
        mut each: impl FnMut(Record) -> Result<(), E>,
    ) -> Result<(Self, u64), E> {
        let io = |error| E::from(JournalError::Io(error));
        let file = File::options().read(true).write(true).open(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let mut magic = [0; MAGIC.len()];
        let whole = length >= magic.len() as u64;
        if !whole || files::read_at(&file, &mut magic, 0).is_err() || &magic != MAGIC {
            return Err(JournalError::Foreign.into());
        }
        let mut journal = Self { file, path: path.to_owned(), end: MAGIC.len() as u64, tail: 0 };
        journal.replay(length, &mut each)?;
        let torn = journal.cut_tail(length)?;
        Ok((journal, torn))
    }

    /// Hands every whole record to `each`, in order, and changes nothing: an explorer may be
    /// writing.
    ///
    /// # Errors
    /// As for [`Journal::open`]; a damaged record is taken for one that is being written.
    pub fn read<E: From<JournalError>>(
        path: &Path,
        mut each: impl FnMut(Record) -> Result<(), E>,
    ) -> Result<(), E> {
        let io = |error| E::from(JournalError::Io(error));
        let file = File::open(path).map_err(io)?;
        let length = file.metadata().map_err(io)?.len();
        let mut magic = [0; MAGIC.len()];
        if files::read_at(&file, &mut magic, 0).is_err() || &magic != MAGIC {
            return Err(JournalError::Foreign.into());
        }
        let mut journal = Self { file, path: path.to_owned(), end: MAGIC.len() as u64, tail: 0 };
        journal.replay(length, &mut each)
    }

    fn replay<E: From<JournalError>>(
        &mut self,
        length: u64,
        each: &mut impl FnMut(Record) -> Result<(), E>,
    ) -> Result<(), E> {
        let io = |error| E::from(JournalError::Io(error));
        while let Some(payload) = self.payload(self.end, length).map_err(io)? {
            let at = self.end;
            let unknown = || E::from(JournalError::Unknown(at));
            let record = postcard::from_bytes(&payload).map_err(|_| unknown())?;
            self.end += (LENGTH_BYTES + payload.len() + CHECK_BYTES) as u64;
            let is_packed = matches!(record, Record::Compacted(_));
            match record {
                Record::Compacted(packed) => {
                    for record in compact::unpack(&packed) {
                        each(record.ok_or_else(unknown)?)?;
                    }
                }
                record => each(record)?,
            }
            if is_packed || self.tail == 0 {
                self.tail = self.end;
            }
        }
        Ok(())
    }

    /// Appends a record and waits until it is on the disk.
    ///
    /// # Errors
    /// It could not be written; what was written before it is safe.
    pub fn append(&mut self, record: &Record) -> io::Result<()> {
        let bytes = frame(record, self.end)?;
        files::write_at(&self.file, &bytes, self.end)?;
        self.file.sync_data()?;
        self.end += bytes.len() as u64;
        Ok(())
    }

    /// Bytes of the records that are not packed, the header apart.
    pub fn tail_bytes(&self) -> u64 {
        self.end - self.tail
    }

    /// Bytes of the whole file.
    pub fn bytes(&self) -> u64 {
        self.end
    }

    /// Packs the records of the tail into one. `states`: how many the graph has by now.
    ///
    /// # Errors
    /// The journal cannot be read or the new one not written: the old one is in its place and as it was.
    pub fn compact(&mut self, states: u64) -> io::Result<()> {
        let mut records = Vec::new();
        let mut at = self.tail;
        while let Some(payload) = self.payload(at, self.end)? {
            records.push(postcard::from_bytes(&payload).map_err(io::Error::other)?);
            at += (LENGTH_BYTES + payload.len() + CHECK_BYTES) as u64;
        }
        let frames = |record: &Record| match record {
            Record::Job(job) => job.frames.len() as u64,
            _ => 0,
        };
        let first = states.saturating_sub(records.iter().map(frames).sum());
        let packed = compact::pack(&records, first).map_err(io::Error::other)?;
        let packed = frame(&Record::Compacted(packed), self.tail)?;
        let file = files::create_with(&self.path, |file| {
            let mut at = 0;
            while at < self.tail {
                let mut bytes = vec![0; COPY_BYTES.min(self.tail - at) as usize];
                files::read_at(&self.file, &mut bytes, at)?;
                file.write_all(&bytes)?;
                at += bytes.len() as u64;
            }
            file.write_all(&packed)
        })?;
        self.file = file;
        self.end = self.tail + packed.len() as u64;
        self.tail = self.end;
        Ok(())
    }

    /// Where it lies.
    pub fn path(&self) -> &Path {
        &self.path
    }

    /// The payload of a whole record at `offset`, else `None`.
    fn payload(&self, offset: u64, length: u64) -> io::Result<Option<Vec<u8>>> {
        let Some(size) = self.declared(offset, length)? else { return Ok(None) };
        let mut bytes = vec![0; size + CHECK_BYTES];
        files::read_at(&self.file, &mut bytes, offset + LENGTH_BYTES as u64)?;
        let check = bytes.split_off(size);
        Ok((check == checksum(offset, &bytes)).then_some(bytes))
    }

    /// The length that a record at `offset` declares, if a record of that length fits there.
    fn declared(&self, offset: u64, length: u64) -> io::Result<Option<usize>> {
        let overhead = (LENGTH_BYTES + CHECK_BYTES) as u64;
        if offset + overhead > length {
            return Ok(None);
        }
        let mut size = [0; LENGTH_BYTES];
        files::read_at(&self.file, &mut size, offset)?;
        let size = u32::from_le_bytes(size);
        let fits = size > 0
            && size as usize <= RECORD_BYTES_MAX
            && offset + overhead + u64::from(size) <= length;
        Ok(fits.then_some(size as usize))
    }

    fn cut_tail(&mut self, length: u64) -> Result<u64, JournalError> {
        if self.is_damage(length)? {
            return Err(JournalError::Damaged(self.end));
        }
        if length > self.end {
            self.file.set_len(self.end)?;
            self.file.sync_data()?;
        }
        Ok(length - self.end)
    }

    /// Whether what follows the last good record is more than one that was torn. The length that a bad record
    /// declares may be what is bad, so a good one is looked for at every place.
    fn is_damage(&self, length: u64) -> io::Result<bool> {
        let behind = length - self.end;
        if behind > (LENGTH_BYTES + RECORD_BYTES_MAX + CHECK_BYTES) as u64 {
            return Ok(true);
        }
        let mut bytes = vec![0; behind as usize];
        files::read_at(&self.file, &mut bytes, self.end)?;
        Ok((1..bytes.len()).any(|at| is_record(&bytes[at..], self.end + at as u64)))
    }
}

/// Whether these bytes, at this offset of a journal, begin with a whole record.
fn is_record(bytes: &[u8], offset: u64) -> bool {
    let Some((size, rest)) = bytes.split_first_chunk::<LENGTH_BYTES>() else { return false };
    let size = u32::from_le_bytes(*size) as usize;
    if size == 0 || rest.len() < size || rest.len() - size < CHECK_BYTES {
        return false;
    }
    let (payload, check) = rest.split_at(size);
    check[..CHECK_BYTES] == checksum(offset, payload)
}

fn frame(record: &Record, offset: u64) -> io::Result<Vec<u8>> {
    let payload = postcard::to_stdvec(record).map_err(io::Error::other)?;
    if payload.len() > RECORD_BYTES_MAX {
        return Err(io::Error::other(format!("a record of {} bytes", payload.len())));
    }
    let mut bytes = (payload.len() as u32).to_le_bytes().to_vec();
    bytes.extend_from_slice(&payload);
    bytes.extend_from_slice(&checksum(offset, &payload));
    Ok(bytes)
}

fn checksum(offset: u64, payload: &[u8]) -> [u8; CHECK_BYTES] {
    let mut hasher = blake3::Hasher::new();
    hasher.update(&offset.to_le_bytes()).update(payload);
    let mut check = [0; CHECK_BYTES];
    hasher.finalize_xof().fill(&mut check);
    check
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::grow::record::FailedRecord;
    use protocol::StateId;

    fn record(index: u32) -> Record {
        Record::Failed(FailedRecord { round: 300, index, start: StateId(1 << 20) })
    }

    fn read(path: &Path) -> Result<(Vec<Record>, u64), JournalError> {
        let mut records = Vec::new();
        let (_, torn) = Journal::open(path, |record| {
            records.push(record);
            Ok::<_, JournalError>(())
        })?;
        Ok((records, torn))
    }

    fn three(path: &Path) -> Vec<u8> {
        let mut journal = Journal::create(path, &record(0)).unwrap();
        journal.append(&record(1)).unwrap();
        journal.append(&record(2)).unwrap();
        std::fs::read(path).unwrap()
    }

    #[test]
    fn cut_anywhere_it_ends_with_the_last_whole_record() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("journal");
        let bytes = three(&path);
        let size = (bytes.len() - 8) / 3;
        for cut in 8 + size..=bytes.len() {
            std::fs::write(&path, &bytes[..cut]).unwrap();
            let (records, torn) = read(&path).unwrap();
            assert_eq!(records.len(), (cut - 8) / size, "{cut}");
            assert_eq!(torn as usize, (cut - 8) % size);
            assert_eq!(std::fs::metadata(&path).unwrap().len() as usize, cut - torn as usize);
        }
    }

    #[test]
    fn a_compacted_journal_holds_the_same_records_and_goes_on() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("journal");
        let mut journal = Journal::create(&path, &record(0)).unwrap();
        let mut expected = vec![record(0)];
        for index in 1..60 {
            journal.append(&record(index)).unwrap();
            expected.push(record(index));
            if index % 17 == 0 {
                let before = journal.bytes();
                journal.compact(1).unwrap();
                assert!(journal.tail_bytes() == 0 && journal.bytes() < before);
            }
            if index % 11 == 0 {
                // Killed while it was compacted: what was begun is not looked at.
                std::fs::write(folder.path().join("journal.new"), b"TOILE").unwrap();
                let (again, torn) = Journal::open(&path, |_| Ok::<_, JournalError>(())).unwrap();
                assert_eq!((torn, again.tail, again.end), (0, journal.tail, journal.end));
                journal = again;
            }
            assert_eq!(read(&path).unwrap().0, expected);
        }
    }

    #[test]
    fn a_torn_last_record_is_cut_and_damage_before_it_is_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("journal");
        let bytes = three(&path);
        let size = (bytes.len() - 8) / 3;
        for at in 8 + 2 * size..bytes.len() {
            let mut torn = bytes.clone();
            torn[at] ^= 0x10;
            std::fs::write(&path, &torn).unwrap();
            assert_eq!(read(&path).unwrap().0, [record(0), record(1)]);
        }
        // Wherever it is: in the length, the payload, or the check sum.
        for at in 8 + size..8 + 2 * size {
            for bit in 0..8 {
                let mut damaged = bytes.clone();
                damaged[at] ^= 1 << bit;
                std::fs::write(&path, &damaged).unwrap();
                let error = read(&path).unwrap_err();
                assert!(matches!(error, JournalError::Damaged(at) if at as usize == 8 + size));
                assert_eq!(std::fs::read(&path).unwrap(), damaged, "nothing is cut");
            }
        }
        std::fs::write(&path, b"something else").unwrap();
        assert!(matches!(read(&path).unwrap_err(), JournalError::Foreign));
    }
}
