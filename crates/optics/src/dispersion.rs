//! Single-disperser spectral imaging (CASSI): a prism or grating displaces the bands of a coded scene along one axis.
//!
//! One two-dimensional mask codes all bands, so the mask of band `b` is that mask, displaced by the offset of the band. The
//! measurement is `y = sum_b S_b(C) S_b(x_b)`, where `S_b` displaces by the offset `d_b`.

use std::ops::Range;

use ndarray::{Array2, ArrayView2, Axis, Slice};
use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, VariantNames};

use super::FindingCode;

/// Largest number of bands.
pub const MAX_BANDS: usize = 64;
/// Largest offset in pixels.
const MAX_OFFSET: f64 = 4096.0;
/// Largest wavelength in nanometres: 1 mm, the end of the infrared.
const MAX_WAVELENGTH: f64 = 1e6;
/// Relative difference up to which two wavelengths are the same.
const SAME_WAVELENGTH: f64 = 1e-11;

/// The displacement of the bands of a spectral camera.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
pub struct Dispersion {
    /// `column` if bands are displaced to the right, `row` if they are displaced downwards.
    pub axis: DispersionAxis,
    /// Displacement of each band on the sensor in pixels, at least 0. Fractions are allowed, and any order.
    #[schemars(length(min = 1, max = 64), inner(range(min = 0, max = 4096)))]
    pub offsets: Vec<f64>,
    /// Wavelength of each band in nanometres.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    #[schemars(length(min = 1, max = 64))]
    pub wavelengths: Option<Vec<f64>>,
    /// The area that the mask covers.
    #[serde(default)]
    pub mask: MaskExtent,
}

/// The axis of a dispersion.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[derive(Serialize, Deserialize, Display, EnumString, VariantNames, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum DispersionAxis {
    /// Bands are displaced to the right, so the measurement is wider than a band.
    Column,
    /// Bands are displaced downwards, so the measurement is higher than a band.
    Row,
}

/// The area that the mask of a spectral camera covers.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
#[derive(Serialize, Deserialize, Display, EnumString, VariantNames, schemars::JsonSchema)]
#[serde(rename_all = "lowercase")]
#[strum(serialize_all = "lowercase")]
pub enum MaskExtent {
    /// The scene: the mask has the size of a band, and the measurement is longer by the largest offset.
    #[default]
    Scene,
    /// The measurement: the mask has its size, and a band is shorter by the largest offset.
    Measurement,
}

/// An invalid field of a dispersion.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct DispersionError {
    /// JSON pointer within the dispersion.
    pub pointer: String,
    /// Description of the error.
    pub detail: String,
}

impl Dispersion {
    /// Checks the numbers.
    ///
    /// Errors: the first violation.
    pub fn check(&self) -> Result<(), DispersionError> {
        let wrong = |pointer: String, detail: String| Err(DispersionError { pointer, detail });
        let count = self.offsets.len();
        if !(1..=MAX_BANDS).contains(&count) {
            let detail = format!("there are {count} offsets; 1 to {MAX_BANDS} are accepted");
            return wrong("/offsets".to_owned(), detail);
        }
        let valid = |offset: &f64| (0.0..=MAX_OFFSET).contains(offset);
        if let Some(band) = self.offsets.iter().position(|offset| !valid(offset)) {
            let detail = format!(
                "the offset of band {band} (counted from 0) is {}; offsets are from 0 to {MAX_OFFSET} pixels: subtract \
                 the smallest offset from all of them",
                self.offsets[band]
            );
            return wrong(format!("/offsets/{band}"), detail);
        }
        let Some(wavelengths) = &self.wavelengths else { return Ok(()) };
        if wavelengths.len() != count {
            let detail = format!(
                "there are {} wavelengths, but {count} offsets: state one of each for every band",
                wavelengths.len()
            );
            return wrong("/wavelengths".to_owned(), detail);
        }
        let valid = |length: &f64| *length > 0.0 && *length <= MAX_WAVELENGTH;
        if let Some(band) = wavelengths.iter().position(|length| !valid(length)) {
            let detail = format!(
                "the wavelength of band {band} (counted from 0) is {} nm; it must be above 0 and at most \
                 {MAX_WAVELENGTH} nm",
                wavelengths[band]
            );
            return wrong(format!("/wavelengths/{band}"), detail);
        }
        // Wavelengths of a regular list differ from the numbers that are meant by rounding errors.
        let is_same = |a: f64, b: f64| (a - b).abs() <= SAME_WAVELENGTH * a;
        for (band, &length) in wavelengths.iter().enumerate() {
            if let Some(other) =
                wavelengths[..band].iter().position(|&other| is_same(length, other))
            {
                let detail = format!(
                    "bands {other} and {band} (counted from 0) both have the wavelength {length} nm; state a different \
                     one for each band"
                );
                return wrong(format!("/wavelengths/{band}"), detail);
            }
        }
        Ok(())
    }

