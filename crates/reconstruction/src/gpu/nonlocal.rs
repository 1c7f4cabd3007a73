//! The nonlocal prior's clip and groups in the memory of a GPU. The kernels are in `nonlocal.wgsl`.

use std::ops::Range;
use std::sync::Arc;

use wgpu::{BindGroupDescriptor, BindGroupEntry, Buffer, BufferUsages, ComputePipeline};

use super::adapter::{Gpu, Shortage};
use super::frames::{DeviceFrames, GROUP, grid};
use crate::error::Result;

/// Frames, height and width of a clip.
type Size = (usize, usize, usize);

// These constants are repeated in `nonlocal.wgsl`.
/// Number of patches of a group.
const PATCHES: usize = 40;
/// Height and width of a patch, in pixels.
const SIDE: usize = 6;
/// Number of pixels of a patch.
const PIXELS: usize = SIDE * SIDE;
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
///
/// Filtered patches take 230 bytes for each voxel. If the GPU has no room for all at once, rows are divided into bands. A
/// band filters all groups with a patch in its rows; groups at the edges of bands are filtered twice. Each pixel adds the
/// same patches in the same order, so the number of bands changes no bit.
pub(crate) struct Clip {
    gpu: Arc<Gpu>,
    size: Size,
    noisy: Buffer,
    guide: Buffer,
    cosines: Buffer,
    coefficients: Buffer,
    settings: Buffer,
    window: (usize, usize),
    group_count: usize,
    /// The search windows of the groups.
    places: Buffer,
    groups: Buffer,
    /// The filtered patches of a band.
    patches: Buffer,
    bands: Vec<Band>,
    /// Number of bands for which the GPU had room.
    band_count: usize,
}

/// Rows of all frames that are filtered and aggregated together.
struct Band {
    rows: Range<usize>,
    /// Number of groups with a patch in these rows.
    count: usize,
    /// Indices of these groups.
    members: Buffer,
    /// The patches at each place.
    entries: Buffer,
}

/// The contents of a [`Band`].
struct BandPlan {
    rows: Range<usize>,
    members: Vec<u32>,
    entries: Vec<u32>,
}

