//! Registration of masks that have moved since their calibration.
//!
//! The displacement is the one at which a short reconstruction predicts pixels best that it has not seen. Whole pixels are
//! searched first. Then a quadratic is fitted to the hold-out error around the best displacement, on ever finer grids. The
//! error itself is minimised, because a linearised step is biased towards 0 by the errors of the frames. Its ratio to the error
//! of the same masks elsewhere decides how the masks are interpolated.
//!
//! A correction is accepted only if it lowers the error significantly at pixels that took no part in the search.

use std::ops::Range;

use ndarray::{Array2, Array3, ArrayView2, ArrayView3, ArrayViewMut1, ArrayViewMut2, Axis, s};
use rand::{RngExt, SeedableRng};
use schemars::JsonSchema;
use serde::{Deserialize, Serialize};

use super::crop;
use super::error::{ReconError, Result, shape_text};
use super::hold_out::{HoldOut, t_statistic};
use super::operator::SensingOperator;
use super::schedule::Schedule;
use super::solver;

/// Largest displacement along each axis that is searched, in pixels.
pub const REACH: usize = 4;
/// Pixels around a window that its interpolation needs: a spline's filter falls below 2e-6 within 16 pixels.
pub const MARGIN: usize = 16 + REACH + 1;
/// Shortest side in pixels of a piece that is compared.
const SHORTEST_SIDE: usize = 32;
/// Share of pixels that are held out.
const SHARE: f64 = 0.1;
/// Iterations of total variation in the search by whole pixels, and in the refinement.
const ITERATIONS: (usize, usize) = (8, 24);
/// Distances in pixels between the displacements of the first grids of the refinement.
const STEPS: [f64; 2] = [0.5, 0.25];
/// Distances in pixels between the displacements of the last grids: each grid is repeated until it has settled.
const LAST_STEPS: [f64; 3] = [0.125, 0.0625, 0.03125];
/// Largest number of these grids.
const MAX_GRIDS: usize = 7;
/// Largest move of a grid that has settled, in distances of its displacements.
const SETTLED: f64 = 0.5;
/// Smallest t-statistic of an accepted correction.
const SIGNIFICANT: f64 = 3.0;
/// Smallest `sum C^2` of interpolated masks at a pixel, relative to the largest of the calibrated pixels around it. At darker
/// pixels the errors of the interpolation outweigh the light, and the projection would divide by it.
const MIN_ENERGY: f32 = 0.05;
/// Width in pixels of the border of a defect that is filled from its surroundings.
const FILLED: usize = 3;
/// Largest hold-out error of an accepted correction, relative to the error of the same masks [`ELSEWHERE`]. Interpolation
/// lowers the contrast of wrong masks, and so their error. Their ratio stays above 0.7, that of most right masks below 0.1.
const EXPLAINED: f64 = 0.5;
/// Distance in whole pixels along both axes of the masks with which this error is compared.
const ELSEWHERE: f64 = REACH as f64;
/// Smallest correction in pixels; a smaller one changes nothing that can be seen.
const SMALLEST: f64 = 0.03;

/// Interpolation of masks by splines. A pixel of a mask is the mean of the light on its area.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Default, Serialize, Deserialize, JsonSchema)]
#[serde(rename_all = "snake_case")]
pub enum Interpolation {
    /// Exact for sharp masks with uniform light on each pixel: a moved pixel covers parts of its neighbours.
    Linear,
    /// For masks between these.
    #[default]
    Cubic,
    /// Most accurate for masks that a lens has blurred.
    Quintic,
}

impl Interpolation {
    const ALL: [Self; 3] = [Self::Linear, Self::Cubic, Self::Quintic];

    fn degree(self) -> usize {
        2 * self as usize + 1
    }

    /// Poles of the filter from samples to coefficients, and its gain (Unser 1999).
    fn filter(self) -> (Vec<f64>, f64) {
        let (a, b) = (17745f64.sqrt() / 2.0, 105f64.sqrt() / 2.0);
        match self {
            Self::Linear => (vec![], 1.0),
            Self::Cubic => (vec![3f64.sqrt() - 2.0], 6.0),
            Self::Quintic => {
                (vec![(67.5 - a).sqrt() + b - 6.5, (67.5 + a).sqrt() - b - 6.5], 120.0)
            }
        }
    }
}