    /// Number of bands.
    pub fn bands(&self) -> usize {
        self.offsets.len()
    }

    /// True if two bands are less than half a pixel apart. Their masks resemble one another too much to separate the bands.
    pub fn has_close_bands(&self) -> bool {
        let mut offsets = self.offsets.clone();
        offsets.sort_by(f64::total_cmp);
        offsets.windows(2).any(|pair| pair[1] - pair[0] < 0.5)
    }

    /// Wavelength of a band in nanometres, if known.
    pub fn wavelength(&self, band: usize) -> Option<f64> {
        self.wavelengths.as_ref()?.get(band).copied()
    }

    /// Number of pixels by which the measurement is longer than a band: the largest offset, rounded up.
    pub fn margin(&self) -> usize {
        self.offsets.iter().fold(0.0f64, |largest, offset| largest.max(*offset)).ceil() as usize
    }

    /// Rows and columns of the measurement behind a mask of this size. `None` for a mask of the measurement's size that is
    /// not longer than the largest offset.
    pub fn sensor_size(&self, mask: (usize, usize)) -> Option<(usize, usize)> {
        match self.mask {
            MaskExtent::Scene => Some(self.resized(mask, |length| length + self.margin())),
            MaskExtent::Measurement => {
                let (height, width) = self.frame_size(mask);
                (height > 0 && width > 0).then_some(mask)
            }
        }
    }

    /// Rows and columns of a band in a measurement of this size.
    pub fn frame_size(&self, sensor: (usize, usize)) -> (usize, usize) {
        self.resized(sensor, |length| length.saturating_sub(self.margin()))
    }

    /// Rows and columns of the mask for bands of this size.
    pub fn mask_size(&self, frame: (usize, usize)) -> (usize, usize) {
        match self.mask {
            MaskExtent::Scene => frame,
            MaskExtent::Measurement => self.resized(frame, |length| length + self.margin()),
        }
    }

    /// The mask of a band on the sensor: the mask \[H,W\], displaced by the band's offset. Between pixels it is interpolated
    /// linearly, which keeps values on \[0,1\]. Beyond the mask it is 0.
    pub fn shear_mask(&self, mask: ArrayView2<'_, f32>, band: usize) -> Array2<f32> {
        let length = self.sensor_size(mask.dim()).map_or(0, |size| self.along(size));
        let (whole, fraction) = self.offset(band);
        displaced(mask, self.array_axis(), (whole.cast_signed(), fraction), length)
    }

    /// A band \[H,W\] as it arrives on the sensor.
    pub fn shear(&self, frame: ArrayView2<'_, f32>, band: usize) -> Array2<f32> {
        let (whole, fraction) = self.offset(band);
        let length = self.along(frame.dim()) + self.margin();
        displaced(frame, self.array_axis(), (whole.cast_signed(), fraction), length)
    }

    /// The band \[H,W\] in a frame of the size of the sensor. It is the adjoint of [`Self::shear`], which interpolates
    /// linearly between pixels.
    pub fn unshear(&self, frame: ArrayView2<'_, f32>, band: usize) -> Array2<f32> {
        let (height, width) = self.frame_size(frame.dim());
        let (rows, columns) = self.sensor_window(band, (0..height, 0..width));
        self.interpolate(frame.slice(ndarray::s![rows, columns]), band)
    }

    /// The rows and columns of the sensor that a window of a band needs.
    pub fn sensor_window(
        &self,
        band: usize,
        (rows, columns): (Range<usize>, Range<usize>),
    ) -> (Range<usize>, Range<usize>) {
        let (whole, fraction) = self.offset(band);
        let moved = |range: Range<usize>| {
            range.start + whole..range.end + whole + usize::from(fraction > 0.0)
        };
        match self.axis {
            DispersionAxis::Column => (rows, moved(columns)),
            DispersionAxis::Row => (moved(rows), columns),
        }
    }

