//! Iterations with total variation, and the nonlocal prior, on a GPU of any vendor. The kernels are in `kernels.wgsl` and
//! `nonlocal.wgsl`.

pub mod adapter;
pub(crate) mod nonlocal;
pub(crate) mod resident;
pub mod speed;
#[cfg(test)]
pub(crate) mod tests;
