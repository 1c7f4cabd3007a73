#![no_main]

mod file;

use sci_recon_core::formats::mat::{SceneArray, open_array};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    file::with_file(bytes, |path| {
        for array in [SceneArray::Masks, SceneArray::Measurements] {
            if let Ok(mut reader) = open_array(path, array, &file::LIMITS) {
                file::drain(&mut *reader);
            }
        }
    });
});
