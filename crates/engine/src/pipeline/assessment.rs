//! The predicted quality of a result without ground truth: PSNR with an interval, a grade, and a map of the expected
//! error.

use ndarray::Array3;
use serde::{Deserialize, Serialize};

use crate::job::{
    Assessment, Dispersion, Finding, FindingCode, Grade, MaskOrder, withholds_quality,
};
pub use reconstruction::assessment::{BLOCK, blocks};
use reconstruction::assessment::{Coverage, Evidence};
use reconstruction::hold_out::Prediction;
use reconstruction::motion::fastest;
use reconstruction::order::Order;
use reconstruction::quality::Model;
use reconstruction::schedule::Schedule;
use reconstruction::sequence::RunShare;
use reconstruction::solver::Outcome;
use reconstruction::tile::TilePlan;

/// The predicted quality of a tile, which is stored with the record of its task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TileAssessment {
    /// Number of block rows and block columns.
    size: (usize, usize),
    /// Expected PSNR of each block \[S B, rows, columns\] on the unit scale of the solver, in steps of 0.25 dB from 0
    /// dB.
    #[serde(with = "hex::serde")]
    levels: Vec<u8>,
    /// Largest motion in pixels per frame.
    #[serde(default)]
    motion: f32,
    /// True if predictions are unreliable behind the masks.
    #[serde(default)]
    unfamiliar: bool,
    /// Prediction of the hold-out pixels, by this tile or by the pilot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    prediction: Option<Prediction>,
    /// Order of the frames, by this tile or by the pilot.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    order: Option<Order>,
}

/// Number of levels per decibel.
const LEVELS_PER_DB: f32 = 4.0;
/// The level of blocks without light, which have no error.
const DARK: u8 = u8::MAX;
/// The level of blocks that were not measured.
const UNMEASURED: u8 = u8::MAX - 1;
/// The level of blocks without an open mask, which do not count.
const CLOSED: u8 = u8::MAX - 2;
/// Expected PSNR of blocks that were not measured, in dB. Half a picture that the priors fill has 6 dB, a tenth 8 to 12 dB.
const UNMEASURED_DB: f64 = 10.0;

impl TileAssessment {
    /// Assesses a tile from the schedule that solved it, the pilot's evidence, and the white level of the scene. `None`
    /// for schedules for which the model is not fitted. A tile without light has frames of 0 and no expected error.
    pub fn of(
        outcome: &Outcome,
        (schedule, evidence, white): (&Schedule, Option<&Evidence>, f32),
    ) -> Option<Self> {
        let model = Model::of(schedule)?;
        let (frames, height, width) = outcome.frames.dim();
        let (rows, columns) = blocks(height, width);
        let evidence = outcome.evidence.as_ref().or(evidence);
        let unfamiliar = outcome.features.iter().any(|piece| piece.unfamiliar);
        let offset = if unfamiliar { model.misses.unfamiliar.offset } else { 0.0 };
        let level = |error: &f32| {
            ((-10.0 * error + offset) * LEVELS_PER_DB).round().clamp(0.0, f32::from(CLOSED - 1))
                as u8
        };
        let mut levels = vec![DARK; frames * rows * columns];
        for piece in &outcome.features {
            let errors = model.log_errors(piece, evidence);
            let levels = levels.iter_mut().skip(piece.first_frame * rows * columns);
            levels.zip(&errors).for_each(|(place, error)| *place = level(error));
        }
        let coverage = outcome.coverage.iter().flat_map(|all| all.indexed_iter());
        let ratio = frames / outcome.coverage.as_ref().map_or(1, |all| all.dim().0.max(1));
        for ((snapshot, row, column), coverage) in coverage {
            let level = match coverage {
                Coverage::Measured => continue,
                Coverage::Dark => DARK,
                Coverage::Unmeasured => UNMEASURED,
                Coverage::Closed => CLOSED,
            };
            for k in snapshot * ratio..(snapshot + 1) * ratio {
                levels[(k * rows + row) * columns + column] = level;
            }
        }
        // The estimate of frames that are mostly wrong is unbounded, and the server refuses impossible records.
        let motion = fastest(outcome.frames.view(), white).max(0.0).min((height + width) as f32);
        let prediction = evidence.and_then(|evidence| evidence.prediction);
        let order = evidence.and_then(|evidence| evidence.order);
        Some(Self { size: (rows, columns), levels, motion, unfamiliar, prediction, order })
    }

