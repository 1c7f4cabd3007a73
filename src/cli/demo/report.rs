//! The comparison of the demo's results with the truth.

use std::path::PathBuf;

use ndarray::Array3;
use serde::Serialize;

use crate::cli::CliError;
use crate::cli::error::Result;
use crate::cli::output::print_line;
use engine::pipeline::quality::{self, FrameQuality};
use formats::Channels;

/// File name of the page.
pub(super) const PAGE: &str = "report.html";

#[derive(Debug, Clone, Copy, Serialize)]
pub(super) struct Quality {
    pub(super) psnr_db: f64,
    pub(super) ssim: f64,
    /// Processor seconds of computing.
    pub(super) cpu_seconds: f64,
}

/// The content of `demo.json`, which `--json` prints.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    pub(super) gap_tv: Quality,
    pub(super) pnp_tv_fastdvdnet: Quality,
    /// Frames of the snapshot.
    #[serde(skip)]
    pub(super) frames: usize,
    /// Wall time of the whole demo.
    pub(super) seconds: f64,
    pub(super) output_dir: PathBuf,
}

/// Compares downloaded frames with the true ones.
pub(super) fn compare(
    frames: &Array3<f32>,
    truth: &Array3<f32>,
    cpu_seconds: f64,
) -> Result<Quality> {
    let pairs = frames.outer_iter().zip(truth.outer_iter()).enumerate();
    let compared =
        pairs.map(|(k, (frame, truth))| FrameQuality::of(k, frame, truth, Channels::Grey));
    let quality = quality::Quality::from(compared.collect::<Result<Vec<_>, _>>()?);
    let ssim = quality.ssim.unwrap_or_default();
    Ok(Quality { psnr_db: quality.psnr, ssim, cpu_seconds })
}

impl Report {
    pub(super) fn to_json(&self) -> Result<String> {
        serde_json::to_string(self)
            .map_err(|error| CliError::Failure(format!("the report: {error}")))
    }

    /// Name and quality of each algorithm.
    pub(super) fn rows(&self) -> [(&'static str, Quality); 2] {
        [("gap-tv", self.gap_tv), ("pnp-tv-fastdvdnet", self.pnp_tv_fastdvdnet)]
    }

    pub(super) fn print(&self, json: bool) -> Result<()> {
        if json {
            return print_line(self.to_json()?);
        }
        let (tv, pnp) = (&self.gap_tv, &self.pnp_tv_fastdvdnet);
        print_line(format!("\n{:20}{:>10}{:>9}{:>14}", "", "PSNR", "SSIM", "CPU"))?;
        for (name, quality) in self.rows() {
            let Quality { psnr_db, ssim, cpu_seconds } = quality;
            print_line(format!("{name:20}{psnr_db:>7.2} dB{ssim:>9.4}{cpu_seconds:>12.1} s"))?;
        }
        print_line(format!(
            "\nPnP-TV-FastDVDNet is {:.2} dB above GAP-TV; {:.0} s in all.",
            pnp.psnr_db - tv.psnr_db,
            self.seconds
        ))?;
        let out = self.output_dir.display();
        print_line(format!(
            "View the results in {out}/{PAGE}. To open the dashboard on the same data:"
        ))?;
        print_line(format!("sci-recon serve --data {out}/service"))?;
        print_line(format!(
            "The downloaded frames are in {out}/frames, the true ones in {out}/input/clip."
        ))?;
        Ok(())
    }
}
