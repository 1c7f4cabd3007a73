//! Registration of masks that have moved since their calibration.
//!
//! The motion is the one at which a short reconstruction predicts pixels best that it has not seen. Whole pixels are
//! searched first. Then a quadratic is fitted to the hold-out error around the best motion, on ever finer grids of
//! displacements. The error itself is minimised, because a linearised step is biased towards 0 by the errors of the frames.
//! Its ratio to the error of the same masks elsewhere decides how the masks are interpolated.
//!
//! The error at a hold-out pixel depends on the displacement there. So the errors on a grid of displacements also give the
//! derivatives by rotation and growth. These are estimated from several patches if the errors at a first grid depend on them
//! significantly, and kept if they predict other pixels significantly better than the mean displacement of the patches.
//!
//! A correction is accepted only if it lowers the error significantly at pixels that took no part in the search.

mod fit;
mod interpolated;
mod patches;
mod quadratic;
mod similarity;

pub use fit::Uncertainty;
pub use interpolated::{Interpolated, Interpolation};
pub use patches::Plan;
pub use similarity::{MAX_GROWTH, MAX_ROTATION, REACH, Similarity};

use ndarray::{Array3, ArrayView2, Axis, s};
use rand::{RngExt, SeedableRng};
use serde::{Deserialize, Serialize};

use self::fit::{Fit, Free, Grid, SIGNIFICANT, SMALLEST, middle};
use self::patches::Place;
use super::error::{ReconError, Result, shape_text};
use super::hold_out::{HoldOut, t_statistic};
use super::operator::SensingOperator;
use super::schedule::Schedule;
use super::solver;
use super::tile::Window;

/// Share of pixels that are held out.
const SHARE: f64 = 0.1;
/// Iterations of total variation in the search by whole pixels, and in the refinement.
const ITERATIONS: (usize, usize) = (8, 24);
/// Distances in pixels between the displacements of the first grids of the refinement.
const STEPS: [f64; 2] = [0.5, 0.25];
/// Largest number of grids on a patch alone, at each of these distances and at the first of [`LAST_STEPS`].
const LOCAL_GRIDS: [usize; 3] = [3, 2, 3];
/// Distances in pixels between the displacements of the last grids: each grid is repeated until it has settled.
const LAST_STEPS: [f64; 3] = [0.125, 0.0625, 0.03125];
/// Largest number of these grids.
const MAX_GRIDS: usize = 7;
/// Largest hold-out error of an accepted correction, relative to the error of the same masks [`ELSEWHERE`]. Interpolation
/// lowers the contrast of wrong masks, and so their error. Their ratio stays above 0.7, that of most right masks below 0.1.
const EXPLAINED: f64 = 0.5;
/// Distance in whole pixels along both axes of the masks with which this error is compared.
const ELSEWHERE: f64 = REACH as f64;
/// Least depth of the hold-out error of a correction that is accepted although noise makes up most of its error; see
/// [`Search::depth`]. Wrong masks stay below 2, right ones that have moved lie above 6.
const DEPTH: f64 = 6.0;
/// Distance in whole pixels between the places of this comparison.
const APART: f64 = 3.0;

/// A correction of masks that have moved since their calibration.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize, schemars::JsonSchema)]
pub struct Correction {
    /// The motion of the masks.
    pub motion: Similarity,
    /// Interpolation between the pixels of the calibrated masks.
    pub interpolation: Interpolation,
}

impl Correction {
    /// Moves the masks away by [`ELSEWHERE`]. At the same fractions of a pixel they lose as much contrast, and fit nothing.
    fn elsewhere(self) -> Self {
        let shift = self.motion.shift.map(|shift| shift - ELSEWHERE.copysign(shift));
        Self { motion: Similarity { shift, ..self.motion }, ..self }
    }
}

