//! `tables.md`: one table per compression ratio, in the paper's layout.

use engine::job::{Algorithm, RunSpec};

use super::record::{Key, Row};

pub struct Layout {
    pub clips: Vec<String>,
    /// The rows of each scale.
    pub algorithms: Vec<Algorithm>,
    pub by_frame: bool,
    pub by_zone: bool,
}

/// Rows of one algorithm and one run length at one scale and compression ratio, in the order of the
/// clips; none for missing clips.
struct Group<'a> {
    name: String,
    scale: usize,
    rows: Vec<Option<&'a Row>>,
}

pub fn table(head: Vec<String>, rows: impl Iterator<Item = Vec<String>>) -> String {
    let line = |cells: &[String]| format!("| {} |\n", cells.join(" | "));
    let mut text = line(&head) + &line(&vec!["---".to_owned(); head.len()]);
    for mut cells in rows {
        cells.resize(head.len(), "-".to_owned());
        text += &line(&cells);
    }
    text
}

/// A row as text, for the log.
pub fn line(row: &Row) -> String {
    let key = &row.key;
    format!(
        "{}, Cr {}, {scale}x{scale}, {}: {} dB, SSIM {:.4}, {:.1} CPU-seconds",
        key.clip,
        key.compression_ratio,
        name(key),
        decibels(row.psnr_db),
        row.ssim,
        row.cpu_seconds,
        scale = key.scale,
    )
}

/// Name of the algorithm, and of the snapshots that are joined.
fn name(key: &Key) -> String {
    let algorithm = key.algorithm.into_str();
    let RunSpec { length, overlap } = key.run;
    match (key.snapshots, length) {
        (1, _) => algorithm.to_owned(),
        (_, 1) => format!("{algorithm}, separate"),
        _ => format!("{algorithm}, runs of {length} sharing {overlap}"),
    }
}

impl Layout {
    /// The tables of the rows available so far, in the order in which they were computed.
    pub fn markdown(&self, rows: &[Row]) -> String {
        let mut text = String::new();
        for rows in rows.chunk_by(|a, b| a.key.compression_ratio == b.key.compression_ratio) {
            let groups = self.groups(rows);
            text += &heading(&rows[0]);
            text += &self.quality(&groups);
            if self.by_frame {
                let frames = 1..=rows[0].key.compression_ratio * rows[0].key.snapshots;
                let frames = frames.map(|k| format!("frame {k}"));
                text += "\nPSNR in dB by frame, mean over the clips:\n\n";
                text += &detail(&groups, frames.collect(), |row| row.psnr_db_by_frame.clone());
            }
            if self.by_zone {
                text += "\nPSNR in dB by zone, from the centre to the rim (quarters of the half side, then \
                         the corners), mean over the clips:\n\n";
                let zones = ["to 1/4", "to 2/4", "to 3/4", "to 4/4", "corners"].map(String::from);
                text += &detail(&groups, zones.into(), |row| {
                    row.psnr_db_by_zone.iter().map(|zone| zone.psnr_db).collect()
                });
            }
            text.push('\n');
        }
        text
    }

