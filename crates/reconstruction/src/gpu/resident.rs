//! The variables of a tile in the memory of a GPU, and its iterations.

use std::collections::VecDeque;
use std::ops::Range;
use std::sync::Arc;

use ndarray::{Array3, ArrayView3};
use wgpu::{BindGroup, BindGroupDescriptor, BindGroupEntry, Buffer, BufferUsages, ComputePipeline};

use super::adapter::Gpu;
use crate::error::{ReconError, Result};
use crate::iterate::{Change, Iterate};
use crate::projection::{Problem, Settings, Step};

// These constants are repeated in `kernels.wgsl`.
/// Lanes of a workgroup.
pub(super) const GROUP: usize = 256;
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

/// Largest number of workgroups in one dimension of a dispatch.
const MAX_GROUPS: u32 = 65_535;
/// Voxels that one batch may process: enough to hide the latency of a read, and far from the driver's time limit.
const BATCH_VOXELS: usize = 1 << 26;

/// A stage with total variation.
#[derive(Debug, Clone, Copy)]
pub(crate) struct Variation {
    /// Weight of the total variation of each frame.
    pub(crate) weight: f32,
    /// Weight of the total variation along time.
    pub(crate) temporal_weight: f32,
    /// Dual updates of both in each iteration.
    pub(crate) updates: usize,
    pub(crate) iterations: usize,
    pub(crate) tolerance: f32,
}

/// A dispatch of a kernel.
pub(super) struct Pass {
    pub(super) name: &'static str,
    pipeline: ComputePipeline,
    bindings: BindGroup,
    groups: [u32; 3],
}

/// A stage in progress on a GPU.
pub(crate) struct Resident {
    gpu: Arc<Gpu>,
    /// The dispatches of one iteration.
    pub(super) passes: Vec<Pass>,
    sums: Buffer,
    pixels: Buffer,
    v: Buffer,
    w: Buffer,
    u: Buffer,
    /// Iterations that are not submitted yet.
    remaining: usize,
    batch: usize,
    /// Iterations that are computed, but not yet requested.
    done: VecDeque<(Step, bool)>,
}

