//! A camera model: shot noise, read noise, background, saturation and bit depth.

use ndarray::{Array2, ArrayView2};
use rand::Rng;
use rand_distr::{Distribution, Normal, Poisson};
use serde::{Deserialize, Serialize};

use super::{OpticsError, Result, check_parameter};

/// A camera and its exposure. Signals are shares of the full well.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Camera {
    /// Bit depth of stored values, 1 to 16.
    pub bits: u32,
    /// Full-well capacity of a pixel, in electrons.
    pub full_well_e: f64,
    /// Standard deviation of the read noise, in electrons.
    pub read_noise_e: f64,
    /// Offset that the camera adds to every pixel, as a share of the full well.
    pub black_level: f64,
    /// Stray light and leakage through the closed LCoS, as a share of the full well.
    pub background: f64,
    /// Exposure of the calibration: the share of the full well that a white board fills through the open aperture
    /// without a mask.
    pub calibration_exposure: f64,
    /// Exposure of one frame of the measurement, defined like `calibration_exposure`.
    pub measurement_exposure: f64,
}

impl Default for Camera {
    /// A common industrial sensor; the paper gives no such numbers.
    fn default() -> Self {
        Self {
            bits: 12,
            full_well_e: 10_000.0,
            read_noise_e: 8.0,
            black_level: 0.01,
            background: 0.01,
            calibration_exposure: 0.85,
            measurement_exposure: 0.2,
        }
    }
}

impl Camera {
    /// Checks all parameters.
    ///
    /// Errors: [`OpticsError::Parameter`] that names the first one out of range.
    pub fn check(&self) -> Result<()> {
        let (well, noise) = (self.full_well_e, self.read_noise_e);
        check_parameter((1..=16).contains(&self.bits), "camera bits", self.bits, "1 to 16")?;
        let range = "1 to 1e9 electrons";
        check_parameter((1.0..=1e9).contains(&well), "camera full_well_e", well, range)?;
        let range = "0 to the full well";
        check_parameter((0.0..=well).contains(&noise), "camera read_noise_e", noise, range)?;
        for (name, value) in
            [("camera black_level", self.black_level), ("camera background", self.background)]
        {
            let range = "at least 0 and below 1, a share of the full well";
            check_parameter((0.0..1.0).contains(&value), name, value, range)?;
        }
        for (name, value) in [
            ("camera calibration_exposure", self.calibration_exposure),
            ("camera measurement_exposure", self.measurement_exposure),
        ] {
            let range = "above 0 and at most 100 full wells";
            check_parameter(value > 0.0 && value <= 100.0, name, value, range)?;
        }
        Ok(())
    }

    /// Largest value of a pixel.
    #[allow(clippy::cast_possible_truncation)] // at most 65535
    pub fn saturation(&self) -> u16 {
        ((1u32 << self.bits.min(16)) - 1) as u16
    }

