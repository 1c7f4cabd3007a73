//! What the command says at its end.

use serde::Serialize;

use super::Arguments;
use crate::cli::CliError;
use crate::pipeline::manifest::Manifest;
use crate::pipeline::quality::Quality;
use crate::pipeline::records::PilotRecord;

/// What `--json` prints.
#[derive(Debug, Serialize)]
pub(super) struct Report {
    algorithm: &'static str,
    frames: usize,
    height: usize,
    width: usize,
    psnr_db: Option<f64>,
    ssim: Option<f64>,
    seconds: f64,
    denoiser_passes: usize,
    tv_iterations: usize,
    cpu_seconds: f64,
    peak_rss_bytes: u64,
    /// None for a schedule without a network.
    provider: Option<String>,
    stop_reason: String,
    /// How an adaptive schedule was decided.
    pilot: Option<PilotRecord>,
}

impl Report {
    /// Of a snapshot, and of its frames if the truth is known.
    pub(super) fn new(manifest: &Manifest, quality: Option<Quality>) -> Self {
        let (content, run) = (&manifest.content, &manifest.run);
        Self {
            algorithm: content.recipe.algorithm.name(),
            frames: content.frames,
            height: content.height,
            width: content.width,
            psnr_db: quality.as_ref().map(|quality| quality.psnr),
            ssim: quality.and_then(|quality| quality.ssim),
            seconds: run.seconds.unwrap_or_default(),
            denoiser_passes: content.summary.denoiser_passes,
            tv_iterations: content.summary.tv_iterations,
            cpu_seconds: run.cost.cpu_seconds,
            peak_rss_bytes: run.cost.peak_rss_bytes,
            provider: run.cost.provider.clone(),
            stop_reason: content.summary.stop_reason.clone(),
            pilot: content.recipe.pilot.clone(),
        }
    }

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
