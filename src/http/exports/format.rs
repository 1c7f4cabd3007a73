//! The formats of exports.

use serde::Deserialize;

use engine::job::MovieFormat;

/// The formats, as paths name them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(in crate::http) enum Format {
    /// All frames of a snapshot as a multi-part EXR.
    Exr,
    /// All frames as one array.
    Npy,
    /// An OME-TIFF with a page per frame.
    Tiff,
    /// An OME-Zarr group, which is a directory of files.
    Zarr,
    /// The OME-Zarr group as one file.
    ZarrZip,
    /// A movie of all frames.
    Mp4,
    /// A movie of all frames for presentation programs.
    Gif,
    /// A directory with an EXR and a PNG of each frame of a snapshot.
    Frames,
    /// Frames of a colour sensor before demosaicking.
    Mosaic,
    /// The expected error of each block of each frame.
    Error,
    /// A record of inputs, parameters and results.
    Manifest,
    /// An archive of all files of a job.
    Zip,
}

impl From<MovieFormat> for Format {
    fn from(format: MovieFormat) -> Self {
        match format {
            MovieFormat::Mp4 => Self::Mp4,
            MovieFormat::Gif => Self::Gif,
        }
    }
}
