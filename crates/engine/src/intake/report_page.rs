//! The report of a calibration as a page: plain HTML with pictures, without scripts and inline styles.

use maud::{DOCTYPE, Markup, html};

use crate::job::{
    CalibrationReport, CaptureReport, Finding, FindingCode, Grade, MaskReport, Severity,
};

/// Side of a cell of the drawn correlation matrix, in pixels.
const CELL: usize = 16;

/// Renders a report; `title` names the calibration. The page refers to pictures in `maps/` and to the style sheet of
/// the service. It is readable without the style sheet.
pub fn report_page(title: &str, report: &CalibrationReport) -> String {
    let title = format!("Calibration {title}");
    let style = html! { link rel="stylesheet" href="../../../dashboard/style.css"; };
    let body = html! {
        main {
            h1 { (title) }
            @if let Some(job) = &report.registration_of {
                p { "The registration of job " code { (job) } " has corrected these masks." }
            }
            (grade(report))
            h2 { "Masks" }
            (masks(&report.masks, report))
            @if let Some(captures) = &report.captures {
                h2 { "Captures" }
                (captured(captures))
                (patterns(captures))
            }
            h2 { "Correlation between the masks" }
            (correlation(&report.masks))
            @for map in &report.maps {
                h2 { (caption(map)) }
                p { img src={ "maps/" (map) ".png" } alt=(caption(map)); }
            }
        }
    };
    html_page(&title, &style, &body)
}

/// A page with a title, the element of its style, and the content of its body.
pub fn html_page(title: &str, style: &Markup, body: &Markup) -> String {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) }
                (style)
            }
            body { (body) }
        }
    };
    page.into_string()
}

fn grade(report: &CalibrationReport) -> Markup {
    let (class, text) = match report.grade {
        Grade::Good => ("good", "Good: no fault was found in the masks alone."),
        Grade::Usable | Grade::Doubtful => ("warn", "Usable, with these limitations:"),
        Grade::Bad => ("trouble", "Bad: frames reconstructed with it will be wrong."),
    };
    html! {
        p class=(class) { strong { (text) } }
        @for finding in &report.findings { (problem(finding)) }
    }
}

fn problem(finding: &Finding) -> Markup {
    let class = match finding.severity {
        Severity::Warning => "warn",
        Severity::Error => "trouble",
    };
    let title = finding.code.parse::<FindingCode>().map(|code| code.entry().title);
    html! {
        p class=(class) {
            code { (finding.code) } @if let Ok(title) = title { ": " (title) } br;
            (finding.detail) "." br;
            "What to do: " (finding.remedy) "."
        }
    }
}

fn masks(masks: &MaskReport, report: &CalibrationReport) -> Markup {
    let pixels = (report.height * report.width) as f64;
    let share = |count: u64, of: f64| format!("{count} ({})", percent(count as f64 / of));
    table(&[
        (
            "Size (frames x rows x columns)",
            format!("{} x {} x {}", report.frames, report.height, report.width),
        ),
        ("Mean", number(masks.mean)),
        ("Standard deviation over the masks", number(masks.deviation)),
        (
            "1st and 99th percentile of all values",
            format!("{} and {}", number(masks.percentile_1), number(masks.percentile_99)),
        ),
        (
            "Correlation between masks: mean, largest",
            format!(
                "{} and {}",
                optional(masks.correlation_mean),
                optional(masks.correlation_largest)
            ),
        ),
        ("Gram diagonal: smallest, mean, largest", masks.gram.map(number).join(", ")),
        ("Dead pixels (dark in every mask)", share(masks.dead_pixels, pixels)),
        ("Stuck pixels (open in every mask)", share(masks.stuck_pixels, pixels)),
        ("Values at 0", share(masks.values_at_zero, pixels * report.frames as f64)),
    ])
}

fn captured(captures: &CaptureReport) -> Markup {
    let figures = &captures.figures;
    let range = captures.dynamic_range_db.map(|db| format!("{db:.1} dB"));
    table(&[
        ("Light throughput", percent(captures.light_throughput)),
        ("Share of the light where a mask is 1", percent(captures.mask_scale)),
        ("Noise of a mask value", optional(captures.noise)),
        (
            "Dynamic range (standard deviation over noise)",
            range.unwrap_or_else(|| "unknown".into()),
        ),
        (
            "Mean stored value of white, black, black with mask",
            format!(
                "{:.1}, {:.1}, {}",
                figures.white_level,
                figures.black_level,
                figures
                    .black_with_mask_level
                    .map_or("none (Eq. 7)".into(), |level| format!("{level:.1}"))
            ),
        ),
        ("Saturated pixels of the white image", share(figures.white_saturated)),
        ("Illumination: darkest part over brightest part", share(figures.illumination_flatness)),
        ("Pixels whose white is not above their black", percent(figures.denominator_not_positive)),
        (
            "Pixels whose white is too little above their black",
            percent(figures.denominator_too_dark),
        ),
    ])
}

