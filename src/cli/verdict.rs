//! Formats findings and verdicts for all commands.

use std::collections::BTreeSet;
use std::fmt::Write;

use super::CliError;
use super::client::Job;
use super::error::Result;
use super::fields::{as_options, role_of};
use engine::job::{Assessment, Finding, Grade, JobState, MaskOrder, Severity};

/// Snapshots after the first that the line of a finding lists. Further ones are counted.
const NAMED_SNAPSHOTS: usize = 8;

/// Formats each finding as one line with its remedy. Findings with the same code share a line if they are about
/// snapshots.
pub(super) fn lines(findings: &[Finding]) -> Vec<String> {
    let mut groups: Vec<(&Finding, Vec<u32>)> = Vec::new();
    for finding in findings {
        let same = groups.iter_mut().find(|(first, _)| {
            first.code == finding.code && first.snapshot.is_some() && finding.snapshot.is_some()
        });
        match same {
            Some((_, snapshots)) => snapshots.extend(finding.snapshot),
            None => groups.push((finding, finding.snapshot.into_iter().collect())),
        }
    }
    groups.into_iter().map(|(finding, snapshots)| line(finding, &snapshots)).collect()
}

fn line(finding: &Finding, snapshots: &[u32]) -> String {
    let severity = match finding.severity {
        Severity::Error => "error",
        Severity::Warning => "warning",
    };
    let mut prefix = String::new();
    if let [first, others @ ..] = snapshots {
        let _ = write!(prefix, "snapshot {first}: ");
        if !others.is_empty() {
            let named: Vec<String> =
                others.iter().take(NAMED_SNAPSHOTS).map(ToString::to_string).collect();
            let further = others.len().saturating_sub(NAMED_SNAPSHOTS);
            let further = if further > 0 { format!(" and {further} more") } else { String::new() };
            prefix = format!("snapshots {first}, {}{further}: ", named.join(", "));
        }
    }
    let Finding { code, .. } = finding;
    let role = role_of(code);
    let (detail, remedy) = (as_options(&finding.detail, role), as_options(&finding.remedy, role));
    let (detail, remedy) = (detail.trim_end_matches('.'), remedy.trim_end_matches('.'));
    format!("{severity} {code}: {prefix}{detail}. Remedy: {remedy}.")
}

/// The grade, with the expected PSNR if it can be predicted, and whether the order of the masks was verified.
pub(super) fn verdict(assessment: Option<&Assessment>, findings: &[Finding]) -> String {
    match assessment {
        Some(assessment) => {
            let Assessment { grade, psnr_db, psnr_low_db, psnr_high_db, order, .. } = assessment;
            let grade = grade.into_str();
            let best = Assessment::MAX_PSNR_DB;
            let mut text = match (psnr_db, psnr_low_db, psnr_high_db) {
                (Some(psnr), Some(low), Some(high)) if *psnr < best => {
                    format!("{grade}, expected PSNR {psnr:.1} dB ({low:.1} to {high:.1})")
                }
                (Some(_), Some(low), _) if *low < best => {
                    format!("{grade}, expected PSNR {best:.0} dB or more ({low:.1} or more)")
                }
                (Some(_), ..) => format!("{grade}, expected PSNR {best:.0} dB or more"),
                (None, ..) => format!("{grade}, no expected PSNR"),
            };
            if let Some(threshold) = missed(assessment) {
                text += &format!("; {threshold}");
            }
            if *order == Some(MaskOrder::NotVerifiable) {
                text += "; order of masks not verifiable: the scene moves too little or too fast";
            }
            text
        }
        None if !errors(findings).is_empty() => "bad".to_owned(),
        None => "not assessed".to_owned(),
    }
}

/// The threshold of the next better grade, if the expected PSNR has missed it.
fn missed(assessment: &Assessment) -> Option<String> {
    let Assessment { grade, psnr_db, psnr_high_db, .. } = assessment;
    let (good, usable) = (Assessment::GOOD_DB, Assessment::BAD_DB);
    match grade {
        Grade::Usable if psnr_db.is_some_and(|psnr| psnr < good) => {
            Some(format!("good from {good:.0} dB"))
        }
        Grade::Bad if psnr_high_db.is_some_and(|high| high < usable) => {
            Some(format!("usable if the interval reaches {usable:.0} dB"))
        }
        _ => None,
    }
}

/// The word for a state. Only the verdict says whether the frames are good, so `succeeded` reads "finished".
pub(super) fn state_word(state: JobState) -> &'static str {
    match state {
        JobState::Succeeded => "finished",
        other => other.into_str(),
    }
}

/// The findings of the checks, and those reasons of an assessment that have other codes.
pub(super) fn merge(checks: &[Finding], assessment: Option<&Assessment>) -> Vec<Finding> {
    let mut findings = checks.to_vec();
    for reason in assessment.iter().flat_map(|assessment| &assessment.reasons) {
        if checks.iter().all(|known| known.code != reason.code) {
            findings.push(reason.clone());
        }
    }
    findings
}

/// The codes of the errors among findings. The same error of several snapshots counts once.
fn errors(findings: &[Finding]) -> BTreeSet<&str> {
    let errors = findings.iter().filter(|finding| finding.severity == Severity::Error);
    errors.map(|finding| finding.code.as_str()).collect()
}

