//! End-to-end networks (such as BIRNAT): a measurement and its masks go in, frames come out.
//!
//! Such a network is trained for one set of masks, and has no schedule or priors. Only its inputs and outputs can be
//! checked before it runs.

use std::fmt;

use ndarray::{Array3, ArrayView2, ArrayView3};

use super::error::{Result, check_shape, shape_text};

/// An input or output of a network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct TensorInfo {
    /// Its name.
    pub name: String,
    /// Element type, such as `float32`.
    pub element: String,
    /// Side lengths; none for any length.
    pub sides: Vec<Option<usize>>,
}

/// Inputs and outputs of a network.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Interface {
    /// The inputs.
    pub inputs: Vec<TensorInfo>,
    /// The outputs.
    pub outputs: Vec<TensorInfo>,
}

/// Picture sizes that a network takes.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum PictureSize {
    /// The size of the masks only, so the picture cannot be tiled.
    Fixed,
    /// Any size.
    Free,
}

/// A loaded end-to-end network.
pub trait SnapshotNetwork {
    /// The frames \[B,H,W\] of measurement `y` \[H,W\] through `masks` \[B,H,W\], where `y = sum_k C_k x_k` with
    /// frames `x_k` on \[0,1\]. All arrays are in standard layout.
    ///
    /// # Errors
    /// The network fails, or its output is not B finite frames.
    fn frames(&mut self, y: ArrayView2<'_, f32>, masks: ArrayView3<'_, f32>)
    -> Result<Array3<f32>>;
}

/// Refuses frames \[B,H,W\] that are not finite.
///
/// # Errors
/// [`super::ReconError::Shape`]: some values are not finite.
pub fn all_finite(frames: &Array3<f32>) -> Result<()> {
    let wrong = frames.iter().find(|value| !value.is_finite()).copied();
    let found = format!("{} among others", wrong.unwrap_or_default());
    let expected = format!("1x{} of finite numbers", shape_text(frames.shape()));
    check_shape(wrong.is_none(), "the network's output", found, expected)
}

/// Name of the input that takes the measurement \[1,1,H,W\].
pub const MEASUREMENT: &str = "measurement";
/// Name of the input that takes the masks \[1,B,H,W\].
pub const MASKS: &str = "masks";
/// Name of the output that gives the frames \[1,B,H,W\].
pub const FRAMES: &str = "frames";

impl Interface {
    /// Checks that the network takes a measurement through `frames` masks of `height` x `width` pixels and returns as
    /// many frames, all float32. Returns the picture sizes that it takes.
    ///
    /// # Errors
    /// [`super::ReconError::Shape`] with the actual and the required tensors.
    pub fn check(&self, frames: usize, height: usize, width: usize) -> Result<PictureSize> {
        let names = |tensors: &[TensorInfo]| {
            let mut names: Vec<&str> = tensors.iter().map(|tensor| tensor.name.as_str()).collect();
            names.sort_unstable();
            names.join(", ")
        };
        let (inputs, outputs) = (names(&self.inputs), names(&self.outputs));
        let fits = inputs == format!("{MASKS}, {MEASUREMENT}") && outputs == FRAMES;
        let found = format!("inputs {inputs}; outputs {outputs}");
        let expected = format!("inputs {MASKS}, {MEASUREMENT}; output {FRAMES}");
        check_shape(fits, "the network's interface", found, expected)?;
        let mut size = PictureSize::Free;
        for tensor in self.inputs.iter().chain(&self.outputs) {
            let (what, planes) = match tensor.name.as_str() {
                MEASUREMENT => ("the network's input measurement", 1),
                MASKS => ("the network's input masks", frames),
                _ => ("the network's output frames", frames),
            };
            tensor.check(what, [1, planes, height, width])?;
            if tensor.sides.iter().skip(2).any(Option::is_some) && tensor.name != FRAMES {
                size = PictureSize::Fixed;
            }
        }
        Ok(size)
    }
}

impl TensorInfo {
    fn check(&self, what: &'static str, needed: [usize; 4]) -> Result<()> {
        let fits = self.sides.len() == needed.len()
            && self.sides.iter().zip(needed).all(|(side, needed)| side.is_none_or(|s| s == needed));
        let needed =
            Self { sides: needed.map(Some).into(), element: "float32".into(), ..self.clone() };
        let expected = format!("{needed} (that of the masks)");
        check_shape(fits && self.element == "float32", what, self.to_string(), expected)
    }
}

/// `float32 [1,8,?,?]`.
impl fmt::Display for TensorInfo {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let side = |side: &Option<usize>| side.map_or_else(|| "?".to_owned(), |s| s.to_string());
        let sides: Vec<String> = self.sides.iter().map(side).collect();
        write!(f, "{} [{}]", self.element, sides.join(","))
    }
}

#[cfg(test)]
mod tests {
    use super::{Interface, PictureSize, TensorInfo};

    fn tensor(name: &str, sides: [usize; 4]) -> TensorInfo {
        let side = |side: usize| (side > 0).then_some(side);
        TensorInfo { name: name.into(), element: "float32".into(), sides: sides.map(side).into() }
    }

    /// A network for `frames` frames; a length of 0 stands for any.
    fn network(frames: usize, height: usize, width: usize) -> Interface {
        Interface {
            inputs: vec![
                tensor("measurement", [1, 1, height, width]),
                tensor("masks", [1, frames, height, width]),
            ],
            outputs: vec![tensor("frames", [0, frames, height, width])],
        }
    }

    #[test]
    fn sizes_are_fixed_or_free() {
        assert_eq!(network(4, 48, 64).check(4, 48, 64).unwrap(), PictureSize::Fixed);
        assert_eq!(network(4, 0, 0).check(4, 48, 64).unwrap(), PictureSize::Free);
        assert_eq!(network(0, 0, 0).check(9, 5, 64).unwrap(), PictureSize::Free);
        assert_eq!(network(4, 48, 0).check(4, 48, 64).unwrap(), PictureSize::Fixed);
    }

    #[test]
    fn a_misfit_is_reported_with_the_required_tensor() {
        let message = |network: &Interface| network.check(4, 48, 64).unwrap_err().to_string();
        let text = message(&network(8, 48, 64));
        assert!(text.contains("masks") && text.contains("[1,8,48,64]"), "{text}");
        assert!(text.contains("[1,4,48,64]"), "{text}");
        let text = message(&network(4, 32, 64));
        assert!(text.contains("[1,1,32,64]") && text.contains("[1,1,48,64]"), "{text}");
        let mut double = network(4, 48, 64);
        double.outputs[0].element = "float64".into();
        let text = message(&double);
        assert!(text.contains("float64 [?,4,48,64]") && text.contains("float32"), "{text}");
        let mut flat = network(4, 48, 64);
        flat.inputs[1].sides.pop();
        assert!(message(&flat).contains("[1,4,48]"));
        let mut other = network(4, 48, 64);
        other.inputs[0].name = "y".into();
        let text = message(&other);
        assert!(text.contains("masks, y") && text.contains("masks, measurement"), "{text}");
    }
}
