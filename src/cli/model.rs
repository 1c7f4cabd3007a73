//! The network of a user's own on the command line.

use std::path::Path;

use super::CliError;
use crate::cli::error::Result;
use crate::job::{Algorithm, TileSpec};
use crate::pipeline::networks::{ModelFile, ModelRecord, NetworkSource};
use crate::recon::learned::{Interface, PictureSize};
use crate::recon::tile::TilePlan;

/// An end-to-end network for one size of masks.
pub struct Model {
    name: String,
    pub file: ModelFile,
    interface: Interface,
}

impl Model {
    /// Loads the network once, to see what it takes.
    pub fn open(path: &Path, network: &NetworkSource) -> Result<Self> {
        let file = ModelFile::open(path).map_err(|error| CliError::Input(error.to_string()))?;
        let interface = network.end_to_end(&file)?.interface();
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Self { name, file, interface })
    }

    /// Which pictures it takes, for masks of frames x rows x columns.
    pub fn size(&self, (frames, height, width): (usize, usize, usize)) -> Result<PictureSize> {
        Ok(self.interface.check(frames, height, width)?)
    }

    pub fn record(&self) -> ModelRecord {
        ModelRecord { name: self.name.clone(), sha256: self.file.sha256().to_string() }
    }
}

/// How masks of frames x rows x columns are cut: as asked for, else as the algorithm or the network
/// wants it.
pub fn plan(
    algorithm: Algorithm,
    (tile, overlap): (Option<usize>, Option<usize>),
    model: Option<&Model>,
    dim: (usize, usize, usize),
) -> Result<TilePlan> {
    let (_, height, width) = dim;
    let fixed = model.map(|model| model.size(dim)).transpose()? == Some(PictureSize::Fixed);
    let usual = if fixed { TileSpec::whole(height, width) } else { algorithm.default_tile() };
    let (size, overlap) = (tile.unwrap_or(usual.size), overlap.unwrap_or(usual.overlap));
    let plan = TilePlan::new(height, width, size, overlap)?;
    if fixed && plan.len() > 1 {
        return Err(CliError::Input(format!(
            "the network takes pictures of {height}x{width} pixels only, so they can't be cut into \
             tiles of {size}: leave --tile out"
        )));
    }
    Ok(plan)
}
