//! The noise experiment as a chart.

use maud::{Markup, html};

use super::noise::{Curve, Record};

const WIDTH: f64 = 640.0;
const HEIGHT: f64 = 400.0;
/// Room for labels: left, right, top, bottom.
const MARGIN: [f64; 4] = [60.0, 20.0, 60.0, 50.0];
const COLOURS: [&str; 2] = ["#0b57a8", "#b3541e"];

/// From noise level and PSNR to places on the chart.
struct Axes {
    sigma: (f64, f64),
    psnr: (f64, f64),
}

impl Axes {
    fn of(record: &Record) -> Self {
        let span = |values: &mut dyn Iterator<Item = f64>| {
            values.fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), value| {
                (low.min(value), high.max(value))
            })
        };
        let sigma = span(&mut record.sigmas.iter().map(|&sigma| f64::from(sigma)));
        let psnr = span(&mut record.curves.iter().flat_map(|curve| curve.psnr_db.iter().copied()));
        let wide = |(low, high): (f64, f64), least: f64| (low, high.max(low + least));
        Self {
            sigma: wide(sigma, 1.0),
            psnr: wide((psnr.0.floor() - 1.0, psnr.1.ceil() + 1.0), 1.0),
        }
    }

    fn x(&self, sigma: f64) -> f64 {
        let share = (sigma - self.sigma.0) / (self.sigma.1 - self.sigma.0);
        MARGIN[0] + share * (WIDTH - MARGIN[0] - MARGIN[1])
    }

    fn y(&self, psnr: f64) -> f64 {
        let share = (psnr - self.psnr.0) / (self.psnr.1 - self.psnr.0);
        HEIGHT - MARGIN[3] - share * (HEIGHT - MARGIN[2] - MARGIN[3])
    }
}

/// The chart as a file of its own.
pub(super) fn svg(record: &Record) -> String {
    let axes = Axes::of(record);
    let sigmas: Vec<f64> = record.sigmas.iter().map(|&sigma| f64::from(sigma)).collect();
    let chart = html! {
        svg xmlns="http://www.w3.org/2000/svg" width=(WIDTH) height=(HEIGHT)
            font-family="sans-serif" font-size="12" {
            rect width=(WIDTH) height=(HEIGHT) fill="#fff" {}
            (grid(&axes, &sigmas))
            @for (index, curve) in record.curves.iter().enumerate() {
                (line(&axes, &sigmas, curve, index))
            }
            text x=((WIDTH + MARGIN[0]) / 2.0) y=(HEIGHT - 12.0) text-anchor="middle" {
                "noise sigma on the scale of 255"
            }
            text x="14" y=(HEIGHT / 2.0) text-anchor="middle"
                transform={ "rotate(-90 14 " (HEIGHT / 2.0) ")" } {
                "PSNR in dB (" (record.algorithm) ")"
            }
        }
    };
    chart.into_string() + "\n"
}

fn grid(axes: &Axes, sigmas: &[f64]) -> Markup {
    #[allow(clippy::cast_possible_truncation)] // decibels
    let levels = axes.psnr.0 as i32..=axes.psnr.1 as i32;
    let (left, right) = (MARGIN[0], WIDTH - MARGIN[1]);
    let bottom = HEIGHT - MARGIN[3];
    html! {
        @for level in levels.step_by(2) {
            @let y = axes.y(f64::from(level));
            line x1=(left) y1=(y) x2=(right) y2=(y) stroke="#ddd" {}
            text x=(left - 6.0) y=(y + 4.0) text-anchor="end" { (level) }
        }
        @for sigma in sigmas {
            @let x = axes.x(*sigma);
            line x1=(x) y1=(bottom) x2=(x) y2=(bottom + 5.0) stroke="#333" {}
            text x=(x) y=(bottom + 18.0) text-anchor="middle" { (sigma) }
        }
        line x1=(left) y1=(bottom) x2=(right) y2=(bottom) stroke="#333" {}
    }
}

fn line(axes: &Axes, sigmas: &[f64], curve: &Curve, index: usize) -> Markup {
    let places: Vec<(f64, f64)> =
        sigmas.iter().zip(&curve.psnr_db).map(|(&s, &p)| (axes.x(s), axes.y(p))).collect();
    let points: Vec<String> = places.iter().map(|(x, y)| format!("{x:.1},{y:.1}")).collect();
    let colour = COLOURS[index % COLOURS.len()];
    let label = 22.0 + 18.0 * index as f64;
    html! {
        polyline points=(points.join(" ")) fill="none" stroke=(colour) stroke-width="2" {}
        @for (x, y) in &places { circle cx=(format!("{x:.1}")) cy=(format!("{y:.1}")) r="3" fill=(colour) {} }
        line x1=(MARGIN[0]) y1=(label - 4.0) x2=(MARGIN[0] + 24.0) y2=(label - 4.0) stroke=(colour) stroke-width="2" {}
        text x=(MARGIN[0] + 30.0) y=(label) { (curve.masks) }
    }
}
