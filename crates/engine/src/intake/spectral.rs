//! The masks of a spectral camera, which are one mask, displaced by band.

use super::IntakeError;
use crate::intake::error::Result;
use crate::job::{Dispersion, MaskExtent};
use formats::{FrameReader, Frames, Limits, StackInfo};

/// The masks of all bands, made from the only mask of an open file. `name` is the name of the file in errors.
///
/// Errors: [`IntakeError::Content`] for several masks, and for a mask that is too small; [`IntakeError::Format`] for masks
/// above the limits.
pub(super) fn sheared(
    mut reader: Box<dyn FrameReader + Send>,
    dispersion: &Dispersion,
    limits: &Limits,
    name: &str,
) -> Result<Box<dyn FrameReader + Send>> {
    let info = *reader.info();
    let StackInfo { frames, height, width, .. } = info;
    if frames != 1 {
        let problem = format!(
            "the file has {frames} masks of {height}x{width} (rows x columns), but a dispersion makes the masks of all \
             bands from one two-dimensional mask: select it with `frames`, or leave the dispersion out if the file has a \
             mask for each band"
        );
        return Err(IntakeError::content(name, &problem));
    }
    let Some((rows, columns)) = dispersion.sensor_size((height, width)) else {
        let problem = format!(
            "the mask is {height}x{width} (rows x columns), but the offsets reach {} pixels along a {}: a mask of the \
             measurement's size must be longer than the largest offset",
            dispersion.margin(),
            dispersion.axis
        );
        return Err(IntakeError::content(name, &problem));
    };
    let bands = dispersion.bands();
    let checked = limits.check_shape(info.format, bands as u64, rows as u64, columns as u64);
    checked.map_err(IntakeError::format(name))?;
    let info = StackInfo { frames: bands, height: rows, width: columns, ..info };
    let (dispersion, mut mask, mut next) = (dispersion.clone(), None, 0..bands);
    Ok(Box::new(Frames::new(info, move || {
        if mask.is_none() {
            mask = reader.next_frame()?;
        }
        let band = mask.as_ref().zip(next.next());
        Ok(band.map(|(mask, band)| dispersion.shear_mask(mask.view(), band)))
    })))
}

/// Explains the size of a measurement behind masks of `sensor` pixels that were made with a dispersion.
pub fn expected_size(dispersion: &Dispersion, (height, width): (usize, usize)) -> String {
    let (rows, columns) = dispersion.frame_size((height, width));
    let other = match dispersion.mask {
        MaskExtent::Scene => {
            "if the mask already has the size of the measurement, state `\"mask\": \"measurement\"`"
        }
        MaskExtent::Measurement => "if the mask has the size of a band, leave `mask` out",
    };
    format!(
        "the dispersion expects a measurement of {height}x{width}: {} bands of {rows}x{columns}, displaced by up to {} \
         pixels; {other}",
        dispersion.bands(),
        dispersion.margin()
    )
}
