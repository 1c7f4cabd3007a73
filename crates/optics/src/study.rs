//! What can be told of masks by looking at them: the figures of a calibration report.

use ndarray::{Array2, ArrayView3, Axis, s};

use super::{OpticsError, Result};

/// Bins of the histogram on \[0,1\].
const BINS: usize = 4096;
/// A pixel whose masks are all above this does not follow the patterns.
const STUCK_OPEN: f32 = 0.95;

/// Looks at masks band by band, so that all of them need not be in memory at once.
#[derive(Debug)]
pub struct MaskStudy {
    next_row: usize,
    products: Array2<f64>,
    sums: Vec<f64>,
    /// Of each mask, the sum over its rows of the squared sum of a row.
    row_squares: Vec<f64>,
    /// Sums \[B,W\] of the columns of each mask.
    columns: Array2<f64>,
    mean: Array2<f32>,
    deviation: Array2<f32>,
    gram: Array2<f32>,
    histogram: Vec<u64>,
    zeros: u64,
    stuck_open: u64,
}

/// Figures of a set of masks \[B,H,W\] on \[0,1\].
#[derive(Debug, Clone, PartialEq)]
pub struct MaskFigures {
    /// Mean of each mask.
    pub frame_means: Vec<f64>,
    /// Correlation \[B,B\] of each mask with each other, over the pixels.
    pub correlation: Array2<f64>,
    /// The share of the masks' variance over the pixels that is between rows, and between columns: 1 where
    /// all pixels of a row (of a column) are the same.
    pub along: (f64, f64),
    /// Mean over the frames of each pixel \[H,W\].
    pub mean: Array2<f32>,
    /// Standard deviation over the frames of each pixel \[H,W\].
    pub deviation: Array2<f32>,
    /// Sum of squares over the frames of each pixel \[H,W\]: the gram diagonal.
    pub gram: Array2<f32>,
    /// Pixels that are dark in all masks, of which nothing can be known.
    pub dead: u64,
    /// Pixels that are open in all masks and so do not follow the patterns.
    pub stuck_open: u64,
    /// Values that are 0.
    pub zeros: u64,
    /// The largest value.
    pub largest: f32,
    /// The values below which 1 % and 99 % of all values lie.
    pub percentiles: (f32, f32),
}

impl MaskFigures {
    /// Mean of all values.
    pub fn overall_mean(&self) -> f64 {
        self.frame_means.iter().sum::<f64>() / self.frame_means.len().max(1) as f64
    }

    /// Mean over the pixels of the deviation over the frames.
    pub fn mean_deviation(&self) -> f64 {
        self.deviation.iter().map(|&value| f64::from(value)).sum::<f64>()
            / self.deviation.len().max(1) as f64
    }

    /// Mean and largest correlation between two masks; none for a single one.
    pub fn correlations(&self) -> Option<(f64, f64)> {
        let pairs = self.correlation.indexed_iter().filter(|((k, l), _)| k < l);
        let values: Vec<f64> = pairs.map(|(_, &value)| value).collect();
        let largest = values.iter().copied().reduce(f64::max)?;
        Some((values.iter().sum::<f64>() / values.len() as f64, largest))
    }
}

impl MaskStudy {
    /// A study of `frames` masks of `height` x `width`.
    pub fn new(frames: usize, height: usize, width: usize) -> Self {
        let map = || Array2::zeros((height, width));
        Self {
            next_row: 0,
            products: Array2::zeros((frames, frames)),
            sums: vec![0.0; frames],
            row_squares: vec![0.0; frames],
            columns: Array2::zeros((frames, width)),
            mean: map(),
            deviation: map(),
            gram: map(),
            histogram: vec![0; BINS],
            zeros: 0,
            stuck_open: 0,
        }
    }

    /// Looks at the next rows \[B,rows,W\] of all masks, on \[0,1\].
    /// Errors: a band that is not the next one of such masks.
    pub fn add(&mut self, band: ArrayView3<'_, f32>) -> Result<()> {
        let (frames, rows, width) = band.dim();
        let (height, expected) = self.mean.dim();
        if frames != self.sums.len() || width != expected || self.next_row + rows > height {
            return Err(OpticsError::Pattern(format!(
                "a band of {frames}x{rows}x{width} does not fit masks of {}x{height}x{expected}, of \
                 which {} rows are known",
                self.sums.len(),
                self.next_row
            )));
        }
        for row in 0..rows {
            let line = band.slice(s![.., row, ..]);
            // Sums of one row in f32, of all rows in f64.
            self.products += &line.dot(&line.t()).mapv(f64::from);
            for (frame, mask) in line.outer_iter().enumerate() {
                let sum = f64::from(mask.sum());
                self.sums[frame] += sum;
                self.row_squares[frame] += sum * sum;
            }
            ndarray::azip!((sum in &mut self.columns, &value in &line) *sum += f64::from(value));
            for &value in line {
                self.zeros += u64::from(value <= 0.0);
                self.histogram[bin(value)] += 1;
            }
            for column in 0..width {
                self.pixel((self.next_row + row, column), line.column(column));
            }
        }
        self.next_row += rows;
        Ok(())
    }

