//! Claiming a task, with its inputs.

use std::path::PathBuf;
use std::time::Duration;

use serde_json::Value;
use sqlx::SqliteConnection;
use sqlx::sqlite::SqliteRow;

use super::lease::{self, LONGEST_LEASE, Lease, Loss};
use crate::Store;
use crate::columns::{Columns, Json, sql, sql_as};
use crate::error::{Result, StoreError};
use crate::tables::jobs;
use crate::tables::requests::{self, Request};
use crate::tables::resources::{Calibration, Measurement, ReadyResource};
use crate::tables::tasks::{self, Owner, TaskRecord, TileResult};
use crate::tables::workers::{self, Claimant};
use engine::job::{
    CalibrationId, Captures, CheckLimits, JobId, JobSpec, JobState, Lab, MovieFormat, Registered,
    ResourceId, Sha256, Submission, TaskKind, TaskStage, TaskState, Timestamp, WorkerId,
};
use engine::pipeline::derived::STACK;

/// The longest pause of a task after a failure, in milliseconds: one that ends later was noted before
/// the clock was set back.
const LONGEST_PAUSE: i64 = 60_000;

/// A task with all that a worker needs to do it.
#[derive(Debug, Clone)]
pub struct ClaimedTask {
    /// The right to it, to be shown with every message about it.
    pub lease: Lease,
    pub kind: TaskKind,
    /// Its planned processor time in seconds.
    pub cost: f64,
    pub work: Work,
}

#[derive(Debug, Clone)]
pub enum Work {
    Job(Box<JobTask>),
    Check(Box<CheckTask>),
    /// A calibration's masks, or the report on them.
    Calibration(Box<CalibrationTask>),
    Movie(Box<MovieWork>),
}

#[derive(Debug, Clone)]
pub struct JobTask {
    pub job: JobId,
    pub spec: JobSpec,
    pub calibration: Calibration,
    pub measurement: Measurement,
    /// Record of the job's prepare task; `None` for that task.
    pub prepared: Option<Value>,
    /// Record of its pilot, if it has one that is done.
    pub pilot: Option<Value>,
    /// The record of its white level, once that is determined.
    pub white: Option<Value>,
    /// For an assembly: all tiles of the runs that hold its snapshot, in the order of the plan. For the white level: all
    /// tiles of the job, without their assessments.
    pub tiles: Vec<TileResult>,
    /// For the manifest: all other tasks of the job, in order.
    pub records: Vec<TaskRecord>,
}

/// The check of a request's uploads.
#[derive(Debug, Clone)]
pub struct CheckTask {
    pub request: Request,
    pub limits: CheckLimits,
    /// The calibration that the request names, or that of the job that it names.
    pub calibration: Option<Calibration>,
    /// The registration of that job.
    pub registered: Option<Registered>,
}

#[derive(Debug, Clone)]
pub struct CalibrationTask {
    pub calibration: CalibrationId,
    /// Captures to compute masks from; `None` if only a report on existing masks is wanted.
    pub captures: Option<Captures>,
    /// A map of bad pixels, for masks that are made of captures.
    pub bad_pixels: Option<Sha256>,
    /// True for the masks of a spectral camera, which are one mask, displaced by band.
    pub spectral: bool,
    /// The masks, a planar array, if they exist.
    pub masks: Option<Sha256>,
}

/// A movie that is to be made.
#[derive(Debug, Clone)]
pub struct MovieWork {
    pub job: JobId,
    pub spec: JobSpec,
    pub format: MovieFormat,
    pub measurement: Measurement,
    /// The record of the job's white level.
    pub white: Option<Value>,
    /// The values to show as black and as white, if they were requested.
    pub window: Option<Value>,
    /// The stack of frames of each snapshot, and its recorded hash.
    pub clips: Vec<(PathBuf, Sha256)>,
}

