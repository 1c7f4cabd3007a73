//! Statistics of masks: the figures of a calibration report.
//!
//! They leave out pixels that were not measured, NaN in any mask, and dark areas: those outside the light of the aperture.

use ndarray::{Array1, Array2, ArrayView1, ArrayView3, Axis, s};

use super::{OpticsError, Result};

/// Number of bins of the histogram over \[0,1\].
const BINS: usize = 4096;
/// A pixel is stuck if it exceeds this value in every mask.
const STUCK_PIXEL: f32 = 0.95;

/// A pixel that is dark in every mask lies in a dark area if this share of its 3x3 neighbourhood is dark too: at a straight
/// border it is two thirds.
const DARK_AREA: f64 = 0.6;

/// Accumulates the statistics of masks band by band, so that they need not fit in memory at once.
#[derive(Debug)]
pub struct MaskStudy {
    next_row: usize,
    /// Inner products of the masks \[B,B\].
    products: Array2<f64>,
    /// Sum of each mask \[B\].
    sums: Vec<f64>,
    /// Squared row sums of each mask \[B,H\].
    squared_row_sums: Array2<f64>,
    /// Column sums of each mask \[B,W\].
    column_sums: Array2<f64>,
    mean: Array2<f32>,
    deviation: Array2<f32>,
    gram: Array2<f32>,
    histogram: Vec<u64>,
    values_at_zero: u64,
    stuck_pixels: u64,
    /// Counts for each mask \[B\].
    counts: Vec<PixelCounts>,
}

/// Counts of the pixels of one mask.
#[derive(Debug, Clone, Copy, Default)]
struct PixelCounts {
    /// Pixels at 0.
    closed: u64,
    /// Pixels above [`STUCK_PIXEL`].
    open: u64,
    /// Pixels above 0.5.
    bright: u64,
    /// Pairs of neighbours in a row with 0.5 between their values.
    edges: u64,
}

/// The share of pixels with a property that independent masks have by chance.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct Chance {
    /// Expected share.
    pub share: f64,
    /// Standard deviation of the share, for masks of independent squares.
    pub deviation: f64,
}

impl Chance {
    /// True if a share exceeds this one by more than 0.1 % of the pixels and four standard deviations.
    pub fn is_exceeded_by(&self, share: f64) -> bool {
        share > self.share + 4.0 * self.deviation + 0.001
    }
}

/// Statistics of masks \[B,H,W\] on \[0,1\].
#[derive(Debug, Clone, PartialEq)]
pub struct MaskFigures {
    /// Mean of each mask \[B\].
    pub frame_means: Vec<f64>,
    /// Correlation between the masks over all pixels \[B,B\].
    pub correlation: Array2<f64>,
    /// Share of the masks' variance that is between rows; 1 if all pixels of a row are equal.
    pub variance_between_rows: f64,
    /// Share of the masks' variance that is between columns; 1 if all pixels of a column are equal.
    pub variance_between_columns: f64,
    /// Mean of each pixel over the masks \[H,W\]; NaN where nothing was measured, as in the other maps.
    pub mean: Array2<f32>,
    /// Standard deviation of each pixel over the masks \[H,W\].
    pub deviation: Array2<f32>,
    /// Sum of squares of each pixel over the masks \[H,W\]: the Gram diagonal.
    pub gram: Array2<f32>,
    /// Number of pixels that were measured in all masks.
    pub measured_pixels: u64,
    /// Number of pixels that are dark in every mask, and so can't be reconstructed.
    pub dead_pixels: u64,
    /// Number of these in dark areas.
    pub dark_area: u64,
    /// Number of pixels that are open in every mask, and so do not follow the patterns.
    pub stuck_pixels: u64,
    /// The share of pixels that are dark in every mask by chance.
    pub dead_by_chance: Chance,
    /// The share of pixels that are open in every mask by chance.
    pub stuck_by_chance: Chance,
    /// Number of values that are 0.
    pub values_at_zero: u64,
    /// The largest value.
    pub largest: f32,
    /// The 1st percentile of all values.
    pub percentile_1: f32,
    /// The 99th percentile of all values.
    pub percentile_99: f32,
}

/// Correlations between pairs of different masks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Correlations {
    /// Mean over all pairs.
    pub mean: f64,
    /// Largest of all pairs.
    pub largest: f64,
}

