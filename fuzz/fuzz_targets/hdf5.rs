#![no_main]

mod file;

use formats::mat::SceneArray;
use formats::{Wanted, open_array};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    // The first bytes choose the decoder; here it is always this one.
    let magic = b"\x89HDF\r\n\x1a\n".as_slice();
    let whole = if bytes.starts_with(magic) { bytes.to_vec() } else { [magic, bytes].concat() };
    file::with_file(&whole, |path| {
        for name in ["data", "group/data"] {
            let wanted = Wanted { name: Some(name), ..SceneArray::Masks.into() };
            if let Ok(mut reader) = open_array(path, wanted, &file::LIMITS) {
                file::drain(&mut *reader);
            }
        }
    });
});
