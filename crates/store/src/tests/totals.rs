//! Running totals equal new sums, whatever happens to jobs, files and labs.

use super::{LEASE, Lab, new_request};
use crate::tables::jobs;
use crate::{Checked, Claimant, ClaimedTask, Job, JobFilter, Purpose, Store, Work, WorkerEnd};
use engine::job::{
    Algorithm, CalibrationRequest, JobId, MeasurementRequest, Sha256, Submission, TaskProgress,
};

/// A small generator of numbers, so that a failure can be repeated.
struct Random(u64);

impl Random {
    fn below(&mut self, limit: usize) -> usize {
        self.0 =
            self.0.wrapping_mul(6_364_136_223_846_793_005).wrapping_add(1_442_695_040_888_963_407);
        (self.0 >> 33) as usize % limit
    }
}

fn named(number: usize) -> engine::job::Lab {
    ["local", "a", "b"][number].parse().unwrap()
}

impl Lab {
    async fn all_jobs(&self) -> Vec<Job> {
        self.store.jobs(None, &JobFilter::default(), 1000).await.unwrap().items
    }

    async fn assert_totals(&self, after: &str) {
        assert_eq!(self.store.wrong_totals().await.unwrap(), [""; 0], "after {after}");
    }

    /// Ends a task in one of the ways in which tasks end.
    async fn end(&self, task: &ClaimedTask, way: usize) {
        match (way, &task.work) {
            (0, _) => self.store.fail(&task.lease, "no reason", false).await.unwrap(),
            (1, _) => self.store.fail(&task.lease, "no reason", true).await.unwrap(),
            (2, _) => self.store.give_back(&task.lease).await.unwrap(),
            (3, _) => self.store.worker_ended(self.worker, &WorkerEnd::Killed).await.unwrap(),
            (4, _) => {
                let half = TaskProgress { fraction: 0.5, ..TaskProgress::START };
                self.store.heartbeat(&task.lease, half, None).await.unwrap();
            }
            (_, Work::Check(_)) => self.store.fail(&task.lease, "no masks", false).await.unwrap(),
            _ => {
                self.work(task).await;
            }
        }
    }

    /// Has a calibration and a measurement made of files that others have, too.
    async fn request(&self, random: &mut Random) {
        let masks = self.upload(&[random.below(3) as u8]).await;
        let asked = CalibrationRequest { masks: Some(masks), ..Default::default() };
        if random.below(2) == 0 {
            let asked = new_request(Submission::Calibration(asked));
            let _: crate::Inserted<engine::job::CalibrationId> =
                self.store.request((&named(0), None), &asked, None).await.unwrap();
            return;
        }
        let local = named(0);
        let old = self.store.measurement(&local, self.measurement).await.unwrap().facts;
        let asked = MeasurementRequest::new(None, old.calibration, masks);
        let facts = crate::NewMeasurement { data: masks, ..old };
        let crate::Product::File(prepared) = self.blob(["x", "y"][random.below(2)]) else { return };
        // Another task may be the next one.
        let request = new_request(Submission::Measurement(asked));
        let _: crate::Inserted<engine::job::MeasurementId> =
            self.store.request((&local, None), &request, None).await.unwrap();
        if let Some(task) = self.claim().await {
            match task.work {
                Work::Check(ref check)
                    if matches!(check.request.submission, Submission::Measurement(_)) =>
                {
                    let passed = Checked::Measurement(Box::new(facts), prepared);
                    super::checked(&self.store, &task, passed).await;
                }
                _ => self.end(&task, 5).await,
            }
        }
    }
}

