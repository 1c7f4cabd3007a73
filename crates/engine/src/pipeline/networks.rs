//! Networks: the embedded ones, those of a folder, users' end-to-end networks, and the libonnxruntime that runs them.

use std::borrow::Cow;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use ndarray::Array3;
use sha2::Digest;

use crate::job::{JobSpec, Label, ModelRecord, Schedule, Sha256};
use reconstruction::ReconError;
use reconstruction::cores::Cores;
use reconstruction::priors::network::{ClipDenoiser, ClipEncoder};
use reconstruction::priors::onnx::{Device, EndToEndNetwork, Runtime};
use reconstruction::priors::{Denoiser, Encoder, Network, Networks};
#[cfg(feature = "gpu")]
use reconstruction::{gpu::adapter::Gpu, operator::SensingOperator, solver::reconstruct};

/// A network embedded in the program as ONNX files, so that only libonnxruntime has to be installed.
#[derive(Debug, Clone, Copy)]
pub struct Model {
    pub name: &'static str,
    /// Name and content of each file, in the order of execution.
    pub files: &'static [(&'static str, &'static [u8])],
}

/// The embedded model of a network, trained for this project; see its model card in `models/`.
pub const fn carried(network: Network) -> Model {
    match network {
        Network::FastDvdNet => FASTDVDNET_GRAY,
        Network::FastDvdNetInt8 => FASTDVDNET_GRAY_INT8,
        Network::FfdNet => FFDNET_GRAY,
    }
}

const FASTDVDNET_GRAY: Model = Model {
    name: "fastdvdnet-gray",
    files: &[
        ("stage1.onnx", include_bytes!("../../../../models/fastdvdnet-gray/stage1.onnx")),
        ("stage2.onnx", include_bytes!("../../../../models/fastdvdnet-gray/stage2.onnx")),
    ],
};

const FASTDVDNET_GRAY_INT8: Model = Model {
    name: "fastdvdnet-gray-int8",
    files: &[
        ("stage1.onnx", include_bytes!("../../../../models/fastdvdnet-gray-int8/stage1.onnx")),
        ("stage2.onnx", include_bytes!("../../../../models/fastdvdnet-gray-int8/stage2.onnx")),
    ],
};

/// The encoder whose features the quality model uses. It can't be replaced, because the model is fitted to its
/// features.
const FASTDVDNET_GRAY_ENCODER: &[u8] =
    include_bytes!("../../../../models/fastdvdnet-gray-encoder/model.onnx");

const FFDNET_GRAY: Model = Model {
    name: "ffdnet-gray",
    files: &[("model.onnx", include_bytes!("../../../../models/ffdnet-gray/model.onnx"))],
};

impl ModelRecord {
    /// The records of all networks of a job: those of its schedule, or its model.
    pub fn for_job(spec: &JobSpec) -> Vec<Self> {
        let model = spec.model.as_ref().map(|model| Self {
            name: model.name.as_ref().map_or("learned", Label::as_str).to_owned(),
            sha256: model.sha256.to_string(),
        });
        spec.networks.iter().cloned().chain(model).collect()
    }

    /// The record of a model whose files have these contents.
    fn new<'a>(model: &Model, contents: impl Iterator<Item = &'a [u8]>) -> Self {
        let digest = contents.fold(sha2::Sha256::new(), Digest::chain_update);
        let sha256 = Sha256::new(digest.finalize().into()).to_string();
        Self { name: model.name.into(), sha256 }
    }
}

/// The ONNX file of an end-to-end network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModelFile {
    path: PathBuf,
    sha256: Sha256,
}

impl ModelFile {
    /// A file with its recorded hash, which [`Self::content`] checks.
    pub fn new(path: PathBuf, sha256: Sha256) -> Self {
        Self { path, sha256 }
    }

    /// Hashes a file.
    pub fn open(path: &Path) -> Result<Self, NetworkError> {
        let bytes = read(path)?;
        Ok(Self { path: path.to_owned(), sha256: Sha256::of(&bytes) })
    }

    /// The recorded hash of the file.
    pub fn sha256(&self) -> Sha256 {
        self.sha256
    }