    /// The window of a band in the pixels of its [`Self::sensor_window`].
    pub fn interpolate(&self, sensor: ArrayView2<'_, f32>, band: usize) -> Array2<f32> {
        let (_, fraction) = self.offset(band);
        if fraction == 0.0 {
            return sensor.to_owned();
        }
        let axis = self.array_axis();
        let length = sensor.len_of(axis).saturating_sub(1);
        let part = |first: usize| sensor.slice_axis(axis, Slice::from(first..first + length));
        let (here, next) = (part(0), part(1));
        ndarray::Zip::from(here).and(next).map_collect(|a, b| (1.0 - fraction) * a + fraction * b)
    }

    /// The pixels in these rows and columns of the sensor that a band \[H,W\] reaches. `read` returns a window of the band.
    ///
    /// Errors: those of `read`.
    pub fn sheared_window<E>(
        &self,
        band: usize,
        frame: (usize, usize),
        (rows, columns): (Range<usize>, Range<usize>),
        read: impl FnOnce(Range<usize>, Range<usize>) -> Result<Array2<f32>, E>,
    ) -> Result<Array2<f32>, E> {
        let (whole, fraction) = self.offset(band);
        let needed = |range: &Range<usize>, length: usize| {
            let end = range.end.saturating_sub(whole).min(length);
            range.start.saturating_sub(whole + 1).min(end)..end
        };
        let (source, along) = match self.axis {
            DispersionAxis::Column => ((rows.clone(), needed(&columns, frame.1)), &columns),
            DispersionAxis::Row => ((needed(&rows, frame.0), columns.clone()), &rows),
        };
        let first = match self.axis {
            DispersionAxis::Column => source.1.start,
            DispersionAxis::Row => source.0.start,
        };
        let shift = (first + whole).cast_signed() - along.start.cast_signed();
        if source.0.is_empty() || source.1.is_empty() {
            return Ok(Array2::zeros((rows.len(), columns.len())));
        }
        let values = read(source.0, source.1)?;
        Ok(displaced(values.view(), self.array_axis(), (shift, fraction), along.len()))
    }

    /// Averages the squares of values of blocks of `side` pixels of the sensor over the blocks of a band, and returns the
    /// roots. `sensor` is the size of the sensor in pixels.
    pub fn unshear_blocks(
        &self,
        values: ArrayView2<'_, f32>,
        band: usize,
        sensor: (usize, usize),
        side: usize,
    ) -> Array2<f32> {
        let (height, width) = self.frame_size(sensor);
        let whole = self.offsets[band].round() as usize;
        let (down, right) = match self.axis {
            DispersionAxis::Column => (0, whole),
            DispersionAxis::Row => (whole, 0),
        };
        let mean = |first: usize, length: usize, offset: usize, value: &dyn Fn(usize) -> f32| {
            let pixels = first * side..((first + 1) * side).min(length);
            let count = pixels.len().max(1) as f32;
            pixels.map(|pixel| value((pixel + offset) / side)).sum::<f32>() / count
        };
        let size = (height.div_ceil(side), width.div_ceil(side));
        Array2::from_shape_fn(size, |(i, j)| {
            let row = |row: usize| mean(j, width, right, &|column| values[[row, column]].powi(2));
            mean(i, height, down, &row).sqrt()
        })
    }

    /// True if a finding on masks can be right about those of a spectral camera. It has one mask for all bands, so findings
    /// that compare separate masks do not apply.
    pub fn admits(code: FindingCode) -> bool {
        use FindingCode::{
            DeadPixels, MissingPattern, OneDimensional, RepeatedPattern, StuckPixels, SwappedOrder,
            UnevenPatterns,
        };
        !matches!(
            code,
            DeadPixels
                | MissingPattern
                | OneDimensional
                | RepeatedPattern
                | StuckPixels
                | SwappedOrder
                | UnevenPatterns
        )
    }

    /// Whole pixels and the remaining fraction of the offset of a band.
    fn offset(&self, band: usize) -> (usize, f32) {
        let offset = self.offsets[band];
        (offset.floor() as usize, offset.fract() as f32)
    }

    fn array_axis(&self) -> Axis {
        match self.axis {
            DispersionAxis::Column => Axis(1),
            DispersionAxis::Row => Axis(0),
        }
    }

    fn along(&self, (height, width): (usize, usize)) -> usize {
        match self.axis {
            DispersionAxis::Column => width,
            DispersionAxis::Row => height,
        }
    }