    /// True if it has a block structure that `frames` frames of `height` x `width` pixels can have.
    pub fn fits(&self, frames: usize, (height, width): (usize, usize)) -> bool {
        let size = blocks(height, width);
        let fastest = (height + width) as f32;
        self.size == size
            && self.levels.len() == frames * size.0 * size.1
            && (0.0..=fastest).contains(&self.motion)
    }

    /// True if two assessments of equal frames agree to within 1 dB in each block, which allows for rounding on
    /// different processors.
    pub fn agrees_with(&self, other: &Self) -> bool {
        let is_close = |(a, b): (&u8, &u8)| f32::from(a.abs_diff(*b)) <= LEVELS_PER_DB;
        self.size == other.size
            && self.levels.len() == other.levels.len()
            && self.levels.iter().zip(&other.levels).all(is_close)
    }

    /// True if light was measured of a frame.
    fn is_lit(&self, frame: usize) -> bool {
        let blocks = self.size.0 * self.size.1;
        self.levels.iter().skip(frame * blocks).take(blocks).any(|level| *level < CLOSED)
    }

    fn level(&self, frame: usize, row: usize, column: usize) -> u8 {
        let (rows, columns) = self.size;
        self.levels.get((frame * rows + row) * columns + column).copied().unwrap_or(DARK)
    }

    /// Expected squared error of a block, on the unit scale of the solver.
    fn error(&self, frame: usize, row: usize, column: usize) -> f64 {
        let decibels = match self.level(frame, row, column) {
            UNMEASURED => UNMEASURED_DB,
            CLOSED => return 0.0,
            level => f64::from(level) / f64::from(LEVELS_PER_DB),
        };
        10f64.powf(-decibels / 10.0)
    }
}

/// The predicted quality of a snapshot.
#[derive(Debug, Clone, PartialEq)]
pub struct Expected {
    pub assessment: Assessment,
    /// Expected root-mean-square error of each block \[B, rows, columns\], on the scale of the frames.
    pub error: Array3<f32>,
}

