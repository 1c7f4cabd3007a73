//! How good a result is, told without a truth: a predicted PSNR with its interval, a grade in words, and a
//! map of the expected error.

use ndarray::Array3;
use serde::{Deserialize, Serialize};

use crate::job::{Assessment, Finding, Grade, Severity};
pub use reconstruction::assessment::{BLOCK, blocks};
use reconstruction::assessment::{Evidence, Model, unfamiliar_masks};
use reconstruction::motion::fastest;
use reconstruction::schedule::Schedule;
use reconstruction::sequence::RunShare;
use reconstruction::solver::Outcome;
use reconstruction::tile::TilePlan;

/// What a tile's frames let expect, as it is kept with the record of its task.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct TileAssessment {
    /// Rows and columns of blocks.
    size: (usize, usize),
    /// The expected PSNR of each block \[S B, rows, columns\] on the scale on which the scene is on \[0,1\], in steps
    /// of a quarter of a decibel from 0.
    #[serde(with = "hex::serde")]
    levels: Vec<u8>,
    /// How fast the frames move at most, in pixels a frame.
    #[serde(default)]
    motion: f32,
    /// Whether predictions are uncertain behind its masks.
    #[serde(default)]
    unfamiliar: bool,
}

/// Levels in a decibel.
const STEPS: f32 = 4.0;
/// The level where no light is, and no error.
const DARK: u8 = u8::MAX;

impl TileAssessment {
    /// Of a tile solved by this schedule, with what the pilot tells of it, and the scene's white level; none for a
    /// schedule that predictions were not fitted to. Of a tile that no light reaches, whose frames are 0, no error is
    /// expected.
    pub fn of(
        outcome: &Outcome,
        (schedule, evidence, white): (&Schedule, Option<&Evidence>, f32),
    ) -> Option<Self> {
        let model = Model::of(schedule)?;
        let Some(features) = &outcome.features else {
            let (frames, height, width) = outcome.frames.dim();
            let size = blocks(height, width);
            let levels = vec![DARK; frames * size.0 * size.1];
            return Some(Self { size, levels, motion: 0.0, unfamiliar: false });
        };
        let errors = model.log_errors(features, outcome.evidence.as_ref().or(evidence), white);
        let unfamiliar = unfamiliar_masks(features);
        let offset = if unfamiliar { model.unfamiliar.offset } else { 0.0 };
        let level =
            |error: &f32| ((-10.0 * error + offset) * STEPS).round().clamp(0.0, 254.0) as u8;
        let (_, rows, columns) = errors.dim();
        let motion = fastest(outcome.frames.view(), white);
        let levels = errors.iter().map(level).collect();
        Some(Self { size: (rows, columns), levels, motion, unfamiliar })
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
        let near = |(a, b): (&u8, &u8)| f32::from(a.abs_diff(*b)) <= STEPS;
        self.size == other.size
            && self.levels.len() == other.levels.len()
            && self.levels.iter().zip(&other.levels).all(near)
    }

    fn is_dark(&self) -> bool {
        self.levels.iter().all(|level| *level == DARK)
    }

    /// Expected squared error of a block, on the scale on which the scene is on \[0,1\].
    fn error(&self, frame: usize, row: usize, column: usize) -> f64 {
        let (rows, columns) = self.size;
        let level = self.levels.get((frame * rows + row) * columns + column);
        10f64.powf(-f64::from(*level.unwrap_or(&DARK)) / f64::from(10.0 * STEPS))
    }
}

/// What is expected of a snapshot.
#[derive(Debug, Clone, PartialEq)]
pub struct Expected {
    pub assessment: Assessment,
    /// Root of the mean squared error of each block \[B, rows, columns\], on the scale of the frames.
    pub error: Array3<f32>,
}

/// Better is not told apart, in dB: nobody sees it.
const BEST: f64 = 40.0;

/// From here on frames are good, and bad if even the upper end of the interval is below that, in dB.
const GOOD: f64 = 28.0;
const BAD: f64 = 22.0;

