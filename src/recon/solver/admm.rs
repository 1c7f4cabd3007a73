//! Alternating direction method of multipliers: `x = P(v + u)`, `v = D(x - u)`, `u <- u - (x - v)`.

use ndarray::Array3;

use super::state::State;

/// `z = x - u` in place of `x`: what goes into the prior. It is kept where the next start will stand.
pub(super) fn shift(state: &mut State, x: &mut Array3<f32>) {
    if let (Some(u), Some(z)) = (&state.multiplier, &mut state.start) {
        *x -= u;
        z.assign(x);
    }
}

/// `u = v - z`, and what is projected next, from the new iterate and the old one in the state.
pub(super) fn prepare_start(state: &mut State, new: &Array3<f32>, momentum: f32) {
    let (Some(u), Some(start)) = (&mut state.multiplier, &mut state.start) else { return };
    ndarray::azip!((u in &mut *u, &new in new, &z in &*start) *u = new - z);
    ndarray::azip!((start in start, &new in new, &old in &state.v, &u in &*u)
        *start = new + momentum * (new - old) + u);
}
