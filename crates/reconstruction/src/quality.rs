//! The quality model: predicts the error of frames without the true ones, from their features ([`super::assessment`]).
//!
//! Small networks predict the error of each block. They were fitted to simulated snapshots of many scenes; the model card
//! `models/quality/README.md` states their error on other scenes. The program evaluates them itself, because `gap-tv`
//! works without ONNX Runtime.

use std::sync::LazyLock;

use ndarray::{
    Array, Array1, Array2, Array3, Array4, ArrayD, ArrayView2, ArrayView3, Axis, Dimension, Zip, s,
};
use prost::Message;
use serde::Deserialize;

use super::assessment::{Evidence, Features, FirstRun};
use super::priors::nonlocal::NonlocalSpec;
use super::priors::registry::PriorSpec;
use super::schedule::{Method, Schedule};
use super::stage::Stage;

/// A quality model from `models/quality/model.onnx`, which `research/training/assessment.py` fits.
///
/// It averages small networks. Their inputs are the features of a block, their means over the blocks around it, in its
/// frame and in all frames, the evidence, and the encoder's features of the block.
#[derive(Debug)]
pub struct Model {
    features: Scaling,
    signs: Scaling,
    /// The encoder's part, for results of schedules with a network.
    encoding: Option<Encoding>,
    layers: [Layer; 3],
    /// The misses of its predictions.
    pub misses: Misses,
}

/// Misses of the predictions on results that are in no fit.
#[derive(Debug, Deserialize)]
pub struct Misses {
    /// Ends of the interval that contains four of five true values, in dB relative to the predicted PSNR.
    pub interval: [f64; 2],
    /// The correction behind masks that are [`unfamiliar`](Features::unfamiliar).
    pub unfamiliar: Unfamiliar,
}

/// Correction of a prediction behind unfamiliar masks.
#[derive(Debug, Deserialize)]
pub struct Unfamiliar {
    /// Correction of the predicted PSNR in dB.
    pub offset: f32,
    /// The interval in place of the model's.
    pub interval: [f64; 2],
}

/// Shift and scale of inputs, which are bounded afterwards.
#[derive(Debug)]
struct Scaling {
    mean: Array1<f32>,
    scale: Array1<f32>,
}

/// Principal components of the encoder's features \[channels, components\].
#[derive(Debug)]
struct Encoding {
    mean: Array1<f32>,
    components: Array2<f32>,
}

/// A layer of neurons of each network: weights \[networks, inputs, neurons\] and biases \[networks, 1, neurons\].
#[derive(Debug)]
struct Layer {
    weights: Array3<f32>,
    bias: Array3<f32>,
}

/// Temporal shrinkage, in units of `sigma`, above which a separate model predicts the error. Behind highly correlated masks
/// it may remove motion without leaving a trace.
const STRONG_SHRINKAGE: f32 = 1.0;

/// Largest deviation of an input from its mean, in units of its scale. Fits contain no larger ones.
const MAX_DEVIATION: f32 = 3.0;

/// True if a stage with the nonlocal prior has settings of the default schedules or of a pilot.
fn has_usual_settings(stage: &Stage) -> bool {
    let schedule = Schedule::pnp_nonlocal();
    let usual = schedule.stages.iter().find_map(|stage| Some((stage, stage.prior.nonlocal()?)));
    let (Some(prior), Some((stage_of_fit, usual))) = (stage.prior.nonlocal(), usual) else {
        return true;
    };
    let equal = |a: f32, b: f32| (a - b).abs() < 1e-3;
    let is_shrinkage = |value: f32| {
        [1.0, 4.0, 8.0].iter().any(|times| equal(value, times * usual.temporal_shrinkage))
    };
    let (own, fit) = (&stage.projection, &stage_of_fit.projection);
    let most = fit.static_variance.unwrap_or_default();
    equal(stage.momentum, stage_of_fit.momentum)
        && equal(own.memory, fit.memory)
        && own.static_variance.is_none_or(|variance| (0.0..=most).contains(&variance))
        && prior.outlier_limit == usual.outlier_limit
        && is_shrinkage(prior.temporal_shrinkage)
        && prior.static_shrinkage.is_none_or(is_shrinkage)
}