    fn pixel(&mut self, at: (usize, usize), values: ndarray::ArrayView1<'_, f32>) {
        let count = values.len() as f32;
        let mean = values.sum() / count;
        let gram: f32 = values.iter().map(|value| value * value).sum();
        let scatter: f32 = values.iter().map(|value| (value - mean).powi(2)).sum();
        self.mean[at] = mean;
        self.gram[at] = gram;
        self.deviation[at] = (scatter / count).sqrt();
        self.stuck_open += u64::from(values.iter().all(|value| *value > STUCK_OPEN));
    }

    /// The figures.
    /// Errors: rows that are missing.
    pub fn finish(self) -> Result<MaskFigures> {
        let (height, width) = self.mean.dim();
        if self.next_row != height {
            return Err(OpticsError::Pattern(format!(
                "{} rows of {height} are known",
                self.next_row
            )));
        }
        let pixels = (height * width) as f64;
        let covariance = |k: usize, l: usize| {
            self.products[[k, l]] / pixels - self.sums[k] * self.sums[l] / (pixels * pixels)
        };
        let correlation = Array2::from_shape_fn(self.products.dim(), |(k, l)| {
            let norm = (covariance(k, k) * covariance(l, l)).sqrt();
            if norm > 0.0 { (covariance(k, l) / norm).clamp(-1.0, 1.0) } else { 0.0 }
        });
        // Between rows: of the rows' means; each stands for a row of pixels.
        let squared = |sum: f64| sum * sum / (pixels * pixels);
        let (mut whole, mut rows, mut columns) = (0.0, 0.0, 0.0);
        for (k, &sum) in self.sums.iter().enumerate() {
            let lines = self.columns.row(k).iter().map(|sum| sum * sum).sum::<f64>();
            whole += covariance(k, k);
            rows += self.row_squares[k] / (width * width * height) as f64 - squared(sum);
            columns += lines / (height * height * width) as f64 - squared(sum);
        }
        let share = |part: f64| if whole > 0.0 { (part / whole).clamp(0.0, 1.0) } else { 0.0 };
        Ok(MaskFigures {
            along: (share(rows), share(columns)),
            frame_means: self.sums.iter().map(|sum| sum / pixels).collect(),
            correlation,
            dead: self.gram.iter().filter(|gram| **gram <= 0.0).count() as u64,
            stuck_open: self.stuck_open,
            zeros: self.zeros,
            largest: percentile(&self.histogram, 1.0),
            percentiles: (percentile(&self.histogram, 0.01), percentile(&self.histogram, 0.99)),
            mean: self.mean,
            deviation: self.deviation,
            gram: self.gram,
        })
    }
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // clamped to the bins
fn bin(value: f32) -> usize {
    (value.clamp(0.0, 1.0) * (BINS - 1) as f32).round() as usize
}

fn percentile(histogram: &[u64], share: f64) -> f32 {
    let total: u64 = histogram.iter().sum();
    let wanted = share * total as f64;
    let mut below = 0;
    let found = histogram.iter().position(|count| {
        below += count;
        below as f64 >= wanted
    });
    found.unwrap_or(0) as f32 / (BINS - 1) as f32
}

/// How even an illumination \[H,W\] is: its darkest over its brightest 16th of the rows and
/// columns, as block means; pixels at 0 are left out. None without light.
pub fn flatness(illumination: &ndarray::ArrayView2<'_, f32>) -> Option<f64> {
    let (height, width) = illumination.dim();
    let side = |length: usize| length.div_ceil(16).max(1);
    let mut means = Vec::new();
    for rows in illumination.axis_chunks_iter(Axis(0), side(height)) {
        for block in rows.axis_chunks_iter(Axis(1), side(width)) {
            let lit = block.iter().filter(|value| **value > 0.0);
            let (sum, count) =
                lit.fold((0.0, 0u32), |(sum, count), &v| (sum + f64::from(v), count + 1));
            if count > 0 {
                means.push(sum / f64::from(count));
            }
        }
    }
    let brightest = means.iter().copied().reduce(f64::max)?;
    Some(means.iter().copied().reduce(f64::min)? / brightest)
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, Array3, Axis, s};

