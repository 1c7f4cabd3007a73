//! The networks that the program carries.

use std::borrow::Cow;
use std::fs;
use std::io;
use std::path::{Path, PathBuf};

use crate::recon::prior::Network;

/// A network in its ONNX files, embedded so that the program needs nothing beside libonnxruntime.
#[derive(Debug, Clone, Copy)]
pub struct Model {
    /// Name, for records.
    pub name: &'static str,
    /// The files, in the order in which a frame goes through them: name and content.
    pub files: &'static [(&'static str, &'static [u8])],
}

impl Model {
    /// The contents of the files, as carried, or as they stand in the folder of this model's name
    /// in `folder`: other weights for the same network.
    ///
    /// # Errors
    /// A file can't be read; its path comes with the reason.
    pub fn contents(&self, folder: Option<&Path>) -> Result<Vec<Content>, (PathBuf, io::Error)> {
        let content = |&(name, carried): &(&str, &'static [u8])| match folder {
            None => Ok(Cow::Borrowed(carried)),
            Some(folder) => {
                let path = folder.join(self.name).join(name);
                fs::read(&path).map(Cow::Owned).map_err(|error| (path, error))
            }
        };
        self.files.iter().map(content).collect()
    }
}

/// A model file's bytes.
pub type Content = Cow<'static, [u8]>;

/// The model of a network, trained for this project (see its model card in `models/`).
pub const fn of(network: Network) -> Model {
    match network {
        Network::FastDvdNet => FASTDVDNET_GRAY,
        Network::FastDvdNetInt8 => FASTDVDNET_GRAY_INT8,
        Network::FfdNet => FFDNET_GRAY,
    }
}

const FASTDVDNET_GRAY: Model = Model {
    name: "fastdvdnet-gray",
    files: &[
        ("stage1.onnx", include_bytes!("../../models/fastdvdnet-gray/stage1.onnx")),
        ("stage2.onnx", include_bytes!("../../models/fastdvdnet-gray/stage2.onnx")),
    ],
};

const FASTDVDNET_GRAY_INT8: Model = Model {
    name: "fastdvdnet-gray-int8",
    files: &[
        ("stage1.onnx", include_bytes!("../../models/fastdvdnet-gray-int8/stage1.onnx")),
        ("stage2.onnx", include_bytes!("../../models/fastdvdnet-gray-int8/stage2.onnx")),
    ],
};

const FFDNET_GRAY: Model = Model {
    name: "ffdnet-gray",
    files: &[("model.onnx", include_bytes!("../../models/ffdnet-gray/model.onnx"))],
};

#[cfg(test)]
mod tests {
    use super::of;
    use crate::pipeline::sha256_of;
    use crate::recon::prior::Network;

    #[test]
    fn the_twin_with_8_bits_was_made_from_these_weights() {
        let (exact, quick) = (of(Network::FastDvdNet), of(Network::FastDvdNetInt8));
        for ((name, exact), (_, quick)) in exact.files.iter().zip(quick.files) {
            // `training/quantize.py` writes it among the file's properties.
            let source = sha256_of(&mut &**exact).unwrap();
            let found = quick.windows(source.len()).any(|window| window == source.as_bytes());
            assert!(found, "{name}: make the twin anew with training/quantize.py");
        }
    }
}
