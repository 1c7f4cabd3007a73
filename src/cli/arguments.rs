//! Arguments that several commands share.

use std::fs;
use std::path::{Path, PathBuf};
use std::str::FromStr;

use clap::Args;
use clap::builder::{PossibleValuesParser, TypedValueParser};
use serde::de::DeserializeOwned;

use super::CliError;
use super::confine::{confine_network, folders_of, limit_memory};
use crate::cli::error::{Result, read_json};
use crate::config::device;
use engine::job::{
    Algorithm, CalibrationId, CalibrationRequest, Dispersion, DispersionAxis, InvalidField, Label,
    MaskExtent, MeasurementRequest, RegistrationRequest, Sha256,
};
use engine::pipeline::NetworkSource;
use formats::{Axes, Crop, Packing};
use optics::MAX_BANDS;
use reconstruction::priors::onnx::Device;
use reconstruction::registration::Similarity;
use reconstruction::schedule::Schedule;
use serde_json::{Value, json};
use strum::VariantNames;

/// The algorithm and the file of its schedule.
#[derive(Debug, Args)]
pub(super) struct AlgorithmArguments {
    /// The algorithm.
    #[arg(long, value_name = "NAME", default_value = Algorithm::PnpTvFastdvdnet.into_str(),
          value_parser = named::<Algorithm>())]
    pub(super) algorithm: Algorithm,
    /// A schedule as JSON (docs/schedule.schema.json) instead of the algorithm's default.
    #[arg(long, value_name = "FILE")]
    schedule: Option<PathBuf>,
}

impl AlgorithmArguments {
    /// Reads the file of the schedule, if there is one.
    pub(super) fn schedule<T: DeserializeOwned>(&self) -> Result<Option<T>> {
        self.schedule.as_deref().map(|path| read_json("schedule", path)).transpose()
    }
}

/// Algorithm, schedule and iterations.
#[derive(Debug, Args)]
pub(super) struct ScheduleArguments {
    #[command(flatten)]
    stated: AlgorithmArguments,
    /// Run exactly N iterations without a test for convergence; the last stage is shortened or extended.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u32).range(1..=10_000))]
    iterations: Option<u32>,
}

/// Options for reading a file of masks.
#[derive(Debug, Args)]
pub(super) struct MaskFileArguments {
    /// Name of the masks in an npz, .mat or HDF5 file [default: mask, or the only array].
    #[arg(long, value_name = "NAME")]
    pub(super) masks_array: Option<Label>,
    /// The order of the axes of the masks [default: the only one that fits].
    #[arg(long, value_name = "ORDER", value_parser = named::<Axes>())]
    pub(super) masks_axes: Option<Axes>,
    /// Window of each mask: ROW,COLUMN,HEIGHT,WIDTH, counted from 0 [default: whole masks].
    #[arg(long, value_name = "WINDOW")]
    pub(super) masks_crop: Option<Crop>,
    /// First and last mask, both included, counted from 0 [default: all masks].
    #[arg(long, value_name = "FIRST-LAST", value_parser = frame_range)]
    pub(super) masks_frames: Option<[usize; 2]>,
    /// How the pixels of the masks are packed [default: one number per pixel].
    #[arg(long, value_name = "NAME", value_parser = named::<Packing>())]
    pub(super) masks_packing: Option<Packing>,
    /// Map of the sensor's bad pixels, of the size of the masks: pixels that are not 0 are bad.
    #[arg(long, value_name = "FILE")]
    pub(super) bad_pixels: Option<PathBuf>,
}

impl MaskFileArguments {
    /// The request for masks of this upload, with the options of its file.
    pub(super) fn request(&self, masks: Sha256) -> CalibrationRequest {
        CalibrationRequest {
            masks: Some(masks),
            array: self.masks_array.clone(),
            axes: self.masks_axes,
            crop: self.masks_crop,
            frames: self.masks_frames,
            packing: self.masks_packing,
            ..CalibrationRequest::default()
        }
    }
}

/// Options for reading a file of snapshots, and for its correction.
#[derive(Debug, Args)]
pub(super) struct SnapshotFileArguments {
    /// Name of the snapshots in an npz, .mat or HDF5 file [default: meas, or the only array].
    #[arg(long, value_name = "NAME")]
    pub(super) array: Option<Label>,
    /// The order of the axes of the snapshots [default: the only one that fits].
    #[arg(long, alias = "measurement-axes", value_name = "ORDER", value_parser = named::<Axes>())]
    pub(super) axes: Option<Axes>,
    /// Window of each snapshot and dark capture: ROW,COLUMN,HEIGHT,WIDTH, counted from 0 [default: whole snapshots].
    #[arg(long, alias = "measurement-crop", value_name = "WINDOW")]
    pub(super) crop: Option<Crop>,
    /// How the pixels of snapshots and dark captures are packed [default: one number per pixel].
    #[arg(long, alias = "measurement-packing", value_name = "NAME", value_parser = named::<Packing>())]
    pub(super) packing: Option<Packing>,
    /// Captures of the dark at the exposure of the snapshots; their average is subtracted. May be repeated.
    #[arg(long, value_name = "FILE")]
    pub(super) dark: Vec<PathBuf>,
    /// The stored number at and above which a pixel is saturated [default: the largest one, if pixels pile up there].
    #[arg(long, value_name = "NUMBER")]
    pub(super) saturation: Option<u32>,
}