/// The models of the file.
struct Models {
    total_variation: Model,
    weakly_shrunk: Model,
    strongly_shrunk: Model,
}

#[allow(clippy::expect_used)] // a test reads it
static MODELS: LazyLock<Models> = LazyLock::new(|| {
    let file = include_bytes!("../../../models/quality/model.onnx");
    let file = OnnxFile::decode(&file[..]).expect("models/quality/model.onnx is a file of ONNX");
    let model = |name| Model::read(&file, name).expect("models/quality/model.onnx has the models");
    Models {
        total_variation: model("gap-tv"),
        weakly_shrunk: model("pnp-tv-fastdvdnet"),
        strongly_shrunk: model("pnp-tv-fastdvdnet-shrunk"),
    }
});

impl Model {
    /// The model for results of a fixed schedule, if there is one. There are models for total variation alone, and
    /// for total variation followed by priors of the default schedule, with weak or strong temporal shrinkage. Stages with the
    /// nonlocal prior have the settings of the fit.
    pub fn of(schedule: &Schedule) -> Option<&'static Self> {
        if schedule.method != Method::Gap {
            return None;
        }
        let (first, rest) = schedule.stages.split_first()?;
        let known = |stage: &Stage| {
            use PriorSpec::{Fastdvdnet, FastdvdnetInt8, Nonlocal};
            matches!(stage.prior, Fastdvdnet(_) | FastdvdnetInt8(_) | Nonlocal(_))
                && has_usual_settings(stage)
        };
        if !matches!(first.prior, PriorSpec::Tv(_)) || !rest.iter().all(known) {
            return None;
        }
        let strongly_shrunk = |stage: &Stage| {
            let nonlocal = stage.prior.nonlocal();
            let level = |nonlocal: &NonlocalSpec| {
                nonlocal.static_shrinkage.unwrap_or(nonlocal.temporal_shrinkage)
            };
            nonlocal.is_some_and(|nonlocal| level(nonlocal) > STRONG_SHRINKAGE)
        };
        Some(match rest {
            [] => &MODELS.total_variation,
            _ if rest.iter().any(strongly_shrunk) => &MODELS.strongly_shrunk,
            _ => &MODELS.weakly_shrunk,
        })
    }

    /// Decimal logarithm of the expected squared error of each block \[S B, rows, columns\], on the scale of the solver.
    ///
    /// Without evidence the signs take their means in the fit, and the features of the whole picture replace those of the
    /// crop. Without an encoder its components take their means.
    pub fn log_errors(&self, features: &Features, evidence: Option<&Evidence>) -> Array3<f32> {
        let result = self.log_errors_of_one_run(features, evidence);
        let Some(FirstRun { features, distance }) = features.first_run.as_deref() else {
            return result;
        };
        let evidence = evidence.and_then(|evidence| evidence.first.as_deref());
        let first = MODELS.weakly_shrunk.log_errors_of_one_run(features, evidence);
        combine_runs(&result, &first, distance.view())
    }

    /// As [`Model::log_errors`], without the first run.
    fn log_errors_of_one_run(
        &self,
        features: &Features,
        evidence: Option<&Evidence>,
    ) -> Array3<f32> {
        let (frames, rows, columns) = features.blocks.dim();
        let mut own = Array4::zeros((self.features.mean.len(), frames, rows, columns));
        for ((k, row, column), block) in features.blocks.indexed_iter() {
            let scaled = Array1::from(self.features.of(&block.values()));
            own.slice_mut(s![.., k, row, column]).assign(&scaled);
        }
        let neighbourhood = neighbourhood_means(&own);
        let over_time = neighbourhood.sum_axis(Axis(1)) / frames as f32;
        let shared: Vec<f32> = match evidence {
            Some(evidence) => {
                [self.features.of(&evidence.features), self.signs.of(&evidence.signs.0)].concat()
            }
            None => {
                let means = own.outer_iter().map(|feature| feature.mean().unwrap_or(0.0));
                // A scaled mean is 0.
                means.chain(self.signs.mean.iter().map(|_| 0.0)).collect()
            }
        };
        let shared = Array2::from_shape_fn((shared.len(), columns), |(input, _)| shared[input]);
        let mut errors = Array3::zeros((frames, rows, columns));
        for k in 0..frames {
            for row in 0..rows {
                let encoded = features.encoded.as_ref().map(|all| all.slice(s![.., k, row, ..]));
                let encoded = self.encoding.as_ref().map(|encoding| encoding.of(encoded, columns));
                let mut inputs = vec![own.slice(s![.., k, row, ..])];
                inputs.push(neighbourhood.slice(s![.., k, row, ..]));
                inputs.extend([over_time.slice(s![.., row, ..]), shared.view()]);
                inputs.extend(encoded.as_ref().map(|encoded| encoded.view()));
                errors.slice_mut(s![k, row, ..]).assign(&self.outputs(&inputs));
            }
        }
        errors
    }

    /// Mean outputs of the networks for blocks, from parts of the inputs \[inputs, blocks\]. The inner layers have the
    /// activation SiLU.
    fn outputs(&self, parts: &[ArrayView2<'_, f32>]) -> Array1<f32> {
        let [first, second, last] = &self.layers;
        let (networks, count, _) = first.weights.dim();
        let blocks = parts.first().map_or(0, |part| part.len_of(Axis(1)));
        let mut inputs = Array2::zeros((count, blocks));
        let values = parts.iter().flat_map(|part| part.outer_iter());
        inputs.outer_iter_mut().zip(values).for_each(|(mut input, values)| input.assign(&values));
        let silu = |sum: f32| sum / (1.0 + (-sum).exp());
        let mut outputs = Array1::zeros(blocks);
        for network in 0..networks {
            let hidden = first.sums(network, &inputs).mapv_into(silu);
            let hidden = second.sums(network, &hidden).mapv_into(silu);
            outputs += &last.sums(network, &hidden).row(0);
        }
        outputs / networks as f32
    }
}

