//! Isotropic total variation, frame by frame (Chambolle, "An algorithm for total variation
//! minimization and applications", 2004).

use multiversion::multiversion;
use ndarray::Array3;

/// Step of the dual ascent: 1 / (2 * dimensions).
const TAU: f32 = 0.25;

/// The dual fields of one frame, kept so that the loop allocates nothing.
#[derive(Debug)]
pub struct TotalVariation {
    width: usize,
    /// Dual field along rows (downwards), then along columns, one row pair after the other.
    down: Vec<f32>,
    right: Vec<f32>,
    here: Vec<f32>,
    below: Vec<f32>,
}

impl TotalVariation {
    /// For frames of `height` x `width` pixels.
    pub fn new(height: usize, width: usize) -> Self {
        Self {
            width,
            down: vec![0.0; height * width],
            right: vec![0.0; height * width],
            here: vec![0.0; width],
            below: vec![0.0; width],
        }
    }

    /// Minimises `||u - x||^2 / 2 + weight * TV(u)` for every frame of `frames` \[B,H,W\], in
    /// place, with a fixed number of dual updates starting from 0 (scikit-image's
    /// `denoise_tv_chambolle` with `max_num_iter = updates + 1` does as many).
    pub fn denoise(&mut self, frames: &mut Array3<f32>, weight: f32, updates: usize) {
        debug_assert_eq!(frames.dim().1 * frames.dim().2, self.down.len());
        debug_assert_eq!(frames.dim().2, self.width);
        if weight <= 0.0 || updates == 0 {
            return;
        }
        for mut frame in frames.outer_iter_mut() {
            if let Some(frame) = frame.as_slice_mut() {
                self.denoise_frame(frame, weight, updates);
            }
        }
    }

    fn denoise_frame(&mut self, image: &mut [f32], weight: f32, updates: usize) {
        let Self { width, down, right, here, below, .. } = self;
        down.fill(0.0);
        right.fill(0.0);
        for k in 0..updates {
            sweep(image, down, right, here, below, *width, TAU / weight, k + 1 == updates);
        }
    }
}

/// One dual update. The primal rows `u = x + div p` are made as they are needed, two at a
/// time, so that one sweep reads and writes everything once. The last sweep also writes `u`
/// of the updated field over the image, one row behind.
#[allow(clippy::too_many_arguments)] // one kernel over plain slices, so that it vectorises
#[multiversion(targets("x86_64+avx512f+avx512vl", "x86_64+avx2+fma"))]
fn sweep(
    image: &mut [f32],
    down: &mut [f32],
    right: &mut [f32],
    here: &mut Vec<f32>,
    below: &mut Vec<f32>,
    width: usize,
    step: f32,
    last: bool,
) {
    let height = image.len() / width;
    primal_row(&image[..width], None, &down[..width], &right[..width], here);
    for i in 0..height {
        let row = i * width..(i + 1) * width;
        if i + 1 < height {
            let next = (i + 1) * width..(i + 2) * width;
            // Row i of the field is still the old one here, as it must be.
            primal_row(
                &image[next.clone()],
                Some(&down[row.clone()]),
                &down[next.clone()],
                &right[next],
                below,
            );
        } else {
            below.copy_from_slice(here);
        }
        update_row(here, below, &mut down[row.clone()], &mut right[row.clone()], step);
        std::mem::swap(here, below);
        if last {
            // Row i of the image is not needed any more; row i - 1 of the field is new too.
            let above = (i > 0).then(|| &down[(i - 1) * width..i * width]);
            add_divergence(&mut image[row.clone()], above, &down[row.clone()], &right[row]);
        }
    }
}

/// A row of `u = x + div p`, given the rows of `p` and the row of its downward part above.
#[inline(always)]
fn primal_row(image: &[f32], above: Option<&[f32]>, down: &[f32], right: &[f32], out: &mut [f32]) {
    out.copy_from_slice(image);
    add_divergence(out, above, down, right);
}

/// `u = x + div p` for one row, in place of `x`.
#[inline(always)]
fn add_divergence(row: &mut [f32], above: Option<&[f32]>, down: &[f32], right: &[f32]) {
    let width = row.len();
    let (down, right) = (&down[..width], &right[..width]);
    match above.map(|above| &above[..width]) {
        Some(above) => {
            for j in 0..width {
                row[j] += above[j] - down[j] - right[j];
            }
        }
        None => {
            for j in 0..width {
                row[j] -= down[j] + right[j];
            }
        }
    }
    row[1..].iter_mut().zip(right).for_each(|(u, &r)| *u += r);
}

