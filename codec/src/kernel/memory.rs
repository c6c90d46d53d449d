//! Memory for what is read once a frame from end to end.

/// An empty list with room for `count` items, on huge pages where the system gives them: a walk
/// over 24 MB then needs 12 address translations instead of 6,000.
pub(crate) fn with_huge_pages<T>(count: usize) -> Vec<T> {
    let list = Vec::with_capacity(count);
    advise(&list);
    list
}

/// A list that is read from end to end once a frame, wholly on huge pages where the system gives
/// them: a [`Vec`] of a few MB begins anywhere, and its first and last part would lie on small ones.
#[derive(Debug)]
pub(crate) struct Huge<T> {
    list: Vec<T>,
    /// Where it begins: what lies before is filling.
    first: usize,
}

impl<T: Copy> Huge<T> {
    /// Takes the items over. Up to a huge page is lost where that is little beside them.
    pub(crate) fn new(items: &[T], filling: T) -> Self {
        let size = size_of::<T>().max(1);
        // Filling must end where a page begins.
        let aligned = HUGE_PAGE.is_multiple_of(size);
        if size_of_val(items) < HUGE_PAGE / 2 || !aligned {
            return Self { list: items.to_vec(), first: 0 };
        }
        let mut list: Vec<T> = Vec::with_capacity(items.len() + 2 * HUGE_PAGE / size);
        let start = list.as_ptr() as usize;
        let first = (start.next_multiple_of(HUGE_PAGE) - start) / size;
        list.resize(first, filling);
        advise(&list);
        list.extend_from_slice(items);
        Self { list, first }
    }
}

impl<T: Copy> Clone for Huge<T> {
    fn clone(&self) -> Self {
        match self.first() {
            Some(filling) => Self::new(self, *filling),
            None => Self { list: Vec::new(), first: 0 },
        }
    }
}

impl<T> std::ops::Deref for Huge<T> {
    type Target = [T];

    fn deref(&self) -> &[T] {
        &self.list[self.first..]
    }
}

const HUGE_PAGE: usize = 2 << 20;

#[cfg(target_os = "linux")]
#[allow(unsafe_code)] // madvise
fn advise<T>(list: &Vec<T>) {
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