/// Excess, in dB, of the first run's expected error over the squared distance of both runs, above which the scene moved.
/// Determined on 75 simulated scenes.
const MOTION_DB: f32 = 3.0;
/// Width of the transition around [`MOTION_DB`], in dB.
const MOTION_WIDTH_DB: f32 = 0.3;
/// Smallest share of the first run's error that remains in the result where something moves.
const MIN_SHARE: f32 = 0.1;

/// Expected error of a stage that was run twice, from the predictions for both runs and from their distance; all are
/// logarithms \[S B, rows, columns\].
///
/// In a static scene the second run removes error, so the first run is as far from the result as from the true frames.
/// If it removes motion, the first run's error exceeds the distance by the error that both runs share. The weakly shrunk
/// frames of the first run show that error.
fn combine_runs(
    result: &Array3<f32>,
    first: &Array3<f32>,
    distance: ArrayView3<'_, f32>,
) -> Array3<f32> {
    let energy = |logs: ArrayView3<'_, f32>| logs.iter().map(|log| 10f32.powf(*log)).sum::<f32>();
    let excess = 10.0 * (energy(first.view()) / energy(distance)).log10();
    let share = 1.0 / (1.0 + (-(excess - MOTION_DB) / MOTION_WIDTH_DB).exp());
    Zip::from(result).and(first).and(distance).map_collect(|result, first, distance| {
        let error = 10f32.powf(*first);
        let remaining = (error - 10f32.powf(*distance)).max(MIN_SHARE * error).log10();
        share * remaining + (1.0 - share) * result
    })
}

/// Means over each block and the blocks that touch it, in the same frame.
fn neighbourhood_means(features: &Array4<f32>) -> Array4<f32> {
    let (_, _, rows, columns) = features.dim();
    let adjacent = |at: usize, length: usize| at.saturating_sub(1)..length.min(at + 2);
    Array4::from_shape_fn(features.dim(), |(feature, k, row, column)| {
        let place = s![feature, k, adjacent(row, rows), adjacent(column, columns)];
        features.slice(place).mean().unwrap_or(0.0)
    })
}