/// The estimated motion of masks.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Registration {
    /// The motion with the smallest hold-out error.
    pub correction: Correction,
    /// Standard errors of this motion.
    pub uncertainty: Uncertainty,
    /// `||y - Hv||^2 / ||y||^2` at hold-out pixels with the masks of the calibration.
    pub error_before: f64,
    /// `||y - Hv||^2 / ||y||^2` with the moved masks.
    pub error_after: f64,
    /// True if the masks are corrected by this motion. False if the masks fit, or if the search has not converged.
    pub applied: bool,
    /// True if the search has converged within its reach, to masks that explain the measurement.
    pub converged: bool,
}

/// Estimates the motion of masks from the planned patches of a measurement `y` \[H,W\] on the scale on which the scene is on
/// \[0,1\]. NaN were not measured. `masks` reads a window of the masks \[B,h,w\]. `proceed` gets the finished share, and
/// returns false to stop. `None` if the first patch has no light or no measured pixels, or if its reconstruction diverges.
///
/// # Errors
/// Sizes that disagree, [`ReconError::Cancelled`], those of [`solver::reconstruct`] and of `masks`.
pub fn register<E: From<ReconError>>(
    plan: &Plan,
    y: ArrayView2<'_, f32>,
    masks: impl Fn(&Window) -> Result<Array3<f32>, E>,
    proceed: &mut dyn FnMut(f64) -> bool,
) -> Result<Option<Registration>, E> {
    let read = |place: &Place| Patch::read(plan, place, y, &masks);
    let first = read(&plan.first)?;
    if first.draws.iter().any(|draw| draw.pixels.is_empty()) {
        return Ok(None);
    }
    let mut search = Search::new(plan, first, proceed);
    let Some(mut best) = search.whole_pixels()? else { return Ok(None) };
    let [coarse, fine] = STEPS;
    let Some(grids) = search.grids(best, coarse)? else { return Ok(None) };
    best.motion = search.fit(best, &grids, coarse, Free::Shift).minimum;
    best.interpolation = search.interpolation(best.motion)?;
    let Some(grid) = search.grid(0, best, fine)? else { return Ok(None) };
    let grids = [grid];
    let turned = search.fit(best, &grids, fine, Free::All);
    best.motion = search.fit(best, &grids, fine, Free::Shift).minimum;
    if let Some(found) = search.similarity(best, turned, read)? {
        return Ok(Some(found));
    }
    search.patches.truncate(1);
    let Some((best, fit)) = search.settle(best, Free::Shift)? else { return Ok(None) };
    Ok(search.verdict(best, &fit)?)
}

/// The test of a known motion.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Known {
    /// Interpolation of the moved masks.
    pub interpolation: Interpolation,
    /// `||y - Hv||^2 / ||y||^2` at hold-out pixels without and with the motion, and whether the masks explain the measurement
    /// with it, or at least better. `None` if the patch has no light or diverges.
    pub outcome: Option<([f64; 2], bool)>,
}

/// A known motion explains a measurement better if it lowers the ratio to the error elsewhere to this share.
const BETTER: f64 = 0.9;