impl MaskFigures {
    /// Mean of all values.
    pub fn overall_mean(&self) -> f64 {
        self.frame_means.iter().sum::<f64>() / self.frame_means.len().max(1) as f64
    }

    /// Standard deviation over the masks, averaged over the pixels.
    pub fn mean_deviation(&self) -> f64 {
        let measured = self.deviation.iter().filter(|value| !value.is_nan());
        let sum = measured.map(|&value| f64::from(value)).sum::<f64>();
        sum / (self.measured_pixels - self.dark_area).max(1) as f64
    }

    /// Correlations between pairs of masks; `None` for a single mask.
    pub fn correlations(&self) -> Option<Correlations> {
        let pairs = self.correlation.indexed_iter().filter(|((k, l), _)| k < l);
        let values: Vec<f64> = pairs.map(|(_, &value)| value).collect();
        let largest = values.iter().copied().reduce(f64::max)?;
        Some(Correlations { mean: values.iter().sum::<f64>() / values.len() as f64, largest })
    }
}

impl MaskStudy {
    /// An empty study of `frames` masks of `height` x `width` pixels.
    pub fn new(frames: usize, height: usize, width: usize) -> Self {
        let map = || Array2::zeros((height, width));
        Self {
            next_row: 0,
            products: Array2::zeros((frames, frames)),
            sums: vec![0.0; frames],
            squared_row_sums: Array2::zeros((frames, height)),
            column_sums: Array2::zeros((frames, width)),
            mean: map(),
            deviation: map(),
            gram: map(),
            histogram: vec![0; BINS],
            values_at_zero: 0,
            stuck_pixels: 0,
            counts: vec![PixelCounts::default(); frames],
        }
    }

    /// Adds the next rows of all masks \[B,rows,W\], on \[0,1\].
    ///
    /// Errors: [`OpticsError::Pattern`] if the band does not fit the masks.
    pub fn add(&mut self, band: ArrayView3<'_, f32>) -> Result<()> {
        let (frames, rows, width) = band.dim();
        let (height, expected) = self.mean.dim();
        if frames != self.sums.len() || width != expected || self.next_row + rows > height {
            return Err(OpticsError::Pattern(format!(
                "a band of {frames}x{rows}x{width} does not fit masks of {}x{height}x{expected} after \
                 {} rows",
                self.sums.len(),
                self.next_row
            )));
        }
        for row in 0..rows {
            let line = band.slice(s![.., row, ..]);
            let known: Vec<bool> =
                line.columns().into_iter().map(|pixel| !pixel.iter().any(|v| v.is_nan())).collect();
            let mut line = line.to_owned();
            for (mut pixel, _) in
                line.columns_mut().into_iter().zip(&known).filter(|(_, known)| !**known)
            {
                pixel.fill(0.0);
            }
            // Within a row sums are f32, across rows f64.
            self.products += &line.dot(&line.t()).mapv(f64::from);
            for (frame, mask) in line.outer_iter().enumerate() {
                let sum = f64::from(mask.sum());
                self.sums[frame] += sum;
                self.squared_row_sums[(frame, self.next_row + row)] = sum * sum;
                self.counts[frame].add(mask, &known);
            }
            ndarray::azip!((sum in &mut self.column_sums, &value in &line) *sum += f64::from(value));
            for (column, (pixel, known)) in line.columns().into_iter().zip(known).enumerate() {
                self.add_pixel((self.next_row + row, column), known.then_some(pixel));
            }
        }
        self.next_row += rows;
        Ok(())
    }

    /// The share of pixels that have a property in every mask by chance, from the numbers of pixels that have it in each
    /// mask. There are `pixels` in all.
    fn chance(&self, pixels: f64, count: impl Fn(&PixelCounts) -> u64) -> Chance {
        let share: f64 = self.counts.iter().map(|counts| count(counts) as f64 / pixels).product();
        // Random squares of side s have 2 p (1 - p) / s edges per pixel, where a share p is bright.
        let (mut edges, mut expected) = (0.0, 0.0);
        for counts in &self.counts {
            let bright = counts.bright as f64 / pixels;
            expected += 2.0 * bright * (1.0 - bright);
            edges += counts.edges as f64 / pixels;
        }
        let side = if edges > 0.0 { (expected / edges).max(1.0) } else { 1.0 };
        let squares = pixels / (side * side);
        Chance { share, deviation: (share * (1.0 - share) / squares).sqrt() }
    }