/// A displacement of masks against their calibration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Correction {
    /// Pixels by which the masks have moved down and to the right.
    pub shift: [f64; 2],
    /// Interpolation between the pixels of the calibrated masks.
    pub interpolation: Interpolation,
}

impl Correction {
    /// Moves the masks away by [`ELSEWHERE`]. At the same fractions of a pixel they lose as much contrast, and fit nothing.
    fn elsewhere(self) -> Self {
        Self { shift: self.shift.map(|shift| shift - ELSEWHERE.copysign(shift)), ..self }
    }
}

/// The estimated displacement of masks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Registration {
    /// The displacement with the smallest hold-out error.
    pub correction: Correction,
    /// Standard error of the shift along rows and columns.
    pub uncertainty: [f64; 2],
    /// `||y - Hv||^2 / ||y||^2` at hold-out pixels with the masks of the calibration.
    pub error_before: f64,
    /// `||y - Hv||^2 / ||y||^2` with the moved masks.
    pub error_after: f64,
    /// True if the masks are corrected by this shift. False if the masks fit, or if the search has not converged.
    pub applied: bool,
    /// True if the search has converged within its reach, to masks that explain the measurement.
    pub converged: bool,
}

/// The rows and columns of the piece on which masks are registered, in a measurement `y` \[H,W\] behind masks with the sum
/// `light` \[H,W\]: a crop as [`crop::choose`] selects it, with a margin around it. `None` if the picture is too small.
pub fn choose(
    light: ArrayView2<'_, f32>,
    y: ArrayView2<'_, f32>,
) -> Option<(Range<usize>, Range<usize>)> {
    let (height, width) = y.dim();
    if height.min(width) < SHORTEST_SIDE + 2 * MARGIN {
        return None;
    }
    let inner = s![MARGIN..height - MARGIN, MARGIN..width - MARGIN];
    let (rows, columns) = crop::choose(light.slice(inner), y.slice(inner));
    Some((rows.start..rows.end + 2 * MARGIN, columns.start..columns.end + 2 * MARGIN))
}

/// Estimates the displacement from a piece of the masks \[B,h,w\] and of a measurement \[h,w\] on the scale on which the
/// scene is on \[0,1\]; see [`choose`]. NaN were not measured. `proceed` gets the finished share, and returns false to stop.
/// `None` if the piece has no light or no measured pixels, or if its reconstruction diverges.
///
/// # Errors
/// Sizes that disagree or are too small, [`ReconError::Cancelled`], or those of [`solver::reconstruct`].
pub fn register(
    masks: ArrayView3<'_, f32>,
    y: ArrayView2<'_, f32>,
    proceed: &mut dyn FnMut(f64) -> bool,
) -> Result<Option<Registration>> {
    let mut search = Search::new(masks, y, proceed)?;
    if search.draws.iter().any(|draw| draw.pixels.is_empty()) {
        return Ok(None);
    }
    let Some(mut best) = search.whole_pixels()? else { return Ok(None) };
    for step in STEPS {
        let Some(fit) = search.refine(best, step)? else { return Ok(None) };
        best.shift = fit.minimum;
    }
    let (mut uncertainty, mut has_settled) = ([0.0; 2], false);
    let mut steps = LAST_STEPS.into_iter().peekable();
    for _ in 0..MAX_GRIDS {
        let Some(step) = steps.peek() else { break };
        best.interpolation = search.interpolation(best.shift)?;
        let Some(fit) = search.refine(best, *step)? else { return Ok(None) };
        (best.shift, uncertainty, has_settled) = (fit.minimum, fit.uncertainty, fit.has_settled);
        if has_settled {
            steps.next();
        }
    }
    // The other draw took no part in the search, so its errors are not biased by it.
    let unmoved = Correction { shift: [0.0; 2], ..best };
    let (before, after) =
        (search.errors(unmoved, 1, ITERATIONS.1)?, search.errors(best, 1, ITERATIONS.1)?);
    let (Some(before), Some(after)) = (before, after) else { return Ok(None) };
    let norm = search.draws[1].norm(search.y.view());
    let length = best.shift[0].hypot(best.shift[1]);
    let converged = has_settled && best.shift.iter().all(|shift| shift.abs() <= REACH as f64 + 0.5);
    let Some(wrong) = search.errors(best.elsewhere(), 1, ITERATIONS.1)? else { return Ok(None) };
    let is_explained = after.iter().sum::<f64>() < EXPLAINED * wrong.iter().sum::<f64>();
    Ok(Some(Registration {
        correction: best,
        uncertainty,
        error_before: before.iter().sum::<f64>() / norm,
        error_after: after.iter().sum::<f64>() / norm,
        applied: converged
            && is_explained
            && length >= SMALLEST
            && t_statistic(&before, &after) >= SIGNIFICANT,
        converged: converged && is_explained,
    }))
}