/// Chooses the interpolation of masks by a known `motion`, and tests this motion, on the first patch as for [`register`].
///
/// # Errors
/// Those of [`register`].
pub fn known<E: From<ReconError>>(
    plan: &Plan,
    y: ArrayView2<'_, f32>,
    motion: Similarity,
    masks: impl Fn(&Window) -> Result<Array3<f32>, E>,
    proceed: &mut dyn FnMut(f64) -> bool,
) -> Result<Known, E> {
    let first = Patch::read(plan, &plan.first, y, &masks)?;
    let mut search = Search::new(plan, first, proceed);
    let interpolation = search.interpolation(motion)?;
    let place = Correction { motion, interpolation };
    let unmoved = Correction { motion: Similarity::default(), interpolation };
    let norm = search.norm();
    let mut relative = |place: Correction| -> Result<Option<f64>> {
        let errors = search.deciding_errors(place)?.filter(|_| norm > 0.0);
        Ok(errors.map(|errors| errors.iter().sum::<f64>() / norm))
    };
    let errors = [unmoved, place, unmoved.elsewhere(), place.elsewhere()].map(&mut relative);
    let [before, after, elsewhere, moved_elsewhere] = errors;
    let outcome = match (before?, after?, elsewhere?, moved_elsewhere?) {
        (Some(before), Some(after), Some(elsewhere), Some(moved_elsewhere)) => {
            let (ratio_before, ratio) = (before / elsewhere, after / moved_elsewhere);
            Some(([before, after], ratio < EXPLAINED || ratio < BETTER * ratio_before))
        }
        _ => None,
    };
    Ok(Known { interpolation, outcome })
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

/// A patch of a picture.
struct Patch {
    /// Row and column of the first pixel of the masks on the sensor.
    origin: [usize; 2],
    /// Masks \[B,h,w\] of the patch with its margin.
    masks: Array3<f32>,
    /// The masks by each of [`Interpolation::ALL`].
    interpolated: [Interpolated; 3],
    /// Measurement \[1,h,w\] of the patch without its margin.
    y: Array3<f32>,
    /// Hold-out pixels of the search, and of the decision.
    draws: [HoldOut; 2],
}

impl Patch {
    fn read<E: From<ReconError>>(
        plan: &Plan,
        place: &Place,
        y: ArrayView2<'_, f32>,
        masks: impl Fn(&Window) -> Result<Array3<f32>, E>,
    ) -> Result<Self, E> {
        let window = place.window(plan.margin);
        let masks = masks(&window)?;
        let (_, height, width) = masks.dim();
        if (height, width) != (window.rows.len(), window.columns.len())
            || y.dim() != (plan.sensor[0], plan.sensor[1])
        {
            return Err(E::from(ReconError::Shape {
                what: "the patch of a registration",
                found: format!("{} of {}", shape_text(masks.shape()), shape_text(y.shape())),
                expected: format!(
                    "{} of {}",
                    shape_text(&[window.rows.len(), window.columns.len()]),
                    shape_text(&plan.sensor)
                ),
            }));
        }
        let interpolated = Interpolation::ALL.map(|kind| Interpolated::new(masks.view(), kind));
        let masks = masks.mapv_into(|mask| if mask.is_nan() { 0.0 } else { mask });
        let y = y.slice(s![place.rows.clone(), place.columns.clone()]);
        let y = y.insert_axis(Axis(0)).to_owned();
        let origin = [window.rows.start, window.columns.start];
        let draws = draw(&y);
        Ok(Self { origin, masks, interpolated, y, draws })
    }

    /// Squared errors at the pixels of a draw with moved masks; `None` if they are dark or the solver diverges.
    fn errors(
        &self,
        plan: &Plan,
        Correction { motion, interpolation }: Correction,
        draw: usize,
        iterations: usize,
    ) -> Result<Option<Vec<f64>>> {
        let (_, rows, columns) = self.y.dim();
        let margin = plan.margin;
        let masks = if motion.is_whole() {
            let start = |axis: usize| (margin as i64 - motion.shift[axis] as i64) as usize;
            let (row, column) = (start(0), start(1));
            self.masks.slice(s![.., row..row + rows, column..column + columns]).to_owned()
        } else {
            let source = motion.source(plan.sensor, self.origin);
            let inner = (margin..margin + rows, margin..margin + columns);
            self.interpolated[interpolation as usize].window(&source, inner.0, inner.1)
        };
        let whole = match SensingOperator::new(masks) {
            Err(ReconError::DarkMasks { .. }) => return Ok(None),
            other => other?,
        };
        let hold_out = &self.draws[draw];
        let op = whole.clone().without(&hold_out.pixels);
        let schedule = Schedule::gap_tv().with_iterations(iterations);
        match solver::reconstruct(&op, self.y.view(), &schedule, &mut (), &mut ()) {
            Err(ReconError::Diverged { .. }) => Ok(None),
            outcome => Ok(Some(hold_out.residuals(&whole, self.y.view(), outcome?.frames.view()))),
        }
    }

    /// Rows and columns on the sensor of the hold-out pixels of the search.
    fn places(&self, margin: usize) -> impl Iterator<Item = [f64; 2]> {
        let [row, column] = self.origin.map(|start| start + margin);
        self.draws[0].pixels.iter().map(move |&(_, i, j)| [(row + i) as f64, (column + j) as f64])
    }
}

struct Search<'a> {
    plan: &'a Plan,
    /// The first patch of the plan, and others.
    patches: Vec<Patch>,
    proceed: &'a mut dyn FnMut(f64) -> bool,
    /// Finished iterations.
    done: f64,
    total: f64,
}

