use ndarray::{Array3, array};

use super::{MaskStatistics, check_masks, check_snapshots};
use crate::test_support::assert_names;
use crate::{Format, FormatError, FrameReader, FullScale, SampleType, StackInfo};

/// A stack in memory.
struct Stack {
    info: StackInfo,
    frames: Vec<ndarray::Array2<f32>>,
}

impl Stack {
    fn new(stack: Array3<f32>) -> Self {
        let (frames, height, width) = stack.dim();
        let info = StackInfo::new(Format::Npy, SampleType::F32, frames, height, width);
        Self { info, frames: stack.outer_iter().rev().map(|f| f.to_owned()).collect() }
    }
}

impl FrameReader for Stack {
    fn info(&self) -> &StackInfo {
        &self.info
    }

    fn next_frame(&mut self) -> Result<Option<ndarray::Array2<f32>>, FormatError> {
        Ok(self.frames.pop())
    }
}

fn masks(
    stack: Array3<f32>,
    full_scale: f32,
) -> Result<(MaskStatistics, Array3<f32>), FormatError> {
    let mut out = Array3::zeros(stack.dim());
    let mut k = 0;
    let scale = FullScale::new(full_scale)?;
    let statistics = check_masks(&mut Stack::new(stack), scale, |frame| {
        out.index_axis_mut(ndarray::Axis(0), k).assign(&frame);
        k += 1;
        Ok(())
    })?;
    Ok((statistics, out))
}

fn measurement(stack: Array3<f32>, full_scale: f32) -> Result<Array3<f32>, FormatError> {
    let mut out = Array3::zeros(stack.dim());
    let mut k = 0;
    let scale = FullScale::new(full_scale)?;
    check_snapshots(&mut Stack::new(stack), scale, |snapshot| {
        out.index_axis_mut(ndarray::Axis(0), k).assign(&snapshot);
        k += 1;
        Ok(())
    })?;
    Ok(out)
}

#[test]
fn masks_are_scaled_clipped_and_counted() {
    let raw = array![[[0.0, 255.0], [-3.0, 51.0]], [[0.0, 0.0], [102.0, -1.0]]];
    let (statistics, scaled) = masks(raw, 255.0).unwrap();
    assert_eq!(scaled, array![[[0.0, 1.0], [0.0, 0.2]], [[0.0, 0.0], [0.4, 0.0]]]);
    assert_eq!((statistics.dead_pixels, statistics.clipped_negative), (1, 2));
    assert!((statistics.mean - 1.6 / 8.0).abs() < 1e-7);
}

#[test]
fn bipolar_masks_are_refused_and_noise_is_not() {
    let refused = |stack: Array3<f32>, scale| match masks(stack, scale) {
        Err(error @ FormatError::BipolarMasks { .. }) => error.to_string(),
        other => panic!("{other:?}"),
    };
    let sign = |k: usize| if (k * 7919 % 101).is_multiple_of(2) { 1.0 } else { -1.0 };
    let at = |(k, i, j): (usize, usize, usize)| k * 1024 + i * 32 + j;
    let hadamard = Array3::from_shape_fn((2, 32, 32), |place| sign(at(place)));
    assert_names(
        &refused(hadamard.clone(), 1.0),
        &["negative", "(1+C)/2", "(1-C)/2", "two exposures"],
    );
    // The scale that would fit is not known yet.
    refused(&hadamard * 127.0, 1.0);
    // Three levels, and a continuous pattern.
    refused(
        Array3::from_shape_fn((2, 32, 32), |place| (at(place) * 7919 % 101 % 3) as f32 - 1.0),
        1.0,
    );
    refused(Array3::from_shape_fn((2, 32, 32), |place| (at(place) as f32 * 0.7).sin()), 1.0);
    // A subtracted dark leaves noise around 0 in closed pixels, and in dark masks hardly anything else.
    let noise = |place| {
        let sum: usize = (1..13).map(|seed| at(place) * 7919 % 104_729 * seed % 1009).sum();
        (sum as f32 / 1009.0 - 6.0) * 0.05
    };
    for open in [0.5, 0.02, 0.0] {
        let stack = Array3::from_shape_fn((2, 32, 32), |place| {
            let lit = (at(place) * 31 % 1000) as f32 / 1000.0 < open;
            (noise(place) + f32::from(u8::from(lit))).min(1.0)
        });
        masks(stack, 1.0).unwrap();
    }
}