/// Chooses the interpolation of masks that have moved by a known `shift`, from a piece as for [`register`].
///
/// # Errors
/// Those of [`register`].
pub fn interpolation(
    masks: ArrayView3<'_, f32>,
    y: ArrayView2<'_, f32>,
    shift: [f64; 2],
    proceed: &mut dyn FnMut(f64) -> bool,
) -> Result<Interpolation> {
    Search::new(masks, y, proceed)?.interpolation(shift)
}

/// Draws two sets of hold-out pixels of a measurement \[1,h,w\]. No pixel is in both.
fn draw(y: &Array3<f32>) -> [HoldOut; 2] {
    let mut random = rand::rngs::ChaCha8Rng::seed_from_u64(0);
    let mut draws = [Vec::new(), Vec::new()];
    for (pixel, value) in y.indexed_iter() {
        let draw = (random.random::<f64>() / SHARE) as usize;
        if let (Some(pixels), false) = (draws.get_mut(draw), value.is_nan()) {
            pixels.push(pixel);
        }
    }
    draws.map(|pixels| HoldOut { pixels })
}

struct Search<'a> {
    /// Masks \[B,h,w\] of the piece with its margin.
    masks: Array3<f32>,
    /// The masks by each of [`Interpolation::ALL`].
    interpolated: [Interpolated; 3],
    /// Measurement \[1,h,w\] of the piece without its margin.
    y: Array3<f32>,
    /// Hold-out pixels of the search, and of the decision.
    draws: [HoldOut; 2],
    proceed: &'a mut dyn FnMut(f64) -> bool,
    /// Finished iterations.
    done: f64,
    total: f64,
}

/// The minimum of a quadratic that was fitted to hold-out errors.
struct Fit {
    minimum: [f64; 2],
    uncertainty: [f64; 2],
    /// True if the quadratic has a minimum, close to the centre of the grid.
    has_settled: bool,
}

impl<'a> Search<'a> {
    fn new(
        masks: ArrayView3<'_, f32>,
        y: ArrayView2<'_, f32>,
        proceed: &'a mut dyn FnMut(f64) -> bool,
    ) -> Result<Self> {
        let (_, height, width) = masks.dim();
        if y.dim() != (height, width) || height.min(width) < SHORTEST_SIDE + 2 * MARGIN {
            return Err(ReconError::Shape {
                what: "the piece of a registration",
                found: format!("{} and {}", shape_text(masks.shape()), shape_text(y.shape())),
                expected: format!("one size of at least {} pixels", SHORTEST_SIDE + 2 * MARGIN),
            });
        }
        let inner = s![MARGIN..height - MARGIN, MARGIN..width - MARGIN];
        let interpolated = Interpolation::ALL.map(|kind| Interpolated::new(masks, kind));
        let masks = masks.mapv(|mask| if mask.is_nan() { 0.0 } else { mask });
        let y = y.slice(inner).insert_axis(Axis(0)).to_owned();
        let draws = draw(&y);
        let runs = STEPS.len() * 9 + MAX_GRIDS * (9 + 2 * Interpolation::ALL.len()) + 3;
        let total = ((2 * REACH + 1).pow(2) * ITERATIONS.0 + runs * ITERATIONS.1) as f64;
        Ok(Self { masks, interpolated, y, draws, proceed, done: 0.0, total })
    }

