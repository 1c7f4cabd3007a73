#![no_main]

mod file;

use formats::{open_colours, open_shown};

// The corpus has JPEG, BMP and PNM.
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    file::with_file(bytes, |path| {
        if let Ok(mut reader) = open_shown(path, &file::LIMITS) {
            file::drain(&mut *reader);
        }
        if let Ok(Some(mut reader)) = open_colours(path, &file::LIMITS) {
            while let Ok(Some(_)) = reader.next_frame() {}
        }
    });
});
