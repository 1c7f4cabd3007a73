#![no_main]

mod file;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    // The first bytes choose the decoder; here it is always this one.
    let magic = b"\x93NUMPY".as_slice();
    let whole = if bytes.starts_with(magic) { bytes.to_vec() } else { [magic, bytes].concat() };
    file::with_file(&whole, |path| {
        if let Ok(mut reader) = formats::open_stack(path, &file::LIMITS) {
            file::drain(&mut *reader);
        }
    });
});