    /// Squared errors at the pixels of a draw with moved masks; `None` if they are dark or the solver diverges.
    fn errors(
        &mut self,
        Correction { shift, interpolation }: Correction,
        draw: usize,
        iterations: usize,
    ) -> Result<Option<Vec<f64>>> {
        let hold_out = &self.draws[draw];
        if !(self.proceed)((self.done / self.total).min(1.0)) {
            return Err(ReconError::Cancelled);
        }
        self.done += iterations as f64;
        let (_, height, width) = self.masks.dim();
        let inner = (MARGIN..height - MARGIN, MARGIN..width - MARGIN);
        let masks = if shift.iter().all(|shift| shift.fract() == 0.0) {
            let start = |axis: usize| (MARGIN as i64 - shift[axis] as i64) as usize;
            let (_, rows, columns) = self.y.dim();
            let (row, column) = (start(0), start(1));
            self.masks.slice(s![.., row..row + rows, column..column + columns]).to_owned()
        } else {
            self.interpolated[interpolation as usize].window(shift, inner.0, inner.1)
        };
        let whole = match SensingOperator::new(masks) {
            Err(ReconError::DarkMasks { .. }) => return Ok(None),
            other => other?,
        };
        let op = whole.clone().without(&hold_out.pixels);
        let schedule = Schedule::gap_tv().with_iterations(iterations);
        match solver::reconstruct(&op, self.y.view(), &schedule, &mut (), &mut ()) {
            Err(ReconError::Diverged { .. }) => Ok(None),
            outcome => Ok(Some(hold_out.residuals(&whole, self.y.view(), outcome?.frames.view()))),
        }
    }

    /// The shift by whole pixels with the smallest error.
    fn whole_pixels(&mut self) -> Result<Option<Correction>> {
        let reach = REACH as i32;
        let mut best: Option<(f64, Correction)> = None;
        for row in -reach..=reach {
            for column in -reach..=reach {
                let shift = [f64::from(row), f64::from(column)];
                let place = Correction { shift, interpolation: Interpolation::default() };
                let Some(errors) = self.errors(place, 0, ITERATIONS.0)? else { continue };
                let error: f64 = errors.iter().sum();
                if best.is_none_or(|(smallest, _)| error < smallest) {
                    best = Some((error, place));
                }
            }
        }
        Ok(best.map(|(_, place)| place))
    }

    /// The interpolation with the smallest error relative to that of the same masks elsewhere, since a loss of contrast lowers
    /// both. Shifts by whole pixels have the default: none is better there.
    fn interpolation(&mut self, shift: [f64; 2]) -> Result<Interpolation> {
        let mut best = (f64::INFINITY, Interpolation::default());
        if shift.iter().all(|shift| shift.fract() == 0.0) {
            return Ok(best.1);
        }
        for interpolation in Interpolation::ALL {
            let place = Correction { shift, interpolation };
            let Some(errors) = self.errors(place, 0, ITERATIONS.1)? else { continue };
            let Some(wrong) = self.errors(place.elsewhere(), 0, ITERATIONS.1)? else { continue };
            let ratio = errors.iter().sum::<f64>() / wrong.iter().sum::<f64>();
            if ratio < best.0 {
                best = (ratio, interpolation);
            }
        }
        Ok(best.1)
    }

    /// Fits a quadratic to the errors on a grid of 3x3 shifts around `centre`. The minimum lies within the grid.
    fn refine(&mut self, best: Correction, step: f64) -> Result<Option<Fit>> {
        let centre = best.shift;
        let mut grid = Vec::with_capacity(9);
        for place in 0..9 {
            let (row, column) = (f64::from(place / 3 - 1), f64::from(place % 3 - 1));
            let limit = (REACH + 1) as f64;
            let shift = [centre[0] + step * row, centre[1] + step * column];
            let shift = shift.map(|value| value.clamp(-limit, limit));
            match self.errors(Correction { shift, ..best }, 0, ITERATIONS.1)? {
                Some(errors) => grid.push(errors),
                None => return Ok(None),
            }
        }
        let sums: Vec<f64> = grid.iter().map(|errors| errors.iter().sum()).collect();
        let quadratic = Quadratic::fit(|place| sums[place]);
        let lowest = quadratic.minimum();
        let has_settled = lowest.is_some_and(|offset| offset.iter().all(|at| at.abs() <= SETTLED));
        let offset = lowest.unwrap_or_else(|| {
            let smallest = (0..9).min_by(|a, b| sums[*a].total_cmp(&sums[*b])).unwrap_or(4);
            [smallest as f64 / 3.0, smallest as f64 % 3.0].map(|place| place.floor() - 1.0)
        });
        let gradients = (0..grid[0].len()).map(|pixel| {
            let quadratic = Quadratic::fit(|place| grid[place][pixel]);
            quadratic.gradient_at(offset)
        });
        let uncertainty = quadratic.uncertainty(gradients).map(|value| value * step);
        let minimum = [centre[0] + step * offset[0], centre[1] + step * offset[1]];
        Ok(Some(Fit { minimum, uncertainty, has_settled }))
    }
}

