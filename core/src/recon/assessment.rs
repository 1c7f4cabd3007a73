//! How near frames come to the truth, told without it.
//!
//! A lab has no truth. What can be seen are the frames themselves: how much changes in them from pixel to pixel
//! and from frame to frame, how far the priors have moved them since total variation, and how well the masks
//! can tell frames apart. Block by block the expected error follows from these by a regression that was fitted
//! to simulated snapshots of many scenes; `docs/benchmarks.md` says how well it does on others.

use std::collections::BTreeMap;
use std::sync::LazyLock;

use ndarray::{Array2, Array4, ArrayView2, ArrayView3, Axis, s};
use serde::Deserialize;

use super::schedule::{Method, Schedule, Stage};
use super::sensing::SensingOperator;

/// Side of the blocks in pixels.
pub const BLOCK: usize = 16;

/// What is seen of a block, each the decimal logarithm of an energy or of a ratio.
pub const FEATURES: [&str; 11] = [
    "gradient",
    "curvature",
    "change in time",
    "distance from total variation",
    "brightness",
    "mask contrast",
    "mask gradient",
    "frames",
    "gradient of the whole frame",
    "change in time of the whole frame",
    "distance of the whole frame",
];

/// Below this, energies are rounding.
const FLOOR: f32 = 1e-7;

/// Rows and columns of blocks of a picture of `height` x `width` pixels; those at the far edges may be smaller.
pub fn blocks(height: usize, width: usize) -> (usize, usize) {
    (height.div_ceil(BLOCK), width.div_ceil(BLOCK))
}

