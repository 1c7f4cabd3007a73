//! Reduced pictures that were asked for lately, so that no stack is read twice for one thumbnail.

use std::collections::HashMap;
use std::sync::{Arc, Mutex, PoisonError};

use ndarray::Array2;
use tokio::sync::{OnceCell, Semaphore};

use super::render::{Picture, Region};
use crate::http::error::{ApiError, Code};

/// Memory for reduced pictures, in bytes.
const BUDGET: usize = 64 << 20;
/// Pictures that are reduced at the same time: the cores are for the workers.
const PLACES: usize = 2;

type Cell = Arc<OnceCell<Arc<Array2<f32>>>>;

/// Reduces pictures, each of them once for all who ask for it.
#[derive(Debug)]
pub(in crate::http) struct Pictures {
    held: Mutex<Held>,
    places: Semaphore,
}

#[derive(Debug, Default)]
struct Held {
    cells: HashMap<(String, Region), (Cell, usize, u64)>,
    bytes: usize,
    clock: u64,
}

impl Pictures {
    pub(in crate::http) fn new() -> Self {
        Self { held: Mutex::default(), places: Semaphore::new(PLACES) }
    }

    /// The values of a region.
    pub(super) async fn reduced(
        &self,
        picture: Arc<Picture>,
        region: Region,
    ) -> Result<Arc<Array2<f32>>, ApiError> {
        let cell = self.cell(&picture, &region);
        let values = cell.get_or_try_init(|| async {
            let stopped = |_| ApiError::new(Code::Unavailable, "the service is shutting down");
            let _place = self.places.acquire().await.map_err(stopped)?;
            let reduce = tokio::task::spawn_blocking(move || picture.reduce(&region));
            let values = reduce.await.map_err(|error| ApiError::internal(&error))?;
            Ok(Arc::new(values.map_err(super::unreadable)?))
        });
        values.await.cloned()
    }

    /// The place of a region's values, empty if nobody has asked for them lately.
    fn cell(&self, picture: &Picture, region: &Region) -> Cell {
        // Whole values are stored: a poisoned lock holds good ones.
        let mut held = self.held.lock().unwrap_or_else(PoisonError::into_inner);
        held.clock += 1;
        let clock = held.clock;
        let key = (picture.identity.clone(), region.clone());
        if let Some((cell, _, used)) = held.cells.get_mut(&key) {
            *used = clock;
            return cell.clone();
        }
        let bytes = region.rows.len() * region.columns.len() * size_of::<f32>();
        held.make_room(bytes);
        let cell = Cell::default();
        held.cells.insert(key, (cell.clone(), bytes, clock));
        held.bytes += bytes;
        cell
    }
}

impl Held {
    /// Lets go of what was not asked for the longest.
    fn make_room(&mut self, bytes: usize) {
        while self.bytes + bytes > BUDGET {
            let oldest = self.cells.iter().min_by_key(|(_, (_, _, used))| *used);
            let Some(key) = oldest.map(|(key, _)| key.clone()) else { return };
            if let Some((_, freed, _)) = self.cells.remove(&key) {
                self.bytes -= freed;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::{BUDGET, Pictures};
    use crate::http::pictures::render::Picture;
    use ndarray::Array2;

    fn picture(name: usize, reads: &Arc<AtomicUsize>) -> Arc<Picture> {
        let reads = reads.clone();
        Arc::new(Picture {
            height: 1024,
            width: 1024,
            identity: name.to_string(),
            settled: true,
            depth: 1,
            read: Box::new(move |rows, columns| {
                reads.fetch_add(1, Ordering::Relaxed);
                Ok(Array2::zeros((rows.len(), columns.len())))
            }),
        })
    }

    #[tokio::test]
    async fn a_picture_is_read_once_and_memory_is_bounded() {
        let (pictures, reads) = (Pictures::new(), Arc::new(AtomicUsize::new(0)));
        let ask = async |name| {
            let picture = picture(name, &reads);
            let whole = picture.whole(0);
            pictures.reduced(picture, whole).await.unwrap().len()
        };
        let both = tokio::join!(ask(0), ask(0));
        assert_eq!(both, (1 << 20, 1 << 20));
        assert_eq!(reads.load(Ordering::Relaxed), 1, "who asks at the same time waits");
        for name in 0..40 {
            ask(name).await;
        }
        let held = pictures.held.lock().unwrap().bytes;
        assert!(held <= BUDGET && held > BUDGET / 2, "{held}");
        let before = reads.load(Ordering::Relaxed);
        ask(39).await;
        assert_eq!(reads.load(Ordering::Relaxed), before);
        ask(0).await;
        assert_eq!(reads.load(Ordering::Relaxed), before + 1, "long forgotten");
    }
}
