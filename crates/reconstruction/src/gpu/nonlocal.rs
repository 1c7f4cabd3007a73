//! The nonlocal prior's clip and groups in the memory of a GPU. The kernels are in `nonlocal.wgsl`.

use std::sync::Arc;

use wgpu::{BindGroupDescriptor, BindGroupEntry, Buffer, BufferUsages, ComputePipeline};

use super::adapter::Gpu;
use super::resident::{GROUP, grid};
use crate::error::Result;

// These constants are repeated in `nonlocal.wgsl`.
/// Number of patches of a group.
const PATCHES: usize = 40;
/// Number of pixels of a patch.
const PIXELS: usize = 36;
/// Stands for no window, and for no patch.
pub(crate) const NONE: u32 = u32::MAX;

/// The search windows of all groups.
pub(crate) struct Windows {
    /// Patch positions of a window, down and to the right.
    pub(crate) size: (usize, usize),
    /// For each group the place of its reference, then the first place of the window in each of 7 frames, or [`NONE`].
    pub(crate) places: Vec<[u32; 8]>,
}

/// Numbers that differ between passes.
#[derive(Debug, Clone, Copy, Default)]
pub(crate) struct Levels {
    /// Distance by which a pixel may exceed the range of its neighbours.
    pub(crate) margin: f32,
    /// Level of temporal shrinkage; 0 for none.
    pub(crate) shrinkage: f32,
    pub(crate) tau: f32,
}

/// Clip and groups of the nonlocal prior on a GPU.
pub(crate) struct Clip {
    gpu: Arc<Gpu>,
    size: (usize, usize, usize),
    frames: Buffer,
    noisy: Buffer,
    guide: Buffer,
    cosines: Buffer,
    coefficients: Buffer,
    settings: Buffer,
    window: (usize, usize),
    count: usize,
    /// Patches of the groups, the filtered patches, and the patches at each place.
    groups: [Buffer; 3],
}

