//! The registry of findings: every code that a check can report, with its severity, title and remedy.
//!
//! Checks report a [`Finding`] with a [`FindingCode`] and the numbers of the case. A new finding takes one entry in
//! this file and the check that reports it. Running the tests with `SCI_RECON_WRITE_FINDINGS=1` then writes
//! `docs/FINDINGS.md`.

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, IntoStaticStr, VariantArray};

/// How serious a finding is.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize, Display)]
#[serde(rename_all = "snake_case")]
#[strum(serialize_all = "snake_case")]
#[derive(schemars::JsonSchema)]
pub enum Severity {
    /// Results are worse than they could be.
    Warning,
    /// Results are wrong.
    Error,
}

/// The subject of a finding.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Display)]
#[strum(serialize_all = "snake_case")]
pub enum Subject {
    /// The masks of a calibration, or the captures they were computed from.
    Calibration,
    /// A measurement, checked against its calibration.
    Measurement,
    /// The reconstructed frames.
    Result,
    /// A job that waits or runs.
    Job,
}

/// The description of a [`FindingCode`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Entry {
    /// Where the finding can occur.
    pub subjects: &'static [Subject],
    /// The usual severity.
    pub severity: Severity,
    /// The severity of grave cases; equal to `severity` where there is no distinction.
    pub worst: Severity,
    /// The problem in a few words, without the numbers of a case.
    pub title: &'static str,
    /// Instruction for the user, without a capital letter and a full stop.
    pub remedy: &'static str,
}

/// Declares [`FindingCode`] from a table of codes, subjects, severities, titles and remedies.
macro_rules! findings {
    ($($code:ident: $subjects:expr, $severities:expr, $title:expr, $remedy:expr;)+) => {
        /// The stable identifier of a finding. Codes are part of the API and never change.
        #[derive(Debug, Clone, Copy, PartialEq, Eq, Hash)]
        #[derive(Display, EnumString, IntoStaticStr, VariantArray)]
        #[strum(serialize_all = "snake_case")]
        #[allow(missing_docs)] // `entry` describes each code
        pub enum FindingCode {
            $($code,)+
        }

        impl FindingCode {
            /// The description of this code.
            pub const fn entry(self) -> Entry {
                use Severity::{Error, Warning};
                use Subject::{Calibration, Job, Measurement, Result};
                let (subjects, severities, title, remedy): (&[Subject], &[Severity], _, _) =
                    match self {
                        $(Self::$code => (&$subjects, &$severities, $title, $remedy),)+
                    };
                let (severity, worst) = (severities[0], severities[severities.len() - 1]);
                Entry { subjects, severity, worst, title, remedy }
            }
        }
    };
}

const REPEAT_PATTERNS: &str = "check the LCoS pattern sequence and its trigger, then record again";
const REDUCE_EXPOSURE: &str =
    "reduce the exposure of the whole calibration and record all captures again";

