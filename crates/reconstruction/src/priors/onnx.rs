//! ONNX Runtime. No other file uses `ort`.

use std::borrow::Cow;
use std::fmt;
use std::path::Path;
use std::sync::OnceLock;

use ndarray::{Array3, ArrayView2, ArrayView3, ArrayView4, Axis};
use ort::environment::Environment;
use ort::ep::{CUDA, WebGPU};
use ort::session::Session;
use ort::session::builder::GraphOptimizationLevel;
use ort::value::{Outlet, Tensor, TensorElementType, TensorRef, ValueType};

use crate::cores::Cores;
use crate::error::{ReconError, Result, shape_text};
use crate::learned::{
    FRAMES, Interface, MASKS, MEASUREMENT, SnapshotNetwork, TensorInfo, all_finite,
};

/// Where a network runs.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub enum Device {
    /// The processor.
    #[default]
    Cpu,
    /// The first adapter of the WebGPU execution provider: a GPU of any vendor.
    Gpu,
    /// The CUDA device with this number.
    Cuda(i32),
}

impl Device {
    /// Reads `cpu`, `gpu`, `gpu:0` or `cuda:N`.
    ///
    /// # Errors
    /// The text has another form, or names an adapter that the WebGPU provider can't select.
    pub fn parse(text: &str) -> Result<Self> {
        let number = |prefix| {
            let digits: &str = text.strip_prefix(prefix)?;
            // `parse` would also accept a sign.
            digits.bytes().all(|byte| byte.is_ascii_digit()).then(|| digits.parse::<i32>().ok())?
        };
        let wrong = |range: &'static str| {
            let value = format!("{text:?}");
            Err(ReconError::Parameter { name: "device".into(), value, range: range.into() })
        };
        match (text, number("gpu:"), number("cuda:")) {
            ("cpu", ..) => Ok(Self::Cpu),
            ("gpu", ..) | (_, Some(0), _) => Ok(Self::Gpu),
            (_, Some(_), _) => wrong(
                "gpu, because ONNX Runtime takes the first adapter of the Vulkan loader; to use another, start with \
                 --device gpu and name it in VK_LOADER_DEVICE_SELECT (docs/GPU.md)",
            ),
            (.., Some(number)) => Ok(Self::Cuda(number)),
            _ => wrong("cpu, gpu (a GPU of any vendor) or cuda:N (NVIDIA; cuda:0 is the first)"),
        }
    }

    /// Name of the execution provider, for records.
    pub fn provider(self) -> &'static str {
        match self {
            Self::Cpu => "CPUExecutionProvider",
            Self::Gpu => "WebGpuExecutionProvider",
            Self::Cuda(_) => "CUDAExecutionProvider",
        }
    }

    /// Explains a failed pass. Providers report the state of their driver only as text.
    fn failure(self, name: &str, error: &str) -> ReconError {
        let lower = error.to_lowercase().replace('_', " ");
        let mentions = |words: &[&str]| words.iter().any(|word| lower.contains(word));
        if self == Self::Cpu {
            ReconError::Runtime(format!("network {name}: {error}"))
        } else if mentions(&["out of memory", "out of device memory", "failed to allocate"])
            // WebGPU goes on without memory, and then refuses the buffer.
            || mentions(&["invalid buffer"])
        {
            ReconError::DeviceFull(format!(
                "the GPU has too little free memory for the network {name}: choose smaller tiles, run fewer workers \
                 on this GPU, or use --device cpu ({error})"
            ))
        } else if mentions(&["device lost", "device is lost", "device was lost", "lost device"])
            || mentions(&["illegal memory access", "unspecified launch failure"])
        {
            ReconError::DeviceLost(format!(
                "the GPU was lost during a pass of the network {name} ({error})"
            ))
        } else {
            ReconError::Runtime(format!("network {name} on {}: {error}", self.provider()))
        }
    }
}

impl fmt::Display for Device {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Cpu => f.write_str("cpu"),
            Self::Gpu => f.write_str("gpu"),
            Self::Cuda(number) => write!(f, "cuda:{number}"),
        }
    }
}

/// The loaded libonnxruntime, and the device and cores of its sessions.
#[derive(Debug, Clone)]
pub struct Runtime {
    environment: Environment,
    device: Device,
    cores: Cores,
}

/// Folder of external weights of a network. Our networks have none. Without this setting, an uploaded network could
/// name any file below the working folder.
const WEIGHTS_FOLDER: &str = "session.model_external_initializers_file_folder_path";
const NOWHERE: &str = "/dev/null/nowhere";

/// The library can be loaded once per process; the first outcome stays.
static ENVIRONMENT: OnceLock<Result<Environment, String>> = OnceLock::new();

