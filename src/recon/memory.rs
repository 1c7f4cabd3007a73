//! How much memory a worker takes: planned, not hoped for.

use super::denoise::fastdvdnet;

/// The program itself, with its runtime and buffers of files.
const PROGRAM: u64 = 16 << 20;
/// libonnxruntime and the network's weights.
const LIBRARY: u64 = 60 << 20;
/// Activations in ONNX Runtime for each pixel that goes through a block at once. Measured: 2,900
/// with a full chunk; its arena grows in powers of two, so that it is less for some sizes.
const ACTIVATION_BYTES: u64 = 3_000;
const F32: u64 = 4;

/// An upper bound in bytes of what one worker holds while it solves tiles of `height` x `width`
/// pixels with `frames` frames, with a learned denoiser (`deep`) or without.
///
/// Measured peaks lie 8 to 20 % below it with full chunks (tiles of 256 and 512 pixels, 4 to 20
/// frames), and further below for small or odd tiles.
pub fn worker_bytes(height: usize, width: usize, frames: usize, deep: bool) -> u64 {
    let plane = (height as u64).saturating_mul(width as u64);
    let frames = frames as u64;
    // Masks, their copy in the operator, the two iterates, the result; for each pixel the
    // measurement, its accumulator, the gram diagonal, its inverse and the dual fields.
    let solver = (5 * frames + 8).saturating_mul(plane).saturating_mul(F32);
    let mut bytes = PROGRAM.saturating_add(solver);
    if deep {
        // The clip with its mirrored ends before, between and after the two blocks.
        let clips = (3 * frames + 6).saturating_mul(plane).saturating_mul(F32);
        let at_once = fastdvdnet::frames_at_once(plane).min(frames).saturating_mul(plane);
        let activations = at_once.saturating_mul(ACTIVATION_BYTES);
        bytes = bytes.saturating_add(LIBRARY).saturating_add(clips).saturating_add(activations);
    }
    bytes
}

#[cfg(test)]
mod tests {
    use super::worker_bytes;

    /// Peak resident MiB of the program with a tile of this side, these frames, deep or not.
    const MEASURED: [(usize, usize, bool, f64); 8] = [
        (256, 10, false, 20.8),
        (512, 10, false, 58.0),
        (512, 20, false, 97.9),
        (128, 10, true, 474.4),
        (256, 4, true, 788.9),
        (256, 20, true, 819.9),
        (512, 4, true, 823.6),
        (512, 20, true, 935.6),
    ];

    #[test]
    fn the_bound_holds_and_is_not_far_from_the_truth() {
        for (side, frames, deep, measured) in MEASURED {
            let bound = worker_bytes(side, side, frames, deep) as f64 / f64::from(1 << 20);
            let ratio = bound / measured;
            assert!((1.0..1.8).contains(&ratio), "{side}, {frames}, {deep}: {bound} MiB");
            assert!(!deep || ratio < 1.25, "{side}, {frames}: {bound} MiB");
        }
    }

    #[test]
    fn the_default_tile_stays_below_its_limit() {
        assert!(worker_bytes(256, 256, 10, true) < 3 << 29, "1.5 GiB");
        // Claims of any size are counted without overflow.
        assert_eq!(worker_bytes(usize::MAX, usize::MAX, 1 << 40, true), u64::MAX);
    }
}