impl Scaling {
    fn of(&self, values: &[f32]) -> Vec<f32> {
        let scaled = values.iter().zip(self.mean.iter().zip(&self.scale));
        scaled.map(|(x, (mean, s))| ((x - mean) / s).clamp(-MAX_DEVIATION, MAX_DEVIATION)).collect()
    }
}

impl Encoding {
    /// The components \[components, blocks\]; without the encoder's features all are 0, their mean.
    fn of(&self, encoded: Option<ArrayView2<'_, f32>>, blocks: usize) -> Array2<f32> {
        let Some(encoded) = encoded else {
            return Array2::zeros((self.components.len_of(Axis(1)), blocks));
        };
        let shifted = &encoded - &self.mean.view().insert_axis(Axis(1));
        let sums = self.components.t().dot(&shifted);
        sums.mapv_into(|sum| sum.clamp(-MAX_DEVIATION, MAX_DEVIATION))
    }
}

impl Layer {
    /// `W x + b` of a network \[neurons, blocks\].
    fn sums(&self, network: usize, inputs: &Array2<f32>) -> Array2<f32> {
        let (weights, bias) =
            (self.weights.index_axis(Axis(0), network), self.bias.index_axis(Axis(0), network));
        weights.t().dot(inputs) + bias.t()
    }
}

/// The constants of an ONNX file, by the field numbers of ONNX's `onnx.proto`.
#[derive(Clone, PartialEq, Message)]
struct OnnxFile {
    #[prost(message, optional, tag = "7")]
    graph: Option<OnnxGraph>,
    #[prost(message, repeated, tag = "14")]
    metadata: Vec<OnnxProperty>,
}

#[derive(Clone, PartialEq, Message)]
struct OnnxGraph {
    #[prost(message, repeated, tag = "5")]
    tensors: Vec<OnnxTensor>,
}

#[derive(Clone, PartialEq, Message)]
struct OnnxTensor {
    #[prost(int64, repeated, tag = "1")]
    sides: Vec<i64>,
    #[prost(string, tag = "8")]
    name: String,
    /// Little-endian numbers.
    #[prost(bytes = "vec", tag = "9")]
    values: Vec<u8>,
}

#[derive(Clone, PartialEq, Message)]
struct OnnxProperty {
    #[prost(string, tag = "1")]
    key: String,
    #[prost(string, tag = "2")]
    value: String,
}

impl OnnxFile {
    /// An array of a model. `None` if it is missing or has other axes.
    fn array<D: Dimension>(&self, model: &str, part: &str) -> Option<Array<f32, D>> {
        let name = format!("{model}/{part}");
        let tensor = self.graph.as_ref()?.tensors.iter().find(|tensor| tensor.name == name)?;
        let sides: Vec<_> = tensor.sides.iter().map(|side| *side as usize).collect();
        let (values, _) = tensor.values.as_chunks();
        let values = values.iter().map(|bytes| f32::from_le_bytes(*bytes)).collect();
        ArrayD::from_shape_vec(sides, values).ok()?.into_dimensionality().ok()
    }
}

impl Model {
    fn read(file: &OnnxFile, name: &str) -> Option<Self> {
        let scaling = |part: &str| {
            let mean = file.array(name, &format!("{part}/mean"))?;
            Some(Scaling { mean, scale: file.array(name, &format!("{part}/scale"))? })
        };
        let layer = |number: usize| {
            let weights = file.array(name, &format!("layer{number}/weights"))?;
            Some(Layer { weights, bias: file.array(name, &format!("layer{number}/bias"))? })
        };
        let encoding = file.array(name, "encoder/mean").zip(file.array(name, "encoder/components"));
        let misses = file.metadata.iter().find(|property| property.key == name)?;
        Some(Self {
            features: scaling("features")?,
            signs: scaling("signs")?,
            encoding: encoding.map(|(mean, components)| Encoding { mean, components }),
            layers: [layer(1)?, layer(2)?, layer(3)?],
            misses: serde_json::from_str(&misses.value).ok()?,
        })
    }
}