impl<'a> Search<'a> {
    fn new(plan: &'a Plan, first: Patch, proceed: &'a mut dyn FnMut(f64) -> bool) -> Self {
        let interpolations = Interpolation::ALL.len();
        let runs = (STEPS.len() + 2 * MAX_GRIDS + interpolations - 1) * 9 + 4 * interpolations + 3;
        let grids = LOCAL_GRIDS.iter().sum::<usize>();
        let others = plan.others.first().map_or(0, |others| 9 * grids * (1 + others.len()));
        let total = (2 * plan.reach() + 1).pow(2) * ITERATIONS.0 + (runs + others) * ITERATIONS.1;
        Self { plan, patches: vec![first], proceed, done: 0.0, total: total as f64 }
    }

    /// Squared errors of one patch; see [`Patch::errors`].
    fn errors(
        &mut self,
        patch: usize,
        correction: Correction,
        draw: usize,
        iterations: usize,
    ) -> Result<Option<Vec<f64>>> {
        if !(self.proceed)((self.done / self.total).min(1.0)) {
            return Err(ReconError::Cancelled);
        }
        self.done += iterations as f64;
        self.patches[patch].errors(self.plan, correction, draw, iterations)
    }

    /// Squared errors at the pixels of all patches on which the decision depends.
    fn deciding_errors(&mut self, correction: Correction) -> Result<Option<Vec<f64>>> {
        let mut all = Vec::new();
        for patch in 0..self.patches.len() {
            let Some(errors) = self.errors(patch, correction, 1, ITERATIONS.1)? else {
                return Ok(None);
            };
            all.extend(errors);
        }
        Ok(Some(all))
    }

    /// The sum of squares of the measurement at these pixels.
    fn norm(&self) -> f64 {
        self.patches.iter().map(|patch| patch.draws[1].norm(patch.y.view())).sum()
    }

    /// The shift by whole pixels with the smallest error of the first patch.
    fn whole_pixels(&mut self) -> Result<Option<Correction>> {
        let reach = self.plan.reach() as i32;
        let mut best: Option<(f64, Correction)> = None;
        for row in -reach..=reach {
            for column in -reach..=reach {
                let motion = Similarity::shifted([f64::from(row), f64::from(column)]);
                let place = Correction { motion, interpolation: Interpolation::default() };
                let Some(errors) = self.errors(0, place, 0, ITERATIONS.0)? else { continue };
                let error: f64 = errors.iter().sum();
                if best.is_none_or(|(smallest, _)| error < smallest) {
                    best = Some((error, place));
                }
            }
        }
        Ok(best.map(|(_, place)| place))
    }

    /// The interpolation with the smallest error of the first patch relative to that of the same masks elsewhere, since a
    /// loss of contrast lowers both. Shifts by whole pixels have the default: none is better there.
    fn interpolation(&mut self, motion: Similarity) -> Result<Interpolation> {
        let mut best = (f64::INFINITY, Interpolation::default());
        if motion.is_whole() {
            return Ok(best.1);
        }
        for interpolation in Interpolation::ALL {
            let ratio = self.ratio(1, Correction { motion, interpolation })?;
            if ratio < best.0 {
                best = (ratio, interpolation);
            }
        }
        Ok(best.1)
    }

    /// The error of the first `count` patches relative to that of the same masks elsewhere; infinite if they are dark or the
    /// solver diverges.
    fn ratio(&mut self, count: usize, place: Correction) -> Result<f64> {
        let mut sums = [0.0; 2];
        for patch in 0..count {
            for (sum, place) in sums.iter_mut().zip([place, place.elsewhere()]) {
                let Some(errors) = self.errors(patch, place, 0, ITERATIONS.1)? else {
                    return Ok(f64::INFINITY);
                };
                *sum += errors.iter().sum::<f64>();
            }
        }
        Ok(sums[0] / sums[1])
    }