impl Runtime {
    /// Loads `library` (a libonnxruntime of 1.24 or later) and prepares for `device`, with one core.
    ///
    /// # Errors
    /// The library is missing or too old. If the device is unavailable, loading a network fails; there is no silent
    /// fallback.
    pub fn open(library: &Path, device: Device) -> Result<Self> {
        let loaded = ENVIRONMENT.get_or_init(|| {
            let builder = ort::init_from(library).map_err(|error| {
                format!(
                    "libonnxruntime can't be loaded from {}: {error}; fetch it with \
                     scripts/fetch-onnxruntime.sh or name it with --onnxruntime",
                    library.display()
                )
            })?;
            let builder = builder.with_name("sci-recon").with_telemetry(false);
            builder.build().map_err(|error| format!("ONNX Runtime does not start: {error}"))
        });
        match loaded {
            Ok(environment) => {
                Ok(Self { environment: environment.clone(), device, cores: Cores::default() })
            }
            Err(message) => Err(ReconError::Runtime(message.clone())),
        }
    }

    /// Lets clip networks use these cores.
    #[must_use]
    pub fn with_cores(self, cores: Cores) -> Self {
        Self { cores, ..self }
    }

    /// The device that sessions run on.
    pub fn device(&self) -> Device {
        self.device
    }

    /// Description of the library's build, for records.
    pub fn build_info(&self) -> &'static str {
        ort::info()
    }

    fn session(&self, name: &str, model: &[u8], threads: usize) -> Result<Session> {
        let failed = |error: String| match self.device.failure(name, &error) {
            ReconError::Runtime(_) => ReconError::Runtime(format!(
                "the network {name} can't be loaded on {}: {error}",
                self.device.provider()
            )),
            other => other,
        };
        let build = || -> Result<Session, String> {
            let text = |error: ort::Error<ort::session::builder::SessionBuilder>| error.to_string();
            let mut builder = Session::builder(&self.environment)
                .map_err(|error| error.to_string())?
                .with_optimization_level(GraphOptimizationLevel::All)
                .map_err(text)?
                .with_intra_threads(threads)
                .map_err(text)?
                // Threads that wait for work leave their core to others.
                .with_intra_op_spinning(false)
                .map_err(text)?
                .with_inter_threads(1)
                .map_err(text)?
                .with_config_entry(WEIGHTS_FOLDER, NOWHERE)
                .map_err(text)?;
            let provider = match self.device {
                Device::Cpu => None,
                Device::Gpu => Some(WebGPU::default().build()),
                Device::Cuda(number) => Some(CUDA::default().with_device_id(number).build()),
            };
            if let Some(provider) = provider {
                // Operators on shapes run on the CPU by design, so its provider can't be excluded.
                let provider = provider.error_on_failure();
                builder = builder.with_execution_providers([provider]).map_err(text)?;
            }
            builder.commit_from_memory(model).map_err(|error| error.to_string())
        };
        build().map_err(failed)
    }
}

/// A network that maps a clip and a noise level to a clip. On a CPU it runs on the cores of its [`Runtime`].
pub struct ClipNetwork {
    name: String,
    model: Cow<'static, [u8]>,
    runtime: Runtime,
    /// The session and the number of cores for which it was loaded; none after a failure to load it.
    session: Option<(usize, Session)>,
}

impl ClipNetwork {
    /// Loads a network with inputs `frames` \[n+2,1,H,W\] and `sigma` (a number) and one
    /// output \[n,..\].
    pub fn load(runtime: &Runtime, name: &str, model: Cow<'static, [u8]>) -> Result<Self> {
        let runtime = runtime.clone();
        let mut network = Self { name: name.to_string(), model, runtime, session: None };
        let session = network.session()?;
        let inputs: Vec<&str> = session.inputs().iter().map(|input| input.name()).collect();
        if inputs != ["frames", "sigma"] || session.outputs().len() != 1 {
            return Err(ReconError::Runtime(format!(
                "the network {name} has inputs {inputs:?} and {} outputs; it must have \
                 [\"frames\", \"sigma\"] and 1",
                session.outputs().len()
            )));
        }
        Ok(network)
    }

    /// The session for the present number of cores. A session has a fixed number of threads, so it is replaced when that
    /// number changes.
    fn session(&mut self) -> Result<&mut Session> {
        let Self { name, model, runtime, session } = self;
        let threads = if runtime.device == Device::Cpu { runtime.cores.count() } else { 1 };
        // The old session is freed before the new one is loaded.
        let kept = session.take().filter(|(count, _)| *count == threads);
        let loaded = match kept {
            Some(kept) => kept,
            // The memory limit may leave no room for the stacks of threads.
            None => match runtime.session(name, model, threads) {
                Err(_) if threads > 1 => (threads, runtime.session(name, model, 1)?),
                loaded => (threads, loaded?),
            },
        };
        Ok(&mut session.insert(loaded).1)
    }

    /// Runs `frames` \[n+2,1,H,W\], in standard layout, and writes the output for the n middle ones.
    pub fn run(
        &mut self,
        frames: ArrayView4<'_, f32>,
        sigma: f32,
        output: &mut [f32],
    ) -> Result<()> {
        let (name, device) = (self.name.clone(), self.runtime.device);
        let failed = |error: ort::Error| device.failure(&name, &error.to_string());
        let frames = TensorRef::from_array_view(frames).map_err(failed)?;
        let sigma = Tensor::from_array(ndarray::arr0(sigma)).map_err(failed)?;
        let outputs = self.session()?.run(ort::inputs![frames, sigma]).map_err(failed)?;
        let (shape, values) = outputs[0].try_extract_tensor::<f32>().map_err(failed)?;
        if values.len() != output.len() {
            return Err(ReconError::Runtime(format!(
                "network {name} gave {shape} where {} values were expected",
                output.len()
            )));
        }
        output.copy_from_slice(values);
        Ok(())
    }
}

