//! The masks of a hybrid coded aperture, computed from its patterns.

use ndarray::{Array2, Array3, ArrayView3, Axis};
use rand::RngExt;

use super::projection::centre;
use super::{Geometry, Method, OpticsError, Placement, Projector, Result, check_patterns};

/// The normalisation of masks.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Normalisation {
    /// 1 is the largest value of all masks, as after a calibration.
    Maximum,
    /// 1 is the light of the whole open aperture without a mask. Patterns with fewer openings give darker masks.
    Throughput,
}

/// The optics that turn patterns into masks. The default is the paper's simulation: sub-apertures shift a random
/// lithography mask by whole mask pixels.
#[derive(Debug, Clone)]
pub struct HybridAperture {
    /// Lengths and pitches of the camera.
    pub geometry: Geometry,
    /// How the shift by an aperture cell is computed.
    pub placement: Placement,
    /// How the light through an aperture cell is modelled.
    pub method: Method,
    /// Transmission of the lithography mask's pixels on \[0,1\]. If it is larger than needed, the central part is used.
    /// `None` for a random binary mask with half of the pixels open.
    pub lithography: Option<Array2<f32>>,
    /// The normalisation of the masks.
    pub normalisation: Normalisation,
}

impl Default for HybridAperture {
    fn default() -> Self {
        Self {
            geometry: Geometry::default(),
            placement: Placement::WholePixels,
            method: Method::Shifts,
            lithography: None,
            normalisation: Normalisation::Maximum,
        }
    }
}

/// Projected masks and their throughput.
#[derive(Debug, Clone, PartialEq)]
pub struct ProjectedMasks {
    /// The masks \[B,H,W\] on \[0,1\].
    pub masks: Array3<f32>,
    /// Mean share of the light of the whole open aperture that the masks transmit.
    pub throughput: f64,
    /// Share of that light where a mask value is 1.
    pub scale: f32,
}

impl HybridAperture {
    /// Computes the masks \[B,H,W\] of `patterns` \[B, rows, columns\] on a sensor of `size` (H, W).
    ///
    /// Errors: [`OpticsError::Parameter`] for an impossible geometry or size; [`OpticsError::Pattern`] for unusable
    /// patterns, for a lithography mask that is too small or has values outside \[0,1\], and for masks without light.
    pub fn masks(
        &self,
        patterns: ArrayView3<'_, f32>,
        size: (usize, usize),
        rng: &mut impl RngExt,
    ) -> Result<ProjectedMasks> {
        let (frames, rows, columns) = patterns.dim();
        check_patterns(patterns, frames)?;
        let projector =
            Projector::new(&self.geometry, (rows, columns), self.placement, self.method, size)?;
        let lithography = self.lithography(projector.mask_size(), rng)?;
        let mut masks = Array3::zeros((frames, size.0, size.1));
        for (mut mask, pattern) in masks.outer_iter_mut().zip(patterns.outer_iter()) {
            mask.assign(&projector.project(lithography.view(), pattern)?);
        }
        let cells = (rows * columns) as f32;
        let mean =
            |mask: ndarray::ArrayView2<'_, f32>| mask.iter().map(|&v| f64::from(v)).sum::<f64>();
        let light: f64 = masks.axis_iter(Axis(0)).map(mean).sum();
        let throughput = light / (masks.len() as f64 * f64::from(cells));
        let largest = masks.fold(0.0f32, |largest, &value| largest.max(value));
        if largest <= 0.0 {
            return Err(OpticsError::Pattern(
                "the lithography mask transmits no light: all masks would be 0".into(),
            ));
        }
        let one = match self.normalisation {
            Normalisation::Maximum => largest,
            Normalisation::Throughput => cells,
        };
        masks /= one;
        Ok(ProjectedMasks { masks, throughput, scale: one / cells })
    }

    fn lithography(
        &self,
        (rows, columns): (usize, usize),
        rng: &mut impl RngExt,
    ) -> Result<Array2<f32>> {
        let Some(given) = &self.lithography else {
            return Ok(Array2::from_shape_simple_fn((rows, columns), || {
                f32::from(u8::from(rng.random::<bool>()))
            }));
        };
        if given.nrows() < rows || given.ncols() < columns {
            return Err(OpticsError::Pattern(format!(
                "the lithography mask has {}x{} pixels, but at least {rows}x{columns} are projected onto the sensor",
                given.nrows(),
                given.ncols()
            )));
        }
        if let Some(((row, column), value)) =
            given.indexed_iter().find(|(_, value)| !(0.0..=1.0).contains(*value))
        {
            return Err(OpticsError::Pattern(format!(
                "the lithography mask transmits {value} at row {row}, column {column} (counted from \
                 0); transmissions must be from 0 to 1"
            )));
        }
        Ok(centre(given.view(), (rows, columns)).to_owned())
    }
}

/// Sharply projected masks \[frames,side,side\] of a circle that makes one turn.
#[cfg(test)]
pub(super) fn turning_circle(frames: usize, side: usize, seed: u64) -> Array3<f32> {
    use super::{Circle, generator};
    let optics = HybridAperture {
        placement: Placement::Geometric,
        method: Method::Convolution,
        ..HybridAperture::default()
    };
    let patterns = Circle::default().patterns(frames, &optics.geometry).unwrap();
    optics.masks(patterns.view(), (side, side), &mut generator(seed)).unwrap().masks
}

