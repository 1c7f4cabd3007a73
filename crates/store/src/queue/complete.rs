//! Completion of a task: its result is stored, and the tasks that waited for it become ready.

use serde::Deserialize;
use serde_json::Value;
use sqlx::SqliteConnection;

use super::lease::{self, Heartbeat, Lease, Outcome};
use super::{graph, job};
use crate::columns::{Json, sql};
use crate::error::{Result, StoreError};
use crate::staging::{StagedBlob, StagedDir};
use crate::tables::blobs::Origin;
use crate::tables::reservations::reservations;
use crate::tables::resources::{self, NewCalibration, NewMeasurement, NewModel};
use crate::tables::tasks::Owner;
use crate::tables::{quota, reports, requests, results, sums};
use crate::{Store, dir, on_files};
use engine::intake::Refusal;
use engine::job::{
    Assessment, CalibrationId, CalibrationReport, JobId, MeasurementId, ModelId, Registered,
    ResourceId, Sha256, Submission, TaskKind, TaskProgress, TaskState, Timestamp, WrittenFile,
    planned_seconds,
};

#[derive(Debug)]
pub struct Completion {
    /// Where the solver stood when it stopped: `fraction` is below 1 if it converged early.
    pub progress: TaskProgress,
    /// The task's record, for the manifest.
    pub record: Value,
    pub product: Product,
}

#[derive(Debug)]
pub enum Product {
    /// Nothing but its record (prepare, white).
    Record,
    /// The share of their planned cost that the tiles still have, on \[0,1\] (pilot).
    TileCost(f64),
    /// A tile, a preview or a movie.
    File(StagedBlob),
    /// The files of a snapshot (assemble) or of the job (manifest). Derived files are not in the folder.
    Files(StagedDir, Vec<WrittenFile>),
    Checked(Box<Checked>),
    Calibration(Box<CalibrationDone>),
}

/// The outcome of a check.
#[derive(Debug)]
pub enum Checked {
    /// Masks on \[0,1\].
    Masks(Box<NewCalibration>, StagedBlob),
    /// Masks can be made from the captures; the planned CPU-seconds.
    Captures(f64),
    Measurement(Box<NewMeasurement>, StagedBlob),
    Model(NewModel),
    Refused(Refusal),
}

#[derive(Debug)]
pub struct CalibrationDone {
    /// The masks and what is known of them, if they were made of captures.
    pub masks: Option<(NewCalibration, StagedBlob)>,
    pub report: CalibrationReport,
    /// Pictures by name, as PNG.
    pub maps: Vec<(String, Vec<u8>)>,
}

impl Store {
    /// Stores what a task has made and moves its job on. Says [`Heartbeat::Lost`] if the lease has
    /// run out and the task was claimed again, or it was deleted; nothing is stored then. If this
    /// fails, the task is still the worker's.
    pub async fn complete(&self, lease: &Lease, completion: Completion) -> Result<Heartbeat> {
        let mut transaction = self.write().await?;
        let Some((owner, kind)) = lease::held(&mut transaction, lease).await? else {
            return Ok(Heartbeat::Lost);
        };
        let mut result = None;
        match (owner, completion.product) {
            (Owner::Job(_), Product::Record) => {}
            (Owner::Job(job), Product::TileCost(share)) => {
                graph::scale_tiles(&mut transaction, job, share).await?;
            }
            (Owner::Job(_), Product::File(staged)) => {
                result = Some(staged.sha256());
                self.publish(&mut transaction, staged, Origin::Tile).await?;
            }
            (Owner::Resource(_), Product::File(staged))
                if matches!(kind, TaskKind::Movie { .. } | TaskKind::Gif { .. }) =>
            {
                result = Some(staged.sha256());
                self.publish(&mut transaction, staged, Origin::Tile).await?;
            }
            (Owner::Job(job), Product::Files(staged, files)) => {
                results::record(&mut transaction, job, kind.snapshot(), &files).await?;
                self.put_files(job, kind, staged, files).await?;
            }
            (Owner::Resource(id), Product::Calibration(done)) if kind == TaskKind::Calibration => {
                self.calibrated(&mut transaction, id.into(), *done).await?;
            }
            (Owner::Resource(id), Product::Checked(checked)) if kind == TaskKind::Check => {
                self.checked(&mut transaction, id, *checked).await?;
            }
            (Owner::Job(_), Product::Calibration(_) | Product::Checked(_))
            | (Owner::Resource(_), _) => {
                let value = kind.into_str().to_owned();
                return Err(StoreError::Corrupt { column: "kind", value });
            }
        }
        finish(&mut transaction, lease, &completion.progress, &completion.record, result).await?;
        if let Owner::Job(job) = owner {
            if kind == TaskKind::Prepare {
                register(&mut transaction, job, &completion.record).await?;
            }
            graph::unblock(&mut transaction, job, kind).await?;
            if kind == TaskKind::Manifest {
                let record = &completion.record;
                let assessment = Option::<Assessment>::deserialize(record).map_err(|_| {
                    StoreError::Corrupt { column: "record", value: record.to_string() }
                })?;
                self.succeed(&mut transaction, job, assessment).await?;
            }
            job::settle(&mut transaction, job).await?;
            sums::recount(&mut transaction, job).await?;
        }
        // The end of a job removes its tiles.
        if kind == TaskKind::Manifest {
            self.commit_removals(transaction).await?;
        } else {
            transaction.commit().await?;
        }
        Ok(Heartbeat::Continue)
    }

