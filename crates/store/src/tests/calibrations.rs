//! Calibrations in the queue: the same rules as for the tasks of jobs.

use std::time::Duration;

use serde_json::json;

use super::{LEASE, Lab, new_request};
use crate::{
    CalibrationDone, Checked, ClaimedTask, Completion, FoundResource, Heartbeat, MAX_FAILURES,
    NewCalibration, Product, Request, StoreError, Work, WorkerEnd,
};
use engine::job::{
    CalibrationId, CalibrationRequest, Captures, Mosaic, Submission, TaskKind, TaskProgress,
    TaskState,
};

/// The product of a worker for existing masks.
pub(super) fn report() -> CalibrationDone {
    let report = json!({
        "schema": "test", "grade": "good", "findings": [], "frames": 8, "height": 64, "width": 96,
        "masks": {
            "mean": 0.5, "deviation": 0.5, "percentile_1": 0.0, "percentile_99": 1.0,
            "frame_means": [], "correlation": [], "correlation_mean": null,
            "correlation_largest": null, "gram": [1.0, 2.0, 3.0], "dead_pixels": 0,
            "stuck_pixels": 0, "values_at_zero": 0,
        },
        "captures": null, "maps": ["mean"],
    });
    CalibrationDone {
        masks: None,
        report: serde_json::from_value(report).unwrap(),
        maps: vec![("mean".into(), b"png".to_vec())],
    }
}

impl Lab {
    async fn calibrate(&self) -> CalibrationId {
        let mut uploads = Vec::new();
        for name in [&b"first"[..], b"second", b"white", b"black"] {
            uploads.push(self.upload(name).await);
        }
        let captures = Captures {
            masks: vec![vec![uploads[0]], vec![uploads[1]]],
            white: vec![uploads[2]],
            black: vec![uploads[3]],
            black_with_mask: Vec::new(),
            patterns: None,
            saturation: None,
        };
        let asked = CalibrationRequest {
            name: Some("optics of May".parse().unwrap()),
            captures: Some(captures),
            mosaic: Some(Mosaic::Gbrg),
            ..CalibrationRequest::default()
        };
        self.make(Submission::Calibration(asked), Checked::Captures(2.5)).await
    }

    async fn unready(&self, id: CalibrationId) -> Option<Request> {
        match self.store.resource(&engine::job::Lab::local(), id).await.unwrap() {
            FoundResource::Ready(_) => None,
            FoundResource::Pending(request) => Some(*request),
        }
    }

    /// Why there will be no masks.
    async fn error(&self, id: CalibrationId) -> Option<String> {
        self.unready(id).await.unwrap().refusal.map(|refusal| refusal.detail)
    }

    /// Completes a calibration of captures as a worker would.
    async fn made(&self, task: &ClaimedTask) -> Heartbeat {
        let Product::File(masks) = self.blob("masks of captures") else { panic!() };
        let facts = NewCalibration {
            masks: masks.sha256(),
            format: "captures".into(),
            sample: "uint16".into(),
            axes: None,
            frames: 2,
            height: 64,
            width: 96,
            full_scale: 1.0,
            mask_mean: 0.5,
            dead_pixels: 0,
            clipped_negatives: 0,
            mosaic: None,
            reading: None,
            dispersion: None,
            corrected: None,
        };
        let done = CalibrationDone { masks: Some((facts, masks)), ..report() };
        let completion = Completion {
            progress: TaskProgress::START,
            record: json!(null),
            product: Product::Calibration(Box::new(done)),
        };
        self.store.complete(&task.lease, completion).await.unwrap()
    }
}

#[tokio::test]
async fn a_calibration_precedes_the_jobs_of_its_lab_and_is_visible() {
    let lab = Lab::new().await;
    let local = engine::job::Lab::local();
    let job = lab.submit(0).await;
    let (first, second) = (lab.calibrate().await, lab.calibrate().await);
    let counts = lab.store.task_counts().await.unwrap();
    assert_eq!(counts[&("calibration".into(), TaskState::Ready)], 2);
    let task = lab.claim().await.unwrap();
    let Work::Calibration(calibration) = &task.work else { panic!() };
    assert_eq!((task.kind, calibration.calibration), (TaskKind::Calibration, first));
    assert_eq!(task.cost, 2.5);
    assert_eq!(calibration.captures.as_ref().unwrap().masks.len(), 2);
    let worker = lab.store.live_workers(LEASE).await.unwrap().remove(0).task.unwrap();
    assert_eq!((worker.job, worker.calibration), (None, Some(first)));
    let half = TaskProgress { fraction: 0.5, ..TaskProgress::START };
    assert_eq!(lab.store.heartbeat(&task.lease, half, None).await.unwrap(), Heartbeat::Continue);
    let shown = lab.unready(first).await.unwrap();
    assert_eq!((shown.fraction, shown.refusal), (0.5, None));
    let refused = lab.store.calibration(&local, first).await;
    assert!(matches!(refused, Err(StoreError::NotReady { error: None, .. })));
    // Jobs are forecast and watched as if there were no calibrations.
    let waiting = lab.store.job(&local, job).await.unwrap();
    assert_eq!(lab.store.progress(&waiting).await.unwrap().queue_position, Some(1));

    assert_eq!(lab.made(&task).await, Heartbeat::Continue);
    assert!(lab.unready(first).await.is_none());
    let made = lab.store.calibration(&local, first).await.unwrap();
    assert_eq!((made.created_at, made.facts.frames), (shown.created_at, 2));
    assert_eq!(made.facts.mosaic, Some(Mosaic::Gbrg), "as it was asked for");
    let inputs = made.inputs();
    assert_eq!(inputs.masks_sha256, made.facts.masks);
    assert_eq!(inputs.calibration["captures"], json!(calibration.captures));
    assert!(lab.store.report(first).await.unwrap().is_some());
    assert_eq!(lab.store.map(first, "mean").await.unwrap().unwrap(), b"png");
    let done = |kind: &str| kind == "calibration";
    let totals = lab.store.totals().await.unwrap();
    assert_eq!(totals.iter().find(|total| done(&total.kind)).unwrap().tasks, 2);
    assert_eq!(lab.claim().await.unwrap().kind, TaskKind::Calibration);
    assert_eq!(lab.claim().await.unwrap().step().job, job);
    lab.store.delete(&local, second).await.unwrap();
}