/// `c + g.d + d.H d / 2` on a grid of 3x3 places `d` from -1 to 1.
struct Quadratic {
    gradient: [f64; 2],
    /// Second derivatives along rows, columns, and both.
    curvature: [f64; 3],
}

impl Quadratic {
    /// The least-squares fit to values in row order.
    fn fit(value: impl Fn(usize) -> f64) -> Self {
        let sum = |weight: &dyn Fn(f64, f64) -> f64| {
            let place = |place: usize| ((place / 3) as f64 - 1.0, (place % 3) as f64 - 1.0);
            (0..9).map(|at| weight(place(at).0, place(at).1) * value(at)).sum::<f64>()
        };
        let gradient = [sum(&|row, _| row) / 6.0, sum(&|_, column| column) / 6.0];
        let curvature = [
            sum(&|row, _| row * row - 2.0 / 3.0),
            sum(&|_, column| column * column - 2.0 / 3.0),
            sum(&|row, column| row * column) / 4.0,
        ];
        Self { gradient, curvature }
    }

    /// The minimum within the grid; `None` if the quadratic has none.
    fn minimum(&self) -> Option<[f64; 2]> {
        let inverse = self.inverse()?;
        let [row, column] = self.gradient;
        let at =
            [-(inverse[0] * row + inverse[2] * column), -(inverse[2] * row + inverse[1] * column)];
        Some(at.map(|value| value.clamp(-1.0, 1.0)))
    }

    /// The inverse of a positive definite curvature.
    fn inverse(&self) -> Option<[f64; 3]> {
        let [rows, columns, both] = self.curvature;
        let determinant = rows * columns - both * both;
        let is_convex = rows > 0.0 && columns > 0.0 && determinant > 0.0;
        is_convex.then(|| [columns / determinant, rows / determinant, -both / determinant])
    }

    fn gradient_at(&self, [row, column]: [f64; 2]) -> [f64; 2] {
        let ([g0, g1], [rows, columns, both]) = (self.gradient, self.curvature);
        [g0 + rows * row + both * column, g1 + both * row + columns * column]
    }

    /// Standard errors of the minimum of a sum of quadratics with these gradients; the step of the grid if it has none.
    fn uncertainty(&self, gradients: impl Iterator<Item = [f64; 2]>) -> [f64; 2] {
        let Some([rows, columns, both]) = self.inverse() else { return [1.0; 2] };
        let (mut row, mut column) = (0.0, 0.0);
        for gradient in gradients {
            row += (rows * gradient[0] + both * gradient[1]).powi(2);
            column += (both * gradient[0] + columns * gradient[1]).powi(2);
        }
        [row.sqrt(), column.sqrt()]
    }
}

/// Interpolated masks \[B,h,w\].
pub struct Interpolated {
    degree: usize,
    /// Coefficients of splines through the masks \[B,h,w\].
    coefficients: Array3<f32>,
    /// `sum C^2` of the masks \[h,w\]; NaN where they are unknown.
    energy: Array2<f32>,
}

impl Interpolated {
    /// Continues the masks by reflection. NaN are filled from their surroundings, so that they do not ring.
    pub fn new(masks: ArrayView3<'_, f32>, interpolation: Interpolation) -> Self {
        let energy = masks.map_axis(Axis(0), |pixel| pixel.iter().map(|mask| mask * mask).sum());
        let mut coefficients = masks.to_owned();
        coefficients.outer_iter_mut().for_each(fill);
        let (poles, gain) = interpolation.filter();
        for axis in [Axis(1), Axis(2)] {
            for lane in coefficients.lanes_mut(axis) {
                filter(lane, &poles, gain);
            }
        }
        Self { degree: interpolation.degree(), coefficients, energy }
    }