    fn groups<'a>(&self, rows: &'a [Row]) -> Vec<Group<'a>> {
        let mut groups = Vec::new();
        for rows in rows.chunk_by(|a, b| a.key.scale == b.key.scale) {
            let mut runs: Vec<RunSpec> = Vec::new();
            for row in rows {
                if !runs.contains(&row.key.run) {
                    runs.push(row.key.run);
                }
            }
            for &algorithm in &self.algorithms {
                let scale = rows[0].key.scale;
                let before = groups.len();
                for &run in &runs {
                    let of = |row: &&Row| row.key.algorithm == algorithm && row.key.run == run;
                    let row =
                        |clip: &String| rows.iter().filter(of).find(|row| row.key.clip == *clip);
                    let rows: Vec<Option<&Row>> = self.clips.iter().map(row).collect();
                    if let Some(first) = rows.iter().flatten().next() {
                        groups.push(Group { name: name(&first.key), scale, rows });
                    }
                }
                // An algorithm that fits no clip, or has no rows yet.
                if groups.len() == before {
                    let (name, rows) =
                        (algorithm.into_str().to_owned(), vec![None; self.clips.len()]);
                    groups.push(Group { name, scale, rows });
                }
            }
        }
        groups
    }

    fn quality(&self, groups: &[Group<'_>]) -> String {
        let clips = self.clips.iter().map(|clip| clip.replace('|', "\\|"));
        let columns = clips.chain(["Mean", "CPU seconds", "Deep passes"].map(String::from));
        let pair = |psnr, ssim: f64| format!("{}, {ssim:.4}", decibels(psnr));
        table_of(groups, columns.collect(), |group| {
            let clip_row = |row: &Option<&Row>| {
                row.map_or_else(|| "-".to_owned(), |row| pair(row.psnr_db, row.ssim))
            };
            let mut cells: Vec<String> = group.rows.iter().map(clip_row).collect();
            if let Some(rows) = group.complete() {
                let average = |value: fn(&Row) -> f64| {
                    rows.iter().map(|row| value(row)).sum::<f64>() / rows.len() as f64
                };
                let psnr = mean(rows.iter().map(|row| row.psnr_db));
                cells.push(pair(psnr, average(|row| row.ssim)));
                cells.push(format!("{:.1}", average(|row| row.cpu_seconds)));
                cells.push(average(|row| row.denoiser_passes as f64).to_string());
            }
            cells
        })
    }
}

impl<'a> Group<'a> {
    /// The rows of all clips, or none if one is missing.
    fn complete(&self) -> Option<Vec<&'a Row>> {
        self.rows.iter().copied().collect()
    }
}

fn heading(row: &Row) -> String {
    let (ratio, setting) = (row.key.compression_ratio, &row.key.setting);
    let noise = match setting.noise_sigma {
        0.0 => "no noise".to_owned(),
        sigma => format!("noise sigma {sigma}"),
    };
    format!(
        "PSNR in dB, SSIM (Cr = {ratio}, {}, {noise}, seed {}):\n\n",
        setting.pattern, setting.seed
    )
}

/// A table of one detail of each row, averaged over the clips.
fn detail(
    groups: &[Group<'_>],
    columns: Vec<String>,
    values: impl Fn(&Row) -> Vec<Option<f64>>,
) -> String {
    let count = columns.len();
    table_of(groups, columns, |group| {
        let Some(rows) = group.complete() else { return Vec::new() };
        let rows: Vec<Vec<Option<f64>>> = rows.into_iter().map(&values).collect();
        let column = |at: usize| rows.iter().map(move |row| row.get(at).copied().flatten());
        (0..count).map(|at| decibels(mean(column(at)))).collect()
    })
}

fn table_of(
    groups: &[Group<'_>],
    columns: Vec<String>,
    cells: impl Fn(&Group<'_>) -> Vec<String>,
) -> String {
    let head = ["Scale", "Algorithm"].map(String::from).into_iter().chain(columns).collect();
    let row = |group: &Group<'_>| {
        let names = [format!("{0}x{0}", group.scale), group.name.clone()];
        names.into_iter().chain(cells(group)).collect()
    };
    table(head, groups.iter().map(row))
}

/// The mean; none if a value is missing or there are no values.
pub fn mean(values: impl ExactSizeIterator<Item = Option<f64>>) -> Option<f64> {
    let count = values.len() as f64;
    let mean = values.sum::<Option<f64>>()? / count;
    mean.is_finite().then_some(mean)
}

/// None means that the frames equal the truth.
fn decibels(psnr: Option<f64>) -> String {
    psnr.map_or_else(|| "inf".to_owned(), |psnr| format!("{psnr:.2}"))
}
