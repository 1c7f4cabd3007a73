//! Networks: those that the program carries, those of a folder, end-to-end networks of a user's own,
//! and the libonnxruntime that runs them.

use std::borrow::Cow;
use std::collections::BTreeSet;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};
use std::sync::{Arc, OnceLock};

use serde::{Deserialize, Serialize};
use sha2::Digest;

use crate::job::{JobSpec, Label, Schedule, Sha256};
use reconstruction::ReconError;
use reconstruction::priors::network::{ClipDenoiser, ClipEncoder};
use reconstruction::priors::onnx::{Device, EndToEndNetwork, Runtime};
use reconstruction::priors::{Denoiser, Encoder, Network, Networks};

/// A network in its ONNX files, embedded so that the program needs nothing beside libonnxruntime.
#[derive(Debug, Clone, Copy)]
pub struct Model {
    pub name: &'static str,
    /// The files, in the order in which a frame goes through them: name and content.
    pub files: &'static [(&'static str, &'static [u8])],
}

/// The model of a network, trained for this project (see its model card in `models/`).
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

/// What results are assessed by. It is always the one that the program carries: predictions are fitted to what it sees.
const FASTDVDNET_GRAY_ENCODER: &[u8] =
    include_bytes!("../../../../models/fastdvdnet-gray-encoder/model.onnx");

const FFDNET_GRAY: Model = Model {
    name: "ffdnet-gray",
    files: &[("model.onnx", include_bytes!("../../../../models/ffdnet-gray/model.onnx"))],
};

/// A network, as it stands in manifests.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct ModelRecord {
    pub name: String,
    /// SHA-256 of its ONNX files, one after the other.
    pub sha256: String,
}

impl ModelRecord {
    /// That of a network that the program carries.
    pub fn carried(network: Network) -> Self {
        let model = carried(network);
        Self::new(&model, model.files.iter().map(|(_, content)| *content))
    }

    /// Those of a schedule that the program carries, in a fixed order.
    pub fn of(schedule: &Schedule) -> Vec<Self> {
        schedule.networks().into_iter().map(Self::carried).collect()
    }

    pub fn of_job(spec: &JobSpec) -> Vec<Self> {
        let model = spec.model.as_ref().map(|model| Self {
            name: model.name.as_ref().map_or("learned", Label::as_str).to_owned(),
            sha256: model.sha256.to_string(),
        });
        Self::of(&spec.schedule).into_iter().chain(model).collect()
    }

    /// That of a model with these contents of its files.
    fn new<'a>(model: &Model, contents: impl Iterator<Item = &'a [u8]>) -> Self {
        let digest = contents.fold(sha2::Sha256::new(), Digest::chain_update);
        let sha256 = Sha256::new(digest.finalize().into()).to_string();
        Self { name: model.name.into(), sha256 }
    }
}

/// An end-to-end network in its ONNX file.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct ModelFile {
    path: PathBuf,
    sha256: Sha256,
}

impl ModelFile {
    /// A file that should have this hash.
    pub fn new(path: PathBuf, sha256: Sha256) -> Self {
        Self { path, sha256 }
    }

    pub fn open(path: &Path) -> Result<Self, NetworkError> {
        let bytes = read(path)?;
        Ok(Self { path: path.to_owned(), sha256: Sha256::of(&bytes) })
    }

    /// The hash of the file.
    pub fn sha256(&self) -> Sha256 {
        self.sha256
    }

    /// The file's bytes.
    /// Errors: it can't be read, or is not what its hash says.
    pub fn content(&self) -> Result<Vec<u8>, NetworkError> {
        let bytes = read(&self.path)?;
        let found = Sha256::of(&bytes);
        if found == self.sha256 {
            return Ok(bytes);
        }
        Err(NetworkError::Damaged { expected: self.sha256, found })
    }
}

fn read(path: &Path) -> Result<Vec<u8>, NetworkError> {
    fs::read(path).map_err(|reason| NetworkError::Model { path: path.to_owned(), reason })
}

/// The library's name.
const LIBRARY: &str = "libonnxruntime.so";
/// Where it is looked for, from the folder of the program: beside it, where `make install` puts it, in the
/// lib folder of a system, and where scripts/fetch-onnxruntime.sh does in a source tree.
const PLACES: [&str; 4] = [".", "../lib/sci-recon", "../lib", "../../runtime"];

