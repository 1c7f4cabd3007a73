//! When the frames were seen.

use serde::{Deserialize, Serialize};

/// What the camera told about time.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct CameraRecord {
    /// Snapshots a second.
    pub fps: Option<f64>,
    /// Seconds that one snapshot is exposed.
    pub exposure_s: Option<f64>,
    /// Start of each frame in seconds after the start of snapshot 0; none where it does not
    /// follow from the two.
    pub frame_times_s: Option<Vec<f64>>,
}

impl CameraRecord {
    /// The times of the `frames` frames of a snapshot.
    ///
    /// The masks share the exposure evenly; an unknown exposure is taken to fill the camera's
    /// whole period. Without a frame rate only snapshot 0 has times.
    pub fn new(
        fps: Option<f64>,
        exposure_s: Option<f64>,
        snapshot: usize,
        frames: usize,
    ) -> Option<Self> {
        let exposure = exposure_s.or_else(|| fps.map(|fps| 1.0 / fps))?;
        let start = match (fps, snapshot) {
            (Some(fps), _) => Some(snapshot as f64 / fps),
            (None, 0) => Some(0.0),
            (None, _) => None,
        };
        let time =
            |start: f64| (0..frames).map(move |k| start + exposure * k as f64 / frames as f64);
        Some(Self { fps, exposure_s, frame_times_s: start.map(|start| time(start).collect()) })
    }

    /// Seconds that each of `frames` frames lasts.
    pub fn frame_exposure_s(&self, frames: usize) -> Option<f64> {
        let exposure = self.exposure_s.or_else(|| self.fps.map(|fps| 1.0 / fps))?;
        Some(exposure / frames as f64)
    }
}

#[cfg(test)]
mod tests {
    use super::CameraRecord;

    #[test]
    fn frame_times_share_the_exposure() {
        let camera = CameraRecord::new(Some(50.0), Some(0.016), 2, 4).unwrap();
        let times = camera.frame_times_s.clone().unwrap();
        let expected = [0.040, 0.044, 0.048, 0.052];
        assert!(times.iter().zip(expected).all(|(a, b)| (a - b).abs() < 1e-12), "{times:?}");
        assert_eq!(camera.frame_exposure_s(4), Some(0.004));
        let full = CameraRecord::new(Some(50.0), None, 0, 4).unwrap();
        assert_eq!(full.frame_times_s.unwrap()[1], 0.005);
        assert_eq!(CameraRecord::new(None, Some(0.01), 1, 4).unwrap().frame_times_s, None);
        assert_eq!(CameraRecord::new(None, None, 0, 4), None);
    }
}
