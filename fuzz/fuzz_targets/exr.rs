#![no_main]

mod file;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    file::with_file(bytes, |path| {
        let _ = formats::exr::read_stack(path, &file::LIMITS);
    });
});