    /// A window of the masks after they moved down and to the right by `shift`, clipped to \[0,1\]. A pixel that no part of
    /// the masks has moved onto is NaN. All masks are 0 where an unknown pixel contributes or hardly any light is left.
    pub fn window(
        &self,
        shift: [f64; 2],
        rows: Range<usize>,
        columns: Range<usize>,
    ) -> Array3<f32> {
        let (frames, height, width) = self.coefficients.dim();
        let taps = |range: Range<usize>, shift: f64, length: usize| -> Vec<Taps> {
            range.map(|place| Taps::at(place, shift, length, self.degree)).collect()
        };
        let (rows, columns) = (taps(rows, shift[0], height), taps(columns, shift[1], width));
        let mut window = Array3::zeros((frames, rows.len(), columns.len()));
        let mut between = Array2::zeros((rows.len(), width));
        for (mut out, plane) in window.outer_iter_mut().zip(self.coefficients.outer_iter()) {
            between.fill(0.0);
            for (mut line, taps) in between.outer_iter_mut().zip(&rows) {
                for (&place, &weight) in taps.places.iter().zip(&taps.weights) {
                    line.scaled_add(weight, &plane.row(place));
                }
            }
            for (mut out, line) in out.outer_iter_mut().zip(between.outer_iter()) {
                for (out, taps) in out.iter_mut().zip(&columns) {
                    let places = taps.places.iter().zip(&taps.weights);
                    let value: f32 = places.map(|(&place, &weight)| weight * line[place]).sum();
                    *out = value.clamp(0.0, 1.0);
                }
            }
        }
        let places = rows.iter().flat_map(|row| columns.iter().map(move |column| (row, column)));
        for (mut pixel, (row, column)) in window.lanes_mut(Axis(0)).into_iter().zip(places) {
            let nearest = row.nearest().iter().flat_map(|&row| {
                column.nearest().iter().map(move |&column| self.energy[[row, column]])
            });
            // NaN outweigh all other values.
            let brightest: f32 =
                nearest.fold(
                    0.0,
                    |most, energy| if energy > most || energy.is_nan() { energy } else { most },
                );
            let energy = pixel.iter().map(|mask| mask * mask).sum::<f32>();
            if brightest.is_nan() && !energy.is_nan() || energy < MIN_ENERGY * brightest {
                pixel.fill(0.0);
            }
        }
        window
    }
}

/// Replaces NaN of a mask within [`FILLED`] pixels of known ones by means of their neighbours, and others by 0.
fn fill(mut mask: ArrayViewMut2<'_, f32>) {
    let mut unknown: Vec<(usize, usize)> =
        mask.indexed_iter().filter(|(_, value)| value.is_nan()).map(|(at, _)| at).collect();
    let (height, width) = mask.dim();
    for _ in 0..FILLED {
        let means = unknown.iter().map(|&(row, column)| {
            let rows = row.saturating_sub(1)..height.min(row + 2);
            let columns = column.saturating_sub(1)..width.min(column + 2);
            let around = mask.slice(s![rows, columns]);
            let known = || around.iter().filter(|value| !value.is_nan());
            known().sum::<f32>() / known().count() as f32
        });
        let means: Vec<f32> = means.collect();
        unknown.iter().zip(&means).for_each(|(&at, &mean)| mask[at] = mean);
        unknown.retain(|&at| mask[at].is_nan());
    }
    unknown.into_iter().for_each(|at| mask[at] = 0.0);
}

/// True if part of masks of this length, moved by `shift`, lies on the pixel `place`.
pub fn covers(place: usize, shift: f64, length: usize) -> bool {
    // Half a pixel beyond the last centre a pixel still has light on it.
    (-0.5..=length as f64 - 0.5).contains(&(place as f64 - shift))
}

/// The coefficients that contribute to a place, and their weights.
struct Taps {
    places: Vec<usize>,
    weights: Vec<f32>,
    is_between: bool,
}

impl Taps {
    /// The one or two nearest pixels.
    fn nearest(&self) -> &[usize] {
        let middle = self.places.len() / 2 - 1;
        &self.places[middle..=middle + usize::from(self.is_between)]
    }

    fn at(place: usize, shift: f64, length: usize, degree: usize) -> Self {
        let is_known = covers(place, shift, length);
        let place = place as f64 - shift;
        let (first, t) = (place.floor() as i64 - (degree / 2) as i64, place - place.floor());
        // The B-splines of each degree follow from those of the degree below (de Boor).
        let mut weights = vec![1.0];
        for degree in 1..=degree {
            let below = |tap: usize| weights.get(tap).copied().unwrap_or(0.0);
            let weight = |tap: usize| {
                let rising = if tap > 0 { below(tap - 1) } else { 0.0 };
                let at = t - tap as f64;
                ((at + degree as f64) * rising + (1.0 - at) * below(tap)) / degree as f64
            };
            weights = (0..=degree).map(weight).collect();
        }
        let reflected = |index: i64| {
            let last = length as i64 - 1;
            let index = index.abs();
            (if index > last { 2 * last - index } else { index }).clamp(0, last) as usize
        };
        let known = |weight: f64| if is_known { weight as f32 } else { f32::NAN };
        Self {
            places: (first..=first + degree as i64).map(reflected).collect(),
            weights: weights.into_iter().map(known).collect(),
            is_between: t > 0.0,
        }
    }
}

