//! Computes masks from captures of a white board: averages of repeats, then Eq. 7 of the paper, or its four-image form
//! with a separate dark for captures through the mask. Pixels that are known to be bad are NaN in all images.

use ndarray::{Array2, ArrayView2, Zip};

use super::{OpticsError, Result};

/// Denominators below this share of their median are too small to divide by.
const MIN_DENOMINATOR: f32 = 0.01;
/// Number of standard deviations below 0 from which noise does not explain a mask value.
const NEGATIVE_SIGMAS: f32 = 4.0;
/// The corresponding limit for captures without repeats, where the noise is unknown, as a share of the white.
const NEGATIVE_WITHOUT_REPEATS: f32 = -0.02;

/// Values of captures and differences of references are between these. Their squares fit into 32-bit floats.
const RANGE: std::ops::RangeInclusive<f32> = 1e-15..=1e15;

/// Accumulates the repeats of one capture.
#[derive(Debug)]
pub struct Repeats {
    sum: Array2<f64>,
    squares: Array2<f64>,
    saturated: Array2<bool>,
    means: Vec<f64>,
    saturation: Option<f32>,
}

/// The average of the repeats of one capture. Values are as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct Average {
    /// Mean \[H,W\]; NaN at pixels that are left out.
    pub mean: Array2<f32>,
    /// Variance of the mean \[H,W\], from the scatter of the repeats; `None` for a single capture.
    pub variance: Option<Array2<f32>>,
    /// Number of repeats.
    pub repeats: usize,
    /// Number of pixels that are saturated in any repeat; `None` if the saturation level is unknown.
    pub saturated: Option<u64>,
    /// Largest relative difference between the mean of a repeat and that of all repeats.
    pub drift: f64,
}

impl Repeats {
    /// An empty accumulator for captures of `height` x `width` pixels. Values of at least `saturation` are saturated.
    pub fn new(height: usize, width: usize, saturation: Option<f32>) -> Self {
        Self {
            sum: Array2::zeros((height, width)),
            squares: Array2::zeros((height, width)),
            saturated: Array2::from_elem((height, width), false),
            means: Vec::new(),
            saturation,
        }
    }

    /// Leaves out the pixels of a map \[H,W\] of this size: they are NaN in the average. A map of another size is ignored.
    #[must_use]
    pub fn without(mut self, bad: &Array2<bool>) -> Self {
        if bad.dim() == self.sum.dim() {
            self.sum.zip_mut_with(bad, |sum, bad| *sum = if *bad { f64::NAN } else { *sum });
        }
        self
    }

    /// Adds a capture \[H,W\].
    ///
    /// Errors: [`OpticsError::Captures`] for another size, and for values that are not finite or above 1e15. Pixels
    /// that are left out may have any value.
    pub fn add(&mut self, capture: ArrayView2<'_, f32>) -> Result<()> {
        if capture.dim() != self.sum.dim() {
            let ((a, b), (c, d)) = (capture.dim(), self.sum.dim());
            return Err(OpticsError::Captures(format!(
                "this capture is {a}x{b} (rows x columns), but the first one is {c}x{d}: all captures must have the same \
                 size"
            )));
        }
        let is_usable = |value: &f32| value.abs() <= *RANGE.end();
        let is_refused = |&(place, value): &((usize, usize), &f32)| {
            !is_usable(value) && !self.sum[place].is_nan()
        };
        if let Some(((row, column), value)) = capture.indexed_iter().find(is_refused) {
            let limit = RANGE.end();
            return Err(OpticsError::Captures(format!(
                "{value:?} at row {row}, column {column} (counted from 0); every value must be finite and at most \
                 {limit:?}: send the counts of the camera"
            )));
        }
        let saturation = self.saturation.unwrap_or(f32::INFINITY);
        let (mut total, mut known) = (0.0, 0u64);
        Zip::from(&mut self.sum)
            .and(&mut self.squares)
            .and(&mut self.saturated)
            .and(capture)
            .for_each(|sum, square, saturated, &value| {
                if sum.is_nan() {
                    return;
                }
                known += 1;
                let wide = f64::from(value);
                *sum += wide;
                *square += wide * wide;
                *saturated |= value >= saturation;
                total += wide;
            });
        self.means.push(total / known.max(1) as f64);
        Ok(())
    }