#[test]
fn only_rounding_above_one_is_tolerated() {
    let (_, scaled) = masks(array![[[1.0 + 5e-7, 0.5]]], 1.0).unwrap();
    assert_eq!(scaled, array![[[1.0, 0.5]]]);
    let error = masks(array![[[0.1, 2.0]], [[7.0, 128.0]]], 1.0).unwrap_err();
    assert_names(&error.to_string(), &["128", "frame 1, row 0, column 1", "full_scale"]);
}

#[test]
fn infinities_and_zero_masks_are_refused_and_nan_are_kept() {
    let (statistics, scaled) = masks(array![[[0.5, 0.5]], [[0.5, f32::NAN]]], 1.0).unwrap();
    assert!(scaled[[1, 0, 1]].is_nan() && scaled[[0, 0, 1]] == 0.5);
    assert!((statistics.mean - 1.5 / 3.0).abs() < 1e-7, "the mean of the measured values");
    let error = masks(array![[[f32::NEG_INFINITY, 0.5]]], 1.0).unwrap_err();
    assert_names(&error.to_string(), &["-inf", "frame 0, row 0, column 0"]);
    let error = masks(array![[[0.0, -1.0]], [[0.0, 0.0]]], 1.0).unwrap_err();
    assert!(matches!(error, FormatError::AllMasksZero { frames: 2, .. }), "{error}");
    let error = masks(array![[[1.0]], [[0.0]], [[0.0]]], 1.0).unwrap_err();
    assert!(matches!(error, FormatError::MaskFrameZero { frame: 1, frames: 3, .. }), "{error}");
}

#[test]
fn masks_far_below_their_full_scale_are_closed() {
    // Their squares are 0 in 32 bits, so that every frame would be 0.
    let error = masks(array![[[1.0]], [[0.5]]], 1e30).unwrap_err();
    assert_names(&error.to_string(), &["largest value", "1.0", "full scale 1e30", "`full_scale`"]);
    let error = masks(array![[[1e-7]], [[0.5]]], 1.0).unwrap_err();
    assert!(matches!(error, FormatError::MaskFrameZero { frame: 0, .. }), "{error}");
}

#[test]
fn pixels_with_vanishing_squares_are_dead() {
    let (statistics, _) = masks(array![[[1e-30, 1.0]]], 1.0).unwrap();
    assert_eq!(statistics.dead_pixels, 1);
}

#[test]
fn measurements_may_be_negative_and_above_one() {
    let scaled = measurement(array![[[510.0, -51.0]]], 255.0).unwrap();
    assert_eq!(scaled, array![[[2.0, -0.2]]]);
}

#[test]
fn measurements_without_light_and_infinities_are_refused() {
    let error = measurement(array![[[0.0]], [[f32::NAN]]], 1.0).unwrap_err();
    assert_names(&error.to_string(), &["snapshot 0 of 2", "zero everywhere"]);
    let kept = measurement(array![[[1.0]], [[0.0]], [[f32::NAN]]], 1.0).unwrap();
    assert!(kept[[1, 0, 0]] == 0.0 && kept[[2, 0, 0]].is_nan());
    for (stack, full_scale, words) in [
        (array![[[f32::NAN, f32::NAN]]], 1.0, &["snapshot 0 of 1", "no finite value"][..]),
        (array![[[1e-30, f32::NAN]]], 1e30, &["full scale", "too large"]),
        (array![[[1e-16, f32::NAN]]], 1.0, &["full scale", "too large"]),
        (array![[[0.5, 8.0]]], 1.2e-38, &["column 0", "0.5", "more than 1e15 times", "full_scale"]),
        (array![[[0.5, 1e37]]], 1.0, &["column 1", "1e37", "more than 1e15 times", "full_scale"]),
    ] {
        let error = measurement(stack, full_scale).unwrap_err();
        assert!(error.is_callers_fault());
        assert_names(&error.to_string(), words);
    }
    let error = measurement(array![[[1.0, f32::INFINITY]]], 1.0).unwrap_err();
    assert_names(&error.to_string(), &["measurement", "inf", "column 1"]);
}

#[test]
fn full_scales_must_be_finite_and_positive() {
    for value in [0.0, -1.0, f32::NAN, f32::INFINITY, 1e-40] {
        assert!(matches!(FullScale::new(value), Err(FormatError::FullScale(_))), "{value}");
    }
    assert_eq!(FullScale::new(4095.0).unwrap().value(), 4095.0);
}

#[test]
fn errors_of_the_sink_are_returned() {
    let mut stack = Stack::new(array![[[1.0]]]);
    let full = || FormatError::Io { action: "write", source: std::io::Error::other("disk full") };
    let error = check_masks(&mut stack, FullScale::ONE, |_| Err(full())).unwrap_err();
    assert!(!error.is_callers_fault());
}