/// Converts samples into coefficients of a spline, in place (Unser 1999).
fn filter(mut line: ArrayViewMut1<'_, f32>, poles: &[f64], gain: f64) {
    let length = line.len();
    if length < 2 {
        return;
    }
    let mut values: Vec<f64> = line.iter().map(|&value| gain * f64::from(value)).collect();
    for pole in poles {
        // Beyond 30 samples the powers of the pole are below 2e-11.
        let (mut sum, mut power) = (0.0, 1.0);
        for index in 0..30 {
            let period = 2 * (length - 1);
            let place = index % period;
            sum += power * values[if place < length { place } else { period - place }];
            power *= pole;
        }
        values[0] = sum;
        for index in 1..length {
            values[index] += pole * values[index - 1];
        }
        let last = length - 1;
        values[last] = pole / (pole * pole - 1.0) * (values[last] + pole * values[last - 1]);
        for index in (0..last).rev() {
            values[index] = pole * (values[index + 1] - values[index]);
        }
    }
    line.iter_mut().zip(values).for_each(|(out, value)| *out = value as f32);
}

#[cfg(test)]
mod tests {
    use super::{Interpolated, Interpolation, MARGIN, Registration, choose, register};
    use ndarray::{Array3, ArrayView3, Axis, s};
    use optics::{iid_masks, measure, noisy, soften};

    /// Grey masks \[B,n,n\] as means over the areas of pixels, after their light moved by `cells` quarters of a pixel.
    fn by_areas(frames: usize, side: usize, cells: [usize; 2], blur: f64) -> Array3<f32> {
        // Two apertures show the pattern at places that are a pixel apart.
        let pattern = iid_masks(frames, side + 8, side + 9, 3).unwrap();
        let size = (frames, 4 * side + 32, 4 * side + 32);
        let mut light = Array3::from_shape_fn(size, |(k, i, j)| {
            (pattern[[k, i / 4, j / 4]] + pattern[[k, i / 4, j / 4 + 1]]) / 2.0
        });
        soften(&mut light, 4.0 * blur, 0.0).unwrap();
        Array3::from_shape_fn((frames, side, side), |(k, i, j)| {
            let (row, column) = (4 * i + 16 - cells[0], 4 * j + 16 - cells[1]);
            light.slice(s![k, row..row + 4, column..column + 4]).mean().unwrap()
        })
    }

    fn scene(frames: usize, side: usize) -> Array3<f32> {
        Array3::from_shape_fn((frames, side, side), |(k, i, j)| {
            let (i, j) = (i as f32, j as f32 - 1.5 * k as f32);
            let disc = (i - 60.0).hypot(j - 60.0) < 25.0;
            0.4 + 0.25 * (i / 9.0).sin() * (j / 13.0).cos() + if disc { 0.3 } else { 0.0 }
        })
    }

    fn registered(
        calibrated: &Array3<f32>,
        moved: ArrayView3<'_, f32>,
        sigma: f32,
    ) -> Registration {
        let (frames, side, _) = moved.dim();
        let y = measure(moved, scene(frames, side).view()).unwrap();
        let y = noisy(y, sigma, 7).unwrap();
        let light = calibrated.sum_axis(Axis(0));
        let (rows, columns) = choose(light.view(), y.view()).unwrap();
        let masks = calibrated.slice(s![.., rows.clone(), columns.clone()]);
        register(masks, y.slice(s![rows, columns]), &mut |_| true).unwrap().unwrap()
    }

