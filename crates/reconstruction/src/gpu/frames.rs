//! Frames in the memory of a GPU.

use std::sync::Arc;

use ndarray::{Array3, ArrayView3};
use wgpu::Buffer;

use super::adapter::Gpu;
use crate::error::Result;

/// Lanes of a workgroup. `kernels.wgsl` and `nonlocal.wgsl` repeat it.
pub(crate) const GROUP: usize = 256;

/// Largest number of workgroups in one dimension of a dispatch.
const MAX_GROUPS: u32 = 65_535;

/// Frames \[S B,H,W\] in the memory of a GPU.
#[derive(Clone)]
pub struct DeviceFrames {
    gpu: Arc<Gpu>,
    size: (usize, usize, usize),
    pub(crate) buffer: Buffer,
}

impl DeviceFrames {
    /// Frames of this size, all 0.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn zeros(gpu: Arc<Gpu>, size: (usize, usize, usize)) -> Result<Self> {
        let [buffer] = gpu.buffers([size.0 * size.1 * size.2])?;
        Ok(Self { gpu, size, buffer })
    }

    /// Copies frames of the same size, in standard layout, to the GPU.
    pub(crate) fn write(&self, frames: &Array3<f32>) {
        debug_assert_eq!(frames.dim(), self.size);
        upload(&self.gpu, &self.buffer, 0, frames.view());
    }

    /// Copies the frames to the host.
    ///
    /// # Errors
    /// The GPU is lost.
    pub(crate) fn read(&self) -> Result<Array3<f32>> {
        let mut values = vec![0.0; self.size.0 * self.size.1 * self.size.2];
        self.gpu.read(self.gpu.commands(), &self.buffer, &mut values)?;
        let frames = Array3::from_shape_vec(self.size, values);
        Ok(frames.unwrap_or_else(|_| unreachable!("as many values as voxels")))
    }

    /// A copy in the memory of the GPU.
    ///
    /// # Errors
    /// The GPU is too small or lost.
    pub(crate) fn copied(&self) -> Result<Self> {
        let copy = Self::zeros(Arc::clone(&self.gpu), self.size)?;
        let mut commands = self.gpu.commands();
        commands.copy_buffer_to_buffer(&self.buffer, 0, &copy.buffer, 0, None);
        self.gpu.queue.submit([commands.finish()]);
        Ok(copy)
    }
}

/// Copies an array in standard layout to a buffer, from the value at `offset` on.
pub(crate) fn upload(gpu: &Gpu, buffer: &Buffer, offset: usize, values: ArrayView3<'_, f32>) {
    let values = values.to_slice().unwrap_or_else(|| unreachable!("arrays in standard layout"));
    gpu.queue.write_buffer(buffer, 4 * offset as u64, bytemuck::cast_slice(values));
}

/// Workgroups in two dimensions, at least `count`.
pub(crate) fn grid(count: usize) -> [u32; 3] {
    let columns = (count as u32).clamp(1, MAX_GROUPS);
    [columns, (count as u32).div_ceil(columns), 1]
}