    /// Adds a pixel, which is `None` if it was not measured.
    fn add_pixel(&mut self, at: (usize, usize), values: Option<ArrayView1<'_, f32>>) {
        let Some(values) = values else {
            (self.mean[at], self.gram[at], self.deviation[at]) = (f32::NAN, f32::NAN, f32::NAN);
            return;
        };
        for &value in values {
            self.values_at_zero += u64::from(value <= 0.0);
            self.histogram[bin(value)] += 1;
        }
        let count = values.len() as f32;
        let mean = values.sum() / count;
        let gram: f32 = values.iter().map(|value| value * value).sum();
        let scatter: f32 = values.iter().map(|value| (value - mean).powi(2)).sum();
        self.mean[at] = mean;
        self.gram[at] = gram;
        self.deviation[at] = (scatter / count).sqrt();
        self.stuck_pixels += u64::from(values.iter().all(|value| *value > STUCK_PIXEL));
    }

    /// Returns the statistics.
    ///
    /// Errors: [`OpticsError::Pattern`] if rows are missing.
    pub fn finish(mut self) -> Result<MaskFigures> {
        let height = self.mean.nrows();
        if self.next_row != height {
            return Err(OpticsError::Pattern(format!(
                "the masks are incomplete: {} of {height} rows were added",
                self.next_row
            )));
        }
        let measured_pixels = self.gram.iter().filter(|gram| !gram.is_nan()).count() as u64;
        let dead_pixels = self.gram.iter().filter(|gram| **gram <= 0.0).count() as u64;
        let measured = (measured_pixels as f64).max(1.0);
        let by_chance = self.chance(measured, |counts| counts.closed);
        // Few independent masks of large squares are dark in some areas by chance.
        let is_dark = match by_chance.is_exceeded_by(dead_pixels as f64 / measured) {
            true => dark_areas(&self.gram),
            false => Array2::from_elem(self.gram.dim(), false),
        };
        let dark_area = is_dark.iter().filter(|dark| **dark).count() as u64;
        // Dark areas add nothing to a sum, so only the numbers of pixels change.
        let counted = ndarray::Zip::from(&self.gram)
            .and(&is_dark)
            .map_collect(|gram, dark| f64::from(u8::from(!gram.is_nan() && !dark)));
        let pixels = ((measured_pixels - dark_area) as f64).max(1.0);
        self.histogram[0] -= dark_area * self.sums.len() as u64;
        let covariance = |k: usize, l: usize| {
            self.products[[k, l]] / pixels - self.sums[k] * self.sums[l] / (pixels * pixels)
        };
        let correlation = Array2::from_shape_fn(self.products.dim(), |(k, l)| {
            let norm = (covariance(k, k) * covariance(l, l)).sqrt();
            if norm > 0.0 { (covariance(k, l) / norm).clamp(-1.0, 1.0) } else { 0.0 }
        });
        let squared_mean = |sum: f64| sum * sum / (pixels * pixels);
        // Mean square over the pixels of the means of their lines.
        let between = |squared_sums: ArrayView1<'_, f64>, counts: &Array1<f64>| {
            let lines = squared_sums.into_iter().zip(counts).filter(|(_, count)| **count > 0.0);
            lines.map(|(sum, count)| sum / count).sum::<f64>() / pixels
        };
        let (row_counts, column_counts) = (counted.sum_axis(Axis(1)), counted.sum_axis(Axis(0)));
        let squared_column_sums = self.column_sums.mapv(|sum| sum * sum);
        let (mut total, mut rows, mut columns) = (0.0, 0.0, 0.0);
        for (k, &sum) in self.sums.iter().enumerate() {
            total += covariance(k, k);
            rows += between(self.squared_row_sums.row(k), &row_counts) - squared_mean(sum);
            columns += between(squared_column_sums.row(k), &column_counts) - squared_mean(sum);
        }
        let share = |part: f64| if total > 0.0 { (part / total).clamp(0.0, 1.0) } else { 0.0 };
        Ok(MaskFigures {
            variance_between_rows: share(rows),
            variance_between_columns: share(columns),
            frame_means: self.sums.iter().map(|sum| sum / pixels).collect(),
            correlation,
            measured_pixels,
            dark_area,
            dead_pixels,
            stuck_pixels: self.stuck_pixels,
            dead_by_chance: self.chance(pixels, |counts| counts.closed - dark_area),
            stuck_by_chance: self.chance(pixels, |counts| counts.open),
            values_at_zero: self.values_at_zero,
            largest: percentile(&self.histogram, 1.0),
            percentile_1: percentile(&self.histogram, 0.01),
            percentile_99: percentile(&self.histogram, 0.99),
            mean: self.mean,
            deviation: self.deviation,
            gram: self.gram,
        })
    }
}