    /// Reads the file.
    ///
    /// Errors: [`NetworkError::Model`] if it can't be read, [`NetworkError::Damaged`] if it does not have the recorded
    /// hash.
    pub fn content(&self) -> Result<Vec<u8>, NetworkError> {
        let bytes = read(&self.path)?;
        let actual = Sha256::of(&bytes);
        if actual == self.sha256 {
            return Ok(bytes);
        }
        Err(NetworkError::Damaged { expected: self.sha256, actual })
    }
}

fn read(path: &Path) -> Result<Vec<u8>, NetworkError> {
    fs::read(path).map_err(|reason| NetworkError::Model { path: path.to_owned(), reason })
}

/// Largest accepted difference between a device and the CPU in the pass at the start, on frames of [0, 1].
/// Half of a grey level of 8 bits; sound devices stay below 1e-5.
const MAX_DIFFERENCE: f32 = 2e-3;
/// File name of the library.
const LIBRARY: &str = "libonnxruntime.so";
/// Folders that are searched for the library, relative to that of the program: the same folder, the destinations of
/// `make install` and of system packages, and the destination of scripts/fetch-onnxruntime.sh in a source tree.
const LIBRARY_FOLDERS: [&str; 4] = [".", "../lib/sci-recon", "../lib", "../../runtime"];

/// Errors of loading a network.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    #[error(
        "libonnxruntime was not found: {0}. State its path with --onnxruntime or ORT_DYLIB_PATH, or download it with \
         scripts/fetch-onnxruntime.sh FOLDER from the source tree and put it into the folder of the program"
    )]
    Missing(String),
    #[error("the model file {} can't be read: {reason}", path.display())]
    Model { path: PathBuf, reason: io::Error },
    #[error(
        "the folder {} has none of the networks {}", .0.display(), Network::ALL.map(|which| carried(which).name).join(", ")
    )]
    NoModels(PathBuf),
    #[error(
        "the networks of this worker differ from those at the submission of the job ({0}): start the service and its \
         workers with the same --models, or submit the job again"
    )]
    Changed(String),
    #[error(
        "the file of the network is damaged: its SHA-256 is {actual}, but should be {expected}"
    )]
    Damaged { expected: Sha256, actual: Sha256 },
    #[error(
        "the device {device} can't be used: {reason}. It needs a libonnxruntime with {provider}, which \
         `scripts/fetch-onnxruntime.sh --{option} FOLDER` downloads, and {driver}. docs/GPU.md has the steps; \
         --device cpu needs neither"
    )]
    Device {
        device: Device,
        provider: &'static str,
        option: &'static str,
        driver: &'static str,
        reason: String,
    },
    /// The library was found, but does not load or run the network.
    #[error(transparent)]
    Runtime(#[from] ReconError),
}

impl NetworkError {
    fn into_recon(self) -> ReconError {
        match self {
            Self::Runtime(error) => error,
            other => ReconError::Runtime(other.to_string()),
        }
    }
}

/// Loads networks. The library is opened on first use, because total variation does not need it.
#[derive(Debug, Clone)]
pub struct NetworkSource {
    library: Option<PathBuf>,
    /// Networks that replace the embedded ones: the contents of their files, in order.
    replaced: Arc<Vec<(Network, Vec<Vec<u8>>)>>,
    /// The records of [`Network::ALL`]: each is hashed once, as every tile and every submission asks for them.
    records: Arc<[OnceLock<ModelRecord>; Network::ALL.len()]>,
    device: Device,
    version: Arc<OnceLock<String>>,
    #[cfg(feature = "gpu")]
    gpu: Arc<OnceLock<Result<Arc<Gpu>, ReconError>>>,
}

impl NetworkSource {
    /// A source that uses this libonnxruntime or, for `None`, the one that [`find_library`] finds.
    pub fn new(library: Option<PathBuf>, device: Device) -> Self {
        Self {
            library,
            replaced: Arc::default(),
            records: Arc::default(),
            device,
            version: Arc::default(),
            #[cfg(feature = "gpu")]
            gpu: Arc::default(),
        }
    }