    fn resized(
        &self,
        (height, width): (usize, usize),
        resize: impl Fn(usize) -> usize,
    ) -> (usize, usize) {
        match self.axis {
            DispersionAxis::Column => (height, resize(width)),
            DispersionAxis::Row => (resize(height), width),
        }
    }
}

/// An image that is displaced along an axis by whole pixels and a fraction, and cut or filled up with 0 to a length.
fn displaced(
    image: ArrayView2<'_, f32>,
    axis: Axis,
    (shift, fraction): (isize, f32),
    length: usize,
) -> Array2<f32> {
    let mut size = image.raw_dim();
    size[axis.index()] = length;
    let mut displaced = Array2::zeros(size);
    let mut add = |shift: isize, weight: f32| {
        let start = shift.max(0).min(length.cast_signed());
        let end = (shift + image.len_of(axis).cast_signed()).min(length.cast_signed()).max(start);
        let source = image.slice_axis(axis, Slice::from(start - shift..end - shift));
        let mut target = displaced.slice_axis_mut(axis, Slice::from(start..end));
        if start < end {
            target.scaled_add(weight, &source);
        }
    };
    add(shift, 1.0 - fraction);
    if fraction > 0.0 {
        add(shift + 1, fraction);
    }
    displaced
}

#[cfg(test)]
mod tests {
    use super::{Dispersion, DispersionAxis, MaskExtent};
    use crate::{generator, iid_masks};
    use ndarray::{Array2, s};
    use rand::RngExt;

    fn dispersion(axis: DispersionAxis, offsets: &[f64]) -> Dispersion {
        let offsets = offsets.to_vec();
        Dispersion { axis, offsets, wavelengths: None, mask: MaskExtent::Scene }
    }

    fn random(size: (usize, usize), seed: u64) -> Array2<f32> {
        let mut rng = generator(seed);
        Array2::from_shape_simple_fn(size, || rng.random())
    }

    fn product(a: &Array2<f32>, b: &Array2<f32>) -> f64 {
        a.iter().zip(b).map(|(a, b)| f64::from(*a) * f64::from(*b)).sum()
    }

    #[test]
    fn whole_offsets_move_pixels_exactly() {
        let frame = random((5, 7), 1);
        let columns = dispersion(DispersionAxis::Column, &[3.0, 0.0, 2.0]);
        let sheared = columns.shear(frame.view(), 0);
        assert_eq!(sheared.dim(), (5, 10));
        assert_eq!(sheared.slice(s![.., 3..]), frame);
        assert_eq!(sheared.slice(s![.., ..3]).sum(), 0.0);
        let rows = dispersion(DispersionAxis::Row, &[0.0, 2.0]);
        let sheared = rows.shear(frame.view(), 1);
        assert_eq!((sheared.dim(), sheared.slice(s![2.., ..])), ((7, 7), frame.view()));
        for band in 0..3 {
            let there = columns.shear(frame.view(), band);
            assert_eq!(columns.unshear(there.view(), band), frame);
        }
    }

    #[test]
    fn fractions_are_interpolated_within_the_range_of_the_values() {
        let frame = ndarray::array![[0.0, 1.0, 1.0]];
        let columns = dispersion(DispersionAxis::Column, &[0.0, 1.25]);
        let sheared = columns.shear(frame.view(), 1);
        assert_eq!(sheared, ndarray::array![[0.0, 0.0, 0.75, 1.0, 0.25]]);
        // A slope stays where it is.
        let slope = Array2::from_shape_fn((1, 20), |(_, j)| j as f32 * 0.05);
        let back = columns.unshear(slope.view(), 1);
        assert_eq!(back.dim(), (1, 18));
        assert!(back.iter().enumerate().all(|(j, v)| (v - (j as f32 + 1.25) * 0.05).abs() < 1e-6));
    }

    /// `<S x, y> = <x, Sᵀ y>`, alone and with a mask.
    #[test]
    fn unshearing_is_the_adjoint_of_shearing() {
        for axis in [DispersionAxis::Column, DispersionAxis::Row] {
            let bands = dispersion(axis, &[0.0, 1.0, 2.4, 0.75, 5.5]);
            let mask = iid_masks(1, 12, 15, 3).unwrap();
            let mask = mask.index_axis(ndarray::Axis(0), 0);
            let sensor = bands.sensor_size(mask.dim()).unwrap();
            assert_eq!(bands.frame_size(sensor), (12, 15));
            let y = random(sensor, 9);
            for band in 0..bands.bands() {
                let (x, mask) = (random((12, 15), band as u64), bands.shear_mask(mask, band));
                assert_eq!(mask.dim(), sensor);
                assert!(mask.iter().all(|value| (0.0..=1.0).contains(value)));
                let forward = &mask * &bands.shear(x.view(), band);
                let adjoint = bands.unshear((&mask * &y).view(), band);
                let (left, right) = (product(&forward, &y), product(&x, &adjoint));
                assert!((left - right).abs() < 1e-4 * left, "{band}: {left} {right}");
            }
        }
    }

