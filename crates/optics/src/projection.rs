//! Projection of aperture patterns: the masks they produce on the sensor.

use ndarray::{Array1, Array2, ArrayView2, s};
use rayon::iter::{IndexedParallelIterator, ParallelIterator};
use rayon::slice::ParallelSliceMut;
use serde::{Deserialize, Serialize};

use super::axis::{Axis, Cell};
use super::{Geometry, OpticsError, Result, check_parameter, check_size};

/// How the shift of the mask by an aperture cell is computed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Placement {
    /// By whole mask pixels: the geometric shift between neighbours is rounded, as in the paper's simulation.
    WholePixels,
    /// As the geometry determines, with the pattern centred on the optical axis.
    Geometric,
}

/// How the light through an aperture cell is modelled.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "kebab-case")]
pub enum Method {
    /// All light passes the centre of the cell, so a mask is a sum of shifted lithography masks (Eq. 1).
    Shifts,
    /// Light passes the whole area of the cell, so a mask is the convolution of the lithography mask with the scaled
    /// pattern.
    Convolution,
}

/// Projects patterns of aperture cells to masks on the sensor.
///
/// A ray through the aperture at u that reaches the image plane at x crosses the lithography mask, at a distance d
/// before the image plane, at `x + d u / f`.
#[derive(Debug)]
pub struct Projector {
    rows: Axis,
    columns: Axis,
    cells: (usize, usize),
}

impl Projector {
    /// A projector from patterns of `cells` (rows, columns), which cover the LCoS, to a sensor of `sensor` (rows,
    /// columns) pixels.
    ///
    /// Errors: [`OpticsError::Parameter`] for an impossible geometry or size, [`OpticsError::Pattern`] if neighbouring
    /// cells shift the mask by less than half a pixel with [`Placement::WholePixels`].
    pub fn new(
        geometry: &Geometry,
        cells: (usize, usize),
        placement: Placement,
        method: Method,
        sensor: (usize, usize),
    ) -> Result<Self> {
        geometry.check()?;
        check_size(1, sensor.0, sensor.1)?;
        let shift = geometry.shift_per_lcos_pixel();
        let ratio = geometry.sensor_pixels_per_mask_pixel();
        let axis = |lcos: usize, count: usize, pixels: usize, offset: f64| {
            let pitch = lcos as f64 / count as f64 * shift;
            let cells = cells_along_axis(pitch, count, placement, method)?;
            Ok::<_, OpticsError>(Axis::new(&cells, pixels, ratio, offset, geometry.blur()))
        };
        for (name, count, pixels) in [
            ("pattern rows", cells.0, geometry.lcos_rows),
            ("pattern columns", cells.1, geometry.lcos_columns),
        ] {
            let range = "at least 1 and at most the number of LCoS pixels";
            check_parameter((1..=pixels).contains(&count), name, count, range)?;
        }
        Ok(Self {
            rows: axis(geometry.lcos_rows, cells.0, sensor.0, geometry.phase_rows)?,
            columns: axis(geometry.lcos_columns, cells.1, sensor.1, geometry.phase_columns)?,
            cells,
        })
    }

    /// Rows and columns of the part of the lithography mask that is projected onto the sensor.
    pub fn mask_size(&self) -> (usize, usize) {
        (self.rows.length, self.columns.length)
    }