/// What the tiles of a snapshot tell together: of each run that has a share in it those of its tiles, in the
/// plan's order. None if one of them tells nothing.
pub fn expected(
    plan: &TilePlan,
    shares: &[(RunShare, Vec<Option<TileAssessment>>)],
    schedule: &Schedule,
    (frames, white): (usize, f32),
    warnings: &[Finding],
) -> Option<Expected> {
    let model = Model::of(schedule)?;
    let (height, width) = plan.dim();
    let (rows, columns) = blocks(height, width);
    let mut squares = Array3::<f64>::zeros((frames, rows, columns));
    let middle = |index: usize, length: usize| (index * BLOCK + BLOCK / 2).min(length - 1);
    let (mut lit, mut motion, mut unfamiliar) = (false, 0.0f32, false);
    for (share, tiles) in shares {
        for (tile, assessed) in plan.tiles().zip(tiles) {
            let assessed = assessed.as_ref()?;
            lit |= !assessed.is_dark();
            motion = motion.max(assessed.motion);
            unfamiliar |= assessed.unfamiliar;
            let weights = plan.weights(&tile);
            let inside = |at: usize, first: usize, length: usize| {
                at.checked_sub(first).filter(|at| *at < length)
            };
            for row in 0..rows {
                let Some(i) = inside(middle(row, height), tile.row, tile.height) else { continue };
                for column in 0..columns {
                    let at = inside(middle(column, width), tile.column, tile.width);
                    let Some(j) = at else { continue };
                    for k in 0..frames {
                        let weight = f64::from(share.weights[k] * weights[[i, j]]);
                        let error = assessed.error(share.frame(k), i / BLOCK, j / BLOCK);
                        squares[[k, row, column]] += weight * error;
                    }
                }
            }
        }
    }
    if !lit {
        return None;
    }
    let white = f64::from(white);
    let psnr = |frame: ndarray::ArrayView2<'_, f64>| {
        -10.0 * (frame.mean().unwrap_or(0.0).max(1e-12) * white * white).log10()
    };
    let psnr_db = squares.outer_iter().map(psnr).sum::<f64>() / frames as f64;
    let end = |further: f64| (psnr_db + further).min(BEST);
    let interval = if unfamiliar { model.unfamiliar.interval } else { model.interval };
    let [low, high] = interval.map(end);
    let error = squares.mapv(|square| (square.sqrt() * white) as f32);
    let psnr_db = psnr_db.min(BEST);
    let mut reasons = reasons(&error, (psnr_db, white), warnings);
    reasons.extend(too_fast(motion));
    reasons.extend(unfamiliar.then(other_masks));
    let assessment = Assessment {
        grade: grade((psnr_db, high), &reasons),
        psnr_db: Assessment::round(psnr_db),
        psnr_low_db: Assessment::round(low),
        psnr_high_db: Assessment::round(high),
        reasons,
    };
    Some(Expected { assessment, error })
}

/// What is expected, but never better than the findings allow. Frames are called bad only where the whole
/// interval says so, lest somebody throws away a usable picture.
fn grade((psnr_db, high): (f64, f64), reasons: &[Finding]) -> Grade {
    let expected = match psnr_db {
        GOOD.. => Grade::Good,
        _ if high >= BAD => Grade::Usable,
        _ => Grade::Bad,
    };
    let worst = reasons.iter().filter(|reason| reason.code != UNEVEN).map(|reason| reason.severity);
    match worst.max() {
        Some(Severity::Error) => Grade::Bad,
        Some(Severity::Warning) if expected == Grade::Good => Grade::Usable,
        _ => expected,
    }
}

const UNEVEN: &str = "uneven_error";
/// A part of the picture whose error is so far above that of the whole is named, in dB.
const UNEVEN_DB: f64 = 4.0;

const LEVEL: &str = "level";
/// A scene whose white is below this is hardly exposed, or its full scale is another one.
const DIM: f64 = 0.12;