    /// Returns the average.
    ///
    /// Errors: [`OpticsError::Captures`] if there are no captures.
    #[allow(clippy::cast_possible_truncation)] // to the precision of masks
    pub fn average(mut self) -> Result<Average> {
        let repeats = self.means.len();
        if repeats == 0 {
            return Err(OpticsError::Captures("there is no capture to average".into()));
        }
        let count = repeats as f64;
        // In place, because a plane of 10 megapixels takes 80 MB.
        Zip::from(&mut self.squares).and(&self.sum).for_each(|square, &sum| {
            *square = ((*square - sum * sum / count) / ((count - 1.0).max(1.0) * count)).max(0.0);
        });
        let overall = self.means.iter().sum::<f64>() / count;
        let drift = self.means.iter().map(|mean| (mean - overall).abs()).fold(0.0, f64::max);
        let saturated = self.saturated.iter().filter(|saturated| **saturated).count() as u64;
        Ok(Average {
            mean: self.sum.mapv(|sum| (sum / count) as f32),
            variance: (repeats > 1).then(|| self.squares.mapv(|variance| variance as f32)),
            repeats,
            saturated: self.saturation.map(|_| saturated),
            drift: if overall > 0.0 { drift / overall } else { 0.0 },
        })
    }
}

/// Averaged captures without a pattern.
#[derive(Debug)]
pub struct References {
    /// LCoS all white, lithography mask removed.
    pub white: Average,
    /// LCoS all black, lithography mask removed.
    pub black: Average,
    /// LCoS all black, lithography mask in place. `None` uses `black` instead (Eq. 7).
    pub black_with_mask: Option<Average>,
}

/// Computes masks from averaged captures of patterns.
#[derive(Debug)]
pub struct Calibrator {
    references: References,
    /// `white - black`, or 0 where it is too small to divide by; NaN at bad pixels.
    denominator: Array2<f32>,
    not_positive: u64,
    too_dark: u64,
}

/// A mask before normalisation to the largest value of all masks.
#[derive(Debug)]
pub struct RawMask {
    /// `(M_k - black_with_mask) / (white - black)` \[H,W\], cut at 0; 0 where the denominator is too small, and
    /// NaN at bad pixels.
    pub values: Array2<f32>,
    /// Largest value.
    pub largest: f32,
    /// Number of pixels at or below 0 among those with a valid denominator.
    pub not_positive: u64,
    /// Number of pixels below 0 by more than noise explains: the dark is too bright there.
    pub negative: u64,
    /// Mean over the pixels with a valid denominator, negative values included.
    pub mean: f64,
    /// Root-mean-square standard deviation of a value due to noise; `None` without repeats.
    pub noise: Option<f64>,
}

impl Calibrator {
    /// Prepares the denominator of Eq. 7.
    ///
    /// Errors: [`OpticsError::Captures`] if the references differ in size, or if the white is nowhere brighter than the
    /// black, or by less than 1e-15 in the median.
    pub fn new(references: References) -> Result<Self> {
        let size = references.white.mean.dim();
        let dark = [Some(&references.black), references.black_with_mask.as_ref()];
        if dark.into_iter().flatten().any(|image| image.mean.dim() != size) {
            return Err(OpticsError::Captures("white, black and black_with_mask differ in size: record them with the same sensor region".into()));
        }
        let mut denominator = &references.white.mean - &references.black.mean;
        let mut positive: Vec<f32> = denominator.iter().copied().filter(|v| *v > 0.0).collect();
        let not_positive = denominator.iter().filter(|value| **value <= 0.0).count() as u64;
        if positive.is_empty() {
            return Err(OpticsError::Captures(
                "white is nowhere brighter than black: check that they are not interchanged and that the light was on"
                    .into(),
            ));
        }
        let middle = positive.len() / 2;
        let median = *positive.select_nth_unstable_by(middle, f32::total_cmp).1;
        if median < *RANGE.start() {
            return Err(OpticsError::Captures(format!(
                "white is brighter than black by only {median:?} in the median: send the counts of the camera"
            )));
        }
        let floor = median * MIN_DENOMINATOR;
        let too_dark = positive.iter().filter(|value| **value < floor).count() as u64;
        denominator.mapv_inplace(|value| if value < floor { 0.0 } else { value });
        Ok(Self { references, denominator, not_positive, too_dark })
    }

