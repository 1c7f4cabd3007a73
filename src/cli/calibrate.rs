//! `sci-recon calibrate`: makes masks and a report from raw captures, without a server.

use std::fs::{self, File};
use std::io::BufWriter;
use std::path::{Path, PathBuf};

use clap::Args;
use serde::Deserialize;

use super::output::print_line;
use super::verdict;
use super::{CliError, progress};
use crate::cli::error::{Result, read_json};
use engine::intake::{CaptureFiles, Report, calibrate, report_page};
use formats::{Channels, FormatError, Limits, StackInfo, npy};

/// Make masks and a report from raw captures.
#[derive(Debug, Args)]
pub struct Arguments {
    /// The index of the captures, JSON as `simulate --captures` writes it: `masks` (a list of files for
    /// each pattern), `white`, `black`, and perhaps `black_with_mask`, `patterns` and `saturation`.
    /// Files are named relative to it; each holds one frame or several repeats.
    #[arg(long, value_name = "FILE")]
    captures: PathBuf,
    /// A picture of the size of the captures that is not 0 at bad pixels. They are left out.
    #[arg(long, value_name = "FILE")]
    bad_pixels: Option<PathBuf>,
    /// Folder for masks.npy, report.json, report.html and maps/.
    #[arg(long, value_name = "FOLDER")]
    out: PathBuf,
    /// Print the report as one JSON object.
    #[arg(long)]
    json: bool,
}

/// The index of the captures. Fields of a measurement are ignored.
#[derive(Debug, Deserialize)]
struct Index {
    #[serde(flatten)]
    captures: CaptureFiles,
}

pub fn run(arguments: &Arguments) -> Result<()> {
    let files = read_index(&arguments.captures)?;
    let out = &arguments.out;
    fs::create_dir_all(out.join("maps")).map_err(|error| CliError::file("make", out, &error))?;
    let bar = progress::bar("calibrating");
    let mut share = |share: f64| {
        progress::show(&bar, share);
        true
    };
    // The output folder has the space for it; the folder for temporary files may be small.
    let scratch = tempfile::Builder::new().prefix(".making-").tempfile_in(out);
    let scratch = scratch.map_err(|error| CliError::file("write", out, &error))?;
    let masks = |info: &StackInfo| {
        let file = File::create(out.join("masks.npy"));
        let file = file.map_err(FormatError::io("write masks.npy"))?;
        npy::writer(BufWriter::new(file), (info.frames, info.height, info.width), Channels::Grey)
    };
    let (bad, limits) = (arguments.bad_pixels.as_deref(), Limits::default());
    let calibrated = calibrate(&files, bad, &limits, scratch.path(), masks, &mut share);
    let (calibrated, _) = calibrated.map_err(|error| match error.is_retryable() {
        // Includes failures to write.
        true => CliError::Failure(error.to_string()),
        false => error.into(),
    })?;
    bar.finish_and_clear();
    write_report(arguments, &calibrated.report)
}

fn write_report(arguments: &Arguments, report: &Report) -> Result<()> {
    let out = &arguments.out;
    let failed = |error| CliError::file("write", out, &error);
    let text = serde_json::to_string_pretty(&report.report)
        .map_err(|error| CliError::Failure(format!("the report: {error}")))?;
    let name = arguments.captures.display().to_string();
    fs::write(out.join("report.html"), report_page(&name, &report.report)).map_err(failed)?;
    for (name, png) in &report.maps {
        fs::write(out.join("maps").join(format!("{name}.png")), png).map_err(failed)?;
    }
    if arguments.json {
        print_line(&text)?;
    } else {
        print_line(format!("grade: {}", report.report.grade.into_str()))?;
        verdict::lines(&report.report.findings).iter().try_for_each(print_line)?;
        print_line(format!("masks.npy and report.html are in {}", out.display()))?;
    }
    fs::write(out.join("report.json"), text + "\n").map_err(failed)
}

fn read_index(path: &Path) -> Result<CaptureFiles> {
    let refused =
        |problem: &str| CliError::Input(format!("captures {}: {problem}", path.display()));
    let Index { captures } = read_json("captures", path)?;
    let folder = path.parent().unwrap_or(Path::new("."));
    if let Some(missing) = captures.masks.iter().position(Vec::is_empty) {
        return Err(refused(&format!("pattern {missing} (counted from 0) has no captures")));
    }
    if captures.masks.is_empty() || captures.white.is_empty() || captures.black.is_empty() {
        return Err(refused("masks, white and black each need captures"));
    }
    Ok(captures.map(|file| folder.join(file)))
}
