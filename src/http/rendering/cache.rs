//! Reduced pictures that were asked for lately, so that no stack is read twice for one thumbnail.

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
const BUDGET: u64 = 64 << 20;
/// Pictures that are reduced at the same time: the cores are for the workers.
const AT_ONCE: usize = 2;

type Key = (String, Region);
type Values = Arc<Array2<f32>>;

/// Reduces pictures, each of them once for all who ask for it.
#[derive(Debug)]
pub(in crate::http) struct Pictures {
    reduced: Cache<Key, Values, Bytes>,
    turns: Semaphore,
}

#[derive(Debug, Clone)]
struct Bytes;

impl Weighter<Key, Values> for Bytes {
    fn weight(&self, _: &Key, values: &Values) -> u64 {
        (values.len() * size_of::<f32>()) as u64
    }
}

impl Pictures {
    pub(in crate::http) fn new() -> Self {
        // One shard: in one of many the largest pictures would find no room. Half is for what was
        // asked for once: a screen of tiles is looked at again with another contrast.
        let options = OptionsBuilder::new()
            .shards(1)
            .estimated_items_capacity(1024)
            .weight_capacity(BUDGET)
            .hot_allocation(0.5)
            .build();
        // The options are complete, so this can't fail.
        let reduced = match options {
            Ok(options) => Cache::with_options(
                options,
                Bytes,
                DefaultHashBuilder::default(),
                DefaultLifecycle::default(),
            ),
            Err(_) => Cache::with_weighter(1024, BUDGET, Bytes),
        };
        Self { reduced, turns: Semaphore::new(AT_ONCE) }
    }

    pub(in crate::http) async fn reduced(
        &self,
        picture: Arc<Picture>,
        region: Region,
    ) -> Result<Values> {
        let key = (picture.identity.clone(), region.clone());
        let reduce = async {
            let stopped = |_| ApiError::new(Code::Unavailable, "the service is shutting down");
            let _turn = self.turns.acquire().await.map_err(stopped)?;
            let reduce = tokio::task::spawn_blocking(move || picture.reduce(&region));
            let values = reduce.await.map_err(|error| ApiError::internal(&error))?;
            Ok(Arc::new(values.map_err(unreadable)?))
        };
        self.reduced.get_or_insert_async(&key, reduce).await
    }
}

/// A file that is gone was one of the tiles that have just been put together.
fn unreadable(error: FormatError) -> ApiError {
    match error {
        FormatError::Io { source, .. } if source.kind() == ErrorKind::NotFound => {
            ApiError::new(Code::NotReady, "the frames are being put together; ask again")
        }
        error => error.into(),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::{BUDGET, Pictures};
    use crate::http::rendering::Picture;
    use formats::Channels;
    use ndarray::Array2;

    fn picture(name: usize, reads: &Arc<AtomicUsize>) -> Arc<Picture> {
        let reads = reads.clone();
        Arc::new(Picture {
            height: 1024,
            width: 1024,
            identity: name.to_string(),
            settled: true,
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
        let held = pictures.reduced.weight();
        assert!(held <= BUDGET && held > BUDGET / 2, "{held}");
        // Sixteen of them fit.
        let before = reads.load(Ordering::Relaxed);
        for name in 0..40 {
            ask(name).await;
        }
        let again = reads.load(Ordering::Relaxed) - before;
        assert!((24..=40).contains(&again), "{again} of 40 pictures were read again");
    }
}