fn patterns(captures: &CaptureReport) -> Markup {
    html! {
        table {
            thead { tr {
                @for name in ["Pattern", "Light", "At or below 0", "Below 0 by more than noise", "Noise", "Saturated", "Drift of the light"] {
                    th scope="col" { (name) }
                }
            } }
            tbody {
                @for (index, pattern) in captures.figures.patterns.iter().enumerate() {
                    tr {
                        th scope="row" { (index) }
                        td { (percent(pattern.light)) }
                        td { (percent(pattern.not_positive)) }
                        td { (percent(pattern.negative)) }
                        td { (optional(pattern.noise)) }
                        td { (share(pattern.saturated)) }
                        td { (percent(pattern.drift)) }
                    }
                }
            }
        }
    }
}

/// Draws the correlation matrix, from white for 0 to dark blue for 1.
fn correlation(masks: &MaskReport) -> Markup {
    let side = masks.correlation.len() * CELL;
    html! {
        svg xmlns="http://www.w3.org/2000/svg" width=(side) height=(side) role="img"
            aria-label="Correlation between the masks" {
            @for (k, row) in masks.correlation.iter().enumerate() {
                @for (l, value) in row.iter().enumerate() {
                    rect x=(l * CELL) y=(k * CELL) width=(CELL) height=(CELL) fill=(shade(*value)) {
                        title { "masks " (k) " and " (l) ": " (number(*value)) }
                    }
                }
            }
        }
    }
}

#[allow(clippy::cast_possible_truncation, clippy::cast_sign_loss)] // clamped to a byte
fn shade(value: f64) -> String {
    let level = value.clamp(0.0, 1.0);
    let mix = |dark: f64| (255.0 + (dark - 255.0) * level).round() as u8;
    format!("#{:02x}{:02x}{:02x}", mix(11.0), mix(40.0), mix(120.0))
}

fn caption(map: &str) -> String {
    match map {
        "mean" => "Mean of each pixel over the masks".into(),
        "deviation" => "Standard deviation of each pixel over the masks".into(),
        "gram" => "Gram diagonal: sum of squares of each pixel over the masks (black pixels can't be reconstructed)".into(),
        "illumination" => "Illumination: white minus black".into(),
        other => other.into(),
    }
}

fn table(rows: &[(&str, String)]) -> Markup {
    html! {
        table { tbody {
            @for (name, value) in rows { tr { th scope="row" { (name) } td { (value) } } }
        } }
    }
}

fn number(value: f64) -> String {
    format!("{value:.4}")
}

fn optional(value: Option<f64>) -> String {
    value.map_or_else(|| "unknown".into(), number)
}

fn percent(value: f64) -> String {
    format!("{:.2} %", value * 100.0)
}

fn share(value: Option<f64>) -> String {
    value.map_or_else(|| "unknown".into(), percent)
}

#[cfg(test)]
mod tests {
    use super::report_page;
    use crate::job::{CalibrationReport, Finding, FindingCode};
    use optics::{MaskStudy, random_squares};

    #[test]
    fn the_page_escapes_names_and_has_no_scripts() {
        let (masks, _) = random_squares(4, 16, 16, 1).unwrap();
        let mut study = MaskStudy::new(4, 16, 16);
        study.add(masks.view()).unwrap();
        let finding = Finding::new(FindingCode::SwappedOrder, "masks 1 and 2");
        let maps = vec!["gram".to_owned()];
        let report = CalibrationReport::new(&study.finish().unwrap(), None, vec![finding], maps);
        let page = report_page("<b>bench</b> 3", &report);
        assert!(page.contains("&lt;b&gt;bench&lt;/b&gt; 3"), "names are escaped");
        assert!(page.contains("Bad: frames") && page.contains("swapped_order"));
        assert!(page.contains("maps/gram.png") && page.matches("<rect").count() == 16);
        for forbidden in ["<script", " style=", "<style", "http://www.w3.org/2000/svg\" onload"] {
            assert!(!page.contains(forbidden), "{forbidden}");
        }
    }
}
