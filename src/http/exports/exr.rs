//! The stack of frames as EXR, with the expected error as a layer of each part.

use std::fs::File;
use std::io::BufReader;
use std::sync::Arc;

use axum::body::Bytes;
use axum::http::{HeaderMap, Method};
use axum::response::Response;

use super::super::error::{ApiError, Result};
use super::super::results::{attachment, media_type, result_file};
use super::clip::{Clip, behind_header};
use super::composed::{Composed, Part, Piece};
use super::lines::{Lines, Make};
use engine::job::SceneShape;
use engine::pipeline::assessment::{BLOCK, blocks};
use formats::exr::{Layered, SIGMA};

const STACK: &str = "stack.exr";

/// `exr?layers=sigma`.
pub(super) async fn with_sigma(clip: Clip, request: (&Method, &HeaderMap)) -> Result<Response> {
    let parts = parts(&clip).await?;
    let disposition = attachment(clip.job.id, clip.snapshot, "stack-sigma.exr");
    let composed = Composed { parts, kind: media_type(STACK), disposition };
    composed.send(&clip.app, clip.job, request).await
}

/// The stored stack, each line with the expected error of its pixels.
async fn parts(clip: &Clip) -> Result<Vec<Part>> {
    let snapshot = clip.snapshot;
    let (file, _) = result_file(&clip.app, &clip.job, snapshot, "error.npy").await?;
    let errors = Piece { snapshot, file };
    let (file, _, stored) = clip.app.store.open_result(&clip.job, snapshot, STACK).await?;
    let stack = Piece { snapshot, file };
    let shape = clip.job.spec.shape;
    let (frames, height, width) = (shape.frames, shape.height, shape.width);
    let mut layered = layered(stored, shape).await?;
    let head = Bytes::from(std::mem::take(&mut layered.head));
    let (rows, columns) = blocks(height, width);
    let frame_bytes = (rows * columns * size_of::<f32>()) as u64;
    let first = behind_header(&errors, frames as u64 * frame_bytes)?;
    let part_bytes = (height * layered.stored_bytes) as u64;
    let (start, count) = (layered.start, height as u64);
    let (stored, made) = (layered.stored_bytes as u64, layered.line_bytes as u64);
    let make: Make = Arc::new(move |errors, line, stored, made| {
        layered.line(stored, of_line(errors, line, width), made);
    });
    let part = |k: u64| Part::Lines {
        piece: stack.clone(),
        shared: (errors.clone(), first + k * frame_bytes, frame_bytes),
        lines: Lines { start: start + k * part_bytes, count, stored, made, make: make.clone() },
    };
    Ok([Part::Bytes(head)].into_iter().chain((0..frames as u64).map(part)).collect())
}

/// The form that a stored stack has with the layer.
async fn layered(stored: File, shape: SceneShape) -> Result<Layered> {
    let size = (shape.frames, shape.height, shape.width);
    let read = move || Layered::read(BufReader::new(stored), size, shape.channels(), SIGMA);
    let read =
        tokio::task::spawn_blocking(read).await.map_err(|error| ApiError::internal(&error))?;
    // The file is ours, so no error in it is the caller's.
    read.map_err(|error| ApiError::internal(&error))
}

/// The values of a line's pixels, each that of its block.
fn of_line(blocks: &[u8], line: usize, width: usize) -> impl Iterator<Item = &[u8]> {
    let values = blocks.chunks_exact(size_of::<f32>());
    let values = values.skip(line / BLOCK * width.div_ceil(BLOCK));
    values.flat_map(|value| std::iter::repeat_n(value, BLOCK)).take(width)
}

#[cfg(test)]
mod tests {
    use super::of_line;

    #[test]
    fn every_pixel_has_the_value_of_its_block() {
        // Two rows of three blocks.
        let blocks: Vec<u8> = (0..6_u8).flat_map(|block| [block; 4]).collect();
        let line = |line| of_line(&blocks, line, 33).map(|value| value[3]).collect::<Vec<_>>();
        let expected = |first: u8| [vec![first; 16], vec![first + 1; 16], vec![first + 2]].concat();
        assert_eq!(line(0), expected(0));
        assert_eq!(line(15), expected(0));
        assert_eq!(line(16), expected(3));
    }
}