/// What is seen of each block of each frame \[features, S B, rows, columns\], of the frames \[S B,H,W\] of a
/// reconstruction and those that total variation alone had left, if others priors followed; all on the scale on which the
/// scene is on \[0,1\].
pub fn features(
    op: &SensingOperator,
    early: Option<ArrayView3<'_, f32>>,
    frames: ArrayView3<'_, f32>,
) -> Array4<f32> {
    let (count, height, width) = frames.dim();
    let (rows, columns) = blocks(height, width);
    let mut all = Array4::zeros((FEATURES.len(), count, rows, columns));
    let (contrast, roughness) = of_masks(op);
    let ratio = (op.masks().len_of(Axis(0)) as f32).log10();
    for (k, frame) in frames.outer_iter().enumerate() {
        let neighbours = [k.checked_sub(1), Some(k + 1).filter(|next| *next < count)];
        let beside = neighbours.into_iter().flatten().map(|at| frames.index_axis(Axis(0), at));
        let beside: Vec<_> = beside.collect();
        let early = early.map(|early| early.index_axis_move(Axis(0), k));
        let mut put = |feature: usize, whole: Option<usize>, energy: Block| {
            all.slice_mut(s![feature, k, .., ..]).assign(&energy.0.mapv(logarithm));
            if let Some(whole) = whole {
                let mean = logarithm(energy.0.mean().unwrap_or(0.0));
                all.slice_mut(s![whole, k, .., ..]).fill(mean);
            }
        };
        put(0, Some(8), Block::of(height, width, |i, j| gradient(frame, i, j)));
        put(1, None, Block::of(height, width, |i, j| curvature(frame, i, j)));
        let change = |i, j| {
            let sum = beside.iter().map(|other| (frame[[i, j]] - other[[i, j]]).powi(2));
            sum.sum::<f32>() / beside.len().max(1) as f32
        };
        put(2, Some(9), Block::of(height, width, change));
        let distance = |i: usize, j: usize| {
            early.map_or(0.0, |early: ArrayView2<'_, f32>| (frame[[i, j]] - early[[i, j]]).powi(2))
        };
        put(3, Some(10), Block::of(height, width, distance));
        put(4, None, Block::of(height, width, |i, j| frame[[i, j]].powi(2)));
        all.slice_mut(s![5, k, .., ..]).assign(&contrast.0);
        all.slice_mut(s![6, k, .., ..]).assign(&roughness.0);
        all.slice_mut(s![7, k, .., ..]).fill(ratio);
    }
    all
}

/// The part of the gram diagonal that changes from mask to mask, and the energy of the masks' gradient relative to
/// their own.
fn of_masks(op: &SensingOperator) -> (Block, Block) {
    let masks = op.masks();
    let (_, height, width) = masks.dim();
    let (gram, steady) = (op.gram(), op.steady_gram());
    let energy = Block::of(height, width, |i, j| gram[[i, j]]);
    let steady = Block::of(height, width, |i, j| steady[[i, j]]);
    let steps = Block::of(height, width, |i, j| {
        masks.outer_iter().map(|mask| gradient(mask, i, j)).sum::<f32>()
    });
    let share = |part: &Array2<f32>| {
        ndarray::Zip::from(part)
            .and(&energy.0)
            .map_collect(|part, all| logarithm(part / all.max(FLOOR)))
    };
    let varying = &energy.0 - &steady.0;
    (Block(share(&varying)), Block(share(&steps.0)))
}

fn logarithm(energy: f32) -> f32 {
    energy.max(FLOOR).log10()
}

/// Half of the squared steps to the next pixel of both axes.
fn gradient(frame: ArrayView2<'_, f32>, i: usize, j: usize) -> f32 {
    let (height, width) = frame.dim();
    let here = frame[[i, j]];
    let down = if i + 1 < height { frame[[i + 1, j]] - here } else { 0.0 };
    let right = if j + 1 < width { frame[[i, j + 1]] - here } else { 0.0 };
    0.5 * (down * down + right * right)
}

/// Half of the squared second differences of both axes.
fn curvature(frame: ArrayView2<'_, f32>, i: usize, j: usize) -> f32 {
    let (height, width) = frame.dim();
    let here = 2.0 * frame[[i, j]];
    let inside = |at: usize, length: usize| at > 0 && at + 1 < length;
    let down = if inside(i, height) { frame[[i - 1, j]] - here + frame[[i + 1, j]] } else { 0.0 };
    let right = if inside(j, width) { frame[[i, j - 1]] - here + frame[[i, j + 1]] } else { 0.0 };
    0.5 * (down * down + right * right)
}

/// Means over blocks \[rows, columns\].
struct Block(Array2<f32>);

impl Block {
    fn of(height: usize, width: usize, value: impl Fn(usize, usize) -> f32) -> Self {
        let (rows, columns) = blocks(height, width);
        Self(Array2::from_shape_fn((rows, columns), |(r, c)| {
            let (across, down) =
                (c * BLOCK..width.min((c + 1) * BLOCK), r * BLOCK..height.min((r + 1) * BLOCK));
            let pixels = across.len() * down.len();
            let row = |i: usize| across.clone().map(|j| value(i, j)).sum::<f32>();
            down.map(row).sum::<f32>() / pixels as f32
        }))
    }
}

/// What errors are predicted by: `assessment.json`, which `training/assessment.py` fits.
#[derive(Debug, Deserialize)]
pub struct Model {
    block: Regression,
    snapshot: Regression,
    /// What is added to the predicted PSNR for the ends of its interval, in dB.
    interval: [f64; 2],
}

/// A polynomial of inputs that are shifted, scaled and bounded first.
#[derive(Debug, Deserialize)]
struct Regression {
    mean: Vec<f64>,
    scale: Vec<f64>,
    /// Of 1, of the inputs, and, if there are as many, of all products of two of them.
    coefficients: Vec<f64>,
}

/// Inputs further from the mean than in any fit, in their scale, count as that far.
const FARTHEST: f64 = 3.0;

static MODELS: LazyLock<BTreeMap<String, Model>> = LazyLock::new(|| {
    #[allow(clippy::expect_used)] // a test reads it
    serde_json::from_str(include_str!("assessment.json"))
        .expect("assessment.json is a map of models")
});

impl Model {
    /// The model that was fitted to results of such schedules, if there is one: of total variation alone, or of
    /// total variation with what may follow in the default schedule.
    pub fn of(schedule: &Schedule) -> Option<&'static Self> {
        if schedule.method != Method::Gap {
            return None;
        }
        let first = schedule.stages.first()?.prior.name();
        let known = |stage: &Stage| {
            ["fastdvdnet", "fastdvdnet-int8", "nonlocal"].contains(&stage.prior.name())
        };
        let rest = &schedule.stages[1..];
        match (first, rest.iter().all(known), rest.is_empty()) {
            ("tv", true, true) => MODELS.get("gap-tv"),
            ("tv", true, false) => MODELS.get("pnp-tv-fastdvdnet"),
            _ => None,
        }
    }

    /// The decimal logarithm of the expected squared error of a block, given by frame, row and column.
    pub fn log_error(
        &self,
        features: &Array4<f32>,
        (k, row, column): (usize, usize, usize),
    ) -> f32 {
        let seen = features.slice(s![.., k, row, column]);
        self.block.value(seen.iter().map(|&value| f64::from(value))) as f32
    }

    /// The expected PSNR of a snapshot between the ends of its interval, in dB, from what its map and its pilot
    /// tell. What is not known counts as in the mean of the fit.
    pub fn psnr(&self, known: &[Option<f64>]) -> [f64; 3] {
        let known = known.iter().zip(&self.snapshot.mean);
        let middle = self.snapshot.value(known.map(|(known, mean)| known.unwrap_or(*mean)));
        [middle + self.interval[0], middle, middle + self.interval[1]]
    }
}

