//! The queue as workers see it: the whole life of a job, and every way in which it can be disturbed.

mod calibrations;
mod checks;
mod failures;
mod keeping;
mod migration;
mod movies;
mod notifications;
mod remote;
mod sequences;
mod statements;
mod totals;
mod turns;

use std::io::Write;
use std::str::FromStr;
use std::time::Duration;

use serde_json::{Value, json};
use tempfile::TempDir;

use super::{
    Checked, Claimant, ClaimedTask, Completion, Heartbeat, Inserted, JobTask, NewCalibration,
    NewJob, NewMeasurement, NewRequest, Product, Purpose, RequestKey, StagedDir, Store, StoreError,
    Work, WorkerEnd, WorkerPlace,
};
use engine::job::{
    Algorithm, CalibrationRequest, CheckLimits, InvalidId, JobId, JobRequest, JobState,
    MeasurementId, MeasurementRequest, Reading, ResourceId, ResultFile, ScaleBasis, Sequence,
    Sha256, SnapshotSelection, Submission, TaskKind, TaskProgress, TileSpec, WorkerId, WrittenFile,
};

const LEASE: Duration = Duration::from_secs(60);

impl Store {
    /// Hands out the next task to a worker of this machine that takes all kinds.
    async fn claim(
        &self,
        worker: WorkerId,
        length: Duration,
    ) -> Result<Option<ClaimedTask>, StoreError> {
        self.claim_as(Claimant::Local, worker, length).await
    }
}

impl ClaimedTask {
    /// The step of a job.
    fn step(&self) -> &JobTask {
        let Work::Job(task) = &self.work else { panic!("{:?}", self.work) };
        task
    }
}

fn file(folder: &StagedDir, name: &str, content: &str) -> WrittenFile {
    std::fs::write(folder.path().join(name), content).unwrap();
    let sha256 = Sha256::of(content.as_bytes());
    let file = ResultFile { name: name.into(), size: content.len() as u64, sha256 };
    WrittenFile { file, crc32: 0, is_derived: false }
}

struct Lab {
    store: Store,
    measurement: MeasurementId,
    worker: WorkerId,
    _folder: TempDir,
}

