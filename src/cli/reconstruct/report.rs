//! What the command says at its end.

use serde::Serialize;

use super::Arguments;
use crate::cli::CliError;
use crate::pipeline::pilot::PilotRecord;

/// What `--json` prints.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    pub(super) algorithm: &'static str,
    pub(super) frames: usize,
    pub(super) height: usize,
    pub(super) width: usize,
    pub(super) psnr_db: Option<f64>,
    pub(super) ssim: Option<f64>,
    pub(super) seconds: f64,
    pub(super) denoiser_passes: usize,
    pub(super) tv_iterations: usize,
    pub(super) cpu_seconds: f64,
    pub(super) peak_rss_bytes: u64,
    /// None for a schedule without a network.
    pub(super) provider: Option<&'static str>,
    pub(super) stop_reason: String,
    /// How an adaptive schedule was decided.
    pub(super) pilot: Option<PilotRecord>,
}

impl Report {
    /// Prints it as the user asked for.
    pub(super) fn print(&self, arguments: &Arguments) -> Result<(), CliError> {
        if arguments.json {
            let text = serde_json::to_string(self)
                .map_err(|error| CliError::Failure(format!("the report: {error}")))?;
            println!("{text}");
            return Ok(());
        }
        println!(
            "{}: {} frames of {}x{} in {:.1} s ({:.1} CPU-seconds), {} TV iterations, {} denoiser \
             passes, {}",
            self.algorithm,
            self.frames,
            self.height,
            self.width,
            self.seconds,
            self.cpu_seconds,
            self.tv_iterations,
            self.denoiser_passes,
            self.stop_reason
        );
        for stage in self.pilot.iter().flat_map(|pilot| &pilot.stages) {
            println!(
                "{}: {} of {} iterations ({}), error at held-out pixels {:.4} to {:.4}{}",
                stage.prior.name(),
                stage.iterations,
                stage.planned,
                stage.end,
                stage.error_before,
                stage.error_after,
                stage.along_time().map_or_else(String::new, |fate| format!(
                    ", total variation along time {fate}"
                ))
            );
        }
        if let Some(psnr) = self.psnr_db {
            let ssim = self.ssim.map_or_else(String::new, |ssim| format!(", SSIM {ssim:.4}"));
            println!("PSNR {psnr:.2} dB{ssim}");
        }
        if let Some(out) = &arguments.out {
            println!("frames are in {}", out.display());
        }
        Ok(())
    }
}
