//! `tables.json`: all rows computed in a folder, each with everything that it depends on.

use std::fs;
use std::io::Write;
use std::path::{Path, PathBuf};

use engine::job::ModelRecord;
use engine::job::{Algorithm, RunSpec, Schedule, TileSpec};
use engine::pipeline::records::JointRecord;
use sci_recon::cli::CliError;
use serde::{Deserialize, Serialize};

/// Name and version of this schema.
const SCHEMA: &str = "sci-recon/bench-tables/1";

const FILE: &str = "tables.json";

/// Settings common to all rows of a command.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Setting {
    pub pattern: String,
    /// Standard deviation of the noise of the measurement on the scale of 255 grey values.
    pub noise_sigma: f32,
    pub seed: u64,
}

/// Everything that a row depends on. A row with an existing key is not computed again.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Key {
    pub program_version: String,
    pub clip: String,
    /// Number of snapshots of the clip.
    pub snapshots: usize,
    /// Mode of joint reconstruction.
    pub run: RunSpec,
    pub algorithm: Algorithm,
    pub scale: usize,
    pub compression_ratio: usize,
    #[serde(flatten)]
    pub setting: Setting,
    /// SHA-256 of masks, measurement and true frames, concatenated as little-endian f32.
    pub inputs_sha256: String,
    pub schedule: Schedule,
    pub tile: TileSpec,
    pub models: Vec<ModelRecord>,
    /// Execution provider of the networks; none without networks.
    pub provider: Option<String>,
}

/// Result of an algorithm on a clip. A PSNR is in dB, averaged over the frames of the snapshot;
/// none if it is infinite.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Row {
    #[serde(flatten)]
    pub key: Key,
    pub psnr_db: Option<f64>,
    pub ssim: f64,
    pub psnr_db_by_frame: Vec<Option<f64>>,
    /// Ordered from the centre to the rim.
    pub psnr_db_by_zone: Vec<ZoneRecord>,
    pub cpu_seconds: f64,
    pub seconds: f64,
    /// Maximum over the tiles.
    pub denoiser_passes: usize,
    /// Estimated white level of the scene.
    pub white: f32,
    pub stop_reason: String,
    /// True if the pilot joined snapshots.
    pub joints: Vec<JointRecord>,
}

/// A ring around the centre.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct ZoneRecord {
    /// Outer radius in pixels; none for the corners.
    pub outer_radius: Option<f64>,
    pub psnr_db: Option<f64>,
}

#[derive(Debug, Serialize, Deserialize)]
struct File {
    schema: String,
    rows: Vec<Row>,
}

pub struct Records {
    folder: PathBuf,
    file: File,
}

impl Records {
    /// Creates the folder, or reads its rows.
    pub fn open(folder: &Path) -> Result<Self, CliError> {
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

    pub fn find(&self, key: &Key) -> Option<&Row> {
        self.file.rows.iter().find(|row| row.key == *key)
    }

    /// Adds a row and writes the file, so that an interruption loses no row.
    pub fn add(&mut self, row: Row) -> Result<Row, CliError> {
        self.file.rows.push(row.clone());
        let text = serde_json::to_string_pretty(&self.file)
            .map_err(|error| CliError::Failure(format!("{FILE}: {error}")))?;
        self.write(FILE, &(text + "\n"))?;
        Ok(row)
    }

    /// Writes a file of the folder atomically.
    pub fn write(&self, name: &str, text: &str) -> Result<(), CliError> {
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
