//! How much room is left.

use std::path::Path;

/// Bytes that a process of this user may still write on the disk of a folder, or of the nearest
/// folder above it that exists; `None` where the system does not tell.
pub fn free_bytes(folder: &Path) -> Option<u64> {
    let folder = folder.ancestors().find(|folder| folder.exists())?;
    of(folder)
}

#[cfg(unix)]
fn of(folder: &Path) -> Option<u64> {
    let found = rustix::fs::statvfs(folder).ok()?;
    found.f_bavail.checked_mul(found.f_frsize)
}

#[cfg(not(unix))]
fn of(_: &Path) -> Option<u64> {
    None
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    #[cfg(unix)]
    fn the_disk_of_a_folder_to_be_made_is_known() {
        let folder = tempfile::tempdir().unwrap();
        let free = free_bytes(&folder.path().join("not/yet")).unwrap();
        assert!(free > 0 && free < 1 << 60, "{free}");
    }
}