    use super::{MaskStudy, flatness};
    use crate::random_squares;

    #[test]
    fn figures_are_those_of_the_whole_arrays() {
        let (mut masks, _) = random_squares(6, 40, 30, 2).unwrap();
        masks.slice_mut(s![.., 3, 4]).fill(0.0);
        masks.slice_mut(s![.., 5, 6]).fill(1.0);
        let mut study = MaskStudy::new(6, 40, 30);
        for band in masks.axis_chunks_iter(Axis(1), 7) {
            study.add(band).unwrap();
        }
        let figures = study.finish().unwrap();
        let all = |wrong: fn(f32) -> bool| {
            let pixels = masks.lanes(Axis(0)).into_iter();
            pixels.filter(|pixel| pixel.iter().all(|&value| wrong(value))).count() as u64
        };
        assert_eq!((figures.dead, figures.stuck_open), (all(|v| v == 0.0), all(|v| v > 0.95)));
        assert!(figures.dead > 0 && figures.stuck_open > 0);
        assert_eq!(figures.zeros, masks.iter().filter(|v| **v == 0.0).count() as u64);
        assert!((figures.overall_mean() - f64::from(masks.mean().unwrap())).abs() < 1e-5);
        let deviation = masks.std_axis(Axis(0), 0.0);
        assert!((&figures.deviation - &deviation).iter().all(|v| v.abs() < 1e-5));
        let gram = masks.mapv(|v| v * v).sum_axis(Axis(0));
        assert!((&figures.gram - &gram).iter().all(|v| v.abs() < 1e-4));
        let (a, b) = (masks.index_axis(Axis(0), 1), masks.index_axis(Axis(0), 4));
        let (a, b) = (&a - a.mean().unwrap(), &b - b.mean().unwrap());
        let expected = (&a * &b).sum() / ((&a * &a).sum() * (&b * &b).sum()).sqrt();
        assert!((figures.correlation[[1, 4]] - f64::from(expected)).abs() < 1e-4);
        assert!(figures.percentiles.0 < 0.2 && figures.percentiles.1 > 0.8);
    }

    #[test]
    fn bands_that_do_not_fit_are_refused() {
        let mut study = MaskStudy::new(2, 4, 4);
        assert!(study.add(Array3::zeros((3, 1, 4)).view()).is_err());
        study.add(Array3::zeros((2, 3, 4)).view()).unwrap();
        assert!(study.add(Array3::zeros((2, 2, 4)).view()).is_err());
        assert!(study.finish().is_err());
    }

    #[test]
    fn an_even_light_is_flat() {
        assert_eq!(flatness(&Array2::from_elem((64, 48), 3.0).view()), Some(1.0));
        let half = Array2::from_shape_fn((64, 64), |(_, j)| if j < 32 { 1.0 } else { 2.0 });
        assert_eq!(flatness(&half.view()), Some(0.5));
        assert_eq!(flatness(&Array2::zeros((4, 4)).view()), None);
    }

    #[test]
    fn variance_along_one_axis_is_told() {
        let noise = |i: usize| (i * 7919 % 101) as f32 / 100.0;
        let along = |height: usize, width: usize, value: &dyn Fn(usize, usize) -> f32| {
            let masks =
                Array3::from_shape_fn((3, height, width), |(k, i, j)| value(i + 13 * k, j + 5 * k));
            let mut study = MaskStudy::new(3, height, width);
            study.add(masks.slice(s![.., ..height / 2, ..])).unwrap();
            study.add(masks.slice(s![.., height / 2.., ..])).unwrap();
            study.finish().unwrap().along
        };
        let (rows, columns) = along(40, 30, &|i, _| noise(i));
        assert!(rows > 0.999 && columns < 1e-6, "{rows} {columns}");
        let (rows, columns) = along(40, 30, &|_, j| noise(j));
        assert!(rows < 1e-6 && columns > 0.999, "{rows} {columns}");
        let (rows, columns) = along(40, 30, &|i, j| noise(31 * i + 17 * j * j));
        assert!(rows < 0.3 && columns < 0.3, "{rows} {columns}");
        assert!(along(1, 900, &|_, j| noise(j)).1 > 0.999);
        assert_eq!(along(8, 8, &|_, _| 1.0), (0.0, 0.0));
    }
}