    /// The illumination `white - black` \[H,W\]; 0 where it is too dark to divide by, and NaN at bad pixels.
    pub fn illumination(&self) -> ArrayView2<'_, f32> {
        self.denominator.view()
    }

    /// The reference images.
    pub fn references(&self) -> &References {
        &self.references
    }

    /// Number of pixels whose white is not above their black.
    pub fn not_positive(&self) -> u64 {
        self.not_positive
    }

    /// Number of pixels whose white is above their black, but by less than 1 % of the median.
    pub fn too_dark(&self) -> u64 {
        self.too_dark
    }

    fn dark(&self) -> &Average {
        self.references.black_with_mask.as_ref().unwrap_or(&self.references.black)
    }

    /// Computes the mask of an averaged pattern.
    ///
    /// Errors: [`OpticsError::Captures`] for a capture of another size.
    pub fn mask(&self, capture: &Average) -> Result<RawMask> {
        if capture.mean.dim() != self.denominator.dim() {
            let ((a, b), (c, d)) = (capture.mean.dim(), self.denominator.dim());
            return Err(OpticsError::Captures(format!(
                "the captures of this pattern are {a}x{b} (rows x columns), but white and black are {c}x{d}"
            )));
        }
        let variance = self.variance(capture);
        let mut mask = RawMask {
            values: &capture.mean - &self.dark().mean,
            largest: 0.0,
            not_positive: 0,
            negative: 0,
            mean: 0.0,
            noise: None,
        };
        let (mut total, mut noise, mut valid) = (0.0, 0.0, 0u64);
        for (place, value) in mask.values.indexed_iter_mut() {
            let denominator = self.denominator[place];
            if denominator == 0.0 || denominator.is_nan() {
                *value = denominator;
                continue;
            }
            *value /= denominator;
            valid += 1;
            total += f64::from(*value);
            let limit = match &variance {
                Some(variance) => {
                    let variance = variance(place, *value) / (denominator * denominator);
                    noise += f64::from(variance);
                    -NEGATIVE_SIGMAS * variance.sqrt()
                }
                None => NEGATIVE_WITHOUT_REPEATS,
            };
            mask.not_positive += u64::from(*value <= 0.0);
            mask.negative += u64::from(*value < limit);
            mask.largest = mask.largest.max(*value);
            *value = value.max(0.0);
        }
        let valid = valid.max(1) as f64;
        mask.mean = total / valid;
        mask.noise = variance.is_some().then(|| (noise / valid).sqrt());
        Ok(mask)
    }

    /// Variance of a mask value times the squared denominator, by pixel and mask value. It combines the variances of
    /// numerator and denominator. `None` if any of the images has no repeats.
    fn variance<'a>(
        &'a self,
        capture: &'a Average,
    ) -> Option<impl Fn((usize, usize), f32) -> f32 + use<'a>> {
        let [capture, dark, white, black] =
            [capture, self.dark(), &self.references.white, &self.references.black]
                .map(|image| image.variance.as_ref());
        let (capture, dark, white, black) = (capture?, dark?, white?, black?);
        Some(move |at, value: f32| capture[at] + dark[at] + value * value * (white[at] + black[at]))
    }
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, array};

    use super::{Average, Calibrator, References, Repeats};

    fn average(mean: Array2<f32>) -> Average {
        Average { mean, variance: None, repeats: 1, saturated: None, drift: 0.0 }
    }

    #[test]
    fn repeats_are_averaged_with_their_variance() {
        let mut repeats = Repeats::new(1, 2, Some(100.0));
        for capture in [array![[1.0, 98.0]], array![[3.0, 100.0]], array![[5.0, 96.0]]] {
            repeats.add(capture.view()).unwrap();
        }
        let error = repeats.add(array![[1.0]].view()).unwrap_err().to_string();
        assert!(error.contains("1x1") && error.contains("1x2"), "{error}");
        for unusable in [f32::NAN, f32::INFINITY, -1e30] {
            let error = repeats.add(array![[unusable, 1.0]].view()).unwrap_err().to_string();
            assert!(error.contains("row 0, column 0"), "{error}");
        }
        let average = repeats.average().unwrap();
        assert_eq!(average.mean, array![[3.0, 98.0]]);
        // Three values with variance 4: the variance of their mean is 4/3.
        let variance = average.variance.unwrap();
        assert!((variance[[0, 0]] - 4.0 / 3.0).abs() < 1e-6, "{variance}");
        assert_eq!(average.saturated, Some(1));
        assert!(Repeats::new(1, 1, None).average().is_err());
    }

    #[test]
    fn masks_follow_from_four_images_or_from_equation_7() {
        let references = |black_with_mask| References {
            white: average(array![[110.0, 60.0, 10.0, 10.1]]),
            black: average(array![[10.0, 10.0, 10.0, 10.0]]),
            black_with_mask,
        };
        let capture = average(array![[55.0, 5.0, 90.0, 90.0]]);
        let four =
            Calibrator::new(references(Some(average(array![[5.0, 5.0, 5.0, 5.0]])))).unwrap();
        let mask = four.mask(&capture).unwrap();
        // The third pixel has no light, the fourth too little.
        assert_eq!(mask.values, array![[0.5, 0.0, 0.0, 0.0]]);
        assert_eq!((four.not_positive(), four.too_dark()), (1, 1));
        assert_eq!((mask.not_positive, mask.negative), (1, 0));
        let seven = Calibrator::new(references(None)).unwrap();
        let mask = seven.mask(&capture).unwrap();
        assert_eq!(mask.values, array![[0.45, 0.0, 0.0, 0.0]]);
        assert_eq!(
            (mask.not_positive, mask.negative),
            (1, 1),
            "(5 - 10) / 50 is below the noise limit"
        );
        let interchanged = References {
            white: average(array![[1.0]]),
            black: average(array![[2.0]]),
            black_with_mask: None,
        };
        assert!(
            Calibrator::new(interchanged).unwrap_err().to_string().contains("nowhere brighter")
        );
        let faint = References {
            white: average(array![[1e-40]]),
            black: average(array![[0.0]]),
            black_with_mask: None,
        };
        assert!(Calibrator::new(faint).unwrap_err().to_string().contains("by only"));
    }

    #[test]
    fn noise_is_propagated_from_the_repeats() {
        let with = |mean: f32, variance: f32| Average {
            mean: array![[mean]],
            variance: Some(array![[variance]]),
            repeats: 9,
            saturated: None,
            drift: 0.0,
        };
        let references = References {
            white: with(110.0, 4.0),
            black: with(10.0, 1.0),
            black_with_mask: Some(with(10.0, 1.0)),
        };
        let mask = Calibrator::new(references).unwrap().mask(&with(60.0, 2.0)).unwrap();
        assert_eq!(mask.values, array![[0.5]]);
        let expected = ((2.0 + 1.0 + 0.25 * 5.0) / 100.0f64.powi(2)).sqrt();
        assert!((mask.noise.unwrap() - expected).abs() < 1e-6, "{:?}", mask.noise);
    }
}
