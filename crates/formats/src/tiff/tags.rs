//! The tags of a page, and errors that name the page.

use std::fmt::Display;
use std::io::{BufReader, ErrorKind, Read, Seek};

use ::tiff::TiffError;
use ::tiff::decoder::{ChunkType, Decoder};
use ::tiff::tags::Tag;

use super::refusal::{malformed, refused};
use crate::error::Result;
use crate::{Format, FormatError};

pub(super) const ACCEPTED_SAMPLES: &str = "one grey sample per pixel (BlackIsZero): integers of 1 to 64 bits, or floats of 16, 32 or 64 bits (to \
     convert others: python -c \"import imagecodecs, numpy, tifffile; numpy.save('out.npy', tifffile.imread('in.tif'))\")";

/// TIFF's number for no compression.
pub(super) const UNCOMPRESSED: u16 = 1;

/// Access to the tags of the current page.
pub(super) struct Tags<'a, R: Read + Seek> {
    pub(super) decoder: &'a mut Decoder<BufReader<R>>,
    pub(super) page: usize,
}

impl<R: Read + Seek> Tags<'_, R> {
    pub(super) fn number(&mut self, tag: Tag, default: u16) -> Result<u16> {
        let value = self.decoder.find_tag_unsigned(tag).map_err(|e| in_page(self.page, e))?;
        Ok(value.unwrap_or(default))
    }

    pub(super) fn numbers(&mut self, tag: Tag) -> Result<Vec<u16>> {
        let values = self.decoder.find_tag_unsigned_vec(tag).map_err(|e| in_page(self.page, e))?;
        Ok(values.unwrap_or_default())
    }

    /// True for strips without compression.
    pub(super) fn is_plain(&mut self) -> Result<bool> {
        let compression = self.number(Tag::Compression, UNCOMPRESSED)?;
        Ok(compression == UNCOMPRESSED && self.decoder.get_chunk_type() == ChunkType::Strip)
    }

    pub(super) fn refused(&self, found: impl Display, accepted: &'static str) -> FormatError {
        refused(format!("{found} (page {})", self.page), accepted)
    }
}

/// Names the page in an error of the decoder.
pub(super) fn in_page(page: usize, error: TiffError) -> FormatError {
    match error {
        // Decompressors report invalid data as I/O errors, too; only errors of the operating system have a number.
        TiffError::IoError(source) if source.raw_os_error().is_some() => {
            FormatError::Io { action: "read the TIFF page", source }
        }
        TiffError::IoError(source) if source.kind() == ErrorKind::UnexpectedEof => {
            FormatError::Truncated {
                format: Format::Tiff,
                promised: format!("page {page} (counted from 0)"),
                present: "only a part of it".to_owned(),
            }
        }
        TiffError::UnsupportedError(feature) => FormatError::Unsupported {
            format: Format::Tiff,
            found: format!("page {page}: {feature}"),
            accepted: ACCEPTED_SAMPLES,
        },
        other => malformed(format!("page {page}: {other}")),
    }
}