#[cfg(test)]
mod tests {
    use super::{MODELS, Model, combine_runs, neighbourhood_means};
    use crate::assessment::{BlockFeatures, ClipFeatures, Evidence, Features};
    use crate::operator::SensingOperator;
    use crate::priors::CHANNELS;
    use crate::schedule::Schedule;
    use crate::signs::{SIGNS, Signs};
    use ndarray::{Array3, Array4, s};
    use optics::iid_masks;
    use std::cell::Cell;
    use std::collections::BTreeMap;

    /// A ramp of 0.01 a column that brightens by 0.02 a frame.
    fn ramp() -> Array3<f32> {
        Array3::from_shape_fn((4, 40, 36), |(k, _, j)| 0.1 + 0.02 * k as f32 + 0.01 * j as f32)
    }

    fn features(op: &SensingOperator, frames: &Array3<f32>) -> Features {
        Features::of(op, Some(ramp().view()), frames.view(), None).unwrap()
    }

    fn evidence(decibels: f32, features: &Features) -> Evidence {
        Evidence::new(Signs([decibels; SIGNS.len()]), &features.blocks)
    }

    #[test]
    fn a_missing_encoder_is_replaced_by_its_mean() {
        let op = SensingOperator::new(iid_masks(4, 40, 36, 1).unwrap()).unwrap();
        let model = Model::of(&Schedule::pnp_tv_fastdvdnet()).unwrap();
        let mean = &model.encoding.as_ref().unwrap().mean;
        let log_errors = |shift: Option<f32>| {
            let size = (CHANNELS, 4, 3, 3);
            let encoded = shift
                .map(|shift| Array4::from_shape_fn(size, |(channel, ..)| mean[channel] + shift));
            model.log_errors(&Features { encoded, ..features(&op, &ramp()) }, None)
        };
        assert_eq!(log_errors(None), log_errors(Some(0.0)));
        assert_ne!(log_errors(None), log_errors(Some(1.0)));
    }

    /// The inputs of `tests/data/quality.json`: a level and a sine of the position.
    fn sample(level: f64, swing: f64, at: [usize; 4]) -> f32 {
        let [n, k, i, j] = at.map(|index| index as f64);
        (level + swing * (n + 2.0 * k + 3.0 * i + 5.0 * j).sin()) as f32
    }

    fn sample_block(k: usize, i: usize, j: usize) -> BlockFeatures {
        let n = Cell::new(0);
        let next = || sample(-2.0, 2.0, [n.replace(n.get() + 1), k, i, j]);
        let clip = || ClipFeatures {
            gradient: next(),
            curvature: next(),
            change: next(),
            variance: next(),
            mean_gradient: next(),
            motion: next(),
            unexplained_change: next(),
            relative_gradient: next(),
            relative_change: next(),
        };
        BlockFeatures {
            clip: clip(),
            distance: next(),
            brightness: next(),
            mask_contrast: next(),
            mask_gradient: next(),
            frames: next(),
            whole_gradient: next(),
            whole_change: next(),
            whole_distance: next(),
            early: clip(),
        }
    }