    /// Estimates rotation and growth too, after the first patch has given a shift and, `turned`, all parameters. `None` if
    /// they are not significant, or if they predict other pixels no better than a shift.
    fn similarity<E: From<ReconError>>(
        &mut self,
        mut best: Correction,
        turned: Fit,
        read: impl Fn(&Place) -> Result<Patch, E>,
    ) -> Result<Option<Registration>, E> {
        let fine = LAST_STEPS[0];
        let plan = self.plan;
        let mut has_turned = turned.has_turned;
        if has_turned {
            best.motion = turned.minimum;
        }
        for places in &plan.others {
            self.patches.truncate(1);
            for place in places {
                self.patches.push(read(place)?);
            }
            if self.patches.len() == 1 {
                break;
            }
            let mut grids = Vec::new();
            while grids.len() < self.patches.len() {
                match self.local_grid(grids.len(), best)? {
                    Some(grid) => grids.push(grid),
                    None if grids.is_empty() => return Ok(None),
                    None => drop(self.patches.remove(grids.len())),
                }
            }
            // Farther patches show rotations that are too small for neighbours.
            let fit = self.fit(best, &grids, fine, Free::All);
            if fit.has_turned {
                has_turned = true;
                best.motion = fit.minimum;
            }
        }
        if !has_turned {
            return Ok(None);
        }
        let Some((best, fit)) = self.settle(best, Free::All)? else { return Ok(None) };
        let Some(found) = self.verdict(best, &fit)?.filter(|found| found.converged) else {
            return Ok(None);
        };
        let places: Vec<_> =
            self.patches.iter().flat_map(|patch| patch.places(plan.margin)).collect();
        let shift = best.motion.displacement(plan.sensor, middle(&places));
        let shifted = Correction { motion: Similarity::shifted(shift), ..best };
        let errors = (self.deciding_errors(shifted)?, self.deciding_errors(best)?);
        let (Some(shifted), Some(turned)) = errors else { return Ok(None) };
        Ok((t_statistic(&shifted, &turned) >= SIGNIFICANT).then_some(found))
    }

    /// The errors of a patch on a fine grid around the displacement that fits it alone, since the errors behind sharp masks are
    /// no quadratic half a pixel away. `None` if it has no light.
    fn local_grid(&mut self, patch: usize, best: Correction) -> Result<Option<Grid>> {
        let mut local = best;
        let mut last = None;
        for (step, count) in [STEPS[0], STEPS[1], LAST_STEPS[0]].into_iter().zip(LOCAL_GRIDS) {
            for _ in 0..count {
                let Some(grid) = self.grid(patch, local, step)? else { return Ok(None) };
                let centre = [0, 1].map(|axis| local.motion.shift[axis] - best.motion.shift[axis]);
                let fit = self.fit(local, std::slice::from_ref(&grid), step, Free::Shift);
                local.motion = fit.minimum;
                last = Some(Grid { centre, ..grid });
                if fit.has_settled {
                    break;
                }
            }
        }
        Ok(last)
    }

    /// Fits ever finer grids until each has settled, and tries the other interpolations at the end: a motion that is a little
    /// wrong favours smooth ones, and these bias it. `None` if a reconstruction diverges.
    fn settle(&mut self, best: Correction, free: Free) -> Result<Option<(Correction, Fit)>> {
        let Some(settled) = self.refine(best, free)? else { return Ok(None) };
        if settled.0.motion.is_whole() {
            return Ok(Some(settled));
        }
        let count = self.patches.len();
        let (mut smallest, mut better) = (self.ratio(count, settled.0)?, None);
        for interpolation in Interpolation::ALL {
            let mut other = Correction { interpolation, ..settled.0 };
            if other == settled.0 {
                continue;
            }
            let Some(grids) = self.grids(other, LAST_STEPS[0])? else { continue };
            other.motion = self.fit(other, &grids, LAST_STEPS[0], free).minimum;
            let ratio = self.ratio(self.patches.len(), other)?;
            if ratio < smallest {
                (smallest, better) = (ratio, Some(other));
            }
        }
        let Some(better) = better else { return Ok(Some(settled)) };
        Ok(self.refine(better, free)?.or(Some(settled)))
    }

