#![no_main]

mod file;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    file::with_file(bytes, |path| {
        if let Ok(reader) = formats::planar::Reader::open(path, &file::LIMITS) {
            let (height, width) = (reader.info().height, reader.info().width);
            let _ = reader.read_window(0..1, 0..height, 0..width);
        }
    });
});
