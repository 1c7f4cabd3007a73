//! The order of the axes of an array: stated by the user, or inferred from the format and known sizes.

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, VariantNames};

use super::{Format, FormatError};
use crate::error::Result;

/// The order of the axes of an array, as shown by h5py for HDF5 files and by MATLAB for its files.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
#[derive(Serialize, Deserialize, Display, EnumString, VariantNames, schemars::JsonSchema)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum Axes {
    /// \[frame, row, column\].
    FrameRowColumn,
    /// \[row, column, frame\].
    RowColumnFrame,
    /// \[column, row, frame\].
    ColumnRowFrame,
    /// \[frame, column, row\], which MATLAB's `h5write` produces from \[row, column, frame\].
    FrameColumnRow,
}

/// Smallest plausible number of rows or columns of a camera.
const MIN_SIDE: u64 = 32;
/// Largest plausible aspect ratio of a camera.
const MAX_ASPECT: u64 = 8;

/// Prior knowledge about a stack, before its file is opened.
#[derive(Debug, Clone, Copy, Default)]
pub struct Expected {
    /// The stated order.
    pub axes: Option<Axes>,
    /// Largest possible number of frames.
    pub max_frames: Option<usize>,
    /// Rows and columns of a frame.
    pub size: Option<(usize, usize)>,
}

/// The program family that wrote an array. It determines how the shape is stored, and which orders are common.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Writer {
    /// The last axis varies fastest.
    Rows,
    /// NumPy's Fortran order: the first axis varies fastest.
    Fortran,
    /// MATLAB: the first axis varies fastest, and frames come last.
    Matlab,
}

/// The order of the samples of a stack in a file.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Layout {
    /// True if all frames of a pixel are adjacent; false if all pixels of a frame are.
    pub(super) interleaved: bool,
    /// True if pixels are stored column by column; false for row by row.
    pub(super) by_columns: bool,
}

/// A shape with known axes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Arranged {
    pub(super) frames: u64,
    pub(super) height: u64,
    pub(super) width: u64,
    pub(super) layout: Layout,
    /// Order of the axes; `None` for two dimensions, unless stated.
    pub(super) axes: Option<Axes>,
}

impl Axes {
    /// Frames, height and width of an array of this shape.
    fn sizes(self, [first, second, third]: [u64; 3]) -> (u64, u64, u64) {
        match self {
            Self::FrameRowColumn => (first, second, third),
            Self::RowColumnFrame => (third, first, second),
            Self::ColumnRowFrame => (third, second, first),
            Self::FrameColumnRow => (first, third, second),
        }
    }
}

impl Writer {
    /// The common orders, the most common one first. In MATLAB a matrix is \[row, column\]. [`Axes::FrameColumnRow`] is
    /// absent, because transposed pictures can be recognised only by a known size.
    fn orders(self) -> &'static [Axes] {
        use Axes::{ColumnRowFrame, FrameRowColumn, RowColumnFrame};
        match self {
            Self::Rows | Self::Fortran => &[FrameRowColumn, RowColumnFrame, ColumnRowFrame],
            Self::Matlab => &[RowColumnFrame, FrameRowColumn],
        }
    }

    /// The order of the samples in the file for this order of axes.
    fn layout(self, axes: Axes) -> Layout {
        let (interleaved, by_columns) = match (axes, self == Self::Rows) {
            (Axes::FrameRowColumn, true) | (Axes::ColumnRowFrame, false) => (false, false),
            (Axes::RowColumnFrame, true) | (Axes::FrameColumnRow, false) => (true, false),
            (Axes::ColumnRowFrame, true) | (Axes::FrameRowColumn, false) => (true, true),
            (Axes::RowColumnFrame, false) | (Axes::FrameColumnRow, true) => (false, true),
        };
        Layout { interleaved, by_columns }
    }
}

impl Expected {
    /// Determines the axes of an array of this shape; `None` unless it has two or three dimensions.
    ///
    /// Errors: [`FormatError::AxesAmbiguous`].
    pub(super) fn arrange(
        &self,
        (format, writer): (Format, Writer),
        shape: &[u64],
    ) -> Result<Option<Arranged>> {
        match *shape {
            [first, second] => {
                let transposed =
                    matches!(self.axes, Some(Axes::ColumnRowFrame | Axes::FrameColumnRow));
                let (height, width) = if transposed { (second, first) } else { (first, second) };
                let by_columns = transposed == (writer == Writer::Rows);
                let layout = Layout { interleaved: false, by_columns };
                Ok(Some(Arranged { frames: 1, height, width, layout, axes: self.axes }))
            }
            [first, second, third] => {
                let shape = [first, second, third];
                let axes = self.order(format, writer, shape)?;
                let (frames, height, width) = axes.sizes(shape);
                let layout = writer.layout(axes);
                Ok(Some(Arranged { frames, height, width, layout, axes: Some(axes) }))
            }
            _ => Ok(None),
        }
    }