#[cfg(test)]
mod tests {
    use ndarray::{Array2, Array3, Axis};

    use super::{HybridAperture, Normalisation, turning_circle};
    use crate::{
        ApertureGrid, Draw, Geometry, Multiplexing, Placement, generator, single_apertures,
    };

    const GRID: ApertureGrid = ApertureGrid { rows: 3, columns: 4 };

    fn squares(seed: u64) -> Array3<f32> {
        Multiplexing::random(10, 12, Draw::of(6), &mut generator(seed)).unwrap().patterns(GRID)
    }

    /// Mean correlation between two frames.
    fn correlation(masks: &Array3<f32>) -> f32 {
        let centred: Vec<Array2<f32>> =
            masks.outer_iter().map(|mask| &mask - mask.mean().unwrap()).collect();
        let mut values = Vec::new();
        for (k, a) in centred.iter().enumerate() {
            for b in &centred[..k] {
                values.push((a * b).sum() / ((a * a).sum() * (b * b).sum()).sqrt());
            }
        }
        values.iter().sum::<f32>() / values.len() as f32
    }

    #[test]
    fn half_pixel_phases_raise_the_correlation_of_even_grids() {
        let mean_correlation = |placement, phase_columns| {
            let geometry = Geometry { phase_columns, ..Geometry::default() };
            let optics = HybridAperture { geometry, placement, ..HybridAperture::default() };
            let correlations = (0..4).map(|seed| {
                let patterns = squares(seed);
                let made = optics.masks(patterns.view(), (128, 128), &mut generator(seed));
                correlation(&made.unwrap().masks)
            });
            correlations.sum::<f32>() / 4.0
        };
        let whole = mean_correlation(Placement::WholePixels, 0.0);
        assert!((0.45..=0.58).contains(&whole), "{whole}");
        let centred = mean_correlation(Placement::Geometric, 0.0);
        assert!((0.62..=0.72).contains(&centred), "{centred}");
        let shifted = mean_correlation(Placement::Geometric, 0.5);
        assert!((0.45..=0.58).contains(&shifted), "{shifted}");
    }

    #[test]
    fn magnification_2_maps_a_mask_pixel_to_four_sensor_pixels() {
        let geometry = Geometry { magnification: 2.0, ..Geometry::default() };
        let optics = HybridAperture { geometry, ..HybridAperture::default() };
        let masks = optics.masks(squares(1).view(), (32, 48), &mut generator(1)).unwrap().masks;
        let paper = HybridAperture::default()
            .masks(squares(1).view(), (16, 24), &mut generator(1))
            .unwrap();
        for ((k, i, j), &value) in masks.indexed_iter() {
            assert_eq!(value, paper.masks[[k, i / 2, j / 2]]);
        }
    }

    #[test]
    fn throughput_is_proportional_to_the_openings() {
        let optics = HybridAperture {
            normalisation: Normalisation::Throughput,
            ..HybridAperture::default()
        };
        let single = single_apertures(10, GRID, &mut generator(1)).unwrap();
        for (patterns, open) in [(squares(2), 6.0), (single, 1.0)] {
            let made = optics.masks(patterns.view(), (96, 96), &mut generator(3)).unwrap();
            let expected = open / 12.0 * 0.5;
            assert!((made.throughput / expected - 1.0).abs() < 0.05, "{}", made.throughput);
            let mean = f64::from(made.masks.mean().unwrap());
            assert!((mean - made.throughput).abs() < 1e-4);
            assert_eq!(made.scale, 1.0);
        }
    }

    #[test]
    fn masks_of_a_turning_circle_correlate_more_with_their_neighbours() {
        let all = turning_circle(6, 96, 3);
        let means: Vec<f32> = all.axis_iter(Axis(0)).map(|m| m.mean().unwrap()).collect();
        assert!(means.iter().all(|mean| (mean / means[0] - 1.0).abs() < 0.02), "{means:?}");
        let masks = |k: [usize; 2]| all.select(Axis(0), &k);
        let (neighbours, opposite) = (correlation(&masks([0, 1])), correlation(&masks([0, 3])));
        assert!(neighbours > opposite + 0.1, "{neighbours} {opposite}");
    }

    #[test]
    fn given_lithography_masks_are_used_or_refused() {
        let with = |lithography| HybridAperture {
            lithography: Some(lithography),
            ..HybridAperture::default()
        };
        let make =
            |lithography| with(lithography).masks(squares(1).view(), (8, 8), &mut generator(1));
        let open = make(Array2::ones((64, 64))).unwrap();
        assert!(open.masks.iter().all(|&value| value == 1.0));
        assert_eq!(open.throughput, 0.5);
        let error = make(Array2::ones((8, 64))).unwrap_err().to_string();
        assert!(error.contains("8x64") && error.contains("10x11"), "{error}");
        let error = make(Array2::from_elem((64, 64), 2.0)).unwrap_err().to_string();
        assert!(error.contains("transmits 2"), "{error}");
        assert!(make(Array2::zeros((64, 64))).is_err());
    }
}