    #[test]
    fn windows_equal_parts_of_the_whole() {
        for axis in [DispersionAxis::Column, DispersionAxis::Row] {
            let bands = dispersion(axis, &[0.0, 2.0, 4.3]);
            let frame = random((16, 18), 4);
            let (rows, columns) = (3..11, 0..9);
            let empty = bands.sheared_window(2, frame.dim(), (0..1, 0..1), |r, c| {
                assert!(!r.is_empty() && !c.is_empty());
                Ok::<_, ()>(frame.slice(s![r, c]).to_owned())
            });
            assert_eq!(empty.unwrap(), Array2::<f32>::zeros((1, 1)));
            for band in 0..3 {
                let sheared = bands.shear(frame.view(), band);
                let window = bands.sheared_window(
                    band,
                    frame.dim(),
                    (rows.clone(), columns.clone()),
                    |r, c| Ok::<_, ()>(frame.slice(s![r, c]).to_owned()),
                );
                assert_eq!(window.unwrap(), sheared.slice(s![rows.clone(), columns.clone()]));
                let (r, c) = bands.sensor_window(band, (rows.clone(), columns.clone()));
                let part = bands.interpolate(sheared.slice(s![r, c]), band);
                let whole = bands.unshear(sheared.view(), band);
                assert_eq!(part, whole.slice(s![rows.clone(), columns.clone()]));
            }
        }
    }

    #[test]
    fn a_mask_of_the_measurement_is_cut_at_its_end() {
        let padded = {
            let mut padded = Array2::zeros((4, 10));
            padded.slice_mut(s![.., ..7]).assign(&random((4, 7), 2));
            padded
        };
        let scene = dispersion(DispersionAxis::Column, &[0.0, 3.0]);
        let measured = Dispersion { mask: MaskExtent::Measurement, ..scene.clone() };
        assert_eq!(measured.sensor_size((4, 10)), Some((4, 10)));
        assert_eq!(measured.frame_size((4, 10)), (4, 7));
        assert_eq!(measured.sensor_size((4, 3)), None);
        for band in 0..2 {
            let cut = scene.shear_mask(padded.slice(s![.., ..7]), band);
            assert_eq!(measured.shear_mask(padded.view(), band), cut);
        }
    }

    #[test]
    fn errors_of_blocks_follow_their_band() {
        let bands = dispersion(DispersionAxis::Column, &[0.0, 4.0]);
        let values = ndarray::array![[1.0, 3.0, 5.0]];
        let moved = bands.unshear_blocks(values.view(), 1, (8, 24), 8);
        assert_eq!(moved.dim(), (1, 3));
        assert_eq!(moved[[0, 0]], 5f32.sqrt());
        assert_eq!(bands.unshear_blocks(values.view(), 0, (8, 24), 8), values);
    }

    #[test]
    fn invalid_numbers_are_refused_with_their_place() {
        let place = |dispersion: &Dispersion| dispersion.check().map_err(|error| error.pointer);
        let good = dispersion(DispersionAxis::Column, &[4.0, 0.0, 2.5]);
        assert_eq!(place(&good), Ok(()));
        let offsets =
            |offsets: &[f64]| place(&dispersion(DispersionAxis::Row, offsets)).unwrap_err();
        assert_eq!(offsets(&[]), "/offsets");
        assert_eq!(offsets(&[0.0; 65]), "/offsets");
        for bad in [-1.0, f64::NAN, f64::INFINITY, 5000.0] {
            assert_eq!(offsets(&[0.0, bad]), "/offsets/1");
        }
        let lengths = |wavelengths: &[f64]| {
            let wavelengths = Some(wavelengths.to_vec());
            place(&Dispersion { wavelengths, ..good.clone() }).unwrap_err()
        };
        assert_eq!(lengths(&[500.0]), "/wavelengths");
        assert_eq!(lengths(&[500.0, 0.0, 510.0]), "/wavelengths/1");
        assert_eq!(lengths(&[500.0, 510.0, 500.0]), "/wavelengths/2");
    }
}