/// The statement that looks for work: a task that is ready, or a lease that has expired. Parameters: now,
/// [`LONGEST_PAUSE`], [`LONGEST_LEASE`].
macro_rules! look_text {
    ($kinds:expr, $by_lab:literal) => {
        look_text!(@ concat!(
            "EXISTS (SELECT 1 FROM tasks INDEXED BY ",
            $by_lab,
            " WHERE state = 'ready' ",
            $kinds,
            " AND ready_at NOT BETWEEN ?1 + 1 AND ?1 + ?2)"))
    };
    // The tasks of things, and those of jobs that have begun.
    ($kinds:expr, $by_lab:literal, $by_job:literal) => {
        look_text!(@ concat!(
            "EXISTS (SELECT 1 FROM tasks INDEXED BY ",
            $by_lab,
            " WHERE state = 'ready' ",
            $kinds,
            " AND job IS NULL AND ready_at NOT BETWEEN ?1 + 1 AND ?1 + ?2)
             OR EXISTS (SELECT 1 FROM jobs CROSS JOIN tasks INDEXED BY ",
            $by_job,
            " ON job = jobs.id
                        WHERE jobs.state = 'running' AND tasks.state = 'ready' ",
            $kinds,
            " AND job IS NOT NULL AND ready_at NOT BETWEEN ?1 + 1 AND ?1 + ?2)"))
    };
    (@ $ready:expr) => {
        concat!(
            "SELECT 1 WHERE ",
            $ready,
            " OR EXISTS (SELECT 1 FROM tasks WHERE state = 'running'
                                AND lease_until NOT BETWEEN ?1 AND ?1 + ?3)"
        )
    };
}

/// The statement that finds the next task, marks it and counts the attempt: of the highest priority, of the
/// lab whose turn it is, of other things before jobs, of the jobs that have begun before others, of the oldest one.
/// Parameters: see [`take`].
macro_rules! take_text {
    ($kinds:expr, $of_lab:literal, $by_lab:literal, $by_job:literal) => {
        take_text!(@
            concat!("state = 'ready' ", $kinds, " AND ready_at NOT BETWEEN ?5 + 1 AND ?5 + ?6"),
            $of_lab, $by_lab, $by_job)
    };
    (@ $ready:expr, $of_lab:literal, $by_lab:literal, $by_job:literal) => {
        concat!(
            "UPDATE tasks SET state = ?1, worker = ?2, lease_until = ?3, attempt = attempt + 1,
                 stage = ?4, iterations = 0, passes = 0, fraction = 0, history = NULL
             WHERE id = (
                 SELECT tasks.id FROM (
                     -- Of each lab its oldest task, and that of the oldest of its jobs that have begun.
                     SELECT finish, (SELECT id FROM tasks INDEXED BY ", $by_lab, "
                                     WHERE ", $ready, $of_lab, " AND tasks.lab = labs.lab
                                     ORDER BY priority DESC, job, ordinal, id LIMIT 1) AS task
                     FROM labs
                     UNION ALL
                     SELECT finish, (SELECT id FROM tasks INDEXED BY ", $by_job, "
                                     WHERE ", $ready, " AND job IS NOT NULL
                                       AND job = (SELECT id FROM jobs
                                                  WHERE jobs.state = 'running' AND jobs.lab = labs.lab
                                                    AND EXISTS (SELECT 1 FROM tasks INDEXED BY ", $by_job, "
                                                                WHERE job = jobs.id AND job IS NOT NULL
                                                                  AND ", $ready, ")
                                                  ORDER BY priority DESC, id LIMIT 1)
                                     ORDER BY ordinal LIMIT 1)
                     FROM labs)
                 JOIN tasks ON tasks.id = task
                 LEFT JOIN jobs ON jobs.id = job
                 ORDER BY tasks.priority DESC, max(finish, (SELECT max(start) FROM labs)),
                     job IS NULL DESC, jobs.state = 'running' DESC, job, ordinal, tasks.id
                 LIMIT 1)
             RETURNING id, job, thing, lab, kind, snapshot, snapshots, tile, attempt, cost"
        )
    };
}

/// Condition for the check of a user's network.
macro_rules! network_check {
    () => {
        "(kind = 'check' AND EXISTS (SELECT 1 FROM requests WHERE requests.id = tasks.thing AND what = 'model'))"
    };
}

