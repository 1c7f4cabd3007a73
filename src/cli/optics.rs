//! Files of optical parameters, and `sci-recon optics`, which prints and checks them.

use std::fs;
use std::path::{Path, PathBuf};

use clap::Args;
use serde::{Deserialize, Serialize};

use super::CliError;
use super::output::{print_line, print_text};
use crate::cli::error::Result;
use optics::{ApertureGrid, Camera, Circle, Draw, Geometry, Method, Placement};

/// The file of the defaults, with a comment for each number.
const DEFAULTS: &str = include_str!("../../docs/optics.toml");

/// Print the optical parameters of `simulate`.
///
/// Prints the defaults as a commented TOML file, or the quantities that are derived from a file.
#[derive(Debug, Args)]
pub struct Arguments {
    /// Check this file and print all parameters and derived quantities as JSON.
    #[arg(long, value_name = "FILE")]
    check: Option<PathBuf>,
}

/// The content of a file of optical parameters.
#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct OpticsFile {
    lcos: Lcos,
    relay: Relay,
    mask: Mask,
    sensor: Sensor,
    pub(super) projection: Projection,
    sub_apertures: SubApertures,
    pub(super) circle: Circle,
    light: Light,
    pub(super) camera: Camera,
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Lcos {
    rows: usize,
    columns: usize,
    pitch_um: f64,
}