    /// Moves result files to their place, under the lock of the caller's transaction.
    async fn put_files(
        &self,
        job: JobId,
        kind: TaskKind,
        staged: StagedDir,
        files: Vec<WrittenFile>,
    ) -> Result<()> {
        let folder = self.dir().results(job);
        let place = kind.snapshot().map(|snapshot| self.dir().snapshot_results(job, snapshot));
        let replaced = on_files(move || {
            dir::make_dir_durably(&folder)?;
            match place {
                Some(place) => staged.put(&place),
                None => staged.put_files(&folder, &files).map(|()| None),
            }
        });
        replaced.await?.into_iter().for_each(|path| self.removals.begin(path));
        Ok(())
    }

    /// Records the outcome of a check, and has the report of a calibration made.
    async fn checked(
        &self,
        transaction: &mut SqliteConnection,
        id: ResourceId,
        checked: Checked,
    ) -> Result<()> {
        let seconds = match checked {
            Checked::Masks(facts, staged) => {
                let prepared = staged.sha256();
                let seconds = planned_seconds(0, facts.frames, facts.height * facts.width);
                self.publish(transaction, staged, Origin::Prepared).await?;
                resources::record::<CalibrationId>(transaction, id.into(), prepared, &*facts)
                    .await?;
                seconds
            }
            Checked::Captures(seconds) => seconds,
            Checked::Measurement(facts, staged) => {
                let prepared = staged.sha256();
                self.publish(transaction, staged, Origin::Prepared).await?;
                return resources::record::<MeasurementId>(
                    transaction,
                    id.into(),
                    prepared,
                    &*facts,
                )
                .await;
            }
            Checked::Model(facts) => {
                return resources::record::<ModelId>(transaction, id.into(), facts.file, &facts)
                    .await;
            }
            Checked::Refused(refusal) => return requests::refuse(transaction, id, &refusal).await,
        };
        let lab = requests::find(transaction, id).await?.lab;
        graph::insert_for(transaction, &lab, id, TaskKind::Calibration, seconds).await
    }

    /// Reserves `bytes` for the result of a check. The disk must have room for `copies` of them above `min_free`.
    /// Errors: [`StoreError::Quota`]; [`StoreError::NoRoom`]; [`StoreError::NoShare`]; [`StoreError::Interrupted`] if
    /// the worker has lost the task.
    pub async fn promise(
        &self,
        lease: &Lease,
        bytes: u64,
        (copies, min_free): (u64, u64),
    ) -> Result<()> {
        let mut transaction = self.write().await?;
        let Some((Owner::Resource(id), _)) = lease::held(&mut transaction, lease).await? else {
            return Err(StoreError::Interrupted);
        };
        // An earlier attempt may have reserved its own.
        requests::promise(&mut transaction, id, 0).await?;
        let request = requests::find(&mut transaction, id).await?;
        quota::check(&mut transaction, &request.lab, request.token, bytes).await?;
        let reserved = reservations(&mut transaction).await?.seen_by(&request.lab);
        self.dir().check_room("the upload", copies * bytes, reserved, min_free)?;
        requests::promise(&mut transaction, id, bytes).await?;
        Ok(transaction.commit().await?)
    }

    /// Writes the masks and the report of a calibration; its captures are no longer needed.
    async fn calibrated(
        &self,
        transaction: &mut SqliteConnection,
        id: CalibrationId,
        done: CalibrationDone,
    ) -> Result<()> {
        let Submission::Calibration(request) =
            requests::find(transaction, id.into()).await?.submission
        else {
            return Err(StoreError::missing("calibration", id));
        };
        let CalibrationDone { masks, report, maps } = done;
        if let Some((facts, staged)) = masks {
            let prepared = staged.sha256();
            self.publish(transaction, staged, Origin::Prepared).await?;
            // The worker that makes masks knows nothing of colours.
            let facts = NewCalibration { mosaic: request.mosaic, ..facts };
            resources::record(transaction, id, prepared, &facts).await?;
        }
        // The worker that makes the report reads the masks alone.
        let report = CalibrationReport { registration_of: request.registration_of, ..report };
        if let Some(warning) = report.warning() {
            // A bad calibration causes other findings, so it comes first.
            sql!(
                "UPDATE jobs SET spec = json_set(spec, '$.warnings', (
                     SELECT json_group_array(json(value)) FROM (
                         SELECT ?1 AS value
                         UNION ALL SELECT value FROM json_each(jobs.spec, '$.warnings'))))
                 WHERE calibration = ?2 AND finished_at IS NULL",
                [Json(&warning), id]
            )
            .execute(&mut *transaction)
            .await?;
        }
        reports::insert(transaction, id, &report, maps).await
    }
}