/// The indexes lead past the tasks that a claimant may not have.
impl Claimant<'_> {
    fn look(self) -> &'static str {
        match self {
            Self::Local => look_text!(concat!("AND NOT ", network_check!()), "tasks_ready"),
            Self::WithoutTiles => {
                look_text!(concat!("AND kind <> 'tile' AND NOT ", network_check!()), "tasks_others")
            }
            Self::Gpu => look_text!("AND kind IN ('tile', 'pilot')", "tasks_tiles"),
            Self::Host => look_text!(
                concat!("AND kind <> 'tile' AND kind <> 'pilot' AND NOT ", network_check!()),
                "tasks_others"
            ),
            Self::Light => look_text!(
                concat!("AND light = 1 AND NOT ", network_check!()),
                "tasks_light",
                "tasks_light_of_job"
            ),
            Self::Networks => look_text!(
                concat!("AND light = 1 AND job IS NULL AND ", network_check!()),
                "tasks_light"
            ),
            // SQLite uses an index with a condition only if the statement repeats it.
            Self::Pool(_) => {
                look_text!("AND kind IN ('tile', 'pilot') AND kind = 'tile'", "tasks_tiles")
            }
        }
    }

    fn take(self) -> &'static str {
        match self {
            Self::Local => take_text!(
                concat!("AND NOT ", network_check!()),
                "",
                "tasks_ready",
                "tasks_ready_of_job"
            ),
            Self::WithoutTiles => take_text!(
                concat!("AND kind <> 'tile' AND NOT ", network_check!()),
                "",
                "tasks_others",
                "tasks_others_of_job"
            ),
            Self::Gpu => {
                take_text!("AND kind IN ('tile', 'pilot')", "", "tasks_tiles", "tasks_tiles_of_job")
            }
            Self::Host => take_text!(
                concat!("AND kind <> 'tile' AND kind <> 'pilot' AND NOT ", network_check!()),
                "",
                "tasks_others",
                "tasks_others_of_job"
            ),
            // It begins no job.
            Self::Light => take_text!(
                concat!("AND light = 1 AND NOT ", network_check!()),
                " AND job IS NULL",
                "tasks_light",
                "tasks_light_of_job"
            ),
            Self::Networks => take_text!(
                concat!("AND light = 1 AND ", network_check!()),
                " AND job IS NULL",
                "tasks_light",
                "tasks_light_of_job"
            ),
            Self::Pool(_) => take_text!(
                "AND kind IN ('tile', 'pilot') AND kind = 'tile'",
                "",
                "tasks_tiles",
                "tasks_tiles_of_job"
            ),
        }
    }
}

impl Store {
    /// Hands out the next task that this claimant may have, if there is one.
    pub async fn claim_as(
        &self,
        claimant: Claimant<'_>,
        worker: WorkerId,
        length: Duration,
    ) -> Result<Option<ClaimedTask>> {
        let now = Timestamp::now().0;
        if !self.may_have_work(claimant, now).await? {
            return Ok(None);
        }
        let mut transaction = self.write().await?;
        lease::reap(&mut transaction, now).await?;
        let claimed = take(&mut transaction, claimant, worker, length, now).await?;
        let Some(row) = claimed else {
            transaction.commit().await?;
            return Ok(None);
        };
        let lease = Lease { task: row.read("id")?, attempt: row.read("attempt")?, worker, length };
        let (owner, kind) = (tasks::owner(&row)?, tasks::kind(&row)?);
        sql!(
            "INSERT INTO attempts (task, attempt, worker, started_at) VALUES (?, ?, ?, ?)",
            [lease.task, lease.attempt, worker, now]
        )
        .execute(&mut *transaction)
        .await?;
        if let Owner::Job(job) = owner
            && jobs::state(&mut transaction, job).await? == JobState::Queued
        {
            jobs::set_state(&mut transaction, job, JobState::Running, None).await?;
        }
        if let Claimant::Pool(pool) = claimant {
            hand_over(&mut transaction, &lease, pool).await?;
        }
        workers::seen(&mut transaction, worker).await?;
        transaction.commit().await?;
        match self.work(owner, kind).await {
            Ok(work) => Ok(Some(ClaimedTask { lease, kind, cost: row.read("cost")?, work })),
            Err(error) => {
                self.part(&lease, &Loss::Lost(error.to_string())).await?;
                Err(error)
            }
        }
    }

    /// All that a task needs.
    pub(super) async fn work(&self, owner: Owner, kind: TaskKind) -> Result<Work, StoreError> {
        match owner {
            Owner::Job(job) => self.job_task(job, kind).await,
            Owner::Resource(id) => match kind {
                TaskKind::Check => self.check_task(id).await,
                TaskKind::Movie { snapshot } => {
                    self.movie_work(id.into(), snapshot, MovieFormat::Mp4).await
                }
                TaskKind::Gif { snapshot } => {
                    self.movie_work(id.into(), snapshot, MovieFormat::Gif).await
                }
                _ => self.calibration_task(id.into()).await,
            },
        }
    }