// Each code has the subjects, the usual severity with that of grave cases, the title and the remedy.
findings! {
    DeadPixels: [Calibration, Measurement], [Warning, Error],
        "pixels are dark in every mask",
        "look at the Gram map of the report: dust or a displaced mask darkens whole areas, too few repeats darken \
         single pixels";
    StuckPixels: [Calibration], [Warning],
        "pixels are open in every mask",
        "check the sensor for hot pixels and the captures for saturation";
    OneDimensional: [Calibration], [Warning],
        "the masks vary along one axis only",
        "check that the file has the axes [frame, row, column], and that the lithography mask is in place";
    MissingPattern: [Calibration, Measurement], [Warning, Error],
        "a pattern was not shown, or too briefly",
        REPEAT_PATTERNS;
    UnevenPatterns: [Calibration], [Warning],
        "a pattern is more than 30 % brighter or darker than the median",
        REPEAT_PATTERNS;
    RepeatedPattern: [Calibration], [Error],
        "two masks show the same pattern",
        REPEAT_PATTERNS;
    SwappedOrder: [Calibration], [Error],
        "the masks are not in the order of the patterns",
        "list the captures in the order in which the LCoS shows the patterns during a measurement";
    Correlated: [Calibration], [Warning],
        "the masks are highly correlated",
        "use patterns that overlap less, more sub-apertures, or a sharper projection (check the mask distance and \
         aberrations)";
    MaskScale: [Calibration, Measurement], [Warning],
        "the largest mask value is far below the full scale",
        "state the `full_scale` of the masks, not of the measurement: the stored number that means fully open, for \
         example 15 for 4-bit values, 4095 for 12-bit values stored in 16 bits";
    WeakModulation: [Calibration], [Warning],
        "the masks hardly differ from frame to frame",
        "focus the projection of the lithography mask, and check that the LCoS pattern changes";
    Pedestal: [Calibration], [Warning],
        "closed mask pixels let light through",
        "record `black_with_mask` again with the LCoS running and all black, so that it contains the leakage";
    SaturatedWhite: [Calibration], [Warning, Error],
        "pixels of the white image are saturated",
        REDUCE_EXPOSURE;
    SaturatedPatterns: [Calibration], [Error],
        "pixels of a pattern are saturated",
        REDUCE_EXPOSURE;
    DarkIllumination: [Calibration], [Warning, Error],
        "the white image is hardly brighter than the black one",
        "illuminate the white board up to the corners, and check that white and black are not interchanged";
    UnevenIllumination: [Calibration], [Warning],
        "the illumination is uneven",
        "illuminate the white board evenly, and check the aperture for vignetting";
    NoRepeats: [Calibration], [Warning],
        "captures have no repeats, so the noise is unknown",
        "record each capture several times; the paper uses 50 repeats";
    NoisyMasks: [Calibration], [Warning],
        "the masks are noisy",
        "record more repeats or increase the exposure";
    LightDrift: [Calibration], [Warning],
        "the light changed during the repeats",
        "let the lamp and the LCoS warm up, and fix exposure and gain";
    BadCalibration: [Measurement], [Error],
        "the calibration is graded `bad`",
        "read the calibration's report, correct the problems it lists, and calibrate again";
    Saturated: [Measurement], [Warning, Error],
        "pixels are saturated",
        "reduce the exposure time or stop down the lens; if the value is a valid reading, state a higher `saturation`";
    BadPixels: [Measurement], [Warning, Error],
        "pixels are hot, dead, frozen, or marked as not measured",
        "if there are few, do nothing; otherwise name a map of the sensor's bad pixels as `bad_pixels` of the calibration";
    EmptySnapshot: [Measurement], [Warning],
        "a snapshot is 0 everywhere, or has no finite value",
        "check the trigger of the camera; the frames of this snapshot are black";
    BinaryMeasurement: [Measurement], [Error],
        "a snapshot has only two values, as masks have, or is a copy of a mask",
        "send the snapshots of the camera as the measurement, and the masks to the calibration";
    LeftAligned: [Measurement], [Warning],
        "12-bit values are left-aligned in 16 bits",
        "state 65520 as `saturation`; the `full_scale` is the number that one frame adds, at most 65520";
    RightAligned: [Measurement], [Warning],
        "12-bit values are right-aligned in 16 bits",
        "if the camera has 12 bits, state 4095 as `saturation`; the `full_scale` is the number that one frame adds, \
         at most 4095";
    Level: [Measurement, Result], [Warning],
        "the brightest parts of the scene are implausible, for example below 0.12 or above 1.1 of the full scale",
        "state the `full_scale` of the measurement for its exposure and bit depth";
    NoDark: [Measurement], [Warning, Error],
        "3 % or more of the light is not explained by the masks, and no dark frames were named",
        "record dark frames: close every pixel of the coded aperture (LCoS all black, DMD all off; cap the lens only if \
         the mask can't be closed), at the measurement's exposure, gain and room light, and name them as `dark`";
    WrongDark: [Calibration, Measurement], [Warning, Error],
        "the dark frames do not belong to these captures",
        "record the dark frames (`black` and `black_with_mask`, or the measurement's `dark`) again with every pixel of \
         the coded aperture closed (LCoS all black), at the exposure, gain and room light of the captures they are \
         subtracted from";
    Negative: [Measurement], [Warning, Error],
        "parts of the image are below 0 by more than noise",
        "record the dark frames again at the measurement's exposure; if dark frames were subtracted before the \
         upload, send the raw camera values and name the dark frames as `dark`";
    NegativeOffset: [Measurement], [Warning, Error],
        "too much was subtracted before the upload",
        "send the raw camera values and name the dark frames as `dark`, so that the service subtracts them";
    Mosaic: [Measurement], [Error],
        "the image looks like the raw mosaic of a colour sensor",
        "state the `mosaic` of the sensor with the calibration, or export both captures and measurement in grey";
    ShiftedMasks: [Measurement], [Error],
        "the masks fit better when shifted (by up to 32 pixels)",
        "check that masks and measurement have the same `crop`; if they have, the optics moved since the \
         calibration: calibrate again (a job with `registration` auto corrects up to 4 pixels)";
    PartlyMovedMasks: [Measurement], [Error],
        "the masks are displaced in a part of the picture",
        "check that the sensor is read in the same way as during the calibration, and that neither masks nor measurement \
         were put together from parts; then calibrate again";
    DriftedMasks: [Measurement], [Warning],
        "the masks are displaced by a fraction of a pixel",
        "calibrate again once the optics are stable (a job with `registration` auto corrects the drift); if the \
         finding stays, record dark frames and name them as `dark`";
    MovedMasks: [Job], [Warning],
        "the job uses masks that are displaced from their calibrated position",
        "if another finding questions the dark or the full scale, correct that first, because it can look like a motion; \
         otherwise calibrate again once the optics are stable";
    MisplacedMasks: [Job], [Error],
        "the moved masks explain less than before, or a large part of the light not at all",
        "check the shift stated as `registration`: pixels down, then pixels to the right; or estimate it with `registration` auto";
    TurnedMasks: [Measurement], [Error],
        "the masks fit when they are flipped or their rows and columns exchanged",
        "export masks and measurement with the same orientation (or state the `axes` of the masks if rows and columns are \
         exchanged), and make the calibration again";
    ResampledMasks: [Measurement], [Error],
        "the masks have another magnification or rotation than the measurement",
        "send masks and measurement in the pixels of the camera, without resizing; if neither was resized, calibrate again \
         with the focus of the measurement";
    MaskValues: [Measurement], [Error],
        "the values of the masks are not their transmission",
        "make the masks again from linear values of the camera: without gamma curve, contrast stretch or threshold";
    MissingMask: [Measurement], [Warning],
        "a mask is missing",
        "send one mask for each frame of the exposure, in the order in which the patterns are shown; if none is missing, \
         record the dark frames again";
    UnmodulatedArea: [Measurement], [Warning],
        "the masks modulate the light of a part of the picture too weakly",
        "look there for glare, a reflection, stray light, or a part of the sensor that repeats old values; if it can't be removed, \
         mark the part in the map of `bad_pixels` of the calibration";
    ForeignMasks: [Measurement], [Error],
        "the masks do not explain the measurement",
        "name the calibration that belongs to this measurement, or calibrate again";
    UnverifiedMasks: [Measurement], [Warning],
        "the measurement does not show whether the masks belong to it",
        "compare the frames with what you know of the scene; a measurement of a bright scene that fills the picture, with \
         the same optics, shows whether the calibration is right";
    InvertedMasks: [Measurement], [Error],
        "the masks are inverted: open pixels are 0, closed ones 1",
        "create a new calibration with 1 - C as the masks";
    FastMotion: [Result], [Warning],
        "fast motion may be reconstructed too smooth",
        "shorten the frames, or use fewer frames in a snapshot";
    UnfamiliarMasks: [Result], [Warning],
        "the expected PSNR is unreliable behind these masks",
        "do not rely on the expected PSNR; simulate a similar scene behind these masks instead";
    UnevenError: [Result], [Warning],
        "a part of the picture is expected to be much worse than the rest",
        "look at the map of the expected error before relying on this part";
    NoTileWorkers: [Job], [Warning],
        "no worker takes tiles, so the job makes no progress",
        "ask the administrator to start workers: `serve --workers N` on the machine of the service, or `sci-recon \
         worker` on another one";
    UnexplainedPixels: [Result], [Error],
        "the frames do not predict pixels that were withheld from the reconstruction",
        "check that the masks belong to this measurement, unflipped and in its pixel grid, and that the measurement \
         is not mostly noise; then calibrate again";
    ExchangedMasks: [Result], [Warning],
        "two masks are probably exchanged",
        "check that the masks are in the order in which the LCoS shows the patterns during a measurement";
}

