//! The predicted quality of frames without ground truth, and the verdict on them.

use serde::{Deserialize, Serialize};

use super::report::{Finding, FindingCode, Grade};

/// The predicted quality of the frames of a snapshot or a job.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Assessment {
    pub grade: Grade,
    /// Predicted PSNR in dB relative to the white level of the job's frames, mean over the frames. Values above 40 dB are
    /// reported as 40 dB. `None`, like the interval, while a finding questions scale, dark or masks.
    pub psnr_db: Option<f64>,
    /// Lower end of the interval that contains the true PSNR in four of five cases, in dB.
    pub psnr_low_db: Option<f64>,
    /// Upper end of that interval, in dB.
    pub psnr_high_db: Option<f64>,
    /// Order of the masks, as far as the motion of the scene shows it; `None` without a test.
    #[serde(default)]
    pub order: Option<MaskOrder>,
    /// Why the scene or the masks do not show the order; `None` unless `order` is `not_verifiable`.
    #[serde(default)]
    pub order_reason: Option<String>,
    /// Findings that limit the quality or the reliability of the prediction.
    pub reasons: Vec<Finding>,
}

/// Evidence for the order of a snapshot's masks from its frames.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord)]
#[derive(Serialize, Deserialize, schemars::JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum MaskOrder {
    /// The frames follow one another more steadily than with any two masks exchanged. The reversed order looks the same.
    Consistent,
    /// The frames do not show the order; `order_reason` says why.
    NotVerifiable,
    /// With two masks exchanged the frames would follow one another much more steadily.
    Doubtful,
}

impl Assessment {
    /// Largest reported PSNR in dB. Differences above it are not visible.
    pub const MAX_PSNR_DB: f64 = 40.0;
    /// Expected PSNR in dB from which frames are graded good.
    pub const GOOD_DB: f64 = 28.0;
    /// Frames are graded bad if the upper end of the interval is below this PSNR in dB.
    pub const BAD_DB: f64 = 22.0;

    /// The assessment of a snapshot without light, whose frames are black or a guess.
    pub fn empty(warnings: &[Finding]) -> Self {
        let mut reasons = warnings.to_vec();
        if !reasons.iter().any(|reason| reason.is(FindingCode::EmptySnapshot)) {
            let title = FindingCode::EmptySnapshot.entry().title;
            reasons.push(Finding::new(FindingCode::EmptySnapshot, title));
        }
        Self {
            grade: Grade::Bad,
            psnr_db: None,
            psnr_low_db: None,
            psnr_high_db: None,
            order: None,
            order_reason: None,
            reasons,
        }
    }

    /// True for a snapshot without light.
    pub fn is_empty(&self) -> bool {
        self.psnr_db.is_none() && self.reasons.iter().any(|one| one.is(FindingCode::EmptySnapshot))
    }

    /// The assessment of a job: the means over its snapshots that have light, and their worst grade; at best `usable` if
    /// some have none. `None` if a snapshot has no assessment. A PSNR is `None` if that of a snapshot is.
    pub fn combined<'a>(snapshots: impl Iterator<Item = Option<&'a Self>>) -> Option<Self> {
        let all = snapshots.collect::<Option<Vec<_>>>().filter(|all| !all.is_empty())?;
        let lit: Vec<_> = all.iter().copied().filter(|one| !one.is_empty()).collect();
        let judged = if lit.is_empty() { &all } else { &lit };
        let best = if lit.len() < all.len() { Grade::Usable } else { Grade::Good };
        let mean = |value: fn(&Self) -> Option<f64>| {
            let sum = judged.iter().map(|one| value(one)).sum::<Option<f64>>();
            sum.map(|sum| Self::round(sum / judged.len() as f64))
        };
        let mut reasons: Vec<Finding> = Vec::new();
        for reason in all.iter().flat_map(|one| &one.reasons) {
            if !reasons.iter().any(|present| present.code == reason.code) {
                reasons.push(reason.clone());
            }
        }
        let order = all.iter().filter_map(|one| one.order).max();
        Some(Self {
            grade: judged.iter().map(|one| one.grade).max()?.max(best),
            psnr_db: mean(|one| one.psnr_db),
            psnr_low_db: mean(|one| one.psnr_low_db),
            psnr_high_db: mean(|one| one.psnr_high_db),
            order,
            order_reason: all
                .iter()
                .filter(|one| one.order == order)
                .find_map(|one| one.order_reason.clone()),
            reasons,
        })
    }

    /// The findings of the checks, and those reasons of an assessment that have other codes.
    pub fn findings(checks: &[Finding], assessment: Option<&Self>) -> Vec<Finding> {
        let mut findings = checks.to_vec();
        for reason in assessment.iter().flat_map(|assessment| &assessment.reasons) {
            if checks.iter().all(|known| known.code != reason.code) {
                findings.push(reason.clone());
            }
        }
        findings
    }

    /// The verdict on frames: the grade of their assessment, or what the findings decide alone. `None` if nothing was found
    /// and no quality can be predicted.
    pub fn verdict(checks: &[Finding], assessment: Option<&Self>) -> Option<Grade> {
        let by_doubts = Grade::by_doubts(&Self::findings(checks, assessment));
        by_doubts.max(assessment.map(|assessment| assessment.grade))
    }

    /// The verdict in a line: its word, the expected PSNR if it can be predicted, the threshold that it missed, and why the
    /// order of the masks was not verified.
    pub fn verdict_text(verdict: Option<Grade>, assessment: Option<&Self>) -> String {
        let word = verdict.map_or("not assessed", |grade| grade.into_str());
        let Some(assessment) = assessment else { return word.to_owned() };
        let Self { psnr_db, psnr_low_db, psnr_high_db, order_reason, .. } = assessment;
        let best = Self::MAX_PSNR_DB;
        let mut text = match (psnr_db, psnr_low_db, psnr_high_db) {
            (Some(psnr), Some(low), Some(high)) if *psnr < best => {
                format!("{word}, expected PSNR {psnr:.1} dB ({low:.1} to {high:.1})")
            }
            (Some(_), Some(low), _) if *low < best => {
                format!("{word}, expected PSNR {best:.0} dB or more ({low:.1} or more)")
            }
            (Some(_), ..) => format!("{word}, expected PSNR {best:.0} dB or more"),
            (None, ..) => format!("{word}, no expected PSNR"),
        };
        let (good, usable) = (Self::GOOD_DB, Self::BAD_DB);
        match verdict {
            Some(Grade::Usable) if psnr_db.is_some_and(|psnr| psnr < good) => {
                text += &format!("; good from {good:.0} dB");
            }
            Some(Grade::Bad) if psnr_high_db.is_some_and(|high| high < usable) => {
                text += &format!("; usable if the interval reaches {usable:.0} dB");
            }
            _ => {}
        }
        if let Some(reason) = order_reason {
            text += &format!("; order of masks not verifiable: {reason}");
        }
        text
    }

    /// Rounds to tenths of a decibel, the precision of the prediction.
    pub fn round(decibels: f64) -> f64 {
        (decibels * 10.0).round() / 10.0
    }
}