    /// Looks without the lock: most of the time there is nothing to do.
    async fn may_have_work(&self, claimant: Claimant<'_>, now: i64) -> Result<bool> {
        let found = sql!(claimant.look(), [now, LONGEST_PAUSE, LONGEST_LEASE])
            .fetch_optional(&self.readers)
            .await?;
        Ok(found.is_some())
    }

    async fn job_task(&self, job: JobId, kind: TaskKind) -> Result<Work> {
        let facts = sql_as!(
            "SELECT spec,
                 (SELECT record FROM tasks WHERE job = jobs.id AND kind = 'prepare') AS prepared,
                 (SELECT record FROM tasks WHERE job = jobs.id AND kind = 'pilot') AS pilot,
                 (SELECT record FROM tasks WHERE job = jobs.id AND kind = 'white') AS white
             FROM jobs WHERE id = ?",
            [job]
        );
        type Record = Option<Json<Value>>;
        let (Json(spec), prepared, pilot, white): (Json<JobSpec>, Record, Record, Record) =
            facts.fetch_one(&self.readers).await?;
        let calibration = self.resource_of_any_lab(spec.calibration).await?;
        let measurement = self.resource_of_any_lab(spec.measurement).await?;
        let (mut tiles, mut records) = (Vec::new(), Vec::new());
        match kind {
            TaskKind::Assemble { snapshot } => tiles = self.tile_results(job, snapshot).await?,
            TaskKind::White => tiles = self.all_tile_results(job).await?,
            TaskKind::Manifest => records = self.task_records(job).await?,
            _ => {}
        }
        let [prepared, pilot, white] =
            [prepared, pilot, white].map(|record| record.map(|json| json.0));
        Ok(Work::Job(Box::new(JobTask {
            job,
            spec,
            calibration,
            measurement,
            prepared,
            pilot,
            white,
            tiles,
            records,
        })))
    }

    async fn movie_work(
        &self,
        job: JobId,
        snapshot: Option<u32>,
        format: MovieFormat,
    ) -> Result<Work> {
        let job = self.job_of_any_lab(job).await?;
        let measurement = self.resource_of_any_lab(job.spec.measurement).await?;
        let white = self.white_record(job.id).await?;
        let window = self.movie_window(job.id, format.task(snapshot)).await?;
        let mut clips = Vec::new();
        for snapshot in
            snapshot.map_or_else(|| job.spec.snapshots.indices().collect(), |one| vec![one])
        {
            let (stack, path) = self.result_file(&job, Some(snapshot), STACK).await?;
            clips.push((path, stack.file.sha256));
        }
        let (job, spec) = (job.id, job.spec);
        let work = MovieWork { job, spec, format, measurement, white, window, clips };
        Ok(Work::Movie(Box::new(work)))
    }

    async fn check_task(&self, id: ResourceId) -> Result<Work> {
        let mut connection = self.readers.acquire().await?;
        let request = requests::find(&mut connection, id).await?;
        let limits = requests::limits(&mut connection, id).await?;
        drop(connection);
        let stated = request.submission.calibration();
        let (calibration, registered) = match (request.submission.registration_of(), stated) {
            (Some(job), _) => self.corrected(&request.lab, job).await?.unzip(),
            (None, Some(id)) => (Some(self.resource_of_any_lab(id).await?), None),
            (None, None) => (None, None),
        };
        let registered = registered.flatten();
        Ok(Work::Check(Box::new(CheckTask { request, limits, calibration, registered })))
    }

    /// The calibration and the registration of a job. `None` if one was deleted.
    async fn corrected(
        &self,
        lab: &Lab,
        job: JobId,
    ) -> Result<Option<(ReadyResource<CalibrationId>, Option<Registered>)>> {
        let found = async {
            let job = self.job(lab, job).await?;
            Ok((self.resource_of_any_lab(job.spec.calibration).await?, job.spec.registered))
        };
        match found.await {
            Ok(found) => Ok(Some(found)),
            Err(StoreError::NotFound { .. }) => Ok(None),
            Err(error) => Err(error),
        }
    }