/// Combines the assessments of tiles into that of a snapshot. `shares` has the runs that contain the snapshot, each
/// with the assessments of its tiles in the plan's order. `normalisation` is the solver's scale, and `white_level` the peak
/// of the PSNR. With a dispersion, frames are `bands`, which neither move nor have an order in time. A snapshot without
/// light gets no figures. `None` if a tile has none.
pub fn expected(
    plan: &TilePlan,
    shares: &[(RunShare, Vec<Option<TileAssessment>>)],
    (schedule, bands): (&Schedule, Option<&Dispersion>),
    (frames, normalisation, white_level): (usize, f32, f32),
    warnings: &[Finding],
) -> Option<Expected> {
    let model = Model::of(schedule)?;
    let (height, width) = plan.dim();
    let (rows, columns) = blocks(height, width);
    let mut squares = Array3::<f64>::zeros((frames, rows, columns));
    let (mut unmeasured, mut open) = (squares.clone(), squares.clone());
    let block_centre = |index: usize, length: usize| (index * BLOCK + BLOCK / 2).min(length - 1);
    let (mut lit, mut motion) = (false, 0.0f32);
    let mut unfamiliar = bands.is_some_and(Dispersion::has_close_bands);
    let (mut predictions, mut orders) = (Vec::new(), Vec::new());
    for (share, tiles) in shares {
        for (tile, assessed) in plan.tiles().zip(tiles) {
            let assessed = assessed.as_ref()?;
            lit |= (0..frames).any(|k| assessed.is_lit(share.frame(k)));
            if bands.is_none() {
                motion = motion.max(assessed.motion);
                orders.extend(assessed.order);
            }
            unfamiliar |= assessed.unfamiliar;
            predictions.extend(assessed.prediction);
            let weights = plan.weights(&tile);
            let inside = |at: usize, first: usize, length: usize| {
                at.checked_sub(first).filter(|at| *at < length)
            };
            for row in 0..rows {
                let Some(i) = inside(block_centre(row, height), tile.row, tile.height) else {
                    continue;
                };
                for column in 0..columns {
                    let at = inside(block_centre(column, width), tile.column, tile.width);
                    let Some(j) = at else { continue };
                    for k in 0..frames {
                        let weight = f64::from(share.weights[k] * weights[[i, j]]);
                        let block = (share.frame(k), i / BLOCK, j / BLOCK);
                        squares[[k, row, column]] +=
                            weight * assessed.error(block.0, block.1, block.2);
                        let level = assessed.level(block.0, block.1, block.2);
                        if level == UNMEASURED {
                            unmeasured[[k, row, column]] += weight;
                        }
                        if level != CLOSED {
                            open[[k, row, column]] += weight;
                        }
                    }
                }
            }
        }
    }
    // Errors are on the unit scale of the solver.
    let (unit, peak) = (f64::from(normalisation), f64::from(white_level));
    if !lit {
        let error = squares.mapv(|square| (square.sqrt() * unit) as f32);
        return Some(Expected { assessment: Assessment::empty(warnings), error });
    }
    let psnr = |(frame, open): (ndarray::ArrayView2<'_, f64>, ndarray::ArrayView2<'_, f64>)| {
        let mean = frame.sum() / open.sum().max(f64::MIN_POSITIVE);
        -10.0 * (mean.max(1e-12) * (unit / peak).powi(2)).log10()
    };
    let pairs = squares.outer_iter().zip(open.outer_iter());
    let psnr_db = pairs.map(psnr).sum::<f64>() / frames as f64;
    let bound = |offset: f64| (psnr_db + offset).min(Assessment::MAX_PSNR_DB);
    let misses = &model.misses;
    let is_guess = unmeasured.mean() > Some(MAX_UNMEASURED);
    let interval =
        if unfamiliar || is_guess { misses.unfamiliar.interval } else { misses.interval };
    let [low, high] = interval.map(bound);
    let error = squares.mapv(|square| (square.sqrt() * unit) as f32);
    let psnr_db = psnr_db.min(Assessment::MAX_PSNR_DB);
    let unresolved = if bands.is_some() {
        "fine texture or spectral detail"
    } else {
        "fine texture or fast motion"
    };
    let mut reasons = reasons(&error, &unmeasured, psnr_db, peak, unresolved, warnings);
    reasons.extend(unexplained_pixels(&predictions));
    reasons.extend(exchanged_masks(&orders));
    reasons.extend(fast_motion(motion));
    reasons.extend(unfamiliar.then(unfamiliar_masks_finding));
    // An uneven error is an effect of the other causes. A bad calibration may be one of altered values of the masks.
    reasons.sort_by_key(|reason| {
        (reason.is(FindingCode::UnevenError), !reason.is(FindingCode::MaskValues))
    });
    let withheld = withholds_quality(&reasons);
    // This finding states the figures that are withheld.
    reasons.retain(|reason| !(withheld && reason.is(FindingCode::UnevenError)));
    let stated = |decibels| (!withheld).then(|| Assessment::round(decibels));
    let assessment = Assessment {
        grade: grade(psnr_db, high, &reasons),
        psnr_db: stated(psnr_db),
        psnr_low_db: stated(low),
        psnr_high_db: stated(high),
        order: common_order(&orders),
        order_reason: unverifiable_order(&orders, motion).map(str::to_owned),
        reasons,
    };
    Some(Expected { assessment, error })
}

/// The order by the majority of the tiles that show it; `None` if there is no test.
fn common_order(orders: &[Order]) -> Option<MaskOrder> {
    let count = |is: fn(&Order) -> bool| orders.iter().filter(|order| is(order)).count();
    let exchanged = count(|order| matches!(order, Order::Exchanged(..)));
    let consistent = count(|order| *order == Order::Consistent);
    match (exchanged, consistent) {
        _ if orders.is_empty() => None,
        (0, 0) => Some(MaskOrder::NotVerifiable),
        _ if exchanged > consistent => Some(MaskOrder::Doubtful),
        _ => Some(MaskOrder::Consistent),
    }
}

/// The reason why the order of the masks can't be verified; `None` if it can. `motion` is in pixels per frame.
fn unverifiable_order(orders: &[Order], motion: f32) -> Option<&'static str> {
    (common_order(orders) == Some(MaskOrder::NotVerifiable)).then(|| {
        if orders.contains(&Order::SimilarMasks) {
            "the masks resemble one another"
        } else if motion > FAST_MOTION {
            "the scene moves too fast"
        } else {
            "the scene moves too little"
        }
    })
}