    /// `research/training/test_pipeline.py` compares the file, run by ONNX Runtime, with the same figures.
    #[test]
    fn predictions_are_those_of_the_onnx_file() {
        let expected = include_str!("../../../tests/data/quality.json");
        let expected: BTreeMap<String, BTreeMap<String, Vec<f32>>> =
            serde_json::from_str(expected).unwrap();
        let blocks = Array3::from_shape_fn((2, 2, 3), |(k, i, j)| sample_block(k, i, j));
        let encoded = Array4::from_shape_fn((CHANNELS, 2, 2, 3), |(n, k, i, j)| {
            sample(-1.0, 1.0, [n, k, i, j])
        });
        let signs = std::array::from_fn(|n| sample(-25.0, 8.0, [n, 0, 0, 0]));
        let evidence = Evidence::new(Signs(signs), &blocks.slice(s![..1, ..1, ..1]).to_owned());
        let features = |encoded| {
            let blocks = blocks.clone();
            Features { first_frame: 0, blocks, encoded, first_run: None, unfamiliar: false }
        };
        for (name, model) in [
            ("gap-tv", &MODELS.total_variation),
            ("pnp-tv-fastdvdnet", &MODELS.weakly_shrunk),
            ("pnp-tv-fastdvdnet-shrunk", &MODELS.strongly_shrunk),
        ] {
            let known = model.log_errors(&features(Some(encoded.clone())), Some(&evidence));
            let unknown = model.log_errors(&features(None), None);
            for (case, found) in [("known", known), ("unknown", unknown)] {
                let expected = &expected[name][case];
                assert_eq!(found.len(), expected.len());
                let is_close = found.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-4);
                assert!(is_close, "{name}, {case}: {found} for {expected:?}");
            }
        }
    }

    #[test]
    fn only_known_schedules_have_a_model() {
        let has = |schedule: Schedule| Model::of(&schedule).is_some();
        assert!(has(Schedule::gap_tv()) && has(Schedule::pnp_tv_fastdvdnet()));
        assert!(!has(Schedule::admm_tv()) && !has(Schedule::pnp_ffdnet()));
        let changes: [fn(&mut crate::stage::Stage); 4] = [
            |stage| stage.momentum = 0.0,
            |stage| stage.projection.static_variance = Some(1.0),
            |stage| stage.prior.nonlocal_mut().unwrap().outlier_limit = Some(1.0),
            |stage| stage.prior.nonlocal_mut().unwrap().temporal_shrinkage = 1.0,
        ];
        for change in changes {
            let mut schedule = Schedule::pnp_nonlocal();
            assert!(has(schedule.clone()));
            change(&mut schedule.stages[1]);
            assert!(!has(schedule));
        }
        for model in [&MODELS.total_variation, &MODELS.weakly_shrunk, &MODELS.strongly_shrunk] {
            let [low, high] = model.misses.interval;
            let [lower, higher] = model.misses.unfamiliar.interval;
            assert!(lower < low && low < 0.0 && 0.0 < high && high < higher);
        }
    }

    #[test]
    fn strongly_shrunk_frames_have_a_separate_model() {
        let mut schedule = Schedule::pnp_tv_fastdvdnet();
        let low = |schedule: &Schedule| Model::of(schedule).unwrap().misses.interval[0];
        let planned = low(&schedule);
        let nonlocal = schedule.stages.last_mut().unwrap().prior.nonlocal_mut().unwrap();
        nonlocal.static_shrinkage = Some(4.0 * nonlocal.temporal_shrinkage);
        assert!(low(&schedule) < planned, "its interval is wider");
    }

    #[test]
    fn a_second_run_removes_motion_or_error() {
        let uniform = |log: f32| Array3::from_elem((2, 1, 3), log);
        let combined = |first, distance: f32| {
            combine_runs(&uniform(-4.0), &uniform(first), uniform(distance).view())
        };
        let is_close = |logs: Array3<f32>, log: f32| logs.iter().all(|f| (f - log).abs() < 0.01);
        assert!(is_close(combined(-3.0, -3.0), -4.0), "error: the prediction for the result holds");
        let remaining = (10f32.powf(-2.0) - 10f32.powf(-3.0)).log10();
        assert!(
            is_close(combined(-2.0, -3.0), remaining),
            "motion: the error that both runs share"
        );
        let mut distance = uniform(-4.0);
        distance[[0, 0, 0]] = -2.0;
        let found = combine_runs(&uniform(-4.0), &uniform(-2.0), distance.view());
        assert!((found[[0, 0, 0]] + 3.0).abs() < 0.01, "at least the smallest share: {found}");
    }

    #[test]
    fn a_first_run_is_predicted_by_the_model_of_weak_shrinkage() {
        let op = SensingOperator::new(iid_masks(4, 40, 36, 1).unwrap()).unwrap();
        let mut ripple = ramp();
        for ((k, i, j), value) in ripple.indexed_iter_mut() {
            *value += 0.1 * ((i * j + k) as f32).sin();
        }
        let (result, first) = (features(&op, &ramp()), features(&op, &ripple));
        let mut schedule = Schedule::pnp_tv_fastdvdnet();
        let weak = Model::of(&schedule).unwrap();
        let nonlocal = schedule.stages.last_mut().unwrap().prior.nonlocal_mut().unwrap();
        nonlocal.static_shrinkage = Some(4.0 * nonlocal.temporal_shrinkage);
        let strong = Model::of(&schedule).unwrap();
        let at_distance = |distance: f32| {
            let frames = (ramp(), ramp() + distance);
            result.clone().with_first_run(first.clone(), frames.0.view(), frames.1.view())
        };
        let alone = strong.log_errors(&result, None);
        let distant = strong.log_errors(&at_distance(1.0), None);
        assert_eq!(distant, alone, "large distance: a static scene");
        let close = at_distance(1e-3);
        let moving = strong.log_errors(&close, None);
        let expected = weak.log_errors(&first, None);
        let difference =
            (&moving - &expected).iter().fold(0.0, |largest: f32, d| largest.max(d.abs()));
        assert!(difference < 0.02, "small distance, large error: {difference}");
        let evidence = evidence(-10.0, &result);
        let first = Some(Box::new(evidence.clone()));
        let known = strong.log_errors(&close, Some(&Evidence { first, ..evidence.clone() }));
        assert_ne!(known, strong.log_errors(&close, Some(&evidence)));
    }

    #[test]
    fn blocks_at_the_edge_have_fewer_neighbours() {
        let features =
            Array4::from_shape_fn((1, 2, 3, 4), |(_, k, i, j)| (100 * k + 10 * i + j) as f32);
        let means = neighbourhood_means(&features);
        assert_eq!((means[[0, 0, 0, 0]], means[[0, 1, 1, 2]]), (5.5, 112.0));
        assert_eq!((means[[0, 0, 2, 1]], means[[0, 1, 2, 3]]), (16.0, 117.5));
    }

    /// Fine moving texture of two amplitudes. The priors have changed both by a fifth.
    #[test]
    fn more_texture_raises_the_expected_error() {
        let op = SensingOperator::new(iid_masks(4, 48, 48, 1).unwrap()).unwrap();
        let error = |schedule: &Schedule, texture: f32| {
            let frame = |(k, i, j): (usize, usize, usize)| {
                let phase = i as f32 * 1.1 + (j as f32 - k as f32) * 0.9;
                0.5 + texture * phase.sin()
            };
            let frames = Array3::from_shape_fn((4, 48, 48), frame);
            let early = frames.mapv(|x| 0.5 + 0.8 * (x - 0.5));
            let deep = schedule.stages.len() > 1;
            let early = deep.then(|| early.view());
            let features = Features::of(&op, early, frames.view(), None).unwrap();
            Model::of(schedule).unwrap().log_errors(&features, None)[[1, 1, 1]]
        };
        for schedule in [Schedule::gap_tv(), Schedule::pnp_tv_fastdvdnet()] {
            let (much, little) = (error(&schedule, 0.1), error(&schedule, 0.01));
            assert!(much > little + 0.3 && much < -1.0 && little > -6.0, "{much}, {little}");
        }
    }

    #[test]
    fn a_larger_hold_out_error_raises_the_expected_error() {
        let op = SensingOperator::new(iid_masks(4, 40, 36, 1).unwrap()).unwrap();
        let features = features(&op, &ramp());
        for model in [&MODELS.total_variation, &MODELS.weakly_shrunk, &MODELS.strongly_shrunk] {
            let error = |decibels: f32| {
                let evidence = evidence(decibels, &features);
                model.log_errors(&features, Some(&evidence)).mean().unwrap()
            };
            assert!(error(-20.0) > error(-35.0), "{}, {}", error(-20.0), error(-35.0));
        }
    }
}