impl Clip {
    /// Room for a clip of `frames` x `height` x `width`; `cosines` is the DCT along time without its constant row.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn new(gpu: Arc<Gpu>, size: Size, cosines: &[f32]) -> Result<Self> {
        let voxels = size.0 * size.1 * size.2;
        let [noisy, guide, coefficients, table] =
            gpu.buffers([voxels, voxels, voxels, cosines.len()])?;
        gpu.queue.write_buffer(&table, 0, bytemuck::cast_slice(cosines));
        let settings = gpu.buffer(44, BufferUsages::UNIFORM | BufferUsages::COPY_DST);
        let [places, groups, patches] = gpu.buffers([0; 3])?;
        let cosines = table;
        Ok(Self {
            gpu,
            size,
            noisy,
            guide,
            cosines,
            coefficients,
            settings,
            window: (0, 0),
            group_count: 0,
            places,
            groups,
            patches,
            bands: Vec::new(),
            band_count: 1,
        })
    }

    fn voxels(&self) -> usize {
        self.size.0 * self.size.1 * self.size.2
    }

    /// Sets the numbers for the next kernels, which work on `count` groups and these rows.
    fn set(&self, levels: Levels, count: usize, rows: &Range<usize>) {
        let (frames, height, width) = self.size;
        let integers = [width, height, frames, self.window.0, self.window.1, count];
        // An unlimited margin must stay a number.
        let reals = [levels.margin.min(1e30), levels.shrinkage * levels.shrinkage, levels.tau];
        let integers = integers.into_iter().map(|value| value as u32);
        let rows = [rows.start as u32, rows.end as u32];
        let words: Vec<u32> = integers.chain(reals.map(f32::to_bits)).chain(rows).collect();
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

    /// Clamps the outliers of frames, and shrinks their changes along time.
    pub(crate) fn load(&self, frames: &DeviceFrames, levels: Levels) {
        self.limit_outliers(frames, levels);
        if levels.shrinkage > 0.0 {
            self.shrink(levels);
        }
    }

    fn limit_outliers(&self, frames: &DeviceFrames, levels: Levels) {
        self.set(levels, 0, &(0..self.size.1));
        let buffers = [(1, &frames.buffer), (2, &self.noisy)];
        let kernel = &self.gpu.kernels.limit_outliers;
        self.run(kernel, &buffers, self.voxels().div_ceil(GROUP));
    }

    fn shrink(&self, levels: Levels) {
        let (changes, plane) = (self.size.0 - 1, self.size.1 * self.size.2);
        if changes > 0 {
            self.set(levels, 0, &(0..self.size.1));
            let kernels = &self.gpu.kernels;
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
        let count = windows.places.len();
        self.window = windows.size;
        [self.places, self.groups] = self.gpu.buffers([8 * count, count * PATCHES])?;
        self.group_count = count;
        self.gpu.queue.write_buffer(&self.places, 0, bytemuck::cast_slice(&windows.places));
        self.compare_patches();
        let mut found = vec![0.0f32; count * PATCHES];
        self.gpu.read(self.gpu.commands(), &self.groups, &mut found)?;
        let mut found: Vec<u32> = found.into_iter().map(f32::to_bits).collect();
        for group in found.chunks_exact_mut(PATCHES) {
            // A clip too small for a full group repeats its patches.
            if let Some(count) = group.iter().position(|&place| place == NONE) {
                (count..PATCHES).for_each(|slot| group[slot] = group[slot - count]);
                group.sort_unstable();
            }
        }
        self.gpu.queue.write_buffer(&self.groups, 0, bytemuck::cast_slice(&found));
        self.divide(&found)?;
        self.gpu.check()
    }

    fn compare_patches(&self) {
        self.set(Levels::default(), self.group_count, &(0..self.size.1));
        let buffers = [(3, &self.guide), (6, &self.places), (7, &self.groups)];
        self.run(&self.gpu.kernels.search, &buffers, self.group_count);
    }

    /// Divides the rows into as many bands as the GPU needs for the patches of these groups.
    ///
    /// # Errors
    /// It has no room for the patches of a single row.
    pub(super) fn divide(&mut self, groups: &[u32]) -> Result<()> {
        // The patches of the last search must not take the room of the new ones.
        self.bands.clear();
        [self.patches] = self.gpu.buffers([0])?;
        loop {
            let plans = plan(groups, self.size, self.band_count);
            match self.hold(plans) {
                Ok(()) => return Ok(()),
                Err(_) if self.band_count < self.size.1 => {
                    self.band_count = self.size.1.min(2 * self.band_count);
                }
                Err(shortage) => return Err(self.gpu.refusal(&shortage)),
            }
        }
    }

    /// Copies bands to the GPU, with room for the patches of the largest.
    fn hold(&mut self, plans: Vec<BandPlan>) -> Result<(), Shortage> {
        let most = plans.iter().map(|plan| plan.members.len()).max().unwrap_or_default();
        let [patches] = self.gpu.allocate([most * PATCHES * PIXELS])?;
        let mut bands = Vec::with_capacity(plans.len());
        for BandPlan { rows, members, entries } in plans {
            let [members_buffer, entries_buffer] =
                self.gpu.allocate([members.len(), entries.len()])?;
            self.gpu.queue.write_buffer(&members_buffer, 0, bytemuck::cast_slice(&members));
            self.gpu.queue.write_buffer(&entries_buffer, 0, bytemuck::cast_slice(&entries));
            let (count, members, entries) = (members.len(), members_buffer, entries_buffer);
            bands.push(Band { rows, count, members, entries });
        }
        (self.patches, self.bands) = (patches, bands);
        Ok(())
    }

    /// Number of bands of the last search.
    #[cfg(test)]
    pub(crate) fn band_count(&self) -> usize {
        self.bands.len()
    }

    /// Filters the groups, and computes the frames that their patches give.
    pub(crate) fn filter(&self, levels: Levels, frames: &DeviceFrames) {
        for band in &self.bands {
            self.filter_groups(levels, band);
            self.aggregate(band, frames);
        }
    }

    fn filter_groups(&self, levels: Levels, band: &Band) {
        self.set(levels, band.count, &band.rows);
        let members = (10, &band.members);
        let buffers = [(2, &self.noisy), (7, &self.groups), (8, &self.patches), members];
        self.run(&self.gpu.kernels.low_rank, &buffers, band.count);
    }

    /// Computes the rows of a band from the patches that were filtered last.
    fn aggregate(&self, band: &Band, frames: &DeviceFrames) {
        self.set(Levels::default(), band.count, &band.rows);
        let entries = (9, &band.entries);
        let buffers = [(1, &frames.buffer), (3, &self.guide), (8, &self.patches), entries];
        let voxels = band.rows.len() * self.size.0 * self.size.2;
        self.run(&self.gpu.kernels.aggregate, &buffers, voxels.div_ceil(GROUP));
    }

    /// The kernels, for measurements after a pass. Each works on the whole clip.
    pub(crate) fn kernels<'a>(
        &'a self,
        levels: Levels,
        frames: &'a DeviceFrames,
    ) -> [NamedKernel<'a>; 5] {
        let kernel = |name, run: Box<dyn Fn() + 'a>| NamedKernel { name, run };
        let each = move |run: &dyn Fn(&Band)| self.bands.iter().for_each(run);
        [
            kernel(
                "nonlocal: outlier limits",
                Box::new(move || self.limit_outliers(frames, levels)),
            ),
            kernel("nonlocal: temporal shrinkage", Box::new(move || self.shrink(levels))),
            kernel("nonlocal: search", Box::new(move || self.compare_patches())),
            kernel(
                "nonlocal: low-rank filter",
                Box::new(move || each(&|band| self.filter_groups(levels, band))),
            ),
            kernel(
                "nonlocal: aggregation",
                Box::new(move || each(&|band| self.aggregate(band, frames))),
            ),
        ]
    }
}