    /// Fits ever finer grids until each has settled. `None` if a reconstruction diverges.
    fn refine(&mut self, mut best: Correction, free: Free) -> Result<Option<(Correction, Fit)>> {
        let mut last = None;
        let mut steps = LAST_STEPS.into_iter().peekable();
        for _ in 0..MAX_GRIDS {
            let Some(step) = steps.peek() else { break };
            let Some(grids) = self.grids(best, *step)? else { return Ok(None) };
            let fit = self.fit(best, &grids, *step, free);
            best.motion = fit.minimum;
            if fit.has_settled {
                steps.next();
            }
            last = Some((best, fit));
        }
        Ok(last)
    }

    /// Decides on the best motion. The other draw took no part in the search, so its errors are not biased by it.
    fn verdict(&mut self, best: Correction, fit: &Fit) -> Result<Option<Registration>> {
        let unmoved = Correction { motion: Similarity::default(), ..best };
        let before = self.deciding_errors(unmoved)?;
        let after = self.deciding_errors(best)?;
        let wrong = self.deciding_errors(best.elsewhere())?;
        let (Some(before), Some(after), Some(wrong)) = (before, after, wrong) else {
            return Ok(None);
        };
        let norm = self.norm();
        let sum = |errors: &[f64]| errors.iter().sum::<f64>();
        let is_explained = sum(&after) < EXPLAINED * sum(&wrong)
            || self.depth(best, sum(&after))?.is_some_and(|depth| depth >= DEPTH);
        let converged = fit.has_settled && is_explained && self.plan.includes(&best.motion);
        Ok(Some(Registration {
            correction: best,
            uncertainty: fit.uncertainty,
            error_before: before.iter().sum::<f64>() / norm,
            error_after: after.iter().sum::<f64>() / norm,
            applied: converged
                && best.motion.length(self.plan.sensor) >= SMALLEST
                && t_statistic(&before, &after) >= SIGNIFICANT,
            converged,
        }))
    }

    /// How far `error` lies below the mean error of the same masks at eight places around, in standard deviations of these.
    /// Each place has the same fractions of a pixel. `None` if a reconstruction diverges.
    fn depth(&mut self, best: Correction, error: f64) -> Result<Option<f64>> {
        let mut errors = Vec::new();
        for place in 0..9 {
            let places = [place / 3, place % 3].map(|at| APART * (f64::from(at) - 1.0));
            let shift = [0, 1].map(|axis| best.motion.shift[axis].fract() + places[axis]);
            let far = |axis: usize| (shift[axis] - best.motion.shift[axis]).abs() >= APART - 1.0;
            if far(0) || far(1) {
                let motion = Similarity { shift, ..best.motion };
                let Some(there) = self.deciding_errors(Correction { motion, ..best })? else {
                    return Ok(None);
                };
                errors.push(there.iter().sum::<f64>());
            }
        }
        let count = errors.len() as f64;
        let mean = errors.iter().sum::<f64>() / count;
        let variance =
            errors.iter().map(|there| (there - mean).powi(2)).sum::<f64>() / (count - 1.0);
        Ok(Some((mean - error) / variance.sqrt()))
    }

    /// The errors of each patch on a grid around the best motion. Patches without light are left out. `None` if this is the
    /// first one.
    fn grids(&mut self, best: Correction, step: f64) -> Result<Option<Vec<Grid>>> {
        let mut grids = Vec::new();
        while grids.len() < self.patches.len() {
            match self.grid(grids.len(), best, step)? {
                Some(grid) => grids.push(grid),
                None if grids.is_empty() => return Ok(None),
                None => drop(self.patches.remove(grids.len())),
            }
        }
        Ok(Some(grids))
    }