/// Why there is no denoiser.
#[derive(Debug, thiserror::Error)]
pub enum NetworkError {
    #[error(
        "no libonnxruntime: {0}; name it with --onnxruntime or ORT_DYLIB_PATH, or fetch it with \
         scripts/fetch-onnxruntime.sh FOLDER of the source tree and put it beside the program"
    )]
    Missing(String),
    #[error("model {}: {reason}", path.display())]
    Model { path: PathBuf, reason: io::Error },
    #[error("the network's file is damaged: its hash should be {expected}, but is {found}")]
    Damaged { expected: Sha256, found: Sha256 },
    /// It was found, but the network does not run on it.
    #[error(transparent)]
    Runtime(#[from] ReconError),
}

/// Loads denoisers. Nothing is opened before the first one is asked for: TV needs no library.
#[derive(Debug, Clone)]
pub struct NetworkSource {
    library: Option<PathBuf>,
    models: Option<PathBuf>,
    device: Device,
    version: Arc<OnceLock<String>>,
}

impl NetworkSource {
    /// `library` is a libonnxruntime, or none for the one near the executable ([`find_library`]).
    pub fn new(library: Option<PathBuf>, device: Device) -> Self {
        Self { library, models: None, device, version: Arc::default() }
    }

    /// The same with the networks in `folder`, one folder of ONNX files each as in `models/`,
    /// instead of those that the program carries.
    pub fn with_models(self, folder: Option<PathBuf>) -> Self {
        Self { models: folder, ..self }
    }

    pub fn records(&self, schedule: &Schedule) -> Result<Vec<ModelRecord>, NetworkError> {
        let record = |network| {
            let contents = self.contents(network)?;
            Ok(ModelRecord::new(&carried(network), contents.iter().map(AsRef::as_ref)))
        };
        let used: BTreeSet<_> = schedule.networks().into_iter().map(|n| self.used(n)).collect();
        used.into_iter().map(record).collect()
    }

    /// The network that stands for `asked` on the device: 8 bits pay on a CPU only.
    fn used(&self, asked: Network) -> Network {
        match (asked, self.device) {
            (Network::FastDvdNetInt8, Device::Cuda(_)) => Network::FastDvdNet,
            _ => asked,
        }
    }

    /// The bytes of the files of a network, in their order.
    fn contents(&self, which: Network) -> Result<Vec<Cow<'static, [u8]>>, NetworkError> {
        let Model { name, files } = carried(which);
        let content = |&(file, carried): &(&str, &'static [u8])| match &self.models {
            None => Ok(Cow::Borrowed(carried)),
            Some(folder) => read(&folder.join(name).join(file)).map(Cow::Owned),
        };
        files.iter().map(content).collect()
    }

    /// Name of the execution provider, for records.
    pub fn provider(&self) -> &'static str {
        self.device.provider()
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

    /// A network with sessions of its own, for one thread.
    fn load(&self, which: Network) -> Result<ClipDenoiser, NetworkError> {
        Ok(ClipDenoiser::load(&self.runtime()?, which, &self.contents(which)?)?)
    }

    /// The encoder with a session of its own, for one thread.
    fn encoder(&self) -> Result<ClipEncoder, NetworkError> {
        Ok(ClipEncoder::load(&self.runtime()?, FASTDVDNET_GRAY_ENCODER)?)
    }

    /// An end-to-end network with a session of its own, for one thread.
    /// Errors: no library; these bytes of an ONNX file hold no network that can be run.
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

/// The libonnxruntime that is named, or else the one near the program. It is not opened.
/// Errors: there is none.
pub fn find_library(named: Option<&Path>) -> Result<PathBuf, NetworkError> {
    // An empty variable is one that is not set.
    if let Some(library) = named.filter(|path| !path.as_os_str().is_empty()) {
        return existing(library).ok_or_else(|| {
            NetworkError::Missing(format!("there is no file {}", library.display()))
        });
    }
    let executable = std::env::current_exe().and_then(|path| path.canonicalize());
    let executable = executable
        .map_err(|error| NetworkError::Missing(format!("the program's own path: {error}")))?;
    near(&executable).ok_or_else(|| {
        let folder = executable.parent().unwrap_or(Path::new("/")).display();
        NetworkError::Missing(format!(
            "none is named, and none is in {folder} or, from there, in {}",
            PLACES[1..].join(", ")
        ))
    })
}