    /// The stated order or, without one, the only common order that fits what is known. If none fits, transposed
    /// pictures of the right size are accepted; otherwise the usual order is assumed, and its sizes are checked later.
    fn order(&self, format: Format, writer: Writer, shape: [u64; 3]) -> Result<Axes> {
        let usual = writer.orders()[0];
        let fits: Vec<Axes> =
            writer.orders().iter().copied().filter(|axes| self.fits(axes.sizes(shape))).collect();
        match (self.axes, &*fits) {
            (Some(stated), _) => Ok(stated),
            (None, [only]) => Ok(*only),
            (None, [_, _, ..]) if self.is_constrained() => {
                let describe = |axes: &Axes| {
                    let (frames, height, width) = axes.sizes(shape);
                    format!("{axes} ({frames} of {height}x{width})")
                };
                let fits: Vec<String> = fits.iter().map(describe).collect();
                Err(FormatError::AxesAmbiguous { format, shape, fits: fits.join(", ") })
            }
            (None, []) if self.size.is_some() && self.fits(Axes::FrameColumnRow.sizes(shape)) => {
                Ok(Axes::FrameColumnRow)
            }
            (None, _) => Ok(usual),
        }
    }

    /// True if anything is known that excludes some orders.
    fn is_constrained(&self) -> bool {
        self.max_frames.is_some() || self.size.is_some()
    }

    fn fits(&self, (frames, height, width): (u64, u64, u64)) -> bool {
        let count_fits = self.max_frames.is_none_or(|max| frames <= max as u64);
        count_fits
            && match self.size {
                Some((rows, columns)) => (height, width) == (rows as u64, columns as u64),
                None => {
                    let (short, long) = (height.min(width), height.max(width));
                    short >= MIN_SIDE && long <= short.saturating_mul(MAX_ASPECT)
                }
            }
    }
}

#[cfg(test)]
mod tests {
    use super::{Axes, Expected, Writer};
    use crate::{Format, FormatError};

    const MASKS: Expected = Expected { axes: None, max_frames: Some(64), size: None };

    fn infer(expected: Expected, writer: Writer, shape: [u64; 3]) -> Result<Axes, String> {
        expected.order(Format::Npy, writer, shape).map_err(|error| match error {
            FormatError::AxesAmbiguous { fits, .. } => fits,
            other => panic!("{other}"),
        })
    }

    #[test]
    fn the_only_fitting_order_is_used() {
        use Axes::{ColumnRowFrame, FrameColumnRow, FrameRowColumn, RowColumnFrame};
        assert_eq!(infer(MASKS, Writer::Rows, [8, 256, 256]), Ok(FrameRowColumn));
        assert_eq!(infer(MASKS, Writer::Rows, [8, 48, 64]), Ok(FrameRowColumn));
        assert_eq!(infer(MASKS, Writer::Matlab, [256, 256, 8]), Ok(RowColumnFrame));
        assert_eq!(infer(MASKS, Writer::Matlab, [8, 256, 256]), Ok(FrameRowColumn));
        let vga = Expected { size: Some((480, 640)), ..Expected::default() };
        for (shape, axes) in [
            ([5, 480, 640], FrameRowColumn),
            ([480, 640, 5], RowColumnFrame),
            ([640, 480, 5], ColumnRowFrame),
            ([5, 640, 480], FrameColumnRow),
            ([480, 640, 640], RowColumnFrame),
        ] {
            assert_eq!(infer(vga, Writer::Rows, shape), Ok(axes), "{shape:?}");
        }
        // No order fits: the usual one is assumed, and later checks refuse the sizes.
        assert_eq!(infer(vga, Writer::Rows, [640, 5, 480]), Ok(FrameRowColumn));
        assert_eq!(infer(MASKS, Writer::Rows, [3, 4, 5]), Ok(FrameRowColumn));
        assert_eq!(infer(MASKS, Writer::Matlab, [500, 400, 300]), Ok(RowColumnFrame));
        // Nothing is known.
        assert_eq!(infer(Expected::default(), Writer::Rows, [256, 256, 8]), Ok(FrameRowColumn));
    }

    #[test]
    fn several_fitting_orders_are_listed() {
        let fits = infer(MASKS, Writer::Rows, [480, 640, 8]).unwrap_err();
        assert_eq!(fits, "row-column-frame (8 of 480x640), column-row-frame (8 of 640x480)");
        let fits = infer(MASKS, Writer::Matlab, [40, 48, 64]).unwrap_err();
        assert_eq!(fits, "row-column-frame (64 of 40x48), frame-row-column (40 of 48x64)");
        let square = Expected { size: Some((256, 256)), ..Expected::default() };
        assert!(infer(square, Writer::Rows, [256, 256, 256]).unwrap_err().starts_with("frame-row"));
        assert!(infer(square, Writer::Fortran, [256, 256, 9]).is_err());
        let stated = Expected { axes: Some(Axes::RowColumnFrame), ..MASKS };
        assert_eq!(infer(stated, Writer::Rows, [480, 640, 8]), Ok(Axes::RowColumnFrame));
    }
}
