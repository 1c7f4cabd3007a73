//! Lists, idempotency keys, and removal of unused things.

use std::io::Write;
use std::time::Duration;

use futures_util::FutureExt;

use super::{Lab, new_request};
use crate::{
    Checked, Inserted, JobFilter, NewCalibration, NewMeasurement, NewModel, Product, StoreError,
};
use engine::job::{
    CalibrationId, CalibrationRequest, JobId, MeasurementId, MeasurementRequest, ModelFacts,
    ModelId, ModelRequest, ModelTrial, Submission, Timestamp,
};

#[tokio::test]
async fn a_key_makes_one_job() {
    let lab = Lab::new().await;
    let Inserted::New(first) = lab.add(0, Some("k"), b"a").await.unwrap() else { panic!() };
    assert_eq!(lab.add(0, Some("k"), b"a").await.unwrap(), Inserted::Before(first));
    let other = lab.add(0, Some("k"), b"b").await;
    assert!(matches!(other, Err(StoreError::KeyReused { id, .. }) if id == first.to_string()));
    assert_eq!(
        lab.store
            .jobs(Some(&engine::job::Lab::local()), &JobFilter::default(), 10)
            .await
            .unwrap()
            .items
            .len(),
        1
    );
}

#[tokio::test]
async fn pages_join_without_gaps() {
    let lab = Lab::new().await;
    let mut ids = Vec::new();
    for _ in 0..5 {
        ids.push(lab.submit(0).await);
    }
    ids.reverse();
    let mut filter = JobFilter::default();
    let mut seen = Vec::new();
    loop {
        let page = lab.store.jobs(Some(&engine::job::Lab::local()), &filter, 2).await.unwrap();
        seen.extend(page.items.iter().map(|job| job.id));
        filter.after = seen.last().copied();
        if !page.more {
            break;
        }
    }
    assert_eq!(seen, ids);
}

#[tokio::test]
async fn used_things_are_kept_and_unused_ones_collected() {
    let lab = Lab::new().await;
    let job = lab.submit(0).await;
    let calibration =
        lab.store.job(&engine::job::Lab::local(), job).await.unwrap().spec.calibration;
    let in_use = |result| matches!(result, Err(StoreError::InUse { users: 1, .. }));
    assert!(in_use(lab.store.delete(&engine::job::Lab::local(), calibration).await));
    assert!(in_use(lab.store.delete(&engine::job::Lab::local(), lab.measurement).await));
    let soon = Timestamp(Timestamp::now().0 + 1000);
    assert_eq!(lab.store.collect(soon).await.unwrap().len(), 0);
    lab.store.cancel_job(&engine::job::Lab::local(), job).await.unwrap();
    lab.store.delete_job(&engine::job::Lab::local(), job).await.unwrap();
    lab.store.delete(&engine::job::Lab::local(), lab.measurement).await.unwrap();
    lab.store.delete(&engine::job::Lab::local(), calibration).await.unwrap();
    assert_eq!(lab.store.blob_totals().await.unwrap().0, 2, "uploads wait for their age");
    assert_eq!(lab.store.collect(soon).await.unwrap().len(), 2);
    let left = walk(&lab.store.dir().blobs());
    assert_eq!(left, Vec::<std::path::PathBuf>::new());
}

pub(super) fn walk(folder: &std::path::Path) -> Vec<std::path::PathBuf> {
    let entries = std::fs::read_dir(folder).unwrap().map(|entry| entry.unwrap().path());
    entries.flat_map(|path| if path.is_dir() { walk(&path) } else { vec![path] }).collect()
}

#[tokio::test]
async fn dark_frames_and_maps_are_kept_while_something_was_made_with_them() {
    let lab = Lab::new().await;
    let local = engine::job::Lab::local();
    let mut uploads = Vec::new();
    for content in [&b"masks with a map"[..], b"map", b"bright data", b"dark"] {
        uploads.push(lab.upload(content).await);
    }
    let [masks, map, data, dark] = uploads[..] else { panic!() };
    let prepared = |content: &str| match lab.blob(content) {
        Product::File(staged) => staged,
        _ => panic!(),
    };
    let measured = lab.store.measurement(&local, lab.measurement).await.unwrap().facts;
    let calibrated = lab.store.calibration(&local, measured.calibration).await.unwrap().facts;
    let asked = CalibrationRequest {
        masks: Some(masks),
        bad_pixels: Some(map),
        ..CalibrationRequest::default()
    };
    let passed =
        Checked::Masks(Box::new(NewCalibration { masks, ..calibrated }), prepared("masks"));
    let calibration: CalibrationId = lab.make(Submission::Calibration(asked), passed).await;
    lab.work_off().await;
    let dark_frames = vec![dark];
    let asked = MeasurementRequest {
        dark: dark_frames.clone(),
        ..MeasurementRequest::new(None, calibration, data)
    };
    let facts = NewMeasurement { calibration, data, dark: dark_frames, ..measured };
    let passed = Checked::Measurement(Box::new(facts), prepared("snapshots"));
    let measurement: MeasurementId = lab.make(Submission::Measurement(asked), passed).await;
    let soon = Timestamp(Timestamp::now().0 + 1000);
    assert_eq!(lab.store.collect(soon).await.unwrap(), []);
    for upload in [masks, map, data, dark] {
        let refused = lab.store.delete_upload(&local, upload).await;
        assert!(matches!(refused, Err(StoreError::FileInUse(_))), "{refused:?}");
    }
    lab.store.delete(&local, measurement).await.unwrap();
    lab.store.delete(&local, calibration).await.unwrap();
    assert_eq!(lab.store.collect(soon).await.unwrap().len(), 4);
}

