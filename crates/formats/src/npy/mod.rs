//! NumPy array files: reads stacks frame by frame, and writes f32 stacks.

mod header;
mod read;
mod write;

pub use read::open_windows;
pub(super) use read::{open, open_colours, shape};
pub use write::{stack_header, write_colours, write_f32, write_image_f32, write_u16, writer};

#[cfg(test)]
mod tests;
