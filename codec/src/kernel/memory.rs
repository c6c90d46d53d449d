//! Memory for what is read once a frame from end to end.

/// An empty list with room for `count` items, on huge pages where the system gives them: a walk
/// over 24 MB then needs 12 address translations instead of 6,000.
pub(crate) fn with_huge_pages<T>(count: usize) -> Vec<T> {
    let list = Vec::with_capacity(count);
    advise(&list);
    list
}

#[cfg(target_os = "linux")]
#[allow(unsafe_code)] // madvise
fn advise<T>(list: &Vec<T>) {
    const HUGE_PAGE: usize = 2 << 20;
    let bytes = list.capacity() * size_of::<T>();
    let start = (list.as_ptr() as usize).next_multiple_of(HUGE_PAGE);
    let end = (list.as_ptr() as usize + bytes) / HUGE_PAGE * HUGE_PAGE;
    if start >= end {
        return;
    }
    // SAFETY: the range lies inside of memory that `list` owns, and this advice changes how the
    // kernel backs it, never what it holds. A refusal costs nothing but speed.
    let _ = unsafe {
        rustix::mm::madvise(start as *mut _, end - start, rustix::mm::Advice::LinuxHugepage)
    };
}

#[cfg(not(target_os = "linux"))]
fn advise<T>(_: &Vec<T>) {}
