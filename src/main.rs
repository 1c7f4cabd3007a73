//! The `sci-recon` program.

fn main() {}