impl SnapshotFileArguments {
    /// The request for snapshots of this upload, with the options of its file.
    pub(super) fn request(
        &self,
        calibration: CalibrationId,
        data: Sha256,
        dark: Vec<Sha256>,
    ) -> MeasurementRequest {
        MeasurementRequest {
            array: self.array.clone(),
            axes: self.axes,
            crop: self.crop,
            packing: self.packing,
            dark,
            saturation: self.saturation,
            ..MeasurementRequest::new(None, calibration, data)
        }
    }
}

/// The displacement of the bands of a spectral camera.
#[derive(Debug, Args)]
pub(super) struct DispersionArguments {
    /// Displacement of each band of a spectral camera (CASSI) in pixels: START:STEP:COUNT, a list separated by commas, or a
    /// file with a JSON list. The masks of all bands are then made from one mask [row, column].
    #[arg(long, value_name = "LIST")]
    dispersion_offsets: Option<Numbers>,
    /// `column` if the bands are displaced to the right, `row` if downwards.
    #[arg(long, value_name = "AXIS", default_value_t = DispersionAxis::Column, value_parser = named::<DispersionAxis>(),
          requires = "dispersion_offsets")]
    dispersion_axis: DispersionAxis,
    /// Wavelength of each band in nm, in the same form as the offsets [default: none].
    #[arg(long, value_name = "LIST", requires = "dispersion_offsets")]
    dispersion_wavelengths: Option<Numbers>,
    /// The size of the mask: `scene` is that of a band, `measurement` that of the measurement.
    #[arg(long, value_name = "SIZE", default_value_t = MaskExtent::Scene, value_parser = named::<MaskExtent>(),
          requires = "dispersion_offsets")]
    dispersion_mask: MaskExtent,
}

impl DispersionArguments {
    /// The dispersion, if there are offsets.
    pub(super) fn resolve(&self) -> Result<Option<Dispersion>> {
        let Some(offsets) = &self.dispersion_offsets else { return Ok(None) };
        let dispersion = Dispersion {
            axis: self.dispersion_axis,
            offsets: offsets.0.clone(),
            wavelengths: self.dispersion_wavelengths.as_ref().map(|lengths| lengths.0.clone()),
            mask: self.dispersion_mask,
        };
        match dispersion.check() {
            Ok(()) => Ok(Some(dispersion)),
            Err(error) => Err(CliError::Input(format!("--dispersion: {}", error.detail))),
        }
    }
}

/// A number for each band.
#[derive(Debug, Clone, PartialEq)]
struct Numbers(Vec<f64>);

impl FromStr for Numbers {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let number =
            |text: &str| text.trim().parse::<f64>().map_err(|_| format!("{text:?} is no number"));
        if let [start, step, count] = text.split(':').collect::<Vec<_>>()[..]
            && let (Ok(start), Ok(step)) = (number(start), number(step))
        {
            let count = count.trim();
            let count = count.parse::<u16>().ok().filter(|count| usize::from(*count) <= MAX_BANDS);
            let count = count.ok_or_else(|| {
                format!("COUNT in {text:?} is not a whole number from 1 to {MAX_BANDS}")
            })?;
            return Ok(Self((0..count).map(|band| start + step * f64::from(band)).collect()));
        }
        if text.contains(',') || number(text).is_ok() {
            return text.split(',').map(number).collect::<Result<_, _>>().map(Self);
        }
        let unreadable = |error: &dyn std::fmt::Display| {
            format!(
                "{error}; state START:STEP:COUNT, a list separated by commas, or a file with a JSON list"
            )
        };
        let list = fs::read_to_string(text).map_err(|error| unreadable(&error))?;
        serde_json::from_str(&list).map(Self).map_err(|error| unreadable(&error))
    }
}

/// Runtime and device of networks.
#[derive(Debug, Args)]
pub struct NetworkArguments {
    /// Path of libonnxruntime [default: next to the program, or in ../lib/sci-recon, ../lib or ../../runtime].
    #[arg(long, value_name = "FILE", env = "ORT_DYLIB_PATH")]
    onnxruntime: Option<PathBuf>,
    /// Device that runs networks, and the solver in a build with the feature gpu: cpu, gpu (the first GPU of any vendor), or
    /// cuda:N (NVIDIA, from 0; networks only).
    #[arg(long, value_name = "DEVICE", default_value = "cpu", value_parser = device)]
    device: String,
}