/// Puts the registration of the masks into the job, and its findings among the warnings.
async fn register(connection: &mut SqliteConnection, job: JobId, record: &Value) -> Result<()> {
    let Some(registration) = record.get("registration") else { return Ok(()) };
    let corrupt = |_| StoreError::Corrupt { column: "record", value: registration.to_string() };
    let Some(registered) = Option::<Registered>::deserialize(registration).map_err(corrupt)? else {
        return Ok(());
    };
    sql!(
        "UPDATE jobs SET spec = json_set(spec, '$.registered', json(?)) WHERE id = ?",
        [Json(&registered), job]
    )
    .execute(&mut *connection)
    .await?;
    let findings = registered.findings();
    if findings.is_empty() {
        return Ok(());
    }
    // An earlier attempt may have added them.
    let superseded = registered.superseded().iter().map(|code| code.as_str());
    let replaced: Vec<_> =
        superseded.chain(findings.iter().map(|finding| finding.code.as_str())).collect();
    sql!(
        "UPDATE jobs SET spec = json_set(spec, '$.warnings', (
             SELECT json_group_array(json(value)) FROM (
                 SELECT value FROM json_each(jobs.spec, '$.warnings')
                 WHERE value ->> 'code' NOT IN (SELECT value FROM json_each(?1))
                 UNION ALL SELECT value FROM json_each(?2))))
         WHERE id = ?3",
        [Json(&replaced), Json(&findings), job]
    )
    .execute(&mut *connection)
    .await?;
    Ok(())
}

async fn finish(
    connection: &mut SqliteConnection,
    lease: &Lease,
    progress: &TaskProgress,
    record: &Value,
    result: Option<Sha256>,
) -> Result<()> {
    let TaskProgress { iterations, passes, fraction, .. } = *progress;
    sql!(
        "UPDATE tasks SET state = ?9, worker = NULL, lease_until = NULL, stage = NULL,
             iterations = ?1, passes = ?2, fraction = ?3, record = ?4, result = ?5,
             seconds = (?6 - (SELECT started_at FROM attempts
                              WHERE task = id AND attempt = ?8)) / 1000.0
         WHERE id = ?7",
        [
            iterations,
            passes,
            fraction.clamp(0.0, 1.0),
            Json(record),
            result,
            Timestamp::now(),
            lease.task,
            lease.attempt,
            TaskState::Done
        ]
    )
    .execute(&mut *connection)
    .await?;
    sql!(
        "INSERT INTO totals (kind, tasks, seconds, iterations, passes, onnxruntime)
             SELECT kind, 1, coalesce(seconds, 0), iterations, passes, record ->> '$.onnxruntime'
             FROM tasks WHERE id = ?
         ON CONFLICT (kind) DO UPDATE SET tasks = tasks + 1, seconds = seconds + excluded.seconds,
             iterations = iterations + excluded.iterations, passes = passes + excluded.passes,
             onnxruntime = coalesce(excluded.onnxruntime, onnxruntime)",
        [lease.task]
    )
    .execute(&mut *connection)
    .await?;
    sql!(
        "INSERT INTO rates (kind, device, seconds, cost)
             SELECT kind, coalesce((SELECT device FROM workers WHERE id = ?2), 'cpu'),
                 coalesce(seconds, 0), iif(kind = 'tile', cost * fraction, cost)
             FROM tasks WHERE id = ?1
         ON CONFLICT (kind, device) DO UPDATE SET seconds = 0.97 * seconds + excluded.seconds,
             cost = 0.97 * cost + excluded.cost",
        [lease.task, lease.worker]
    )
    .execute(&mut *connection)
    .await?;
    // Of tiles the processor's time is known; the others are short and run on one core.
    sql!(
        "INSERT INTO lab_totals (lab, cpu_seconds)
             SELECT lab, coalesce(record ->> '$.cpu_seconds', seconds, 0.0) FROM tasks WHERE id = ?
         ON CONFLICT (lab) DO UPDATE SET cpu_seconds = cpu_seconds + excluded.cpu_seconds",
        [lease.task]
    )
    .execute(&mut *connection)
    .await?;
    lease::end_attempt(connection, lease.task, Outcome::Done, None).await
}