/// A network that maps a measurement and its masks to frames.
pub struct EndToEndNetwork {
    session: Session,
}

impl EndToEndNetwork {
    /// Loads a network; [`Self::interface`] describes its inputs and outputs.
    ///
    /// # Errors
    /// [`ReconError::Runtime`]: ONNX Runtime refuses the network.
    pub fn load(runtime: &Runtime, model: &[u8]) -> Result<Self> {
        Ok(Self { session: runtime.session("of the file", model, 1)? })
    }

    /// Inputs and outputs of the network.
    pub fn interface(&self) -> Interface {
        let tensors = |outlets: &[Outlet]| outlets.iter().map(tensor).collect();
        Interface {
            inputs: tensors(self.session.inputs()),
            outputs: tensors(self.session.outputs()),
        }
    }
}

impl SnapshotNetwork for EndToEndNetwork {
    fn frames(
        &mut self,
        y: ArrayView2<'_, f32>,
        masks: ArrayView3<'_, f32>,
    ) -> Result<Array3<f32>> {
        let failed = |error: ort::Error| ReconError::Runtime(format!("the network: {error}"));
        let measurement = y.insert_axis(Axis(0)).insert_axis(Axis(0));
        let measurement = TensorRef::from_array_view(measurement).map_err(failed)?;
        let stack = TensorRef::from_array_view(masks.insert_axis(Axis(0))).map_err(failed)?;
        let outputs = self
            .session
            .run(ort::inputs![MEASUREMENT => measurement, MASKS => stack])
            .map_err(failed)?;
        let (shape, values) = outputs[FRAMES].try_extract_tensor::<f32>().map_err(failed)?;
        let frames = Array3::from_shape_vec(masks.raw_dim(), values.to_vec());
        let frames = frames.map_err(|_| ReconError::Shape {
            what: "the network's output",
            found: shape.to_string(),
            expected: format!("1x{}", shape_text(masks.shape())),
        })?;
        all_finite(&frames)?;
        Ok(frames)
    }
}

fn tensor(outlet: &Outlet) -> TensorInfo {
    let name = outlet.name().to_owned();
    match outlet.dtype() {
        ValueType::Tensor { ty, shape, .. } => TensorInfo {
            name,
            element: element(*ty),
            // -1 means any length.
            sides: shape.iter().map(|&side| usize::try_from(side).ok()).collect(),
        },
        other => TensorInfo { name, element: format!("{other:?}"), sides: Vec::new() },
    }
}

/// Name of the type in ONNX and NumPy.
fn element(element: TensorElementType) -> String {
    match element {
        TensorElementType::Float32 => "float32".to_owned(),
        TensorElementType::Float64 => "float64".to_owned(),
        other => format!("{other:?}").to_lowercase(),
    }
}

#[cfg(test)]
mod tests {
    use super::Device;
    use crate::error::ReconError;

    #[test]
    fn the_text_of_a_device_is_parsed_and_printed() {
        for (text, device) in
            [("cpu", Device::Cpu), ("gpu", Device::Gpu), ("cuda:1", Device::Cuda(1))]
        {
            assert_eq!(Device::parse(text).unwrap(), device);
            assert_eq!(device.to_string(), text);
        }
        assert_eq!(Device::parse("gpu:0").unwrap(), Device::Gpu);
        let huge = format!("cuda:{}", u64::MAX);
        for text in ["", "GPU", "gpu:", "cuda", "cuda:", "cuda:-1", "cuda:+1", "gpu:x", &huge] {
            let error = Device::parse(text).unwrap_err().to_string();
            assert!(error.contains("cpu, gpu"), "{text}: {error}");
        }
        let error = Device::parse("gpu:1").unwrap_err().to_string();
        assert!(error.contains("VK_LOADER_DEVICE_SELECT"), "{error}");
    }

    #[test]
    fn a_lost_device_differs_from_a_full_one() {
        for text in [
            "A valid external Instance reference no longer exists: Device is lost",
            "VK_ERROR_DEVICE_LOST",
        ] {
            let error = Device::Gpu.failure("n", text);
            assert!(matches!(error, ReconError::DeviceLost(_)), "{error:?}");
            assert!(matches!(Device::Cpu.failure("n", text), ReconError::Runtime(_)));
        }
        for text in [
            "VK_ERROR_OUT_OF_DEVICE_MEMORY",
            "CUDA out of memory",
            "Failed to allocate buffer",
            "WebGPU validation failed. [Invalid Buffer (unlabeled)] is invalid due to a previous error.",
        ] {
            let error = Device::Gpu.failure("n", text);
            assert!(matches!(error, ReconError::DeviceFull(_)), "{error:?}");
            assert!(error.to_string().contains("smaller tiles"), "{error}");
        }
    }
}
