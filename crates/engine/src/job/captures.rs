//! The captures that a calibration is made of.

use serde::{Deserialize, Serialize};

use super::{InvalidField, Sha256};

/// The most patterns, and the most uploads for each.
const MOST: usize = 4096;
/// Masks of a calibration. Published systems have up to 50.
pub const MOST_MASKS: usize = 64;

/// The most processor time that a calibration is planned to take, in seconds: 36,000 captures of 3200x3200 take it.
pub const MOST_SECONDS: f64 = 3600.0;

/// Planned processor seconds of a calibration: `captured` samples to average, and `frames` masks of `pixels`
/// each to look at. Measured on one core.
#[allow(clippy::cast_precision_loss)] // samples far below 2^53
pub fn planned_seconds(captured: u64, frames: usize, pixels: usize) -> f64 {
    let masks = frames as f64 * pixels as f64;
    6e-9 * captured as f64 + masks * (25e-9 + 0.2e-9 * frames as f64)
}

/// Files by what they show, as uploads or as paths. Each has one frame or several: all are repeats of
/// the same.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Captures<T = Sha256> {
    /// For each pattern, in order: the white board through the lithography mask.
    pub masks: Vec<Vec<T>>,
    /// The lithography mask taken out, the LCoS all white.
    pub white: Vec<T>,
    /// The lithography mask taken out, the LCoS all black.
    pub black: Vec<T>,
    /// With the lithography mask, the LCoS all black. Without these, `black` serves for it: Eq. 7 of
    /// the paper.
    #[serde(default = "Vec::new")]
    pub black_with_mask: Vec<T>,
    /// The aperture patterns that were shown, one frame each, to tell whether the order is right.
    #[serde(default = "Option::default")]
    pub patterns: Option<T>,
    /// The stored number from which on a pixel is full; by default the largest of its type.
    #[serde(default)]
    pub saturation: Option<u32>,
}

impl<T> Captures<T> {
    /// The same captures, each named by what `to` makes of it.
    pub fn map<U>(&self, to: impl Fn(&T) -> U) -> Captures<U> {
        let list = |list: &Vec<T>| list.iter().map(&to).collect();
        Captures {
            masks: self.masks.iter().map(list).collect(),
            white: list(&self.white),
            black: list(&self.black),
            black_with_mask: list(&self.black_with_mask),
            patterns: self.patterns.as_ref().map(&to),
            saturation: self.saturation,
        }
    }

    /// Each list of repeats with its place in the request.
    pub fn lists(&self) -> impl Iterator<Item = (String, &[T])> {
        let masks = self.masks.iter().enumerate();
        let masks = masks.map(|(index, list)| (format!("/captures/masks/{index}"), &list[..]));
        masks.chain([
            ("/captures/white".to_owned(), &self.white[..]),
            ("/captures/black".to_owned(), &self.black[..]),
            ("/captures/black_with_mask".to_owned(), &self.black_with_mask[..]),
        ])
    }
}

impl Captures {
    /// Each upload with its place in the request.
    pub fn uploads(&self) -> impl Iterator<Item = (String, Sha256)> {
        let lists = self.lists().flat_map(|(place, list)| {
            let uploads = list.iter().enumerate();
            uploads.map(|(index, upload)| (format!("{place}/{index}"), *upload)).collect::<Vec<_>>()
        });
        lists.chain(self.patterns.map(|upload| ("/captures/patterns".to_owned(), upload)))
    }

    /// Refuses lists that are empty or too long.
    /// Errors: all that is wrong, each with its place.
    pub fn check(&self) -> Result<(), Vec<InvalidField>> {
        let mut errors = Vec::new();
        if self.masks.is_empty() || self.masks.len() > MOST_MASKS {
            let detail = format!("{} patterns; it must be 1 to {MOST_MASKS}", self.masks.len());
            errors.push(InvalidField::new("/captures/masks", detail));
        }
        for (place, list) in self.lists() {
            let may_be_empty = place == "/captures/black_with_mask";
            if (list.is_empty() && !may_be_empty) || list.len() > MOST {
                let detail = format!(
                    "{} uploads; each capture needs 1 to {MOST}: a pattern without one is missing",
                    list.len()
                );
                errors.push(InvalidField::new(&place, detail));
            }
        }
        if self.saturation == Some(0) {
            errors.push(InvalidField::new("/captures/saturation", "0; it must be at least 1"));
        }
        if errors.is_empty() { Ok(()) } else { Err(errors) }
    }
}
