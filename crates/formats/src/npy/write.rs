//! Writes f32 stacks as npy.

use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::Path;

use ndarray::{Array2, ArrayView2, ArrayView3};

use crate::error::Result;
use crate::format::NPY_MAGIC;
use crate::samples::StackWriter;
use crate::{Channels, FormatError};

/// The header of an npy file with the shape (frame, row, column), or (frame, row, column, 3) for colours, of
/// little-endian float32.
pub fn stack_header((frames, height, width): (usize, usize, usize), channels: Channels) -> Vec<u8> {
    header(&match channels {
        Channels::Grey => format!("({frames}, {height}, {width})"),
        Channels::Rgb => format!("({frames}, {height}, {width}, {})", channels.count()),
    })
}

/// Writes the header of [`stack_header`], and returns a writer for the frames. `to` should be buffered.
///
/// Errors: I/O.
pub fn writer<W: Write>(
    mut to: W,
    (frames, height, width): (usize, usize, usize),
    channels: Channels,
) -> Result<StackWriter<W>> {
    to.write_all(&stack_header((frames, height, width), channels))
        .map_err(FormatError::io("write the npy header"))?;
    Ok(StackWriter::new(to, frames, height, width * channels.count()))
}

/// Writes a stack (frame, row, column), and replaces an existing file.
///
/// Errors: I/O.
pub fn write_f32(path: &Path, stack: ArrayView3<'_, f32>) -> Result<()> {
    write_all(path, stack, stack.dim(), Channels::Grey)
}

/// Writes colour frames \[frame, row, 3 column\] with the shape (frame, row, column, 3), and replaces an existing file.
///
/// Errors: I/O.
pub fn write_colours(path: &Path, stack: ArrayView3<'_, f32>) -> Result<()> {
    let (frames, height, width) = stack.dim();
    write_all(path, stack, (frames, height, width / Channels::Rgb.count()), Channels::Rgb)
}

fn write_all(
    path: &Path,
    stack: ArrayView3<'_, f32>,
    shape: (usize, usize, usize),
    channels: Channels,
) -> Result<()> {
    let file = File::create(path).map_err(FormatError::io("create the npy file"))?;
    let mut writer = writer(BufWriter::new(file), shape, channels)?;
    for frame in stack.outer_iter() {
        writer.write_frame(frame)?;
    }
    writer.finish()?;
    Ok(())
}

/// Writes one image (row, column), and replaces an existing file.
///
/// Errors: I/O.
pub fn write_image_f32(path: &Path, image: ArrayView2<'_, f32>) -> Result<()> {
    let file = File::create(path).map_err(FormatError::io("create the npy file"))?;
    let (height, width) = image.dim();
    let mut writer = BufWriter::new(file);
    writer
        .write_all(&header(&format!("({height}, {width})")))
        .map_err(FormatError::io("write the npy header"))?;
    let mut sink = StackWriter::new(writer, 1, height, width);
    sink.write_frame(image)?;
    sink.finish()?;
    Ok(())
}

/// Writes `count` frames (row, column) from `frame` as little-endian uint16 with the shape (frame, row, column), and
/// replaces an existing file. One frame at a time is in memory.
///
/// Errors: those of `frame`; I/O; [`FormatError::Internal`] for a frame of another size.
pub fn write_u16<E: From<FormatError>>(
    path: &Path,
    (count, height, width): (usize, usize, usize),
    mut frame: impl FnMut(usize) -> Result<Array2<u16>, E>,
) -> Result<(), E> {
    let failed = |error| FormatError::io("write the npy file")(error);
    let file = File::create(path).map_err(FormatError::io("create the npy file"))?;
    let mut writer = BufWriter::new(file);
    let header = typed_header("<u2", &format!("({count}, {height}, {width})"));
    writer.write_all(&header).map_err(failed)?;
    for index in 0..count {
        let frame = frame(index)?;
        if frame.dim() != (height, width) {
            let (rows, columns) = frame.dim();
            let text =
                format!("a frame of {rows}x{columns} does not fit a stack of {height}x{width}");
            return Err(FormatError::Internal(text).into());
        }
        let bytes: Vec<u8> = frame.iter().flat_map(|value| value.to_le_bytes()).collect();
        writer.write_all(&bytes).map_err(failed)?;
    }
    Ok(writer.flush().map_err(failed)?)
}

fn header(shape: &str) -> Vec<u8> {
    typed_header("<f4", shape)
}

/// A header of version 1.0. Like NumPy, it is padded so that the data start at a multiple of 64 bytes.
fn typed_header(sample: &str, shape: &str) -> Vec<u8> {
    let mut text = format!("{{'descr': '{sample}', 'fortran_order': False, 'shape': {shape}, }}");
    let prefix = NPY_MAGIC.len() + 4;
    while !(prefix + text.len() + 1).is_multiple_of(64) {
        text.push(' ');
    }
    text.push('\n');
    let mut bytes = NPY_MAGIC.to_vec();
    bytes.extend([1, 0]);
    // Four numbers of at most 20 digits fit into the 65535 bytes of version 1.0.
    bytes.extend((text.len() as u16).to_le_bytes());
    bytes.extend(text.as_bytes());
    bytes
}