impl ScheduleArguments {
    pub(super) fn algorithm(&self) -> Algorithm {
        self.stated.algorithm
    }

    /// Reads and checks the schedule. It has no stages for `learned`.
    pub(super) fn resolve(&self) -> Result<Schedule> {
        if self.algorithm() == Algorithm::Learned {
            if self.stated.schedule.is_some() || self.iterations.is_some() {
                let text = "learned runs one network once: it takes no --schedule or --iterations";
                return Err(CliError::Input(text.into()));
            }
            return Ok(self.algorithm().default_schedule());
        }
        let schedule: Option<Schedule> = self.stated.schedule()?;
        let schedule = schedule.unwrap_or_else(|| self.algorithm().default_schedule());
        let faults = InvalidField::schedule_errors(&schedule);
        if !faults.is_empty() {
            let line = |fault: InvalidField| format!("{}: {}", fault.pointer, fault.detail);
            let lines: Vec<String> = faults.into_iter().map(line).collect();
            let text = format!("the schedule can't be used: {}", lines.join("; "));
            return Err(CliError::Input(text));
        }
        if let Some(misfit) = self.algorithm().misfit(&schedule) {
            return Err(CliError::Input(format!("the schedule does not fit: {misfit}")));
        }
        Ok(match self.iterations {
            Some(count) => schedule.with_iterations(count as usize),
            None => schedule,
        })
    }
}

/// A registration: `off`, `auto`, or a motion `ROWS,COLUMNS[,DEGREES[,SCALE]]`.
pub(super) fn registration(text: &str) -> Result<RegistrationRequest, String> {
    let wrong = || {
        format!(
            "{text:?}; give off, auto, or ROWS,COLUMNS[,DEGREES[,SCALE]], such as 0.5,-1.2 for a shift in pixels"
        )
    };
    let request = match text {
        "off" => return Ok(RegistrationRequest::Off),
        "auto" => return Ok(RegistrationRequest::Auto),
        motion => {
            let numbers: Result<Vec<f64>, _> =
                motion.split(',').map(|number| number.trim().parse()).collect();
            let (rows, columns, rotation, scale) = match numbers.map_err(|_| wrong())?[..] {
                [rows, columns] => (rows, columns, 0.0, 1.0),
                [rows, columns, rotation] => (rows, columns, rotation, 1.0),
                [rows, columns, rotation, scale] => (rows, columns, rotation, scale),
                _ => return Err(wrong()),
            };
            RegistrationRequest::Stated(Similarity { shift: [rows, columns], rotation, scale })
        }
    };
    request.error(false).map_or(Ok(request), |error| Err(error.detail))
}

/// A selection of snapshots: `all`, one index, or `FIRST-LAST` including both ends.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Snapshots {
    pub(super) first: usize,
    /// `None` selects the last snapshot of the file.
    pub(super) last: Option<usize>,
}

impl FromStr for Snapshots {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        let wrong = || format!("{text:?}; give one index, FIRST-LAST including both ends, or all");
        let index = |text: &str| text.parse::<usize>().map_err(|_| wrong());
        let (first, last) = match text.split_once('-') {
            None if text == "all" => return Ok(Self { first: 0, last: None }),
            None => (index(text)?, index(text)?),
            Some((first, last)) => (index(first)?, index(last)?),
        };
        if first <= last { Ok(Self { first, last: Some(last) }) } else { Err(wrong()) }
    }
}

impl Snapshots {
    /// The selection in a request for a job.
    pub(super) fn request(self) -> Value {
        match (self.first, self.last) {
            (0, None) => json!("all"),
            (first, Some(last)) if first == last => json!(first),
            (first, last) => json!([first, last]),
        }
    }
}

impl NetworkArguments {
    /// Confines this process, which runs a network of a user. It limits the memory, forbids connections, and allows
    /// only the files of the system, libonnxruntime and `readable`. Must be called before the process starts a
    /// thread. With a GPU or `unconfined`, only the memory limit applies.
    /// Errors: the memory can't be limited. Other failures are printed to standard error.
    pub(super) fn confine(
        &self,
        memory_bytes: Option<u64>,
        unconfined: bool,
        readable: Option<&Path>,
    ) -> Result<()> {
        if let Some(bytes) = memory_bytes {
            limit_memory(bytes).map_err(CliError::Failure)?;
        }
        if unconfined || self.device != "cpu" {
            return Ok(());
        }
        let library = folders_of(self.onnxruntime.as_deref());
        let readable: Vec<_> = library.iter().map(PathBuf::as_path).chain(readable).collect();
        if let Err(reason) = confine_network(&readable) {
            eprintln!("a network is not confined: {reason}");
        }
        Ok(())
    }