/// Reports frames that follow one another much more steadily after an exchange.
fn exchanged_masks(orders: &[Order]) -> Option<Finding> {
    let pair = orders.iter().find_map(|order| match order {
        Order::Exchanged(first, second) => Some((*first, *second)),
        _ => None,
    });
    let (first, second) = pair.filter(|_| common_order(orders) == Some(MaskOrder::Doubtful))?;
    let detail = format!(
        "the frames would follow one another more steadily if frames {first} and {second} (counted from 0) were \
         exchanged. Most likely the masks are in a wrong order or one is missing: count them first. A scene that moves \
         to and fro, and light that flickers from frame to frame, look the same"
    );
    let finding = Finding::new(FindingCode::ExchangedMasks, detail);
    Some(Finding { frames: vec![first, second], ..finding })
}

/// Largest squared error of the frames' prediction of hold-out pixels, relative to the prediction by the pixels around
/// them.
const MAX_UNEXPLAINED: f64 = 1.0;

/// Reports frames that predict hold-out pixels no better than the mean of the pixels around them.
fn unexplained_pixels(predictions: &[Prediction]) -> Option<Finding> {
    let sum = |value: fn(&Prediction) -> f64| predictions.iter().map(value).sum::<f64>();
    let (frames, neighbours) = (sum(|one| one.by_frames), sum(|one| one.by_neighbours));
    (neighbours > 0.0 && frames >= MAX_UNEXPLAINED * neighbours).then(|| {
        let detail = format!(
            "the frames predict pixels that were withheld from the reconstruction with {:.1} times the error of the \
             mean of the pixels around them",
            (frames / neighbours).sqrt()
        );
        Finding::new(FindingCode::UnexplainedPixels, detail)
    })
}

/// The grade by the findings, or else by the expected PSNR, limited by warnings. Frames are graded bad only if the whole interval is below
/// [`Assessment::BAD_DB`], so that usable pictures are not discarded.
fn grade(psnr_db: f64, high: f64, reasons: &[Finding]) -> Grade {
    if let Some(grade) = Grade::by_doubts(reasons) {
        return grade;
    }
    let expected = match psnr_db {
        Assessment::GOOD_DB.. => Grade::Good,
        _ if high >= Assessment::BAD_DB => Grade::Usable,
        _ => Grade::Bad,
    };
    let is_limited = reasons.iter().any(|reason| !reason.is(FindingCode::UnevenError));
    if is_limited { expected.max(Grade::Usable) } else { expected }
}

/// Share of the picture that was not measured from which the expected PSNR is as uncertain as behind unfamiliar masks.
const MAX_UNMEASURED: f64 = 0.01;
/// A part of the picture is reported if its PSNR is this much below that of the whole picture, in dB.
const UNEVEN_DB: f64 = 4.0;

/// The findings of the checks, and the worst part of the picture, from the error and the unmeasured share of each block.
/// `peak` is the peak of the PSNR, and `unresolved` names what the masks may fail to resolve.
fn reasons(
    error: &Array3<f32>,
    unmeasured: &Array3<f64>,
    psnr_db: f64,
    peak: f64,
    unresolved: &str,
    warnings: &[Finding],
) -> Vec<Finding> {
    let mut reasons = warnings.to_vec();
    let (_, rows, columns) = error.dim();
    if rows < 3 || columns < 3 {
        return reasons;
    }
    let thirds = |length: usize| {
        [0..length / 3, length / 3..length - length / 3, length - length / 3..length]
    };
    let (mut worst_db, mut worst_part, mut share) = (f64::INFINITY, "", 0.0);
    for (part_rows, names) in thirds(rows).into_iter().zip(PARTS) {
        for (part_columns, name) in thirds(columns).into_iter().zip(names) {
            let place = ndarray::s![.., part_rows.clone(), part_columns];
            let part = error.slice(place);
            let mean = part.iter().map(|e| f64::from(*e).powi(2)).sum::<f64>() / part.len() as f64;
            let decibels = -10.0 * (mean / peak.powi(2)).max(1e-12).log10();
            if decibels < worst_db {
                (worst_db, worst_part) = (decibels, name);
                share = unmeasured.slice(place).mean().unwrap_or(0.0);
            }
        }
    }
    if worst_db < psnr_db - UNEVEN_DB {
        let cause = match share > MAX_UNMEASURED {
            true => format!("{:.0} % of this part were not measured", 100.0 * share),
            false => format!("the masks do not resolve {unresolved} there"),
        };
        let detail = format!(
            "{worst_part} of the picture has an expected PSNR of {worst_db:.0} dB, the whole picture one of \
             {psnr_db:.0} dB: {cause}"
        );
        reasons.push(Finding::new(FindingCode::UnevenError, detail));
    }
    reasons
}

