//! The variables of a tile in the memory of a GPU, and its iterations.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::Arc;

use wgpu::{BindGroup, BindGroupDescriptor, BindGroupEntry, Buffer, BufferUsages, ComputePipeline};

use crate::error::{ReconError, Result};
use crate::gpu::adapter::Gpu;
use crate::gpu::frames::{DeviceFrames, GROUP, grid, upload};
use crate::iterate::{Change, Variables};
use crate::operator::Statistics;
use crate::priors::registry::PriorSpec;
use crate::priors::tv::TvSpec;
use crate::priors::{Prior, Size};
use crate::projection::{Problem, Settings, Step};
use crate::stage::Stage;

// These constants are repeated in `gpu/kernels.wgsl`.
/// Largest number of iterations between two reads of their sums.
const BATCH: usize = 32;
/// Position of the first part of a sum.
const PARTS: usize = 4 + 4 * BATCH;
/// Side in pixels of the block in which a workgroup completes total variation.
const INNER: usize = 24;
/// Dual updates of a dispatch that starts from 0, and of the others.
const UPDATES: [usize; 2] = [4, 3];
/// Step of the dual ascent.
const TAU: f32 = 0.25;
const ACCELERATED: u32 = 1;
const ADMM: u32 = 2;
const EXTRAPOLATED: u32 = 4;
const FIRST: u32 = 8;
const LAST: u32 = 16;
/// Voxels that one batch may process: enough to hide the latency of a read, and far from the driver's time limit.
const BATCH_VOXELS: usize = 1 << 26;

/// A dispatch of a kernel.
pub(crate) struct Pass {
    pub(crate) name: &'static str,
    pipeline: ComputePipeline,
    bindings: BindGroup,
    groups: [u32; 3],
}

/// The variables of a reconstruction on a GPU.
pub(crate) struct Resident {
    gpu: Arc<Gpu>,
    snapshots: usize,
    size: Size,
    masks: Buffer,
    /// The measurement y, (H R H^T + gamma)^-1 and y1, each \[S,H,W\].
    pixels: Buffer,
    /// True if the target of the projection accumulates in y1.
    accelerated: bool,
    x: DeviceFrames,
    v: DeviceFrames,
    w: Option<DeviceFrames>,
    u: Option<DeviceFrames>,
    sums: Buffer,
    /// Stand for w and u if they are not used.
    unused: [Buffer; 2],
    /// R C \[B,H,W\] of the last stage, unless R = 1, and the statistics from which it follows.
    directions: Option<(Statistics, Option<Buffer>)>,
    pub(crate) iterations: Iterations,
}

/// The iterations of a stage.
#[derive(Default)]
pub(crate) struct Iterations {
    /// The dispatches of one iteration. The first is the projection.
    pub(crate) passes: Vec<Pass>,
    /// True if one of them is the prior.
    has_prior: bool,
    /// Iterations that are not submitted yet.
    remaining: usize,
    batch: usize,
    /// Iterations that are computed, but not yet requested.
    done: VecDeque<(Step, bool)>,
}

/// A copy of the variables.
pub(crate) struct Copies {
    pub(crate) v: DeviceFrames,
    w: Option<DeviceFrames>,
    u: Option<DeviceFrames>,
    y1: Buffer,
}

impl Copies {
    /// Another copy.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn copied(&self) -> Result<Self> {
        // Restoring does not change y1.
        let (v, y1) = (self.v.copied()?, self.y1.clone());
        Ok(Self { v, w: copied(self.w.as_ref())?, u: copied(self.u.as_ref())?, y1 })
    }
}

/// A copy of frames, if they are used.
fn copied(frames: Option<&DeviceFrames>) -> Result<Option<DeviceFrames>> {
    frames.map(DeviceFrames::copied).transpose()
}