impl Resident {
    /// Copies the problem and the variables to the GPU.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn new<'a>(
        gpu: Arc<Gpu>,
        problem: Problem<'_>,
        settings: &Settings,
        stage: Variation,
        iterate: &'a Iterate,
    ) -> Result<Self> {
        let Problem { operator, y } = problem;
        let (all_frames, height, width) = operator.dim();
        let (snapshots, plane) = (operator.snapshots(), height * width);
        let voxels = all_frames * plane;
        let (directions, weights) = operator.corrections(&settings.statistics);

        let updates = if stage.weight > 0.0 { stage.updates } else { 0 };
        let along_time = stage.temporal_weight > 0.0 && stage.updates > 0;
        let runs = dispatches(updates);
        let dual = if runs.len() > 1 { 2 * voxels } else { 0 };
        let pixel_groups = (snapshots * plane).div_ceil(GROUP);
        let blocks = [width.div_ceil(INNER), height.div_ceil(INNER), all_frames];
        let block_groups: usize = blocks.iter().product();
        let optional = |is_needed: bool| if is_needed { voxels } else { 0 };
        let [optics, pixels, x, u, v, w, dual_one, dual_other, field, sums] = gpu.buffers([
            (1 + usize::from(directions.is_some())) * operator.masks().len(),
            3 * y.len(),
            voxels,
            optional(iterate.u.is_some()),
            voxels,
            optional(iterate.w.is_some()),
            dual,
            dual,
            optional(along_time),
            PARTS + pixel_groups + 2 * block_groups,
        ])?;
        let upload = |buffer: &Buffer, offset: usize, values: Option<ArrayView3<'_, f32>>| {
            if let Some(values) = values.and_then(|values| values.to_slice()) {
                gpu.queue.write_buffer(buffer, 4 * offset as u64, bytemuck::cast_slice(values));
            }
        };
        let view = |array: &'a Option<Array3<f32>>| array.as_ref().map(|array| array.view());
        upload(&optics, 0, Some(operator.masks()));
        upload(&optics, operator.masks().len(), directions.as_ref().map(|array| array.view()));
        upload(&pixels, 0, Some(y.view()));
        upload(&pixels, y.len(), Some(weights.view()));
        upload(&pixels, 2 * y.len(), view(&iterate.y1));
        upload(&v, 0, Some(iterate.v.view()));
        upload(&w, 0, view(&iterate.w));
        upload(&u, 0, view(&iterate.u));

        let mut flags = 0;
        for (is_set, flag) in [
            (iterate.y1.is_some(), ACCELERATED),
            (iterate.u.is_some(), ADMM),
            (iterate.w.is_some(), EXTRAPOLATED),
        ] {
            flags |= if is_set { flag } else { 0 };
        }
        let first_direction = if directions.is_some() { operator.masks().len() } else { 0 };
        let integers = [width, height, all_frames / snapshots, all_frames, first_direction];
        let groups = [pixel_groups, block_groups];
        let reals = [
            TAU / stage.weight,
            stage.temporal_weight,
            settings.memory,
            settings.momentum,
            stage.tolerance,
        ];
        let uniform = |flags: u32, updates: usize| {
            let integers = integers.into_iter().chain(groups).map(|value| value as u32);
            let words: Vec<u32> =
                integers.chain([flags, updates as u32]).chain(reals.map(f32::to_bits)).collect();
            let usage = BufferUsages::UNIFORM | BufferUsages::COPY_DST;
            let buffer = gpu.buffer(4 * words.len() as u64, usage);
            gpu.queue.write_buffer(&buffer, 0, bytemuck::cast_slice(&words));
            buffer
        };
        let pass = |pipeline: &ComputePipeline, name, settings: &Buffer, buffers: &[_], groups| {
            let bound = [(0, settings), (1, &sums)];
            let entries: Vec<BindGroupEntry<'_>> = bound
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
            let bindings = gpu.device.create_bind_group(&descriptor);
            Pass { name, pipeline: pipeline.clone(), bindings, groups }
        };
        let start = if iterate.w.is_some() { &w } else { &v };
        let kernels = &gpu.kernels;
        let plain = uniform(flags, stage.updates);
        let mut passes = vec![pass(
            &kernels.project,
            "projection",
            &plain,
            &[(2, &optics), (3, &pixels), (4, start), (5, &x), (6, &u)],
            grid(pixel_groups),
        )];
        if along_time {
            passes.push(pass(
                &kernels.variation_along_time,
                "total variation along time",
                &plain,
                &[(5, &x), (11, &field)],
                grid(plane.div_ceil(GROUP)),
            ));
        }
        for (index, &updates) in runs.iter().enumerate() {
            let first = if index == 0 { FIRST } else { 0 };
            let last = if index + 1 == runs.len() { LAST } else { 0 };
            let (before, after) =
                if index % 2 == 0 { (&dual_one, &dual_other) } else { (&dual_other, &dual_one) };
            passes.push(pass(
                &kernels.variation,
                "total variation",
                &uniform(flags | first | last, updates),
                &[(5, &x), (6, &u), (7, &v), (8, &w), (9, before), (10, after)],
                blocks.map(|count| count as u32),
            ));
        }
        passes.push(pass(&kernels.finish, "sums", &plain, &[], [1; 3]));
        gpu.check()?;
        let batch = (BATCH_VOXELS / voxels).clamp(1, BATCH);
        let remaining = stage.iterations;
        Ok(Self { gpu, passes, sums, pixels, v, w, u, remaining, batch, done: VecDeque::new() })
    }

    /// The next iteration, and true if its change is below the tolerance.
    ///
    /// # Errors
    /// The GPU is lost, or all iterations of the stage are done.
    pub(crate) fn step(&mut self) -> Result<(Step, bool)> {
        if self.done.is_empty() {
            let count = self.batch.min(self.remaining);
            self.remaining -= count;
            let sums = self.run(0..self.passes.len(), count)?;
            let steps = sums[4..].chunks_exact(4).take(sums[0] as usize);
            self.done.extend(steps.map(|sums| {
                let change = Change::new(sums[1].into(), sums[2].into());
                (Step { squared_residual: sums[0].into(), change }, sums[3] > 0.0)
            }));
        }
        self.done.pop_front().ok_or_else(|| {
            ReconError::Runtime(format!("the GPU {} did not iterate", self.gpu.name()))
        })
    }

    /// Runs some of the passes as often as in a batch, and returns how often.
    pub(super) fn repeat(&self, passes: Range<usize>) -> Result<usize> {
        self.run(passes, self.batch).map(|_| self.batch)
    }

    /// Runs some of the passes, `count` times. Returns the sums.
    fn run(&self, passes: Range<usize>, count: usize) -> Result<Vec<f32>> {
        self.gpu.queue.write_buffer(&self.sums, 0, &[0; 16]);
        let mut commands = self.gpu.commands();
        let mut compute = commands.begin_compute_pass(&Default::default());
        for _ in 0..count {
            for Pass { pipeline, bindings, groups: [columns, rows, layers], .. } in
                &self.passes[passes.clone()]
            {
                compute.set_pipeline(pipeline);
                compute.set_bind_group(0, bindings, &[]);
                compute.dispatch_workgroups(*columns, *rows, *layers);
            }
        }
        drop(compute);
        let mut sums = vec![0.0; 4 + 4 * count];
        self.gpu.read(commands, &self.sums, &mut sums)?;
        Ok(sums)
    }

    /// Copies the variables back.
    ///
    /// # Errors
    /// The GPU is lost.
    pub(crate) fn download(&self, iterate: &mut Iterate) -> Result<()> {
        let read = |buffer: &Buffer, values: Option<&mut Array3<f32>>| {
            let values = values.and_then(|values| values.as_slice_mut());
            values.map_or(Ok(()), |values| self.gpu.read(self.gpu.commands(), buffer, values))
        };
        read(&self.v, Some(&mut iterate.v))?;
        read(&self.w, iterate.w.as_mut())?;
        read(&self.u, iterate.u.as_mut())?;
        if let Some(y1) = iterate.y1.as_mut().and_then(|y1| y1.as_slice_mut()) {
            let mut pixels = vec![0.0; 3 * y1.len()];
            self.gpu.read(self.gpu.commands(), &self.pixels, &mut pixels)?;
            y1.copy_from_slice(&pixels[2 * y1.len()..]);
        }
        Ok(())
    }
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

/// Workgroups in two dimensions, at least `count`.
pub(super) fn grid(count: usize) -> [u32; 3] {
    let columns = (count as u32).min(MAX_GROUPS);
    [columns, (count as u32).div_ceil(columns), 1]
}