/// Motion, in pixels per frame, above which frames may be smoother than the scene. A motion of 4 is estimated as at
/// most 5.3, one of 10 as 7 to 14 (`research/NOTEBOOK.md`).
const FAST_MOTION: f32 = 6.0;

fn fast_motion(motion: f32) -> Option<Finding> {
    (motion > FAST_MOTION).then(|| {
        let detail = format!(
            "the scene moves by about {motion:.0} pixels from frame to frame: moving parts may be reconstructed too \
             smooth, which the measurement can't reveal"
        );
        Finding::new(FindingCode::FastMotion, detail)
    })
}

fn unfamiliar_masks_finding() -> Finding {
    let detail = "the masks have a nearly constant sum, or they are highly correlated and not sharp: they are blurred, or \
                  closed pixels let light through. The expected PSNR is often far from the true one behind such masks, so its \
                  interval is wider";
    Finding::new(FindingCode::UnfamiliarMasks, detail)
}

/// Names of the ninths of the picture, by row and column.
const PARTS: [[&str; 3]; 3] = [
    ["the top left", "the top centre", "the top right"],
    ["the left", "the centre", "the right"],
    ["the bottom left", "the bottom centre", "the bottom right"],
];

#[cfg(test)]
mod tests {
    use super::{
        CLOSED, DARK, Prediction, TileAssessment, UNMEASURED, expected, grade, unverifiable_order,
    };
    use crate::job::{Assessment, Finding, FindingCode, Grade, Severity};
    use reconstruction::order::Order;
    use reconstruction::schedule::Schedule;
    use reconstruction::sequence::SequencePlan;
    use reconstruction::tile::TilePlan;

    fn finding(severity: Severity) -> Finding {
        Finding { severity, ..Finding::new(FindingCode::Saturated, "") }
    }

    #[test]
    fn an_assessment_fits_the_frames_that_it_is_of() {
        let one = tile(30);
        let (rows, columns) = (2 * super::BLOCK, 2 * super::BLOCK);
        let frames = one.levels.len() / 4;
        assert!(one.fits(frames, (rows, columns)));
        assert!(!one.fits(frames + 1, (rows, columns)) && !one.fits(frames, (rows, columns + 1)));
        for motion in [f32::NAN, f32::INFINITY, -1.0, 1e30] {
            assert!(!TileAssessment { motion, ..one.clone() }.fits(frames, (rows, columns)));
        }
        assert!(one.agrees_with(&tile(31)) && !one.agrees_with(&tile(32)));
    }

    /// A tile of 2 frames of 32x32 pixels with this expected PSNR.
    fn tile(decibels: u8) -> TileAssessment {
        let (levels, motion) = (vec![4 * decibels; 8], 4.0);
        TileAssessment {
            size: (2, 2),
            levels,
            motion,
            unfamiliar: false,
            prediction: None,
            order: None,
        }
    }

    #[test]
    fn findings_limit_the_grade() {
        let grade_of = |psnr, reasons: &[Finding]| grade(psnr, psnr + 1.5, reasons);
        assert_eq!(
            [30.0, 25.0, 21.0].map(|psnr| grade_of(psnr, &[])),
            [Grade::Good, Grade::Usable, Grade::Usable]
        );
        assert_eq!(grade_of(20.0, &[]), Grade::Bad);
        assert_eq!(grade_of(30.0, &[finding(Severity::Warning)]), Grade::Usable);
        assert_eq!(grade_of(20.0, &[finding(Severity::Warning)]), Grade::Bad);
        assert_eq!(grade_of(30.0, &[finding(Severity::Error)]), Grade::Bad);
        // The figure is withheld, or its scale questioned, so it does not decide the grade.
        for code in [FindingCode::DriftedMasks, FindingCode::NoDark, FindingCode::Level] {
            let doubt = Finding { severity: Severity::Warning, ..Finding::new(code, "") };
            for psnr in [12.0, 25.0, 35.0] {
                assert_eq!(grade_of(psnr, std::slice::from_ref(&doubt)), Grade::Doubtful);
            }
        }
        let uneven = [Finding::new(FindingCode::UnevenError, "")];
        assert_eq!(grade_of(30.0, &uneven), Grade::Good);
    }