impl Default for Lcos {
    fn default() -> Self {
        let paper = Geometry::default();
        Self { rows: paper.lcos_rows, columns: paper.lcos_columns, pitch_um: paper.lcos_pitch_um }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Relay {
    focal_length_mm: f64,
    magnification: f64,
}

impl Default for Relay {
    fn default() -> Self {
        let paper = Geometry::default();
        Self { focal_length_mm: paper.focal_length_mm, magnification: paper.magnification }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Mask {
    pitch_um: f64,
    distance_um: f64,
}

impl Default for Mask {
    fn default() -> Self {
        let paper = Geometry::default();
        Self { pitch_um: paper.mask_pitch_um, distance_um: paper.mask_distance_um }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Sensor {
    pitch_um: f64,
}

impl Default for Sensor {
    fn default() -> Self {
        Self { pitch_um: Geometry::default().sensor_pitch_um }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub(super) struct Projection {
    pub(super) placement: Placement,
    pub(super) method: Method,
    phase_rows: f64,
    phase_columns: f64,
    blur_um: f64,
}

impl Default for Projection {
    fn default() -> Self {
        let (placement, method) = (Placement::WholePixels, Method::Shifts);
        Self { placement, method, phase_rows: 0.0, phase_columns: 0.0, blur_um: 0.0 }
    }
}

#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct SubApertures {
    rows: Option<usize>,
    columns: Option<usize>,
    open_share: f64,
    rank: Option<usize>,
    tries: usize,
}

impl Default for SubApertures {
    fn default() -> Self {
        Self { rows: None, columns: None, open_share: 0.5, rank: None, tries: Draw::of(1).tries }
    }
}

#[derive(Debug, Clone, Default, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
struct Light {
    vignetting: f64,
}

impl OpticsFile {
    /// Reads and checks a file. Without a path, returns the defaults.
    pub(super) fn read(path: Option<&Path>) -> Result<Self> {
        let Some(path) = path else { return Ok(Self::default()) };
        let text = fs::read_to_string(path).map_err(|error| refused(path, &error))?;
        let file: Self = toml::from_str(&text).map_err(|error| refused(path, &error))?;
        file.geometry().check().map_err(|error| refused(path, &error))?;
        file.camera.check().map_err(|error| refused(path, &error))?;
        Ok(file)
    }

    pub(super) fn geometry(&self) -> Geometry {
        Geometry {
            lcos_rows: self.lcos.rows,
            lcos_columns: self.lcos.columns,
            lcos_pitch_um: self.lcos.pitch_um,
            focal_length_mm: self.relay.focal_length_mm,
            mask_distance_um: self.mask.distance_um,
            mask_pitch_um: self.mask.pitch_um,
            magnification: self.relay.magnification,
            sensor_pitch_um: self.sensor.pitch_um,
            blur_um: self.projection.blur_um,
            phase_rows: self.projection.phase_rows,
            phase_columns: self.projection.phase_columns,
        }
    }

    /// Share of the light that is lost at the corners.
    pub fn vignetting(&self) -> f64 {
        self.light.vignetting
    }

    /// The grid of sub-apertures for snapshots of `frames` frames.
    pub(super) fn grid(&self, frames: usize) -> Result<ApertureGrid> {
        let rule = ApertureGrid::for_frames(frames);
        match (self.sub_apertures.rows, self.sub_apertures.columns) {
            (None, None) => Ok(rule),
            (Some(rows @ 1..), Some(columns @ 1..)) => Ok(ApertureGrid { rows, columns }),
            _ => Err(CliError::Input(
                "sub_apertures: state both rows and columns, at least 1, or neither".into(),
            )),
        }
    }

    /// Parameters of random squares on a grid.
    pub(super) fn draw(&self, grid: ApertureGrid) -> Result<Draw> {
        let SubApertures { open_share, rank, tries, .. } = self.sub_apertures;
        if !(open_share > 0.0 && open_share <= 1.0) {
            return Err(CliError::Input(format!(
                "sub_apertures open_share is {open_share}; it is the open share of the sub-apertures and must be \
                above 0 and at most 1"
            )));
        }
        #[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // at most the count
        let open = (open_share * grid.count() as f64).round() as usize;
        Ok(Draw { open, rank, tries })
    }
}

fn refused(path: &Path, error: &dyn std::fmt::Display) -> CliError {
    CliError::Input(format!("optics {}: {error}", path.display()))
}

/// The derived quantities that `--check` prints.
#[derive(Debug, Serialize)]
struct Derived {
    /// Shift of the mask's projection from the first to the last row of the LCoS.
    shift_over_lcos_rows_mask_pixels: f64,
    shift_over_lcos_columns_mask_pixels: f64,
    shift_per_lcos_pixel_mask_pixels: f64,
    sensor_pixels_per_mask_pixel: f64,
    blur_mask_pixels: f64,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let Some(path) = &arguments.check else {
        return print_text(DEFAULTS);
    };
    let file = OpticsFile::read(Some(path))?;
    let geometry = file.geometry();
    let shift = geometry.shift_per_lcos_pixel();
    let derived = Derived {
        shift_over_lcos_rows_mask_pixels: shift * geometry.lcos_rows as f64,
        shift_over_lcos_columns_mask_pixels: shift * geometry.lcos_columns as f64,
        shift_per_lcos_pixel_mask_pixels: shift,
        sensor_pixels_per_mask_pixel: geometry.sensor_pixels_per_mask_pixel(),
        blur_mask_pixels: geometry.blur_um / geometry.mask_pitch_um,
    };
    let value = serde_json::json!({ "optics": file, "derived": derived });
    print_line(format!("{value:#}"))
}

#[cfg(test)]
mod tests {
    use super::{DEFAULTS, OpticsFile};

    #[test]
    fn the_printed_file_contains_the_defaults() {
        let file: OpticsFile = toml::from_str(DEFAULTS).unwrap();
        assert_eq!(file, OpticsFile::default());
        // The file names every parameter, even without a default.
        let values = serde_json::to_value(&file).unwrap();
        for (section, fields) in values.as_object().unwrap() {
            assert!(DEFAULTS.contains(&format!("[{section}]")), "{section}");
            for field in fields.as_object().unwrap().keys() {
                assert!(DEFAULTS.contains(&format!("{field} = ")), "{section}.{field}");
            }
        }
    }

    #[test]
    fn an_invalid_file_is_refused_with_its_name() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("optics.toml");
        let read = |text: &str| {
            std::fs::write(&path, text).unwrap();
            OpticsFile::read(Some(&path))
        };
        let error = read("[mask]\ndistance_um = 0.0\n").unwrap_err().to_string();
        assert!(error.contains("optics.toml") && error.contains("distance_um is 0"), "{error}");
        let error = read("[mask]\ndistance = 3.0\n").unwrap_err().to_string();
        assert!(error.contains("distance"), "{error}");
        let file = read("[sub_apertures]\nopen_share = 1.5\n").unwrap();
        let error = file.draw(file.grid(10).unwrap()).unwrap_err().to_string();
        assert!(error.contains("open_share is 1.5"), "{error}");
        let file = read("[sub_apertures]\nrows = 4\n").unwrap();
        assert!(file.grid(10).is_err());
        let file = read("[sub_apertures]\nrows = 4\ncolumns = 6\nopen_share = 0.25\n").unwrap();
        assert_eq!(file.draw(file.grid(10).unwrap()).unwrap().open, 6);
    }
}
