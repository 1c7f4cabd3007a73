//! A cache of reduced pictures, so that a stack is not read again for each thumbnail or change of contrast.

use std::io::ErrorKind;
use std::sync::Arc;

use ndarray::Array2;
use quick_cache::sync::{Cache, DefaultLifecycle};
use quick_cache::{DefaultHashBuilder, OptionsBuilder, Weighter};
use tokio::sync::Semaphore;

use super::render::{Picture, Region};
use crate::http::error::{ApiError, Code, Result};
use formats::FormatError;

/// Memory for reduced pictures, in bytes.
const CACHE_BYTES: u64 = 64 << 20;
/// Pictures that are reduced at the same time. The limit leaves the other cores to the workers.
const CONCURRENT_REDUCTIONS: usize = 2;

type Key = (String, Region);
type Values = Arc<Array2<f32>>;

/// Reduces pictures and caches them. Concurrent requests for the same region share one reduction.
#[derive(Debug)]
pub(in crate::http) struct Pictures {
    reduced: Cache<Key, Values, SizeInBytes>,
    permits: Semaphore,
}

/// Weighs cached values by their size in bytes.
#[derive(Debug, Clone)]
struct SizeInBytes;

impl Weighter<Key, Values> for SizeInBytes {
    fn weight(&self, _: &Key, values: &Values) -> u64 {
        (values.len() * size_of::<f32>()) as u64
    }
}

impl Pictures {
    pub(in crate::http) fn new() -> Self {
        // With several shards, the largest pictures would exceed the share of one. Half of the memory is for pictures
        // that were requested once: a viewer requests all tiles of a screen again when the contrast changes.
        let options = OptionsBuilder::new()
            .shards(1)
            .estimated_items_capacity(1024)
            .weight_capacity(CACHE_BYTES)
            .hot_allocation(0.5)
            .build();
        // `build` fails only if an option is missing; all are given.
        let reduced = match options {
            Ok(options) => Cache::with_options(
                options,
                SizeInBytes,
                DefaultHashBuilder::default(),
                DefaultLifecycle::default(),
            ),
            Err(_) => Cache::with_weighter(1024, CACHE_BYTES, SizeInBytes),
        };
        Self { reduced, permits: Semaphore::new(CONCURRENT_REDUCTIONS) }
    }

    /// The values of a region of a picture, as [`Picture::reduce`] gives them.
    pub(in crate::http) async fn reduced(
        &self,
        picture: Arc<Picture>,
        region: Region,
    ) -> Result<Values> {
        let key = (picture.identity.clone(), region.clone());
        let reduce = async {
            let stopped = |_| ApiError::new(Code::Unavailable, "the service is shutting down");
            let _permit = self.permits.acquire().await.map_err(stopped)?;
            let reduce = tokio::task::spawn_blocking(move || picture.reduce(&region));
            let values = reduce.await.map_err(|error| ApiError::internal(&error))?;
            Ok(Arc::new(values.map_err(unreadable)?))
        };
        self.reduced.get_or_insert_async(&key, reduce).await
    }
}

/// Maps a missing file to 404: it was a tile of a snapshot that has just been assembled.
fn unreadable(error: FormatError) -> ApiError {
    match error {
        FormatError::Io { source, .. } if source.kind() == ErrorKind::NotFound => {
            ApiError::new(Code::NotReady, "the frames are being assembled; try again")
        }
        error => error.into(),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::{CACHE_BYTES, Pictures};
    use crate::http::rendering::Picture;
    use formats::Channels;
    use ndarray::Array2;

    fn picture(name: usize, reads: &Arc<AtomicUsize>) -> Arc<Picture> {
        let reads = reads.clone();
        Arc::new(Picture {
            height: 1024,
            width: 1024,
            identity: name.to_string(),
            channels: Channels::Grey,
            depth: 1,
            white: None,
            read: Box::new(move |rows, columns| {
                reads.fetch_add(1, Ordering::Relaxed);
                Ok(Array2::zeros((rows.len(), columns.len())))
            }),
        })
    }

    #[tokio::test]
    async fn a_picture_is_read_once_and_memory_is_bounded() {
        let (pictures, reads) = (Pictures::new(), Arc::new(AtomicUsize::new(0)));
        let request = async |name| {
            let picture = picture(name, &reads);
            let whole = picture.whole(0);
            pictures.reduced(picture, whole).await.unwrap().len()
        };
        let both = tokio::join!(request(0), request(0));
        assert_eq!(both, (1 << 20, 1 << 20));
        assert_eq!(reads.load(Ordering::Relaxed), 1, "concurrent requests share a read");
        for name in 0..40 {
            request(name).await;
        }
        let cached_bytes = pictures.reduced.weight();
        assert!(cached_bytes <= CACHE_BYTES && cached_bytes > CACHE_BYTES / 2, "{cached_bytes}");
        // Sixteen pictures fit into the cache.
        let first_reads = reads.load(Ordering::Relaxed);
        for name in 0..40 {
            request(name).await;
        }
        let repeated = reads.load(Ordering::Relaxed) - first_reads;
        assert!((24..=40).contains(&repeated), "{repeated} of 40 pictures were read again");
    }
}