    /// Simulates a capture \[H,W\] of `light` \[H,W\] and a uniform `background`, both as shares of the full well.
    ///
    /// Electrons follow a Poisson distribution and are cut at the full well; read noise and the black level are added;
    /// values are rounded and cut at [`Camera::saturation`]. NaN counts as no light.
    ///
    /// Errors: [`OpticsError::Parameter`] for a parameter out of range, [`OpticsError::Pattern`] for infinite light.
    pub fn capture(
        &self,
        light: ArrayView2<'_, f32>,
        background: f64,
        rng: &mut impl Rng,
    ) -> Result<Array2<u16>> {
        self.check()?;
        let read = Normal::new(0.0, self.read_noise_e).map_err(|error| impossible(&error))?;
        let unit = f64::from(self.saturation()) / self.full_well_e;
        let mut capture = Array2::zeros(light.dim());
        for (value, &light) in capture.iter_mut().zip(light) {
            let expected = (f64::from(light) + background) * self.full_well_e;
            let arrived = if expected > 0.0 {
                Poisson::new(expected).map_err(|error| impossible(&error))?.sample(rng)
            } else {
                0.0
            };
            let offset = self.black_level * self.full_well_e;
            let electrons = arrived.min(self.full_well_e) + read.sample(rng) + offset;
            *value = digital(electrons * unit, self.saturation());
        }
        Ok(capture)
    }
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // clamped to the range
fn digital(value: f64, largest: u16) -> u16 {
    value.round().clamp(0.0, f64::from(largest)) as u16
}

fn impossible(error: &dyn std::fmt::Display) -> OpticsError {
    OpticsError::Pattern(format!("the light on the sensor can't be simulated: {error}"))
}

/// Relative illumination \[H,W\] of a sensor with vignetting: 1 in the centre, and less by the share `vignetting` in
/// the corners. The loss grows with the square of the distance from the centre.
///
/// Errors: [`OpticsError::Parameter`] for a share outside \[0,1).
pub fn illumination((height, width): (usize, usize), vignetting: f64) -> Result<Array2<f32>> {
    let range = "at least 0 and below 1, the share of light lost at the corners";
    check_parameter((0.0..1.0).contains(&vignetting), "light vignetting", vignetting, range)?;
    let (middle_row, middle_column) = ((height as f64 - 1.0) / 2.0, (width as f64 - 1.0) / 2.0);
    let corner = (middle_row.powi(2) + middle_column.powi(2)).max(f64::MIN_POSITIVE);
    #[allow(clippy::cast_possible_truncation)] // to the precision of pictures
    let light = |(row, column): (usize, usize)| {
        let square = (row as f64 - middle_row).powi(2) + (column as f64 - middle_column).powi(2);
        (1.0 - vignetting * square / corner) as f32
    };
    Ok(Array2::from_shape_fn((height, width), light))
}

#[cfg(test)]
mod tests {
    use ndarray::Array2;

    use super::{Camera, illumination};
    use crate::generator;

    #[test]
    fn captures_have_shot_noise_and_read_noise() {
        let camera = Camera { bits: 16, ..Camera::default() };
        let light = Array2::from_elem((100, 100), 0.4);
        let capture = camera.capture(light.view(), 0.05, &mut generator(1)).unwrap();
        let unit = 65535.0 / 10_000.0;
        let electrons = capture.mapv(|value| f64::from(value) / unit);
        let expected = 4500.0 + 100.0;
        assert!((electrons.mean().unwrap() - expected).abs() < 3.0, "{:?}", electrons.mean());
        let noise = (4500.0f64 + 64.0).sqrt();
        assert!((electrons.std(0.0) / noise - 1.0).abs() < 0.03, "{}", electrons.std(0.0));
    }

    #[test]
    fn too_much_light_saturates() {
        let camera = Camera::default();
        let light = Array2::from_elem((8, 8), 3.0);
        let capture = camera.capture(light.view(), 0.0, &mut generator(1)).unwrap();
        assert!(capture.iter().all(|&value| value == 4095));
        let nan = Array2::from_elem((2, 2), f32::NAN);
        let dark = camera.capture(nan.view(), 0.0, &mut generator(1)).unwrap();
        assert!(dark.iter().all(|&value| value < 100));
    }

    #[test]
    fn illumination_decreases_towards_the_corners() {
        let light = illumination((11, 21), 0.3).unwrap();
        assert_eq!(light[[5, 10]], 1.0);
        assert!((light[[0, 0]] - 0.7).abs() < 1e-6 && (light[[10, 20]] - 0.7).abs() < 1e-6);
        assert_eq!(illumination((1, 1), 0.5).unwrap()[[0, 0]], 1.0);
        assert!(illumination((4, 4), 1.0).is_err());
    }

    #[test]
    fn parameters_out_of_range_are_refused_by_name() {
        let camera = Camera::default();
        for (bad, name) in [
            (Camera { bits: 17, ..camera }, "camera bits is 17"),
            (Camera { full_well_e: 0.0, ..camera }, "full_well_e is 0"),
            (Camera { read_noise_e: -1.0, ..camera }, "read_noise_e is -1"),
            (Camera { background: 1.0, ..camera }, "background is 1"),
            (Camera { calibration_exposure: 0.0, ..camera }, "calibration_exposure is 0"),
        ] {
            let error = bad.check().unwrap_err().to_string();
            assert!(error.contains(name), "{error}");
        }
    }
}