impl Regression {
    fn value(&self, inputs: impl Iterator<Item = f64>) -> f64 {
        let scaled = inputs.zip(self.mean.iter().zip(&self.scale));
        let inputs: Vec<f64> = scaled
            .map(|(x, (mean, scale))| ((x - mean) / scale).clamp(-FARTHEST, FARTHEST))
            .collect();
        let products = (0..inputs.len()).flat_map(|i| (i..inputs.len()).map(move |j| (i, j)));
        let products = products.map(|(i, j)| inputs[i] * inputs[j]);
        let terms = std::iter::once(1.0).chain(inputs.iter().copied()).chain(products);
        terms.zip(&self.coefficients).map(|(term, coefficient)| term * coefficient).sum()
    }
}

#[cfg(test)]
mod tests {
    use super::{FEATURES, MODELS, Model, features};
    use crate::optics::iid_masks;
    use crate::recon::schedule::Schedule;
    use crate::recon::sensing::SensingOperator;
    use ndarray::{Array3, s};

    /// A ramp of 0.01 a column that brightens by 0.02 a frame.
    fn ramp() -> Array3<f32> {
        Array3::from_shape_fn((4, 40, 36), |(k, _, j)| 0.1 + 0.02 * k as f32 + 0.01 * j as f32)
    }

    #[test]
    fn features_are_means_over_blocks_and_those_at_the_edge_are_smaller() {
        let masks = Array3::from_shape_fn((4, 40, 36), |(k, _, _)| if k == 0 { 1.0 } else { 0.0 });
        let op = SensingOperator::new(masks).unwrap();
        let early = ramp() - 0.1;
        let seen = features(&op, Some(early.view()), ramp().view());
        assert_eq!(seen.dim(), (FEATURES.len(), 4, 3, 3));
        let near = |feature: usize, at: (usize, usize, usize), energy: f32| {
            let found = seen[[feature, at.0, at.1, at.2]];
            assert!((found - energy.log10()).abs() < 1e-3, "{}: {found}", FEATURES[feature]);
        };
        // Half of a squared step; the last column of the picture has no next one.
        near(0, (1, 0, 0), 0.5 * 1e-4);
        near(0, (1, 2, 2), 0.5 * 1e-4 * 0.75);
        near(2, (0, 1, 1), 4e-4);
        near(2, (2, 1, 1), 4e-4);
        near(3, (3, 2, 0), 1e-2);
        // One mask of four is open: 1 - 4 * (1/4)^2 of the gram differs from mask to mask.
        near(5, (0, 0, 0), 0.75);
        near(7, (0, 0, 0), 4.0);
        assert!(seen.slice(s![6, .., .., ..]).iter().all(|&gradient| gradient == -7.0));
    }

    #[test]
    fn results_of_known_schedules_have_a_model_and_no_others() {
        assert_eq!(MODELS.len(), 2);
        let has = |schedule: Schedule| Model::of(&schedule).is_some();
        assert!(has(Schedule::gap_tv()) && has(Schedule::pnp_tv_fastdvdnet()));
        assert!(!has(Schedule::admm_tv()) && !has(Schedule::pnp_ffdnet()));
        for model in MODELS.values() {
            let inputs = FEATURES.len();
            assert_eq!(model.block.coefficients.len(), 1 + inputs + inputs * (inputs + 1) / 2);
            assert_eq!(model.snapshot.coefficients.len(), 1 + 5 + inputs);
            assert!(model.interval[0] < 0.0 && model.interval[1] > 0.0);
            let [_, mean, _] = model.psnr(&vec![None; 5 + inputs]);
            assert_eq!(mean, model.snapshot.coefficients[0], "nothing known is the mean of all");
        }
    }

    /// Moving texture of a tenth, and of a hundredth, that the priors have moved by a fifth.
    #[test]
    fn more_texture_lets_expect_more_error() {
        let op = SensingOperator::new(iid_masks(4, 48, 48, 1).unwrap()).unwrap();
        let error = |texture: f32| {
            let frame = |(k, i, j): (usize, usize, usize)| {
                let phase = i as f32 * 0.4 + (j as f32 - k as f32) * 0.3;
                0.5 + texture * phase.sin()
            };
            let frames = Array3::from_shape_fn((4, 48, 48), frame);
            let early = frames.mapv(|x| 0.5 + 0.8 * (x - 0.5));
            let seen = features(&op, Some(early.view()), frames.view());
            let model = Model::of(&Schedule::pnp_tv_fastdvdnet()).unwrap();
            model.log_error(&seen, (1, 1, 1))
        };
        let (much, little) = (error(0.1), error(0.01));
        assert!(much > little + 0.3 && much < -1.0 && little > -6.0, "{much}, {little}");
    }
}
