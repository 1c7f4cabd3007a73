//! The order of an array's axes: stated, told by the format, or found from the sizes that are known.

use serde::{Deserialize, Serialize};
use strum::{Display, EnumString, VariantNames};

use super::{Format, FormatError};
use crate::error::Result;

/// The order of the axes of an array, as the program that wrote it shows them: of HDF5 files as h5py does,
/// of MATLAB's as MATLAB does.
#[derive(
    Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize, Display, EnumString, VariantNames,
)]
#[serde(rename_all = "kebab-case")]
#[strum(serialize_all = "kebab-case")]
pub enum Axes {
    /// \[frame, row, column\].
    FrameRowColumn,
    /// \[row, column, frame\].
    RowColumnFrame,
    /// \[column, row, frame\].
    ColumnRowFrame,
    /// \[frame, column, row\]: what MATLAB's `h5write` makes of \[row, column, frame\].
    FrameColumnRow,
}

/// No camera has fewer rows or columns.
const LEAST_SIDE: u64 = 32;
/// No camera's picture is longer than so many times its other side.
const MOST_ASPECT: u64 = 8;

/// What is known of a stack before its file is opened.
#[derive(Debug, Clone, Copy, Default)]
pub struct Expected {
    /// The order that was stated.
    pub axes: Option<Axes>,
    /// The most frames there can be.
    pub most_frames: Option<usize>,
    /// Rows and columns of a frame.
    pub size: Option<(usize, usize)>,
}

/// Who wrote an array: how its shape is told, and which orders people use there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) enum Writer {
    /// The last axis varies fastest.
    Rows,
    /// NumPy's Fortran order: the first axis varies fastest.
    Fortran,
    /// MATLAB: the first axis varies fastest, and frames come last.
    Matlab,
}

/// How the samples of a stack lie one after another.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Layout {
    /// All frames of a pixel lie together; otherwise all pixels of a frame.
    pub(super) interleaved: bool,
    /// Pixels go column by column; otherwise row by row.
    pub(super) by_columns: bool,
}

