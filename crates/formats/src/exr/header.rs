//! The header of a part.

use ::exr::compression::Compression;
use ::exr::math::Vec2;
use ::exr::meta::BlockDescription;
use ::exr::meta::attribute::{AttributeValue, ChannelDescription, LineOrder, SampleType, Text};
use ::exr::meta::header::{Header, LayerAttributes};

use super::{FRAME_TIME, names};
use crate::error::Result;
use crate::{Channels, FormatError};

/// The attributes of a frame.
#[derive(Debug, Clone, Default, PartialEq)]
pub struct Attributes {
    /// Names and values of string attributes (provenance). Names have up to 255 bytes and differ from those that
    /// OpenEXR defines. Values are UTF-8.
    pub texts: Vec<(String, String)>,
    /// Time of the frame in seconds after the start of the sequence: `frameTime` (double).
    pub frame_time_s: Option<f64>,
    /// Frames per second: OpenEXR's `framesPerSecond` (rational, rounded to thousandths).
    pub frames_per_second: Option<f64>,
    /// Exposure time in seconds: OpenEXR's `expTime` (float).
    pub exposure_s: Option<f32>,
    /// Wavelength of a grey frame in nanometres, which names its channel.
    pub wavelength_nm: Option<f64>,
}

fn part_name(index: usize) -> String {
    format!("frame_{:04}", index + 1)
}

/// Name of the channel of a wavelength in the layout of spectral EXR images (Fichet, Pacanowski and Wilkie 2021), with a
/// decimal comma because dots separate layers. Rounding errors are left out, but bands that differ have different names.
fn spectral_name(wavelength_nm: f64) -> String {
    let rounded = (wavelength_nm * 1000.0).round() / 1000.0;
    let is_exact = (rounded - wavelength_nm).abs() <= 1e-12 * wavelength_nm;
    let shown = if is_exact { rounded } else { wavelength_nm };
    format!("S0.{}nm", shown.to_string().replace('.', ","))
}

/// The header of part `index` of a stack.
pub(super) fn header(
    (height, width): (usize, usize),
    channels: Channels,
    index: usize,
    attributes: &Attributes,
) -> Result<Header> {
    if height == 0 || width == 0 {
        return Err(FormatError::Internal(format!("an EXR frame of {height}x{width} is empty")));
    }
    let names = match (channels, attributes.wavelength_nm) {
        (Channels::Grey, Some(wavelength)) => vec![spectral_name(wavelength)],
        _ => names(channels).iter().map(|(name, _)| (*name).to_owned()).collect(),
    };
    let channels = names.iter().map(|name| ChannelDescription::named(&**name, SampleType::F32));
    let header = Header::new(Text::from(""), Vec2(width, height), channels.collect());
    let mut own = LayerAttributes {
        layer_name: Some(Text::from(&*part_name(index))),
        exposure: attributes.exposure_s,
        frames_per_second: attributes.frames_per_second.map(rational),
        ..LayerAttributes::default()
    };
    if let Some(seconds) = attributes.frame_time_s {
        own.other.insert(Text::from(FRAME_TIME), AttributeValue::F64(seconds));
    }
    for (name, value) in &attributes.texts {
        // OpenEXR strings are bytes, which readers interpret as UTF-8.
        let value = AttributeValue::Text(Text::from_slice_unchecked(value.as_bytes()));
        let name = Text::from_slice_unchecked(name.as_bytes());
        if own.other.insert(name, value).is_some() {
            return Err(FormatError::Internal("two EXR attributes have the same name".to_owned()));
        }
    }
    Ok(header.with_attributes(own).with_encoding(
        Compression::Uncompressed,
        BlockDescription::ScanLines,
        LineOrder::Increasing,
    ))
}

/// A frame rate as numerator and denominator.
fn rational(frames_per_second: f64) -> (i32, u32) {
    if frames_per_second.fract() == 0.0 {
        (frames_per_second as i32, 1)
    } else {
        ((frames_per_second * 1000.0).round() as i32, 1000)
    }
}