impl Resident {
    /// Copies the problem to the GPU. All variables start from 0.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn new(gpu: Arc<Gpu>, problem: Problem<'_>, variables: Variables) -> Result<Self> {
        let Problem { operator, y } = problem;
        let (size, snapshots) = (operator.dim(), operator.snapshots());
        let pixel_groups = y.len().div_ceil(GROUP);
        let block_groups: usize = blocks(size).iter().product();
        let sums = PARTS + pixel_groups + 2 * block_groups;
        let [masks, pixels, sums] = gpu.buffers([operator.masks().len(), 3 * y.len(), sums])?;
        let unused = gpu.buffers([0; 2])?;
        upload(&gpu, &masks, 0, operator.masks());
        upload(&gpu, &pixels, 0, y.view());
        let zeros = || DeviceFrames::zeros(Arc::clone(&gpu), size);
        let optional = |is_used: bool| is_used.then(zeros).transpose();
        let (x, v) = (zeros()?, zeros()?);
        let (w, u) = (optional(variables.w)?, optional(variables.u)?);
        let accelerated = variables.y1;
        let (directions, iterations) = (None, Iterations::default());
        Ok(Self {
            gpu,
            snapshots,
            size,
            masks,
            pixels,
            accelerated,
            x,
            v,
            w,
            u,
            sums,
            unused,
            directions,
            iterations,
        })
    }

    /// Number of measured pixels.
    fn pixel_count(&self) -> usize {
        self.snapshots * self.size.1 * self.size.2
    }

    /// Prepares the iterations of a stage. Total variation has kernels here; other priors are called in each iteration.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn start(
        &mut self,
        problem: Problem<'_>,
        settings: &Settings,
        stage: &Stage,
    ) -> Result<()> {
        let directions = self.directions(problem, settings)?;
        // Without weights and updates, the kernel of total variation only compares and extrapolates.
        let none = TvSpec { tv_weight: 0.0, temporal_weight: 0.0, tv_updates: 0 };
        let has_prior = matches!(stage.prior, PriorSpec::Tv(_));
        let tv = if let PriorSpec::Tv(tv) = &stage.prior { tv } else { &none };
        let passes = self.passes(directions.as_ref(), settings, tv, stage.tolerance)?;
        let voxels = self.size.0 * self.size.1 * self.size.2;
        let batch = (BATCH_VOXELS / voxels).clamp(1, BATCH);
        let (remaining, done) = (stage.iterations, VecDeque::new());
        self.iterations = Iterations { passes, has_prior, remaining, batch, done };
        self.gpu.check()
    }

    /// R C of a stage, and its weights (H R H^T + gamma)^-1 in `pixels`.
    fn directions(&mut self, problem: Problem<'_>, settings: &Settings) -> Result<Option<Buffer>> {
        let statistics = &settings.statistics;
        if let Some((known, directions)) = &self.directions
            && known == statistics
        {
            return Ok(directions.clone());
        }
        let (directions, weights) = problem.operator.corrections(statistics);
        let directions = directions.map(|directions| -> Result<Buffer> {
            let [buffer] = self.gpu.buffers([directions.len()])?;
            upload(&self.gpu, &buffer, 0, directions.view());
            Ok(buffer)
        });
        let directions = directions.transpose()?;
        upload(&self.gpu, &self.pixels, self.pixel_count(), weights.view());
        self.directions = Some((statistics.clone(), directions.clone()));
        Ok(directions)
    }

    /// The dispatches of one iteration.
    fn passes(
        &self,
        directions: Option<&Buffer>,
        settings: &Settings,
        tv: &TvSpec,
        tolerance: f32,
    ) -> Result<Vec<Pass>> {
        let gpu = &self.gpu;
        let (all_frames, height, width) = self.size;
        let (plane, voxels) = (height * width, all_frames * height * width);
        let updates = if tv.tv_weight > 0.0 { tv.tv_updates } else { 0 };
        let along_time = tv.temporal_weight > 0.0 && tv.tv_updates > 0;
        let runs = dispatches(updates);
        let dual = if runs.len() > 1 { 2 * voxels } else { 0 };
        let [dual_one, dual_other, field] =
            gpu.buffers([dual, dual, if along_time { voxels } else { 0 }])?;
        let pixel_groups = self.pixel_count().div_ceil(GROUP);
        let blocks = blocks(self.size);

        let mut flags = 0;
        for (is_set, flag) in [
            (self.accelerated, ACCELERATED),
            (self.u.is_some(), ADMM),
            (self.w.is_some(), EXTRAPOLATED),
        ] {
            flags |= if is_set { flag } else { 0 };
        }
        let reals =
            [TAU / tv.tv_weight, tv.temporal_weight, settings.memory, settings.momentum, tolerance];
        let uniform = |flags: u32, updates: usize| self.uniform(flags, updates, reals);
        let [no_w, no_u] = &self.unused;
        let (x, v) = (&self.x.buffer, &self.v.buffer);
        let w = self.w.as_ref().map_or(no_w, |w| &w.buffer);
        let u = self.u.as_ref().map_or(no_u, |u| &u.buffer);
        let start = if self.w.is_some() { w } else { v };
        let directions = directions.unwrap_or(&self.masks);
        let kernels = &gpu.kernels;
        let plain = uniform(flags, tv.tv_updates);
        let mut passes = vec![self.pass(
            &kernels.project,
            "projection",
            &plain,
            &[
                (1, &self.sums),
                (2, &self.masks),
                (3, &self.pixels),
                (4, start),
                (5, x),
                (6, u),
                (12, directions),
            ],
            grid(pixel_groups),
        )];
        if along_time {
            passes.push(self.pass(
                &kernels.variation_along_time,
                "total variation along time",
                &plain,
                &[(1, &self.sums), (5, x), (11, &field)],
                grid(plane.div_ceil(GROUP)),
            ));
        }
        for (index, &updates) in runs.iter().enumerate() {
            let first = if index == 0 { FIRST } else { 0 };
            let last = if index + 1 == runs.len() { LAST } else { 0 };
            let (before, after) =
                if index % 2 == 0 { (&dual_one, &dual_other) } else { (&dual_other, &dual_one) };
            passes.push(self.pass(
                &kernels.variation,
                "total variation",
                &uniform(flags | first | last, updates),
                &[(1, &self.sums), (5, x), (6, u), (7, v), (8, w), (9, before), (10, after)],
                blocks.map(|count| count as u32),
            ));
        }
        passes.push(self.pass(&kernels.finish, "sums", &plain, &[(1, &self.sums)], [1; 3]));
        Ok(passes)
    }

    /// The settings of a kernel.
    fn uniform(&self, flags: u32, updates: usize, reals: [f32; 5]) -> Buffer {
        let (all_frames, height, width) = self.size;
        let pixel_groups = self.pixel_count().div_ceil(GROUP);
        let block_groups: usize = blocks(self.size).iter().product();
        let frames = all_frames / self.snapshots;
        let integers = [width, height, frames, all_frames, pixel_groups, block_groups];
        let integers = integers.into_iter().map(|value| value as u32);
        let words: Vec<u32> =
            integers.chain([flags, updates as u32]).chain(reals.map(f32::to_bits)).collect();
        let usage = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
        let buffer = self.gpu.buffer(4 * words.len() as u64, usage);
        self.gpu.queue.write_buffer(&buffer, 0, bytemuck::cast_slice(&words));
        buffer
    }

    fn pass(
        &self,
        pipeline: &ComputePipeline,
        name: &'static str,
        settings: &Buffer,
        buffers: &[(u32, &Buffer)],
        groups: [u32; 3],
    ) -> Pass {
        let entries: Vec<BindGroupEntry<'_>> = [(0, settings)]
            .iter()
            .chain(buffers)
            .map(|&(binding, buffer): &(u32, &Buffer)| BindGroupEntry {
                binding,
                resource: buffer.as_entire_binding(),
            })
            .collect();
        let layout = pipeline.get_bind_group_layout(0);
        let descriptor =
            BindGroupDescriptor { label: Some(name), layout: &layout, entries: &entries };
        let bindings = self.gpu.device.create_bind_group(&descriptor);
        Pass { name, pipeline: pipeline.clone(), bindings, groups }
    }

    /// The next iteration, and true if its change is below the tolerance. `prior` is called unless the kernels are the
    /// prior.
    ///
    /// # Errors
    /// The GPU is lost, the prior fails, or all iterations of the stage are done.
    pub(crate) fn iterate(&mut self, prior: &mut dyn Prior, sigma: f32) -> Result<(Step, bool)> {
        if self.iterations.done.is_empty() {
            let batch = if self.iterations.has_prior { self.iterations.batch } else { 1 };
            let count = batch.min(self.iterations.remaining);
            self.iterations.remaining -= count;
            self.reset();
            let sums = if self.iterations.has_prior {
                self.run(0..self.iterations.passes.len(), count)?
            } else {
                let commands = self.encoded(0..1, 1); // x = P(w)
                self.gpu.queue.submit([commands.finish()]);
                prior.denoise_on_gpu(&self.x, sigma)?; // v' = D(x)
                self.run(1..self.iterations.passes.len(), count)?
            };
            let steps = sums[4..].chunks_exact(4).take(sums[0] as usize);
            self.iterations.done.extend(steps.map(|sums| {
                let change = Change::new(sums[1].into(), sums[2].into());
                (Step { squared_residual: sums[0].into(), change }, sums[3] > 0.0)
            }));
        }
        self.iterations.done.pop_front().ok_or_else(|| {
            ReconError::Runtime(format!("the GPU {} did not iterate", self.gpu.name()))
        })
    }

    /// Runs some of the passes as often as in a batch, and returns how often.
    pub(crate) fn repeat(&self, passes: Range<usize>) -> Result<usize> {
        self.reset();
        self.run(passes, self.iterations.batch).map(|_| self.iterations.batch)
    }

    /// Starts the sums of the next iterations.
    fn reset(&self) {
        self.gpu.queue.write_buffer(&self.sums, 0, &[0; 16]);
    }

    /// Runs some of the passes, `count` times. Returns the sums.
    fn run(&self, passes: Range<usize>, count: usize) -> Result<Vec<f32>> {
        let mut sums = vec![0.0; 4 + 4 * count];
        self.gpu.read(self.encoded(passes, count), &self.sums, &mut sums)?;
        Ok(sums)
    }

    fn encoded(&self, passes: Range<usize>, count: usize) -> wgpu::CommandEncoder {
        let mut commands = self.gpu.commands();
        let mut compute = commands.begin_compute_pass(&Default::default());
        for _ in 0..count {
            self.iterations.passes[passes.clone()]
                .iter()
                .for_each(|pass| pass.encode(&mut compute));
        }
        drop(compute);
        commands
    }

    /// The frames `v`.
    pub(crate) fn frames(&self) -> &DeviceFrames {
        &self.v
    }

    /// A copy of the variables, for [`Resident::restore`].
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn snapshot(&self) -> Result<Copies> {
        let count = self.pixel_count();
        let [y1] = self.gpu.buffers([count])?;
        let mut commands = self.gpu.commands();
        let (first, bytes) = (8 * count as u64, 4 * count as u64);
        commands.copy_buffer_to_buffer(&self.pixels, first, &y1, 0, bytes);
        self.gpu.queue.submit([commands.finish()]);
        let (w, u) = (copied(self.w.as_ref())?, copied(self.u.as_ref())?);
        Ok(Copies { v: self.v.copied()?, w, u, y1 })
    }

    /// Goes back to a copy, and returns the frames `v` that it replaces. A stage must be started before the next iteration.
    pub(crate) fn restore(&mut self, copies: Copies) -> DeviceFrames {
        let Copies { v, w, u, y1 } = copies;
        let count = self.pixel_count();
        let mut commands = self.gpu.commands();
        let (first, bytes) = (8 * count as u64, 4 * count as u64);
        commands.copy_buffer_to_buffer(&y1, 0, &self.pixels, first, bytes);
        self.gpu.queue.submit([commands.finish()]);
        // The passes are bound to the arrays that are replaced.
        self.iterations = Iterations::default();
        (self.w, self.u) = (w, u);
        std::mem::replace(&mut self.v, v)
    }

    /// `(y - H v)^2` of each of these pixels, given by snapshot, row and column.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn hold_out_residuals(&self, pixels: &[(usize, usize, usize)]) -> Result<Vec<f64>> {
        let (_, height, width) = self.size;
        let places: Vec<u32> = pixels
            .iter()
            .map(|&(snapshot, row, column)| ((snapshot * height + row) * width + column) as u32)
            .collect();
        let [held_out, squares] = self.gpu.buffers([places.len(); 2])?;
        self.gpu.queue.write_buffer(&held_out, 0, bytemuck::cast_slice(&places));
        let pass = self.pass(
            &self.gpu.kernels.hold_out,
            "hold-out error",
            &self.uniform(0, 0, [0.0; 5]),
            &[
                (2, &self.masks),
                (3, &self.pixels),
                (4, &self.v.buffer),
                (13, &held_out),
                (14, &squares),
            ],
            grid(places.len().div_ceil(GROUP)),
        );
        let mut commands = self.gpu.commands();
        let mut compute = commands.begin_compute_pass(&Default::default());
        pass.encode(&mut compute);
        drop(compute);
        let mut values = vec![0.0f32; places.len()];
        if !values.is_empty() {
            self.gpu.read(commands, &squares, &mut values)?;
        }
        Ok(values.into_iter().map(f64::from).collect())
    }
}

impl Pass {
    fn encode(&self, compute: &mut wgpu::ComputePass<'_>) {
        let [columns, rows, layers] = self.groups;
        compute.set_pipeline(&self.pipeline);
        compute.set_bind_group(0, &self.bindings, &[]);
        compute.dispatch_workgroups(columns, rows, layers);
    }
}

/// Workgroups of total variation.
fn blocks((frames, height, width): Size) -> [usize; 3] {
    [width.div_ceil(INNER), height.div_ceil(INNER), frames]
}

/// Numbers of dual updates of the dispatches that make `updates` of them; at least one dispatch.
fn dispatches(updates: usize) -> Vec<usize> {
    let [first, others] = UPDATES;
    let mut counts = vec![updates.min(first)];
    let mut remaining = updates - counts[0];
    while remaining > 0 {
        counts.push(remaining.min(others));
        remaining -= remaining.min(others);
    }
    counts
}
