//! Geometry of the camera, and the mask shift that follows from it.

use super::{Result, check_parameter};

/// The hybrid coded aperture: an LCoS in the aperture of a 4f system, a lithography mask in front of its image plane,
/// and a relay to the sensor. The defaults are those of the paper's simulation.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Geometry {
    /// Rows of the LCoS, in pixels.
    pub lcos_rows: usize,
    /// Columns of the LCoS, in pixels.
    pub lcos_columns: usize,
    /// Side of an LCoS pixel, in micrometres.
    pub lcos_pitch_um: f64,
    /// Focal length of the lenses of the 4f system, in millimetres.
    pub focal_length_mm: f64,
    /// Distance of the lithography mask before the image plane, in micrometres.
    pub mask_distance_um: f64,
    /// Side of a pixel of the lithography mask, in micrometres.
    pub mask_pitch_um: f64,
    /// Magnification of the relay from the image plane to the sensor: 1 in the paper's simulation, 2 in its camera.
    pub magnification: f64,
    /// Side of a sensor pixel, in micrometres.
    pub sensor_pitch_um: f64,
    /// Standard deviation, in micrometres on the image plane, of the Gaussian that models aberrations and diffraction.
    pub blur_um: f64,
    /// Position of the sensor's first row on the lithography mask, in mask pixels. Its fraction is the sub-pixel phase.
    pub phase_rows: f64,
    /// Position of the sensor's first column on the lithography mask, in mask pixels.
    pub phase_columns: f64,
}

impl Default for Geometry {
    fn default() -> Self {
        Self {
            lcos_rows: 1536,
            lcos_columns: 2048,
            lcos_pitch_um: 8.2,
            focal_length_mm: 75.0,
            mask_distance_um: 80.0,
            mask_pitch_um: 4.5,
            magnification: 1.0,
            sensor_pitch_um: 4.5,
            blur_um: 0.0,
            phase_rows: 0.0,
            phase_columns: 0.0,
        }
    }
}

/// Largest accepted shift or blur, in mask pixels.
const MAX_SHIFT: f64 = 1000.0;

impl Geometry {
    /// Checks all parameters.
    ///
    /// Errors: [`OpticsError::Parameter`](super::OpticsError::Parameter) that names the first one out of range.
    pub fn check(&self) -> Result<()> {
        let lengths = [
            ("lcos pitch_um", self.lcos_pitch_um),
            ("relay focal_length_mm", self.focal_length_mm),
            ("mask distance_um", self.mask_distance_um),
            ("mask pitch_um", self.mask_pitch_um),
            ("relay magnification", self.magnification),
            ("sensor pitch_um", self.sensor_pitch_um),
        ];
        for (name, value) in lengths {
            let fits = value.is_finite() && value > 0.0;
            check_parameter(fits, name, value, "a finite number above 0")?;
        }
        for (name, value) in [("lcos rows", self.lcos_rows), ("lcos columns", self.lcos_columns)] {
            let fits = (1..=1 << 16).contains(&value);
            check_parameter(fits, name, value, "from 1 to 65536 pixels")?;
        }
        let fits = self.blur_um >= 0.0 && self.blur() <= MAX_SHIFT;
        check_parameter(fits, "projection blur_um", self.blur_um, "0 to 1000 mask pixels")?;
        for (name, value) in
            [("phase_rows", self.phase_rows), ("phase_columns", self.phase_columns)]
        {
            let fits = (-MAX_SHIFT..=MAX_SHIFT).contains(&value);
            check_parameter(fits, name, value, "-1000 to 1000 mask pixels")?;
        }
        let ratio = self.sensor_pixels_per_mask_pixel();
        let range = "such that 0.1 to 64 sensor pixels show a mask pixel (magnification x mask \
                     pitch / sensor pitch)";
        let fits = (0.1..=64.0).contains(&ratio);
        check_parameter(fits, "relay magnification", self.magnification, range)?;
        let widest = self.lcos_rows.max(self.lcos_columns) as f64 * self.shift_per_lcos_pixel();
        let range = "such that the aperture shifts the mask by at most 1000 mask pixels";
        check_parameter(widest <= MAX_SHIFT, "mask distance_um", self.mask_distance_um, range)
    }

    /// Shift of the projected mask, in mask pixels, when the opening moves by one LCoS pixel: mask distance x LCoS
    /// pitch / focal length.
    pub fn shift_per_lcos_pixel(&self) -> f64 {
        let shift_um = self.mask_distance_um * self.lcos_pitch_um / (self.focal_length_mm * 1000.0);
        shift_um / self.mask_pitch_um
    }

    /// Number of sensor pixels along the side of one projected mask pixel.
    pub fn sensor_pixels_per_mask_pixel(&self) -> f64 {
        self.magnification * self.mask_pitch_um / self.sensor_pitch_um
    }

    /// Standard deviation of the blur in mask pixels.
    pub(super) fn blur(&self) -> f64 {
        self.blur_um / self.mask_pitch_um
    }
}

#[cfg(test)]
mod tests {
    use super::Geometry;

    #[test]
    fn a_sub_aperture_of_512_pixels_shifts_by_one_mask_pixel() {
        let paper = Geometry::default();
        paper.check().unwrap();
        assert!((512.0 * paper.shift_per_lcos_pixel() - 1.0).abs() < 0.006);
        assert_eq!(paper.sensor_pixels_per_mask_pixel(), 1.0);
        let camera = Geometry { magnification: 2.0, ..paper };
        assert_eq!(camera.sensor_pixels_per_mask_pixel(), 2.0);
        assert_eq!(camera.shift_per_lcos_pixel(), paper.shift_per_lcos_pixel());
    }

    #[test]
    fn parameters_out_of_range_are_refused_by_name() {
        let paper = Geometry::default();
        let bad = [
            (Geometry { mask_distance_um: 0.0, ..paper }, "mask distance_um is 0"),
            (Geometry { mask_distance_um: -80.0, ..paper }, "mask distance_um is -80"),
            (Geometry { mask_distance_um: 1e9, ..paper }, "at most 1000 mask pixels"),
            (Geometry { focal_length_mm: f64::NAN, ..paper }, "focal_length_mm is NaN"),
            (Geometry { lcos_rows: 0, ..paper }, "lcos rows is 0"),
            (Geometry { magnification: 1e-3, ..paper }, "relay magnification"),
            (Geometry { blur_um: -1.0, ..paper }, "projection blur_um is -1"),
            (Geometry { phase_rows: f64::INFINITY, ..paper }, "phase_rows is inf"),
        ];
        for (geometry, expected) in bad {
            let error = geometry.check().unwrap_err().to_string();
            assert!(error.contains(expected), "{error}");
        }
    }
}
