//! Masks from raw captures.

pub mod calibrate;
