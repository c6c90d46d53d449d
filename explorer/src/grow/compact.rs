//! Records of the journal, packed: what a compaction makes of them, and back.
//!
//! Most frames follow on the one before along the next edge, in the same class, and are not merged: of such
//! frames only their number is written. Nothing is dropped, so a compacted journal replays to the same graph,
//! every moment of its past included.

use serde::Serialize;
use serde::de::DeserializeOwned;

use protocol::{EdgeId, StateId};

use super::class::Class;
use super::record::{FrameRecord, JobRecord, MergeRecord, Record};
use crate::simulator::FrameQuality;

/// Most frames of one packed record: far more than a job may have.
const FRAMES_MAX: u64 = 1 << 20;

/// A job without its frames.
type Job = (u64, u32, StateId, FrameQuality, Option<f32>, Vec<MergeRecord>, u64);
/// A frame that is not as expected: how far back its parent lies, the step to its edge, its class, and the
/// merge's target, as far back, with its error.
type Frame = (u64, i64, Class, Option<(i64, f32)>);

/// Records in a row, the first of them made when the graph had `first` states.
pub fn pack(records: &[Record], first: u64) -> postcard::Result<Vec<u8>> {
    let mut out = Vec::new();
    put(&mut out, &(first, records.len() as u64))?;
    let mut next = first;
    for record in records {
        let Record::Job(job) = record else {
            put(&mut out, &false)?;
            put(&mut out, record)?;
            continue;
        };
        put(&mut out, &true)?;
        let JobRecord { round, index, start, quality, future_m, remerges, frames } = job;
        let head: (_, _, _, _, _, &[MergeRecord], _) =
            (round, index, start, quality, future_m, remerges, frames.len() as u64);
        put(&mut out, &head)?;
        next = pack_frames(&mut out, *start, frames, next)?;
    }
    Ok(out)
}

/// Gives the records back, one by one; `None` where these are no packed records.
pub fn unpack(mut bytes: &[u8]) -> impl Iterator<Item = Option<Record>> {
    let head: Option<(u64, u64)> = take(&mut bytes);
    let (mut next, mut left) = head.unwrap_or((0, 1));
    let mut sound = head.is_some();
    std::iter::from_fn(move || {
        if left == 0 && sound {
            sound = bytes.is_empty();
            return if sound { None } else { Some(None) };
        }
        if !sound {
            return (std::mem::take(&mut left) > 0).then_some(None);
        }
        left -= 1;
        let record = unpack_record(&mut bytes, &mut next);
        sound = record.is_some();
        left = if sound { left } else { 0 };
        Some(record)
    })
}

fn unpack_record(bytes: &mut &[u8], next: &mut u64) -> Option<Record> {
    if !take::<bool>(bytes)? {
        return take(bytes);
    }
    let (round, index, start, quality, future_m, remerges, count): Job = take(bytes)?;
    let frames = unpack_frames(bytes, start, count, next)?;
    Some(Record::Job(JobRecord { round, index, start, frames, remerges, quality, future_m }))
}

/// What a frame is expected to be after the one before, whose id is `before`.
fn expected(before: &FrameRecord, id: u64) -> FrameRecord {
    let edge = EdgeId(before.edge.0.wrapping_add(1));
    FrameRecord { parent: StateId(id), edge, class: before.class, merge: None }
}

/// The frame before the first one of a job.
fn origin(start: StateId) -> FrameRecord {
    FrameRecord { parent: start, edge: EdgeId(0), class: 0, merge: None }
}

fn pack_frames(
    out: &mut Vec<u8>,
    start: StateId,
    frames: &[FrameRecord],
    first: u64,
) -> postcard::Result<u64> {
    let (mut before, mut before_id, mut plain) = (origin(start), start.0, 0u64);
    let mut id = first;
    for frame in frames {
        if *frame == expected(&before, before_id) {
            plain += 1;
        } else {
            put(out, &std::mem::take(&mut plain))?;
            let back = |state: StateId| id.wrapping_sub(state.0);
            let step = i64::from(frame.edge.0) - i64::from(before.edge.0);
            let merge = frame.merge.map(|(target, error_m)| (back(target) as i64, error_m));
            put::<Frame>(out, &(back(frame.parent), step, frame.class, merge))?;
        }
        (before, before_id) = (*frame, id);
        id += 1;
    }
    if plain > 0 {
        put(out, &plain)?;
    }
    Ok(id)
}

