//! A GPU of any vendor, frames in its memory, and the nonlocal prior. The kernels are in `kernels.wgsl` (iterations and
//! total variation, which `resident.rs` runs) and `nonlocal.wgsl`.

pub mod adapter;
pub(crate) mod frames;
pub(crate) mod nonlocal;
#[cfg(test)]
pub(crate) mod tests;
