//! The formats, told apart by the first bytes of a file.

use strum::Display;

/// The first bytes of every npy file.
pub(super) const NPY_MAGIC: &[u8] = b"\x93NUMPY";
/// The first bytes of an HDF5 file that begins without a block of its writer's.
const HDF5_MAGIC: &[u8] = b"\x89HDF\r\n\x1a\n";
/// The first bytes of our own prepared arrays.
pub(super) const PLANAR_MAGIC: &[u8] = b"SCIPLNR\0";

/// As many first bytes tell all formats.
pub(super) const HEAD_BYTES: u64 = 512;
/// Where the signature of a tar archive stands, and what it begins with.
const TAR_MAGIC: (usize, &[u8]) = (257, b"ustar");

/// A file format that is read or written here.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Hash, Display)]
pub enum Format {
    /// NumPy's array file.
    #[strum(serialize = "npy")]
    Npy,
    /// TIFF and BigTIFF, one frame a page.
    #[strum(serialize = "TIFF")]
    Tiff,
    /// PNG, one frame.
    #[strum(serialize = "PNG")]
    Png,
    /// MATLAB's level 5 array file.
    #[strum(serialize = ".mat")]
    Mat,
    /// HDF5, and MATLAB's level 7.3 array file, which is HDF5.
    #[strum(serialize = "HDF5")]
    Hdf5,
    /// A ZIP archive: of numbered pictures, or [`Format::Npz`].
    #[strum(serialize = "ZIP")]
    Zip,
    /// A ZIP archive of npy files.
    #[strum(serialize = "npz")]
    Npz,
    /// A tar archive of numbered pictures.
    #[strum(serialize = "tar")]
    Tar,
    /// OpenEXR.
    #[strum(serialize = "EXR")]
    Exr,
    /// Our own prepared arrays ([`super::planar`]).
    #[strum(serialize = "planar")]
    Planar,
}

impl Format {
    /// The format whose signature these first bytes ([`HEAD_BYTES`] suffice) carry. An npz is a ZIP here.
    pub(super) fn sniff(head: &[u8]) -> Option<Self> {
        const BIG_ENDIAN_MAT: &[u8] = &[1, 0, b'M', b'I'];
        const LITTLE_ENDIAN_MAT: &[u8] = &[0, 1, b'I', b'M'];
        let tiff: [&[u8]; 4] = [b"II\x2a\0", b"II\x2b\0", b"MM\0\x2a", b"MM\0\x2b"];
        if head.starts_with(NPY_MAGIC) {
            Some(Self::Npy)
        } else if tiff.iter().any(|magic| head.starts_with(magic)) {
            Some(Self::Tiff)
        } else if head.starts_with(b"\x89PNG\r\n\x1a\n") {
            Some(Self::Png)
        } else if head.starts_with(HDF5_MAGIC) || head.starts_with(b"MATLAB 7.3") {
            Some(Self::Hdf5)
        } else if head.starts_with(b"PK\x03\x04") || head.starts_with(b"PK\x05\x06") {
            Some(Self::Zip)
        } else if head.get(TAR_MAGIC.0..).is_some_and(|head| head.starts_with(TAR_MAGIC.1)) {
            Some(Self::Tar)
        } else if head.starts_with(&[0x76, 0x2f, 0x31, 0x01]) {
            Some(Self::Exr)
        } else if head.starts_with(PLANAR_MAGIC) {
            Some(Self::Planar)
        } else {
            match head.get(124..128) {
                Some(version) if version == LITTLE_ENDIAN_MAT || version == BIG_ENDIAN_MAT => {
                    Some(Self::Mat)
                }
                _ => None,
            }
        }
    }
}

/// What a file of an unknown format begins with.
pub(super) fn describe(head: &[u8]) -> String {
    if head.starts_with(b"\x1f\x8b") {
        return "it is packed by gzip (python -c \"import gzip, shutil; \
                shutil.copyfileobj(gzip.open('in.gz'), open('out', 'wb'))\" unpacks it)"
            .to_owned();
    }
    if head.starts_with(b"GIF8") || head.starts_with(b"BM") {
        return "it is a GIF or BMP (python -c \"import numpy; from PIL import Image, ImageSequence; \
                numpy.save('out.npy', [numpy.array(page.convert('L')) for page in \
                ImageSequence.Iterator(Image.open('in.gif'))])\" saves its grey values)"
            .to_owned();
    }
    if head.starts_with(b"\xff\xd8\xff") {
        return "it is a JPEG, which changes the values it stores".to_owned();
    }
    if is_level_4(head) {
        return "it is a MATLAB file of level 4 (python -c \"import numpy, scipy.io; numpy.save('out.npy', \
                scipy.io.loadmat('in.mat')['mask'])\")"
            .to_owned();
    }
    let start: Vec<String> = head.iter().take(8).map(|b| format!("{b:02x}")).collect();
    format!("it begins with the bytes {}", start.join(" "))
}

/// Whether a file begins as MATLAB's level 4 does, which has no signature: with the kind of numbers, rows, columns,
/// whether there are imaginary parts, and the length of a name, which follows.
fn is_level_4(head: &[u8]) -> bool {
    let Some((header, rest)) = head.split_first_chunk::<20>() else { return false };
    let (words, _) = header.as_chunks::<4>();
    // The thousands of the kind tell the order of bytes: 0 for little-endian, 1 for big-endian.
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
