#![no_main]

use sci_recon::http::tus::headers::{Checksum, metadata};

libfuzzer_sys::fuzz_target!(|text: &str| {
    if let Ok(pairs) = metadata(text) {
        assert!(pairs.len() <= text.len());
    }
    if let Ok(mut checksum) = Checksum::parse(text) {
        checksum.update(text.as_bytes());
        let _ = checksum.holds();
    }
});