#[cfg(test)]
mod tests {
    use super::{Assessment, Finding, Grade, MaskOrder};
    use crate::job::{FindingCode, Severity};

    const GRADED: Assessment = Assessment {
        grade: Grade::Usable,
        psnr_db: Some(31.24),
        psnr_low_db: Some(29.8),
        psnr_high_db: Some(32.9),
        order: None,
        order_reason: None,
        reasons: Vec::new(),
    };

    #[test]
    fn a_verdict_has_the_grade_and_the_expected_psnr() {
        let text = |one: &Assessment| Assessment::verdict_text(Some(one.grade), Some(one));
        assert_eq!(text(&GRADED), "usable, expected PSNR 31.2 dB (29.8 to 32.9)");
        let unordered = Assessment {
            order: Some(MaskOrder::NotVerifiable),
            order_reason: Some("the scene moves too little".into()),
            ..GRADED
        };
        let line = text(&unordered);
        assert!(
            line.ends_with("; order of masks not verifiable: the scene moves too little"),
            "{line}"
        );
        let at = |grade, psnr, low, high| Assessment {
            grade,
            psnr_db: Some(psnr),
            psnr_low_db: Some(low),
            psnr_high_db: Some(high),
            ..GRADED
        };
        let line = text(&at(Grade::Good, 40.0, 38.2, 40.0));
        assert_eq!(line, "good, expected PSNR 40 dB or more (38.2 or more)");
        let line = text(&at(Grade::Good, 40.0, 40.0, 40.0));
        assert_eq!(line, "good, expected PSNR 40 dB or more");
        let withheld = Assessment { grade: Grade::Doubtful, psnr_db: None, ..GRADED };
        assert_eq!(text(&withheld), "doubtful, no expected PSNR");
        let line = text(&at(Grade::Usable, 24.1, 21.1, 26.0));
        assert_eq!(line, "usable, expected PSNR 24.1 dB (21.1 to 26.0); good from 28 dB");
        let line = text(&at(Grade::Bad, 18.0, 15.0, 20.0));
        assert!(line.ends_with("; usable if the interval reaches 22 dB"), "{line}");
        assert_eq!(Assessment::verdict_text(None, None), "not assessed");
        assert_eq!(Assessment::verdict_text(Some(Grade::Bad), None), "bad");
    }

    /// Algorithms without a quality model get the verdict of their findings.
    #[test]
    fn findings_decide_without_a_quality_model() {
        let finding = |code, severity| Finding { severity, ..Finding::new(code, "") };
        let verdict = |code, severity| Assessment::verdict(&[finding(code, severity)], None);
        let (warning, error) = (Severity::Warning, Severity::Error);
        assert_eq!(verdict(FindingCode::DriftedMasks, warning), Some(Grade::Doubtful));
        assert_eq!(verdict(FindingCode::LeftAligned, warning), Some(Grade::Doubtful));
        assert_eq!(verdict(FindingCode::NoDark, error), Some(Grade::Bad));
        assert_eq!(verdict(FindingCode::BadPixels, warning), None);
        assert_eq!(Assessment::verdict(&[], None), None);
        // A check that the assessment does not know lowers its grade.
        let doubt = [finding(FindingCode::NoDark, warning)];
        assert_eq!(Assessment::verdict(&doubt, Some(&GRADED)), Some(Grade::Doubtful));
    }
}