#[tokio::test]
async fn a_job_is_kept_until_the_calibration_from_it_is_made() {
    let lab = Lab::new().await;
    let local = engine::job::Lab::local();
    let job = lab.submit(0).await;
    lab.store.cancel_job(&local, job).await.unwrap();
    let asked = CalibrationRequest { registration_of: Some(job), ..CalibrationRequest::default() };
    let new = new_request(Submission::Calibration(asked));
    let made = lab.store.request::<CalibrationId>((&local, None), &new, None).await.unwrap();
    let refused = lab.store.delete_job(&local, job).await.unwrap_err();
    assert!(matches!(refused, StoreError::JobInUse(by) if by == made.id()), "{refused}");
    assert!(refused.to_string().contains(&made.id().to_string()), "{refused}");
    lab.store.delete(&local, made.id()).await.unwrap();
    lab.store.delete_job(&local, job).await.unwrap();
    let late = lab.store.request::<CalibrationId>((&local, None), &new, None).await;
    assert!(matches!(late, Err(StoreError::NotFound { what: "job", .. })), "{late:?}");
}

#[tokio::test]
async fn the_file_of_a_model_is_kept_and_its_calibration_too() {
    let lab = Lab::new().await;
    let local = engine::job::Lab::local();
    let mut writer = lab.store.blob_writer().unwrap();
    writer.write_all(b"network").unwrap();
    let (file, _) = lab.store.store_upload(&local, None, writer.finish().unwrap()).await.unwrap();
    let calibration =
        lab.store.measurement(&local, lab.measurement).await.unwrap().facts.calibration;
    let trial = ModelTrial { height: 64, width: 96, cpu_seconds: 1.0, peak_rss_bytes: 1 << 20 };
    let facts = ModelFacts { inputs: Vec::new(), outputs: Vec::new(), fixed_size: true, trial };
    let asked = ModelRequest { name: None, calibration, file: file.sha256 };
    let facts = NewModel { calibration, file: file.sha256, facts };
    let id: ModelId = lab.make(Submission::Model(asked), Checked::Model(facts)).await;
    let model = lab.store.model(&local, id).await.unwrap();
    lab.store.delete(&local, lab.measurement).await.unwrap();
    let soon = Timestamp(Timestamp::now().0 + 1000);
    assert_eq!(lab.store.collect(soon).await.unwrap().len(), 1, "the data of the measurement");
    assert!(lab.store.upload(&local, file.sha256).await.is_ok());
    let refused = lab.store.delete(&local, calibration).await;
    assert!(matches!(refused, Err(StoreError::InUse { by: "models", users: 1, .. })));
    lab.store.delete(&local, model.id).await.unwrap();
    assert_eq!(lab.store.collect(soon).await.unwrap().len(), 1, "the network");
    lab.store.delete(&local, calibration).await.unwrap();
}

/// True if the job exists with all its files, or neither it nor a file of it.
async fn is_whole(lab: &Lab, id: JobId) -> bool {
    let folder = lab.store.dir().results(id);
    let Ok(job) = lab.store.job(&engine::job::Lab::local(), id).await else {
        return !folder.exists();
    };
    for snapshot in [Some(0), Some(1), None] {
        for file in lab.store.result_files(&job, snapshot).await.unwrap() {
            let name = &file.file.name;
            if !file.is_derived && lab.store.open_result(&job, snapshot, name).await.is_err() {
                return false;
            }
        }
    }
    folder.exists()
}

#[tokio::test]
async fn a_deletion_that_is_broken_off_leaves_no_job_without_files() {
    let lab = Lab::new().await;
    let local = engine::job::Lab::local();
    let (mut deleted, mut left) = (0, 0);
    for steps in 0.. {
        let id = lab.submit(0).await;
        lab.work_off().await;
        let ended = {
            let mut deletion = Box::pin(lab.store.delete_job(&local, id));
            let mut ended = false;
            for _ in 0..steps {
                ended = (&mut deletion).now_or_never().is_some();
                if ended {
                    break;
                }
                tokio::time::sleep(Duration::from_millis(2)).await;
            }
            ended
        };
        // Work on files that has begun goes on.
        tokio::time::sleep(Duration::from_millis(20)).await;
        let is_there = lab.store.job(&local, id).await.is_ok();
        assert!(!is_there || is_whole(&lab, id).await, "a job without files after {steps} steps");
        // As at the next start.
        lab.store.finish_removals().await.unwrap();
        assert!(is_whole(&lab, id).await, "after {steps} steps");
        if is_there {
            left += 1
        } else {
            deleted += 1
        }
        if ended {
            break;
        }
    }
    assert!(deleted > 0 && left > 0, "{deleted} {left}");
    assert_eq!(lab.store.quarantine_orphans(false).await.unwrap(), 0);
}