fn unpack_frames(
    bytes: &mut &[u8],
    start: StateId,
    count: u64,
    next: &mut u64,
) -> Option<Vec<FrameRecord>> {
    if count > FRAMES_MAX {
        return None;
    }
    let (mut before, mut before_id) = (origin(start), start.0);
    let mut frames = Vec::new();
    while (frames.len() as u64) < count {
        let plain: u64 = take(bytes)?;
        if plain > count - frames.len() as u64 {
            return None;
        }
        for _ in 0..plain {
            before = expected(&before, before_id);
            frames.push(before);
            (before_id, *next) = (*next, next.checked_add(1)?);
        }
        if (frames.len() as u64) < count {
            let (back, step, class, merge): Frame = take(bytes)?;
            let id = |back: u64| StateId(next.wrapping_sub(back));
            let edge = u32::try_from(i64::from(before.edge.0).checked_add(step)?).ok()?;
            let merge = merge.map(|(back, error_m)| (id(back as u64), error_m));
            before = FrameRecord { parent: id(back), edge: EdgeId(edge), class, merge };
            frames.push(before);
            (before_id, *next) = (*next, next.checked_add(1)?);
        }
    }
    Some(frames)
}

fn put<T: Serialize + ?Sized>(out: &mut Vec<u8>, value: &T) -> postcard::Result<()> {
    let bytes = postcard::to_stdvec(value)?;
    out.extend_from_slice(&bytes);
    Ok(())
}

fn take<T: DeserializeOwned>(bytes: &mut &[u8]) -> Option<T> {
    let (value, rest) = postcard::take_from_bytes(bytes).ok()?;
    *bytes = rest;
    Some(value)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::grow::record::FailedRecord;

    fn any_job() -> impl Strategy<Value = Record> {
        let merge = proptest::option::of((0u64..2000, 0f32..9.0));
        let frame = (0u64..2000, 0u32..50, 0u8..3, merge, any::<bool>());
        (0u64..1000, proptest::collection::vec(frame, 0..40)).prop_map(|(start, rows)| {
            let mut frames: Vec<FrameRecord> = Vec::new();
            for (place, (parent, edge, class, merge, plain)) in (1000u64..).zip(rows) {
                let merge = merge.map(|(target, error_m)| (StateId(target), error_m));
                let odd = FrameRecord { parent: StateId(parent), edge: EdgeId(edge), class, merge };
                let before = frames.last().copied().unwrap_or(origin(StateId(start)));
                let id = if frames.is_empty() { start } else { place - 1 };
                frames.push(if plain { expected(&before, id) } else { odd });
            }
            let merge = MergeRecord { state: StateId(3), target: StateId(9), error_m: 0.5 };
            Record::Job(JobRecord {
                round: 7,
                index: 3,
                start: StateId(start),
                frames,
                remerges: vec![merge],
                quality: FrameQuality { frames: 9, stretch_max: 0.1, ..FrameQuality::default() },
                future_m: Some(0.25),
            })
        })
    }

    proptest! {
        #[test]
        fn what_was_packed_comes_back(mut records in proptest::collection::vec(any_job(), 0..6)) {
            records.push(Record::Failed(FailedRecord { round: 1, index: 2, start: StateId(3) }));
            let bytes = pack(&records, 1000).unwrap();
            let back: Option<Vec<Record>> = unpack(&bytes).collect();
            prop_assert_eq!(back, Some(records));
        }

        #[test]
        fn bytes_from_anywhere_are_refused_or_read(
            records in proptest::collection::vec(any_job(), 1..4), at in any::<usize>(), by in 1u8..,
        ) {
            let mut bytes = pack(&records, 1000).unwrap();
            let at = at % bytes.len();
            prop_assert!(unpack(&bytes[..at]).any(|record| record.is_none()), "cut at {}", at);
            bytes[at] ^= by;
            unpack(&bytes).for_each(drop);
        }
    }

    #[test]
    fn a_chain_of_plain_frames_takes_next_to_nothing() {
        let quality = FrameQuality::default();
        let mut frames = vec![FrameRecord { edge: EdgeId(40), ..origin(StateId(5)) }];
        for id in 1000..1029 {
            frames.push(expected(frames.last().unwrap(), id));
        }
        let job = JobRecord {
            round: 1,
            index: 0,
            start: StateId(5),
            frames,
            remerges: Vec::new(),
            quality,
            future_m: None,
        };
        let bytes = pack(&[Record::Job(job)], 1000).unwrap();
        assert!(bytes.len() < 45, "{} bytes for 30 frames", bytes.len());
    }
}
