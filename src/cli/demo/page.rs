//! The page that the demo writes: the measurement, the reconstructions, and their differences from the truth.

use std::fs;
use std::path::Path;

use maud::html;
use ndarray::{Array3, Axis};

use super::report::{PAGE, Report};
use crate::cli::CliError;
use crate::cli::error::Result;
use engine::intake::html_page;
use formats::display::{Encoding, Picture};
use formats::{Channels, Limits, read_stack};

/// The folder of the page's pictures.
pub(super) const PICTURES: &str = "pictures";
/// Gain with which differences are shown.
const GAIN: f32 = 4.0;

const STYLE: &str = "body { font: 16px/1.5 system-ui, sans-serif; margin: 2rem auto; max-width: 72rem; padding: 0 1rem; \
     background: #fff; color: #1b2026 } \
     .row { display: flex; flex-wrap: wrap; gap: 1rem } figure { margin: 0 } \
     img, video { width: 256px; image-rendering: pixelated; background: #000; display: block } \
     th, td { padding: .1rem 1.5rem .1rem 0; text-align: right } th:first-child, td:first-child { text-align: left }";

/// The results of a job.
pub(super) struct Reconstruction {
    pub(super) name: &'static str,
    pub(super) frames: Array3<f32>,
    /// Path of the movie below the demo's folder.
    pub(super) movie: String,
}

/// Writes `report.html` and its pictures. It shows the measurement, the movies, and for the middle frame the truth, the
/// reconstructions and their differences.
pub(super) fn write(
    out: &Path,
    truth: &Array3<f32>,
    reconstructions: &[Reconstruction],
    report: &Report,
) -> Result<()> {
    let folder = out.join(PICTURES);
    let unwritable = |path: &Path, error| CliError::file("write", path, &error);
    fs::create_dir_all(&folder).map_err(|error| unwritable(&folder, error))?;
    let middle = truth.len_of(Axis(0)) / 2;
    let picture =
        |name: &str, values: ndarray::ArrayView2<'_, f32>, white: f32| -> Result<String> {
            let name = format!("{name}.png");
            let picture = Picture::new(values, Channels::Grey, (0.0, white))?;
            let bytes = picture.encode(Encoding::Png)?;
            let path = folder.join(&name);
            fs::write(&path, bytes).map_err(|error| unwritable(&path, error))?;
            Ok(format!("{PICTURES}/{name}"))
        };
    let (_, measurement) = read_stack(&out.join("input/measurement.npy"), &Limits::default())?;
    let measurement = measurement.index_axis(Axis(0), 0);
    let brightest = measurement.iter().copied().fold(f32::MIN_POSITIVE, f32::max);
    let measured = picture("measurement", measurement, brightest)?;
    let true_frame = truth.index_axis(Axis(0), middle);
    let mut pictures = vec![("truth", picture("truth", true_frame, 1.0)?, None)];
    for Reconstruction { name, frames, .. } in reconstructions {
        let frame = frames.index_axis(Axis(0), middle);
        let difference = (&frame - &true_frame).mapv(f32::abs);
        let difference = picture(&format!("{name}-difference"), difference.view(), 1.0 / GAIN)?;
        pictures.push((name, picture(name, frame, 1.0)?, Some(difference)));
    }
    let text = page(middle, &measured, &pictures, reconstructions, report);
    let path = out.join(PAGE);
    fs::write(&path, text).map_err(|error| unwritable(&path, error))
}

/// Name, picture and picture of the difference.
type Shown<'a> = (&'a str, String, Option<String>);

fn page(
    middle: usize,
    measured: &str,
    pictures: &[Shown<'_>],
    reconstructions: &[Reconstruction],
    report: &Report,
) -> String {
    let style = html! { style { (STYLE) } };
    let body = html! {
        h1 { "One snapshot, " (report.frames) " frames" }
        div class="row" {
            figure { img src=(measured) alt="The measurement"; figcaption { "the measurement" } }
            @for Reconstruction { name, movie, .. } in reconstructions {
                figure {
                    video src=(movie) controls loop autoplay muted playsinline {}
                    figcaption { (name) }
                }
            }
        }
        table {
            tr { th { "" } th { "PSNR" } th { "SSIM" } th { "CPU" } }
            @for (name, quality) in report.rows() {
                tr {
                    td { (name) }
                    td { (format!("{:.2} dB", quality.psnr_db)) }
                    td { (format!("{:.4}", quality.ssim)) }
                    td { (format!("{:.1} s", quality.cpu_seconds)) }
                }
            }
        }
        h2 { "Frame " (middle + 1) }
        div class="row" {
            @for (name, picture, _) in pictures {
            figure { img src=(picture) alt=(name); figcaption { (name) } }
            }
        }
        h2 { "Difference from the truth, " (GAIN) " times as bright" }
        div class="row" {
            @for (name, _, difference) in pictures {
                @if let Some(difference) = difference {
                    figure { img src=(difference) alt={ "Difference of " (name) }; figcaption { (name) } }
                }
            }
        }
    };
    html_page("sci-recon: the demo", &style, &body)
}