    fn grid(&mut self, patch: usize, best: Correction, step: f64) -> Result<Option<Grid>> {
        let limit = (self.plan.reach() + 1) as f64;
        let [rows, columns] = best.motion.shift;
        let mut grid = Vec::with_capacity(9);
        for place in 0..9 {
            let (row, column) = (f64::from(place / 3 - 1), f64::from(place % 3 - 1));
            let shift = [rows + step * row, columns + step * column];
            let shift = shift.map(|value| value.clamp(-limit, limit));
            let motion = Similarity { shift, ..best.motion };
            match self.errors(patch, Correction { motion, ..best }, 0, ITERATIONS.1)? {
                Some(errors) => grid.push(errors),
                None => return Ok(None),
            }
        }
        let places = self.patches[patch].places(self.plan.margin).collect();
        Ok(Some(Grid { centre: [0.0; 2], places, errors: grid }))
    }

    fn fit(&self, best: Correction, grids: &[Grid], step: f64, free: Free) -> Fit {
        Fit::new((best.motion, self.plan.sensor), grids, step, free)
    }
}

#[cfg(test)]
mod tests {
    use super::patches::MARGIN;
    use super::{Interpolated, Interpolation, Plan, Registration, Similarity, register};
    use crate::error::Result;
    use crate::tile::Window;
    use ndarray::{Array3, ArrayView3, Axis, s};
    use optics::{iid_masks, measure, noisy, soften};

