//! Refuses pages with more than one grey value per pixel, and grey values that are not stored as such.

use std::io::{Read, Seek};

use ::tiff::tags::Tag;

use super::tags::Tags;
use crate::error::Result;

/// Photometric interpretations.
const WHITE_IS_ZERO: u16 = 0;
const BLACK_IS_ZERO: u16 = 1;
const RGB: u16 = 2;
const PALETTE: u16 = 3;
const CMYK: u16 = 5;
const YCBCR: u16 = 6;
/// Planar configuration of separate planes.
const PLANES: u16 = 2;

const ACCEPTED_WHITE: &str = "BlackIsZero (to convert integers: python -c \"import tifffile; \
     tifffile.imwrite('out.tif', ~tifffile.imread('in.tif'), photometric='minisblack')\")";
const RGB_PIXELS: &str = "grey, BlackIsZero (to convert colours to grey: python -c \"import imagecodecs, numpy, tifffile; a = \
     tifffile.imread('in.tif'); g = a[..., :3] @ [.299, .587, .114]; numpy.save('out.npy', (g if a.dtype.kind == \
     'f' else g.round()).astype(a.dtype))\")";
const RGB_PLANES: &str = "grey, BlackIsZero (to convert colours to grey: python -c \"import imagecodecs, numpy, tifffile; a = \
     numpy.moveaxis(tifffile.imread('in.tif'), -3, -1); g = a[..., :3] @ [.299, .587, .114]; numpy.save('out.npy', \
     (g if a.dtype.kind == 'f' else g.round()).astype(a.dtype))\"; if the planes are frames: python -c \"import imagecodecs, \
     numpy, tifffile; numpy.save('out.npy', tifffile.imread('in.tif'))\")";
const ALPHA_PIXELS: &str = "grey without transparency (to drop the transparency: python -c \"import imagecodecs, numpy, tifffile; \
     numpy.save('out.npy', tifffile.imread('in.tif')[..., 0])\")";
const ALPHA_PLANES: &str = "grey without transparency (to drop the transparency: python -c \"import imagecodecs, numpy, tifffile; \
     numpy.save('out.npy', tifffile.imread('in.tif')[..., 0, :, :])\")";
const MULTIBAND_PIXELS: &str = "one sample per pixel (if the samples are frames: python -c \"import imagecodecs, numpy, tifffile; \
     numpy.save('out.npy', numpy.moveaxis(tifffile.imread('in.tif'), -1, 0))\")";
const MULTIBAND_PLANES: &str = "one sample per pixel (if the planes are frames: python -c \"import imagecodecs, numpy, tifffile; \
     numpy.save('out.npy', tifffile.imread('in.tif'))\")";
const COLOUR_MAP: &str = "grey, BlackIsZero (to convert the colours to grey: python -c \"import imagecodecs, numpy, tifffile; \
     numpy.save('out.npy', [(p.colormap.T[p.asarray()] @ [.299, .587, .114]).round().astype('u2') for p in \
     tifffile.TiffFile('in.tif').pages])\"; if the palette is for display only: python -c \"import imagecodecs, numpy, tifffile; \
     numpy.save('out.npy', tifffile.imread('in.tif'))\")";
const PRINT: &str = "grey, BlackIsZero (to convert 8-bit colours to grey: python -c \"import numpy; from PIL import Image, ImageSequence; \
     numpy.save('out.npy', [numpy.array(page.convert('L')) for page in ImageSequence.Iterator(Image.open('in.tif'))])\")";
const WHITE_FLOATS: &str = "BlackIsZero (to keep the numbers as they are stored: python -c \"import imagecodecs, numpy, tifffile; \
     numpy.save('out.npy', tifffile.imread('in.tif'))\")";
const GREY: &str = "grey, BlackIsZero: export the pictures in grey";

/// Checks that the page has one grey value per pixel, with black at 0. Returns true if the stored numbers are the
/// indices of a palette of greys, which the decoder does not support.
pub(super) fn check<R: Read + Seek>(tags: &mut Tags<'_, R>) -> Result<bool> {
    let photometric = tags.number(Tag::PhotometricInterpretation, BLACK_IS_ZERO)?;
    let samples = tags.number(Tag::SamplesPerPixel, 1)?;
    let planes = tags.number(Tag::PlanarConfiguration, 1)? == PLANES;
    let choose = |pixels, planes_line| if planes { planes_line } else { pixels };
    let arrangement = if planes { " in separate planes" } else { "" };
    match (photometric, samples) {
        (BLACK_IS_ZERO, 1) => Ok(false),
        (PALETTE, 1) if tags.is_plain()? && is_grey_ramp(tags)? => Ok(true),
        (WHITE_IS_ZERO, 1) => {
            let floats = tags.numbers(Tag::SampleFormat)?.first() == Some(&3);
            let accepted = if floats { WHITE_FLOATS } else { ACCEPTED_WHITE };
            Err(tags.refused("WhiteIsZero", accepted))
        }
        (BLACK_IS_ZERO | WHITE_IS_ZERO, _) => {
            let alpha = tags.numbers(Tag::ExtraSamples)?.iter().any(|kind| [1, 2].contains(kind));
            if alpha && samples == 2 {
                let found = format_args!("grey with transparency{arrangement}");
                return Err(tags.refused(found, choose(ALPHA_PIXELS, ALPHA_PLANES)));
            }
            let found = format_args!("{samples} samples per pixel{arrangement}");
            Err(tags.refused(found, choose(MULTIBAND_PIXELS, MULTIBAND_PLANES)))
        }
        (RGB, _) => {
            let found = format_args!("RGB colours{arrangement}");
            Err(tags.refused(found, choose(RGB_PIXELS, RGB_PLANES)))
        }
        (PALETTE, _) => Err(tags.refused("colours of a palette", COLOUR_MAP)),
        (CMYK, _) => Err(tags.refused("CMYK colours", PRINT)),
        (YCBCR, _) => Err(tags.refused("YCbCr colours", PRINT)),
        (other, _) => Err(tags.refused(format_args!("photometric interpretation {other}"), GREY)),
    }
}

/// True if the palette of the page gives each stored number a grey value in proportion to it.
fn is_grey_ramp<R: Read + Seek>(tags: &mut Tags<'_, R>) -> Result<bool> {
    let map = tags.numbers(Tag::ColorMap)?;
    let count = map.len() / 3;
    let largest = count.saturating_sub(1).max(1);
    let ramp = |(index, value): (usize, &u16)| {
        // Programs round to 16 bits, or repeat the 8 bits of the number.
        (usize::from(*value) * largest).abs_diff(index * 65_535) <= 512 * largest
    };
    Ok(count > 1 && map.chunks_exact(count).all(|channel| channel.iter().enumerate().all(ramp)))
}
