//! The captures from which a calibration computes masks.

use serde::{Deserialize, Serialize};

use super::{InvalidField, Sha256};

/// Largest number of uploads for one capture. Their hashes fit into a JSON body of 256 KiB, also with indentation.
pub(super) const MAX_REPEATS: usize = 2048;
/// Largest number of masks of a calibration. Published systems have up to 50.
pub const MAX_MASKS: usize = 64;

/// Largest planned CPU time of a calibration in seconds. About 36,000 captures of 3200x3200 pixels take that long.
pub const MAX_CALIBRATION_SECONDS: f64 = 3600.0;

/// Planned CPU seconds of a calibration that averages `samples` stored values and analyses `frames` masks of `pixels`
/// pixels. The constants were measured on one core.
#[allow(clippy::cast_precision_loss)] // samples far below 2^53
pub fn planned_seconds(samples: u64, frames: usize, pixels: usize) -> f64 {
    let masks = frames as f64 * pixels as f64;
    6e-9 * samples as f64 + masks * (25e-9 + 0.2e-9 * frames as f64)
}

/// The captures of a calibration, as uploads or as paths. Each file holds one frame or several repeats.
#[derive(Debug, Clone, PartialEq, Eq, Serialize, Deserialize, schemars::JsonSchema)]
#[serde(deny_unknown_fields)]
#[schemars(rename = "Captures")]
pub struct Captures<T = Sha256> {
    /// For each pattern, in order: captures of the white board with the lithography mask in place.
    #[schemars(length(min = 1, max = 64))]
    pub masks: Vec<Vec<T>>,
    /// LCoS all white, lithography mask removed.
    pub white: Vec<T>,
    /// LCoS all black, lithography mask removed.
    pub black: Vec<T>,
    /// LCoS all black, lithography mask in place. If empty, `black` is used instead (Eq. 7 of the paper).
    #[serde(default = "Vec::<T>::new")]
    pub black_with_mask: Vec<T>,
    /// The intended aperture patterns, one frame each, for a check of the order.
    #[serde(default = "Option::<T>::default")]
    pub patterns: Option<T>,
    /// Stored value from which a pixel is saturated; by default the largest of the data type.
    #[serde(default)]
    #[schemars(range(min = 1))]
    pub saturation: Option<u32>,
}

impl<T> Captures<T> {
    /// Converts the reference to each file with `to`.
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

    /// Each list of repeats with its JSON pointer in the request.
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
    /// Each upload with its JSON pointer in the request.
    pub fn uploads(&self) -> impl Iterator<Item = (String, Sha256)> {
        let lists = self.lists().flat_map(|(place, list)| {
            let uploads = list.iter().enumerate();
            uploads.map(|(index, upload)| (format!("{place}/{index}"), *upload)).collect::<Vec<_>>()
        });
        lists.chain(self.patterns.map(|upload| ("/captures/patterns".to_owned(), upload)))
    }

    /// Checks the lengths of all lists.
    ///
    /// Errors: every violation, each with its JSON pointer.
    pub fn check(&self) -> Result<(), Vec<InvalidField>> {
        let mut errors = Vec::new();
        if self.masks.is_empty() || self.masks.len() > MAX_MASKS {
            let detail =
                format!("there are {} patterns; 1 to {MAX_MASKS} are accepted", self.masks.len());
            errors.push(InvalidField::new("/captures/masks", detail));
        }
        for (place, list) in self.lists() {
            let may_be_empty = place == "/captures/black_with_mask";
            if (list.is_empty() && !may_be_empty) || list.len() > MAX_REPEATS {
                let detail = format!(
                    "there are {} uploads for this capture; 1 to {MAX_REPEATS} are accepted",
                    list.len()
                );
                errors.push(InvalidField::new(&place, detail));
            }
        }
        if self.saturation == Some(0) {
            errors.push(InvalidField::new(
                "/captures/saturation",
                "saturation is 0; it must be at least 1",
            ));
        }
        if errors.is_empty() { Ok(()) } else { Err(errors) }
    }
}