/// The part of a job that a finding makes doubtful. The verdict is then at best doubtful.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Doubt {
    /// The masks, their scale or the dark. There is no expected PSNR.
    Inputs,
    /// The full scale of the measurement. The expected PSNR is relative to the white level, so it does not depend on it.
    Scale,
}

impl FindingCode {
    /// The code as it appears in reports and in the API.
    pub fn as_str(self) -> &'static str {
        self.into()
    }

    /// The part of a job that this finding makes doubtful, whether it is a warning or an error.
    pub fn doubt(self) -> Option<Doubt> {
        match self {
            Self::BadCalibration
            | Self::BinaryMeasurement
            | Self::DriftedMasks
            | Self::ExchangedMasks
            | Self::ForeignMasks
            | Self::InvertedMasks
            | Self::MaskScale
            | Self::MaskValues
            | Self::MisplacedMasks
            | Self::MissingMask
            | Self::MissingPattern
            | Self::Mosaic
            | Self::Negative
            | Self::NegativeOffset
            | Self::NoDark
            | Self::PartlyMovedMasks
            | Self::ResampledMasks
            | Self::ShiftedMasks
            | Self::TurnedMasks
            | Self::UnexplainedPixels
            | Self::UnmodulatedArea
            | Self::UnverifiedMasks
            | Self::WrongDark => Some(Doubt::Inputs),
            Self::LeftAligned | Self::Level | Self::RightAligned => Some(Doubt::Scale),
            _ => None,
        }
    }
}

