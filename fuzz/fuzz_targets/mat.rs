#![no_main]

mod file;

use formats::mat::SceneArray;
use formats::{Axes, Expected, Wanted, open_array};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    file::with_file(bytes, |path| {
        for (array, axes) in [
            (SceneArray::Masks, Axes::RowColumnFrame),
            (SceneArray::Measurements, Axes::FrameRowColumn),
        ] {
            let expected = Expected { axes: Some(axes), ..Expected::default() };
            let wanted = Wanted { expected, ..array.into() };
            if let Ok(mut reader) = open_array(path, wanted, &file::LIMITS) {
                file::drain(&mut *reader);
            }
        }
    });
});
