//! The formats, told apart by the first bytes of a file.

use strum::Display;

/// The first bytes of every npy file.
pub(super) const NPY_MAGIC: &[u8] = b"\x93NUMPY";
/// The first bytes of an HDF5 file that begins without a block of its writer's.
const HDF5_MAGIC: &[u8] = b"\x89HDF\r\n\x1a\n";
/// The first bytes of our own prepared arrays.
pub(super) const PLANAR_MAGIC: &[u8] = b"SCIPLNR\0";

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
    /// OpenEXR.
    #[strum(serialize = "EXR")]
    Exr,
    /// Our own prepared arrays ([`super::planar`]).
    #[strum(serialize = "planar")]
    Planar,
}

impl Format {
    /// The format whose signature these first bytes (128 suffice) carry.
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
    if head.starts_with(b"PK\x03\x04") {
        return "it is a zip archive, perhaps .npz (python -c \"import numpy; numpy.save('out.npy', \
                numpy.load('in.npz')['NAME'])\" saves one array)"
            .to_owned();
    }
    if head.starts_with(b"\xff\xd8\xff") {
        return "it is a JPEG, which changes the values it stores".to_owned();
    }
    let start: Vec<String> = head.iter().take(8).map(|b| format!("{b:02x}")).collect();
    format!("it begins with the bytes {}", start.join(" "))
}