    #[test]
    fn moved_masks_are_found_and_masks_that_fit_are_left() {
        let side = 2 * MARGIN + 64;
        for (cells, blur, sigma, interpolation) in [
            ([2, 1], 0.0, 0.0, Interpolation::Linear),
            ([10, 3], 0.0, 0.01, Interpolation::Linear),
            ([2, 3], 0.7, 0.0, Interpolation::Quintic),
        ] {
            let calibrated = by_areas(6, side, [0, 0], blur);
            let found = registered(&calibrated, by_areas(6, side, cells, blur).view(), sigma);
            assert!(found.applied && found.error_after < found.error_before, "{found:?}");
            assert_eq!(found.correction.interpolation, interpolation, "{found:?}");
            for (axis, cells) in cells.into_iter().enumerate() {
                let expected = cells as f64 / 4.0;
                assert!((found.correction.shift[axis] - expected).abs() < 0.03, "{found:?}");
            }
        }
        let calibrated = by_areas(6, side, [0, 0], 0.0);
        let mut flipped = calibrated.clone();
        flipped.invert_axis(Axis(2));
        let found = registered(&flipped, calibrated.view(), 0.01);
        assert!(!found.applied && !found.converged, "{found:?}");
        for sigma in [0.0, 0.02] {
            let found = registered(&calibrated, calibrated.view(), sigma);
            assert!(!found.applied, "{found:?}");
        }
    }

    #[test]
    fn dark_and_unknown_pixels_count_as_not_measured() {
        let mut masks = iid_masks(4, 60, 60, 4).unwrap();
        let whole = Interpolated::new(masks.view(), Interpolation::Linear);
        masks.slice_mut(s![.., 30, 30]).fill(f32::NAN);
        let shift = [0.4, 0.3];
        let interpolated = Interpolated::new(masks.view(), Interpolation::Linear);
        let moved = interpolated.window(shift, 20..40, 20..40);
        assert!(moved.iter().all(|value| (0.0..=1.0).contains(value)));
        let darkest = |masks: &Array3<f32>| {
            let energies =
                masks.map_axis(Axis(0), |pixel| pixel.iter().map(|c| c * c).sum::<f32>());
            energies.into_iter().filter(|energy| *energy > 0.0).fold(4.0, f32::min)
        };
        assert!(darkest(&moved) >= super::MIN_ENERGY);
        // The unknown pixel contributes to four pixels. The others hardly notice it.
        let expected = whole.window(shift, 20..40, 20..40);
        let differ = |bound: f32| {
            let pixels = moved.lanes(Axis(0)).into_iter().zip(expected.lanes(Axis(0)));
            pixels
                .filter(|(one, other)| one.iter().zip(*other).any(|(a, b)| (a - b).abs() > bound))
                .count()
        };
        assert!((0..4).all(|k| moved[[k, 10, 10]] == 0.0 && moved[[k, 11, 11]] == 0.0));
        assert!((1..=4).contains(&differ(0.3)), "{}", differ(0.3));
    }

    #[test]
    fn hold_out_pixels_of_the_two_draws_differ() {
        let mut y = Array3::zeros((1, 60, 60));
        y[[0, 3, 3]] = f32::NAN;
        let [one, other] = super::draw(&y);
        assert!(one.pixels.len() > 250 && other.pixels.len() > 250);
        assert!(
            one.pixels.iter().all(|pixel| !other.pixels.contains(pixel) && *pixel != (0, 3, 3))
        );
    }

    #[test]
    fn interpolation_passes_through_the_masks_and_a_window_needs_only_its_margin() {
        let masks = iid_masks(2, 80, 90, 4).unwrap();
        for interpolation in Interpolation::ALL {
            check_interpolation(&masks, interpolation);
        }
    }

    fn check_interpolation(masks: &Array3<f32>, interpolation: Interpolation) {
        let whole = Interpolated::new(masks.view(), interpolation);
        let unmoved = whole.window([0.0; 2], 0..80, 0..90);
        assert!(unmoved.iter().zip(masks).all(|(one, other)| (one - other).abs() < 1e-5));
        let shift = [1.3, -2.6];
        let expected = whole.window(shift, 30..50, 30..60);
        let piece = masks.slice(s![.., 30 - MARGIN..50 + MARGIN, 30 - MARGIN..60 + MARGIN]);
        let found = Interpolated::new(piece, interpolation).window(
            shift,
            MARGIN..MARGIN + 20,
            MARGIN..MARGIN + 30,
        );
        assert!(found.iter().zip(&expected).all(|(one, other)| (one - other).abs() < 1e-5));
        let moved = whole.window([3.0, 0.0], 0..80, 0..90);
        assert!(moved.slice(s![.., ..2, ..]).iter().all(|value| value.is_nan()));
        let (moved, masks) = (moved.slice(s![.., 3.., ..]), masks.slice(s![.., ..77, ..]));
        assert!(moved.iter().zip(masks).all(|(one, other)| (one - other).abs() < 1e-5));
    }
}
