#![no_main]

use engine::job::{CalibrationId, JobRequest, Mosaic, SceneShape, Sequence, without_paths};

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    if let Ok(text) = std::str::from_utf8(bytes) {
        let _ = without_paths(text);
    }
    let Ok(request) = serde_json::from_slice::<JobRequest>(bytes) else { return };
    let mosaic = (bytes.len() % 2 == 0).then_some(Mosaic::Rggb);
    let shape = SceneShape { frames: 8, height: 512, width: 512, snapshots: 3, mosaic };
    // An accepted request must be plannable.
    if let Ok(spec) = request.resolve(CalibrationId::new(), shape, Sequence::Contiguous, None) {
        assert!(spec.tile_plan().is_ok());
        assert!(spec.disk_bytes() > 0 && spec.worker_bytes() > 0);
    }
});