#[tokio::test]
async fn totals_equal_new_sums_after_random_operations() {
    let lab = Lab::new().await;
    let mut random = Random(7);
    for step in 0..600 {
        let jobs = lab.all_jobs().await;
        let one = jobs.get(random.below(jobs.len().max(1))).cloned();
        let operation = random.below(12);
        match (operation, one) {
            (0 | 1, _) => {
                let owner = named(random.below(3));
                lab.add_for(&owner, Algorithm::GapTv, 0, None, b"request").await.unwrap();
            }
            (2..=5, _) => {
                lab.skip_pauses().await;
                for _ in 0..4 {
                    let claimant =
                        if random.below(4) == 0 { Claimant::Light } else { Claimant::Local };
                    let task = lab.store.claim_as(claimant, lab.worker, LEASE).await.unwrap();
                    let Some(task) = task else { break };
                    // Most tasks are done.
                    lab.end(&task, random.below(30)).await;
                }
            }
            // Some of these are refused.
            (6, Some(job)) => drop(lab.store.cancel_job(&job.lab, job.id).await),
            (7, Some(job)) => drop(lab.store.retry_job(&job.lab, job.id).await),
            (8, Some(job)) => drop(lab.store.delete_job(&job.lab, job.id).await),
            (9, Some(job)) if job.state == engine::job::JobState::Succeeded => {
                drop(lab.store.movie(&job, Some(0), engine::job::MovieFormat::Mp4).await);
            }
            (10, _) => lab.request(&mut random).await,
            (11, _) => {
                let file = Sha256::of(&[random.below(3) as u8]);
                drop(lab.store.delete_upload(&named(0), file).await);
                drop(lab.store.remove_lab(&named(1 + random.below(2))).await);
                for asked in lab
                    .store
                    .resources(
                        &named(0),
                        crate::Filter::<engine::job::MeasurementId>::default(),
                        100,
                    )
                    .await
                    .unwrap()
                    .items
                {
                    if let crate::FoundResource::Ready(found) = asked
                        && found.id != lab.measurement
                        && random.below(2) == 0
                    {
                        drop(lab.store.delete(&named(0), found.id).await);
                    }
                }
            }
            _ => {}
        }
        lab.assert_totals(&format!("operation {operation} in step {step}")).await;
    }
    assert!(lab.all_jobs().await.len() > 3);
    // A process that is killed leaves a transaction without its end.
    let spec = lab.all_jobs().await.remove(0).spec;
    let mut transaction = lab.store.write().await.unwrap();
    jobs::insert(&mut transaction, JobId::new(), &named(1), &spec).await.unwrap();
    drop(transaction);
    lab.assert_totals("a transaction that was broken off").await;
    // Once all is deleted, nothing is left of the totals, and the labs can go.
    for job in lab.all_jobs().await {
        drop(lab.store.cancel_job(&job.lab, job.id).await);
    }
    lab.store.worker_ended(lab.worker, &WorkerEnd::Killed).await.unwrap();
    for job in lab.all_jobs().await {
        lab.store.delete_job(&job.lab, job.id).await.unwrap();
    }
    for number in [1, 2] {
        let used = lab.store.lab_use(&named(number)).await.unwrap();
        assert_eq!((used.jobs, used.result_bytes, used.uploads), (0, 0, 0));
        drop(lab.store.remove_lab(&named(number)).await);
    }
    let left: i64 = sqlx::query_scalar("SELECT count(*) FROM jobs_by_state WHERE lab <> 'local'")
        .fetch_one(&lab.store.writer)
        .await
        .unwrap();
    assert_eq!(left, 0);
    lab.assert_totals("the end").await;
}

#[tokio::test]
async fn verification_finds_wrong_totals() {
    let lab = Lab::new().await;
    lab.submit(0).await;
    assert_eq!(lab.store.verify().await.unwrap().database, "ok");
    sqlx::query("UPDATE jobs_by_state SET jobs = 7").execute(&lab.store.writer).await.unwrap();
    let audit = lab.store.verify().await.unwrap();
    assert!(audit.database.contains("jobs_by_state"), "{}", audit.database);
    assert!(!audit.is_good());
    // A server that accepts the database repairs the totals.
    let root = lab.store.dir().root().to_owned();
    lab.store.close().await;
    drop(lab.store);
    let store = Store::open(&root, Purpose::Serve { accept_database: true }).await.unwrap();
    assert_eq!(store.verify().await.unwrap().database, "ok");
}
