//! `tables.json`: all rows that were ever made in a folder, each with all that it depends on.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use serde::{Deserialize, Serialize};

use crate::cli::CliError;
use crate::job::{Algorithm, Schedule, TileSpec};
use crate::pipeline::manifest::ModelRecord;

/// Name and version of this form of record.
const SCHEMA: &str = "sci-recon/bench-tables/1";

const FILE: &str = "tables.json";

/// What all rows of one command share.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Setting {
    /// Kind of the masks.
    pub(super) pattern: String,
    /// Standard deviation of the noise of the measurement on the scale of 255 grey values.
    pub(super) noise_sigma: f32,
    /// Seed of masks and noise.
    pub(super) seed: u64,
}

/// All that a row depends on: a row with the same key need not be computed again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Key {
    pub(super) program_version: String,
    pub(super) clip: String,
    pub(super) algorithm: Algorithm,
    /// Side of the square, in pixels.
    pub(super) scale: usize,
    /// Frames of the snapshot.
    pub(super) compression_ratio: usize,
    #[serde(flatten)]
    pub(super) setting: Setting,
    /// SHA-256 of masks, measurement and true frames, one after the other, as little-endian f32.
    pub(super) inputs_sha256: String,
    pub(super) schedule: Schedule,
    pub(super) tile: TileSpec,
    pub(super) models: Vec<ModelRecord>,
    /// Execution provider of the networks; none without one.
    pub(super) provider: Option<String>,
}

/// A clip, an algorithm, and what came of them. A PSNR is in dB, the mean over the frames of the
/// snapshot, and none where it is infinite.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub(super) struct Row {
    #[serde(flatten)]
    pub(super) key: Key,
    pub(super) psnr_db: Option<f64>,
    pub(super) ssim: f64,
    pub(super) psnr_db_by_frame: Vec<Option<f64>>,
    /// From the centre to the rim.
    pub(super) psnr_db_by_zone: Vec<ZoneRecord>,
    pub(super) cpu_seconds: f64,
    pub(super) seconds: f64,
    /// Most of any tile.
    pub(super) denoiser_passes: usize,
    /// White level of the scene, as it was estimated.
    pub(super) white: f32,
    pub(super) stop_reason: String,
}

/// A ring around the centre.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub(super) struct ZoneRecord {
    /// Its outer radius in pixels; none for the corners.
    pub(super) outer_radius: Option<f64>,
    pub(super) psnr_db: Option<f64>,
}

#[derive(Debug, Serialize, Deserialize)]
struct File {
    schema: String,
    rows: Vec<Row>,
}

/// The rows of a folder.
pub(super) struct Records {
    folder: PathBuf,
    file: File,
}

impl Records {
    /// Makes the folder, or reads what an earlier command left there.
    ///
    /// # Errors
    /// A folder that can't be made; a file of this name that is none of ours.
    pub(super) fn open(folder: &Path) -> Result<Self, CliError> {
        fs::create_dir_all(folder).map_err(|error| CliError::file("make", folder, &error))?;
        let path = folder.join(FILE);
        let file = match fs::read(&path) {
            Err(error) if error.kind() == std::io::ErrorKind::NotFound => {
                File { schema: SCHEMA.into(), rows: Vec::new() }
            }
            Err(error) => return Err(CliError::file("read", &path, &error)),
            Ok(text) => parse(&text).map_err(|problem| {
                CliError::Input(format!(
                    "{} is not what this version writes: {problem}; move it away or name another \
                     --out",
                    path.display()
                ))
            })?,
        };
        Ok(Self { folder: folder.to_owned(), file })
    }

    /// The row with this key.
    pub(super) fn find(&self, key: &Key) -> Option<&Row> {
        self.file.rows.iter().find(|row| row.key == *key)
    }

    /// Adds a row and writes the file, so that an interruption costs nothing that was made.
    pub(super) fn add(&mut self, row: Row) -> Result<Row, CliError> {
        self.file.rows.push(row.clone());
        let text = serde_json::to_string_pretty(&self.file)
            .map_err(|error| CliError::Failure(format!("{FILE}: {error}")))?;
        self.write(FILE, &(text + "\n"))?;
        Ok(row)
    }

    /// Writes a file of the folder: the old one stays until the new one is whole.
    pub(super) fn write(&self, name: &str, text: &str) -> Result<(), CliError> {
        let path = self.folder.join(name);
        let write = || -> std::io::Result<()> {
            let mut file = tempfile::NamedTempFile::new_in(&self.folder)?;
            file.write_all(text.as_bytes())?;
            file.persist(&path)?;
            Ok(())
        };
        write().map_err(|error| CliError::file("write", &path, &error))
    }
}

fn parse(text: &[u8]) -> Result<File, String> {
    let file: File = serde_json::from_slice(text).map_err(|error| error.to_string())?;
    if file.schema != SCHEMA {
        return Err(format!("its schema is {:?}, not {SCHEMA:?}", file.schema));
    }
    Ok(file)
}
