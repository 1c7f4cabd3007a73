//! From captures of a white board to masks: averages of repeats, Eq. 7 of the paper and its form
//! with four images.

use ndarray::{Array2, ArrayView2, Zip};

use super::{OpticsError, Result};

/// Denominators below this share of their median are too dark to divide by.
const DARKEST: f32 = 0.01;
/// A mask value so many standard deviations below 0 is no noise.
const SURELY: f32 = 4.0;
/// The same where a capture has no repeats to tell its noise: a share of the white.
const NEGATIVE: f32 = -0.02;

/// Sums of the repeats of one capture, to which one frame is added at a time.
#[derive(Debug)]
pub struct Repeats {
    sum: Array2<f64>,
    squares: Array2<f64>,
    full: Array2<bool>,
    means: Vec<f64>,
    saturation: Option<f32>,
}

/// The average of the repeats of one capture. Values are numbers as stored.
#[derive(Debug, Clone, PartialEq)]
pub struct Average {
    /// Mean \[H,W\].
    pub mean: Array2<f32>,
    /// Variance \[H,W\] of that mean, from the scatter of the repeats; none for a single capture.
    pub variance: Option<Array2<f32>>,
    /// Number of repeats.
    pub repeats: usize,
    /// Pixels that were full in any repeat; none if nobody knows when they are.
    pub saturated: Option<u64>,
    /// Largest difference of a repeat's mean from that of all, as a share of it.
    pub drift: f64,
}

impl Repeats {
    /// No captures yet, of `height` x `width`; numbers from `saturation` on mean a full pixel.
    pub fn new(height: usize, width: usize, saturation: Option<f32>) -> Self {
        Self {
            sum: Array2::zeros((height, width)),
            squares: Array2::zeros((height, width)),
            full: Array2::from_elem((height, width), false),
            means: Vec::new(),
            saturation,
        }
    }

    /// Adds a capture.
    /// Errors: another size; numbers that are not finite.
    pub fn add(&mut self, capture: ArrayView2<'_, f32>) -> Result<()> {
        if capture.dim() != self.sum.dim() {
            let ((a, b), (c, d)) = (capture.dim(), self.sum.dim());
            return Err(OpticsError::Captures(format!(
                "a capture is {a}x{b} (rows x columns), the first one {c}x{d}"
            )));
        }
        if let Some(((row, column), value)) = capture.indexed_iter().find(|(_, v)| !v.is_finite()) {
            return Err(OpticsError::Captures(format!(
                "{value} at row {row}, column {column} (counted from 0); every value must be finite"
            )));
        }
        let full = self.saturation.unwrap_or(f32::INFINITY);
        let mut total = 0.0;
        Zip::from(&mut self.sum).and(&mut self.squares).and(&mut self.full).and(capture).for_each(
            |sum, square, saturated, &value| {
                let wide = f64::from(value);
                *sum += wide;
                *square += wide * wide;
                *saturated |= value >= full;
                total += wide;
            },
        );
        self.means.push(total / capture.len() as f64);
        Ok(())
    }

    /// The average.
    /// Errors: no captures.
    #[allow(clippy::cast_possible_truncation)] // to the precision of masks
    pub fn average(mut self) -> Result<Average> {
        let repeats = self.means.len();
        if repeats == 0 {
            return Err(OpticsError::Captures("there is no capture to average".into()));
        }
        let count = repeats as f64;
        // In place: at 10 megapixels a plane is 80 MB.
        Zip::from(&mut self.squares).and(&self.sum).for_each(|square, &sum| {
            *square = ((*square - sum * sum / count) / ((count - 1.0).max(1.0) * count)).max(0.0);
        });
        let overall = self.means.iter().sum::<f64>() / count;
        let drift = self.means.iter().map(|mean| (mean - overall).abs()).fold(0.0, f64::max);
        let saturated = self.full.iter().filter(|full| **full).count() as u64;
        Ok(Average {
            mean: self.sum.mapv(|sum| (sum / count) as f32),
            variance: (repeats > 1).then(|| self.squares.mapv(|variance| variance as f32)),
            repeats,
            saturated: self.saturation.map(|_| saturated),
            drift: if overall > 0.0 { drift / overall } else { 0.0 },
        })
    }
}

/// Averages of the images without a pattern.
#[derive(Debug)]
pub struct References {
    /// Without the lithography mask, the LCoS all white.
    pub white: Average,
    /// Without the lithography mask, the LCoS all black.
    pub black: Average,
    /// With the lithography mask, the LCoS all black; none to use `black` for it (Eq. 7).
    pub black_with_mask: Option<Average>,
}

/// Turns averaged captures of patterns into masks.
#[derive(Debug)]
pub struct Calibrator {
    references: References,
    /// `white - black`, and 0 where that is too dark to divide by.
    denominator: Array2<f32>,
    not_positive: u64,
    too_dark: u64,
}

/// A mask that is not yet divided by the largest value of all masks.
#[derive(Debug)]
pub struct RawMask {
    /// `(M_k - black_with_mask) / (white - black)` \[H,W\], at least 0, and 0 where nothing is known.
    pub values: Array2<f32>,
    /// Largest value.
    pub largest: f32,
    /// Pixels at or below 0, where the denominator was good.
    pub not_positive: u64,
    /// Those of them that are too far below 0 for noise: the dark was too bright there.
    pub negative: u64,
    /// Mean over the good pixels, negative ones included.
    pub mean: f64,
    /// Standard deviation that noise gives a value in the mean; none without repeats.
    pub noise: Option<f64>,
}