    #[test]
    fn an_order_that_can_t_be_verified_has_a_reason() {
        let still = [Order::NotVerifiable; 2];
        assert_eq!(unverifiable_order(&still, 0.2), Some("the scene moves too little"));
        assert_eq!(unverifiable_order(&still, 9.0), Some("the scene moves too fast"));
        let similar = unverifiable_order(&[Order::SimilarMasks; 2], 0.2);
        assert!(similar.unwrap().starts_with("the masks resemble"), "{similar:?}");
        assert_eq!(unverifiable_order(&[Order::NotVerifiable, Order::Consistent], 1.0), None);
        assert_eq!(unverifiable_order(&[], 1.0), None);
    }

    #[test]
    fn tiles_are_combined_and_the_worst_part_is_reported() {
        // 2x2 tiles with an overlap of 16 pixels.
        let plan = TilePlan::new(48, 48, 32, 16).unwrap();
        assert_eq!(plan.len(), 4);
        let shares = SequencePlan::separate(0..1).shares(0, &[], 2);
        let assess_at = |peak, tiles: Vec<Option<TileAssessment>>| {
            let shares = [(shares[0].clone(), tiles)];
            expected(&plan, &shares, (&Schedule::gap_tv(), None), (2, 0.5, peak), &[])
        };
        let assess = |tiles| assess_at(1.0, tiles);
        let tiles =
            |decibels: [u8; 4]| -> Vec<_> { decibels.map(|level| Some(tile(level))).into() };
        let even = assess(tiles([25; 4])).unwrap();
        assert_eq!(even.error.dim(), (2, 3, 3));
        let first = even.error[[0, 0, 0]];
        assert!(
            even.error.iter().all(|error| (error / first - 1.0).abs() < 1e-3),
            "{}",
            even.error
        );
        // The predicted PSNR is the mean of the map.
        let rms = -20.0 * f64::from(first).log10();
        let psnr = even.assessment.psnr_db.unwrap();
        assert!((rms - psnr).abs() < 0.06, "{rms}: {:?}", even.assessment);
        assert!(even.assessment.reasons.is_empty());
        let uneven = assess(tiles([15, 35, 35, 35])).unwrap().assessment;
        assert!(uneven.reasons[0].detail.starts_with("the top left"), "{uneven:?}");
        // The PSNR is relative to the white level.
        let dim = assess_at(0.1, tiles([25; 4])).unwrap();
        assert!((psnr - dim.assessment.psnr_db.unwrap() - 20.0).abs() < 0.06, "{dim:?}");
        assert_eq!(dim.error, even.error);
        // Frames that predict hold-out pixels worse than the pixels around them are bad, and get no figure.
        let predicted = |by_frames| {
            let prediction = Some(Prediction { by_frames, by_neighbours: 2.0 });
            let tiles = tiles([35; 4]).into_iter().flatten();
            let tiles = tiles.map(|tile| Some(TileAssessment { prediction, ..tile })).collect();
            assess(tiles).unwrap().assessment
        };
        assert_eq!(predicted(1.0).grade, Grade::Good);
        let unexplained = predicted(2.0);
        assert_eq!((unexplained.grade, unexplained.psnr_db), (Grade::Bad, None));
        assert_eq!(unexplained.reasons[0].code, "unexplained_pixels");
        let uneven = tiles([15, 35, 35, 35]).into_iter().flatten();
        let prediction = Some(Prediction { by_frames: 2.0, by_neighbours: 2.0 });
        let uneven = uneven.map(|tile| Some(TileAssessment { prediction, ..tile })).collect();
        let codes: Vec<_> = assess(uneven).unwrap().assessment.reasons;
        assert_eq!(codes.len(), 1, "no finding states a withheld figure: {codes:?}");
        // One moving tile suffices.
        let mut fast = tiles([25; 4]);
        fast[1] = fast[1].clone().map(|tile| TileAssessment { motion: 8.6, ..tile });
        let fast = assess(fast).unwrap().assessment;
        assert_eq!((fast.reasons[0].code.as_str(), fast.grade), ("fast_motion", Grade::Usable));
        assert!(fast.reasons[0].detail.contains("about 9 pixels"), "{fast:?}");
        // The interval is wider behind unfamiliar masks.
        let other = tiles([25; 4]).into_iter().flatten();
        let other = other.map(|tile| Some(TileAssessment { unfamiliar: true, ..tile })).collect();
        let other = assess(other).unwrap().assessment;
        assert_eq!(
            (other.reasons[0].code.as_str(), other.grade),
            ("unfamiliar_masks", Grade::Usable)
        );
        let below = other.psnr_db.zip(other.psnr_low_db).map(|(psnr, low)| psnr - low);
        assert!(below > Some(5.9), "{other:?}");
        // Without the assessment of one tile there is none of the snapshot.
        let mut incomplete = tiles([25; 4]);
        incomplete[2] = None;
        assert!(assess(incomplete).is_none());
        // Tiles without light do not contribute, and no figure is stated of a snapshot without light.
        let all = |level| Some(TileAssessment { levels: vec![level; 8], motion: 0.0, ..tile(0) });
        for level in [DARK, UNMEASURED, CLOSED] {
            let empty = assess(vec![all(level); 4]).unwrap().assessment;
            assert_eq!((empty.grade, empty.psnr_db), (Grade::Bad, None));
            assert!(empty.is_empty(), "{empty:?}");
        }
        let mut lit = tiles([25; 4]);
        lit[3] = all(DARK);
        let lit = assess(lit).unwrap();
        assert!(lit.error[[0, 2, 2]] < 0.1 * lit.error[[0, 0, 0]]);
        // Tiles that were not measured lower the figure, and widen its interval.
        let mut closed = tiles([25; 4]);
        closed[3] = all(CLOSED);
        let closed = assess(closed).unwrap().assessment.psnr_db.unwrap();
        assert!((closed - psnr).abs() < 0.2, "{closed}: closed areas do not count");
        let mut partial = tiles([35; 4]);
        partial[3] = all(UNMEASURED);
        let partial = assess(partial).unwrap().assessment;
        assert!(partial.psnr_db < Some(26.0) && !partial.is_empty(), "{partial:?}");
        assert!(
            partial.psnr_db.zip(partial.psnr_low_db).is_some_and(|(psnr, low)| psnr - low > 5.0)
        );
        assert!(partial.reasons[0].detail.ends_with("% of this part were not measured"));
    }