/// The library at the first place from an executable where there is one.
fn near(executable: &Path) -> Option<PathBuf> {
    let folder = executable.parent()?;
    PLACES.iter().find_map(|place| existing(&folder.join(place).join(LIBRARY)))
}

/// Networks of one thread: each is loaded at its first use and stays warm.
pub struct WarmNetworks {
    source: NetworkSource,
    loaded: Vec<(Network, ClipDenoiser)>,
    encoder: Option<ClipEncoder>,
    /// The last end-to-end network.
    end_to_end: Option<(Sha256, EndToEndNetwork)>,
}

impl WarmNetworks {
    /// Networks from `source`, none of them loaded yet.
    pub fn new(source: NetworkSource) -> Self {
        Self { source, loaded: Vec::new(), encoder: None, end_to_end: None }
    }

    /// The end-to-end network in this file, which is kept until another one is asked for.
    pub fn end_to_end(&mut self, file: &ModelFile) -> Result<&mut EndToEndNetwork, NetworkError> {
        let warm = self.end_to_end.take().filter(|(sha256, _)| *sha256 == file.sha256());
        let network = match warm {
            Some((_, network)) => network,
            None => self.source.end_to_end(&file.content()?)?,
        };
        Ok(&mut self.end_to_end.insert((file.sha256(), network)).1)
    }

    pub fn source(&self) -> &NetworkSource {
        &self.source
    }
}

impl Networks for WarmNetworks {
    fn network(&mut self, asked: Network) -> Result<&mut dyn Denoiser, ReconError> {
        let which = self.source.used(asked);
        let index = match self.loaded.iter().position(|(kind, _)| *kind == which) {
            Some(index) => index,
            None => {
                let network = self.source.load(which);
                let network = network.map_err(|error| ReconError::Runtime(error.to_string()))?;
                self.loaded.push((which, network));
                self.loaded.len() - 1
            }
        };
        Ok(&mut self.loaded[index].1)
    }

    fn encoder(&mut self) -> Result<Option<&mut dyn Encoder>, ReconError> {
        let encoder = match self.encoder.take() {
            Some(encoder) => encoder,
            None => {
                let loaded = self.source.encoder();
                loaded.map_err(|error| ReconError::Runtime(error.to_string()))?
            }
        };
        Ok(Some(self.encoder.insert(encoder)))
    }
}

fn existing(path: &Path) -> Option<PathBuf> {
    path.is_file().then(|| path.to_path_buf())
}

/// The version that a libonnxruntime gives to its symbols, such as `1.31.1`. What it tells of
/// its build through its own interface names a commit only.
fn version_in(library: &[u8]) -> Option<String> {
    const MARK: &[u8] = b"\0VERS_";
    let at = library.windows(MARK.len()).position(|window| window == MARK)?;
    let rest = &library[at + MARK.len()..];
    let is_version = |byte: &u8| byte.is_ascii_digit() || *byte == b'.';
    let version: Vec<u8> = rest.iter().copied().take_while(is_version).collect();
    String::from_utf8(version).ok().filter(|version| version.contains('.'))
}

#[cfg(test)]
mod tests {
    use std::fs;

    use super::{
        FASTDVDNET_GRAY_ENCODER, LIBRARY, ModelFile, NetworkSource, PLACES, carried, near,
        version_in,
    };
    use crate::job::{Algorithm, Sha256};
    use reconstruction::priors::Network;
    use reconstruction::priors::onnx::Device;

    #[test]
    fn the_version_is_that_of_the_symbols() {
        let library = b"\x7fELF\0VERS_1.31.1\0OrtGetApiBase\0";
        assert_eq!(version_in(library).as_deref(), Some("1.31.1"));
        assert_eq!(version_in(b"\0VERS_\0"), None);
        assert_eq!(version_in(b"nothing"), None);
    }