    /// Replaces the embedded networks by those in `folder`, which is organised like `models/`. The files are read at once, so
    /// that later changes of the folder have no effect. An empty path counts as none.
    ///
    /// # Errors
    /// [`NetworkError::NoModels`]: the folder has none of the networks. [`NetworkError::Model`]: a file can't be read.
    pub fn with_models(self, folder: Option<&Path>) -> Result<Self, NetworkError> {
        let Some(folder) = folder.filter(|folder| !folder.as_os_str().is_empty()) else {
            return Ok(self);
        };
        let found =
            Network::ALL.into_iter().filter(|which| folder.join(carried(*which).name).is_dir());
        let contents = |which| {
            let Model { name, files } = carried(which);
            let files = files.iter().map(|(file, _)| read(&folder.join(name).join(file)));
            Ok((which, files.collect::<Result<_, NetworkError>>()?))
        };
        let replaced: Vec<_> = found.map(contents).collect::<Result<_, NetworkError>>()?;
        if replaced.is_empty() {
            return Err(NetworkError::NoModels(folder.to_owned()));
        }
        Ok(Self { replaced: replaced.into(), records: Arc::default(), ..self })
    }

    /// True if a folder's network replaces one of the schedule.
    pub fn replaces(&self, schedule: &Schedule) -> bool {
        schedule.networks().into_iter().any(|network| self.replacement(network).is_some())
    }

    fn replacement(&self, network: Network) -> Option<&[Vec<u8>]> {
        let files = self.replaced.iter().find(|(which, _)| *which == network);
        files.map(|(_, files)| files.as_slice())
    }

    /// The record of a network.
    pub fn record(&self, network: Network) -> ModelRecord {
        let new = || {
            let model = carried(network);
            match self.replacement(network) {
                Some(files) => ModelRecord::new(&model, files.iter().map(Vec::as_slice)),
                None => ModelRecord::new(&model, model.files.iter().map(|(_, file)| *file)),
            }
        };
        let kept = Network::ALL.iter().zip(&*self.records).find(|(which, _)| **which == network);
        kept.map_or_else(new, |(_, record)| record.get_or_init(new).clone())
    }

    /// The records of the networks that a schedule uses, in a fixed order.
    pub fn records(&self, schedule: &Schedule) -> Vec<ModelRecord> {
        schedule.networks().into_iter().map(|network| self.record(network)).collect()
    }

    /// Checks that the networks of a schedule are those that were recorded for its job.
    ///
    /// # Errors
    /// [`NetworkError::Changed`] with the name of a network that differs.
    pub fn check(&self, schedule: &Schedule, recorded: &[ModelRecord]) -> Result<(), NetworkError> {
        let changed = self.records(schedule).into_iter().find(|record| !recorded.contains(record));
        changed.map_or(Ok(()), |record| Err(NetworkError::Changed(record.name)))
    }

    /// A schedule with the precision of networks that suits this device. A folder's FastDVDNet without an 8-bit version runs
    /// with its 32-bit weights.
    #[must_use]
    pub fn suited(&self, schedule: Schedule) -> Schedule {
        let only_float = self.replacement(Network::FastDvdNet).is_some()
            && self.replacement(Network::FastDvdNetInt8).is_none();
        let keeps = self.device == Device::Cpu && !only_float;
        if keeps { schedule } else { schedule.with_float_networks() }
    }

    /// The device for a network. GPUs have no operators for 8 bits, and results must not depend on the worker.
    fn device_for(&self, network: Network) -> Device {
        if network == Network::FastDvdNetInt8 { Device::Cpu } else { self.device }
    }

