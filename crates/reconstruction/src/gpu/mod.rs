//! Iterations with total variation on a GPU of any vendor. The kernels are in `kernels.wgsl`.

pub mod adapter;
pub(crate) mod resident;
pub mod speed;
#[cfg(test)]
mod tests;
