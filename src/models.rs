//! The networks that the program carries.

/// A network in two ONNX files, embedded so that the program needs nothing beside
/// libonnxruntime.
#[derive(Debug, Clone, Copy)]
pub struct TwoStageModel {
    /// Name, for records.
    pub name: &'static str,
    /// First block.
    pub stage1: &'static [u8],
    /// Second block.
    pub stage2: &'static [u8],
}

/// FastDVDNet for gray video, trained for this project (see `models/fastdvdnet-gray`).
pub const FASTDVDNET_GRAY: TwoStageModel = TwoStageModel {
    name: "fastdvdnet-gray",
    stage1: include_bytes!("../models/fastdvdnet-gray/stage1.onnx"),
    stage2: include_bytes!("../models/fastdvdnet-gray/stage2.onnx"),
};