impl Lab {
    /// A store with a calibration of 64x96 pixels and a measurement of two snapshots.
    async fn new() -> Self {
        let folder = tempfile::tempdir().unwrap();
        let store =
            Store::open(folder.path(), Purpose::Serve { accept_database: false }).await.unwrap();
        let upload = |bytes: &[u8]| {
            let mut writer = store.blob_writer().unwrap();
            writer.write_all(bytes).unwrap();
            writer.finish().unwrap()
        };
        let local = engine::job::Lab::local();
        let (masks, _) = store.store_upload(&local, None, upload(b"masks")).await.unwrap();
        let (data, _) = store.store_upload(&local, None, upload(b"data")).await.unwrap();
        let facts = NewCalibration {
            masks: masks.sha256,
            format: "npy".into(),
            sample: "float32".into(),
            axes: None,
            frames: 8,
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
        let asked = CalibrationRequest { masks: Some(masks.sha256), ..Default::default() };
        let worker = WorkerId::new();
        store.worker_started(worker, 1, &WorkerPlace::default(), Claimant::Local).await.unwrap();
        let asked = Submission::Calibration(asked);
        let passed = Checked::Masks(Box::new(facts), upload(b"prepared masks"));
        let calibration = make(&store, worker, asked, passed).await;
        let facts = NewMeasurement {
            calibration,
            data: data.sha256,
            format: "npy".into(),
            sample: "float32".into(),
            axes: None,
            snapshots: 2,
            height: 64,
            width: 96,
            full_scale: 1.0,
            camera_fps: Some(30.0),
            exposure_s: None,
            sequence: Sequence::Separate,
            dark: Vec::new(),
            warnings: Vec::new(),
            reading: Reading {
                scale_basis: ScaleBasis::Type,
                crop: None,
                frames: None,
                packing: None,
            },
        };
        let asked = MeasurementRequest::new(None, calibration, data.sha256);
        let passed = Checked::Measurement(Box::new(facts), upload(b"prepared data"));
        let measurement = make(&store, worker, Submission::Measurement(asked), passed).await;
        let lab = Self { store, measurement, worker, _folder: folder };
        assert_eq!(lab.work_off().await, [TaskKind::Calibration], "its report");
        lab
    }

    /// Makes something of uploads, whose check ends like this.
    async fn make<Id>(&self, asked: Submission, passed: Checked) -> Id
    where
        Id: From<ResourceId> + FromStr<Err = InvalidId>,
    {
        make(&self.store, self.worker, asked, passed).await
    }

    /// A job with two tiles in each of two snapshots.
    async fn submit(&self, priority: i32) -> JobId {
        id(self.add(priority, None, b"request").await.unwrap())
    }

    async fn submit_algorithm(&self, algorithm: Algorithm) -> JobId {
        id(self.add_algorithm(algorithm, 0, None, b"request").await.unwrap())
    }

    async fn add(
        &self,
        priority: i32,
        key: Option<&str>,
        request: &[u8],
    ) -> Result<Inserted, StoreError> {
        self.add_algorithm(Algorithm::GapTv, priority, key, request).await
    }

    async fn add_algorithm(
        &self,
        algorithm: Algorithm,
        priority: i32,
        key: Option<&str>,
        request: &[u8],
    ) -> Result<Inserted, StoreError> {
        let local = engine::job::Lab::local();
        self.add_for(&local, algorithm, priority, key, request).await
    }

    async fn add_for(
        &self,
        lab: &engine::job::Lab,
        algorithm: Algorithm,
        priority: i32,
        key: Option<&str>,
        request: &[u8],
    ) -> Result<Inserted, StoreError> {
        let measurement = self
            .store
            .measurement(&engine::job::Lab::local(), self.measurement)
            .await
            .unwrap()
            .facts;
        let (height, width) = (64, 96);
        let shape =
            engine::job::SceneShape { frames: 8, height, width, snapshots: 2, mosaic: None };
        let job = JobRequest {
            measurement: self.measurement,
            calibration: None,
            snapshots: SnapshotSelection::All,
            sequence: None,
            algorithm,
            model: None,
            schedule: None,
            tile: Some(TileSpec { size: 64, overlap: 8 }),
            registration: engine::job::RegistrationRequest::Off,
            priority,
            truth: None,
            label: None,
            webhook: None,
        };
        let sequence = measurement.sequence;
        let spec = job.resolve(measurement.calibration, shape, sequence, None).unwrap();
        let new = NewJob {
            most_jobs: 1000,
            lab: lab.clone(),
            spec,
            key: key.map(|key| RequestKey { key: key.into(), request: Sha256::of(request) }),
        };
        self.store.add_job(new).await
    }

    async fn claim(&self) -> Option<ClaimedTask> {
        self.store.claim(self.worker, LEASE).await.unwrap()
    }

    fn blob(&self, content: &str) -> Product {
        let mut writer = self.store.blob_writer().unwrap();
        writer.write_all(content.as_bytes()).unwrap();
        Product::File(writer.finish().unwrap())
    }

    /// Does the task as a worker would and says what the store answered.
    async fn work(&self, task: &ClaimedTask) -> Heartbeat {
        let product = match task.kind {
            TaskKind::Prepare | TaskKind::White => Product::Record,
            TaskKind::Pilot => Product::TileCost(0.5),
            TaskKind::Preview { snapshot } => self.blob(&format!("preview {snapshot}")),
            TaskKind::Tile { snapshot, tile, .. } => self.blob(&format!("{snapshot} {tile}")),
            TaskKind::Assemble { .. } => {
                let folder = self.store.staged_dir().unwrap();
                std::fs::create_dir(folder.path().join("png")).unwrap();
                let picture = file(&folder, "png/frame_0001.png", "pixels");
                let stack = file(&folder, "stack.exr", "pixels");
                let sha256 = Sha256::of(b"array");
                let array = ResultFile { name: "frames.npy".into(), size: 1 << 40, sha256 };
                let array = WrittenFile { file: array, crc32: 1, is_derived: true };
                Product::Files(folder, vec![picture, stack, array])
            }
            TaskKind::Movie { snapshot } | TaskKind::Gif { snapshot } => {
                self.blob(&format!("movie {snapshot:?}"))
            }
            TaskKind::Check => panic!("what passes depends on the request"),
            TaskKind::Calibration => Product::Calibration(Box::new(calibrations::report())),
            TaskKind::Manifest => {
                let folder = self.store.staged_dir().unwrap();
                let file = file(&folder, "manifest.json", "{}");
                Product::Files(folder, vec![file])
            }
        };
        let record = match task.kind {
            // Its record is the assessment of the job.
            TaskKind::Manifest => Value::Null,
            kind => json!({"kind": kind.into_str()}),
        };
        let progress = TaskProgress { fraction: 0.5, ..TaskProgress::START };
        self.store.complete(&task.lease, Completion { progress, record, product }).await.unwrap()
    }

    /// Works until nothing is ready, and returns the kinds of the tasks.
    async fn work_off(&self) -> Vec<TaskKind> {
        let mut done = Vec::new();
        while let Some(task) = self.claim().await {
            assert_eq!(self.work(&task).await, Heartbeat::Continue);
            done.push(task.kind);
        }
        done
    }

    /// Puts an upload in the store.
    async fn upload(&self, content: &[u8]) -> Sha256 {
        let mut writer = self.store.blob_writer().unwrap();
        writer.write_all(content).unwrap();
        let staged = writer.finish().unwrap();
        let local = engine::job::Lab::local();
        self.store.store_upload(&local, None, staged).await.unwrap().0.sha256
    }

    /// Lets the pauses after failures pass.
    async fn skip_pauses(&self) {
        sqlx::query("UPDATE tasks SET ready_at = 0").execute(&self.store.writer).await.unwrap();
    }

    /// Does so many tasks.
    async fn work_on(&self, tasks: usize) {
        for _ in 0..tasks {
            let task = self.claim().await.unwrap();
            self.work(&task).await;
        }
    }

    async fn state(&self, job: JobId) -> JobState {
        self.store.job(&engine::job::Lab::local(), job).await.unwrap().state
    }
}

/// A request without the service around it.
fn new_request(submission: Submission) -> NewRequest {
    let limits = CheckLimits { max_file_bytes: 1 << 30, min_free_bytes: 0, seconds: 10.0 };
    NewRequest { submission, limits, origin: None }
}

/// Requests something, and does its check with this outcome.
async fn make<Id>(store: &Store, worker: WorkerId, asked: Submission, passed: Checked) -> Id
where
    Id: From<ResourceId> + FromStr<Err = InvalidId>,
{
    let local = engine::job::Lab::local();
    let is_model = matches!(asked, Submission::Model(_));
    let made = store.request((&local, None), &new_request(asked), None).await.unwrap();
    let (claimant, other) = match is_model {
        true => (Claimant::Networks, Claimant::Light),
        false => (Claimant::Local, Claimant::Networks),
    };
    assert!(store.claim_as(other, worker, LEASE).await.unwrap().is_none());
    let task = store.claim_as(claimant, worker, LEASE).await.unwrap().unwrap();
    assert_eq!(task.kind, TaskKind::Check);
    assert_eq!(checked(store, &task, passed).await, Heartbeat::Continue);
    made.id()
}

/// Ends a check with this outcome.
async fn checked(store: &Store, task: &ClaimedTask, outcome: Checked) -> Heartbeat {
    let product = Product::Checked(Box::new(outcome));
    let completion = Completion { progress: TaskProgress::START, record: json!(null), product };
    store.complete(&task.lease, completion).await.unwrap()
}

fn id(inserted: Inserted) -> JobId {
    match inserted {
        Inserted::New(id) | Inserted::Before(id) => id,
    }
}

fn tile(snapshot: u32, tile: u32) -> TaskKind {
    TaskKind::Tile { snapshot, snapshots: 1, tile }
}

#[tokio::test]
async fn a_job_runs_in_order_and_leaves_its_results_and_no_tiles() {
    let lab = Lab::new().await;
    let job = lab.submit(0).await;
    assert_eq!(lab.state(job).await, JobState::Queued);
    let order = [
        TaskKind::Prepare,
        TaskKind::Preview { snapshot: 0 },
        TaskKind::Preview { snapshot: 1 },
        tile(0, 0),
        tile(0, 1),
        tile(1, 0),
        tile(1, 1),
        TaskKind::White,
        TaskKind::Assemble { snapshot: 0 },
        TaskKind::Assemble { snapshot: 1 },
        TaskKind::Manifest,
    ];
    assert_eq!(lab.work_off().await, order);
    let done = lab.store.job(&engine::job::Lab::local(), job).await.unwrap();
    assert_eq!(done.state, JobState::Succeeded);
    assert!(done.finished_at >= done.started_at);
    let (picture, path) =
        lab.store.result_file(&done, Some(1), "png/frame_0001.png").await.unwrap();
    assert_eq!(Sha256::of(&std::fs::read(path).unwrap()), picture.file.sha256);
    // A derived file has a record, takes no room, and is not expected on the disk.
    let (array, _) = lab.store.result_file(&done, Some(1), "frames.npy").await.unwrap();
    assert!(array.is_derived);
    assert!(lab.store.open_result(&done, Some(1), "frames.npy").await.is_err());
    assert!(lab.store.verify().await.unwrap().is_good());
    let used = lab.store.lab_use(&engine::job::Lab::local()).await.unwrap();
    assert!(used.result_bytes < 1 << 10, "{}", used.result_bytes);
    assert!(lab.store.result_file(&done, None, "manifest.json").await.unwrap().1.exists());
    let progress = lab.store.progress(&done).await.unwrap();
    assert_eq!((progress.percent, progress.tiles_done, progress.snapshots_done), (100.0, 4, 2));
    // Two uploads and two prepared files are left.
    assert_eq!(lab.store.blob_totals().await.unwrap().0, 4);
    assert_eq!(std::fs::read_dir(lab.store.dir().tmp()).unwrap().count(), 0);
}

#[tokio::test]
async fn priority_comes_before_age() {
    let lab = Lab::new().await;
    let (old, urgent) = (lab.submit(0).await, lab.submit(5).await);
    assert_eq!(lab.claim().await.unwrap().step().job, urgent);
    assert_eq!(lab.claim().await.unwrap().step().job, old);
    assert!(lab.claim().await.is_none(), "the tiles wait for the scale");
}

#[tokio::test]
async fn no_task_goes_to_two_workers_at_once() {
    let lab = Lab::new().await;
    for _ in 0..20 {
        lab.submit(0).await;
    }
    let claims = (0..8).map(|_| {
        let store = lab.store.clone();
        tokio::spawn(async move {
            let mut tasks = Vec::new();
            while let Some(task) = store.claim(WorkerId::new(), LEASE).await.unwrap() {
                tasks.push(task.lease.task);
            }
            tasks
        })
    });
    let mut tasks: Vec<_> =
        futures_util::future::join_all(claims).await.into_iter().flat_map(Result::unwrap).collect();
    tasks.sort();
    tasks.dedup();
    assert_eq!(tasks.len(), 20);
}

#[tokio::test]
async fn workers_are_busy_as_far_as_there_are_tasks_for_them() {
    let lab = Lab::new().await;
    let (here, elsewhere) = (
        WorkerPlace::default(),
        WorkerPlace { host: Some("node".into()), ..WorkerPlace::default() },
    );
    for (place, claimant) in
        [(&here, Claimant::Local), (&here, Claimant::Light), (&elsewhere, Claimant::Pool("pool"))]
    {
        lab.store.worker_started(WorkerId::new(), 2, place, claimant).await.unwrap();
    }
    let busy = async || lab.store.busy_workers(LEASE).await.unwrap();
    assert_eq!(busy().await, 0);
    // Does a job, and returns the number of busy workers during each tile.
    let beside_tiles = async || {
        lab.submit(0).await;
        let mut counts = Vec::new();
        while let Some(task) = lab.claim().await {
            if matches!(task.kind, TaskKind::Tile { .. }) {
                counts.push(busy().await);
            }
            lab.work(&task).await;
        }
        counts
    };
    let mut beside_tile = beside_tiles().await;
    let last = beside_tile.pop();
    assert_eq!(last, Some(1), "the last tile is computed alone");
    assert!(beside_tile.len() > 1 && beside_tile.iter().all(|busy| *busy == 2), "{beside_tile:?}");
    assert_eq!(busy().await, 0);
    sqlx::query("UPDATE workers SET tiles = id = ?")
        .bind(lab.worker.to_string())
        .execute(&lab.store.writer)
        .await
        .unwrap();
    assert_eq!(beside_tiles().await, [1; 4], "one worker takes tiles");
}

#[tokio::test]
async fn a_silent_worker_loses_its_task_and_later_reports_are_refused() {
    let lab = Lab::new().await;
    let job = lab.submit(0).await;
    let late = lab.store.claim(lab.worker, Duration::from_millis(1)).await.unwrap().unwrap();
    tokio::time::sleep(Duration::from_millis(20)).await;
    let again = lab.claim().await.unwrap();
    assert_eq!((again.lease.task, again.lease.attempt), (late.lease.task, 2));
    let beat = lab.store.heartbeat(&late.lease, TaskProgress::START, None).await.unwrap();
    assert_eq!(beat, Heartbeat::Lost);
    assert_eq!(lab.work(&late).await, Heartbeat::Lost);
    lab.store.fail(&late.lease, "too late", false).await.unwrap();
    assert_eq!(lab.state(job).await, JobState::Running);
    assert_eq!(lab.work(&again).await, Heartbeat::Continue);
}

#[tokio::test]
async fn work_that_was_late_but_not_taken_over_counts() {
    let lab = Lab::new().await;
    lab.submit(0).await;
    let late = lab.store.claim(lab.worker, Duration::from_millis(1)).await.unwrap().unwrap();
    tokio::time::sleep(Duration::from_millis(20)).await;
    assert_eq!(lab.work(&late).await, Heartbeat::Continue);
}

#[tokio::test]
async fn cancel_stops_running_tasks_at_their_heartbeat() {
    let lab = Lab::new().await;
    let job = lab.submit(0).await;
    let task = lab.claim().await.unwrap();
    lab.store.cancel_job(&engine::job::Lab::local(), job).await.unwrap();
    assert_eq!(lab.state(job).await, JobState::Cancelling);
    assert!(lab.store.delete_job(&engine::job::Lab::local(), job).await.is_err());
    let beat = lab.store.heartbeat(&task.lease, TaskProgress::START, None).await.unwrap();
    assert_eq!(beat, Heartbeat::Cancelled);
    lab.store.give_back(&task.lease).await.unwrap();
    assert_eq!(lab.state(job).await, JobState::Cancelled);
    assert!(lab.claim().await.is_none());
    lab.store.retry_job(&engine::job::Lab::local(), job).await.unwrap();
    assert_eq!(lab.work_off().await.len(), 11);
    assert!(matches!(
        lab.store.cancel_job(&engine::job::Lab::local(), job).await,
        Err(StoreError::State(_))
    ));
}

#[tokio::test]
async fn cancel_ends_a_job_after_its_last_worker_finished_or_died() {
    let lab = Lab::new().await;
    for dies in [false, true] {
        let job = lab.submit(0).await;
        let task = lab.claim().await.unwrap();
        lab.store.cancel_job(&engine::job::Lab::local(), job).await.unwrap();
        if dies {
            lab.store.worker_ended(lab.worker, &WorkerEnd::Killed).await.unwrap();
        } else {
            assert_eq!(lab.work(&task).await, Heartbeat::Continue);
        }
        assert_eq!(lab.state(job).await, JobState::Cancelled);
        assert!(lab.claim().await.is_none());
    }
}

#[tokio::test]
async fn a_waiting_job_is_cancelled_at_once_and_twice_is_no_error() {
    let lab = Lab::new().await;
    let job = lab.submit(0).await;
    lab.store.cancel_job(&engine::job::Lab::local(), job).await.unwrap();
    lab.store.cancel_job(&engine::job::Lab::local(), job).await.unwrap();
    assert_eq!(lab.state(job).await, JobState::Cancelled);
    lab.store.delete_job(&engine::job::Lab::local(), job).await.unwrap();
    assert!(matches!(
        lab.store.job(&engine::job::Lab::local(), job).await,
        Err(StoreError::NotFound { .. })
    ));
}

#[tokio::test]
async fn tiles_wait_for_the_pilot_and_cost_what_it_leaves_of_them() {
    let lab = Lab::new().await;
    let job = lab.submit_algorithm(Algorithm::PnpNonlocal).await;
    let cost = async || -> f64 {
        sqlx::query_scalar("SELECT sum(cost) FROM tasks WHERE kind = 'tile'")
            .fetch_one(&lab.store.writer)
            .await
            .unwrap()
    };
    let planned = cost().await;
    lab.work_on(2).await;
    let (pilot, preview) = (lab.claim().await.unwrap(), lab.claim().await.unwrap());
    assert_eq!((pilot.kind, pilot.step().pilot.clone()), (TaskKind::Pilot, None));
    assert_eq!(preview.kind, TaskKind::Preview { snapshot: 1 });
    assert!(lab.claim().await.is_none(), "the tiles wait");
    lab.work(&pilot).await;
    assert!((cost().await - 0.5 * planned).abs() < 1e-9 * planned);
    let task = lab.claim().await.unwrap();
    let pilot = task.step().pilot.clone();
    assert_eq!((task.kind, pilot), (tile(0, 0), Some(json!({"kind": "pilot"}))));
    lab.store.cancel_job(&engine::job::Lab::local(), job).await.unwrap();
    lab.store.give_back(&task.lease).await.unwrap();
    lab.store.give_back(&preview.lease).await.unwrap();
    lab.store.retry_job(&engine::job::Lab::local(), job).await.unwrap();
    let left = [TaskKind::Preview { snapshot: 1 }, tile(0, 0), tile(0, 1)];
    assert_eq!(lab.work_off().await[..3], left, "the pilot is not done again");
    assert_eq!(lab.state(job).await, JobState::Succeeded);
    assert!(lab.store.preview(job, 0).await.unwrap().is_none(), "previews go with the tiles");
}

#[tokio::test]
async fn a_second_process_sees_the_same_store() {
    let lab = Lab::new().await;
    let job = lab.submit(0).await;
    let other = Store::open(lab.store.dir().root(), Purpose::Use).await.unwrap();
    let task = other.claim(WorkerId::new(), LEASE).await.unwrap().unwrap();
    assert_eq!((task.step().job, lab.state(job).await), (job, JobState::Running));
}