    #[test]
    fn jobs_get_the_grade_of_their_worst_snapshot() {
        let one = |psnr_db, grade, reasons: &[Finding]| Assessment {
            grade,
            psnr_db: Some(psnr_db),
            psnr_low_db: Some(psnr_db - 3.0),
            psnr_high_db: Some(psnr_db + 3.0),
            order: None,
            order_reason: None,
            reasons: reasons.to_vec(),
        };
        let warned = [finding(Severity::Warning)];
        let all = [one(30.0, Grade::Good, &warned), one(20.05, Grade::Bad, &warned)];
        let job = Assessment::combined(all.iter().map(Some)).unwrap();
        assert_eq!((job.grade, job.psnr_db, job.reasons.len()), (Grade::Bad, Some(25.0), 1));
        let withheld = Assessment { psnr_db: None, ..all[0].clone() };
        let job = Assessment::combined([Some(&withheld), Some(&all[1])].into_iter()).unwrap();
        assert_eq!((job.psnr_db, job.psnr_low_db), (None, Some(22.0)));
        assert_eq!(Assessment::combined([Some(&all[0]), None].into_iter()), None);
        // A snapshot without light has no figures, and those of the others stay.
        let empty = Assessment::empty(&[]);
        let good = one(30.0, Grade::Good, &[]);
        let job = Assessment::combined([Some(&good), Some(&empty)].into_iter()).unwrap();
        assert_eq!((job.grade, job.psnr_db), (Grade::Usable, Some(30.0)));
        assert_eq!(job.reasons[0].code, "empty_snapshot");
        let job = Assessment::combined([Some(&empty), Some(&empty)].into_iter()).unwrap();
        assert_eq!((job.grade, job.psnr_db), (Grade::Bad, None));
        assert_eq!(Assessment::combined(std::iter::empty()), None);
    }
}
