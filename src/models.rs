//! The networks that the program carries.

use crate::recon::schedule::Network;

/// A network in its ONNX files, embedded so that the program needs nothing beside libonnxruntime.
#[derive(Debug, Clone, Copy)]
pub struct Model {
    /// Name, for records.
    pub name: &'static str,
    /// The files, in the order in which a frame goes through them.
    pub files: &'static [&'static [u8]],
}

/// The model of a network, trained for this project (see its model card in `models/`).
pub const fn of(network: Network) -> Model {
    match network {
        Network::FastDvdNet => FASTDVDNET_GRAY,
        Network::FfdNet => FFDNET_GRAY,
    }
}

const FASTDVDNET_GRAY: Model = Model {
    name: "fastdvdnet-gray",
    files: &[
        include_bytes!("../models/fastdvdnet-gray/stage1.onnx"),
        include_bytes!("../models/fastdvdnet-gray/stage2.onnx"),
    ],
};

const FFDNET_GRAY: Model =
    Model { name: "ffdnet-gray", files: &[include_bytes!("../models/ffdnet-gray/model.onnx")] };