/// A kernel that can be run again, for measurements.
pub(crate) struct NamedKernel<'a> {
    pub(crate) name: &'static str,
    pub(crate) run: Box<dyn Fn() + 'a>,
}

/// Divides rows evenly into `count` bands, and finds the groups and patches of each.
fn plan(groups: &[u32], (frames, height, width): Size, count: usize) -> Vec<BandPlan> {
    let rows_of = |band: usize| height * band / count..height * (band + 1) / count;
    let top_of = |place: u32| place as usize % (height * width) / width;
    let band = |band: usize| {
        let rows = rows_of(band);
        let first_place_row = rows.start.saturating_sub(SIDE - 1);
        let place_rows = rows.end - first_place_row;
        let reaches = |place: u32| (first_place_row..rows.end).contains(&top_of(place));
        let (mut members, mut patches) = (Vec::new(), Vec::new());
        for (group, places) in groups.chunks_exact(PATCHES).enumerate() {
            if places.iter().any(|&place| reaches(place)) {
                members.push(group as u32);
                patches.extend(places.iter().map(|&place| {
                    let (frame, at) = (place as usize / width / height, place as usize % width);
                    if !reaches(place) {
                        return NONE;
                    }
                    let row = top_of(place) - first_place_row;
                    ((frame * place_rows + row) * width + at) as u32
                }));
            }
        }
        let entries = by_place(&patches, frames * place_rows * width);
        BandPlan { rows, members, entries }
    };
    (0..count).map(band).collect()
}

/// For each place the end of its entries; then the entries, which are indices of patches in the order of their places.
/// Patches at [`NONE`] are left out.
fn by_place(places: &[u32], count: usize) -> Vec<u32> {
    let is_inside = |place: &&u32| **place != NONE;
    let mut ends = vec![0u32; count + places.iter().filter(is_inside).count()];
    let (ends_of, entries) = ends.split_at_mut(count);
    places.iter().filter(is_inside).for_each(|&place| ends_of[place as usize] += 1);
    let mut sum = 0;
    for end in ends_of.iter_mut() {
        (sum, *end) = (sum + *end, sum);
    }
    // Each start moves to the end of its entries.
    for (index, &place) in places.iter().enumerate().filter(|(_, place)| is_inside(place)) {
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
