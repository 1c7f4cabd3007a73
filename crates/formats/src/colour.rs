//! Opens colour clips.

use std::path::Path;

use super::open::open;
use super::photo::{self, read_picture};
use super::{Format, Limits, Reader, npy, png};
use crate::error::Result;

/// Opens a colour clip: npy (frame, row, column, 3) in C order, or a picture in colours: a PNG with 8 or 16 bits per
/// channel, or a JPEG, BMP or PNM with 8. Its frames, and their stated width, are three times as wide as the picture.
/// `None` if the file is not in colour.
///
/// Errors: as [`super::open_stack`].
pub fn open_colours(path: &Path, limits: &Limits) -> Result<Option<Reader>> {
    let (file, length, format) = open(path, "mask")?;
    limits.check_file(format, length)?;
    Ok(match format {
        Format::Npy => {
            let reader = npy::open_colours(file, length, limits)?;
            reader.map(|reader| Box::new(reader) as Reader)
        }
        Format::Png => png::open_colours(file, length, limits)?,
        Format::Jpeg | Format::Bmp | Format::Pnm => {
            let bytes = read_picture(file, (format, length))?;
            photo::open_colours(&bytes, format, limits)?
        }
        _ => None,
    })
}

#[cfg(test)]
mod tests {
    use ndarray::Array3;

    use super::open_colours;
    use crate::display::{Encoding, Picture};
    use crate::test_support::file;
    use crate::{Channels, Limits, collect, npy, open_stack};

    #[test]
    fn colour_clips_are_distinguished_from_grey_ones() {
        let frames = Array3::from_shape_fn((2, 3, 12), |(k, i, j)| (k * 36 + i * 12 + j) as f32);
        let path = tempfile::NamedTempFile::new().unwrap();
        npy::write_colours(path.path(), frames.view()).unwrap();
        let mut reader = open_colours(path.path(), &Limits::default()).unwrap().unwrap();
        assert_eq!(collect(&mut *reader).unwrap().1, frames);
        let refused = open_stack(path.path(), &Limits::default()).err().unwrap().to_string();
        assert!(refused.contains("4 dimensions"), "{refused}");
        let windows = npy::open_windows(path.path(), &Limits::default()).unwrap();
        assert_eq!(
            windows.read_window(1..2, 0..3, 3..9).unwrap(),
            frames.slice(ndarray::s![1..2, .., 3..9])
        );
        npy::write_f32(path.path(), frames.view()).unwrap();
        assert!(open_colours(path.path(), &Limits::default()).unwrap().is_none());

        let frame = frames.index_axis(ndarray::Axis(0), 1).mapv(|value| value / 255.0);
        let png = |channels| {
            let picture = Picture::new(frame.view(), channels, (0.0, 1.0)).unwrap();
            picture.encode(Encoding::Png).unwrap()
        };
        let bytes = png(Channels::Rgb);
        let picture = file(&bytes);
        let mut reader = open_colours(picture.path(), &Limits::default()).unwrap().unwrap();
        assert_eq!((reader.info().height, reader.info().width), (3, 12));
        assert_eq!(reader.next_frame().unwrap().unwrap(), frames.index_axis(ndarray::Axis(0), 1));
        assert!(reader.next_frame().unwrap().is_none());
        let grey = file(&png(Channels::Grey));
        assert!(open_colours(grey.path(), &Limits::default()).unwrap().is_none());
        let cut = file(&bytes[..bytes.len() - 30]);
        let read = open_colours(cut.path(), &Limits::default())
            .and_then(|reader| reader.unwrap().next_frame());
        assert!(read.is_err_and(|error| error.is_callers_fault()));
    }
}
