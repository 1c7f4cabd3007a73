//! The stack of frames as EXR, with the expected error of the pixels as a layer of each part.

use std::fs::File;
use std::io::BufReader;
use std::sync::Arc;

use axum::body::Bytes;
use axum::http::{HeaderMap, Method};
use axum::response::Response;

use super::super::error::{ApiError, Result};
use super::super::results::{attachment, media_type, result_file};
use super::clip::{Clip, values_offset};
use super::composed::{Composed, Content, Part, Section, Source};
use super::lines::{Compose, Lines};
use engine::job::SceneShape;
use engine::pipeline::assessment::{BLOCK, blocks};
use formats::exr::{Layered, SIGMA};

const STACK: &str = "stack.exr";

/// `exr?layers=sigma`: the stack with the layer of expected errors.
pub(super) async fn with_sigma(clip: Clip, request: (&Method, &HeaderMap)) -> Result<Response> {
    let parts = parts(&clip).await?;
    let disposition = attachment(clip.job.id, clip.snapshot, "stack-sigma.exr");
    let composed = Composed { parts, kind: media_type(STACK), disposition };
    composed.send(&clip.app, clip.job, request).await
}

/// Lays out the stack: each stored line, extended by the expected errors of its pixels.
async fn parts(clip: &Clip) -> Result<Vec<Part>> {
    let snapshot = clip.snapshot;
    let (file, _) = result_file(&clip.app, &clip.job, snapshot, "error.npy").await?;
    let errors = Source { snapshot, file };
    let (file, _, stored) = clip.app.store.open_result(&clip.job, snapshot, STACK).await?;
    let stack = Source { snapshot, file };
    let shape = clip.job.spec.frame_shape();
    let (frames, height, width) = (shape.frames, shape.height, shape.width);
    let mut layered = read_layout(stored, shape).await?;
    let head = Bytes::from(std::mem::take(&mut layered.head));
    let (rows, columns) = blocks(height, width);
    let frame_bytes = (rows * columns * size_of::<f32>()) as u64;
    let first = values_offset(&errors, frames as u64 * frame_bytes)?;
    let part_bytes = (height * layered.stored_bytes) as u64;
    let (start, count) = (layered.start, height as u64);
    let (stored_bytes, composed_bytes) = (layered.stored_bytes as u64, layered.line_bytes as u64);
    let compose: Compose = Arc::new(move |errors, number, stored, composed| {
        layered.line(stored, block_values(errors, number, width), composed);
    });
    let part = |k: u64| Part::Lines {
        source: stack.clone(),
        shared: Section {
            source: errors.clone(),
            start: first + k * frame_bytes,
            length: frame_bytes,
        },
        lines: Lines {
            start: start + k * part_bytes,
            count,
            stored_bytes,
            composed_bytes,
            compose: compose.clone(),
        },
    };
    Ok([Part::Content(Content::Bytes(head))]
        .into_iter()
        .chain((0..frames as u64).map(part))
        .collect())
}

/// Reads the header of the stored stack, and lays out the stack with the additional layer.
async fn read_layout(stored: File, shape: SceneShape) -> Result<Layered> {
    let size = (shape.frames, shape.height, shape.width);
    let read = move || Layered::read(BufReader::new(stored), size, shape.channels(), SIGMA);
    let read =
        tokio::task::spawn_blocking(read).await.map_err(|error| ApiError::internal(&error))?;
    // The service wrote the file, so its faults are internal errors.
    read.map_err(|error| ApiError::internal(&error))
}

/// The value of each pixel of a line, given the values of all blocks.
fn block_values(blocks: &[u8], line: usize, width: usize) -> impl Iterator<Item = &[u8]> {
    let values = blocks.chunks_exact(size_of::<f32>());
    let values = values.skip(line / BLOCK * width.div_ceil(BLOCK));
    values.flat_map(|value| std::iter::repeat_n(value, BLOCK)).take(width)
}

#[cfg(test)]
mod tests {
    use super::block_values;

    #[test]
    fn every_pixel_has_the_value_of_its_block() {
        // Two rows of three blocks.
        let blocks: Vec<u8> = (0..6_u8).flat_map(|block| [block; 4]).collect();
        let line = |line| block_values(&blocks, line, 33).map(|value| value[3]).collect::<Vec<_>>();
        let expected = |first: u8| [vec![first; 16], vec![first + 1; 16], vec![first + 2]].concat();
        assert_eq!(line(0), expected(0));
        assert_eq!(line(15), expected(0));
        assert_eq!(line(16), expected(3));
    }
}