/// A shape whose axes are known.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(super) struct Arranged {
    pub(super) frames: u64,
    pub(super) height: u64,
    pub(super) width: u64,
    pub(super) layout: Layout,
    /// None for an array of two dimensions.
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
    /// The orders that people use, the usual one first. In MATLAB a matrix is \[row, column\].
    /// [`Axes::FrameColumnRow`] is not among them: turned pictures of a size that nobody knows are no worse
    /// than others.
    fn orders(self) -> &'static [Axes] {
        use Axes::{ColumnRowFrame, FrameRowColumn, RowColumnFrame};
        match self {
            Self::Rows | Self::Fortran => &[FrameRowColumn, RowColumnFrame, ColumnRowFrame],
            Self::Matlab => &[RowColumnFrame, FrameRowColumn],
        }
    }

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
    /// The axes of an array of this shape; none unless it has two or three dimensions.
    /// Errors: [`FormatError::AxesAmbiguous`].
    pub(super) fn arrange(
        &self,
        (format, writer): (Format, Writer),
        shape: &[u64],
    ) -> Result<Option<Arranged>> {
        match *shape {
            [first, second] => {
                let turned = matches!(self.axes, Some(Axes::ColumnRowFrame | Axes::FrameColumnRow));
                let (height, width) = if turned { (second, first) } else { (first, second) };
                let by_columns = turned == (writer == Writer::Rows);
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

    /// The order that was stated; else the one that fits what is known; if none does, that of turned pictures of
    /// the right size, or the usual one, whose sizes are refused elsewhere.
    fn order(&self, format: Format, writer: Writer, shape: [u64; 3]) -> Result<Axes> {
        let usual = writer.orders()[0];
        let fits: Vec<Axes> =
            writer.orders().iter().copied().filter(|axes| self.fits(axes.sizes(shape))).collect();
        match (self.axes, &*fits) {
            (Some(stated), _) => Ok(stated),
            (None, [only]) => Ok(*only),
            (None, [_, _, ..]) if self.knows() => {
                let told = |axes: &Axes| {
                    let (frames, height, width) = axes.sizes(shape);
                    format!("{axes} ({frames} of {height}x{width})")
                };
                let fits: Vec<String> = fits.iter().map(told).collect();
                Err(FormatError::AxesAmbiguous { format, shape, fits: fits.join(", ") })
            }
            (None, []) if self.size.is_some() && self.fits(Axes::FrameColumnRow.sizes(shape)) => {
                Ok(Axes::FrameColumnRow)
            }
            (None, _) => Ok(usual),
        }
    }

    fn knows(&self) -> bool {
        self.most_frames.is_some() || self.size.is_some()
    }

    fn fits(&self, (frames, height, width): (u64, u64, u64)) -> bool {
        let few = self.most_frames.is_none_or(|most| frames <= most as u64);
        few && match self.size {
            Some((rows, columns)) => (height, width) == (rows as u64, columns as u64),
            None => {
                let (short, long) = (height.min(width), height.max(width));
                short >= LEAST_SIDE && long <= short.saturating_mul(MOST_ASPECT)
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::{Axes, Expected, Writer};
    use crate::{Format, FormatError};

    const MASKS: Expected = Expected { axes: None, most_frames: Some(64), size: None };

    fn of(expected: Expected, writer: Writer, shape: [u64; 3]) -> Result<Axes, String> {
        expected.order(Format::Npy, writer, shape).map_err(|error| match error {
            FormatError::AxesAmbiguous { fits, .. } => fits,
            other => panic!("{other}"),
        })
    }

    #[test]
    fn one_order_that_fits_is_taken() {
        use Axes::{ColumnRowFrame, FrameColumnRow, FrameRowColumn, RowColumnFrame};
        assert_eq!(of(MASKS, Writer::Rows, [8, 256, 256]), Ok(FrameRowColumn));
        assert_eq!(of(MASKS, Writer::Rows, [8, 48, 64]), Ok(FrameRowColumn));
        assert_eq!(of(MASKS, Writer::Matlab, [256, 256, 8]), Ok(RowColumnFrame));
        assert_eq!(of(MASKS, Writer::Matlab, [8, 256, 256]), Ok(FrameRowColumn));
        let of_480x640 = Expected { size: Some((480, 640)), ..Expected::default() };
        for (shape, axes) in [
            ([5, 480, 640], FrameRowColumn),
            ([480, 640, 5], RowColumnFrame),
            ([640, 480, 5], ColumnRowFrame),
            ([5, 640, 480], FrameColumnRow),
            // More than a sensor's worth of snapshots, which are few enough for the limits.
            ([480, 640, 640], RowColumnFrame),
        ] {
            assert_eq!(of(of_480x640, Writer::Rows, shape), Ok(axes), "{shape:?}");
        }
        // None fits: the sizes are refused, not the axes.
        assert_eq!(of(of_480x640, Writer::Rows, [640, 5, 480]), Ok(FrameRowColumn));
        assert_eq!(of(MASKS, Writer::Rows, [3, 4, 5]), Ok(FrameRowColumn));
        assert_eq!(of(MASKS, Writer::Matlab, [500, 400, 300]), Ok(RowColumnFrame));
        // Nothing is known.
        assert_eq!(of(Expected::default(), Writer::Rows, [256, 256, 8]), Ok(FrameRowColumn));
    }

    #[test]
    fn several_that_fit_are_listed() {
        let fits = of(MASKS, Writer::Rows, [480, 640, 8]).unwrap_err();
        assert_eq!(fits, "row-column-frame (8 of 480x640), column-row-frame (8 of 640x480)");
        let fits = of(MASKS, Writer::Matlab, [40, 48, 64]).unwrap_err();
        assert_eq!(fits, "row-column-frame (64 of 40x48), frame-row-column (40 of 48x64)");
        let square = Expected { size: Some((256, 256)), ..Expected::default() };
        assert!(of(square, Writer::Rows, [256, 256, 256]).unwrap_err().starts_with("frame-row"));
        assert!(of(square, Writer::Fortran, [256, 256, 9]).is_err());
        let stated = Expected { axes: Some(Axes::RowColumnFrame), ..MASKS };
        assert_eq!(of(stated, Writer::Rows, [480, 640, 8]), Ok(Axes::RowColumnFrame));
    }
}
