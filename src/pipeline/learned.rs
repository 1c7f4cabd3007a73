//! End-to-end networks: their files, and a tile that goes through one.

use std::fs;
use std::path::{Path, PathBuf};

use ndarray::ArrayView2;

use super::networks::NetworkError;
use super::tile::{TileInput, TileOutcome};
use crate::job::Sha256;
use crate::recon::ReconError;
use crate::recon::learned::SnapshotNetwork;
use crate::recon::solver::StopReason;

/// An end-to-end network in its ONNX file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModelFile {
    path: PathBuf,
    sha256: Sha256,
}

impl ModelFile {
    /// A file that should have this hash.
    pub fn new(path: PathBuf, sha256: Sha256) -> Self {
        Self { path, sha256 }
    }

    /// A file as it is.
    ///
    /// # Errors
    /// A file that can't be read.
    pub fn open(path: &Path) -> Result<Self, NetworkError> {
        let bytes = read(path)?;
        Ok(Self { path: path.to_owned(), sha256: Sha256::of(&bytes) })
    }

    /// The hash of the file.
    pub fn sha256(&self) -> Sha256 {
        self.sha256
    }

    /// The content.
    pub(super) fn read(&self) -> Result<Vec<u8>, NetworkError> {
        let bytes = read(&self.path)?;
        let found = Sha256::of(&bytes);
        if found == self.sha256 {
            return Ok(bytes);
        }
        Err(NetworkError::Damaged { expected: self.sha256, found })
    }
}

fn read(path: &Path) -> Result<Vec<u8>, NetworkError> {
    fs::read(path).map_err(|reason| NetworkError::Model { path: path.to_owned(), reason })
}

/// Reconstructs one tile in one run of a network, brought to \[0,1\] by its white level.
///
/// # Errors
/// Inputs that can't be, or a network that fails.
pub fn run_network(
    input: TileInput,
    network: &mut dyn SnapshotNetwork,
) -> Result<TileOutcome, ReconError> {
    input.solved(|op, measurement| {
        let frames = network.frames(measurement, op.masks())?;
        let rest = &measurement - &op.forward(frames.view())?;
        let norm = squares(measurement).max(f64::MIN_POSITIVE);
        Ok(TileOutcome {
            frames,
            tv_iterations: 0,
            denoiser_passes: 1,
            residual: (squares(rest.view()) / norm).sqrt() as f32,
            stop_reason: StopReason::MaxIterations,
        })
    })
}

fn squares(values: ArrayView2<'_, f32>) -> f64 {
    values.iter().map(|&value| f64::from(value) * f64::from(value)).sum()
}

#[cfg(test)]
mod tests {
    use super::{ModelFile, run_network};
    use crate::optics::{iid_masks, measure};
    use crate::pipeline::TileInput;
    use crate::recon::ReconError;
    use crate::recon::learned::SnapshotNetwork;
    use ndarray::{Array3, ArrayView2, ArrayView3};

    /// Knows the frames already, and what it should be given for them.
    struct Oracle(Array3<f32>);

    impl SnapshotNetwork for Oracle {
        fn frames(
            &mut self,
            y: ArrayView2<'_, f32>,
            masks: ArrayView3<'_, f32>,
        ) -> Result<Array3<f32>, ReconError> {
            let expected = measure(masks, self.0.view()).unwrap();
            assert!(y.iter().zip(&expected).all(|(a, b)| (a - b).abs() < 1e-5));
            Ok(self.0.clone())
        }
    }

    #[test]
    fn the_network_sees_a_scene_on_0_to_1_and_its_scale_is_undone() {
        let masks = iid_masks(3, 20, 24, 1).unwrap();
        let frames = Array3::from_shape_fn((3, 20, 24), |(k, i, j)| (k + i + j) as f32 / 45.0);
        let measurement = measure(masks.view(), frames.view()).unwrap() * 4.0;
        let input = TileInput { masks, measurement, white: 4.0 };
        let outcome = run_network(input, &mut Oracle(frames.clone())).unwrap();
        assert_eq!(outcome.frames, frames * 4.0);
        assert_eq!(outcome.denoiser_passes, 1);
        assert!(outcome.residual < 1e-5);
    }

    #[test]
    fn a_damaged_file_is_not_run() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("network.onnx");
        std::fs::write(&path, "as it was").unwrap();
        let file = ModelFile::open(&path).unwrap();
        assert_eq!(file.read().unwrap(), b"as it was");
        std::fs::write(&path, "as it is").unwrap();
        assert!(file.read().unwrap_err().to_string().contains("damaged"));
    }
}
