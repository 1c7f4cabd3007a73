//! Formats findings for all commands, and derives their exit code from verdicts.

use std::collections::BTreeSet;
use std::fmt::Write;

use super::CliError;
use super::client::Job;
use super::error::Result;
use super::fields::{as_options, role_of};
use engine::job::{Assessment, Finding, Grade, JobState, Severity};

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

/// The word for a state. Only the verdict says whether the frames are good, so `succeeded` reads "finished".
pub(super) fn state_word(state: JobState) -> &'static str {
    match state {
        JobState::Succeeded => "finished",
        other => other.into_str(),
    }
}

/// The codes of the errors among findings. The same error of several snapshots counts once.
fn errors(findings: &[Finding]) -> BTreeSet<&str> {
    let errors = findings.iter().filter(|finding| finding.severity == Severity::Error);
    errors.map(|finding| finding.code.as_str()).collect()
}

/// Returns the error for exit code 3 if the verdict on a result is bad.
pub(super) fn refuse_bad<'a>(
    results: impl IntoIterator<Item = (&'a [Finding], Option<Grade>)>,
) -> Result<()> {
    let bad = results.into_iter().filter(|(_, verdict)| *verdict == Some(Grade::Bad));
    let mut bad = bad.map(|(findings, _)| errors(findings)).peekable();
    if bad.peek().is_none() {
        return Ok(());
    }
    let codes: Vec<&str> = bad.flatten().collect::<BTreeSet<_>>().into_iter().collect();
    match codes.as_slice() {
        [] => Err(CliError::ErrorsFound(
            "the verdict is bad: the expected PSNR is too low; see docs/DATA.md, section Expected PSNR".into(),
        )),
        _ => {
            let text = format!("the checks found {}: results will be wrong", codes.join(", "));
            Err(CliError::ErrorsFound(text))
        }
    }
}

impl Job {
    pub(super) fn findings(&self) -> Vec<Finding> {
        Assessment::findings(&self.warnings, self.assessment.as_ref())
    }

    /// Identifier, verdict and state, and an indented line for each finding.
    pub(super) fn summary(&self) -> String {
        let verdict =
            self.verdict_text.as_ref().map(|text| format!("{text}; ")).unwrap_or_default();
        let findings = lines(&self.findings());
        let findings = findings.iter().map(|line| format!("\n    {line}")).collect::<String>();
        format!("{}: {verdict}{}{findings}", self.id, state_word(self.state))
    }
}

#[cfg(test)]
mod tests {
    use super::{lines, refuse_bad};
    use engine::job::{Finding, Grade, Severity};

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
        let (doubtful, bad) = (Some(Grade::Doubtful), Some(Grade::Bad));
        assert!(refuse_bad([(&warning[..], doubtful), (&[], None)]).is_ok());
        let refused = refuse_bad([(&warning[..], doubtful), (&error, bad)]).unwrap_err();
        assert!(refused.to_string().contains("found b, c:"), "{refused}");
        let refused = refuse_bad([(&warning[..], bad)]).unwrap_err();
        assert!(refused.to_string().contains("expected PSNR is too low"), "{refused}");
        assert_eq!(
            format!("{:?}", refused.exit_code()),
            format!("{:?}", std::process::ExitCode::from(3))
        );
    }
}