/// The findings of the checks, a scale that looks wrong, and the part of the picture that is worst.
fn reasons(
    error: &Array3<f32>,
    (psnr_db, white): (f64, f64),
    warnings: &[Finding],
) -> Vec<Finding> {
    let mut reasons = warnings.to_vec();
    if white < DIM && reasons.iter().all(|reason| reason.code != LEVEL) {
        reasons.push(Finding {
            code: LEVEL.to_owned(),
            severity: Severity::Warning,
            detail: format!(
                "the brightest parts of the scene are at {white:.3} times the full scale, and errors are told on that \
                 scale"
            ),
            remedy: "State the measurement's full_scale for its exposure and its bits.".to_owned(),
            frames: Vec::new(),
            snapshot: None,
        });
    }
    let (_, rows, columns) = error.dim();
    if rows < 3 || columns < 3 {
        return reasons;
    }
    let thirds = |length: usize| {
        [0..length / 3, length / 3..length - length / 3, length - length / 3..length]
    };
    let mut worst = (f64::INFINITY, "");
    for (band, names) in thirds(rows).into_iter().zip(PARTS) {
        for (across, name) in thirds(columns).into_iter().zip(names) {
            let part = error.slice(ndarray::s![.., band.clone(), across]);
            let mean = part.iter().map(|e| f64::from(*e).powi(2)).sum::<f64>() / part.len() as f64;
            let decibels = -10.0 * mean.max(1e-12).log10();
            if decibels < worst.0 {
                worst = (decibels, name);
            }
        }
    }
    if worst.0 < psnr_db - UNEVEN_DB {
        reasons.push(Finding {
            code: UNEVEN.to_owned(),
            severity: Severity::Warning,
            detail: format!(
                "{} is expected at {:.0} dB, the whole picture at {psnr_db:.0} dB: there is fine texture or fast motion \
                 that the masks do not resolve",
                worst.1, worst.0
            ),
            remedy: "Look at the map of the expected error before relying on this part.".to_owned(),
            frames: Vec::new(),
            snapshot: None,
        });
    }
    reasons
}

/// Frames that move by so much, in pixels a frame, may be smoother than the scene. Motion by 4 is told as up
/// to 5.3, motion by 10 as 7 to 14 (`research/NOTEBOOK.md`).
const FAST: f32 = 6.0;

fn too_fast(motion: f32) -> Option<Finding> {
    (motion > FAST).then(|| Finding {
        code: "fast_motion".to_owned(),
        severity: Severity::Warning,
        detail: format!(
            "there is motion of about {motion:.0} pixels from frame to frame: what moves so fast may come out smoother than \
             it is, and no measurement tells"
        ),
        remedy: "Take shorter frames, or fewer of them in a snapshot.".to_owned(),
        frames: Vec::new(),
        snapshot: None,
    })
}

fn other_masks() -> Finding {
    Finding {
        code: "unfamiliar_masks".to_owned(),
        severity: Severity::Warning,
        detail: "the masks are much alike and not sharp: they are blurred, or their closed pixels let light through. Behind \
                 such masks the expected PSNR is often far from the truth, and the interval wider"
            .to_owned(),
        remedy:
            "Don't rely on the expected PSNR here; simulate a scene like yours behind these masks."
                .to_owned(),
        frames: Vec::new(),
        snapshot: None,
    }
}

const PARTS: [[&str; 3]; 3] = [
    ["the upper left", "the upper middle", "the upper right"],
    ["the left", "the middle", "the right"],
    ["the lower left", "the lower middle", "the lower right"],
];

#[cfg(test)]
mod tests {
    use super::{DARK, TileAssessment, expected, grade};
    use crate::job::{Assessment, Finding, Grade, Severity};
    use reconstruction::schedule::Schedule;
    use reconstruction::sequence::SequencePlan;
    use reconstruction::tile::TilePlan;

    fn finding(severity: Severity) -> Finding {
        let text = String::new;
        let code = "any".to_owned();
        Finding { code, severity, detail: text(), remedy: text(), frames: vec![], snapshot: None }
    }

    /// A tile of 2 frames of 32x32 pixels with this level in dB.
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

    fn tile(decibels: u8) -> TileAssessment {
        let (levels, motion) = (vec![4 * decibels; 8], 4.0);
        TileAssessment { size: (2, 2), levels, motion, unfamiliar: false }
    }

    #[test]
    fn what_the_checks_found_bounds_the_grade() {
        let of = |psnr, found: &[Finding]| grade((psnr, psnr + 1.5), found);
        assert_eq!(
            [30.0, 25.0, 21.0].map(|psnr| of(psnr, &[])),
            [Grade::Good, Grade::Usable, Grade::Usable]
        );
        assert_eq!(of(20.0, &[]), Grade::Bad);
        assert_eq!(of(30.0, &[finding(Severity::Warning)]), Grade::Usable);
        assert_eq!(of(20.0, &[finding(Severity::Warning)]), Grade::Bad);
        assert_eq!(of(30.0, &[finding(Severity::Error)]), Grade::Bad);
    }