    /// The contents of the files of a network, in order.
    fn contents(&self, network: Network) -> Vec<Cow<'static, [u8]>> {
        match self.replacement(network) {
            Some(files) => files.iter().map(|file| Cow::Owned(file.clone())).collect(),
            None => carried(network).files.iter().map(|(_, file)| Cow::Borrowed(*file)).collect(),
        }
    }

    /// Name of the execution provider of the networks of a schedule, for records: that of the GPU if any runs there. A schedule
    /// without networks stands for an end-to-end network.
    pub fn provider(&self, schedule: &Schedule) -> &'static str {
        let mut devices = schedule.networks().into_iter().map(|network| self.device_for(network));
        let is_on_cpu = schedule.needs_network() && devices.all(|device| device == Device::Cpu);
        if is_on_cpu { Device::Cpu.provider() } else { self.device.provider() }
    }

    /// The device that runs the networks.
    pub fn device(&self) -> Device {
        self.device
    }

    /// Runs a small network on the device and compares the result with the CPU's. Does nothing for the CPU.
    ///
    /// # Errors
    /// [`NetworkError::Device`] with the reason and the remedy.
    pub fn try_device(&self) -> Result<(), NetworkError> {
        if self.device == Device::Cpu {
            return Ok(());
        }
        self.agreement().map(drop).map_err(|reason| {
            let (option, driver) = match self.device {
                Device::Cuda(_) => ("cuda", "NVIDIA's driver with CUDA and cuDNN"),
                Device::Cpu | Device::Gpu => ("gpu", "a Vulkan driver of the card with libvulkan1"),
            };
            let (device, provider) = (self.device, self.device.provider());
            NetworkError::Device { device, provider, option, driver, reason }
        })
    }

    /// The GPU that runs the solver, opened at the first call. `None` with `--device cpu` or `cuda:N`.
    ///
    /// # Errors
    /// It can't be used.
    #[cfg(feature = "gpu")]
    pub fn gpu(&self) -> Result<Option<Arc<Gpu>>, ReconError> {
        if self.device != Device::Gpu {
            return Ok(None);
        }
        let opened = self.gpu.get_or_init(|| Gpu::open().map(Arc::new));
        let opened = opened.as_ref().map_err(|error| ReconError::Runtime(error.to_string()))?;
        Ok(Some(Arc::clone(opened)))
    }

    /// The GPU that runs the solver, for records. `None` if the CPU does.
    pub fn gpu_name(&self) -> Option<String> {
        #[cfg(feature = "gpu")]
        {
            Some(self.gpu().ok()??.name().to_owned())
        }
        #[cfg(not(feature = "gpu"))]
        None
    }

    /// Largest difference between the GPU and the CPU in a few iterations of total variation.
    #[cfg(feature = "gpu")]
    fn kernel_difference(&self) -> Result<f32, ReconError> {
        let masks = Array3::from_shape_fn((3, 16, 16), |(k, i, j)| ((i * j + k) % 3) as f32 / 2.0);
        let operator = SensingOperator::new(masks)?;
        let ramp = Array3::from_shape_fn((3, 16, 16), |(k, i, j)| (k + i + j) as f32 / 32.0);
        let y = operator.forward(ramp.view())?;
        let schedule = Schedule::gap_tv3d().with_iterations(3);
        let solve = |networks: &mut dyn Networks| {
            let solved = reconstruct(&operator, y.view(), &schedule, networks, &mut ());
            solved.map(|outcome| outcome.frames)
        };
        let on_gpu = solve(&mut WarmNetworks::new(self.clone()))?;
        Ok(largest_difference(&on_gpu, &solve(&mut ())?))
    }

    /// Largest difference between the device and the CPU in a pass of FFDNet over a small ramp.
    fn agreement(&self) -> Result<f32, String> {
        let text = |error: &dyn std::fmt::Display| error.to_string();
        let path = self.path().map_err(|error| text(&error))?;
        let files = carried(Network::FfdNet).files;
        let pass = |device| -> Result<Array3<f32>, ReconError> {
            let runtime = Runtime::open(&path, device)?;
            let mut frames =
                Array3::from_shape_fn((1, 16, 16), |(_, i, j)| (i * 16 + j) as f32 / 255.0);
            let files = files.iter().map(|(_, content)| Cow::Borrowed(*content));
            ClipDenoiser::load(&runtime, Network::FfdNet, files)?.denoise(&mut frames, 0.1)?;
            Ok(frames)
        };
        let on_device = pass(self.device).map_err(|error| text(&error))?;
        let on_cpu = pass(Device::Cpu).map_err(|error| text(&error))?;
        let largest = largest_difference(&on_device, &on_cpu);
        #[cfg(feature = "gpu")]
        let largest = largest + self.kernel_difference().map_err(|error| text(&error))?;
        if largest <= MAX_DIFFERENCE {
            return Ok(largest);
        }
        Err(format!("its results differ from the CPU's by {largest}, more than {MAX_DIFFERENCE}"))
    }

    /// Version of the library, for records; loads it.
    pub fn version(&self) -> Result<String, NetworkError> {
        let runtime = self.runtime()?;
        let path = self.path()?;
        let read = || {
            let version = fs::read(&path).ok().and_then(|library| version_in(&library));
            version.unwrap_or_else(|| runtime.build_info().to_owned())
        };
        Ok(self.version.get_or_init(read).clone())
    }

    /// Loads a network with separate sessions for these cores.
    fn load(&self, network: Network, cores: &Cores) -> Result<ClipDenoiser, NetworkError> {
        let runtime = Runtime::open(&self.path()?, self.device_for(network))?;
        let runtime = runtime.with_cores(cores.clone());
        Ok(ClipDenoiser::load(&runtime, network, self.contents(network))?)
    }

    /// Loads the encoder with a separate session for these cores.
    fn encoder(&self, cores: &Cores) -> Result<ClipEncoder, NetworkError> {
        let runtime = self.runtime()?.with_cores(cores.clone());
        Ok(ClipEncoder::load(&runtime, FASTDVDNET_GRAY_ENCODER)?)
    }

    /// Loads an end-to-end network from an ONNX file, with a separate session for one thread.
    ///
    /// Errors: [`NetworkError::Missing`] without a library, [`NetworkError::Runtime`] if the network can't be loaded.
    pub fn end_to_end(&self, content: &[u8]) -> Result<EndToEndNetwork, NetworkError> {
        Ok(EndToEndNetwork::load(&self.runtime()?, content)?)
    }

    fn runtime(&self) -> Result<Runtime, NetworkError> {
        Ok(Runtime::open(&self.path()?, self.device)?)
    }

    fn path(&self) -> Result<PathBuf, NetworkError> {
        find_library(self.library.as_deref())
    }
}

