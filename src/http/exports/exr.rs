//! The stack of frames as EXR, with the expected error of the pixels as a layer of each part.

use std::sync::Arc;

use axum::http::{HeaderMap, Method};
use axum::response::Response;

use super::super::error::{ApiError, Result};
use super::super::results::{attachment, media_type, result_file};
use super::clip::{Clip, values_offset};
use super::composed::{Composed, FileRange, Part, Piece, Source, read_stack};
use super::lines::Compose;
use engine::pipeline::assessment::{BLOCK, blocks};
use engine::pipeline::derived::STACK;
use formats::exr::SIGMA;

/// `exr?layers=sigma`: the stack with the layer of expected errors.
pub(super) async fn with_sigma(clip: Clip, request: (&Method, &HeaderMap)) -> Result<Response> {
    let parts = parts(&clip).await?;
    let disposition = attachment(clip.job.id, clip.snapshot, "stack-sigma.exr");
    let composed = Composed { parts, sha256: None, kind: media_type(STACK), disposition };
    composed.send(&clip.app, clip.job, request).await
}

/// Lays out the stack: each stored line, extended by the expected errors of its pixels.
async fn parts(clip: &Clip) -> Result<Vec<Part>> {
    let snapshot = clip.snapshot;
    let (error, _) = result_file(&clip.app, &clip.job, snapshot, "error.npy").await?;
    let errors = Source { snapshot, file: error.file };
    let (file, _, stored) = clip.app.store.open_result(&clip.job, snapshot, STACK).await?;
    let source = Source { snapshot, file };
    let shape = clip.job.spec.frame_shape();
    let (frames, height, width) = (shape.frames, shape.height, shape.width);
    // The service wrote the file, so its faults are internal errors.
    let stack = read_stack(stored, shape).await.map_err(|error| ApiError::internal(&error))?;
    let head = stack.layered_head(SIGMA).map_err(|error| ApiError::internal(&error))?;
    let lines = stack.lines();
    let (rows, columns) = blocks(height, width);
    let block_bytes = (rows * columns * size_of::<f32>()) as u64;
    let first = values_offset(errors.file.size, frames as u64 * block_bytes)?;
    let compose: Compose = Arc::new(move |errors, number, stored, composed| {
        lines.layered_line(stored, block_values(errors, number, width), composed);
    });
    let composition = (lines.layered_bytes(), compose);
    let part = |k: usize| {
        let start = first + k as u64 * block_bytes;
        let section = FileRange { source: errors.clone(), start, length: block_bytes };
        clip.lines(&source, k..k + 1, Some(section), composition.clone()).map(Part::Piece)
    };
    let head = Ok(Part::Piece(Piece::Bytes(head.into())));
    [head].into_iter().chain((0..frames).map(part)).collect()
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