    /// The networks on the stated device.
    /// Errors: the device can't run a network; the text has the remedy.
    pub fn network(&self) -> Result<NetworkSource> {
        // An empty variable counts as not set.
        let library = self.onnxruntime.clone().filter(|path| !path.as_os_str().is_empty());
        let source = NetworkSource::new(library, Device::parse(&self.device)?);
        source.try_device()?;
        Ok(source)
    }
}

/// Parses names of algorithms that need no network of the user.
pub fn algorithms() -> impl TypedValueParser<Value = Algorithm> {
    let names = Algorithm::VARIANTS.iter().filter(|name| **name != Algorithm::Learned.into_str());
    PossibleValuesParser::new(names).try_map(|name: String| name.parse::<Algorithm>())
}

/// Parses the names of the variants of `T`.
pub(super) fn named<T>() -> impl TypedValueParser<Value = T>
where
    T: VariantNames + FromStr<Err = strum::ParseError> + Clone + Send + Sync + 'static,
{
    PossibleValuesParser::new(T::VARIANTS).try_map(|name: String| name.parse::<T>())
}

/// Parses `FIRST-LAST`: first and last frame, both included, counted from 0.
pub(super) fn frame_range(text: &str) -> Result<[usize; 2], String> {
    match text.parse::<Snapshots>()? {
        Snapshots { first, last: Some(last) } => Ok([first, last]),
        Snapshots { last: None, .. } => {
            Err("name one index, or FIRST-LAST with both ends in".to_owned())
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Numbers, ScheduleArguments};
    use clap::Parser;
    use engine::job::Algorithm;
    use std::fs;

    #[derive(Debug, Parser)]
    struct Command {
        #[command(flatten)]
        schedule: ScheduleArguments,
    }

    fn parse(arguments: &[&str]) -> ScheduleArguments {
        Command::try_parse_from([&["test"], arguments].concat()).unwrap().schedule
    }

    #[test]
    fn numbers_of_bands_are_a_range_a_list_or_a_file() {
        let numbers = |text: &str| text.parse::<Numbers>().map(|numbers| numbers.0);
        assert_eq!(numbers("450:7.5:3"), Ok(vec![450.0, 457.5, 465.0]));
        assert_eq!(numbers("0, 2.5,1"), Ok(vec![0.0, 2.5, 1.0]));
        assert_eq!(numbers("3"), Ok(vec![3.0]));
        let file = tempfile::NamedTempFile::new().unwrap();
        fs::write(file.path(), "[0, 2, 4.5]").unwrap();
        assert_eq!(numbers(file.path().to_str().unwrap()), Ok(vec![0.0, 2.0, 4.5]));
        for bad in ["0:2", "0:2:x", "1,a", "missing.json", ""] {
            assert!(numbers(bad).is_err(), "{bad}");
        }
        assert!(numbers("0:2").unwrap_err().contains("START:STEP:COUNT"));
    }

    #[test]
    fn the_count_of_iterations_can_be_fixed() {
        let spec = parse(&["--algorithm", "gap-tv", "--iterations", "7"]).resolve().unwrap();
        assert_eq!(spec.planned_iterations(), 7);
        assert!(spec.stages.iter().all(|stage| stage.tolerance == 0.0));
        assert_eq!(parse(&[]).algorithm(), Algorithm::PnpTvFastdvdnet);
        assert!(Command::try_parse_from(["test", "--algorithm", "magic"]).is_err());
        assert!(Command::try_parse_from(["test", "--iterations", "0"]).is_err());
    }

    #[test]
    fn an_error_in_a_schedule_names_the_file_and_the_field() {
        let folder = tempfile::tempdir().unwrap();
        let file = folder.path().join("schedule.json");
        let message = |algorithm: &str, text: &str| {
            fs::write(&file, text).unwrap();
            let arguments = ["--algorithm", algorithm, "--schedule", file.to_str().unwrap()];
            parse(&arguments).resolve().unwrap_err().to_string()
        };
        assert!(message("gap-tv", "{").contains("schedule.json"));
        let sigma = r#"{"stages": [{"prior": "fastdvdnet", "iterations": 5}]}"#;
        assert!(message("pnp-tv-fastdvdnet", sigma).contains("missing field `sigma`"));
        let deep = r#"{"stages": [{"prior": "fastdvdnet", "iterations": 5, "sigma": [0.2, 0.1]}]}"#;
        assert!(message("gap-tv", deep).contains("use the algorithm pnp-fastdvdnet"));
    }
}