/// A problem that a check has found.
#[derive(Debug, Clone, PartialEq)]
pub struct Finding {
    /// Which problem it is; it determines the title and the remedy.
    pub code: FindingCode,
    /// The severity of this case.
    pub severity: Severity,
    /// The observation with its numbers, for people.
    pub detail: String,
    /// The affected patterns or frames, counted from 0.
    pub frames: Vec<usize>,
}

impl Finding {
    /// A finding of the usual severity that concerns no particular frame.
    pub fn new(code: FindingCode, detail: impl Into<String>) -> Self {
        let severity = code.entry().severity;
        Self { code, severity, detail: detail.into(), frames: Vec::new() }
    }

    /// Raises the severity to the worst one of the code if the case is grave.
    pub(super) fn escalate_if(self, is_grave: bool) -> Self {
        let severity = if is_grave { self.code.entry().worst } else { self.severity };
        Self { severity, ..self }
    }

    /// Names the affected patterns or frames.
    pub(super) fn with_frames(self, frames: Vec<usize>) -> Self {
        Self { frames, ..self }
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;
    use std::fmt::Write;

    use strum::VariantArray;

    use super::{Doubt, FindingCode};

    /// The beginning of `docs/FINDINGS.md`.
    const HEADER: &str = "\
<!-- Generated from crates/optics/src/finding.rs. Edit the source and run
     SCI_RECON_WRITE_FINDINGS=1 cargo test -p sci-recon-optics --lib finding -->

# Findings

[DATA.md](DATA.md#warnings) explains where findings appear. \"Checked\" names the object that has the finding. An error makes
the [verdict](DATA.md#expected-psnr) of a job bad. \"Doubt\" names what a warning questions, so that the verdict is doubtful:
the full `scale` of the measurement, or other `inputs`. With doubtful inputs there is no expected PSNR.

";

    fn page() -> String {
        let mut page = HEADER.to_owned();
        page.push_str(
            "| code | checked | severity | doubt | meaning | remedy |\n| --- | --- | --- | --- | --- | --- |\n",
        );
        for code in FindingCode::VARIANTS {
            let entry = code.entry();
            let subjects: Vec<_> =
                entry.subjects.iter().map(|subject| subject.to_string()).collect();
            let severities = BTreeSet::from([entry.severity, entry.worst]);
            let severities: Vec<_> =
                severities.into_iter().map(|severity| severity.to_string()).collect();
            let (subjects, severities) = (subjects.join(", "), severities.join(" or "));
            let doubt = match code.doubt() {
                Some(Doubt::Inputs) => "inputs",
                Some(Doubt::Scale) => "scale",
                None => "",
            };
            let (title, remedy) = (entry.title, entry.remedy);
            writeln!(
                page,
                "| `{code}` | {subjects} | {severities} | {doubt} | {title} | {remedy} |"
            )
            .unwrap();
        }
        page
    }

    #[test]
    fn the_document_lists_every_code() {
        let path = concat!(env!("CARGO_MANIFEST_DIR"), "/../../docs/FINDINGS.md");
        if std::env::var_os("SCI_RECON_WRITE_FINDINGS").is_some() {
            std::fs::write(path, page()).unwrap();
            return;
        }
        assert!(
            std::fs::read_to_string(path).unwrap() == page(),
            "docs/FINDINGS.md is not up to date: run this test with SCI_RECON_WRITE_FINDINGS=1"
        );
    }

    #[test]
    fn codes_are_parsed_back_from_their_names() {
        for code in FindingCode::VARIANTS {
            assert_eq!(code.as_str().parse(), Ok(*code));
        }
    }

    #[test]
    fn remedies_are_instructions_without_a_full_stop() {
        for code in FindingCode::VARIANTS {
            let entry = code.entry();
            assert!(entry.worst >= entry.severity && !entry.subjects.is_empty(), "{code}");
            for text in [entry.title, entry.remedy] {
                assert!(
                    !text.is_empty() && !text.ends_with('.') && !text.contains('|'),
                    "{code}: {text}"
                );
                assert!(!text.starts_with(|c: char| c.is_uppercase()), "{code}: {text}");
            }
        }
    }
}
