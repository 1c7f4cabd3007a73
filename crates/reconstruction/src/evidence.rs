//! Hold-out evidence of the error of a reconstruction's frames, for the quality model.

use ndarray::{Array3, ArrayView3, Axis, s};

use super::assessment::{Evidence, block_features};
use super::crop;
use super::error::{ReconError, Result};
use super::hold_out::HoldOut;
use super::operator::SensingOperator;
use super::order::Order;
use super::priors::Networks;
use super::schedule::Schedule;
use super::signs::Signs;
use super::solver;
use super::unmeasured::Measured;

/// Evidence from the crop of the first snapshot that [`crop::choose`] selects; measurement and frames are on the scale on
/// which the scene is on \[0,1\]. Returns `None` if no light reaches the crop, or the iteration diverges. Costs a run of
/// the schedule on the crop.
///
/// # Errors
/// As [`solver::reconstruct`].
pub fn collect(
    op: &SensingOperator,
    y: ArrayView3<'_, f32>,
    schedule: &Schedule,
    networks: &mut dyn Networks,
) -> Result<Option<Evidence>> {
    let light = op.masks().sum_axis(Axis(0));
    let (rows, columns) = crop::choose(light.view(), y.index_axis(Axis(0), 0));
    let masks = op.masks().slice(s![.., rows.clone(), columns.clone()]).to_owned();
    let whole = match SensingOperator::new(masks) {
        Err(ReconError::DarkMasks { .. }) => return Ok(None),
        other => other?,
    };
    let Measured { op: whole, y } = Measured::new(&whole, y.slice(s![..1, rows, columns]));
    let (whole, y) = (&*whole, y.view());
    let hold_out = HoldOut::draw(whole, 0);
    let op = whole.clone().without(&hold_out.pixels);
    let mut early: Option<Array3<f32>> = None;
    let solved = solver::run_stages(&op, y, schedule, networks, &mut (), |_, state, _| {
        if early.is_none() {
            early = Some(state.frames()?.into_owned());
        }
        Ok(())
    });
    let outcome = match solved {
        // The solver of the whole picture reports divergence.
        Err(ReconError::Diverged { .. }) => return Ok(None),
        other => other?,
    };
    let early = early.as_ref().unwrap_or(&outcome.frames);
    let measurement = HeldOutMeasurement { whole, op: &op, y, hold_out: &hold_out };
    Ok(measurement.evidence(schedule, early, &outcome.frames))
}

/// A measurement \[1,H,W\] with hold-out pixels.
pub(crate) struct HeldOutMeasurement<'a> {
    /// The operator with all pixels.
    pub(crate) whole: &'a SensingOperator,
    /// The operator without the hold-out pixels.
    pub(crate) op: &'a SensingOperator,
    pub(crate) y: ArrayView3<'a, f32>,
    pub(crate) hold_out: &'a HoldOut,
}

impl HeldOutMeasurement<'_> {
    /// Evidence from the frames \[B,H,W\] after the first stage and those at the end; none if no pixel is held out.
    pub(crate) fn evidence(
        &self,
        schedule: &Schedule,
        early: &Array3<f32>,
        last: &Array3<f32>,
    ) -> Option<Evidence> {
        let (early, last) = (early.view(), last.view());
        let signs = Signs::of((self.op, self.y), self.hold_out, early, last)?;
        let first_stage = early;
        let early = (schedule.stages.len() > 1).then_some(early);
        let prediction = Some(self.hold_out.prediction(self.op, self.y, last));
        let is_frame_by_frame = schedule
            .stages
            .first()
            .is_some_and(|stage| stage.prior.tv().is_some_and(|tv| tv.temporal_weight == 0.0));
        let order =
            if is_frame_by_frame { Order::of(first_stage, self.whole.masks()) } else { None };
        let evidence = Evidence::new(signs, &block_features(self.whole, early, last));
        Some(Evidence { prediction, order, ..evidence })
    }
}
