//! Writes bytes to a file, for decoders that need a path.

use std::path::{Path, PathBuf};
use std::sync::LazyLock;

use formats::{FrameReader, Limits};

/// In memory if possible, because each run writes a file.
static PLACE: LazyLock<PathBuf> = LazyLock::new(|| {
    let folder = Path::new("/dev/shm");
    let folder = if folder.is_dir() { folder.to_owned() } else { std::env::temp_dir() };
    folder.join(format!("sci-recon-fuzz-{}", std::process::id()))
});

/// Small, so that an allocation of the size that a header claims exceeds the memory limit.
pub const LIMITS: Limits =
    Limits { max_file_bytes: 1 << 20, max_frames: 64, max_side: 512, max_voxels: 1 << 20 };

pub fn with_file(bytes: &[u8], run: impl FnOnce(&Path)) {
    std::fs::write(&*PLACE, bytes).expect("the fuzzer can write");
    run(&PLACE);
}

/// Reads all frames, like the check of an upload.
pub fn drain(reader: &mut dyn FrameReader) {
    let info = *reader.info();
    assert!(info.frames <= LIMITS.max_frames && info.voxels() <= LIMITS.max_voxels);
    while let Ok(Some(frame)) = reader.next_frame() {
        assert_eq!(frame.dim(), (info.height, info.width));
    }
}