/// `p = (p - tau grad u) / (1 + tau/weight |grad u|)` for one row; forward differences, 0 at
/// the far edges. `step` is `tau / weight`.
#[inline(always)]
fn update_row(here: &[f32], below: &[f32], down: &mut [f32], right: &mut [f32], step: f32) {
    let last = here.len() - 1;
    let (below, down, right) = (&below[..=last], &mut down[..=last], &mut right[..=last]);
    let ahead = &here[1..];
    for j in 0..last {
        let (g0, g1) = (below[j] - here[j], ahead[j] - here[j]);
        let scale = 1.0 / (1.0 + step * (g0 * g0 + g1 * g1).sqrt());
        down[j] = (down[j] - TAU * g0) * scale;
        right[j] = (right[j] - TAU * g1) * scale;
    }
    let g0 = below[last] - here[last];
    let scale = 1.0 / (1.0 + step * g0.abs());
    down[last] = (down[last] - TAU * g0) * scale;
    right[last] *= scale;
}

#[cfg(test)]
mod tests {
    use super::{TAU, TotalVariation};
    use ndarray::{Array2, Array3, Axis};
    use rand::{Rng, SeedableRng};

    /// The readable reference: whole-image differences, as in the paper.
    fn reference(image: &Array2<f32>, weight: f32, updates: usize) -> Array2<f32> {
        let (h, w) = image.dim();
        let (mut p0, mut p1) = (Array2::<f32>::zeros((h, w)), Array2::<f32>::zeros((h, w)));
        let primal = |p0: &Array2<f32>, p1: &Array2<f32>| {
            Array2::from_shape_fn((h, w), |(i, j)| {
                let mut u = image[[i, j]] - p0[[i, j]] - p1[[i, j]];
                if i > 0 {
                    u += p0[[i - 1, j]];
                }
                if j > 0 {
                    u += p1[[i, j - 1]];
                }
                u
            })
        };
        for _ in 0..updates {
            let u = primal(&p0, &p1);
            for i in 0..h {
                for j in 0..w {
                    let g0 = if i + 1 < h { u[[i + 1, j]] - u[[i, j]] } else { 0.0 };
                    let g1 = if j + 1 < w { u[[i, j + 1]] - u[[i, j]] } else { 0.0 };
                    let norm = 1.0 + TAU / weight * (g0 * g0 + g1 * g1).sqrt();
                    p0[[i, j]] = (p0[[i, j]] - TAU * g0) / norm;
                    p1[[i, j]] = (p1[[i, j]] - TAU * g1) / norm;
                }
            }
        }
        primal(&p0, &p1)
    }

    #[test]
    fn fast_kernel_equals_the_reference() {
        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(1);
        for (h, w) in [(1, 1), (1, 7), (9, 1), (2, 2), (17, 33), (40, 64)] {
            let frames = Array3::from_shape_fn((2, h, w), |_| rng.random::<f32>());
            for updates in [1, 2, 4, 20] {
                let mut fast = frames.clone();
                TotalVariation::new(h, w).denoise(&mut fast, 0.1, updates);
                for (fast, frame) in fast.outer_iter().zip(frames.outer_iter()) {
                    let slow = reference(&frame.to_owned(), 0.1, updates);
                    let worst = (&fast - &slow).mapv(f32::abs).fold(0.0f32, |a, &b| a.max(b));
                    assert!(worst < 2e-6, "{h}x{w}, {updates} updates: {worst}");
                }
            }
        }
    }

    #[test]
    fn constant_images_stay_and_noise_falls() {
        let mut flat = Array3::from_elem((1, 8, 8), 0.4f32);
        TotalVariation::new(8, 8).denoise(&mut flat, 0.1, 10);
        assert!(flat.iter().all(|&x| (x - 0.4).abs() < 1e-6));

        let mut rng = rand_chacha::ChaCha8Rng::seed_from_u64(2);
        let mut noisy = Array3::from_shape_fn((1, 32, 32), |_| 0.5 + 0.1 * rng.random::<f32>());
        let before = noisy.index_axis(Axis(0), 0).var(0.0);
        TotalVariation::new(32, 32).denoise(&mut noisy, 0.1, 20);
        assert!(noisy.var(0.0) < 0.3 * before);
    }
}
