//! The formats of exports.

use serde::Deserialize;

use engine::job::MovieFormat;

/// The formats, as paths name them.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub(in crate::http) enum Format {
    /// All frames of a snapshot as one multi-part EXR.
    Exr,
    /// All frames as one array.
    Npy,
    /// A BigTIFF with a page per frame.
    Tiff,
    /// A Zarr array, which is a tree of files.
    Zarr,
    /// A movie.
    Mp4,
    /// A movie for presentations.
    Gif,
    /// Each frame of a snapshot as EXR and PNG, which is a tree of files.
    Frames,
    /// Frames of a colour sensor before demosaicking.
    Mosaic,
    /// The expected error of blocks of the frames.
    Error,
    /// Inputs, parameters and outcome.
    Manifest,
    /// All files of a job.
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