/// Returns the error for exit code 3 if the checks of a result found errors, or if its grade is bad.
pub(super) fn refuse_bad<'a>(
    results: impl IntoIterator<Item = (&'a [Finding], Option<&'a Assessment>)>,
) -> Result<()> {
    let (mut codes, mut is_bad) = (BTreeSet::new(), false);
    for (findings, assessment) in results {
        codes.extend(errors(findings));
        is_bad |= assessment.is_some_and(|assessment| assessment.grade == Grade::Bad);
    }
    let codes: Vec<&str> = codes.into_iter().collect();
    match codes.as_slice() {
        [] if is_bad => Err(CliError::ErrorsFound(
            "the verdict is bad: the expected PSNR is too low; see docs/DATA.md, section Expected PSNR".into(),
        )),
        [] => Ok(()),
        _ => {
            let text = format!("the checks found {}: results will be wrong", codes.join(", "));
            Err(CliError::ErrorsFound(text))
        }
    }
}

impl Job {
    pub(super) fn findings(&self) -> Vec<Finding> {
        merge(&self.warnings, self.assessment.as_ref())
    }

    /// The verdict of a job that has succeeded.
    pub(super) fn verdict(&self) -> Option<String> {
        let verdict = || verdict(self.assessment.as_ref(), &self.findings());
        (self.state == JobState::Succeeded).then(verdict)
    }

    /// Identifier, verdict and state, and an indented line for each finding.
    pub(super) fn summary(&self) -> String {
        let verdict = self.verdict().map(|verdict| format!("{verdict}; ")).unwrap_or_default();
        let findings = lines(&self.findings());
        let findings = findings.iter().map(|line| format!("\n    {line}")).collect::<String>();
        format!("{}: {verdict}{}{findings}", self.id, state_word(self.state))
    }
}

#[cfg(test)]
mod tests {
    use super::{lines, refuse_bad, verdict};
    use engine::job::{Assessment, Finding, Grade, MaskOrder, Severity};

    fn finding(code: &str, severity: Severity, snapshot: Option<u32>) -> Finding {
        let (code, detail, remedy) = (code.to_owned(), "light is missing".into(), "add it.".into());
        Finding { code, severity, detail, remedy, frames: Vec::new(), snapshot }
    }

    #[test]
    fn each_finding_has_one_line_with_its_remedy() {
        let mut findings = vec![finding("bad_calibration", Severity::Error, None)];
        findings.extend((0..3).map(|k| finding("no_dark", Severity::Warning, Some(k))));
        assert_eq!(
            lines(&findings),
            [
                "error bad_calibration: light is missing. Remedy: add it.",
                "warning no_dark: snapshots 0, 1, 2: light is missing. Remedy: add it.",
            ]
        );
        let many: Vec<_> = (0..12).map(|k| finding("level", Severity::Error, Some(k))).collect();
        assert!(lines(&many)[0].contains("snapshots 0, 1, 2, 3, 4, 5, 6, 7, 8 and 3 more:"));
    }

    #[test]
    fn errors_end_a_command_with_three() {
        let (warning, error) = (
            [finding("a", Severity::Warning, None)],
            [finding("b", Severity::Error, None), finding("c", Severity::Error, None)],
        );
        assert!(refuse_bad([(&warning[..], None)]).is_ok());
        let refused = refuse_bad([(&warning[..], None), (&error, None)]).unwrap_err();
        assert!(refused.to_string().contains("found b, c:"), "{refused}");
        assert_eq!(
            format!("{:?}", refused.exit_code()),
            format!("{:?}", std::process::ExitCode::from(3))
        );
    }

    #[test]
    fn a_verdict_has_the_grade_and_the_expected_psnr() {
        let assessment = Assessment {
            grade: Grade::Usable,
            psnr_db: Some(31.24),
            psnr_low_db: Some(29.8),
            psnr_high_db: Some(32.9),
            order: None,
            reasons: Vec::new(),
        };
        let text = verdict(Some(&assessment), &[]);
        assert_eq!(text, "usable, expected PSNR 31.2 dB (29.8 to 32.9)");
        let unordered = Assessment { order: Some(MaskOrder::NotVerifiable), ..assessment.clone() };
        assert!(verdict(Some(&unordered), &[]).contains("32.9); order of masks not verifiable"));
        let at = |psnr, low| Assessment {
            psnr_db: Some(psnr),
            psnr_low_db: Some(low),
            psnr_high_db: Some(40.0),
            ..assessment.clone()
        };
        let capped = verdict(Some(&at(40.0, 38.2)), &[]);
        assert_eq!(capped, "usable, expected PSNR 40 dB or more (38.2 or more)");
        assert_eq!(verdict(Some(&at(40.0, 40.0)), &[]), "usable, expected PSNR 40 dB or more");
        let withheld = Assessment { psnr_db: None, ..assessment };
        assert_eq!(verdict(Some(&withheld), &[]), "usable, no expected PSNR");
        assert_eq!(verdict(None, &[]), "not assessed");
        let graded = |grade, psnr, high| Assessment {
            grade,
            psnr_db: Some(psnr),
            psnr_low_db: Some(psnr - 3.0),
            psnr_high_db: Some(high),
            ..withheld.clone()
        };
        let text = verdict(Some(&graded(Grade::Usable, 24.1, 26.0)), &[]);
        assert_eq!(text, "usable, expected PSNR 24.1 dB (21.1 to 26.0); good from 28 dB");
        let text = verdict(Some(&graded(Grade::Bad, 18.0, 20.0)), &[]);
        assert!(text.ends_with("; usable if the interval reaches 22 dB"), "{text}");
        assert_eq!(verdict(None, &[finding("a", Severity::Error, None)]), "bad");
    }
}