/// Path of libonnxruntime: the stated one or, for `None`, the first one near the program. It is not opened.
///
/// Errors: [`NetworkError::Missing`].
pub fn find_library(stated: Option<&Path>) -> Result<PathBuf, NetworkError> {
    // An empty environment variable counts as not set.
    if let Some(library) = stated.filter(|path| !path.as_os_str().is_empty()) {
        return existing(library).ok_or_else(|| {
            let path = library.display();
            NetworkError::Missing(match library.try_exists() {
                // Confined workers run as another user.
                Err(error) => format!(
                    "{path} can't be read ({error}); choose a folder that all users can read"
                ),
                Ok(_) => format!("there is no file {path}"),
            })
        });
    }
    let executable = std::env::current_exe().and_then(|path| path.canonicalize());
    let executable = executable.map_err(|error| {
        NetworkError::Missing(format!("the path of the program is unknown ({error})"))
    })?;
    find_near(&executable).ok_or_else(|| {
        let folder = executable.parent().unwrap_or(Path::new("/")).display();
        NetworkError::Missing(format!(
            "no path is stated, and it is neither in {folder} nor, relative to that folder, in {}",
            LIBRARY_FOLDERS[1..].join(", ")
        ))
    })
}

/// The library in the first of [`LIBRARY_FOLDERS`] that contains it.
fn find_near(executable: &Path) -> Option<PathBuf> {
    let folder = executable.parent()?;
    LIBRARY_FOLDERS.iter().find_map(|place| existing(&folder.join(place).join(LIBRARY)))
}

/// The networks and cores of one reconstruction after another. Each network is loaded on first use and kept.
pub struct WarmNetworks {
    source: NetworkSource,
    cores: Cores,
    loaded: Vec<(Network, ClipDenoiser)>,
    encoder: Option<ClipEncoder>,
    /// The most recently used end-to-end network.
    end_to_end: Option<(Sha256, EndToEndNetwork)>,
}

impl WarmNetworks {
    /// An empty cache of networks from `source`, and one core.
    pub fn new(source: NetworkSource) -> Self {
        let cores = Cores::default();
        Self { source, cores, loaded: Vec::new(), encoder: None, end_to_end: None }
    }

    /// Uses these cores.
    #[must_use]
    pub fn with_cores(self, cores: Cores) -> Self {
        Self { cores, ..self }
    }

    /// The end-to-end network in this file. It replaces the one that was used before.
    pub fn end_to_end(&mut self, file: &ModelFile) -> Result<&mut EndToEndNetwork, NetworkError> {
        let loaded = self.end_to_end.take().filter(|(sha256, _)| *sha256 == file.sha256());
        let network = match loaded {
            Some((_, network)) => network,
            None => self.source.end_to_end(&file.content()?)?,
        };
        Ok(&mut self.end_to_end.insert((file.sha256(), network)).1)
    }

    /// Frees the networks, which are loaded again on their next use.
    pub fn clear(&mut self) {
        (self.loaded, self.encoder, self.end_to_end) = (Vec::new(), None, None);
    }