#[tokio::test]
async fn a_worker_of_a_deleted_calibration_stops() {
    let lab = Lab::new().await;
    let local = engine::job::Lab::local();
    let id = lab.calibrate().await;
    let task = lab.claim().await.unwrap();
    lab.store.delete(&local, id).await.unwrap();
    let again = lab.store.delete(&local, id).await;
    assert!(matches!(again, Err(StoreError::NotFound { .. })));
    let beat = lab.store.heartbeat(&task.lease, TaskProgress::START, None).await.unwrap();
    assert_eq!(beat, Heartbeat::Lost);
    assert_eq!(lab.made(&task).await, Heartbeat::Lost);
    lab.store.give_back(&task.lease).await.unwrap();
    assert!(lab.claim().await.is_none());
    assert!(matches!(lab.store.calibration(&local, id).await, Err(StoreError::NotFound { .. })));
    // Six uploads, and the products of two.
    assert_eq!(lab.store.blob_totals().await.unwrap().0, 8);
}

#[tokio::test]
async fn a_calibration_is_retried_and_then_fails_with_its_last_reason() {
    let lab = Lab::new().await;
    let id = lab.calibrate().await;
    for attempt in 1..=MAX_FAILURES {
        lab.skip_pauses().await;
        let task = lab.claim().await.unwrap();
        assert_eq!(task.lease.attempt, attempt);
        assert_eq!(lab.error(id).await, None);
        assert_eq!(lab.store.report_failure(id).await.unwrap(), None);
        lab.store.fail(&task.lease, &format!("no disk, {attempt}"), true).await.unwrap();
    }
    assert_eq!(lab.error(id).await.unwrap(), "no disk, 3");
    assert_eq!(lab.store.report_failure(id).await.unwrap().unwrap(), "no disk, 3");
    let attempts: Vec<(String, String)> = sqlx::query_as(
        "SELECT outcome, reason FROM attempts WHERE outcome = 'failed' ORDER BY attempt",
    )
    .fetch_all(&lab.store.readers)
    .await
    .unwrap();
    assert_eq!(attempts.len(), 3);
    assert!(lab.claim().await.is_none());
    let other = lab.calibrate().await;
    let task = lab.claim().await.unwrap();
    lab.store.fail(&task.lease, "no light", false).await.unwrap();
    assert_eq!(lab.error(other).await.unwrap(), "no light");
}

#[tokio::test]
async fn a_calibration_outlives_its_workers() {
    let lab = Lab::new().await;
    let id = lab.calibrate().await;
    let late = lab.store.claim(lab.worker, Duration::from_millis(1)).await.unwrap().unwrap();
    tokio::time::sleep(Duration::from_millis(20)).await;
    let again = lab.claim().await.unwrap();
    assert_eq!((again.lease.task, again.lease.attempt), (late.lease.task, 2));
    assert_eq!(lab.made(&late).await, Heartbeat::Lost);
    lab.store.worker_ended(lab.worker, &WorkerEnd::Crashed("signal 11".into())).await.unwrap();
    assert_eq!(lab.error(id).await, None);
    assert!(lab.claim().await.is_none(), "after a crash it waits");
    // A pause that ends far in the future was noted before the clock was set back; so was a lease.
    let forward = "UPDATE tasks SET ready_at = ready_at + 86400000 WHERE thing IS NOT NULL";
    sqlx::query(forward).execute(&lab.store.writer).await.unwrap();
    assert_eq!(lab.claim().await.unwrap().lease.attempt, 3);
    let forward = "UPDATE tasks SET lease_until = lease_until + 86400000 WHERE state = 'running'";
    sqlx::query(forward).execute(&lab.store.writer).await.unwrap();
    let task = lab.claim().await.unwrap();
    assert_eq!(task.lease.attempt, 4);
    assert_eq!(lab.made(&task).await, Heartbeat::Continue);
}

#[tokio::test]
async fn missing_captures_are_named() {
    let lab = Lab::new().await;
    let gone = engine::job::Sha256::of(b"gone");
    let captures = Captures {
        masks: vec![vec![gone]],
        white: vec![gone],
        black: vec![gone],
        black_with_mask: Vec::new(),
        patterns: None,
        saturation: None,
    };
    let whose = (&engine::job::Lab::local(), None);
    let asked = CalibrationRequest { captures: Some(captures), ..CalibrationRequest::default() };
    let asked = new_request(Submission::Calibration(asked));
    let refused = lab.store.request::<CalibrationId>(whose, &asked, None).await;
    assert!(matches!(refused, Err(StoreError::NotFound { what: "blob", id })
        if id == gone.to_string()));
    assert!(lab.claim().await.is_none());
}
