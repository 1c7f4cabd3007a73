//! `tables.md`: one table for each compression ratio, laid out as the paper's.

use std::fmt::Write;

use super::record::Row;
use super::trial::mean;
use crate::job::Algorithm;

/// What the tables show.
pub(super) struct Layout {
    /// The columns.
    pub(super) clips: Vec<String>,
    /// The rows of each scale.
    pub(super) algorithms: Vec<Algorithm>,
    pub(super) by_frame: bool,
    pub(super) by_zone: bool,
}

/// Rows of one algorithm at one scale and compression ratio, in the order of the clips; none for
/// clips that are still to come.
struct Group<'a> {
    algorithm: Algorithm,
    scale: usize,
    rows: Vec<Option<&'a Row>>,
}

impl Layout {
    /// A row as a line on the way.
    pub(super) fn line(&self, row: &Row) -> String {
        let key = &row.key;
        format!(
            "{}, Cr {}, {scale}x{scale}, {}: {} dB, SSIM {:.4}, {:.1} CPU-seconds",
            key.clip,
            key.compression_ratio,
            key.algorithm.name(),
            decibels(row.psnr_db),
            row.ssim,
            row.cpu_seconds,
            scale = key.scale,
        )
    }

    /// The tables, as far as `rows` go: in the order in which they were made.
    pub(super) fn markdown(&self, rows: &[Row]) -> String {
        let mut text = String::new();
        let mut ratios: Vec<usize> = rows.iter().map(|row| row.key.compression_ratio).collect();
        ratios.dedup();
        for ratio in ratios {
            let rows: Vec<&Row> =
                rows.iter().filter(|row| row.key.compression_ratio == ratio).collect();
            let groups = self.groups(&rows);
            // Writing into a String can't fail.
            let _ = writeln!(text, "{}", self.heading(ratio, &rows));
            text += &self.quality(&groups);
            if self.by_frame {
                let frames: Vec<String> =
                    (1..=ratio).map(|frame| format!("frame {frame}")).collect();
                text += "\nPSNR in dB by frame, mean over the clips:\n\n";
                text += &detail(&groups, &frames, |row| row.psnr_db_by_frame.clone());
            }
            if self.by_zone {
                text += "\nPSNR in dB by zone, from the centre to the rim (quarters of the half side, then \
                         the corners), mean over the clips:\n\n";
                let zones = ["to 1/4", "to 2/4", "to 3/4", "to 4/4", "corners"].map(String::from);
                text += &detail(&groups, &zones, |row| {
                    row.psnr_db_by_zone.iter().map(|zone| zone.psnr_db).collect()
                });
            }
            text.push('\n');
        }
        text
    }

    fn heading(&self, ratio: usize, rows: &[&Row]) -> String {
        let Some(setting) = rows.first().map(|row| &row.key.setting) else { return String::new() };
        let noise = match setting.noise_sigma {
            0.0 => "no noise".to_owned(),
            sigma => format!("noise sigma {sigma}"),
        };
        format!(
            "PSNR in dB, SSIM (Cr = {ratio}, {}, {noise}, seed {}):\n",
            setting.pattern, setting.seed
        )
    }

    fn groups<'a>(&self, rows: &[&'a Row]) -> Vec<Group<'a>> {
        let mut scales: Vec<usize> = rows.iter().map(|row| row.key.scale).collect();
        scales.dedup();
        let of = |scale: usize, algorithm: Algorithm| {
            let here = |row: &&&Row| row.key.scale == scale && row.key.algorithm == algorithm;
            let rows: Vec<&'a Row> = rows.iter().filter(here).copied().collect();
            let clip = |name: &String| rows.iter().copied().find(|row| row.key.clip == *name);
            Group { algorithm, scale, rows: self.clips.iter().map(clip).collect() }
        };
        let pairs = scales.into_iter().flat_map(|s| self.algorithms.iter().map(move |a| (s, *a)));
        pairs.map(|(scale, algorithm)| of(scale, algorithm)).collect()
    }

    fn quality(&self, groups: &[Group<'_>]) -> String {
        let clips = self.clips.iter().map(|clip| clip.replace('|', "\\|"));
        let mut head: Vec<String> = ["Scale", "Algorithm"].map(String::from).into();
        head.extend(clips);
        head.extend(["Mean", "CPU seconds", "Deep passes"].map(String::from));
        let mut text = head_of(&head);
        for group in groups {
            let cell =
                |row: &Option<&Row>| row.map_or_else(missing, |row| pair(row.psnr_db, row.ssim));
            let mut cells = group.names();
            cells.extend(group.rows.iter().map(cell));
            let Some(rows) = group.complete() else {
                cells.extend([missing(), missing(), missing()]);
                text += &line_of(&cells);
                continue;
            };
            let count = rows.len() as f64;
            let average =
                |value: fn(&Row) -> f64| rows.iter().map(|row| value(row)).sum::<f64>() / count;
            let psnr = mean(&rows.iter().map(|row| row.psnr_db).collect::<Vec<_>>());
            cells.push(pair(psnr, average(|row| row.ssim)));
            cells.push(format!("{:.1}", average(|row| row.cpu_seconds)));
            cells.push(average(|row| row.denoiser_passes as f64).to_string());
            text += &line_of(&cells);
        }
        text
    }
}

impl<'a> Group<'a> {
    fn names(&self) -> Vec<String> {
        vec![format!("{0}x{0}", self.scale), self.algorithm.name().to_owned()]
    }

    /// The rows of all clips, if they are there.
    fn complete(&self) -> Option<Vec<&'a Row>> {
        self.rows.iter().copied().collect()
    }
}

/// A table of `values` of each row, in the mean over the clips.
fn detail(
    groups: &[Group<'_>],
    columns: &[String],
    values: impl Fn(&Row) -> Vec<Option<f64>>,
) -> String {
    let mut head: Vec<String> = ["Scale", "Algorithm"].map(String::from).into();
    head.extend_from_slice(columns);
    let mut text = head_of(&head);
    for group in groups {
        let mut cells = group.names();
        match group.complete() {
            None => cells.extend(columns.iter().map(|_| missing())),
            Some(rows) => {
                let rows: Vec<Vec<Option<f64>>> = rows.into_iter().map(&values).collect();
                cells.extend((0..columns.len()).map(|at| {
                    let column: Vec<Option<f64>> =
                        rows.iter().map(|row| row.get(at).copied().flatten()).collect();
                    decibels(mean(&column))
                }));
            }
        }
        text += &line_of(&cells);
    }
    text
}

fn head_of(cells: &[String]) -> String {
    let rule: Vec<String> = cells.iter().map(|_| "---".to_owned()).collect();
    line_of(cells) + &line_of(&rule)
}

fn line_of(cells: &[String]) -> String {
    format!("| {} |\n", cells.join(" | "))
}

fn missing() -> String {
    "-".to_owned()
}

fn pair(psnr: Option<f64>, ssim: f64) -> String {
    format!("{}, {ssim:.4}", decibels(psnr))
}

/// None is what equals the truth.
fn decibels(psnr: Option<f64>) -> String {
    psnr.map_or_else(|| "inf".to_owned(), |psnr| format!("{psnr:.2}"))
}
