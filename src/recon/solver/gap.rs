//! Generalized alternating projection: `x = P(v)`, `v = D(x)` (Liao, Li and Carin, SIAM J. Imaging Sciences
//! 2014), with extrapolation.

use ndarray::Array3;

use super::state::State;

/// What is projected next, where there is momentum: from the new iterate, and the old one in the state.
pub(super) fn prepare_start(state: &mut State, new: &Array3<f32>, momentum: f32) {
    let Some(start) = &mut state.start else { return };
    ndarray::azip!((start in start, &new in new, &old in &state.v)
        *start = new + momentum * (new - old));
}
