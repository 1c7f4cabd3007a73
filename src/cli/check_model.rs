//! `sci-recon check-model`: checks in a separate process whether a network can be used.
//!
//! Loading a stranger's network runs native code on its content: it may crash, hang, or take all memory. The service
//! starts this command so that such a failure does not affect the service.

use std::path::PathBuf;

use clap::Args;
use ndarray::{Array2, Array3};

use super::CliError;
use super::arguments::NetworkArguments;
use super::output::print_line;
use crate::cli::error::Result;
use engine::job::{
    Algorithm, ModelFacts, ModelTensor, ModelTrial, ModelVerdict, TileSpec, shortened_reason,
};
use engine::pipeline::networks::{ModelFile, NetworkError, NetworkSource};
use engine::pipeline::usage::{cpu_seconds, peak_rss_bytes};
use reconstruction::ReconError;
use reconstruction::learned::{PictureSize, SnapshotNetwork, TensorInfo};
use reconstruction::tile::TilePlan;

/// Nice value of the check.
const NICE: i32 = 10;

/// Longest name of a tensor that is reported, in characters.
const MAX_NAME: usize = 100;

/// Check a custom network for `learned`.
///
/// Checks whether it fits masks of a given size, and runs it once on a dark scene. Prints one JSON object with its
/// properties, or the reason why it is refused.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The ONNX file.
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Frames in one snapshot.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..))]
    frames: u32,
    /// Rows of the masks.
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(1..))]
    height: u32,
    /// Columns of the masks.
    #[arg(long, value_name = "PIXELS", value_parser = clap::value_parser!(u32).range(1..))]
    width: u32,
    /// Memory limit of the check [default: no limit].
    #[arg(long, value_name = "BYTES")]
    memory_bytes: Option<u64>,
    /// Do not restrict the files and connections of the check.
    #[arg(long, hide = true)]
    unconfined: bool,
    /// End when standard input ends, because the worker that started the check has then ended.
    #[arg(long, hide = true)]
    supervised: bool,
    #[command(flatten)]
    engine: NetworkArguments,
}

/// Runs the command. An unusable network is a result of the command, not a failure.
pub fn run(arguments: &Arguments) -> Result<()> {
    let refused = |error: &dyn std::fmt::Display| CliError::Failure(error.to_string());
    rustix::process::setpriority_process(None, NICE).map_err(|error| refused(&error))?;
    let Arguments { file, memory_bytes, unconfined, engine, supervised, .. } = arguments;
    if *supervised {
        std::thread::spawn(|| {
            let _ = std::io::copy(&mut std::io::stdin().lock(), &mut std::io::sink());
            std::process::exit(1);
        });
    }
    engine.confine(*memory_bytes, *unconfined, Some(file))?;
    let network = arguments.engine.network()?;
    // Fails before the network is loaded if the library is missing.
    network.version()?;
    let file =
        ModelFile::open(&arguments.file).map_err(|error| CliError::Input(error.to_string()))?;
    let verdict = match facts(arguments, &network, &file) {
        Ok(facts) => ModelVerdict::Fits(facts),
        Err(NetworkError::Runtime(error)) => {
            ModelVerdict::Refused(shortened_reason(&error.to_string()))
        }
        Err(other) => return Err(other.into()),
    };
    let text = serde_json::to_string(&verdict).map_err(|error| refused(&error))?;
    print_line(text)?;
    Ok(())
}

fn facts(
    arguments: &Arguments,
    network: &NetworkSource,
    file: &ModelFile,
) -> Result<ModelFacts, NetworkError> {
    let length = |length: u32| usize::try_from(length).unwrap_or(usize::MAX);
    let (height, width) = (length(arguments.height), length(arguments.width));
    let frames = length(arguments.frames);
    let mut network = network.end_to_end(&file.content()?)?;
    let interface = network.interface();
    let size = interface.check(frames, height, width)?;
    let trial_size = match size {
        PictureSize::Fixed => (height, width),
        PictureSize::Free => first_tile(height, width)?,
    };
    Ok(ModelFacts {
        inputs: interface.inputs.into_iter().map(tensor).collect(),
        outputs: interface.outputs.into_iter().map(tensor).collect(),
        fixed_size: size == PictureSize::Fixed,
        trial: run_once(&mut network, frames, trial_size)?,
    })
}

fn tensor(TensorInfo { name, sides, .. }: TensorInfo) -> ModelTensor {
    // The file may contain names of any length.
    ModelTensor { name: name.chars().take(MAX_NAME).collect(), shape: sides }
}

/// The default size of a job's tiles.
fn first_tile(height: usize, width: usize) -> Result<(usize, usize), ReconError> {
    let TileSpec { size, overlap } = Algorithm::Learned.default_tile();
    let tile = TilePlan::new(height, width, size, overlap)?.tile(0);
    Ok(tile.map_or((height, width), |tile| (tile.height, tile.width)))
}

/// Runs a network on a dark scene with half-open masks. Many networks would divide by masks of 0.
fn run_once(
    network: &mut dyn SnapshotNetwork,
    frames: usize,
    (height, width): (usize, usize),
) -> Result<ModelTrial, ReconError> {
    let masks = Array3::from_elem((frames, height, width), 0.5);
    let before = cpu_seconds();
    network.frames(Array2::zeros((height, width)).view(), masks.view())?;
    let cpu_seconds = cpu_seconds() - before;
    Ok(ModelTrial { height, width, cpu_seconds, peak_rss_bytes: peak_rss_bytes() })
}
