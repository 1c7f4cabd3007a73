//! The GPU, its kernels, and the state of its driver.

use std::fmt;
use std::sync::{Arc, Mutex, PoisonError};

use pollster::block_on;
use wgpu::{
    Backends, Buffer, BufferDescriptor, BufferUsages, CommandEncoder, ComputePipeline,
    ComputePipelineDescriptor, Device, DeviceDescriptor, DeviceLostReason, ErrorFilter, Instance,
    InstanceDescriptor, InstanceFlags, Limits, MapMode, MemoryHints, PollType, PowerPreference,
    Queue, RequestAdapterOptions, ShaderModule, include_wgsl,
};

use crate::error::{ReconError, Result};

/// An open GPU. Threads may share it.
pub struct Gpu {
    name: String,
    pub(crate) device: Device,
    pub(crate) queue: Queue,
    pub(crate) kernels: Kernels,
    fault: Arc<Mutex<Option<Fault>>>,
    /// Number of bytes that were copied to the host.
    #[cfg(test)]
    pub(crate) read_bytes: std::sync::atomic::AtomicU64,
}

/// The compiled kernels.
pub(crate) struct Kernels {
    pub(crate) project: ComputePipeline,
    pub(crate) variation_along_time: ComputePipeline,
    pub(crate) variation: ComputePipeline,
    pub(crate) finish: ComputePipeline,
    pub(crate) hold_out: ComputePipeline,
    pub(crate) limit_outliers: ComputePipeline,
    pub(crate) analyse: ComputePipeline,
    pub(crate) shrink: ComputePipeline,
    pub(crate) search: ComputePipeline,
    pub(crate) low_rank: ComputePipeline,
    pub(crate) aggregate: ComputePipeline,
}

/// A failure that the driver reports outside of calls.
enum Fault {
    Lost(String),
    Full(String),
    Other(String),
}

/// Why the device has no room for buffers.
pub(crate) enum Shortage {
    /// A buffer exceeds the largest size in bytes.
    Limit { largest: u64, limit: u64 },
    /// The driver has no memory for all buffers, in bytes.
    Memory { total: u64, reason: String },
}

impl Gpu {
    /// Opens the first GPU with a Vulkan driver. Separate cards come before those of the processor.
    ///
    /// # Errors
    /// There is none, or it lacks what the kernels need.
    pub fn open() -> Result<Self> {
        Self::open_with(|_| ())
    }