impl Calibrator {
    /// # Errors
    /// References of different sizes, or a white that is nowhere brighter than the black.
    pub fn new(references: References) -> Result<Self> {
        let size = references.white.mean.dim();
        let dark = [Some(&references.black), references.black_with_mask.as_ref()];
        if dark.into_iter().flatten().any(|image| image.mean.dim() != size) {
            return Err(OpticsError::Captures("the reference images differ in size".into()));
        }
        let mut denominator = &references.white.mean - &references.black.mean;
        let mut positive: Vec<f32> = denominator.iter().copied().filter(|v| *v > 0.0).collect();
        let not_positive = (denominator.len() - positive.len()) as u64;
        if positive.is_empty() {
            return Err(OpticsError::Captures(
                "white is nowhere brighter than black: were the two confused, or was there no light?"
                    .into(),
            ));
        }
        let middle = positive.len() / 2;
        let floor = *positive.select_nth_unstable_by(middle, f32::total_cmp).1 * DARKEST;
        let too_dark = positive.iter().filter(|value| **value < floor).count() as u64;
        denominator.mapv_inplace(|value| if value >= floor { value } else { 0.0 });
        Ok(Self { references, denominator, not_positive, too_dark })
    }

    /// `white - black` \[H,W\], the illumination; 0 where it is too dark to divide by.
    pub fn illumination(&self) -> ArrayView2<'_, f32> {
        self.denominator.view()
    }

    /// The reference images.
    pub fn references(&self) -> &References {
        &self.references
    }

    /// Pixels whose white is not above their black.
    pub fn not_positive(&self) -> u64 {
        self.not_positive
    }

    /// Further pixels whose white is above their black by less than 1 % of the median.
    pub fn too_dark(&self) -> u64 {
        self.too_dark
    }

    fn dark(&self) -> &Average {
        self.references.black_with_mask.as_ref().unwrap_or(&self.references.black)
    }

    /// The mask of an averaged pattern.
    /// Errors: a capture of another size.
    pub fn mask(&self, capture: &Average) -> Result<RawMask> {
        if capture.mean.dim() != self.denominator.dim() {
            let ((a, b), (c, d)) = (capture.mean.dim(), self.denominator.dim());
            return Err(OpticsError::Captures(format!(
                "a pattern's captures are {a}x{b} (rows x columns), the reference images {c}x{d}"
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
        let (mut total, mut noise, mut good) = (0.0, 0.0, 0u64);
        for (place, value) in mask.values.indexed_iter_mut() {
            let denominator = self.denominator[place];
            if denominator == 0.0 {
                *value = 0.0;
                continue;
            }
            *value /= denominator;
            good += 1;
            total += f64::from(*value);
            let limit = match &variance {
                Some(variance) => {
                    let variance = variance(place, *value) / (denominator * denominator);
                    noise += f64::from(variance);
                    -SURELY * variance.sqrt()
                }
                None => NEGATIVE,
            };
            mask.not_positive += u64::from(*value <= 0.0);
            mask.negative += u64::from(*value < limit);
            mask.largest = mask.largest.max(*value);
            *value = value.max(0.0);
        }
        let good = good.max(1) as f64;
        mask.mean = total / good;
        mask.noise = variance.is_some().then(|| (noise / good).sqrt());
        Ok(mask)
    }

    /// The variance of a mask's numerator, the denominator's share included, by place and value;
    /// none if any of the images has no repeats.
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
    fn repeats_are_averaged_as_they_come() {
        let mut repeats = Repeats::new(1, 2, Some(100.0));
        for capture in [array![[1.0, 98.0]], array![[3.0, 100.0]], array![[5.0, 96.0]]] {
            repeats.add(capture.view()).unwrap();
        }
        let error = repeats.add(array![[1.0]].view()).unwrap_err().to_string();
        assert!(error.contains("1x1") && error.contains("1x2"), "{error}");
        assert!(repeats.add(array![[f32::NAN, 1.0]].view()).is_err());
        let average = repeats.average().unwrap();
        assert_eq!(average.mean, array![[3.0, 98.0]]);
        // Variance 4 of three values, of their mean a third of it.
        let variance = average.variance.unwrap();
        assert!((variance[[0, 0]] - 4.0 / 3.0).abs() < 1e-6, "{variance}");
        assert_eq!(average.saturated, Some(1));
        assert!(Repeats::new(1, 1, None).average().is_err());
    }

    #[test]
    fn the_four_images_give_the_mask_and_one_background_gives_equation_7() {
        let references = |black_with_mask| References {
            white: average(array![[110.0, 60.0, 10.0, 10.1]]),
            black: average(array![[10.0, 10.0, 10.0, 10.0]]),
            black_with_mask,
        };
        let capture = average(array![[55.0, 5.0, 90.0, 90.0]]);
        let four =
            Calibrator::new(references(Some(average(array![[5.0, 5.0, 5.0, 5.0]])))).unwrap();
        let mask = four.mask(&capture).unwrap();
        // The third pixel has no light, the fourth too little: nothing is known of either.
        assert_eq!(mask.values, array![[0.5, 0.0, 0.0, 0.0]]);
        assert_eq!((four.not_positive(), four.too_dark()), (1, 1));
        assert_eq!((mask.not_positive, mask.negative), (1, 0));
        let seven = Calibrator::new(references(None)).unwrap();
        let mask = seven.mask(&capture).unwrap();
        assert_eq!(mask.values, array![[0.45, 0.0, 0.0, 0.0]]);
        assert_eq!((mask.not_positive, mask.negative), (1, 1), "(5 - 10) / 50 is no noise");
        let confused = References {
            white: average(array![[1.0]]),
            black: average(array![[2.0]]),
            black_with_mask: None,
        };
        assert!(Calibrator::new(confused).unwrap_err().to_string().contains("nowhere brighter"));
    }

    #[test]
    fn noise_follows_from_the_repeats() {
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