    /// The source of the networks.
    pub fn source(&self) -> &NetworkSource {
        &self.source
    }
}

impl Networks for WarmNetworks {
    fn cores(&self) -> Cores {
        self.cores.clone()
    }

    fn network(&mut self, network: Network) -> Result<&mut dyn Denoiser, ReconError> {
        let index = match self.loaded.iter().position(|(key, _)| *key == network) {
            Some(index) => index,
            None => {
                let denoiser = self.source.load(network, &self.cores);
                let denoiser = denoiser.map_err(NetworkError::into_recon)?;
                self.loaded.push((network, denoiser));
                self.loaded.len() - 1
            }
        };
        Ok(&mut self.loaded[index].1)
    }

    fn encoder(&mut self) -> Result<Option<&mut dyn Encoder>, ReconError> {
        let encoder = match self.encoder.take() {
            Some(encoder) => encoder,
            None => self.source.encoder(&self.cores).map_err(NetworkError::into_recon)?,
        };
        Ok(Some(self.encoder.insert(encoder)))
    }

    #[cfg(feature = "gpu")]
    fn gpu(&mut self) -> Result<Option<Arc<Gpu>>, ReconError> {
        self.source.gpu()
    }
}

/// Largest difference between two clips; NaN if any value is.
fn largest_difference(one: &Array3<f32>, other: &Array3<f32>) -> f32 {
    let differences = one.iter().zip(other).map(|(a, b)| (a - b).abs());
    // `f32::max` would drop a NaN.
    differences.fold(0.0, |one: f32, other| if other <= one { one } else { other })
}

fn existing(path: &Path) -> Option<PathBuf> {
    path.is_file().then(|| path.to_path_buf())
}