    /// As [`Gpu::open`], with a changed request for a device.
    pub(crate) fn open_with(change: impl FnOnce(&mut DeviceDescriptor<'_>)) -> Result<Self> {
        let mut descriptor = InstanceDescriptor::new_without_display_handle();
        (descriptor.backends, descriptor.flags) = (Backends::VULKAN, InstanceFlags::empty());
        let power_preference = PowerPreference::HighPerformance;
        let options = RequestAdapterOptions { power_preference, ..Default::default() };
        let adapter = block_on(Instance::new(descriptor).request_adapter(&options));
        let adapter = adapter.map_err(|error| {
            ReconError::Runtime(format!(
                "no GPU with a Vulkan driver was found: install libvulkan1 and the driver of the card, or use \
                 --device cpu ({error})"
            ))
        })?;
        let (info, has) = (adapter.get_info(), adapter.limits());
        let driver = format!("{} {}", info.driver, info.driver_info);
        // Servers refuse records with longer or other names.
        let name = format!("{} ({})", info.name, driver.trim());
        let is_plain = |char: &char| char.is_ascii_graphic() || *char == ' ';
        let name: String = name.chars().filter(is_plain).take(64).collect();
        let required_limits = Limits {
            max_buffer_size: has.max_buffer_size,
            max_storage_buffer_binding_size: has.max_storage_buffer_binding_size,
            ..Limits::default()
        };
        // Workers and networks share the memory.
        let memory_hints = MemoryHints::MemoryUsage;
        let mut descriptor =
            DeviceDescriptor { required_limits, memory_hints, ..Default::default() };
        change(&mut descriptor);
        let opened = block_on(adapter.request_device(&descriptor));
        let (device, queue) = opened.map_err(|error| {
            ReconError::Runtime(format!("the GPU {name} can't run the solver's kernels: {error}"))
        })?;
        let fault = Arc::new(Mutex::new(None));
        let shared = Arc::clone(&fault);
        device.set_device_lost_callback(move |reason, text| {
            let text = match reason {
                DeviceLostReason::Destroyed => "it was closed".to_owned(),
                DeviceLostReason::Unknown => text,
            };
            *shared.lock().unwrap_or_else(PoisonError::into_inner) = Some(Fault::Lost(text));
        });
        let shared = Arc::clone(&fault);
        device.on_uncaptured_error(Arc::new(move |error: wgpu::Error| {
            let mut fault = shared.lock().unwrap_or_else(PoisonError::into_inner);
            fault.get_or_insert_with(|| match error {
                wgpu::Error::OutOfMemory { .. } => Fault::Full(error.to_string()),
                _ => Fault::Other(error.to_string()),
            });
        }));
        let module = device.create_shader_module(include_wgsl!("kernels.wgsl"));
        let nonlocal = device.create_shader_module(include_wgsl!("nonlocal.wgsl"));
        let kernel_of = |module: &ShaderModule, name| {
            device.create_compute_pipeline(&ComputePipelineDescriptor {
                label: Some(name),
                layout: None,
                module,
                entry_point: Some(name),
                compilation_options: Default::default(),
                cache: None,
            })
        };
        let kernel = |name| kernel_of(&module, name);
        let nonlocal = |name| kernel_of(&nonlocal, name);
        let kernels = Kernels {
            project: kernel("project"),
            variation_along_time: kernel("variation_along_time"),
            variation: kernel("variation"),
            finish: kernel("finish"),
            hold_out: kernel("hold_out"),
            limit_outliers: nonlocal("limit_outliers"),
            analyse: nonlocal("analyse"),
            shrink: nonlocal("shrink"),
            search: nonlocal("search"),
            low_rank: nonlocal("low_rank"),
            aggregate: nonlocal("aggregate"),
        };
        let gpu = Self {
            name,
            device,
            queue,
            kernels,
            fault,
            #[cfg(test)]
            read_bytes: Default::default(),
        };
        gpu.check()?;
        Ok(gpu)
    }

    /// Name of the card and of its driver.
    pub fn name(&self) -> &str {
        &self.name
    }

    /// Fails if the driver has reported a fault.
    ///
    /// # Errors
    /// [`ReconError::DeviceLost`] from the loss of the device on, [`ReconError::DeviceFull`] or [`ReconError::Runtime`]
    /// once after another fault.
    pub(crate) fn check(&self) -> Result<()> {
        let fault = || self.fault.lock().unwrap_or_else(PoisonError::into_inner);
        if fault().is_none() {
            return Ok(());
        }
        // After a loss all calls fail; its callback runs in a poll.
        let polled = self.device.poll(PollType::Poll);
        let mut fault = fault();
        match &*fault {
            Some(Fault::Lost(text)) => {
                Err(ReconError::DeviceLost(format!("the GPU {} was lost ({text})", self.name)))
            }
            Some(Fault::Full(reason)) => {
                let error = self.full("a tile", reason);
                *fault = None;
                Err(error)
            }
            Some(Fault::Other(text)) => {
                let text = polled.map_or_else(|error| format!("{text}; {error}"), |_| text.clone());
                *fault = None;
                Err(ReconError::Runtime(format!("the GPU {} failed: {text}", self.name)))
            }
            None => Ok(()),
        }
    }

    /// Buffers of these numbers of 32-bit values, all 0.
    ///
    /// # Errors
    /// The device or its free memory is too small.
    pub(crate) fn buffers<const N: usize>(&self, lengths: [usize; N]) -> Result<[Buffer; N]> {
        self.allocate(lengths).map_err(|shortage| self.refusal(&shortage))
    }

    /// As [`Gpu::buffers`], for callers that can do with smaller ones.
    pub(crate) fn allocate<const N: usize>(
        &self,
        lengths: [usize; N],
    ) -> Result<[Buffer; N], Shortage> {
        let limits = self.device.limits();
        let limit = limits.max_storage_buffer_binding_size.min(limits.max_buffer_size);
        let bytes = |length: usize| 4 * length.max(4) as u64;
        let largest = lengths.into_iter().map(bytes).max().unwrap_or_default();
        if largest > limit {
            return Err(Shortage::Limit { largest, limit });
        }
        let scope = self.device.push_error_scope(ErrorFilter::OutOfMemory);
        let usage = BufferUsages::STORAGE | BufferUsages::COPY_SRC | BufferUsages::COPY_DST;
        let buffers = lengths.map(|length| self.buffer(bytes(length), usage));
        let total: u64 = lengths.into_iter().map(bytes).sum();
        block_on(scope.pop()).map_or(Ok(buffers), |error| {
            // Memory of finished work becomes free for the next attempt. A loss is reported by `check`.
            let _ = self.device.poll(PollType::wait_indefinitely());
            Err(Shortage::Memory { total, reason: error.to_string() })
        })
    }

    /// The error of a task for which the device is too small.
    pub(crate) fn refusal(&self, shortage: &Shortage) -> ReconError {
        let name = &self.name;
        match shortage {
            Shortage::Limit { largest, limit } => ReconError::Runtime(format!(
                "the GPU {name} accepts arrays of up to {limit} bytes, but a tile needs {largest}: choose smaller tiles, \
                 or use --device cpu"
            )),
            Shortage::Memory { total, reason } => self.full(&format!("{total} bytes"), reason),
        }
    }

    fn full(&self, needed: &str, reason: &str) -> ReconError {
        let name = &self.name;
        ReconError::DeviceFull(format!(
            "the GPU {name} has too little free memory for {needed}: choose smaller tiles, run fewer workers on this \
             GPU, or use --device cpu ({reason})"
        ))
    }

    pub(crate) fn buffer(&self, size: u64, usage: BufferUsages) -> Buffer {
        let descriptor = BufferDescriptor { label: None, size, usage, mapped_at_creation: false };
        self.device.create_buffer(&descriptor)
    }

    /// Submits commands, then reads the first `output.len()` values of a buffer.
    ///
    /// # Errors
    /// As [`Gpu::check`].
    pub(crate) fn read(
        &self,
        mut commands: CommandEncoder,
        buffer: &Buffer,
        output: &mut [f32],
    ) -> Result<()> {
        let size = size_of_val(output) as u64;
        #[cfg(test)]
        self.read_bytes.fetch_add(size, std::sync::atomic::Ordering::Relaxed);
        let copy = self.buffer(size, BufferUsages::MAP_READ | BufferUsages::COPY_DST);
        commands.copy_buffer_to_buffer(buffer, 0, &copy, 0, size);
        self.queue.submit([commands.finish()]);
        copy.map_async(MapMode::Read, .., |_| ());
        let polled = self.device.poll(PollType::wait_indefinitely());
        self.check()?;
        let failed = |error: &dyn fmt::Display| {
            ReconError::Runtime(format!("the GPU {} failed: {error}", self.name))
        };
        polled.map_err(|error| failed(&error))?;
        let range = copy.get_mapped_range(..).map_err(|error| failed(&error))?;
        output.copy_from_slice(bytemuck::cast_slice(&range));
        Ok(())
    }

    /// Waits until all submitted commands are done.
    ///
    /// # Errors
    /// As [`Gpu::check`].
    pub(crate) fn wait(&self) -> Result<()> {
        let polled = self.device.poll(PollType::wait_indefinitely());
        self.check()?;
        let failed = |error| ReconError::Runtime(format!("the GPU {} failed: {error}", self.name));
        polled.map(drop).map_err(failed)
    }

    pub(crate) fn commands(&self) -> CommandEncoder {
        self.device.create_command_encoder(&Default::default())
    }
}

impl fmt::Debug for Gpu {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.debug_tuple("Gpu").field(&self.name).finish()
    }
}