impl Clip {
    /// Room for a clip of `frames` x `height` x `width`; `cosines` is the DCT along time without its constant row.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn new(gpu: Arc<Gpu>, size: (usize, usize, usize), cosines: &[f32]) -> Result<Self> {
        let voxels = size.0 * size.1 * size.2;
        let [frames, noisy, guide, coefficients, table] =
            gpu.buffers([voxels, voxels, voxels, voxels, cosines.len()])?;
        gpu.queue.write_buffer(&table, 0, bytemuck::cast_slice(cosines));
        let settings = gpu.buffer(36, BufferUsages::UNIFORM | BufferUsages::COPY_DST);
        let groups = gpu.buffers([0; 3])?;
        let (window, count) = ((0, 0), 0);
        let cosines = table;
        Ok(Self {
            gpu,
            size,
            frames,
            noisy,
            guide,
            cosines,
            coefficients,
            settings,
            window,
            count,
            groups,
        })
    }

    fn voxels(&self) -> usize {
        self.size.0 * self.size.1 * self.size.2
    }

    fn set(&self, levels: Levels) {
        let (frames, height, width) = self.size;
        let integers = [width, height, frames, self.window.0, self.window.1, self.count];
        // An unlimited margin must stay a number.
        let reals = [levels.margin.min(1e30), levels.shrinkage * levels.shrinkage, levels.tau];
        let integers = integers.into_iter().map(|value| value as u32);
        let words: Vec<u32> = integers.chain(reals.map(f32::to_bits)).collect();
        self.gpu.queue.write_buffer(&self.settings, 0, bytemuck::cast_slice(&words));
    }

    fn run(&self, kernel: &ComputePipeline, buffers: &[(u32, &Buffer)], groups: usize) {
        let entries: Vec<BindGroupEntry<'_>> = [(0, &self.settings)]
            .iter()
            .chain(buffers)
            .map(|&(binding, buffer)| BindGroupEntry {
                binding,
                resource: buffer.as_entire_binding(),
            })
            .collect();
        let layout = kernel.get_bind_group_layout(0);
        let descriptor = BindGroupDescriptor { label: None, layout: &layout, entries: &entries };
        let bindings = self.gpu.device.create_bind_group(&descriptor);
        let mut commands = self.gpu.commands();
        let mut compute = commands.begin_compute_pass(&Default::default());
        compute.set_pipeline(kernel);
        compute.set_bind_group(0, &bindings, &[]);
        let [columns, rows, layers] = grid(groups);
        compute.dispatch_workgroups(columns, rows, layers);
        drop(compute);
        self.gpu.queue.submit([commands.finish()]);
    }

    /// Copies frames to the GPU, clamps outliers and shrinks changes along time.
    pub(crate) fn load(&self, frames: &[f32], levels: Levels) {
        self.set(levels);
        self.gpu.queue.write_buffer(&self.frames, 0, bytemuck::cast_slice(frames));
        let kernels = &self.gpu.kernels;
        let buffers = [(1, &self.frames), (2, &self.noisy)];
        self.run(&kernels.limit_outliers, &buffers, self.voxels().div_ceil(GROUP));
        let changes = self.size.0 - 1;
        if levels.shrinkage > 0.0 && changes > 0 {
            let plane = self.size.1 * self.size.2;
            let buffers = [(2, &self.noisy), (4, &self.cosines), (5, &self.coefficients)];
            self.run(&kernels.analyse, &buffers, (plane * changes).div_ceil(GROUP));
            self.run(&kernels.shrink, &buffers, plane.div_ceil(GROUP));
        }
    }

    /// Compares patches in the loaded frames, because there is no result yet.
    pub(crate) fn guide_by_frames(&self) {
        let mut commands = self.gpu.commands();
        commands.copy_buffer_to_buffer(&self.noisy, 0, &self.guide, 0, 4 * self.voxels() as u64);
        self.gpu.queue.submit([commands.finish()]);
    }

    /// The frames in which patches are compared.
    ///
    /// # Errors
    /// The GPU is lost.
    pub(crate) fn guide(&self) -> Result<Vec<f32>> {
        let mut values = vec![0.0; self.voxels()];
        self.gpu.read(self.gpu.commands(), &self.guide, &mut values)?;
        Ok(values)
    }

    /// Finds the patches of all groups.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn search(&mut self, windows: &Windows) -> Result<()> {
        (self.window, self.count) = (windows.size, windows.places.len());
        let patches = self.count * PATCHES;
        let voxels = self.voxels();
        let lengths = [patches, patches * PIXELS, voxels + patches];
        self.groups = self.gpu.buffers(lengths)?;
        let [places] = self.gpu.buffers([8 * self.count])?;
        self.gpu.queue.write_buffer(&places, 0, bytemuck::cast_slice(&windows.places));
        self.set(Levels::default());
        let [groups, _, entries] = &self.groups;
        let buffers = [(3, &self.guide), (6, &places), (7, groups)];
        self.run(&self.gpu.kernels.search, &buffers, self.count);
        let mut found = vec![0.0f32; patches];
        self.gpu.read(self.gpu.commands(), groups, &mut found)?;
        let mut found: Vec<u32> = found.into_iter().map(f32::to_bits).collect();
        for group in found.chunks_exact_mut(PATCHES) {
            // A clip too small for a full group repeats its patches.
            if let Some(count) = group.iter().position(|&place| place == NONE) {
                (count..PATCHES).for_each(|slot| group[slot] = group[slot - count]);
                group.sort_unstable();
            }
        }
        self.gpu.queue.write_buffer(groups, 0, bytemuck::cast_slice(&found));
        let at_places = by_place(&found, voxels);
        self.gpu.queue.write_buffer(entries, 0, bytemuck::cast_slice(&at_places));
        self.gpu.check()
    }

    /// Filters the groups, and reads the frames that their patches give.
    ///
    /// # Errors
    /// The GPU is lost.
    pub(crate) fn filter(&self, levels: Levels, frames: &mut [f32]) -> Result<()> {
        self.set(levels);
        let [groups, patches, entries] = &self.groups;
        let kernels = &self.gpu.kernels;
        let buffers = [(2, &self.noisy), (7, groups), (8, patches)];
        self.run(&kernels.low_rank, &buffers, self.count);
        let buffers = [(1, &self.frames), (3, &self.guide), (8, patches), (9, entries)];
        self.run(&kernels.aggregate, &buffers, self.voxels().div_ceil(GROUP));
        self.gpu.read(self.gpu.commands(), &self.frames, frames)
    }
}

/// For each place the end of its entries; then the entries, which are indices of patches in the order of their places.
fn by_place(places: &[u32], count: usize) -> Vec<u32> {
    let mut ends = vec![0u32; count + places.len()];
    let (ends_of, entries) = ends.split_at_mut(count);
    for &place in places {
        ends_of[place as usize] += 1;
    }
    let mut sum = 0;
    for end in ends_of.iter_mut() {
        (sum, *end) = (sum + *end, sum);
    }
    // Each start moves to the end of its entries.
    for (index, &place) in places.iter().enumerate() {
        let next = &mut ends_of[place as usize];
        entries[*next as usize] = index as u32;
        *next += 1;
    }
    ends
}

impl std::fmt::Debug for Clip {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_tuple("Clip").field(&self.gpu).field(&self.size).finish()
    }
}