    async fn calibration_task(&self, id: CalibrationId) -> Result<Work> {
        let mut connection = self.readers.acquire().await?;
        let request = requests::find(&mut connection, id.into()).await?;
        let masks = "SELECT prepared FROM requests WHERE id = ? AND prepared IS NOT NULL";
        let masks = sql_as!(masks, [id]);
        let masks = masks.fetch_optional(&mut *connection).await?;
        let (captures, bad_pixels, spectral) = match request.submission {
            Submission::Calibration(request) => {
                (request.captures, request.bad_pixels, request.dispersion.is_some())
            }
            Submission::Measurement(_) | Submission::Model(_) => (None, None, false),
        };
        let task = CalibrationTask { calibration: id, captures, bad_pixels, spectral, masks };
        Ok(Work::Calibration(Box::new(task)))
    }
}

/// Takes the next task, and advances its lab's tag.
async fn take(
    connection: &mut SqliteConnection,
    claimant: Claimant<'_>,
    worker: WorkerId,
    length: Duration,
    now: i64,
) -> Result<Option<SqliteRow>> {
    let row = sql!(
        claimant.take(),
        [
            TaskState::Running,
            worker,
            Lease::until(length, now),
            TaskStage::Reading,
            now,
            LONGEST_PAUSE
        ]
    )
    .fetch_optional(&mut *connection)
    .await?;
    let Some(row) = row else { return Ok(None) };
    // A lab that wanted nothing for a while begins where the others are: what it left them is not owed to it.
    sql!(
        "UPDATE labs SET start = max(finish, clock), finish = max(finish, clock) + ?2 / share
         FROM (SELECT max(start) AS clock FROM labs) WHERE lab = ?1",
        [row.read::<String>("lab")?, row.read::<f64>("cost")?]
    )
    .execute(connection)
    .await?;
    Ok(Some(row))
}

/// Notes that a tile that was claimed a moment ago is out with a pool.
async fn hand_over(
    connection: &mut SqliteConnection,
    lease: &Lease,
    pool: &str,
) -> Result<(), StoreError> {
    sql!(
        "INSERT INTO remote_tasks (task, pool, attempt) VALUES (?, ?, ?)",
        [lease.task, pool, lease.attempt]
    )
    .execute(&mut *connection)
    .await?;
    sql!("UPDATE tasks SET lease_until = NULL WHERE id = ?", [lease.task])
        .execute(connection)
        .await?;
    Ok(())
}

#[cfg(test)]
mod tests {
    use sqlx::{AssertSqlSafe, Row};

    use super::Claimant;
    use crate::{Purpose, Store};

    /// What SQLite reads of `tasks` for a statement, line by line.
    async fn plan(store: &Store, text: &str) -> Vec<String> {
        let explained = sqlx::query(AssertSqlSafe(format!("EXPLAIN QUERY PLAN {text}")));
        let rows = explained.fetch_all(&store.readers).await.unwrap();
        let lines = rows.iter().map(|row| row.get::<String, _>("detail"));
        lines.filter(|line| line.contains(" tasks")).collect()
    }

    #[tokio::test]
    async fn workers_that_take_some_tasks_read_no_others() {
        let folder = tempfile::tempdir().unwrap();
        let purpose = Purpose::Serve { accept_database: false };
        let store = Store::open(folder.path(), purpose).await.unwrap();
        // The look for leases that have run out reads what runs.
        let (no_tiles, light) = (Claimant::WithoutTiles, Claimant::Light);
        let networks = Claimant::Networks;
        let (gpu, host) = (Claimant::Gpu, Claimant::Host);
        let pool = Claimant::Pool("gpu");
        for (text, index, others) in [
            (pool.look(), "INDEX tasks_tiles", 1),
            (pool.take(), "INDEX tasks_tiles", 0),
            (gpu.look(), "INDEX tasks_tiles", 1),
            (gpu.take(), "INDEX tasks_tiles", 0),
            (host.look(), "INDEX tasks_others", 1),
            (host.take(), "INDEX tasks_others", 0),
            (no_tiles.look(), "INDEX tasks_others", 1),
            (no_tiles.take(), "INDEX tasks_others", 0),
            (light.look(), "INDEX tasks_light", 1),
            (light.take(), "INDEX tasks_light", 0),
            (networks.look(), "INDEX tasks_light", 1),
            (networks.take(), "INDEX tasks_light", 0),
        ] {
            let plan = plan(&store, text).await;
            let good = [index, "PRIMARY KEY (id=?)"];
            let bad: Vec<_> =
                plan.iter().filter(|line| !good.iter().any(|good| line.contains(good))).collect();
            assert!(plan.iter().any(|line| line.contains(good[0])), "{plan:#?}");
            assert_eq!(bad.len(), others, "{bad:#?} of {plan:#?}");
        }
    }
}