    /// Grey masks \[B,n,n\] as means over the areas of pixels, after their light moved on a grid of quarters of a pixel.
    fn by_areas(frames: usize, side: usize, motion: Similarity, blur: f64) -> Array3<f32> {
        const BORDER: usize = 4;
        // Two apertures show the pattern at places that are a pixel apart.
        let pattern = iid_masks(frames, side + 4 * BORDER, side + 4 * BORDER + 1, 3).unwrap();
        let source = motion.source([side; 2], [0; 2]);
        let cells = 4 * (side + 2 * BORDER);
        let mut light = Array3::from_shape_fn((frames, cells, cells), |(k, i, j)| {
            let pixel = |cell: usize| (cell as f64 + 0.5) / 4.0 - 0.5 - BORDER as f64;
            let place = source.at([pixel(i), pixel(j)]);
            let [i, j] = place.map(|at| (at + 0.5 + 2.0 * BORDER as f64) as usize);
            (pattern[[k, i, j]] + pattern[[k, i, j + 1]]) / 2.0
        });
        soften(&mut light, 4.0 * blur, 0.0).unwrap();
        Array3::from_shape_fn((frames, side, side), |(k, i, j)| {
            let (row, column) = (4 * (i + BORDER), 4 * (j + BORDER));
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
        let plan = Plan::choose(light.view(), y.view()).unwrap();
        let masks = |place: &Window| -> Result<_> {
            Ok(calibrated.slice(s![.., place.rows.clone(), place.columns.clone()]).to_owned())
        };
        register(&plan, y.view(), masks, &mut |_| true).unwrap().unwrap()
    }

    #[test]
    fn moved_masks_are_found_and_masks_that_fit_are_left() {
        let side = 2 * MARGIN + 64;
        for (cells, blur, sigma, interpolation, tolerance) in [
            ([2u8, 1], 0.0, 0.0, Interpolation::Linear, 0.03),
            ([10, 3], 0.0, 0.01, Interpolation::Linear, 0.03),
            ([2, 3], 0.7, 0.0, Interpolation::Quintic, 0.03),
            // Noise makes up most of the error of the right masks.
            ([6, 3], 0.7, 0.12, Interpolation::Quintic, 0.27),
        ] {
            let shift = cells.map(|cells| f64::from(cells) / 4.0);
            let calibrated = by_areas(6, side, Similarity::default(), blur);
            let moved = by_areas(6, side, Similarity::shifted(shift), blur);
            let found = registered(&calibrated, moved.view(), sigma);
            assert!(found.applied && found.error_after < found.error_before, "{found:?}");
            assert_eq!(found.correction.interpolation, interpolation, "{found:?}");
            let motion = found.correction.motion;
            assert!(motion.is_shift(), "{found:?}");
            for (axis, expected) in shift.into_iter().enumerate() {
                assert!((motion.shift[axis] - expected).abs() < tolerance, "{found:?}");
            }
        }
        let calibrated = by_areas(6, side, Similarity::default(), 0.0);
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
    fn rotation_and_growth_are_found() {
        let side = 2 * MARGIN + 172;
        for (blur, sigma, motion) in [
            (0.0, 0.0, Similarity { shift: [0.5, -1.25], rotation: 0.3, scale: 1.0 }),
            (0.0, 0.02, Similarity { shift: [2.5, -0.5], rotation: 0.25, scale: 0.9985 }),
            (0.7, 0.01, Similarity { shift: [-0.25, 0.75], rotation: -0.15, scale: 1.003 }),
        ] {
            let calibrated = by_areas(5, side, Similarity::default(), blur);
            let found = registered(&calibrated, by_areas(5, side, motion, blur).view(), sigma);
            assert!(found.applied, "{found:?}");
            let corners = [[0.0; 2], [0.0, side as f64], [side as f64, 0.0], [side as f64; 2]];
            for corner in corners {
                let displacement = |motion: Similarity| motion.displacement([side; 2], corner);
                let (is, expected) = (displacement(found.correction.motion), displacement(motion));
                let off = (is[0] - expected[0]).hypot(is[1] - expected[1]);
                assert!(off < 0.06, "{off} at {corner:?}: {found:?}");
            }
            assert!(found.uncertainty.rotation > 0.0 && found.uncertainty.rotation < 0.05);
        }
    }

    #[test]
    fn dark_and_unknown_pixels_count_as_not_measured() {
        let mut masks = iid_masks(4, 60, 60, 4).unwrap();
        let whole = Interpolated::new(masks.view(), Interpolation::Linear);
        masks.slice_mut(s![.., 30, 30]).fill(f32::NAN);
        let shift = Similarity::shifted([0.4, 0.3]).source([60; 2], [0; 2]);
        let interpolated = Interpolated::new(masks.view(), Interpolation::Linear);
        let moved = interpolated.window(&shift, 20..40, 20..40);
        assert!(moved.iter().all(|value| (0.0..=1.0).contains(value)));
        let darkest = |masks: &Array3<f32>| {
            let energies =
                masks.map_axis(Axis(0), |pixel| pixel.iter().map(|c| c * c).sum::<f32>());
            energies.into_iter().filter(|energy| *energy > 0.0).fold(4.0, f32::min)
        };
        assert!(darkest(&moved) >= super::interpolated::MIN_ENERGY);
        // The unknown pixel contributes to four pixels. The others hardly notice it.
        let expected = whole.window(&shift, 20..40, 20..40);
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
        let sensor = [80, 90];
        let unmoved = Similarity::default().source(sensor, [0; 2]);
        let unmoved = whole.window(&unmoved, 0..80, 0..90);
        assert!(unmoved.iter().zip(masks).all(|(one, other)| (one - other).abs() < 1e-5));
        let shift = Similarity::shifted([1.3, -2.6]);
        for motion in [shift, Similarity { rotation: 0.3, scale: 0.998, ..shift }] {
            let (rows, columns) = (30..50, 30..60);
            let source = motion.source(sensor, [0; 2]);
            let expected = whole.window(&source, rows.clone(), columns.clone());
            let margin = motion.margin(sensor, &rows, &columns);
            assert!(margin <= MARGIN, "{margin}");
            let patch = masks.slice(s![.., 30 - margin..50 + margin, 30 - margin..60 + margin]);
            let source = motion.source(sensor, [30 - margin; 2]);
            let found = Interpolated::new(patch, interpolation).window(
                &source,
                margin..margin + 20,
                margin..margin + 30,
            );
            assert!(found.iter().zip(&expected).all(|(one, other)| (one - other).abs() < 1e-5));
        }
        let moved = Similarity::shifted([3.0, 0.0]).source(sensor, [0; 2]);
        let moved = whole.window(&moved, 0..80, 0..90);
        assert!(moved.slice(s![.., ..2, ..]).iter().all(|value| value.is_nan()));
        let (moved, masks) = (moved.slice(s![.., 3.., ..]), masks.slice(s![.., ..77, ..]));
        assert!(moved.iter().zip(masks).all(|(one, other)| (one - other).abs() < 1e-5));
    }
}
