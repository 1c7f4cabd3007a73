//! What a server takes up again that the one before has left.

use super::app::App;
use super::calibrations::CalibrationRequest;
use super::checks::resume;
use super::measurements::MeasurementRequest;
use store::{Made, StoreError};

impl App {
    /// Begins again the checks that the server before did not bring to their end. To be called before the first
    /// request.
    pub async fn resume_checks(&self) -> Result<(), StoreError> {
        for check in self.store.open_checks(Made::Calibration).await? {
            tokio::spawn(resume::<CalibrationRequest>(self.clone(), check));
        }
        for check in self.store.open_checks(Made::Measurement).await? {
            tokio::spawn(resume::<MeasurementRequest>(self.clone(), check));
        }
        Ok(())
    }
}