/// The version in the symbol versions of a libonnxruntime, such as `1.31.1`. The build information from its API
/// contains only a commit.
fn version_in(library: &[u8]) -> Option<String> {
    const MARK: &[u8] = b"\0VERS_";
    let start = library.windows(MARK.len()).position(|window| window == MARK)?;
    let rest = &library[start + MARK.len()..];
    let is_version = |byte: &u8| byte.is_ascii_digit() || *byte == b'.';
    let version: Vec<u8> = rest.iter().copied().take_while(is_version).collect();
    String::from_utf8(version).ok().filter(|version| version.contains('.'))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::{
        FASTDVDNET_GRAY_ENCODER, LIBRARY, LIBRARY_FOLDERS, ModelFile, NetworkSource, carried,
        find_near, version_in,
    };
    use crate::job::{Algorithm, Sha256};
    use reconstruction::cores::Cores;
    use reconstruction::priors::Network;
    use reconstruction::priors::onnx::Device;

    #[test]
    fn the_version_is_read_from_the_symbols() {
        let library = b"\x7fELF\0VERS_1.31.1\0OrtGetApiBase\0";
        assert_eq!(version_in(library).as_deref(), Some("1.31.1"));
        assert_eq!(version_in(b"\0VERS_\0"), None);
        assert_eq!(version_in(b"nothing"), None);
    }

    #[test]
    fn the_library_is_found_in_each_folder() {
        for place in LIBRARY_FOLDERS {
            let root = tempfile::tempdir().unwrap();
            let folder = root.path().join("target/release");
            fs::create_dir_all(&folder).unwrap();
            let program = folder.join("sci-recon");
            assert_eq!(find_near(&program), None);
            fs::create_dir_all(folder.join(place)).unwrap();
            fs::write(folder.join(place).join(LIBRARY), "").unwrap();
            assert_eq!(find_near(&program), Some(folder.join(place).join(LIBRARY)));
        }
    }

    #[test]
    fn the_error_names_the_missing_library() {
        let source = NetworkSource::new(Some("/nowhere/libonnxruntime.so".into()), Device::Cpu);
        let error = source.load(Network::FfdNet, &Cores::default()).err().unwrap().to_string();
        assert!(error.contains("/nowhere/libonnxruntime.so"), "{error}");
        assert!(error.contains("--onnxruntime"), "{error}");
    }

    #[test]
    fn the_schedule_decides_the_network_on_every_device() {
        let algorithm = Algorithm::PnpTvFastdvdnet;
        for device in [Device::Cpu, Device::Gpu, Device::Cuda(0)] {
            let source = NetworkSource::new(None, device);
            let name = |schedule| source.records(&schedule).remove(0).name;
            let (quick, exact) =
                (algorithm.default_schedule(), algorithm.default_schedule().with_float_networks());
            assert_eq!(source.provider(&quick), "CPUExecutionProvider");
            assert_eq!(source.provider(&exact), device.provider());
            assert_eq!(algorithm.misfit(&exact), None);
            assert_eq!((&*name(quick), &*name(exact)), ("fastdvdnet-gray-int8", "fastdvdnet-gray"));
        }
    }

    #[test]
    fn networks_of_a_folder_replace_the_embedded_ones_and_are_recorded() {
        let carried = NetworkSource::new(None, Device::Cpu);
        let folder = tempfile::tempdir().unwrap();
        let custom = || carried.clone().with_models(Some(folder.path()));
        let schedule = Algorithm::PnpFfdnet.default_schedule();
        let error = custom().unwrap_err().to_string();
        assert!(error.contains("none of the networks ffdnet-gray"), "{error}");

        let file = folder.path().join("ffdnet-gray/model.onnx");
        std::fs::create_dir(file.parent().unwrap()).unwrap();
        let error = custom().unwrap_err().to_string();
        assert!(error.contains("ffdnet-gray/model.onnx"), "{error}");
        let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/ffdnet-gray/model.onnx");
        let mut content = std::fs::read(shipped).unwrap();
        std::fs::write(&file, &content).unwrap();
        assert_eq!(custom().unwrap().records(&schedule), carried.records(&schedule));
        content.push(0);
        std::fs::write(&file, &content).unwrap();
        let custom = custom().unwrap();
        assert_ne!(custom.records(&schedule), carried.records(&schedule));
        assert!(custom.replaces(&schedule) && !carried.replaces(&schedule));
        custom.check(&schedule, &custom.records(&schedule)).unwrap();
        let error = custom.check(&schedule, &carried.records(&schedule)).unwrap_err().to_string();
        assert!(error.contains("(ffdnet-gray)"), "{error}");
        let default = Algorithm::PnpTvFastdvdnet.default_schedule();
        assert!(!custom.replaces(&default));
        assert_eq!(custom.suited(default.clone()), default);
    }

    #[test]
    fn a_network_without_an_8_bit_version_runs_in_32_bits() {
        let folder = tempfile::tempdir().unwrap();
        std::fs::create_dir(folder.path().join("fastdvdnet-gray")).unwrap();
        for file in ["stage1.onnx", "stage2.onnx"] {
            std::fs::write(folder.path().join("fastdvdnet-gray").join(file), file).unwrap();
        }
        let source =
            NetworkSource::new(None, Device::Cpu).with_models(Some(folder.path())).unwrap();
        let schedule = source.suited(Algorithm::PnpTvFastdvdnet.default_schedule());
        assert_eq!(schedule, Algorithm::PnpTvFastdvdnet.default_schedule().with_float_networks());
        assert!(source.replaces(&schedule));
    }

    #[test]
    fn the_8_bit_network_is_quantized_from_these_weights() {
        let (exact, quick) = (carried(Network::FastDvdNet), carried(Network::FastDvdNetInt8));
        for ((name, exact), (_, quick)) in exact.files.iter().zip(quick.files) {
            // `research/training/quantize.py` writes the hash into the metadata of the file.
            let source = Sha256::of(exact).to_string();
            let is_current = quick.windows(source.len()).any(|window| window == source.as_bytes());
            assert!(is_current, "{name}: quantize again with research/training/quantize.py");
        }
    }

    #[test]
    fn the_quality_model_is_fitted_to_this_encoder() {
        let quality = include_bytes!("../../../../models/quality/model.onnx");
        // `research/training/assessment.py` writes the hash into the metadata of the file.
        let hash = Sha256::of(FASTDVDNET_GRAY_ENCODER).to_string();
        assert!(quality.windows(hash.len()).any(|window| window == hash.as_bytes()));
    }

    #[test]
    fn damaged_model_files_are_refused() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("network.onnx");
        std::fs::write(&path, "original").unwrap();
        let file = ModelFile::open(&path).unwrap();
        assert_eq!(file.content().unwrap(), b"original");
        std::fs::write(&path, "changed").unwrap();
        assert!(file.content().unwrap_err().to_string().contains("damaged"));
    }
}