    /// Returns the mask on the sensor \[H,W\]: the sum over the cells of `pattern` of the cell's transmission times the
    /// lithography mask seen through it. Without a mask and with all cells open, each value is the number of cells.
    ///
    /// Errors: [`OpticsError::Pattern`] if the arrays do not have the sizes of [`Projector::new`] and
    /// [`Projector::mask_size`].
    pub fn project(
        &self,
        lithography: ArrayView2<'_, f32>,
        pattern: ArrayView2<'_, f32>,
    ) -> Result<Array2<f32>> {
        if pattern.dim() != self.cells || lithography.dim() != self.mask_size() {
            let text = |(rows, columns): (usize, usize)| format!("{rows}x{columns}");
            let (mask_rows, mask_columns) = self.mask_size();
            return Err(OpticsError::Pattern(format!(
                "the pattern has {} cells, but {} are expected; the lithography mask has {} pixels, but \
                 {mask_rows}x{mask_columns} are expected",
                text(pattern.dim()),
                text(self.cells),
                text(lithography.dim()),
            )));
        }
        let kernels = self.kernels(&pattern.mapv(f64::from));
        let (height, width) = (self.rows.start.len(), self.columns.start.len());
        let mut mask = vec![0.0; height * width];
        mask.par_chunks_mut(width).enumerate().for_each(|(row, out)| {
            let first = self.rows.start[row];
            let kernels = &kernels[self.rows.phase[row]];
            for (column, out) in out.iter_mut().enumerate() {
                let start = self.columns.start[column];
                for tap in &kernels[self.columns.phase[column]] {
                    *out += tap.weight * lithography[[first + tap.row, start + tap.column]];
                }
            }
        });
        Array2::from_shape_vec((height, width), mask)
            .map_err(|error| OpticsError::Pattern(error.to_string()))
    }

    /// Taps of the pattern's kernel for each row phase and column phase.
    fn kernels(&self, pattern: &Array2<f64>) -> Vec<Vec<Vec<Tap>>> {
        let row_kernels = self.rows.weights.iter().map(|rows| {
            let half = rows.t().dot(pattern);
            let columns = self.columns.weights.iter();
            columns.map(|columns| taps(&half.dot(columns))).collect()
        });
        row_kernels.collect()
    }
}

/// A mask pixel and its weight in a sensor pixel.
#[derive(Debug, Clone, Copy)]
struct Tap {
    row: usize,
    column: usize,
    weight: f32,
}

#[allow(clippy::cast_possible_truncation)] // to the precision of the masks
fn taps(kernel: &Array2<f64>) -> Vec<Tap> {
    let taps = kernel.indexed_iter().filter(|(_, weight)| **weight > 0.0);
    taps.map(|((row, column), &weight)| Tap { row, column, weight: weight as f32 }).collect()
}

/// The cells along one axis. `pitch` is the shift between neighbouring cells in mask pixels.
fn cells_along_axis(
    pitch: f64,
    count: usize,
    placement: Placement,
    method: Method,
) -> Result<Vec<Cell>> {
    let half = match method {
        Method::Shifts => 0.0,
        Method::Convolution => pitch / 2.0,
    };
    let centre = match placement {
        Placement::Geometric => Array1::from_iter((0..count).map(|cell| cell as f64 + 0.5))
            .mapv(|cell| (cell - count as f64 / 2.0) * pitch),
        Placement::WholePixels => {
            let step = pitch.round();
            if step < 1.0 && count > 1 {
                return Err(OpticsError::Pattern(format!(
                    "neighbouring sub-apertures shift the mask by {pitch:.3} mask pixels, which rounds to 0: \
                     use fewer sub-apertures, a greater mask distance, or the placement `geometric`"
                )));
            }
            let middle = ((count - 1) / 2) as f64;
            Array1::from_iter((0..count).map(|cell| (cell as f64 - middle) * step))
        }
    };
    let cell = |&at: &f64| Cell { from: at - half, to: at + half };
    Ok(centre.iter().map(cell).collect())
}

/// The central part of an array, of the given numbers of rows and columns.
pub(super) fn centre(
    array: ArrayView2<'_, f32>,
    (rows, columns): (usize, usize),
) -> ArrayView2<'_, f32> {
    let [row, column] = [array.nrows() - rows, array.ncols() - columns].map(|rest| rest / 2);
    array.slice_move(s![row..row + rows, column..column + columns])
}

#[cfg(test)]
mod tests;
