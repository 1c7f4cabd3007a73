//! File formats, and their detection by the first bytes of a file.

use strum::Display;

/// Signature of npy files.
pub(super) const NPY_MAGIC: &[u8] = b"\x93NUMPY";
/// Signature of HDF5 files. It follows a user block, if there is one.
pub(super) const HDF5_MAGIC: &[u8] = b"\x89HDF\r\n\x1a\n";
/// Signature of prepared arrays.
pub(super) const PLANAR_MAGIC: &[u8] = b"SCIPLNR\0";

/// Number of first bytes that identify all formats.
pub(super) const HEAD_BYTES: u64 = 512;

/// Signatures of JPEG 2000, as a file and as a stream.
const JPEG_2000: [&[u8]; 2] = [b"\0\0\0\x0cjP  ", b"\xff\x4f\xff\x51"];

/// A file format that this crate reads or writes.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Display)]
pub enum Format {
    /// NumPy array.
    #[strum(serialize = "npy")]
    Npy,
    /// TIFF and BigTIFF, one frame per page.
    #[strum(serialize = "TIFF")]
    Tiff,
    /// PNG, one frame.
    #[strum(serialize = "PNG")]
    Png,
    /// JPEG, one frame.
    #[strum(serialize = "JPEG")]
    Jpeg,
    /// BMP, one frame.
    #[strum(serialize = "BMP")]
    Bmp,
    /// PBM, PGM, PPM or PAM, one frame.
    #[strum(serialize = "PNM")]
    Pnm,
    /// MATLAB level 5 file.
    #[strum(serialize = ".mat")]
    Mat,
    /// HDF5, which includes MATLAB level 7.3 files.
    #[strum(serialize = "HDF5")]
    Hdf5,
    /// ZIP archive of numbered pictures.
    #[strum(serialize = "ZIP")]
    Zip,
    /// ZIP archive of npy files.
    #[strum(serialize = "npz")]
    Npz,
    /// Tar archive of numbered pictures.
    #[strum(serialize = "tar")]
    Tar,
    /// OpenEXR.
    #[strum(serialize = "EXR")]
    Exr,
    /// Packed pixels of a camera without a header.
    #[strum(serialize = "raw")]
    Raw,
    /// Prepared array of this program ([`super::planar`]).
    #[strum(serialize = "planar")]
    Planar,
}

impl Format {
    /// Determines the format from the first [`HEAD_BYTES`] of a file. An npz file is reported as ZIP.
    pub(super) fn sniff(head: &[u8]) -> Option<Self> {
        // Offset and signature; short signatures last.
        const SIGNATURES: [(usize, &[u8], Format); 18] = [
            (0, NPY_MAGIC, Format::Npy),
            (0, b"II\x2a\0", Format::Tiff),
            (0, b"II\x2b\0", Format::Tiff),
            (0, b"MM\0\x2a", Format::Tiff),
            (0, b"MM\0\x2b", Format::Tiff),
            (0, b"\x89PNG\r\n\x1a\n", Format::Png),
            (0, b"\xff\xd8\xff", Format::Jpeg),
            (0, HDF5_MAGIC, Format::Hdf5),
            (0, b"MATLAB 7.3", Format::Hdf5),
            (0, b"PK\x03\x04", Format::Zip),
            (0, b"PK\x05\x06", Format::Zip),
            (257, b"ustar", Format::Tar),
            (0, b"\x76\x2f\x31\x01", Format::Exr),
            (0, PLANAR_MAGIC, Format::Planar),
            // Version and byte order of a MATLAB file.
            (124, b"\0\x01IM", Format::Mat),
            (124, b"\x01\0MI", Format::Mat),
            (0, b"BM", Format::Bmp),
            (0, b"P", Format::Pnm),
        ];
        let is_pnm = matches!(head, [_, b'1'..=b'7', b' ' | b'\n' | b'\r' | b'\t' | b'#', ..]);
        let found = SIGNATURES.iter().find(|(offset, signature, _)| {
            head.get(*offset..).is_some_and(|head| head.starts_with(signature))
        });
        found.map(|(.., format)| *format).filter(|format| *format != Self::Pnm || is_pnm)
    }
}

/// Describes a file of an unsupported format by its first bytes. `name` is that of the array in a line of Python.
pub(super) fn describe(head: &[u8], name: &str) -> String {
    if head.starts_with(b"\x1f\x8b") {
        return "it is compressed with gzip (to decompress it: python -c \"import gzip, shutil; \
                shutil.copyfileobj(gzip.open('in.gz'), open('out', 'wb'))\")"
            .to_owned();
    }
    let format = Format::sniff(head);
    if head.starts_with(b"GIF8") || format == Some(Format::Bmp) {
        return "it is a GIF or BMP, with 8 bits (to convert its grey values: python -c \"import numpy; from PIL import Image, ImageSequence; \
                numpy.save('out.npy', [numpy.array(page.convert('L')) for page in \
                ImageSequence.Iterator(Image.open('in.gif'))])\")"
            .to_owned();
    }
    if format == Some(Format::Jpeg) {
        return "it is a JPEG, which is lossy, so only true frames may be JPEG: save the pictures as PNG, TIFF or npy instead"
            .to_owned();
    }
    if format == Some(Format::Pnm) {
        return "it is a PNM (to convert its grey values: python -c \"import numpy; from PIL import Image; \
                a = numpy.array(Image.open('in.pgm')); g = a if a.ndim == 2 else (a @ [.299, .587, .114]).round(); \
                numpy.save('out.npy', g.astype(a.dtype if a.itemsize < 2 else 'u2'))\")"
            .to_owned();
    }
    if JPEG_2000.iter().any(|magic| head.starts_with(magic)) {
        return "it is a JPEG 2000 (to convert it: python -c \"import imagecodecs, numpy; numpy.save('out.npy', \
                imagecodecs.imread('in.jp2'))\")"
            .to_owned();
    }
    if is_level_4(head) {
        return format!(
            "it is a MATLAB level 4 file (to convert it: python -c \"import numpy, scipy.io; numpy.save('out.npy', \
             scipy.io.loadmat('in.mat')['{name}'])\")"
        );
    }
    let start: Vec<String> = head.iter().take(8).map(|b| format!("{b:02x}")).collect();
    format!("it starts with the bytes {}", start.join(" "))
}

/// True if the first bytes are those of a MATLAB level 4 file. The format has no signature. It starts with the type,
/// the numbers of rows and columns, a flag for imaginary parts, the length of the name, and the name.
fn is_level_4(head: &[u8]) -> bool {
    let Some((header, rest)) = head.split_first_chunk::<20>() else { return false };
    let (words, _) = header.as_chunks::<4>();
    // The thousands digit of the type is the byte order: 0 for little-endian, 1 for big-endian.
    [(u32::from_le_bytes as fn([u8; 4]) -> u32, 0), (u32::from_be_bytes, 1000)].iter().any(
        |(number, kinds)| {
            let [kind, rows, columns, imaginary, length] =
                [0, 1, 2, 3, 4].map(|i| number(words[i]));
            let name = (length as usize)
                .checked_sub(1)
                .and_then(|end| Some((rest.get(..end)?, rest.get(end)?)));
            (*kinds..=kinds + 52).contains(&kind)
                && rows > 0
                && columns > 0
                && imaginary <= 1
                && name.is_some_and(|(name, end)| {
                    let word = |byte: &u8| byte.is_ascii_alphanumeric() || *byte == b'_';
                    !name.is_empty() && name.iter().all(word) && *end == 0
                })
        },
    )
}