    #[test]
    fn a_library_is_found_where_it_is_put() {
        for place in PLACES {
            let root = tempfile::tempdir().unwrap();
            let folder = root.path().join("target/release");
            fs::create_dir_all(&folder).unwrap();
            let program = folder.join("sci-recon");
            assert_eq!(near(&program), None);
            fs::create_dir_all(folder.join(place)).unwrap();
            fs::write(folder.join(place).join(LIBRARY), "").unwrap();
            assert_eq!(near(&program), Some(folder.join(place).join(LIBRARY)));
        }
    }

    #[test]
    fn a_missing_library_is_named() {
        let source = NetworkSource::new(Some("/nowhere/libonnxruntime.so".into()), Device::Cpu);
        let error = source.load(Network::FfdNet).err().unwrap().to_string();
        assert!(error.contains("/nowhere/libonnxruntime.so"), "{error}");
        assert!(error.contains("--onnxruntime"), "{error}");
    }

    #[test]
    fn a_gpu_computes_with_floating_point_and_the_records_say_so() {
        let schedule = Algorithm::PnpFastdvdnet.default_schedule();
        let names = |device| -> Vec<String> {
            let records = NetworkSource::new(None, device).records(&schedule).unwrap();
            records.into_iter().map(|record| record.name).collect()
        };
        assert_eq!(names(Device::Cpu), ["fastdvdnet-gray", "fastdvdnet-gray-int8"]);
        assert_eq!(names(Device::Cuda(0)), ["fastdvdnet-gray"]);
    }

    #[test]
    fn networks_of_a_folder_replace_the_carried_ones_and_are_recorded() {
        let carried = NetworkSource::new(None, Device::Cpu);
        let folder = tempfile::tempdir().unwrap();
        let own = carried.clone().with_models(Some(folder.path().into()));
        let schedule = Algorithm::PnpFfdnet.default_schedule();
        let error = own.records(&schedule).unwrap_err().to_string();
        assert!(error.contains("ffdnet-gray/model.onnx"), "{error}");

        let file = folder.path().join("ffdnet-gray/model.onnx");
        std::fs::create_dir(file.parent().unwrap()).unwrap();
        let shipped = concat!(env!("CARGO_MANIFEST_DIR"), "/../../models/ffdnet-gray/model.onnx");
        let mut content = std::fs::read(shipped).unwrap();
        std::fs::write(&file, &content).unwrap();
        assert_eq!(own.records(&schedule).unwrap(), carried.records(&schedule).unwrap());
        content.push(0);
        std::fs::write(&file, &content).unwrap();
        assert_ne!(own.records(&schedule).unwrap(), carried.records(&schedule).unwrap());
    }

    #[test]
    fn the_twin_with_8_bits_was_made_from_these_weights() {
        let (exact, quick) = (carried(Network::FastDvdNet), carried(Network::FastDvdNetInt8));
        for ((name, exact), (_, quick)) in exact.files.iter().zip(quick.files) {
            // `research/training/quantize.py` writes it among the file's properties.
            let source = Sha256::of(exact).to_string();
            let found = quick.windows(source.len()).any(|window| window == source.as_bytes());
            assert!(found, "{name}: make the twin anew with research/training/quantize.py");
        }
    }

    #[test]
    fn predictions_are_fitted_to_this_encoder() {
        let models: serde_json::Value =
            serde_json::from_str(include_str!("../../../reconstruction/src/assessment.json"))
                .unwrap();
        let models = models.as_object().unwrap().values();
        let encodings = models.map(|model| &model["encoding"]).filter(|it| !it.is_null());
        let own = Sha256::of(FASTDVDNET_GRAY_ENCODER).to_string();
        assert_eq!(encodings.map(|encoding| &encoding["encoder"]).collect::<Vec<_>>(), [&own; 2]);
    }

    #[test]
    fn a_damaged_file_is_not_run() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("network.onnx");
        std::fs::write(&path, "as it was").unwrap();
        let file = ModelFile::open(&path).unwrap();
        assert_eq!(file.content().unwrap(), b"as it was");
        std::fs::write(&path, "as it is").unwrap();
        assert!(file.content().unwrap_err().to_string().contains("damaged"));
    }
}
