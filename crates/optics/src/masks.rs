//! The masks of a hybrid coded aperture.

use ndarray::{Array2, Array3, ArrayView3, Axis};
use rand::Rng;

use super::projection::centre;
use super::{Geometry, Method, OpticsError, Placement, Projector, Result, check_patterns};

/// What a mask value of 1 means.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Normalisation {
    /// The largest value of all masks, as after a calibration.
    Maximum,
    /// The light of the whole aperture without a mask, so that masks of patterns that are less
    /// open are darker.
    Throughput,
}

/// The optics that turn patterns into masks. The default is the paper's simulation: sub-apertures
/// shift a random mask by whole mask pixels.
#[derive(Debug, Clone)]
pub struct HybridAperture {
    /// The camera's lengths.
    pub geometry: Geometry,
    /// Where cells shift the mask to.
    pub placement: Placement,
    /// How the light through a cell is taken.
    pub method: Method,
    /// Transmission of the lithography mask's pixels on \[0,1\]; its centre is used. None for a
    /// random binary one, half of it open.
    pub lithography: Option<Array2<f32>>,
    /// What a mask value of 1 means.
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

/// Masks and how much light they pass.
#[derive(Debug, Clone, PartialEq)]
pub struct ProjectedMasks {
    /// The masks \[B,H,W\] on \[0,1\].
    pub masks: Array3<f32>,
    /// Share of the light of the whole aperture without a mask that the masks pass in the mean.
    pub throughput: f64,
    /// The mask value that stands for the whole of that light is 1 over this.
    pub scale: f32,
}

impl HybridAperture {
    /// The masks of `patterns` \[B, rows, columns\] on a sensor of `size` (rows, columns).
    /// Errors: a geometry, patterns or sizes that can't be; a lithography mask that is too small or
    /// has values outside \[0,1\]; masks without light.
    pub fn masks(
        &self,
        patterns: ArrayView3<'_, f32>,
        size: (usize, usize),
        rng: &mut impl Rng,
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
            return Err(OpticsError::Pattern("no light passes the lithography mask".into()));
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
        rng: &mut impl Rng,
    ) -> Result<Array2<f32>> {
        let Some(given) = &self.lithography else {
            return Ok(Array2::from_shape_simple_fn((rows, columns), || {
                f32::from(u8::from(rng.random::<bool>()))
            }));
        };
        if given.nrows() < rows || given.ncols() < columns {
            return Err(OpticsError::Pattern(format!(
                "the lithography mask has {}x{} pixels, but the sensor sees {rows}x{columns} of them",
                given.nrows(),
                given.ncols()
            )));
        }
        if let Some(((row, column), value)) =
            given.indexed_iter().find(|(_, value)| !(0.0..=1.0).contains(*value))
        {
            return Err(OpticsError::Pattern(format!(
                "the lithography mask transmits {value} at row {row}, column {column} (counted from \
                 0); it must be from 0 to 1"
            )));
        }
        Ok(centre(given.view(), (rows, columns)).to_owned())
    }
}

/// Masks \[frames,side,side\] of a circle that turns once, sharply projected.
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
    fn an_even_grid_that_is_centred_correlates_more_and_half_a_pixel_mends_it() {
        let with = |placement, phase_columns| {
            let geometry = Geometry { phase_columns, ..Geometry::default() };
            let optics = HybridAperture { geometry, placement, ..HybridAperture::default() };
            let seen = (0..4).map(|seed| {
                let patterns = squares(seed);
                let made = optics.masks(patterns.view(), (128, 128), &mut generator(seed));
                correlation(&made.unwrap().masks)
            });
            seen.sum::<f32>() / 4.0
        };
        let whole = with(Placement::WholePixels, 0.0);
        assert!((0.45..=0.58).contains(&whole), "{whole}");
        let centred = with(Placement::Geometric, 0.0);
        assert!((0.62..=0.72).contains(&centred), "{centred}");
        let mended = with(Placement::Geometric, 0.5);
        assert!((0.45..=0.58).contains(&mended), "{mended}");
    }

    #[test]
    fn the_cameras_relay_shows_each_mask_pixel_on_four_sensor_pixels() {
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
    fn throughput_follows_the_openings() {
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
    fn a_turning_circle_gives_masks_that_are_alike_in_turn() {
        let all = turning_circle(6, 96, 3);
        let means: Vec<f32> = all.axis_iter(Axis(0)).map(|m| m.mean().unwrap()).collect();
        assert!(means.iter().all(|mean| (mean / means[0] - 1.0).abs() < 0.02), "{means:?}");
        let masks = |k: [usize; 2]| all.select(Axis(0), &k);
        let (near, far) = (correlation(&masks([0, 1])), correlation(&masks([0, 3])));
        assert!(near > far + 0.1, "{near} {far}");
    }

    #[test]
    fn a_given_mask_is_used_or_refused() {
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
