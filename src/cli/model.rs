//! A user's network on the command line.

use std::path::Path;

use super::CliError;
use crate::cli::error::Result;
use engine::job::{Algorithm, Cut, CutRequest, ModelRecord, Schedule, Sequence, TileSpec};
use engine::pipeline::networks::{ModelFile, NetworkSource};
use reconstruction::learned::{Interface, PictureSize};

/// An end-to-end network for one size of masks.
pub struct Model {
    name: String,
    pub file: ModelFile,
    interface: Interface,
}

impl Model {
    /// Loads the network once to learn its inputs and outputs.
    pub fn open(path: &Path, network: &NetworkSource) -> Result<Self> {
        let file = ModelFile::open(path).map_err(|error| CliError::Input(error.to_string()))?;
        let interface = network.end_to_end(&file.content()?)?.interface();
        let name = path.file_stem().unwrap_or_default().to_string_lossy().into_owned();
        Ok(Self { name, file, interface })
    }

    /// The sizes of pictures that the network accepts for masks of frames x rows x columns.
    pub fn size(&self, (frames, height, width): (usize, usize, usize)) -> Result<PictureSize> {
        Ok(self.interface.check(frames, height, width)?)
    }

    pub fn record(&self) -> ModelRecord {
        ModelRecord { name: self.name.clone(), sha256: self.file.sha256().to_string() }
    }
}

/// Decides how snapshots of frames x rows x columns are cut. The user's values precede the defaults of the algorithm and
/// the network.
pub fn cut(
    algorithm: Algorithm,
    schedule: &Schedule,
    tile: Option<usize>,
    overlap: Option<usize>,
    model: Option<&Model>,
    sequence: (Sequence, u32),
    dim: (usize, usize, usize),
) -> Result<Cut> {
    let (_, height, width) = dim;
    let fixed = model.map(|model| model.size(dim)).transpose()? == Some(PictureSize::Fixed);
    let default = if fixed { TileSpec::whole(height, width) } else { algorithm.default_tile() };
    let (size, overlap) = (tile.unwrap_or(default.size), overlap.unwrap_or(default.overlap));
    let (sequence, snapshots) = sequence;
    let tile_is_fixed = fixed || tile.is_some();
    let tile = TileSpec { size, overlap };
    let request = CutRequest { sequence, snapshots, size: dim, tile, tile_is_fixed };
    let cut = Cut::new(request, schedule)?;
    if fixed && cut.tiles(height, width)?.len() > 1 {
        return Err(CliError::Input(format!(
            "the network takes pictures of {height}x{width} pixels only, so they can't be cut into \
             tiles of {size}: leave --tile out"
        )));
    }
    Ok(cut)
}
