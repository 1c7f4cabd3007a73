#![no_main]

mod file;

use formats::mat::SceneArray;
use formats::{Axes, Expected, Wanted, open_array, open_stack};

// The corpus has both kinds of archives, with arrays and with images.
libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    file::with_file(bytes, |path| {
        if let Ok(mut reader) = open_stack(path, &file::LIMITS) {
            file::drain(&mut *reader);
        }
        let expected = Expected { axes: Some(Axes::ColumnRowFrame), ..Expected::default() };
        let wanted = Wanted { expected, ..SceneArray::Masks.into() };
        if let Ok(mut reader) = open_array(path, wanted, &file::LIMITS) {
            file::drain(&mut *reader);
        }
    });
});