    #[test]
    fn tiles_are_joined_and_the_worst_part_is_named() {
        // Two by two, which share 16 pixels.
        let plan = TilePlan::new(48, 48, 32, 16).unwrap();
        assert_eq!(plan.len(), 4);
        let shares = SequencePlan::separate(0..1).shares(0, &[], 2);
        let of = |white, tiles: Vec<Option<TileAssessment>>| {
            let of_run = [(shares[0].clone(), tiles)];
            expected(&plan, &of_run, &Schedule::gap_tv(), (2, white), &[])
        };
        let map = |tiles| of(0.5, tiles);
        let tiles =
            |decibels: [u8; 4]| -> Vec<_> { decibels.map(|level| Some(tile(level))).into() };
        let even = map(tiles([25; 4])).unwrap();
        assert_eq!(even.error.dim(), (2, 3, 3));
        let first = even.error[[0, 0, 0]];
        assert!(
            even.error.iter().all(|error| (error / first - 1.0).abs() < 1e-3),
            "{}",
            even.error
        );
        // The mean of the map is what is predicted.
        let rms = -20.0 * f64::from(first).log10();
        assert!((rms - even.assessment.psnr_db).abs() < 0.06, "{rms}: {:?}", even.assessment);
        assert!(even.assessment.reasons.is_empty());
        let uneven = map(tiles([15, 35, 35, 35])).unwrap().assessment;
        assert!(uneven.reasons[0].detail.starts_with("the upper left"), "{uneven:?}");
        // On a scale that is ten times too large every error is small.
        let dim = of(0.05, tiles([25; 4])).unwrap().assessment;
        assert_eq!((dim.reasons[0].code.as_str(), dim.grade), ("level", Grade::Usable), "{dim:?}");
        // One tile that moves is enough.
        let mut fast = tiles([25; 4]);
        fast[1] = fast[1].clone().map(|tile| TileAssessment { motion: 8.6, ..tile });
        let fast = map(fast).unwrap().assessment;
        assert_eq!((fast.reasons[0].code.as_str(), fast.grade), ("fast_motion", Grade::Usable));
        assert!(fast.reasons[0].detail.contains("about 9 pixels"), "{fast:?}");
        // Behind masks that are much alike and not sharp there is more to doubt.
        let other = tiles([25; 4]).into_iter().flatten();
        let other = other.map(|tile| Some(TileAssessment { unfamiliar: true, ..tile })).collect();
        let other = map(other).unwrap().assessment;
        assert_eq!(
            (other.reasons[0].code.as_str(), other.grade),
            ("unfamiliar_masks", Grade::Usable)
        );
        assert!(other.psnr_db - other.psnr_low_db > 5.9, "{other:?}");
        // A tile of an older version tells nothing; one without light has no part in what is seen.
        let mut partly = tiles([25; 4]);
        partly[2] = None;
        assert!(map(partly).is_none());
        let (levels, motion) = (vec![DARK; 8], 0.0);
        let dark = TileAssessment { size: (2, 2), levels, motion, unfamiliar: false };
        assert!(map(vec![Some(dark.clone()); 4]).is_none());
        let mut lit = tiles([25; 4]);
        lit[3] = Some(dark);
        let lit = map(lit).unwrap();
        assert!(lit.error[[0, 2, 2]] < 0.1 * lit.error[[0, 0, 0]]);
    }

    #[test]
    fn a_job_is_as_good_as_its_worst_snapshot() {
        let one = |psnr_db, grade, reasons: &[Finding]| Assessment {
            grade,
            psnr_db,
            psnr_low_db: psnr_db - 3.0,
            psnr_high_db: psnr_db + 3.0,
            reasons: reasons.to_vec(),
        };
        let warned = [finding(Severity::Warning)];
        let all = [one(30.0, Grade::Good, &warned), one(20.05, Grade::Bad, &warned)];
        let job = Assessment::of_all(all.iter().map(Some)).unwrap();
        assert_eq!((job.grade, job.psnr_db, job.reasons.len()), (Grade::Bad, 25.0, 1));
        assert_eq!(Assessment::of_all([Some(&all[0]), None].into_iter()), None);
        assert_eq!(Assessment::of_all(std::iter::empty()), None);
    }
}