impl PixelCounts {
    /// Adds a row of a mask, without the pixels that are not known.
    fn add(&mut self, row: ArrayView1<'_, f32>, known: &[bool]) {
        let mut previous = None;
        for (&value, known) in row.iter().zip(known) {
            if !known {
                previous = None;
                continue;
            }
            let bright = value > 0.5;
            // As in the Gram diagonal: the square of a tiny value is 0.
            self.closed += u64::from(value.max(0.0).powi(2) == 0.0);
            self.open += u64::from(value > STUCK_PIXEL);
            self.bright += u64::from(bright);
            self.edges += u64::from(previous.is_some_and(|previous| previous != bright));
            previous = Some(bright);
        }
    }
}

/// True for pixels in dark areas, from the Gram diagonal \[H,W\].
fn dark_areas(gram: &Array2<f32>) -> Array2<bool> {
    let (height, width) = gram.dim();
    let around = |at: usize, length: usize| at.saturating_sub(1)..length.min(at + 2);
    Array2::from_shape_fn((height, width), |(row, column)| {
        if gram[(row, column)] != 0.0 {
            return false;
        }
        let neighbours = gram.slice(s![around(row, height), around(column, width)]);
        let known = neighbours.iter().filter(|gram| !gram.is_nan()).count();
        let dark = neighbours.iter().filter(|gram| **gram == 0.0).count();
        dark > 1 && dark as f64 >= DARK_AREA * known as f64
    })
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // clamped to the bins
fn bin(value: f32) -> usize {
    (value.clamp(0.0, 1.0) * (BINS - 1) as f32).round() as usize
}

fn percentile(histogram: &[u64], share: f64) -> f32 {
    let total: u64 = histogram.iter().sum();
    let rank = share * total as f64;
    let mut cumulative = 0;
    let bin = histogram.iter().position(|count| {
        cumulative += count;
        cumulative as f64 >= rank
    });
    bin.unwrap_or(0) as f32 / (BINS - 1) as f32
}

/// Uniformity of an illumination \[H,W\]: the smallest over the largest block mean, where the image is divided into
/// 16x16 blocks. Pixels at 0 are ignored. `None` if all pixels are 0.
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
    fn statistics_of_bands_equal_those_of_the_whole_masks() {
        let (mut masks, _) = random_squares(6, 40, 30, 2).unwrap();
        masks.slice_mut(s![.., 3, 4]).fill(0.0);
        masks.slice_mut(s![.., 5, 6]).fill(1.0);
        let mut study = MaskStudy::new(6, 40, 30);
        for band in masks.axis_chunks_iter(Axis(1), 7) {
            study.add(band).unwrap();
        }
        let figures = study.finish().unwrap();
        let pixels_where_all = |condition: fn(f32) -> bool| {
            let pixels = masks.lanes(Axis(0)).into_iter();
            pixels.filter(|pixel| pixel.iter().all(|&value| condition(value))).count() as u64
        };
        assert_eq!(figures.dead_pixels, pixels_where_all(|value| value == 0.0));
        assert_eq!(figures.stuck_pixels, pixels_where_all(|value| value > 0.95));
        assert!(figures.dead_pixels > 0 && figures.stuck_pixels > 0);
        assert_eq!(figures.values_at_zero, masks.iter().filter(|v| **v == 0.0).count() as u64);
        assert!((figures.overall_mean() - f64::from(masks.mean().unwrap())).abs() < 1e-5);
        let deviation = masks.std_axis(Axis(0), 0.0);
        assert!((&figures.deviation - &deviation).iter().all(|v| v.abs() < 1e-5));
        let gram = masks.mapv(|v| v * v).sum_axis(Axis(0));
        assert!((&figures.gram - &gram).iter().all(|v| v.abs() < 1e-4));
        let (a, b) = (masks.index_axis(Axis(0), 1), masks.index_axis(Axis(0), 4));
        let (a, b) = (&a - a.mean().unwrap(), &b - b.mean().unwrap());
        let expected = (&a * &b).sum() / ((&a * &a).sum() * (&b * &b).sum()).sqrt();
        assert!((figures.correlation[[1, 4]] - f64::from(expected)).abs() < 1e-4);
        assert!(figures.percentile_1 < 0.2 && figures.percentile_99 > 0.8);
    }

    /// Areas that were not measured, or that no light reaches, change no statistic of the others.
    #[test]
    fn areas_without_values_are_left_out() {
        let (masks, _) = random_squares(6, 80, 60, 2).unwrap();
        let figures = |masks: &Array3<f32>| {
            let (frames, height, width) = masks.dim();
            let mut study = MaskStudy::new(frames, height, width);
            for band in masks.axis_chunks_iter(Axis(1), 7) {
                study.add(band).unwrap();
            }
            study.finish().unwrap()
        };
        let expected = figures(&masks.slice(s![.., .., 30..]).to_owned());
        for value in [f32::NAN, 0.0] {
            let mut part = masks.clone();
            part.slice_mut(s![.., .., ..30]).fill(value);
            let found = figures(&part);
            let pairs = [
                (found.overall_mean(), expected.overall_mean()),
                (found.mean_deviation(), expected.mean_deviation()),
                (found.correlation[[1, 4]], expected.correlation[[1, 4]]),
                (found.variance_between_rows, expected.variance_between_rows),
                (found.variance_between_columns, expected.variance_between_columns),
                (f64::from(found.percentile_1), f64::from(expected.percentile_1)),
            ];
            for (found, expected) in pairs {
                assert!((found - expected).abs() < 1e-4, "{value}: {pairs:?}");
            }
            assert_eq!(found.dark_area, if value == 0.0 { 80 * 30 } else { 0 });
            assert_eq!(found.dead_pixels - found.dark_area, expected.dead_pixels);
            let grades: Vec<_> = crate::judge_masks(&found, None)
                .into_iter()
                .map(|finding| (finding.code.as_str(), finding.severity))
                .collect();
            let dark = ("dead_pixels", crate::Severity::Warning);
            assert_eq!(grades, if value == 0.0 { vec![dark] } else { vec![] });
        }
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
    fn flatness_is_the_ratio_of_extreme_block_means() {
        assert_eq!(flatness(&Array2::from_elem((64, 48), 3.0).view()), Some(1.0));
        let half = Array2::from_shape_fn((64, 64), |(_, j)| if j < 32 { 1.0 } else { 2.0 });
        assert_eq!(flatness(&half.view()), Some(0.5));
        assert_eq!(flatness(&Array2::zeros((4, 4)).view()), None);
    }

    #[test]
    fn variance_is_split_between_rows_and_columns() {
        let noise = |i: usize| (i * 7919 % 101) as f32 / 100.0;
        let shares = |height: usize, width: usize, value: &dyn Fn(usize, usize) -> f32| {
            let masks =
                Array3::from_shape_fn((3, height, width), |(k, i, j)| value(i + 13 * k, j + 5 * k));
            let mut study = MaskStudy::new(3, height, width);
            study.add(masks.slice(s![.., ..height / 2, ..])).unwrap();
            study.add(masks.slice(s![.., height / 2.., ..])).unwrap();
            let figures = study.finish().unwrap();
            (figures.variance_between_rows, figures.variance_between_columns)
        };
        let (rows, columns) = shares(40, 30, &|i, _| noise(i));
        assert!(rows > 0.999 && columns < 1e-6, "{rows} {columns}");
        let (rows, columns) = shares(40, 30, &|_, j| noise(j));
        assert!(rows < 1e-6 && columns > 0.999, "{rows} {columns}");
        let (rows, columns) = shares(40, 30, &|i, j| noise(31 * i + 17 * j * j));
        assert!(rows < 0.3 && columns < 0.3, "{rows} {columns}");
        assert!(shares(1, 900, &|_, j| noise(j)).1 > 0.999);
        assert_eq!(shares(8, 8, &|_, _| 1.0), (0.0, 0.0));
    }
}
